"""Capture of sessions: addresses, plans, acquisition, light safety and sequences."""
