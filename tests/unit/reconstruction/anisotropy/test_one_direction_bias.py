import numpy as np
import pytest

from reconstruction.anisotropy import plane_vectors
from reconstruction.anisotropy.estimation import (
    AnisotropyError,
    estimate,
    estimate_single_direction_bias,
)

SIXTEEN = np.deg2rad(np.arange(16) * 22.5)
STDERR = 0.02


def ellipse(angle, ratio, axis_rad, mean=0.6):
    """sigma_tr of a medium that diffuses `ratio` squared times as much along the axis."""
    along, across = np.cos(angle - axis_rad), np.sin(angle - axis_rad)
    value = np.sqrt((along / ratio) ** 2 + across**2)
    turn = np.linspace(0, np.pi, 3601)[:-1]
    return mean * value / np.hypot(np.cos(turn) / ratio, np.sin(turn)).mean()


def test_single_direction_bias_matches_ellipse():
    found = estimate(SIXTEEN, ellipse(SIXTEEN, 1.3, 0.5))
    angles = np.array([0.1, 0.5, 1.2, 2.9])
    bias = estimate_single_direction_bias(found, angles)
    np.testing.assert_allclose(bias.bias, ellipse(angles, 1.3, 0.5) / 0.6 - 1, atol=1e-6)
    every = ellipse(np.linspace(0, np.pi, 1001)[:-1], 1.3, 0.5) / 0.6 - 1
    assert bias.lowest == pytest.approx(every.min(), abs=1e-5)
    assert bias.highest == pytest.approx(every.max(), abs=1e-5)
    assert bias.rms == pytest.approx(np.sqrt((every**2).mean()), abs=1e-5)


def test_single_direction_biases_are_within_standard_errors(rng):
    truth = ellipse(SIXTEEN, 1.3, 0.8)[:, None]
    found = estimate(SIXTEEN, truth * (1 + STDERR * rng.standard_normal((16, 3000))))
    angles = np.array([0.0, 0.8, 1.5])
    bias = estimate_single_direction_bias(found, angles)
    assert bias.bias.shape == (3, 3000)
    off = np.abs(bias.bias - (ellipse(angles, 1.3, 0.8) / 0.6 - 1)[:, None])
    assert ((off < bias.stderr).mean(axis=1) > 0.65).all()
    assert ((off < bias.stderr).mean(axis=1) < 0.72).all()


def test_single_direction_bias_is_unknown_without_estimate():
    good = np.zeros((16, 1), bool)
    found = estimate(SIXTEEN, np.ones((16, 1)), valid=good)
    bias = estimate_single_direction_bias(found, 0.0)
    assert bias.bias.tolist() == [[0.0]]
    assert np.isinf(bias.stderr).all()
    assert found.axis_stderr_rad[0] == plane_vectors.UNKNOWN_AXIS_RAD


def test_directions_that_are_not_finite_are_refused():
    found = estimate(SIXTEEN, ellipse(SIXTEEN, 1.3, 0.5))
    for angle in (np.nan, [[0.0]], [0.0, np.inf]):
        with pytest.raises(AnisotropyError, match="angle_rad"):
            estimate_single_direction_bias(found, angle)
