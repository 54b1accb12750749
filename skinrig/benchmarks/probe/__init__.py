"""Benchmarks of the probe's estimators."""
