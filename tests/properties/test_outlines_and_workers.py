"""Outlines, curls and sums of images under patterns, and workers for tiles."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from reconstruction import tiles
from reconstruction.stack_diagnosis import axis_faults, pattern_faults, reduced_stack

SIDE = 48
ROWS, COLUMNS = np.mgrid[:SIDE, :SIDE].astype(float)


def disc(row, column, radius):
    return np.hypot(ROWS - row, COLUMNS - column) < radius


@given(st.floats(20.0, 27.0), st.floats(20.0, 27.0), st.floats(9.0, 15.0))
def test_outline_of_disc_leads_out_of_it(row, column, radius):
    found = axis_faults.find_outline(disc(row, column, radius))
    assert found is not None
    near, out = found
    away = np.stack([COLUMNS - column, row - ROWS], axis=-1)[near]  # y is up
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    assert (np.sum(away * out[near], axis=-1) > 0.9).mean() > 0.9
    assert axis_faults.list_ways(("x", "y", "z"), disc(row, column, radius)) == [("x", "y", "z")]


@given(st.floats(0.2, 3.0), st.floats(-2.0, 2.0), st.floats(0.0, 6.0))
def test_surface_has_no_curl_and_turned_normals_have(height, slope, phase):
    z = height * np.sin(0.3 * COLUMNS + phase) * np.cos(0.2 * ROWS) + slope * COLUMNS * 0.1
    p, q = np.gradient(z, axis=1), -np.gradient(z, axis=0)  # y is up
    normals = np.stack([-p, -q, np.ones_like(z)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    every = np.ones((SIDE, SIDE), bool)
    surface = axis_faults.median_curl(normals, every)
    exchanged = axis_faults.median_curl(normals[..., [1, 0, 2]], every)
    assert surface < 0.35 * exchanged


@given(st.floats(0.0, 5.0), st.floats(20.0, 27.0), st.floats(6.0, 15.0))
def test_blur_inside_keeps_even_light(level, row, radius):
    inside = disc(row, 24.0, radius)
    image = np.where(inside, level, 1e3)
    blurred = reduced_stack.smooth_inside(image, inside)
    np.testing.assert_allclose(blurred[inside], level, rtol=1e-6, atol=1e-9)


@given(st.floats(0.1, 2.0), st.floats(1.05, 3.0))
def test_sums_of_inverse_patterns_equal_full_light(light, factor):
    shape = np.stack([0.5 + 0.4 * np.sin(k + 0.2 * (ROWS + k * COLUMNS)) for k in range(3)])
    images = {"full": np.full((SIDE, SIDE), light)}
    for axis, share in zip("xyz", shape, strict=True):
        images |= {axis: light * share, f"-{axis}": light * (1.0 - share)}
    inside = disc(24.0, 24.0, 18.0)
    right = pattern_faults.measure_sum_misfit(images, inside, patterns=("x", "y", "z"))
    wrong = images | {"x": factor * images["x"]}
    assert right < 1e-6
    assert pattern_faults.measure_sum_misfit(wrong, inside, patterns=("x",)) > 0.01


@given(st.integers(1, 6), st.lists(st.integers(-99, 99), max_size=20))
def test_any_number_of_workers_gives_results_in_order(workers, values):
    with tiles.open_worker_pool(workers) as (executor, count):
        assert 1 <= count <= workers
        found = tiles.map_tiles(lambda v: v * v, values, executor=executor, window=count)
        assert list(found) == [v * v for v in values]
