"""Compare two runs side by side: maps, images and checks."""
