"""Faces analysed together: spaces of reflectance and of albedo."""
