"""Simulated populations and subject files."""
