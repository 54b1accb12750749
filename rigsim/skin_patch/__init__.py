"""Skin patches: microrelief, stretch and motion."""
