"""Subsurface scattering: optical properties from radial profiles."""

from reconstruction.subsurface.inversion import SubsurfaceError, fit_dipole, invert, nearest_medium
from reconstruction.subsurface.outcome import FitOutcome, SubsurfaceFit
from reconstruction.subsurface.profile_batch import OmissionReason

__all__ = [
    "FitOutcome",
    "OmissionReason",
    "SubsurfaceError",
    "SubsurfaceFit",
    "fit_dipole",
    "invert",
    "nearest_medium",
]
