"""The photon table: Monte Carlo reflectance of semi-infinite media."""

from model.dipole.kienle_patterson import Slopes as Slopes
from model.photon_table.medium import TableDomainError as TableDomainError
from model.photon_table.medium import asymmetries as asymmetries
from model.photon_table.table import derivatives as derivatives
from model.photon_table.table import domain as domain
from model.photon_table.table import reflectance as reflectance
from model.photon_table.table import relative_error as relative_error
