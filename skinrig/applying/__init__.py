"""Evaluate fitted models of a moving face: `skinrig apply`."""
