"""Error against run time of every stage: what `skinrig bench` measures."""
