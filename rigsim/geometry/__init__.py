"""Meshes, texture atlases and noise on surfaces."""
