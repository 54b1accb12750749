"""Packing of arrays and text into the page."""
