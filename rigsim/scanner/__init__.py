"""The simulated surface scanner: pods, flaws and fusion."""
