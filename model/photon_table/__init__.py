"""The photon table: Monte Carlo reflectance of semi-infinite media."""

from model.dipole.kienle_patterson import ProfileDerivatives as ProfileDerivatives
from model.photon_table.medium import TableDomainError as TableDomainError
from model.photon_table.medium import stored_asymmetries as stored_asymmetries
from model.photon_table.table import derivatives as derivatives
from model.photon_table.table import is_in_domain as is_in_domain
from model.photon_table.table import reflectance as reflectance
from model.photon_table.table import relative_error as relative_error
