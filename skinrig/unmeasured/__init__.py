"""Parts of a person that no rig measures, fitted for display: crown, neck, eyes, brows, hair."""
