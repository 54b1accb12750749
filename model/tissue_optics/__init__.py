"""Tissue optics: absorption of chromophores and reflectance of layered skin."""

from model.tissue_optics.layers import (
    TissueError,
    blood_absorption,
    layer_stack_reflectance,
    skin_layers,
    two_layer_reflectance,
)

__all__ = [
    "TissueError",
    "blood_absorption",
    "layer_stack_reflectance",
    "skin_layers",
    "two_layer_reflectance",
]
