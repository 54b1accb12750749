"""Dipole diffusion: profiles, total reflectance and sums over surfaces."""

from model.dipole.profile import (
    ReflectanceOutlierError,
    absorbed_fraction,
    albedo_slope,
    coefficients,
    effective_transport,
    invert_to_deficit,
    invert_total_reflectance,
    is_outlier,
    reflectance,
    total_reflectance,
)

__all__ = [
    "ReflectanceOutlierError",
    "absorbed_fraction",
    "albedo_slope",
    "coefficients",
    "effective_transport",
    "invert_to_deficit",
    "invert_total_reflectance",
    "is_outlier",
    "reflectance",
    "total_reflectance",
]
