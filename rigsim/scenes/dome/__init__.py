"""Scenes of the light dome."""
