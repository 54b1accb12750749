"""The photon table: Monte Carlo reflectance of semi-infinite media."""

from model.dipole.kienle_patterson import Slopes
from model.photon_table.medium import TableDomainError, asymmetries
from model.photon_table.table import derivatives, domain, reflectance, relative_error

__all__ = [
    "Slopes",
    "TableDomainError",
    "asymmetries",
    "derivatives",
    "domain",
    "reflectance",
    "relative_error",
]
