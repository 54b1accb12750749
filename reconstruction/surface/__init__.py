"""Estimates at surface points, their textures and errors."""
