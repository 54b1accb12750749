"""Maps grown from patches: slopes, seams, sites, scales, holes, and the same bytes."""

import itertools

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from model.displacement_synthesis import cut_kernels
from model.displacement_synthesis import growth as synthesis
from model.displacement_synthesis.layout import CellGrid
from model.displacement_synthesis.sources import fill_holes, level_patch
from reconstruction import normal_histogram
from rigsim.skin_patch.microrelief import make_micro_skin

PIXEL_UM = 20.0
SIDE = 640


def measured(site, seed, size_mm=4.8):
    skin = make_micro_skin(site, seed=seed, size_mm=size_mm, texel_um=PIXEL_UM)
    return level_patch(skin.height_um, pixel_um=PIXEL_UM)


@pytest.fixture(scope="module")
def foreheads():
    return [measured("forehead", seed) for seed in range(3)]


@pytest.fixture(scope="module")
def cheeks():
    return [measured("cheek", seed) for seed in range(2)]


def knobs(**changes):
    return {"pixel_um": PIXEL_UM, "patch_pixel_um": PIXEL_UM, **changes}


def share(height):
    return normal_histogram.histogram(height, pixel=PIXEL_UM)


def curvature(height):
    return 4 * height - sum(np.roll(height, s, a) for s in (-1, 1) for a in (0, 1))


def test_slopes_keep_the_distribution_of_the_patches(foreheads):
    """Expected: nearer to the patches together than the farthest of them is on its own."""
    pooled = np.mean([share(patch) for patch in foreheads], axis=0)
    grown = synthesis.grow(foreheads, SIDE, rng=np.random.default_rng(1), **knobs())
    apart = max(normal_histogram.distance(share(patch), pooled) for patch in foreheads)
    assert normal_histogram.distance(share(grown), pooled) < apart
    assert abs(grown.std() / np.std(foreheads) - 1.0) < 0.05
    # what blending does without care for variance: the test can fail
    half = 0.5 * (grown + grown[::-1, ::-1])
    assert normal_histogram.distance(share(half), pooled) > 5.0 * apart


def at_and_off_cuts(patches, **changes):
    layout = synthesis.build_layout(patches, SIDE, rng=np.random.default_rng(2), **knobs(**changes))
    whole = (0, SIDE), (0, SIDE)
    height = layout.draw(*whole)
    cuts = layout.cut_mask(*whole)
    cuts[[0, -1]] = cuts[:, [0, -1]] = False  # the map ends there
    down, right = np.gradient(height.astype(np.float64))
    slope, bend = right**2 + down**2, curvature(height) ** 2
    return [np.sqrt(of[cuts].mean() / of[~cuts].mean()) for of in (slope, bend)]


def test_cuts_are_not_rougher_than_skin(foreheads):
    """Expected: at most the slopes and bends of elsewhere; 10 % for the finite length of cuts."""
    slope, bend = at_and_off_cuts(foreheads)
    assert slope < 1.1
    assert bend < 1.1


def test_steps_remaining_at_cuts_are_detectable(foreheads):
    _, closed = at_and_off_cuts(foreheads)
    _, left = at_and_off_cuts(foreheads, range_px=0.5)
    assert left > 1.25 * closed


def test_more_candidates_make_cheaper_cuts(foreheads):
    """By the bends at cuts when steps are left there."""
    few, many = (at_and_off_cuts(foreheads, range_px=0.5, candidates=n)[1] for n in (1, 64))
    assert many < few


def test_threads_and_parts_do_not_change_a_byte(foreheads, monkeypatch):
    """Three by three tiles, and a part across two of them."""
    monkeypatch.setattr("model.displacement_synthesis.layout.TILE_PX", 256)
    size, part = (560, 650), ((490, 530), (450, 600))
    maps = [
        synthesis.grow(foreheads, size, rng=np.random.default_rng(3), threads=n, **knobs())
        for n in (1, 3)
    ]
    same, other = (
        synthesis.build_layout(foreheads, size, rng=np.random.default_rng(k), **knobs()).draw(*part)
        for k in (3, 4)
    )
    assert maps[0].tobytes() == maps[1].tobytes()
    assert same.tobytes() == maps[0][490:530, 450:600].tobytes()
    assert (other != same).mean() > 0.9


def test_tiles_meet_within_a_thousandth_of_a_step(foreheads, monkeypatch):
    rng = np.random.default_rng
    whole = synthesis.grow(foreheads, SIDE, rng=rng(5), **knobs())
    monkeypatch.setattr("model.displacement_synthesis.layout.TILE_PX", 256)
    parts = synthesis.grow(foreheads, SIDE, rng=rng(5), **knobs())
    assert np.abs(whole - parts).max() < 1e-3 * np.std(foreheads)


@pytest.mark.parametrize(("wrap", "axes"), [("u", (1,)), ("both", (0, 1))])
def test_a_map_goes_on_at_its_other_side(foreheads, wrap, axes):
    grown = synthesis.grow(foreheads, SIDE, rng=np.random.default_rng(6), **knobs(wrap=wrap))
    plain = synthesis.grow(foreheads, SIDE, rng=np.random.default_rng(6), **knobs())
    for axis in axes:
        steps, broken = (
            np.sqrt(np.mean((each.take(0, axis) - each.take(-1, axis)) ** 2))
            for each in (grown, plain)
        )
        usual = np.sqrt(np.mean(np.diff(grown, axis=axis) ** 2))
        assert steps < 1.3 * usual
        assert broken > 3.0 * usual


def test_sites_keep_roughness_and_meet_without_edge(foreheads, cheeks):
    patches = {"forehead": foreheads, "cheek": cheeks}
    labels = np.zeros((10, 10), np.int64)
    labels[:, 5:] = 1
    grown = synthesis.grow(
        patches, SIDE, rng=np.random.default_rng(7), regions=labels, **knobs(transition_px=64)
    )
    for name, part in (("forehead", grown[:, :200]), ("cheek", grown[:, -200:])):
        assert abs(part.std() / np.std(patches[name]) - 1.0) < 0.1
    between = grown[:, 300:340].std()
    ends = sorted(np.std(p) for p in patches.values())
    assert 0.9 * ends[0] < between < 1.1 * ends[1]
    bend = np.sqrt((curvature(grown)[1:-1] ** 2).mean(axis=0))
    assert bend[310:330].max() < 1.25 * bend[50:-50].max()


def test_single_site_weights_give_that_site(foreheads, cheeks):
    only = np.zeros((2, 3, 3))
    only[1] = 0.3
    both = synthesis.grow(
        {"forehead": foreheads, "cheek": cheeks},
        300,
        rng=np.random.default_rng(8),
        regions=only,
        **knobs(),
    )
    assert abs(both.std() / np.std(cheeks) - 1.0) < 0.1


def test_unlabeled_cells_take_nearest_site(foreheads, cheeks):
    patches = {"forehead": foreheads, "cheek": cheeks}
    sparse, full = np.full((8, 8), -1), np.zeros((8, 8), int)
    sparse[4, 1], sparse[4, 6] = 0, 1
    full[:, 4:] = 1
    maps = [
        synthesis.grow(patches, 300, rng=np.random.default_rng(9), regions=r, **knobs())
        for r in (sparse, full)
    ]
    np.testing.assert_array_equal(*maps)


def test_features_keep_skin_size_where_pixels_vary(foreheads):
    """Rationale: slopes on the skin do not depend on the map's pixels. Tolerance 10 %: coarser
    pixels leave out some fine slope, and scales are met to 2 %."""
    pixel_um = np.repeat(np.repeat([[20.0, 30.0]], 4, axis=0), 4, axis=1)
    grown = synthesis.grow(
        foreheads, SIDE, rng=np.random.default_rng(10), pixel_um=pixel_um, patch_pixel_um=PIXEL_UM
    )
    smooth = [gaussian_filter(p, 2.0) for p in foreheads]
    truth = np.sqrt(np.mean([np.gradient(p, PIXEL_UM)[0] ** 2 for p in smooth]))
    for part, pixel in ((grown[:, :260], 20.0), (grown[:, -260:], 30.0)):
        soft = gaussian_filter(part, 2.0 * 20.0 / pixel)
        assert abs(np.sqrt((np.gradient(soft, pixel)[0] ** 2).mean()) / truth - 1.0) < 0.1
    unscaled = synthesis.grow(foreheads, SIDE, rng=np.random.default_rng(10), **knobs())
    soft = gaussian_filter(unscaled, 2.0 * 20.0 / 30.0)
    assert abs(np.sqrt((np.gradient(soft, 30.0)[0] ** 2).mean()) / truth - 1.0) > 0.15


def test_windows_keep_off_holes_when_they_can(foreheads):
    holed = foreheads[0].copy()
    holed[100:140, :30] = np.nan
    layout = synthesis.build_layout([holed], 300, rng=np.random.default_rng(11), **knobs())
    assert layout.filled_fraction == 0.0
    assert np.isfinite(layout.draw((0, 300), (0, 300))).all()


def test_pixels_that_were_filled_are_counted(foreheads):
    holed = foreheads[0].copy()
    holed[::16, ::16] = np.nan
    layout = synthesis.build_layout([holed], 300, rng=np.random.default_rng(12), **knobs())
    assert abs(layout.filled_fraction / (1 / 256) - 1.0) < 0.1
    assert np.isfinite(layout.draw((0, 300), (0, 300))).all()


def test_a_hole_is_bridged_between_its_borders():
    plane = np.add.outer(np.arange(40.0), np.zeros(40))
    known = np.ones((40, 40), bool)
    known[15:25, 15:25] = False
    bridged = fill_holes(plane, known)
    np.testing.assert_array_equal(bridged[known], plane[known])
    assert np.abs(bridged - plane).max() < 5.0


def test_leveling_halves_cutoff_wave_and_keeps_short_waves():
    x = np.arange(600) * 10.0
    for wave_um, kept in ((1000.0, 0.5), (100.0, 1.0), (8000.0, 0.01)):
        wave = np.tile(np.sin(2 * np.pi * x / wave_um), (600, 1))
        part = level_patch(wave, pixel_um=10.0)[200:400, 100:500]
        gain = (part * wave[200:400, 100:500]).sum() / (wave[200:400, 100:500] ** 2).sum()
        assert abs(gain - kept) < 0.05


def brute_force(misfit, first, last):
    length, overlap = misfit.shape
    best = np.inf
    for path in itertools.product(range(1, overlap - 1), repeat=length):
        steps = np.abs(np.diff(path))
        if (steps > 1).any() or (first >= 0 and path[0] != first):
            continue
        if last >= 0 and abs(path[-1] - last) > 1:
            continue
        best = min(best, misfit[np.arange(length), path].sum())
    return best


@pytest.mark.parametrize(("first", "last"), [(-1, -1), (1, 4), (3, -1)])
def test_a_cut_is_the_cheapest_of_all(rng, first, last):
    misfit = rng.random((5, 6)).astype(np.float32)
    path = np.zeros(5, np.int16)
    cost = cut_kernels._cheapest_path(misfit, first, last, path)
    assert cost == pytest.approx(brute_force(misfit, first, last), rel=1e-6)
    assert misfit[np.arange(5), path].sum() == pytest.approx(cost, rel=1e-6)
    assert (np.abs(np.diff(path)) <= 1).all()


def test_choice_cost_is_that_of_its_cut(rng):
    heights = rng.standard_normal(2 * 30 * 12).astype(np.float32)
    a, b = heights.reshape(2, 30, 12).astype(np.float64)
    d = a - b
    misfit = np.full((29, 12), 1e9, np.float32)
    misfit[:, :-1] = (
        0.1 * d[:-1, :-1] ** 2 + np.diff(d, axis=1)[:-1] ** 2 + np.diff(d, axis=0)[:, :-1] ** 2
    )
    path = np.zeros(29, np.int16)
    cost = cut_kernels._cheapest_path(misfit, -1, -1, path)
    nowhere = np.zeros(1, np.int64)
    grid = CellGrid(nowhere, nowhere, 12, 30, (False, False))
    found = cut_kernels.cut_cost(heights, 0, 12, 360, 12, grid, np.float32(0.1), np.inf)
    assert found == pytest.approx(cost, rel=1e-5)
    assert cut_kernels.cut_cost(heights, 0, 12, 360, 12, grid, np.float32(0.1), 1.0) == 1.0


def test_windows_are_as_rough_as_their_source_patches(foreheads):
    """Choosing what cuts cheaply could prefer flat skin. Tolerance 5 %: 60 windows of 3 patches."""
    grown = synthesis.grow(foreheads, SIDE, rng=np.random.default_rng(13), **knobs(candidates=64))
    slope = np.sqrt(np.mean(np.gradient(grown)[0] ** 2))
    assert abs(slope / np.sqrt(np.mean([np.gradient(p)[0] ** 2 for p in foreheads])) - 1) < 0.05


def test_map_is_written_to_requested_array(foreheads, tmp_path):
    out = np.lib.format.open_memmap(
        tmp_path / "map.npy", mode="w+", dtype=np.float32, shape=(300, 200)
    )
    heard = []
    synthesis.grow(
        foreheads,
        (300, 200),
        rng=np.random.default_rng(14),
        out=out,
        progress=lambda *n: heard.append(n),
        **knobs(),
    )
    assert np.load(tmp_path / "map.npy", mmap_mode="r").std() > 1.0
    assert heard == [(1, 1)]


PATCH = np.random.default_rng(0).standard_normal((64, 64))


@pytest.mark.parametrize(
    ("patches", "size", "changes", "message"),
    [
        ([], 64, {}, "no patch"),
        ({}, 64, {}, "no site"),
        ([PATCH], 0, {}, "size_px: got 0"),
        ([PATCH], (4, 4, 4), {}, "size_px"),
        ([PATCH[0]], 64, {}, "expected \\(H, W\\)"),
        ([PATCH * np.nan], 64, {}, "no valid height"),
        ([np.where(PATCH > 1.0, PATCH, np.nan)], 64, {}, "got holes of 8. %"),
        ([PATCH], 64, {"cells_px": (8, 9)}, "overlap of 9"),
        ([PATCH], 400, {"cells_px": (80, 26)}, "at most 64 px"),
        ([PATCH], 64, {"pixel_um": -1.0}, "pixel_um"),
        ([PATCH], 64, {"pixel_um": np.ones(3)}, "pixel_um"),
        ([PATCH], 64, {"patch_pixel_um": 0.0}, "patch_pixel_um"),
        ([PATCH], 64, {"candidates": 0}, "candidates"),
        ([PATCH], 64, {"threads": 0}, "threads"),
        ([PATCH], 64, {"range_px": 0.0}, "range_px"),
        ([PATCH], 64, {"transition_px": 0.0}, "transition_px"),
        ([PATCH], 64, {"wrap": "v"}, "wrap"),
        ([PATCH], 64, {"wrap": "u", "cells_px": (40, 12)}, "two cells"),
        ([PATCH], 64, {"out": np.empty((64, 64))}, "out: got"),
        ({"a": [PATCH], "b": [PATCH]}, 64, {}, "where each of 2 sites"),
        ({"a": [PATCH]}, 64, {"regions": np.ones((3, 3), int)}, "regions: got"),
        ({"a": [PATCH]}, 64, {"regions": np.ones((2, 3, 3))}, "weights \\(1, h, w\\)"),
        ({"a": [PATCH]}, 64, {"regions": -np.ones((1, 3, 3))}, "regions: got -1"),
        ({"a": [PATCH]}, 64, {"regions": np.full((3, 3), -1)}, "got no site"),
    ],
)
def test_impossible_growth_is_refused_by_name(patches, size, changes, message):
    with pytest.raises(synthesis.SynthesisError, match=message):
        synthesis.grow(patches, size, rng=np.random.default_rng(0), **changes)


def test_flat_skin_stays_flat_in_any_unit():
    flat = synthesis.grow([np.full((100, 100), 5.0)], 200, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(flat, 5.0)
    maps = [
        synthesis.grow([scale * PATCH], 200, rng=np.random.default_rng(0)) / scale
        for scale in (1.0, 2.0**20, 2.0**-20)
    ]
    np.testing.assert_allclose(maps[1], maps[0], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(maps[2], maps[0], rtol=1e-5, atol=1e-5)


def test_map_may_be_line_or_below_cell_size():
    for size in (1, (1, 300), (300, 7)):
        found = synthesis.grow([PATCH], size, rng=np.random.default_rng(0))
        assert np.isfinite(found).all()


def test_a_part_outside_the_map_is_refused(foreheads):
    layout = synthesis.build_layout(foreheads, 200, rng=np.random.default_rng(0), **knobs())
    with pytest.raises(synthesis.SynthesisError, match=r"rows: got 100...201"):
        layout.draw((100, 201), (0, 10))


def test_patches_are_not_modified(foreheads):
    before = [patch.copy() for patch in foreheads]
    synthesis.grow(foreheads, 200, rng=np.random.default_rng(0), **knobs())
    np.testing.assert_array_equal(before, foreheads)
