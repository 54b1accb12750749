"""Measure how well two sessions of one simulated person agree."""
