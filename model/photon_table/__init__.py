"""The photon table: Monte Carlo reflectance of semi-infinite media."""

from model.dipole.kienle_patterson import Slopes
from model.photon_table.medium import TableDomainError, asymmetries
from model.photon_table.table import by_asymmetry, derivatives, domain, reflectance, relative_error

__all__ = [
    "Slopes",
    "TableDomainError",
    "asymmetries",
    "by_asymmetry",
    "derivatives",
    "domain",
    "reflectance",
    "relative_error",
]
