"""Extremes of searches on maps: common mixtures, depth steps, landmark fields, pigments."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.brdf import tables
from reconstruction.brdf_basis.space import brdf_inner_products, refine_mixtures
from reconstruction.correspondence.landmark_field import LandmarkFieldError, fit_landmark_field
from reconstruction.normal_integration import IntegrationError
from reconstruction.normal_integration.discontinuities import integrate_with_discontinuities
from reconstruction.tsumura import UnmixingError, tsumura_ica
from skinrig.arrays import Float64Array
from skinrig.extremes.expectations import (
    expect_error,
    expect_finite,
    expect_near,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision


def _mixtures(seed: int, count: int) -> Float64Array:
    rows = np.random.default_rng(seed).random((count, tables.default_basis().size))
    return rows / rows.sum(axis=1, keepdims=True)


def _refined(weights: NDArray[Any], start: NDArray[Any]) -> Float64Array:
    return refine_mixtures(weights, start, tables.default_basis(), sweeps=5)


def _expect_unit_sums(found: Float64Array) -> str:
    return "sums " + expect_near(found.sum(axis=1), np.ones(len(found)), absolute=1e-9)


def _points_of_zero(real: InputPrecision) -> str:
    start = real(_mixtures(0, 3))
    return _expect_unit_sums(_refined(np.zeros((8, start.shape[1])), start))


def _start_of_zero(real: InputPrecision) -> str:
    weights = real(_mixtures(1, 20))
    return _expect_unit_sums(_refined(weights, np.zeros((3, weights.shape[1]))))


def _exact_mixtures(real: InputPrecision) -> str:
    mix = _mixtures(2, 3)
    shares = np.random.default_rng(3).random((20, 3))
    off = _refined(real(shares @ mix), real(mix)) - mix
    gram = brdf_inner_products(tables.default_basis())
    size = np.einsum("rk,kl,rl->r", mix, gram, mix)
    moved = np.sqrt(np.maximum(np.einsum("rk,kl,rl->r", off, gram, off), 0.0) / size)
    return expect_within(moved, 0.0, 1e-4, label="relative change")


def _units_of_weights(real: InputPrecision) -> str:
    weights, start = _mixtures(4, 20), _mixtures(5, 3)
    faint, strong = (_refined(real(scale * weights), real(start)) for scale in (1e-9, 1e9))
    return "mixtures " + expect_near(faint, strong, absolute=1e-5)


def _facing_normals(side: int, tilt_rad: float = 0.0) -> Float64Array:
    one = np.array([np.sin(tilt_rad), 0.0, np.cos(tilt_rad)])
    return np.broadcast_to(one, (side, side, 3)).copy()


def _flat_surface(real: InputPrecision) -> str:
    found = integrate_with_discontinuities(real(_facing_normals(16)))
    return "heights " + expect_near(np.ptp(found.height), 0.0, absolute=1e-6)


def _steep_plane(real: InputPrecision) -> str:
    tilt = np.deg2rad(85.0)
    found = integrate_with_discontinuities(real(_facing_normals(16, tilt)))
    slope = np.diff(found.height, axis=1).mean()
    return "slope " + expect_near(slope, -np.tan(tilt), relative=0.01)


def _normals_with_holes(real: InputPrecision) -> str:
    normals = real(_facing_normals(16))
    normals[4:9, 4:9] = np.nan
    found = integrate_with_discontinuities(normals)
    expect_finite(found.height, found.valid, label="heights")
    return expect_valid_fraction(found.valid, fraction_range=(1 - 25 / 256, 1 - 25 / 256))


def _surface_without_mask(real: InputPrecision) -> str:
    return expect_error(
        lambda: integrate_with_discontinuities(
            real(_facing_normals(4)), valid=np.zeros((4, 4), bool)
        ),
        IntegrationError,
        "valid",
    )


LANDMARKS_PX = np.random.default_rng(6).uniform(0.0, 200.0, (12, 2))


def _still_landmarks(real: InputPrecision) -> str:
    points = real(LANDMARKS_PX)
    moved, _ = fit_landmark_field(points, points, stderr_px=0.5).evaluate([[90.0, 110.0]])
    return "displacement, px " + expect_near(moved, np.zeros((1, 2)), absolute=1e-9)


def _far_landmarks(real: InputPrecision) -> str:
    points, moved = real(LANDMARKS_PX), real(1.1 * LANDMARKS_PX + 1e5)
    found, _ = fit_landmark_field(points, moved, stderr_px=0.5).evaluate([[90.0, 110.0]])
    return "displacement, px " + expect_near(found, [[1e5 + 9.0, 1e5 + 11.0]], absolute=0.05)


def _exact_landmarks(real: InputPrecision) -> str:
    bent = LANDMARKS_PX + 20.0 * np.sin(LANDMARKS_PX[:, ::-1] / 40.0)
    field = fit_landmark_field(real(LANDMARKS_PX), real(bent), stderr_px=1e-12)
    found, error = field.evaluate(LANDMARKS_PX)
    expect_finite(error, np.ones(len(error), bool), label="standard errors")
    return "displacement, px " + expect_near(found, bent - LANDMARKS_PX, absolute=0.1)


def _landmarks_on_line(real: InputPrecision) -> str:
    line = real(np.stack([np.arange(9.0), 2.0 * np.arange(9.0)], axis=1))
    return expect_error(
        lambda: fit_landmark_field(line, line, stderr_px=0.5), LandmarkFieldError, "line"
    )


def _pigmented(real: InputPrecision) -> NDArray[Any]:
    amounts = np.random.default_rng(7).laplace(0.5, 0.05, (40, 40, 2))
    return real(np.exp(-amounts @ np.array([[0.3, 0.6, 1.0], [0.1, 0.9, 0.4]])))


def _black_holes(real: InputPrecision) -> str:
    rgb = _pigmented(real)
    rgb[:10] = 0.0
    found = tsumura_ica(rgb, np.ones((40, 40), bool))
    expect_finite(found.melanin, found.valid, label="melanin")
    return expect_valid_fraction(found.valid, fraction_range=(0.75, 0.75))


def _units_of_channels(real: InputPrecision) -> str:
    rgb, every = _pigmented(real), np.ones((40, 40), bool)
    scaled = tsumura_ica(rgb * real([1e-9, 1.0, 1e9]), every)
    return "melanin " + expect_near(scaled.melanin, tsumura_ica(rgb, every).melanin, absolute=5e-3)


def _one_color(real: InputPrecision) -> str:
    return expect_error(
        lambda: tsumura_ica(real(np.full((20, 20, 3), 0.4)), np.ones((20, 20), bool)),
        UnmixingError,
        "one direction",
    )


def _too_few_colors(real: InputPrecision) -> str:
    valid = np.zeros((40, 40), bool)
    valid[0] = True
    return expect_error(
        lambda: tsumura_ica(_pigmented(real), valid), UnmixingError, "usable pixels"
    )
