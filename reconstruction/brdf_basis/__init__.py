"""BRDF basis: non-negative weights at surface points and their reduction."""

from reconstruction.brdf_basis.fit import (
    BasisWeights,
    SampleError,
    SurfaceSamples,
    evaluate,
    fit_weights,
    lit_sphere,
    plateau,
    reduce,
    surface_samples,
)

__all__ = [
    "BasisWeights",
    "SampleError",
    "SurfaceSamples",
    "evaluate",
    "fit_weights",
    "lit_sphere",
    "plateau",
    "reduce",
    "surface_samples",
]
