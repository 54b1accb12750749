"""Microstructure assets of the viewer."""
