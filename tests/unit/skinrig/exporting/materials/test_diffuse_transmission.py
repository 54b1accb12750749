"""The transmission of glTF against traced slabs of tissue, and read back."""

from math import sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model import fresnel
from rigsim.tissue.tissue_mc import Layer, LayerStack, trace_photons
from skinrig.exporting.materials.diffuse_transmission import DiffuseTransmission, amplitude

ETA = 1.4


def made(translucency_mm, deficit, max_factor=1.0):
    return DiffuseTransmission.of(
        translucency_mm, deficit, eta=ETA, max_factor=max_factor, thickness_m=0.1
    )


@pytest.mark.parametrize(("sigma_a", "sigma_s"), [(0.03, 1.4), (0.35, 2.0)])
@pytest.mark.parametrize("depths", [1.0, 2.0])
def test_slab_transmits_as_traced(sigma_a, sigma_s, depths):
    """Expected: 5 % by diffusion theory, and three standard errors."""
    sigma_t = sigma_a + sigma_s
    depth_mm = 1.0 / sqrt(3.0 * sigma_a * sigma_t)
    layer = Layer(depths * depth_mm, sigma_a, sigma_s / 0.2, 0.8, ETA)
    rng = np.random.default_rng(7)
    traced = trace_photons(LayerStack((layer,)), photons=20_000, rng=rng)
    found = made([depth_mm] * 3, [sigma_a / sigma_t] * 3).transmit(depths * depth_mm)
    expected = traced.transmittance / (1.0 - fresnel.normal_reflectance(ETA))
    allowed = 0.05 * expected + 3.0 * traced.transmittance_stderr
    np.testing.assert_allclose(found, expected, atol=allowed)


@settings(derandomize=True, deadline=None, max_examples=30, database=None)
@given(
    depth=st.lists(st.floats(0.05, 50.0), min_size=3, max_size=3),
    deficit=st.lists(st.floats(1e-6, 0.9), min_size=3, max_size=3),
    max_factor=st.floats(0.05, 1.0),
)
def test_transmission_is_read_back_and_stays_in_range(depth, deficit, max_factor):
    if max(depth) > 30.0 * min(depth):
        depth = [max(one, max(depth) / 30.0) for one in depth]
    found = made(depth, deficit, max_factor)
    np.testing.assert_allclose(found.translucency_mm, depth, rtol=1e-9)
    assert 0.0 < found.factor <= max_factor
    assert ((found.color >= 0.0) & (found.color <= 1.0)).all()
    assert ((found.attenuation_color > 0.0) & (found.attenuation_color < 1.0)).all()
    assert (found.factor * found.color <= amplitude(deficit, ETA) + 1e-12).all()
    values = found.extensions()
    assert list(values) == ["KHR_materials_diffuse_transmission", "KHR_materials_volume"]


def test_light_beyond_largest_factor_is_lost():
    whole, part = made([2.0] * 3, [0.02, 0.1, 0.3]), made([2.0] * 3, [0.02, 0.1, 0.3], 0.4)
    np.testing.assert_allclose(whole.factor * whole.color, amplitude([0.02, 0.1, 0.3], ETA))
    np.testing.assert_allclose(
        part.factor * part.color, np.minimum(whole.factor * whole.color, 0.4)
    )
