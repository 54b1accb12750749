"""Kernels of states whose relief was made from the neutral one by a known kernel and stretch."""

import math

import numpy as np
import pytest
from scipy import ndimage

from capture.plan.gradient import state_name
from model.skin import SkinMap
from reconstruction.normal_histogram.blocks import (
    BLOCKS_PER_SIDE,
    assign_blocks,
    block_grid_shape,
    count_block_normals,
)
from reconstruction.pipeline.gradient.images import SkinState
from reconstruction.pipeline.gradient.skin_strain import StateStrain, skin_mask
from reconstruction.pipeline.gradient.strain_kernels import (
    HIDDEN_VARIANCE_RATIO,
    UNRESOLVED_VARIANCE,
    _along_x,
    _skin_blocks,
    count_normals,
    fit_kernels,
    histogram_document,
    lost_variances,
)
from reconstruction.registration.strain import Strain

SIDE, PIXEL_UM = 240, 6.0


@pytest.fixture(scope="module")
def relief():
    rng = np.random.default_rng(3)
    big = sum(
        weight * ndimage.gaussian_filter(rng.standard_normal((2 * SIDE, 2 * SIDE)), sigma) * sigma
        for weight, sigma in ((1.0, 2.0), (2.0, 5.0))
    )
    return 9.0 * big / big.std()


def middle(whole):
    edge = SIDE // 2
    return whole[edge : edge + SIDE, edge : edge + SIDE]


def strained(relief, angle_deg, r, alpha, sigma_um):
    """Convolve along the jaws by SciPy, then stretch: height at x is that at x / r."""
    axis = 1 if angle_deg == 0 else 0
    blurred = ndimage.gaussian_filter1d(relief, sigma_um / PIXEL_UM, axis=axis, mode="reflect")
    made = (1 - alpha) * relief + alpha * blurred
    center = (np.array(relief.shape) - 1) / 2
    scale = np.array([1.0, 1 / r] if axis == 1 else [1 / r, 1.0])
    return ndimage.affine_transform(made, scale, center - scale * center, order=3)


def state(angle_deg, step, r):
    turn = math.radians(angle_deg)
    axis = np.array([math.cos(turn), math.sin(turn)])
    gradient = np.eye(2) + (r - 1) * np.outer(axis, axis)
    described = SkinState(state_name(angle_deg, step), angle_deg, step, 8 * r, 0.1)
    strain = Strain(gradient, np.zeros(2), 1e-8 * np.eye(6), 0.05, 100, True)
    return StateStrain(described, r, strain)


def as_map(height):
    stderr = np.full(height.shape, 0.1, np.float32)
    return SkinMap(height.astype(np.float32), "um", stderr, np.ones(height.shape, bool))


KNOWN = {
    (0.0, 1): (1.1, 0.6, 16.0),
    (0.0, -1): (0.9, -0.8, 16.0),
    (90.0, 1): (1.1, 0.6, 16.0),
    (90.0, -1): (0.9, -0.8, 16.0),
}


@pytest.fixture(scope="module")
def fitted(relief):
    strains = [state(0.0, 0, 1.0)]
    heights = {"a000_n0": as_map(middle(relief))}
    for (angle, step), (r, alpha, sigma) in KNOWN.items():
        strains.append(state(angle, step, r))
        heights[strains[-1].state.name] = as_map(middle(strained(relief, angle, r, alpha, sigma)))
    counted = count_normals(strains, heights, pixel_um=PIXEL_UM)
    fractions = []

    def compute_tiles(name, tiles, compute):
        for number, tile in enumerate(tiles):
            fractions.append(number / len(tiles))
            yield compute(tile)

    document = fit_kernels(
        strains, heights, counted, pixel_um=PIXEL_UM, compute_tiles=compute_tiles
    )
    return strains, counted, document, fractions


@pytest.mark.long
def test_known_kernels_are_recovered_at_both_angles(fitted):
    _, _, document, _ = fitted
    for fit in document["fits"]:
        step = 1 if "_p" in fit["name"] else -1
        _, alpha, sigma = KNOWN[(fit["angle_deg"], step)]
        low, high = fit["alpha_interval"]
        assert low <= alpha <= high
        low, high = fit["sigma_interval_um"]
        assert low <= sigma <= high
        assert fit["distance"] < 0.6 * fit["distance_before"]


@pytest.mark.long
def test_variances_change_more_along_the_jaws_than_across(fitted):
    strains, counted, _, _ = fitted
    rows = {row["name"]: row for row in histogram_document(strains, counted)["states"]}
    for angle in ("a000", "a090"):
        along = [rows[f"{angle}_{step}"]["variance_s"] for step in ("m1", "p1")]
        across = [rows[f"{angle}_{step}"]["variance_t"] for step in ("m1", "p1")]
        assert along[0] / along[1] > 1.5 * max(across[0] / across[1], 1.0)


@pytest.mark.long
def test_variance_errors_include_detail_hidden_in_images(fitted):
    """As a share of the variance beside the scatter over patches, which large patches outgrow."""
    strains, counted, _, _ = fitted
    for row in histogram_document(strains, counted)["states"]:
        one = counted[row["name"]]
        for axis, value, scatter in (
            ("s", one.variance_x, one.stderr_x),
            ("t", one.variance_y, one.stderr_y),
        ):
            assert row[f"variance_{axis}_stderr"] > HIDDEN_VARIANCE_RATIO * value
            assert row[f"variance_{axis}_stderr"] == pytest.approx(
                UNRESOLVED_VARIANCE * math.hypot(scatter, HIDDEN_VARIANCE_RATIO * value)
            )


@pytest.mark.long
def test_variances_regain_what_the_filter_removed(fitted):
    strains, counted, _, _ = fitted
    plain = histogram_document(strains, counted)["states"]
    names = [row["name"] for row in plain]
    corrected = histogram_document(strains, counted, dict.fromkeys(names, (1e-3, 2e-3)))["states"]
    for before, after in zip(plain, corrected, strict=True):
        assert after["variance_s"] == pytest.approx(
            before["variance_s"] + 1e-3 * UNRESOLVED_VARIANCE
        )
        assert after["variance_t"] == pytest.approx(
            before["variance_t"] + 2e-3 * UNRESOLVED_VARIANCE
        )
        assert after["variance_s_stderr"] == before["variance_s_stderr"]
        np.testing.assert_array_equal(after["counts"], before["counts"])


@pytest.mark.parametrize(("steepness", "angle_deg"), [(0.5, 0.0), (1.0, 35.0)])
def test_smooth_relief_has_variances_of_rough_one(steepness, angle_deg):
    """Grooves without their finest part, white heights, against the normals of all of it.

    Rationale: a slope of two pixels' difference has half the heights' variance over the pixel's
    square. Tolerance: 3 % for terms of higher order in the part. Without the normals' derivatives
    the slopes' variance would add up to a tenth.
    """
    rng = np.random.default_rng(8)
    slope_error = 0.02 * steepness
    waves = ndimage.gaussian_filter(rng.standard_normal((600, 600)), (12.0, 4.0))
    across, along = np.gradient(waves)
    clean = PIXEL_UM * waves * steepness / np.hypot(across.std(), along.std())
    finest = PIXEL_UM * math.sqrt(2.0 * slope_error) * rng.standard_normal(clean.shape)
    each = state(angle_deg, 0, 1.0)
    found, expected = (
        count_normals([each], {each.state.name: as_map(relief)}, pixel_um=PIXEL_UM)
        for relief in (clean, clean + finest)
    )
    added = lost_variances(
        clean.astype(np.float32),
        np.full(clean.shape, slope_error, np.float32),
        pixel_um=PIXEL_UM,
        valid=np.ones(clean.shape, bool),
        angle_rad=each.state.angle_rad,
    )
    truth = expected[each.state.name]
    errors = []
    for lost in (added, (slope_error, slope_error)):
        (row,) = histogram_document([each], found, {each.state.name: lost})["states"]
        values = (row[f"variance_{axis}"] / UNRESOLVED_VARIANCE for axis in "st")
        truths = truth.variance_x, truth.variance_y
        errors.append([abs(v / t - 1.0) for v, t in zip(values, truths, strict=True)])
    assert max(errors[0]) < 0.03, errors
    assert min(errors[1]) > 1.5 * max(errors[0]), errors


@pytest.mark.long
@pytest.mark.parametrize("angle_deg", [0.0, 35.0, 90.0])
def test_state_is_counted_in_blocks_that_show_skin(relief, angle_deg):
    """Skin moved and stretched, counted in the neutral map's blocks, against counting it there.

    Rationale: the state's height at F X + shift is the neutral one's at X, so that its slopes times
    F transposed, counted where the turned neutral map has X, are the neutral ones. With F a mere
    shift the histograms are alike to interpolation; those of other blocks are not.
    """
    shift = np.array([14.0, -9.0])
    each = state(angle_deg, 1, 1.0)
    moved = Strain(np.eye(2), shift, 1e-8 * np.eye(6), 0.05, 100, True)
    each = StateStrain(each.state, 1.0, moved)
    whole, edge = relief, SIDE // 2
    # x to the right, y up: what was at X is at X + shift
    top, left = edge + round(shift[1]), edge - round(shift[0])
    there = np.ones((SIDE, SIDE), bool)
    found = _skin_blocks(
        each, as_map(whole[top : top + SIDE, left : left + SIDE]), pixel_um=PIXEL_UM, there=there
    )
    turned, inside = _along_x(middle(whole).astype(np.float32), there, each.state.angle_rad)
    group, groups = assign_blocks(np.arange(SIDE**2), (SIDE, SIDE), BLOCKS_PER_SIDE)
    expected = count_block_normals(
        turned, group.reshape(SIDE, SIDE), groups, pixel=PIXEL_UM, valid=inside
    )
    assert found.shape == (*block_grid_shape((SIDE, SIDE), BLOCKS_PER_SIDE), 64, 64)

    def shares(counts):
        coarse = counts.reshape(-1, 16, 4, 16, 4).sum(axis=(2, 4)).reshape(len(counts), -1)
        return coarse / np.maximum(coarse.sum(axis=1, keepdims=True), 1)

    both = found.reshape(groups, 64, 64)
    whole_blocks = np.flatnonzero(
        (both.sum(axis=(1, 2)) > 0.95 * SIDE**2 / groups)
        & (expected.sum(axis=(1, 2)) > 0.95 * SIDE**2 / groups)
    )
    assert len(whole_blocks) > 0.3 * groups
    ours, theirs = shares(both)[whole_blocks], shares(expected)[whole_blocks]
    own = np.abs(ours - theirs).sum(axis=1)
    other = np.abs(ours - theirs[::-1]).sum(axis=1)
    assert np.median(own) < 0.5 * np.median(other)


@pytest.mark.long
def test_progress_is_reported_and_direction_is_irrelevant(fitted):
    _, _, document, fractions = fitted
    assert fractions == [0.0, 0.25, 0.5, 0.75]
    if document["direction"] is not None:
        assert document["direction"]["p_alpha"] > 1e-3


@pytest.mark.long
def test_state_near_neutral_or_unstrained_has_no_kernel(relief):
    lost = state(0.0, 2, 1.2)
    lost = StateStrain(
        lost.state, 1.2, Strain(np.eye(2), np.zeros(2), np.full((6, 6), np.inf), math.inf, 0, False)
    )
    strains = [state(0.0, 0, 1.0), state(0.0, 1, 1.004), lost]
    heights = {each.state.name: as_map(middle(relief)) for each in strains}
    counted = count_normals(strains, heights, pixel_um=PIXEL_UM)
    document = fit_kernels(
        strains,
        heights,
        counted,
        pixel_um=PIXEL_UM,
        compute_tiles=lambda name, tiles, compute: map(compute, tiles),
    )
    assert document["fits"] == []
    assert document["tables"] == []


@pytest.mark.long
def test_only_skin_that_both_states_show_is_counted(relief):
    wide = state(0.0, 1, 1.25)
    strains = [state(0.0, 0, 1.0), wide]
    heights = {each.state.name: as_map(middle(relief)) for each in strains}
    half = np.zeros((SIDE, SIDE), bool)
    half[:, : SIDE // 2] = True
    heights["a000_n0"] = SkinMap(heights["a000_n0"].values, "um", heights["a000_n0"].stderr, half)
    counted = count_normals(strains, heights, pixel_um=PIXEL_UM)
    # of the stretched state only what the left half of the neutral one has become
    assert counted[wide.state.name].samples == pytest.approx(SIDE * SIDE / 2, rel=0.05)


def test_jaws_are_not_skin():
    picture = np.full((200, 200), 0.3, np.float32)
    picture[:, :40] = 0.02
    mask = skin_mask(picture)
    assert not mask[:, :40].any()
    assert mask[60:140, 70:].all()
