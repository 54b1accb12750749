"""Extremes of surfaces: normals, heights, histograms, albedo, textures, wrapped scans."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.metrics import angular_error_rad
from reconstruction import diffuse_albedo, kernel_fit, normal_histogram, normal_integration
from reconstruction import photometric_stereo as stereo
from reconstruction.scan.face_template import load_default_template
from reconstruction.scan.repair import ScanMeshError, TriangleMesh
from reconstruction.scan.template_wrapping import wrap_template
from reconstruction.surface import texture_fill
from skinrig.arrays import Float64Array, FloatArray
from skinrig.benchmarks.dome.template import simulate_scan
from skinrig.extremes.expectations import (
    ExpectationError,
    expect_error,
    expect_finite,
    expect_near,
    expect_valid_fraction,
    expect_within,
)
from skinrig.extremes.inputs import InputPrecision, ring_directions

UP_NORMAL = np.array([0.0, 0.0, 1.0])


def _upward(side: int) -> Float64Array:
    return np.broadcast_to(UP_NORMAL, (side, side, 3)).copy()


def _degrees_off(normals: FloatArray, truth: FloatArray) -> float:
    return float(np.degrees(np.max(angular_error_rad(normals, truth))))


def _lit(lights: Float64Array, normal: Float64Array, real: InputPrecision) -> NDArray[Any]:
    return real(np.clip(lights @ normal, 0.0, None)[:, None, None])


def _expect_rejected_lights(lights: Float64Array, real: InputPrecision, *words: str) -> str:
    estimate = partial(stereo.estimate_normals, _lit(lights, UP_NORMAL, real), lights)
    return expect_error(estimate, stereo.PhotometricStereoError, *words)


def _coplanar(real: InputPrecision) -> str:
    lights = np.array([[np.sin(t), 0.0, np.cos(t)] for t in np.linspace(-0.6, 0.6, 9)])
    return _expect_rejected_lights(lights, real, "plane", "along (0.0, -1.0, 0.0);")


def _collinear(real: InputPrecision) -> str:
    lights = np.repeat(UP_NORMAL[None], 5, axis=0)
    return _expect_rejected_lights(lights, real, "line", "(0.0, -1.0, 0.0) and (-1.0, 0.0, 0.0)")


def _all_shadowed(real: InputPrecision) -> str:
    lights = ring_directions(8, 0.6)
    found = stereo.estimate_normals(real(np.zeros((8, 3, 3))), lights)
    expect_finite(found.normals, found.valid, label="normals")
    return expect_valid_fraction(found.valid)


def _two_lights_left(real: InputPrecision) -> str:
    lights = ring_directions(8, 0.6)
    visible = np.zeros((8, 1, 1), bool)
    visible[:2] = True
    found = stereo.estimate_normals(_lit(lights, UP_NORMAL, real), lights, valid=visible)
    return expect_valid_fraction(found.valid)


def _nearly_coplanar(real: InputPrecision) -> str:
    t, k = np.linspace(-0.6, 0.6, 9), np.arange(9)
    lights = np.stack([np.sin(t), 1e-3 * (-1.0) ** k, np.cos(t)], axis=-1)
    lights /= np.linalg.norm(lights, axis=-1, keepdims=True)
    rng = np.random.default_rng(2)
    noisy = _lit(lights, UP_NORMAL, real) + real(rng.normal(0, 1e-3, (9, 1, 1)))
    try:
        found = stereo.estimate_normals(noisy, lights, variance=real(np.full((9, 1, 1), 1e-6)))
    except stereo.PhotometricStereoError as error:
        return f"rejected: {error}"
    expect_finite(found.normals, found.valid, label="normals")
    if np.any(found.valid):
        off = _degrees_off(found.normals[found.valid], np.broadcast_to(UP_NORMAL, (1, 3)))
        stated = float(np.degrees(found.stderr_rad[found.valid].max()))
        if off > 4 * stated:
            raise ExpectationError(
                f"got an error of {off:.2g} degrees, expected at most 4 x {stated:.2g}"
            )
        return f"error {off:.2g} degrees, stated {stated:.2g}"
    return expect_valid_fraction(found.valid)


def _grazing(real: InputPrecision) -> str:
    lights = ring_directions(12, np.radians(89.9))
    every = np.vstack([lights, UP_NORMAL])
    found = stereo.estimate_normals(_lit(every, UP_NORMAL, real), every)
    expect_finite(found.normals, found.valid, label="normals")
    if not np.all(found.valid):
        return expect_valid_fraction(found.valid)
    off = _degrees_off(found.normals[0], np.broadcast_to(UP_NORMAL, (1, 3)))
    return expect_within(off, 0.0, 0.1, label="degrees")


def _near_light(real: InputPrecision) -> str:
    positions = 1.0 * ring_directions(8, 0.6)  # 1 mm from the skin
    distance = np.linalg.norm(positions, axis=-1)
    lit = np.clip(positions @ UP_NORMAL / distance, 0, None) / distance**2
    found = stereo.estimate_normals(
        real(lit[:, None, None]),
        positions / distance[:, None],
        light_positions_mm=positions,
        points_mm=np.zeros((1, 1, 3)),
    )
    expect_valid_fraction(found.valid, fraction_range=(1.0, 1.0))
    return expect_within(
        _degrees_off(found.normals[0], UP_NORMAL[None]), 0.0, 0.05, label="degrees"
    )


def _far_light(real: InputPrecision) -> str:
    positions = 1e7 * ring_directions(8, 0.6)
    lit = np.clip(ring_directions(8, 0.6) @ UP_NORMAL, 0, None) / 1e14
    found = stereo.estimate_normals(
        real(1e14 * lit[:, None, None]),
        ring_directions(8, 0.6),
        light_positions_mm=positions,
        points_mm=np.zeros((1, 1, 3)),
        light_intensity=np.full(8, 1e14),
    )
    expect_valid_fraction(found.valid, fraction_range=(1.0, 1.0))
    return expect_within(
        _degrees_off(found.normals[0], UP_NORMAL[None]), 0.0, 0.05, label="degrees"
    )


def _scales(real: InputPrecision) -> str:
    lights = ring_directions(8, 0.6)
    tilted = np.array([0.3, -0.2, np.sqrt(1 - 0.13)])
    off = []
    for scale in (1e-12, 1e12):
        found = stereo.estimate_normals(real(scale) * _lit(lights, tilted, real), lights)
        expect_valid_fraction(found.valid, fraction_range=(1.0, 1.0))
        off.append(_degrees_off(found.normals[0], tilted[None]))
    return expect_within(off, 0.0, 0.05, label="degrees")


def _cliff(real: InputPrecision) -> str:
    slope = np.zeros((24, 24))
    slope[:, 12] = 20.0  # a wall of arctan 20 = 87 degrees
    normals = np.stack([-slope, np.zeros_like(slope), np.ones_like(slope)], -1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    height = normal_integration.integrate(real(normals))
    step = float(height[:, 14:].mean() - height[:, :11].mean())
    expect_within(height, -40.0, 40.0, label="height")
    return "step of " + expect_within(abs(step), 10.0, 21.0, label="pixels")


def _horizontal_normals(real: InputPrecision) -> str:
    normals = _upward(8)
    normals[4, 4] = (1.0, 0.0, 0.0)
    try:
        height = normal_integration.integrate(real(normals))
    except normal_integration.IntegrationError as error:
        return f"rejected: {error}"
    return expect_within(height[np.isfinite(height)], -1e4, 1e4, label="height")


def _islands(real: InputPrecision) -> str:
    valid = np.zeros((16, 16), bool)
    valid[2:5, 2:5] = valid[10:14, 9:15] = valid[0, 15] = True
    height = normal_integration.integrate(real(_upward(16)), valid=valid)
    return expect_near(height[valid], np.zeros(int(valid.sum())), absolute=1e-4)


def _empty_mask(real: InputPrecision) -> str:
    normals, nowhere = real(_upward(4)), np.zeros((4, 4), bool)
    integrate = partial(normal_integration.integrate, normals, valid=nowhere)
    return expect_error(integrate, normal_integration.IntegrationError, "valid")


def _flat_height(real: InputPrecision) -> str:
    fractions = normal_histogram.histogram(real(np.zeros((64, 64))), pixel=10.0)
    expect_near(fractions.sum(), 1.0, absolute=1e-9)
    return expect_near(np.max(fractions[31:33, 31:33]), np.max(fractions), absolute=0.0)


def _steep_height(real: InputPrecision) -> str:
    rows = np.arange(64.0)[:, None] * np.ones((1, 64))
    fractions = normal_histogram.histogram(real(1e6 * rows), pixel=1.0)
    expect_near(fractions.sum(), 1.0, absolute=1e-9)
    edge = fractions[0].sum() + fractions[-1].sum()
    return expect_near(edge, 1.0, absolute=1e-6)


def _one_point(real: InputPrecision) -> str:
    return expect_error(
        lambda: normal_histogram.histogram(real(np.zeros((1, 1))), pixel=1.0), ValueError
    )


def _relief_without_relief(real: InputPrecision) -> str:
    flat = real(np.zeros((64, 64)))
    target = normal_histogram.histogram(flat, pixel=10.0)
    try:
        found = kernel_fit.fit_kernel(flat, target, stretch=1.1, axis="x", pixel_um=10.0)
    except ValueError as error:
        return f"rejected: {error}"
    return expect_valid_fraction(found.valid)


def _no_diffuse(real: InputPrecision) -> str:
    lights = np.vstack([ring_directions(20, 0.5), ring_directions(20, 0.9)])
    views = np.broadcast_to(UP_NORMAL, lights.shape)
    samples = np.zeros((1, 40, 3))
    found = diffuse_albedo.estimate(
        real(samples), lights[None], views[None], UP_NORMAL[None], eta=1.4
    )
    expect_finite(found.r_d, found.valid, label="R_d")
    if not np.any(found.valid):
        return expect_valid_fraction(found.valid)
    return expect_within(found.r_d[found.valid], -1e-6, 1e-6, label="R_d")


def _estimate_even(real: InputPrecision, samples: Float64Array) -> diffuse_albedo.DiffuseAlbedo:
    """Return the albedo from samples of one gray point without an index step."""
    lights = ring_directions(samples.shape[0], 0.5)
    views = np.broadcast_to(UP_NORMAL, lights.shape)
    given = real(samples[None, :, None])
    return diffuse_albedo.estimate(given, lights[None], views[None], UP_NORMAL[None], eta=1.0)


def _white_surface(real: InputPrecision) -> str:
    return expect_near(_estimate_even(real, np.full(20, 1.0 / np.pi)).r_d, 1.0, absolute=1e-6)


def _nearly_black_surface(real: InputPrecision) -> str:
    samples = 1e-3 * (1.0 + 0.01 * np.random.default_rng(0).standard_normal(20)) / np.pi
    return expect_near(_estimate_even(real, samples).r_d, 1e-3, relative=0.01)


def _no_numbers_in_samples(real: InputPrecision) -> str:
    samples = np.full(20, 0.5 / np.pi)
    samples[::2], samples[1] = np.nan, np.inf
    return expect_near(_estimate_even(real, samples).r_d, 0.5, absolute=1e-6)


def _nothing_to_fill(real: InputPrecision) -> str:
    empty = texture_fill.push_pull(real(np.zeros((9, 7, 3))), np.zeros((9, 7)))
    one = np.zeros((9, 7))
    one[4, 3] = 1.0
    filled = texture_fill.push_pull(real(np.full((9, 7, 3), 0.4)), one)
    expect_finite(empty.values, np.ones((9, 7), bool), label="empty texture")
    return expect_near(filled.values, np.full((9, 7, 3), 0.4), relative=1e-5)


PERSON_SEED = 300
STIFFNESS_STEPS = 4
QUARTER_TURN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
"""By 90 degrees about the vertical axis."""


def _wrap_scan(
    real: InputPrecision,
    limits: tuple[float, float, float],
    *,
    triangles: int = 20_000,
    keep: Callable[[Float64Array], Float64Array] | None = None,
    rotation: Float64Array | None = None,
    shift_mm: float = 0.0,
) -> str:
    """Check RMS error of the valid vertices, mm, and the range of the valid fraction."""
    face = simulate_scan(PERSON_SEED, "neutral", triangles=triangles)
    scan, turn = face.scan, np.eye(3) if rotation is None else rotation
    if keep is not None:
        scan = scan.select_faces(keep(scan.vertices_mm[scan.faces].mean(axis=1)) > 0.0)
    moved = np.asarray(real(scan.vertices_mm @ turn.T + shift_mm), np.float64)
    found = wrap_template(
        load_default_template(), TriangleMesh(moved, scan.faces), steps=STIFFNESS_STEPS
    )
    gap = found.mesh.vertices_mm - (face.true_vertices_mm @ turn.T + shift_mm)
    expect_near(found.folded, 0)
    expect_valid_fraction(found.valid, fraction_range=limits[1:])
    rms = np.sqrt(np.mean(np.sum(gap[found.valid] ** 2, axis=1)))
    return expect_within(rms, 0.0, limits[0], label="RMS error, mm")


def _scan_half(real: InputPrecision) -> str:
    return _wrap_scan(real, (2.0, 0.3, 0.7), keep=lambda centers: centers[:, 0])


def _scan_coarse(real: InputPrecision) -> str:
    return expect_error(
        lambda: _wrap_scan(real, (2.0, 0.2, 1.0), triangles=500), ScanMeshError, "expected a face"
    )


def _scan_far_turned(real: InputPrecision) -> str:
    return _wrap_scan(real, (2.0, 0.8, 1.0), rotation=QUARTER_TURN, shift_mm=1e5)


def _scan_ball(real: InputPrecision) -> str:
    angle, height = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 61), np.linspace(-0.99, 0.99, 41))
    ring = np.sqrt(1.0 - height**2)
    points = 95.0 * np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=-1)
    at = np.arange(points.size // 3).reshape(points.shape[:2])
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]))
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])
    mesh = TriangleMesh(np.asarray(real(points.reshape(-1, 3)), np.float64), faces)
    return expect_error(
        lambda: wrap_template(load_default_template(), mesh), ScanMeshError, "expected a face"
    )


def _scan_empty(real: InputPrecision) -> str:
    nothing = TriangleMesh(np.asarray(real(np.zeros((0, 3))), np.float64), np.zeros((0, 3), int))
    return expect_error(
        lambda: wrap_template(load_default_template(), nothing), ScanMeshError, "triangle"
    )
