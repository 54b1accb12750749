"""Capture: rigs, plans, device drivers, sessions, calibration and raw frames."""
