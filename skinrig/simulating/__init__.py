"""Simulate sessions of all rigs through the drivers of the real devices."""
