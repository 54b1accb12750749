"""Stiff and extreme cases: what `skinrig bench --extremes` tries."""
