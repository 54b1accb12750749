"""Extremes of facial motion: local statistics, blends, wrinkles, strain, kernels."""

import numpy as np

from model import facial_color, microstructure, wrinkles
from model.facial_color import FacialColorError, HemoglobinRig
from skinrig.extremes.expectations import (
    expect_error,
    expect_finite,
    expect_near,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision, sheet_faces, stretched_sheet


def _near_constant(real: InputPrecision) -> str:
    rng = np.random.default_rng(0)
    h = real(1.0 + 1e-6 * rng.standard_normal((64, 64)))
    mean, deviation = facial_color.local_statistics(h, 40.0)
    exact = float(np.std(np.asarray(h, np.float64)))
    expect_near(np.mean(mean), 1.0, relative=1e-6)
    return "deviation over the map's: " + expect_within(
        np.asarray(deviation)[20:44, 20:44] / exact, 0.8, 1.2
    )


def _constant(real: InputPrecision) -> str:
    _, deviation = facial_color.local_statistics(real(np.full((16, 16), 0.1)), 5.0)
    return expect_within(deviation, 0.0, 1e-7, label="deviation")


def _flat_neutral(real: InputPrecision) -> str:
    neutral = real(np.full((64, 64), 0.05))
    smile = real(0.05 + 0.01 * np.random.default_rng(1).random((64, 64)))
    rig = HemoglobinRig.from_maps(neutral, {"smile": smile}, radius_px=8.0)
    found = rig.evaluate({"neutral": 0.0, "smile": 1.0})
    expect_finite(found.hemoglobin, found.valid, label="hemoglobin")
    return expect_within(found.hemoglobin, 0.0, 0.32, label="hemoglobin")


def _weights_do_not_sum(real: InputPrecision) -> str:
    h = real(0.05 + 0.01 * np.random.default_rng(1).random((32, 32)))
    rig = HemoglobinRig.from_maps(h, {"smile": 1.2 * h}, radius_px=4.0)
    return expect_error(
        lambda: rig.blend({"neutral": 0.5, "smile": 0.9}), FacialColorError, "neutral"
    )


def _disc_beyond_map(real: InputPrecision) -> str:
    h = real(np.random.default_rng(2).random((8, 8)))
    mean, deviation = facial_color.local_statistics(h, 1000.0)
    expect_near(mean, np.full((8, 8), np.mean(h, dtype=np.float64)), relative=1e-5)
    return expect_near(deviation, np.full((8, 8), np.std(h, dtype=np.float64)), relative=1e-4)


def _horizon_normals(real: InputPrecision) -> str:
    normals = real([[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    report = wrinkles.encode_with_report(normals)
    expect_near(report.valid, [[False, True, False]])
    found = wrinkles.encode(normals)
    expect_near(np.isfinite(found).all(axis=-1), report.valid)
    return "masked or NaN; " + expect_within(
        found[report.valid], 0.0, 0.0, label="derivatives elsewhere"
    )


def _wrinkle_sum(real: InputPrecision) -> str:
    outward = np.array([0.0, 0.0, 1.0])
    base = wrinkles.encode(real(np.zeros((4, 4, 3)) + outward))
    tilted = np.array([0.6, 0.0, 0.8])
    wrinkle = wrinkles.encode(real(np.zeros((4, 4, 3)) + tilted))
    masks = real(np.ones((8, 4, 4)))
    weights = real(np.full(8, 1e6))
    unit = wrinkles.combine(base, wrinkle, masks, weights)
    expect_near(np.linalg.norm(unit, axis=-1), np.ones((4, 4)), absolute=1e-5)
    anger = wrinkles.combine(base, wrinkle, masks, -weights, clamp="unit")
    expect_near(anger, np.zeros((4, 4, 3)) + outward, absolute=1e-6)
    return expect_within(unit[..., 2], 0.0, 1.0, label="n_z")


def _strained(
    real: InputPrecision, factors: tuple[float, float, float]
) -> microstructure.MeshStrain:
    flat, moved, uv = (real(part) for part in stretched_sheet(factors))
    return microstructure.strain(flat, moved, sheet_faces(9), uv)


def _stretch_ends(real: InputPrecision) -> str:
    twice = _strained(real, (2.0, 1.0, 1.0))
    half = _strained(real, (0.5, 1.0, 1.0))
    expect_near(twice.r_s, np.full(81, 2.0), relative=1e-5)
    expect_near(half.r_t, np.full(81, 0.5), relative=1e-5)
    return f"r_s {twice.r_s.mean():.5f}, r_t {half.r_t.mean():.5f}"


def _collapsed(real: InputPrecision) -> str:
    found = _strained(real, (0.0, 1.0, 1.0))
    expect_finite(found.r_t, found.valid, label="r_t")
    return expect_within(found.r_t, 0.0, 1.0, label="r_t")


def _turned_over(real: InputPrecision) -> str:
    found = _strained(real, (-1.0, 1.0, 1.0))
    return expect_near(found.r_s, np.ones(81), relative=1e-5)


def _no_area(real: InputPrecision) -> str:
    points = real([[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    uv = real([[0, 0], [1, 0], [0, 1]])
    found = microstructure.strain(points, points, np.array([[0, 1, 2]]), uv)
    expect_finite(found.r_s, np.ones(3, bool), label="r_s")
    return expect_valid_fraction(found.valid)


def _sharpened_again(real: InputPrecision) -> str:
    height = real(np.random.default_rng(4).standard_normal((48, 48)))
    axes = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    start = float(np.max(np.abs(height)))
    for _ in range(4):
        height = microstructure.convolve(height, *axes, -2.0, 2.0, -2.0, 2.0)
    # alpha = -2 has gain 1 - alpha (1 - G) <= 1 + 2 per axis, so 9 per pass; four passes give 9^4 =
    # 81^2 as the bound
    return "peak over the first: " + expect_within(np.max(np.abs(height)) / start, 0.5, 81.0**2)


def _vanishing_kernel(real: InputPrecision) -> str:
    height = real(np.random.default_rng(4).standard_normal((32, 32)))
    axes = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    same = microstructure.convolve(height, *axes, 1.0, 0.0, -2.0, 1e-9)
    return expect_near(same, np.asarray(height), absolute=1e-5)


def _table_ends(real: InputPrecision) -> str:
    alpha, sigma = microstructure.kernel_parameters(real([0.01, 0.5, 1.0, 2.0, 50.0]))
    expect_within(alpha, -2.0, 1.0, label="alpha")
    expect_error(lambda: microstructure.kernel_parameters(real(0.0)), ValueError, "stretch")
    return "0 rejected; " + expect_within(sigma, 1.0, 60.0, label="sigma")
