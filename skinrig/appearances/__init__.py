"""Access parts of appearances: dynamic parts, face textures and ground truth of expressions."""
