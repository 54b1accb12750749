"""Scenes of the fiber probe."""
