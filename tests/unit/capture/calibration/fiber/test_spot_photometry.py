"""Middles and sums of spots: unbiased, with errors as large as stated."""

import numpy as np
import pytest
from scipy.stats import chi2

from capture.calibration.fiber.spot_photometry import (
    SpotImage,
    encircled_energy,
    make_spot_image,
    measure_centroids,
    measure_flux,
    merge_spot_images,
)
from capture.raw import RawFrame

ALARM = 1e-3
WELL_E = 13500.0
READ_E = 13.0


def scene(pixels, electrons, *, size=200, sigma=3.0, tilt=0.0):
    y, x = np.mgrid[:size, :size].astype(float)
    light = 20.0 + tilt * (x - size / 2)
    for (column, row), total in zip(pixels, electrons, strict=True):
        square = (x - column) ** 2 + (y - row) ** 2
        light += total / (2 * np.pi * sigma**2) * np.exp(-square / (2 * sigma**2))
    return light


def exposed(light, rng, amount=1.0):
    signal = rng.poisson(np.maximum(light * amount, 0)) + READ_E * rng.standard_normal(light.shape)
    valid = signal < WELL_E
    x = np.minimum(signal, WELL_E) / WELL_E
    variance = np.maximum(x, 0) / WELL_E + (READ_E / WELL_E) ** 2
    return SpotImage(x.astype(np.float32), variance.astype(np.float32), valid, amount, 0.0)


PIXELS = np.array([[40.3, 50.7], [120.5, 60.0], [70.2, 150.4], [150.9, 140.1]])
APERTURE = np.full(4, 16.0)


@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_fluxes_are_unbiased_with_stated_scatter_on_slope(rng, tilt):
    electrons = np.array([3e5, 1e5, 3e4, 1e4])
    light = scene(PIXELS, electrons, tilt=tilt)
    pulls = []
    for _ in range(12):
        flux = measure_flux(exposed(light, rng), PIXELS, aperture_px=APERTURE)
        assert flux.whole.all()
        assert not flux.saturated.any()
        pulls.append((flux.value - electrons / WELL_E) / np.sqrt(flux.variance))
    # the plane's own allowance makes the stated errors a little too large, never too small
    assert np.sum(np.square(pulls)) < chi2.ppf(1 - ALARM, 48)
    assert np.sum(np.square(pulls)) > 0.15 * 48


def test_middles_scatter_as_stated(rng):
    electrons = np.array([3e5, 1e5, 5e4, 3e4])
    light = scene(PIXELS, electrons)
    pulls = []
    for _ in range(12):
        image = merge_spot_images([exposed(light, rng)])
        middle, stderr, saturated = measure_centroids(image, PIXELS.round(), aperture_px=APERTURE)
        assert not saturated.any()
        pulls.append((middle - PIXELS) / stderr[:, None])
    assert np.sum(np.square(pulls)) < chi2.ppf(1 - ALARM, 96)
    assert np.sum(np.square(pulls)) > 0.15 * 96


def test_saturated_spots_are_flagged_shorter_exposure_measures_them(rng):
    electrons = np.array([3e6, 1e5, 3e5, 1e5])
    light = scene(PIXELS, electrons)
    long, short = exposed(light, rng), exposed(light, rng, amount=0.1)
    flux = measure_flux(long, PIXELS, aperture_px=APERTURE)
    np.testing.assert_array_equal(flux.saturated, [True, False, False, False])
    assert flux.value[0] < 0.9 * electrons[0] / WELL_E
    both = merge_spot_images([long, short])
    assert both.valid.all()
    assert not merge_spot_images([long]).valid.all()
    again = measure_flux(short, PIXELS, aperture_px=APERTURE)
    assert not again.saturated[0]
    assert abs(again.value[0] - 0.1 * electrons[0] / WELL_E) < 4 * np.sqrt(again.variance[0])


def test_spots_at_border_or_unlit_are_not_measured(rng):
    places = np.array([[5.0, 100.0], [100.0, 100.0], [np.nan, np.nan]])
    part = exposed(scene(places[:1], [1e5]), rng)
    flux = measure_flux(part, places, aperture_px=np.full(3, 16.0))
    np.testing.assert_array_equal(flux.whole, [False, True, False])
    assert abs(flux.value[1]) < 4 * np.sqrt(flux.variance[1])
    middle, _, _ = measure_centroids(
        merge_spot_images([part]), places, aperture_px=np.full(3, 16.0)
    )
    assert np.isnan(middle).all()


def test_perfect_lens_light_beyond_disc_is_known():
    """Airy's pattern, summed over a disc and its ring, against the asymptote."""
    from scipy.special import j1

    airy_px, aperture = 3.0, 40.0
    y, x = np.mgrid[-100:101, -100:101].astype(float)
    v = np.pi * np.hypot(x, y) / airy_px
    pattern = np.ones_like(v)
    np.divide(2 * j1(v), v, out=pattern, where=v > 0)
    pattern = pattern**2 * np.pi / (4 * airy_px**2)
    part = SpotImage(
        pattern.astype(np.float32),
        np.full(v.shape, 1e-4, np.float32),
        np.ones(v.shape, bool),
        1.0,
        0.0,
    )
    flux = measure_flux(part, np.array([[100.0, 100.0]]), aperture_px=np.array([aperture]))
    assert flux.value[0] == pytest.approx(float(encircled_energy(aperture, airy_px)), abs=2e-3)
    assert flux.value[0] < 0.99


def test_frames_of_color_cameras_are_refused():
    frame = RawFrame(cfa=np.zeros((4, 4), np.uint16), pattern="RGGB", black=(0.0,) * 4, white=100)
    with pytest.raises(ValueError, match="monochrome"):
        make_spot_image(frame, amount_s=1.0, reading_deg=0.0)


def test_dark_and_flat_are_taken_off():
    frame = RawFrame(
        cfa=np.full((4, 4), 164, np.uint16),
        pattern="MONO",
        black=(64.0,),
        white=1064,
        noise_profile=(1e-3, 1e-5),
    )
    part = make_spot_image(
        frame, amount_s=1.0, reading_deg=0.0, dark=np.full((4, 4), 0.02), flat=0.5
    )
    np.testing.assert_allclose(part.signal, 0.16, rtol=1e-6)
    np.testing.assert_allclose(part.variance, (1e-4 + 1e-5) / 0.25, rtol=1e-5)
