"""Actual rigs: nominal geometry plus tolerances."""
