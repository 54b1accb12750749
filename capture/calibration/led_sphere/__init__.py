"""Calibration of the gradient rig's LED sphere: lights, survey and polarizers."""
