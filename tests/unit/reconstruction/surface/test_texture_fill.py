"""Textures are filled without changing what is known, and smoothly where nothing is."""

import numpy as np
import pytest
from twins.textures import points_from_texels

from reconstruction.surface.texture_fill import densify, push_pull, rasterize, texels_from_points


def grid(side=17, *, low=0.05, high=0.95):
    """A square of triangles that covers most of the texture: points, faces, corner_uv."""
    x, y = np.meshgrid(np.linspace(low, high, side), np.linspace(low, high, side))
    uv = np.stack([x, y], axis=-1).reshape(-1, 2)
    at = np.arange(side**2).reshape(side, side)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
    faces = np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in ([a, b, d], [a, d, c])])
    return uv, faces, uv[faces]


def texel_uv(size):
    x = (np.arange(size) + 0.5) / size
    return np.broadcast_to(x, (size, size)), np.broadcast_to(1 - x[:, None], (size, size))


@pytest.mark.parametrize("size", [8, 61, 256])
def test_texel_coverage_is_unique_and_complete_under_surface(size):
    _, _, corner_uv = grid()
    u, v = texel_uv(size)
    inside = (u > 0.05) & (u < 0.95) & (v > 0.05) & (v < 0.95)
    np.testing.assert_array_equal(rasterize(corner_uv, size).covered, inside)
    mirrored = corner_uv[:, ::-1]  # charts may be laid out either way round
    np.testing.assert_array_equal(rasterize(mirrored, size).covered, inside)


def test_linear_field_is_rasterized_exactly():
    uv, faces, corner_uv = grid()
    texels = rasterize(corner_uv, 128)
    values, weight = texels_from_points(texels, faces, np.stack([uv[:, 0], 3 * uv[:, 1]], axis=-1))
    u, v = texel_uv(128)
    seen = texels.covered
    np.testing.assert_allclose(values[seen][:, 0], u[seen], atol=1e-6)
    np.testing.assert_allclose(values[seen][:, 1], 3 * v[seen], atol=3e-6)
    np.testing.assert_allclose(weight[seen], 1.0, atol=1e-6)
    np.testing.assert_array_equal(weight[~seen], 0.0)


def test_texture_top_row_is_v_equal_one():
    uv, faces, corner_uv = grid()
    made = densify(rasterize(corner_uv, 64), faces, uv[:, 1])
    assert made.values[4, 32, 0] > 0.9
    assert made.values[-5, 32, 0] < 0.1


def test_points_resampled_from_texture_match_originals():
    uv, faces, corner_uv = grid()
    field = np.stack([uv[:, 0], uv[:, 1] ** 2], axis=-1)
    made = densify(rasterize(corner_uv, 256), faces, field)
    back = points_from_texels(made.values, corner_uv, faces, len(uv))
    inner = np.abs(uv - 0.5).max(axis=1) < 0.42
    np.testing.assert_allclose(back[inner], field[inner], atol=1e-3)
    # at the rim half of the texels are filled ones: within two texels of the slope
    np.testing.assert_allclose(back, field, atol=2 * 2 / 256)
    single = points_from_texels(made.values[..., 0], corner_uv, faces, len(uv))
    np.testing.assert_array_equal(single, back[:, 0])


def test_points_without_weight_or_value_leave_filled_gap():
    uv, faces, corner_uv = grid()
    values = uv[:, 0].copy()
    bad = np.linalg.norm(uv - 0.5, axis=1) < 0.15
    values[bad] = np.nan
    made = densify(rasterize(corner_uv, 128), faces, values)
    u, v = texel_uv(128)
    gap = np.hypot(u - 0.5, v - 0.5) < 0.08
    # the gap is 0.3 wide: a sixth of it; filled with its mean it would be off by 0.08
    assert np.abs(made.values[..., 0] - u)[gap].max() < 0.05
    assert made.confidence[gap].max() < 0.5
    zero = densify(
        rasterize(corner_uv, 128), faces, np.where(bad, 99.0, uv[:, 0]), (~bad).astype(float)
    )
    np.testing.assert_allclose(zero.values, made.values, atol=1e-6)


@pytest.mark.parametrize("shape", [(64, 64), (37, 90), (1, 5), (2, 2)])
@pytest.mark.parametrize("share", [0.02, 0.3, 1.0])
def test_a_constant_stays_constant_whatever_is_known(rng, shape, share):
    weight = (rng.random(shape) < share).astype(float)
    weight.flat[0] = 0.5
    found = push_pull(np.where(weight > 0, 7.25, np.nan), weight)
    assert found.valid.all()
    np.testing.assert_allclose(found.values[..., 0], 7.25, rtol=1e-5)


def test_fill_ramp_from_scattered_texels_is_exact_inside(rng):
    """A fifth of the texels known: median error below 0.01 texel steps, largest below half one."""
    y, x = np.mgrid[0:200, 0:200].astype(float)
    ramp = x + 0.5 * y
    found = push_pull(ramp, (rng.random(ramp.shape) < 0.2).astype(float))
    off = np.abs(found.values[..., 0] - ramp)[10:-10, 10:-10]
    assert np.median(off) < 0.01
    assert off.max() < 0.5


def test_fill_of_ramp_gap_errs_below_twentieth_width():
    x = np.broadcast_to(np.arange(256.0), (256, 256))
    weight = np.ones(x.shape)
    weight[:, 100:140] = 0
    found = push_pull(x, weight)
    assert np.abs(found.values[..., 0] - x).max() < 40 / 20
    # a fill with the mean of the two sides, which the test could mistake for it, is off by half
    assert np.abs(119.5 - x[:, 100:140]).max() > 19


def test_measured_texels_keep_their_values_and_their_confidence(rng):
    weight = (rng.random((60, 80)) < 0.4).astype(float)
    values = rng.random((60, 80, 3)).astype(np.float32)
    found = push_pull(values, weight)
    np.testing.assert_array_equal(found.values[weight == 1], values[weight == 1])
    np.testing.assert_array_equal(found.confidence[weight == 1], 1.0)
    assert found.confidence[weight == 0].max() < 1.0


def test_filled_values_stay_between_the_known_ones(rng):
    weight = (rng.random((80, 80)) < 0.1).astype(float)
    values = rng.random((80, 80))
    found = push_pull(values, weight).values[..., 0]
    known = values[weight > 0]
    margin = 0.1 * np.ptp(known)  # over-relaxation may pass the goal a little
    assert known.min() - margin < found.min() <= found.max() < known.max() + margin


def test_confidence_falls_with_distance_to_known_texels():
    weight = np.zeros((128, 128))
    weight[:, :8] = 1
    confidence = push_pull(np.ones(weight.shape), weight).confidence[64]
    assert confidence[8] > confidence[30] > confidence[120] > 0
    assert confidence[8] < 1


def test_mask_excludes_values_and_is_not_filled():
    values = np.ones((64, 64))
    values[:, 32:] = 100.0
    weight = np.ones(values.shape)
    weight[20:40, 20:30] = 0
    mask = np.zeros(values.shape, bool)
    mask[:, :32] = True
    found = push_pull(values, weight, mask=mask)
    np.testing.assert_array_equal(found.valid, mask)
    np.testing.assert_allclose(found.values[mask][:, 0], 1.0, rtol=1e-5)
    np.testing.assert_array_equal(found.values[~mask], 0.0)


def test_nothing_known_gives_nothing_valid():
    found = push_pull(np.full((16, 16, 3), np.nan), np.zeros((16, 16)))
    assert not found.valid.any()
    np.testing.assert_array_equal(found.values, 0.0)
    np.testing.assert_array_equal(found.confidence, 0.0)


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: push_pull(np.ones((4, 4)), np.ones((4, 5))), "weight: got shape"),
        (lambda: push_pull(np.ones((4, 4)), 2 * np.ones((4, 4))), "weight: got 2.0"),
        (lambda: push_pull(np.ones((4, 4)), np.ones((4, 4)), mask=np.ones((3, 4))), "mask"),
        (lambda: rasterize(np.zeros((2, 3)), 64), "corner_uv"),
        (lambda: rasterize(np.zeros((2, 3, 2)), 4), "size"),
        (lambda: texels_from_points(rasterize(grid()[2], 16), grid()[1], np.ones(3)), "faces: got"),
    ],
)
def test_arguments_that_do_not_fit_are_named(call, says):
    with pytest.raises(ValueError, match=says):
        call()


def test_inputs_are_not_changed(rng):
    values, weight = rng.random((30, 30, 2)), (rng.random((30, 30)) < 0.5).astype(np.float32)
    before = values.copy(), weight.copy()
    push_pull(values, weight)
    np.testing.assert_array_equal(values, before[0])
    np.testing.assert_array_equal(weight, before[1])
