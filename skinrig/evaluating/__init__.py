"""Evaluate maps against ground truth: their errors, and the coverage of their intervals."""
