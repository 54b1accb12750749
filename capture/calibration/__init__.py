"""Calibration of sensor, color and polarization, and the CALIBRATION/ format."""
