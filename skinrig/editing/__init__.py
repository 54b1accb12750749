"""Traits and spots given to a face or taken from it."""
