"""Prepare data of other devices for import."""
