"""Diffuse albedo R_d from lumitexels, and the reduced albedo."""

from reconstruction.diffuse_albedo.estimation import (
    DiffuseAlbedo,
    ReducedAlbedo,
    estimate,
    reduced_albedo,
)

__all__ = ["DiffuseAlbedo", "ReducedAlbedo", "estimate", "reduced_albedo"]
