"""Benchmarks of the gradient rig's estimators."""
