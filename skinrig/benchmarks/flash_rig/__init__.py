"""Benchmarks of the flash rig's estimators."""
