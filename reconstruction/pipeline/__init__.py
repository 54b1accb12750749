"""Recipes that compute an APPEARANCE/ folder from a session."""
