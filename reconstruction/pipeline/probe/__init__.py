"""Stages of the fiber probe."""
