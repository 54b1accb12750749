"""The boundary's transmittance, compiled, against its plain twin."""

import numpy as np
import pytest

from model import fresnel
from reconstruction.lumitexels import boundary_kernels


def plain(cos_light, cos_view, eta):
    inside = 1.0 - fresnel.reflectance(np.clip(cos_light, 0.0, 1.0), eta)
    return inside * (1.0 - fresnel.reflectance(np.clip(cos_view, 0.0, 1.0), eta))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("eta", [0.7, 1.0, 1.3, fresnel.ETA_SKIN, 1e6])
def test_compiled_and_plain_transmittance_are_bit_equal(rng, eta, dtype):
    cosines = rng.uniform(-0.2, 1.2, (2, 60, 70)).astype(dtype)
    special = np.array([0.0, 1.0, 1e-30, -1.0, 1e-8, np.nan, np.inf, -np.inf], dtype)
    cosines[:, 0, :8] = special
    cosines[1, 0, 8:16] = special
    cosines = np.concatenate([cosines, cosines[::-1]], axis=1)
    before = cosines.copy()
    found = boundary_kernels.boundary_transmittance(*cosines, eta)
    expected = plain(*cosines.astype(np.float64), eta)
    assert found.dtype == np.float64
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(cosines, before)


def test_matched_boundary_transmits_everything_and_grazing_light_nothing():
    up, low = np.ones(3), np.zeros(3)
    np.testing.assert_array_equal(boundary_kernels.boundary_transmittance(up, low, 1.0), 1.0)
    np.testing.assert_array_equal(boundary_kernels.boundary_transmittance(low, up, 1.4), 0.0)


def test_transmittance_works_in_any_memory_order_or_empty(rng):
    cosines = rng.uniform(0.0, 1.0, (40, 30))
    turned = boundary_kernels.boundary_transmittance(cosines.T, cosines.T[:, ::1])
    np.testing.assert_array_equal(turned, plain(cosines.T, cosines.T, fresnel.ETA_SKIN))
    assert boundary_kernels.boundary_transmittance(np.zeros((0, 4)), np.zeros((0, 4))).shape == (
        0,
        4,
    )


@pytest.mark.parametrize("eta", [0.0, -1.0, np.nan, np.inf])
def test_invalid_index_is_refused(eta):
    with pytest.raises(ValueError, match="eta: got"):
        boundary_kernels.boundary_transmittance(np.ones(2), np.ones(2), eta)
    with pytest.raises(ValueError, match="cos_light: got"):
        boundary_kernels.boundary_transmittance(np.ones(2), np.ones(3))
