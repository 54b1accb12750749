"""Scenes of the gradient rig."""
