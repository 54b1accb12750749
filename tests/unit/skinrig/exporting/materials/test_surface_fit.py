"""One lobe for a mixture of tabulated ones: exact where one lobe is the truth, told where not."""

import numpy as np
import pytest

from model.brdf import recipe as brdf_recipe
from model.brdf import tables as brdf_tables
from skinrig.exporting.materials.surface_fit import fit_ggx_lobe


def lobes_named(*names):
    every = dict(brdf_recipe.materials())
    light = brdf_tables.LED_RADIUS_RAD
    return brdf_tables.tabulate({n: every[n] for n in names}, light_radius_rad=light)


@pytest.mark.parametrize("alpha", [0.1, 0.22, 0.33, 0.48])
def test_single_lobe_surface_recovers_roughness_and_weight(alpha):
    """Tables are coarse and seen by a round light: 2 % of roughness, 4 % of weight."""
    found = fit_ggx_lobe(lobes_named(f"ggx {alpha:g} eta 1.4"), [[[1.0], [0.5]]], eta=1.4)
    np.testing.assert_allclose(found.roughness[0], np.sqrt(alpha), rtol=0.02)
    np.testing.assert_allclose(found.weight[0], [1.0, 0.5], rtol=0.04)
    assert found.misfit.max() < 0.04


def test_misfit_reveals_mixture_unlike_any_lobe():
    lobes = lobes_named("ggx 0.1 eta 1.4", "ggx 0.58 eta 1.4")
    found = fit_ggx_lobe(lobes, [[[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]]], eta=1.4)
    assert found.misfit[0, 2] > 0.2 > 3.0 * found.misfit[0, :2].max()
    assert found.roughness[0, 0] < found.roughness[0, 2] < found.roughness[0, 1]


def test_a_denser_surface_is_a_heavier_lobe():
    """F_0 of 1.55 over that of 1.4 is 1.675; away from normal light less."""
    found = fit_ggx_lobe(lobes_named("ggx 0.33 eta 1.55"), [[[1.0]]], eta=1.4)
    assert 1.4 < found.weight[0, 0] < 1.7


def test_non_reflecting_surface_has_zero_weight():
    found = fit_ggx_lobe(lobes_named("ggx 0.33 eta 1.4"), [[[0.0]]], eta=1.4)
    assert (found.weight[0, 0], found.roughness[0, 0], found.misfit[0, 0]) == (0.0, 1.0, 0.0)
