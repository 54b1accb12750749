"""Views of appearances: dynamic maps, face textures and ground truth of expressions."""
