"""Light through fibers: Monte Carlo profiles as the probe measures them."""
