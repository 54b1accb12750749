"""Minimal acquisition: the smallest capture plan per error goal, and error forecasts of plans."""
