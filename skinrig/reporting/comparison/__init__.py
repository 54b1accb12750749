"""Comparison pages: runs, maps, images and checks side by side."""
