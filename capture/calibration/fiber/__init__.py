"""Calibration of the fiber probe: gains, positions, cross-talk and dark signal."""
