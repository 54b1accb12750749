"""Scenes of the flash rig."""
