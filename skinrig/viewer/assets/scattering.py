"""How far light spreads in skin where nothing of it was measured: the page's default profile.

Measured translucency comes with the fitted reflectance (`skinrig.viewer.assets.reflectance`); the
page switches between the two.
"""

from __future__ import annotations

from model import skin_reflectance
from skinrig.viewer.assets import gaussian_profiles
from skinrig.viewer.scene import Assets, SceneSource

R_D = (0.46, 0.31, 0.23)
"""R_d of facial skin, Weyrich et al. 2006, figure 11, linear sRGB; it shapes the profile's core."""


def assets(source: SceneSource) -> Assets:
    """Return variances and weights of the Gaussians of the population's mean dipole."""
    depth_mm, told = skin_reflectance.population_mean_mm()
    profile = gaussian_profiles.fit(R_D, 1.0 / depth_mm)
    return {"facts": {"scattering": profile.facts(told)}}
