"""Correspondence between faces: landmarks, fields and common maps."""
