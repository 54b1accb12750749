"""Wrinkle fit: masks, zones and weights from normal maps."""
