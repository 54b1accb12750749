import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d, map_coordinates

from model.microstructure.convolution import (
    ConvolutionError,
    LineKernels,
    convolve,
    convolve_tiled,
    list_tiles,
)
from model.microstructure.convolution_kernels import distance_to_invalid
from model.microstructure.map_windows import MapWindow

X, Y = (1.0, 0.0), (0.0, 1.0)


def slanted(angle):
    return (np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))


def fields(shape, *, turn=0.004):
    """Kernels that blur and sharpen, and turn, over a map."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    angle = turn * (x + 0.5 * y) + 0.3
    axis_s = np.stack([np.cos(angle), np.sin(angle)], -1)
    axis_t = np.stack([-np.sin(angle), np.cos(angle)], -1)
    alpha_s = np.clip(1.2 * np.sin(x / 40.0), -2.0, 1.0)
    alpha_t = np.clip(-1.6 * np.cos(y / 30.0), -2.0, 1.0)
    return axis_s, axis_t, alpha_s, 1.5 + np.cos(y / 25.0), alpha_t, 1.4 + np.sin(x / 35.0)


def relief(shape, rng):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return rng.standard_normal(shape) + 0.02 * (x + y)


def numpy_pass(height, axis, alpha, sigma, valid):
    """Eqs. (3) and (6) as they are written, with bilinear samples and the rule for pairs."""
    y, x = np.mgrid[: height.shape[0], : height.shape[1]].astype(np.float64)
    axis = np.broadcast_to(axis, (*height.shape, 2))
    alpha, sigma = (np.broadcast_to(v, height.shape) for v in (alpha, sigma))
    total, norm = np.zeros(height.shape), np.ones(height.shape)
    usable = np.where(valid, height, 0.0)
    radius = np.floor(4.0 * sigma + 0.5)
    for i in range(1, int(radius.max()) + 1):
        w = np.exp(-0.5 * (i / np.maximum(sigma, 1e-9)) ** 2) * (i <= radius)
        pair, good = np.zeros(height.shape), valid.copy()
        for side in (1, -1):
            at = [y + side * i * axis[..., 1], x + side * i * axis[..., 0]]
            pair += map_coordinates(usable, at, order=1, mode="reflect")
            share = map_coordinates(valid.astype(np.float64), at, order=1, mode="reflect")
            good &= share > 1.0 - 1e-9
        total += np.where(good, w * (pair - 2.0 * usable), 0.0)
        norm += 2.0 * w
    return np.where(valid, height + alpha * total / norm, height)


@pytest.mark.parametrize("mode", ["plain", "holes"])
def test_two_passes_match_plain_eqs_4_to_6(rng, mode):
    shape = (61, 83)
    height = relief(shape, rng)
    valid = np.ones(shape, bool)
    if mode == "holes":
        valid[20:30, 30:50] = False
        valid[rng.random(shape) < 0.01] = False
        height[valid.argmin() // 83, valid.argmin() % 83] = np.nan
    axis_s, axis_t, alpha_s, sigma_s, alpha_t, sigma_t = fields(shape)
    found = convolve(
        height, axis_s, axis_t, alpha_s, sigma_s, alpha_t, sigma_t, valid=valid, sampling="linear"
    )
    first = numpy_pass(height, axis_s, alpha_s, sigma_s, valid)
    expected = numpy_pass(first, axis_t, alpha_t, sigma_t, valid)
    # samples a rounding of float32 beside a pixel may or may not need its neighbour in a hole
    same = np.isclose(found, expected, atol=2e-5, rtol=1e-5, equal_nan=True)
    assert same.mean() > 0.999
    if mode == "plain":
        assert same.all()


def test_double_heights_are_convolved_to_float32_parameter_rounding(rng):
    shape = (61, 83)
    height = 1e4 + relief(shape, rng)  # float32 would leave 1e-3 of it
    asked = [np.asarray(v, np.float32) for v in fields(shape)]
    found = convolve(height, *asked, sampling="linear")
    assert found.dtype == np.float64
    axis_s, axis_t, alpha_s, sigma_s, alpha_t, sigma_t = (v.astype(np.float64) for v in asked)
    valid = np.ones(shape, bool)
    first = numpy_pass(height, axis_s, alpha_s, sigma_s, valid)
    expected = numpy_pass(first, axis_t, alpha_t, sigma_t, valid)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)
    still = convolve(height, *slanted(0.6), 0.0, 2.0, 0.5, np.where(valid & (height > 2e4), 2, 0))
    np.testing.assert_array_equal(still, height)


def test_stacked_heights_are_convolved_independently(rng):
    stack = rng.standard_normal((2, 3, 12, 15)).astype(np.float32)
    valid = rng.random(stack.shape) > 0.05
    kernel = (*slanted(0.4), 0.8, 1.2, -0.9, 1.1)
    for mask in (valid, valid[0, 0]):
        found = convolve(stack, *kernel, valid=mask)
        assert found.dtype == np.float32
        for at in np.ndindex(2, 3):
            one = convolve(stack[at], *kernel, valid=np.broadcast_to(mask, stack.shape)[at])
            np.testing.assert_array_equal(found[at], one)
    assert convolve(stack[:0], *kernel).shape == (0, 3, 12, 15)
    half = stack.astype(np.float16)
    np.testing.assert_array_equal(
        convolve(half, *kernel), convolve(half.astype(np.float32), *kernel)
    )


def test_row_and_column_kernels_match_fit_kernels(rng):
    height = relief((40, 50), rng)
    found = convolve(height, X, Y, 0.7, 1.7, -1.3, 2.2)
    once = 0.3 * height + 0.7 * gaussian_filter1d(height, 1.7, axis=1)
    twice = 2.3 * once - 1.3 * gaussian_filter1d(once, 2.2, axis=0)
    np.testing.assert_allclose(found, twice, atol=1e-5)


def test_zero_strength_is_bit_exact_even_without_axis(rng):
    height = relief((30, 40), rng).astype(np.float32)
    np.testing.assert_array_equal(convolve(height, (0, 0), (0, 0), 0.0, 3.0, 0.0, 3.0), height)
    np.testing.assert_array_equal(convolve(height, X, Y, 1.0, 0.0, -2.0, 0.05), height)
    alpha = np.zeros(height.shape)
    alpha[:, 20:] = 0.8
    moved = convolve(height, *slanted(0.6), alpha, 2.0, 0.0, 1.0)
    np.testing.assert_array_equal(moved[:, :20], height[:, :20])
    assert (moved[:, 20:] != height[:, 20:]).mean() > 0.99


@pytest.mark.parametrize("angle", [0.0, 0.3, np.pi / 4, 1.2, 2.5])
@pytest.mark.parametrize(("alpha", "sigma"), [(1.0, 1.0), (0.5, 2.5), (-2.0, 1.2)])
def test_waves_scale_with_kernel_response_in_any_direction(angle, alpha, sigma):
    y, x = np.mgrid[:96, :96].astype(np.float64)
    axis_s, axis_t = slanted(angle)
    k = 2.0 * np.pi / 9.0
    inner = slice(24, -24), slice(24, -24)
    for along, axis in ((True, axis_s), (False, axis_t)):
        wave = np.cos(k * (x * axis[0] + y * axis[1]) + 0.4)
        found = convolve(wave, axis_s, axis_t, alpha, sigma, 0.0, 1.0)
        gain = 1.0 - alpha + alpha * np.exp(-0.5 * (k * sigma) ** 2) if along else 1.0
        np.testing.assert_allclose(found[inner], gain * wave[inner], atol=0.012 * (1 + abs(alpha)))


def test_bilinear_sampling_blurs_slanted_lines_but_cubic_barely():
    y, x = np.mgrid[:96, :96].astype(np.float64)
    axis_s, axis_t = slanted(0.5)
    wave = np.cos(2.0 * np.pi / 5.0 * (x * axis_t[0] + y * axis_t[1]))
    inner = slice(24, -24), slice(24, -24)
    loss = {
        name: np.std(
            (convolve(wave, axis_s, axis_t, 1.0, 2.0, 0.0, 1.0, sampling=name) - wave)[inner]
        )
        for name in ("linear", "cubic")
    }
    # bilinear: a response of 1 - f (1 - f) k^2 / 2 an axis, on average over fractions f
    assert loss["linear"] > 0.05
    assert loss["cubic"] < 0.25 * loss["linear"]


def test_planes_stay_planes_at_borders_and_around_holes():
    y, x = np.mgrid[:40, :40].astype(np.float64)
    plane = 0.3 * x - 0.7 * y
    valid = np.ones(plane.shape, bool)
    valid[10:20, 15:18] = False
    for alpha in (-2.0, 1.0):
        found = convolve(plane, *slanted(0.7), alpha, 2.5, alpha, 1.5, valid=valid, border="open")
        np.testing.assert_allclose(found, plane, atol=1e-4)


def test_sharpening_stays_bounded_at_borders_seams_and_holes(rng):
    shape = (160, 160)
    height = rng.standard_normal(shape)
    valid = np.ones(shape, bool)
    valid[60:90, 70:100] = False
    valid[:, 130] = False
    valid[rng.random(shape) < 0.02] = False
    garbage = np.where(valid, height, 1e6)
    garbage[60:90, 70:100] = np.nan
    clear = convolve(height, *slanted(0.4), -2.0, 1.5, -2.0, 3.0)
    interior = np.std(clear[20:-20, 20:-20])
    for border in ("mirror", "open"):
        found = convolve(garbage, *slanted(0.4), -2.0, 1.5, -2.0, 3.0, valid=valid, border=border)
        near = found[valid & (distance_to_invalid(valid) <= 14)]
        # 15,000 pixels, of which about one in four is independent: standard error 1.2 %
        assert np.std(near) < 1.04 * interior
        np.testing.assert_array_equal(found[~valid], garbage.astype(np.float32)[~valid])


def test_neighbor_weights_near_hole_never_exceed_distant_ones():
    n = 41
    valid = np.ones((1, n), bool)
    valid[0, [8, 9, 15]] = False
    rows = np.zeros((n, n))
    for i in np.flatnonzero(valid[0]):
        spike = np.zeros((1, n))
        spike[0, i] = 1.0
        made = convolve(spike, X, Y, -2.0, 2.0, 0.0, 1.0, valid=valid, border="open")
        rows[:, i] = made[0]
    weight = np.abs(rows).sum(axis=1)
    assert weight.max() <= weight[28] + 1e-5  # 28 reaches neither holes nor borders
    np.testing.assert_allclose(rows.sum(axis=1)[valid[0]], 1.0, atol=1e-6)


def test_ramp_near_hole_is_lifted_by_unpaired_samples():
    # what the rule for pairs prevents: this is why it is there
    ramp = np.arange(40.0)
    w = np.exp(-0.5 * (np.arange(-8, 9) / 2.0) ** 2)
    seen = np.arange(-8, 9) >= 0
    one_sided = (w * ramp[20 + np.arange(-8, 9)])[seen].sum() / w[seen].sum()
    assert abs(3.0 * 20.0 - 2.0 * one_sided - 20.0) > 2.0
    valid = np.ones((1, 40), bool)
    valid[0, :20] = False
    found = convolve(ramp[None], X, Y, -2.0, 2.0, 0.0, 1.0, valid=valid)
    assert abs(found[0, 20] - 20.0) < 1e-4


def test_tiles_reproduce_whole_map_exactly_and_can_resume(rng):
    shape = (150, 190)
    height = relief(shape, rng).astype(np.float32)
    height[70:75, 90:99] = np.nan
    valid = rng.random(shape) > 0.003
    made = fields(shape)
    made[2][:, 100:] = 0.0
    whole = convolve(height, *made[:2], *made[2:], valid=valid)
    asked = [np.asarray(values, np.float32) for values in made]

    def cut(values, window):
        return np.ascontiguousarray(values[window.rows, window.columns])

    def fields_at(window):
        s, t, alpha_s, sigma_s, alpha_t, sigma_t = (cut(v, window) for v in asked)
        return LineKernels(s, alpha_s, sigma_s), LineKernels(t, alpha_t, sigma_t)

    for tile in (37, 64, 400):
        target = np.full(shape, -7.0, np.float32)
        done = []

        def stop(number, count, done=done):
            done.append(number)
            if len(done) == 2 and count > 2:
                raise KeyboardInterrupt

        arguments = {"tile": tile, "valid_at": lambda window: cut(valid, window)}
        try:
            convolve_tiled(height, target, fields_at, progress=stop, **arguments)
        except KeyboardInterrupt:
            left = [w for n, w in enumerate(list_tiles(shape, tile)) if n not in done]
            assert all((target[w.rows, w.columns] == -7.0).all() for w in left)
            convolve_tiled(height, target, fields_at, finished=done, **arguments)
        np.testing.assert_array_equal(target, whole)


def test_distances_to_invalid_pixels_are_chebyshev(rng):
    valid = rng.random((30, 41)) > 0.004
    bad = np.argwhere(~valid)
    y, x = np.mgrid[:30, :41]
    moves = np.maximum(np.abs(y[..., None] - bad[:, 0]), np.abs(x[..., None] - bad[:, 1]))
    np.testing.assert_array_equal(distance_to_invalid(valid), moves.min(axis=-1))
    assert distance_to_invalid(np.ones((3, 3), bool)).min() == 255


def test_maps_smaller_than_kernel_are_mirrored_repeatedly(rng):
    height = rng.standard_normal((3, 4))
    found = convolve(height, X, Y, 1.0, 5.0, 1.0, 3.0)
    expected = gaussian_filter1d(gaussian_filter1d(height, 5.0, axis=1), 3.0, axis=0)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert convolve(np.ones((1, 1)), *slanted(0.3), -2.0, 4.0, 1.0, 4.0)[0, 0] == pytest.approx(1.0)
    np.testing.assert_array_equal(
        convolve(np.full((5, 5), np.nan), X, Y, 1.0, 2.0, 1.0, 2.0), np.full((5, 5), np.nan)
    )


def test_out_of_range_parameters_are_refused_by_name():
    height = np.zeros((4, 5))
    for arguments, word in (
        (((2.0, 0.0), Y, 1.0, 1.0, 0.0, 1.0), "unit length"),
        ((X, Y, 1.5, 1.0, 0.0, 1.0), "strength"),
        ((X, Y, 1.0, -1.0, 0.0, 1.0), "deviation"),
        ((X, Y, 1.0, 1e5, 0.0, 1.0), "deviation"),
        ((X, Y, np.nan, 1.0, 0.0, 1.0), "NaN"),
        ((X, (np.nan, 1.0), 0.0, 1.0, 0.5, 1.0), "unit length"),
        ((X, Y, np.zeros((4, 4)), 1.0, 0.0, 1.0), "alpha"),
        ((np.zeros((5, 4, 2)), Y, 0.0, 1.0, 0.0, 1.0), "axis"),
    ):
        with pytest.raises(ConvolutionError, match=word):
            convolve(height, *arguments)
    with pytest.raises(ConvolutionError, match="height"):
        convolve(np.zeros(5), X, Y, 0.0, 1.0, 0.0, 1.0)
    with pytest.raises(ConvolutionError, match="valid"):
        convolve(height, X, Y, 0.5, 1.0, 0.0, 1.0, valid=np.ones((4, 5)))
    with pytest.raises(ConvolutionError, match="sampling"):
        convolve(height, X, Y, 0.5, 1.0, 0.0, 1.0, sampling="nearest")
    with pytest.raises(ConvolutionError, match="border"):
        convolve(height, X, Y, 0.5, 1.0, 0.0, 1.0, border="wrap")
    single = np.zeros((4, 5), np.float32)
    with pytest.raises(ConvolutionError, match="memory"):
        convolve_tiled(single, single, lambda w: None)
    with pytest.raises(ConvolutionError, match="float32"):
        convolve_tiled(single, height, lambda w: None)
    with pytest.raises(ConvolutionError, match="source: got"):
        convolve_tiled(np.zeros((4, 5), np.float32)[:0], height, lambda w: None)
    with pytest.raises(ConvolutionError, match="tile"):
        list_tiles((4, 4), 0)
    assert MapWindow(0, 2, 0, 2).expand(3, (4, 4)) == MapWindow(0, 4, 0, 4)


def test_input_is_unmodified(rng):
    height = rng.standard_normal((20, 20)).astype(np.float32)
    before = height.copy()
    found = convolve(height, X, Y, 0.0, 1.0, 0.0, 1.0)
    found += 1.0
    convolve(height, *slanted(0.2), 0.9, 2.0, -1.0, 1.0)
    np.testing.assert_array_equal(height, before)
