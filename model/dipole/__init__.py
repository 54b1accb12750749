"""Dipole diffusion: profiles, total reflectance and sums over surfaces."""

from model.dipole.profile import ReflectanceOutlierError as ReflectanceOutlierError
from model.dipole.profile import absorbed_fraction as absorbed_fraction
from model.dipole.profile import coefficients as coefficients
from model.dipole.profile import effective_transport as effective_transport
from model.dipole.profile import invert_to_deficit as invert_to_deficit
from model.dipole.profile import invert_total_reflectance as invert_total_reflectance
from model.dipole.profile import is_outlier as is_outlier
from model.dipole.profile import reflectance as reflectance
from model.dipole.profile import total_reflectance as total_reflectance
