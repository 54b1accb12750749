"""Stages of the flash rig."""
