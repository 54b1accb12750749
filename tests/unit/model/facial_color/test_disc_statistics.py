"""Mean and deviation in a disc, against a plain twin in extended precision."""

import numpy as np
import pytest
from scipy import ndimage

from model import facial_color
from model.facial_color import disc_statistics
from model.facial_color.disc_statistics import DiscStatisticsError, measure

RADII_PX = (0.0, 1.0, 1.5, 2.9, 7.3, 16.0, 40.0)


def disc(radius_px):
    reach = int(radius_px)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return y * y + x * x <= radius_px**2


def shifted(image, dy, dx):
    rows, columns = image.shape
    out = np.zeros_like(image)
    if abs(dy) < rows and abs(dx) < columns:
        ys, xs = slice(max(0, -dy), min(rows, rows - dy)), slice(max(0, -dx), columns - max(0, dx))
        out[ys, xs] = image[ys.start + dy : ys.stop + dy, xs.start + dx : xs.stop + dx]
    return out


def twin(h, radius_px, valid):
    """Return mean, deviation, count by two passes over the disc's offsets in long double."""
    keep = valid & np.isfinite(h)
    values = np.where(keep, h, 0.0).astype(np.longdouble)
    offsets = np.argwhere(disc(radius_px)) - int(radius_px)
    count, total, squares = (np.zeros(h.shape, np.longdouble) for _ in range(3))
    for dy, dx in offsets:
        count += shifted(keep.astype(np.longdouble), dy, dx)
        total += shifted(values, dy, dx)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total / count
        for dy, dx in offsets:
            there = shifted(keep.astype(np.longdouble), dy, dx)
            squares += np.where(there > 0, (shifted(values, dy, dx) - mean) ** 2, 0)
        deviation = np.sqrt(squares / count)
    return mean.astype(float), deviation.astype(float), count.astype(int)


@pytest.mark.long
@pytest.mark.parametrize("radius_px", RADII_PX)
@pytest.mark.parametrize("shape", [(40, 37), (5, 70), (70, 3), (1, 1)])
def test_disc_contains_pixels_within_radius_map_and_mask(shape, radius_px, rng):
    h = rng.random(shape)
    valid = rng.random(shape) > 0.6
    for mask in (np.ones(shape, bool), valid):
        found = measure(h, radius_px, valid=mask)
        mean, deviation, count = twin(h, radius_px, mask)
        np.testing.assert_array_equal(found.count, count)
        np.testing.assert_allclose(found.mean, mean, rtol=1e-12)
        np.testing.assert_allclose(found.deviation, deviation, rtol=1e-7, atol=1e-15)
        np.testing.assert_array_equal(found.valid, count > 0)


def test_tiles_leave_no_seam(rng):
    # wider and taller than a tile, against a convolution
    h = rng.random((300, 1100))
    kernel = disc(11.0).astype(float)
    ones = ndimage.convolve(np.ones_like(h), kernel, mode="constant")
    mean = ndimage.convolve(h, kernel, mode="constant") / ones
    square = ndimage.convolve(h * h, kernel, mode="constant") / ones
    found = measure(h, 11.0)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-12)
    np.testing.assert_allclose(found.deviation, np.sqrt(square - mean**2), rtol=1e-9)


NEARLY_CONSTANT = {
    "flat": lambda x: 0.3 + 0.0 * x,
    "ramp": lambda x: 0.5 * x,
    "step": lambda x: np.where(x < 0.5, 0.0, 0.5),
}


@pytest.mark.long
@pytest.mark.parametrize("kind", NEARLY_CONSTANT)
@pytest.mark.parametrize("radius_px", [4.0, 16.0])
def test_deviation_keeps_precision_on_nearly_constant_map(kind, radius_px, rng):
    x = np.linspace(0.0, 1.0, 240)[None, :]
    h = NEARLY_CONSTANT[kind](x) + 1e-5 * rng.standard_normal((50, 240))
    _, deviation, _ = twin(h, radius_px, np.ones(h.shape, bool))
    found = measure(h, radius_px).deviation
    assert np.abs(found / deviation - 1).max() < 1e-6
    single = h.astype(np.float32)
    _, deviation, _ = twin(single.astype(float), radius_px, np.ones(h.shape, bool))
    assert np.abs(measure(single, radius_px).deviation / deviation - 1).max() < 2e-4


def test_float32_deviation_is_within_thousandth_at_small_contrast(rng):
    h = 0.3 + 1e-5 * rng.standard_normal((80, 200))
    _, deviation, _ = twin(h, 16.0, np.ones(h.shape, bool))
    found = measure(h.astype(np.float32), 16.0).deviation
    assert np.abs(found / deviation - 1).max() < 1e-3
    # the textbook form in float32 fails here, so that the test can fail
    kernel = (disc(16.0) / disc(16.0).sum()).astype(np.float32)
    single = h.astype(np.float32)
    mean = ndimage.convolve(single, kernel)
    textbook = np.sqrt(np.maximum(ndimage.convolve(single**2, kernel) - mean**2, 0))
    assert np.abs(textbook / deviation - 1).max() > 0.1


def test_constant_map_has_no_deviation_at_all():
    for kind in (np.float32, np.float64):
        h = np.full((150, 90), 0.1, kind)
        h[:, 40:] = 0.7
        found = measure(h, 5.0)
        assert (found.deviation[:, :34] == 0.0).all()
        assert (found.mean[:, :34] == h[0, 0]).all()


def test_missing_pixels_never_leak(rng):
    h = rng.random((80, 90))
    hole = np.zeros(h.shape, bool)
    hole[20:60, 30:70] = True
    wild = h.copy()
    wild[hole] = np.nan
    wild[25, 35] = np.inf
    huge = np.where(hole, 1e30, h)
    expected = measure(h, 6.0, valid=~hole)
    for found in (measure(wild, 6.0), measure(huge, 6.0, valid=~hole)):
        np.testing.assert_array_equal(found.count, expected.count)
        np.testing.assert_allclose(found.mean, expected.mean, rtol=1e-13)
        np.testing.assert_allclose(found.deviation, expected.deviation, rtol=1e-10)
    # no neighbour at all: NaN, and said so
    centre = (40, 50)
    assert expected.count[centre] == 0
    assert not expected.valid[centre]
    assert np.isnan(expected.mean[centre])
    assert np.isnan(expected.deviation[centre])


def test_radius_zero_is_the_pixel_itself(rng):
    h = rng.random((20, 30))
    mu, sigma = facial_color.local_statistics(h, 0)
    np.testing.assert_allclose(mu, h, rtol=1e-15)
    assert (sigma == 0.0).all()


def test_disc_larger_than_map_is_whole_map(rng):
    h = rng.random((20, 30))
    mu, sigma = facial_color.local_statistics(h, 1e6)
    np.testing.assert_allclose(mu, h.mean(), rtol=1e-13)
    np.testing.assert_allclose(sigma, h.std(), rtol=1e-13)


def test_map_is_unmodified_and_may_be_view(rng):
    h = rng.random((40, 60))
    before = h.copy()
    found = measure(h[::2, ::3], 3.0)
    np.testing.assert_array_equal(h, before)
    np.testing.assert_array_equal(found.mean, measure(h[::2, ::3].copy(), 3.0).mean)


def test_stacked_maps_are_measured_independently(rng):
    h, valid = rng.random((2, 3, 9, 11)), rng.random((3, 9, 11)) > 0.3
    whole, masked = measure(h, 2.5), measure(h, 2.5, valid=valid)
    for i, j in np.ndindex(2, 3):
        for found, one in (
            (whole, measure(h[i, j], 2.5)),
            (masked, measure(h[i, j], 2.5, valid=valid[j])),
        ):
            np.testing.assert_array_equal(found.mean[i, j], one.mean)
            np.testing.assert_array_equal(found.deviation[i, j], one.deviation)
            np.testing.assert_array_equal(found.count[i, j], one.count)
    assert measure(h[:0], 2.5, valid=valid).mean.shape == (0, 3, 9, 11)


@pytest.mark.parametrize("radius_px", [2.0, 8.0])
@pytest.mark.parametrize(
    ("given", "told"),
    [(np.float16, np.float32), (np.float32, np.float32), (np.float64, np.float64)],
)
def test_local_statistics_have_the_precision_of_their_map(given, told, radius_px, rng):
    h = rng.uniform(0.1, 0.2, (3, 20, 20)).astype(given)
    mu, sigma = facial_color.local_statistics(h, radius_px)
    exact = measure(h.astype(np.float64), radius_px)
    assert mu.dtype == sigma.dtype == told
    np.testing.assert_allclose(mu, exact.mean, rtol=2e-6)
    np.testing.assert_allclose(sigma, exact.deviation, rtol=2e-4)


def test_wrong_maps_masks_and_radii_are_named():
    with pytest.raises(DiscStatisticsError, match=r"h: got shape \(3,\)"):
        measure(np.zeros(3), 1.0)
    with pytest.raises(DiscStatisticsError, match="valid: got float64"):
        measure(np.zeros((3, 3)), 1.0, valid=np.ones((3, 3)))
    for shape in ((1, 3), (2, 3, 3), (1, 3, 3)):
        with pytest.raises(DiscStatisticsError, match=r"expected bool \(3, 3\)"):
            measure(np.zeros((3, 3)), 1.0, valid=np.ones(shape, bool))
    with pytest.raises(DiscStatisticsError, match=r"h: got shape \(2, 0, 3\)"):
        measure(np.zeros((2, 0, 3)), 1.0)
    for radius in (-1.0, np.nan, np.inf):
        with pytest.raises(DiscStatisticsError, match="radius_px: got"):
            measure(np.zeros((3, 3)), radius)


def test_radius_counts_pixel_centres_on_its_edge():
    widths = disc_statistics.half_widths(5.0, 99, 99)
    assert widths.tolist() == [5, 4, 4, 4, 3, 0]
    assert disc_statistics.half_widths(5.0, 2, 3).tolist() == [3, 3, 3]
