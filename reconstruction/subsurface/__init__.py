"""Subsurface scattering: optical properties from radial profiles."""

from reconstruction.subsurface.inversion import SubsurfaceError, fit_dipole, invert, nearest_medium
from reconstruction.subsurface.outcome import Outcome, SubsurfaceFit
from reconstruction.subsurface.profile_batch import LeftOut

__all__ = [
    "LeftOut",
    "Outcome",
    "SubsurfaceError",
    "SubsurfaceFit",
    "fit_dipole",
    "invert",
    "nearest_medium",
]
