"""Fit of a color table to single pixels: kernels, priors, start values, factors of intervals."""
