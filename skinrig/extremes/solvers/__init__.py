"""Extreme cases of iterative solvers: what is reached, how, and why a search stops."""
