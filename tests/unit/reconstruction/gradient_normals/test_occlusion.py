"""Normals corrected for the lights that a relief hides from its own grooves."""

import math

import numpy as np
import pytest

from model.fresnel import ETA_SKIN
from reconstruction.gradient_normals import GradientError, SphereLights
from reconstruction.gradient_normals.lobe_response import direction_from_moments, specular_sums
from reconstruction.gradient_normals.occlusion import (
    HORIZON_DIRECTIONS,
    HORIZON_REACH_UM,
    HORIZON_SOFTNESS_RAD,
    HORIZON_STEP_RATIO,
    SOLVER_STEPS,
    SOLVER_TOLERANCE,
    _convert_to_elevations,
    _horizon_samples,
    correct_occlusion,
)
from reconstruction.gradient_normals.sphere_lights import (
    disc_from_normal,
    normal_from_disc,
    view_frame,
)

PIXEL_UM = 6.0
ALPHA = 0.25


def even_sphere(count=200):
    """Return directions of an even sphere of lights (a Fibonacci spiral)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = math.pi * (1.0 + math.sqrt(5.0)) * np.arange(count)
    across = np.sqrt(1.0 - z**2)
    return SphereLights(np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1))


def grooves(depth_um, side=96, period_px=24):
    """Return grooves that run along the rows' axis, sinusoidal along x."""
    wave = 0.5 * depth_um * np.cos(2.0 * np.pi * np.arange(side) / period_px)
    return np.tile(wave, (side, 1))


def normals_of(relief):
    down, right = (
        np.gradient(relief, PIXEL_UM, axis=axis) if relief.shape[axis] > 1 else 0.0 * relief
        for axis in (0, 1)
    )
    normals = np.stack([-right, down, np.ones_like(relief)], axis=-1)
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def correct(relief, normals=None, valid=None, **settings):
    valid = np.ones(relief.shape, bool) if valid is None else valid
    normals = normals_of(relief) if normals is None else normals
    usual = {"pixel_um": PIXEL_UM, "lights": even_sphere(), "alpha": ALPHA}
    return correct_occlusion(normals, relief, valid, **(usual | settings))


def plain_place(relief, row, column, lights, each, pixel_um=PIXEL_UM):
    """Return one pixel's place in plain Python: horizons by sampling, then all lights."""
    side_y, side_x = relief.shape

    def height(y, x):
        y, x = min(max(y, 0.0), side_y - 1.0), min(max(x, 0.0), side_x - 1.0)
        i, j = int(y), int(x)
        below, right = min(i + 1, side_y - 1), min(j + 1, side_x - 1)
        v, u = y - i, x - j
        upper = (1 - u) * relief[i, j] + u * relief[i, right]
        lower = (1 - u) * relief[below, j] + u * relief[below, right]
        return (1 - v) * upper + v * lower

    count = math.ceil(math.log(HORIZON_REACH_UM / pixel_um, HORIZON_STEP_RATIO))
    steps = sorted({round(HORIZON_STEP_RATIO**k) for k in range(count + 1)})
    horizon = np.zeros(HORIZON_DIRECTIONS)
    for k in range(HORIZON_DIRECTIONS):
        turn = 2 * math.pi * k / HORIZON_DIRECTIONS
        for step in steps:
            there = height(row - step * math.sin(turn), column + step * math.cos(turn))
            tangent = (there - relief[row, column]) / (step * pixel_um)
            horizon[k] = max(horizon[k], math.atan(tangent))
    ways = lights.directions
    elevation = np.arctan2(ways[:, 2], np.hypot(ways[:, 0], ways[:, 1]))
    turn = np.arctan2(ways[:, 1], ways[:, 0]) % (2 * math.pi)
    circle = np.append(horizon, horizon[0])
    angles = 2 * math.pi * np.arange(HORIZON_DIRECTIONS + 1) / HORIZON_DIRECTIONS
    free = 0.5 + 0.5 * (elevation - np.interp(turn, angles, circle)) / HORIZON_SOFTNESS_RAD

    def observed(place, visible):
        parts = each(normal_from_disc(place[None]), np.zeros(3)) * visible
        return direction_from_moments(parts @ ways, True)[0][0]

    first = disc_from_normal(normals_of(relief)[row, column])
    place = first
    if not horizon.any():  # as on a plane, no light is hidden
        return first
    for _ in range(SOLVER_STEPS):
        step = observed(first, 1.0) - observed(place, np.clip(free, 0.0, 1.0))
        place = place + step
        if np.linalg.norm(step) < SOLVER_TOLERANCE:
            break
    return place


def test_correction_equals_a_plain_sum_over_lights():
    rng = np.random.default_rng(3)
    relief = 1.5 * rng.standard_normal((9, 11)).cumsum(axis=1)
    found = disc_from_normal(correct(relief))
    lights = even_sphere()
    each = specular_sums(lights, view_frame((0.0, 0.0, 1.0)), ALPHA, ETA_SKIN)
    for row, column in ((0, 0), (4, 5), (8, 10), (3, 1)):
        expected = plain_place(relief, row, column, lights, each)
        assert found[row, column] == pytest.approx(expected, abs=1e-9), (row, column)
    assert np.abs(found - disc_from_normal(normals_of(relief))).max() > 0.01


@pytest.mark.parametrize("width", [1, 5, 300, 513])
def test_rows_of_any_width_equal_plain_sums(width):
    """Rows are computed in blocks of 256 pixels: each block's ends, and a rest of one pixel."""
    rng = np.random.default_rng(width)
    relief = rng.standard_normal(width).cumsum() + 0.5 * rng.standard_normal((2, width))
    found = disc_from_normal(correct(relief))
    lights = even_sphere()
    each = specular_sums(lights, view_frame((0.0, 0.0, 1.0)), ALPHA, ETA_SKIN)
    columns = {0, width // 2, width - 1} | {c for c in (255, 256, 511) if c < width}
    for row, column in [(row, column) for column in sorted(columns) for row in (0, 1)]:
        expected = plain_place(relief, row, column, lights, each)
        assert found[row, column] == pytest.approx(expected, abs=1e-9), (row, column)
    smallest = 1e-5 if width == 1 else 1e-3  # two pixels hide little of each other
    assert np.abs(found - disc_from_normal(normals_of(relief))).max() > smallest


@pytest.mark.parametrize("pixel_um", [0.01, 1.0])
def test_small_pixels_need_margin_of_relief(pixel_um):
    """Beyond the relief its edge is repeated: a wider margin would have nothing new."""
    rng = np.random.default_rng(8)
    relief = 0.3 * pixel_um * rng.standard_normal((7, 12)).cumsum(axis=1)
    assert _horizon_samples(pixel_um, relief.shape)[2] == 13
    normals = normals_of(relief * PIXEL_UM / pixel_um)
    found = disc_from_normal(correct(relief, normals, pixel_um=pixel_um))
    lights = even_sphere()
    each = specular_sums(lights, view_frame((0.0, 0.0, 1.0)), ALPHA, ETA_SKIN)
    scaled = relief * PIXEL_UM / pixel_um  # `plain_place` takes the normals from this one
    for row, column in ((0, 0), (3, 6), (6, 11)):
        far = plain_place(scaled, row, column, lights, each, PIXEL_UM)
        assert found[row, column] == pytest.approx(far, abs=1e-9), (row, column)


def test_elevations_are_arc_tangents_up_to_vertical():
    tangent = np.concatenate([[0.0], np.geomspace(1e-6, 1e15, 2000)])
    found = tangent.copy()
    _convert_to_elevations.py_func(found)
    np.testing.assert_allclose(found, np.arctan(tangent), rtol=0.0, atol=4e-11)


def test_flat_relief_hides_nothing():
    flat = np.zeros((32, 32))
    tilted = normals_of(np.tile(0.2 * PIXEL_UM * np.arange(32.0), (32, 1)))
    assert correct(flat, tilted) == pytest.approx(tilted, abs=1e-15)


def test_deeper_grooves_are_corrected_more():
    change = []
    for depth in (10.0, 30.0, 60.0):
        relief = grooves(depth)
        change.append(np.var(correct(relief)[..., 0]) / np.var(normals_of(relief)[..., 0]))
        assert np.abs(correct(relief)[..., 1]).max() < 0.02  # lights are not quite symmetric
    assert (np.diff(change) > 0.0).all()
    assert change[0] > 1.0
    assert change[-1] > 1.05


def test_walls_are_made_steeper():
    relief = grooves(60.0)
    before, after = normals_of(relief)[48], correct(relief)[48]
    steep = np.abs(before[:, 0]) > 0.3
    assert steep.any()
    assert (np.abs(after[steep, 0]) > np.abs(before[steep, 0])).all()


def test_correction_turns_with_the_relief():
    """Relief and lights turned by half: each normal turns with them."""
    lights = even_sphere()
    turned_lights = SphereLights(lights.directions * [-1.0, -1.0, 1.0], analyzer=(0.0, 1.0, 0.0))
    rng = np.random.default_rng(4)
    relief = 2.0 * rng.standard_normal((12, 12)).cumsum(axis=1)
    found = correct(relief, lights=SphereLights(lights.directions, analyzer=(0.0, 1.0, 0.0)))
    turned = correct(relief[::-1, ::-1].copy(), lights=turned_lights)[::-1, ::-1]
    assert turned * [-1.0, -1.0, 1.0] == pytest.approx(found, abs=1e-9)


def test_hole_neither_shadows_nor_changes():
    relief = grooves(30.0)
    valid = np.ones(relief.shape, bool)
    valid[40:44, 40:44] = False
    holed = np.where(valid, relief, -1e6)
    normals = normals_of(relief)
    found = correct(holed, normals, valid)
    assert (found[~valid] == normals[~valid]).all()
    far = np.ones_like(valid)
    far[30:54, 30:54] = False
    assert found[far] == pytest.approx(correct(relief, normals)[far], abs=2e-3)


def test_pixel_without_light_keeps_its_normal():
    pit = np.full((9, 9), 1e4)
    pit[4, 4] = 0.0
    tilted = np.broadcast_to([0.1, 0.0, math.sqrt(0.99)], (9, 9, 3))
    lights = even_sphere()
    low = SphereLights(lights.directions[np.abs(lights.directions[:, 2]) < 0.7])
    assert correct(pit, tilted, lights=low)[4, 4] == pytest.approx(tilted[4, 4], abs=1e-12)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("valid", {"valid": np.zeros((96, 96), bool)}),
        ("pixel_um", {"pixel_um": 0.0}),
        ("alpha", {"alpha": 0.0}),
        ("height", {"relief": np.full((96, 96), np.nan)}),
        ("normals", {"normals": np.zeros((96, 96, 2))}),
    ],
)
def test_bad_input_is_named(name, settings):
    given = {"relief": grooves(10.0), "normals": normals_of(grooves(10.0))} | settings
    with pytest.raises(GradientError, match=name):
        correct(**given)
