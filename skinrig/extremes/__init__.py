"""Stiff and extreme cases of `skinrig bench --extremes`."""
