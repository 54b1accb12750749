"""Analyze populations of faces: spaces of reflectance and of albedo."""
