"""Benchmarks of the dome's estimators."""
