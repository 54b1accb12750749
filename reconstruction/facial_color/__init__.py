"""Estimators of facial color over expressions, repeats and sequences."""
