"""Fit models to the maps of sessions: `skinrig fit`."""
