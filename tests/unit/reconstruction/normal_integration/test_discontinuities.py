"""Height of surfaces that jump, from their normals."""

import numpy as np
import pytest

from reconstruction.normal_integration.discontinuities import (
    BilateralSettings,
    integrate_with_discontinuities,
)
from reconstruction.normal_integration.integration import integrate
from reconstruction.normal_integration.weighted_poisson import IntegrationError


def flap(side, rise):
    """Return height in px and normals of a flap that curls up from a hinge, cut on three sides."""
    y, x = np.mgrid[0:side, 0:side].astype(float)
    on = (x > 0.3 * side) & (x < 0.7 * side) & (abs(y - 0.5 * side) < 0.2 * side)
    slope = np.where(on, rise * (x - 0.3 * side) / (0.4 * side), 0.0)
    height = np.where(on, slope * (x - 0.3 * side) / 2, 0.0)
    waves = 2.0 * np.pi / side
    height += 0.02 * side * np.sin(waves * x + 0.4) * np.cos(0.9 * waves * y)
    right = 0.02 * side * waves * np.cos(waves * x + 0.4) * np.cos(0.9 * waves * y)
    down = -0.018 * side * waves * np.sin(waves * x + 0.4) * np.sin(0.9 * waves * y)
    n = np.stack([-(slope + right), down, np.ones_like(x)], axis=-1)
    return height, n / np.linalg.norm(n, axis=-1, keepdims=True), on


def rms(height, truth):
    error = height - truth
    return np.sqrt(np.mean((error - np.median(error)) ** 2))


def plain_objective(height, normals, k):
    """Evaluate the paper's objective pixel by pixel, weights from the same height."""
    m = normals[..., 2]
    total = 0.0
    for axis, g in ((1, -normals[..., 0] / m), (0, normals[..., 1] / m)):
        h, n, s = (np.moveaxis(a, axis, 1) for a in (height, m, g))
        step = np.diff(h, axis=1)
        after = n[:, :-1] * step  # from each pixel to its next
        before = n[:, 1:] * step
        weight = np.full(h.shape, 0.5)
        weight[:, 1:-1] = 1.0 / (1.0 + np.exp(-k * (before[:, :-1] ** 2 - after[:, 1:] ** 2)))
        total += np.sum(weight[:, :-1] * n[:, :-1] ** 2 * (step - s[:, :-1]) ** 2)
        total += np.sum((1 - weight[:, 1:]) * n[:, 1:] ** 2 * (step - s[:, 1:]) ** 2)
    return total


@pytest.mark.long
def test_bilateral_integration_raises_flap_joined_surface_flattens():
    truth, normals, _ = flap(96, 1.0)
    joined = rms(integrate(normals), truth)
    found = integrate_with_discontinuities(
        normals, settings=BilateralSettings(sharpness=20.0, stop=0.0)
    )
    assert rms(found.height, truth) < joined / 2
    # too soft a setting leaves it joined
    soft = integrate_with_discontinuities(normals, settings=BilateralSettings(sharpness=0.01))
    assert rms(soft.height, truth) > 0.85 * joined


def test_the_objective_is_that_of_the_paper():
    _, normals, _ = flap(40, 1.0)
    found = integrate_with_discontinuities(
        normals, settings=BilateralSettings(sharpness=3.0, rounds=4, stop=0.0)
    )
    assert found.energy == pytest.approx(plain_objective(found.height, normals, 3.0), rel=1e-5)
    assert found.outcome.iterations == 4
    assert found.outcome.stop == "limit"


def test_weights_within_unit_interval_open_at_jump():
    truth, normals, on = flap(96, 1.0)
    found = integrate_with_discontinuities(
        normals, settings=BilateralSettings(sharpness=20.0, stop=0.0)
    )
    assert found.right.min() >= 0.0
    assert found.right.max() <= 1.0
    tip = np.flatnonzero(on[48])[-1]
    assert truth[48, tip] - truth[48, tip + 1] > 15.0
    assert found.height[48, tip - 1] - found.height[48, tip + 1] > 10.0
    # to within a pixel of it, one holds to the flap only and the next to the ground only
    beside = found.right[48, tip - 1 : tip + 2]
    assert beside.min() < 0.01
    assert beside.max() > 0.99


def test_smooth_surface_is_unchanged_to_first_order():
    truth, normals, _ = flap(64, 0.0)
    found = integrate_with_discontinuities(normals)
    assert rms(found.height, truth) < 0.02 * np.std(truth)
    assert found.outcome.converged


def test_gentle_slopes_are_iterated_like_steep_ones():
    """The relative stop does not end the search at the first, coarse solution."""
    truth, normals, _ = flap(64, 0.0)
    normals = normals / normals[..., 2:]
    gentle = integrate_with_discontinuities(normals * [1e-3, 1e-3, 1.0])  # slopes of 1e-4
    assert gentle.outcome.iterations >= 1
    assert gentle.outcome.stop == "tolerance"
    steep = integrate_with_discontinuities(normals)
    assert rms(gentle.height, 1e-3 * truth) < 1.1e-3 * rms(steep.height, truth)


def test_masks_and_parts_are_kept():
    _, normals, _ = flap(48, 1.0)
    valid = np.ones((48, 48), bool)
    valid[:, 10] = False
    valid[5, 5] = False
    found = integrate_with_discontinuities(normals.astype(np.float32), valid=valid, stderr_rad=0.02)
    assert found.height.dtype == np.float32
    np.testing.assert_array_equal(found.valid, valid)
    np.testing.assert_array_equal(found.height[~valid], 0.0)
    assert found.part.max() == 2
    for part in (1, 2):
        assert abs(found.height[found.part == part].mean()) < 1e-5


@pytest.mark.long
def test_single_pixel_and_single_row_have_height():
    flat = np.broadcast_to([0.1, 0.0, 1.0], (1, 9, 3))
    assert integrate_with_discontinuities(flat[:, :1]).height.shape == (1, 1)
    np.testing.assert_allclose(
        np.diff(integrate_with_discontinuities(flat).height), -0.1, atol=1e-6
    )


@pytest.mark.parametrize("change", [{"sharpness": 0.0}, {"rounds": 0}, {"stop": 1.0}, {"inner": 0}])
def test_settings_out_of_range_are_named(change):
    with pytest.raises(IntegrationError, match=f"BilateralSettings.{next(iter(change))}: got"):
        BilateralSettings(**change)


def test_nothing_to_integrate_is_named():
    with pytest.raises(IntegrationError, match="no pixel"):
        integrate_with_discontinuities(np.zeros((4, 4, 3)))
    with pytest.raises(IntegrationError, match="pixel: got"):
        integrate_with_discontinuities(np.ones((4, 4, 3)), pixel=-1.0)
