"""Subsurface scattering: optical properties from radial profiles."""

from reconstruction.subsurface.inversion import SubsurfaceError, fit_dipole, invert, nearest_medium
from reconstruction.subsurface.outcome import LEFT_OUT, Outcome, SubsurfaceFit

__all__ = [
    "LEFT_OUT",
    "Outcome",
    "SubsurfaceError",
    "SubsurfaceFit",
    "fit_dipole",
    "invert",
    "nearest_medium",
]
