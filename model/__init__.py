"""Appearance model: parameter classes, forward equations, the APPEARANCE/ format."""
