"""Calibrations of each rig from sessions of targets."""
