"""Fusion: one person's skin from the measurements of several rigs."""
