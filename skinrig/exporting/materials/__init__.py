"""Export materials and meshes."""
