"""Diffuse albedo R_d from lumitexels."""

from reconstruction.diffuse_albedo.estimation import DiffuseAlbedo, estimate

__all__ = ["DiffuseAlbedo", "estimate"]
