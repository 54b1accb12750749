"""Stages of the light dome."""
