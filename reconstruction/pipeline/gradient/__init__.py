"""Stages of the gradient rig."""
