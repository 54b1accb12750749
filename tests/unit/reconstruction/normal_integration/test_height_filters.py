"""High-pass and denoising: transfers, borders, and that strength follows the noise."""

import numpy as np
import pytest

from reconstruction.normal_integration import slope_fields
from reconstruction.normal_integration.height_filters import denoise_slopes, high_pass
from reconstruction.normal_integration.integration import integrate, integrate_map
from reconstruction.normal_integration.relief_errors import expected_height_rms
from reconstruction.normal_integration.weighted_poisson import IntegrationError


def facing_with_noise(shape, sigma, rng):
    flat = np.broadcast_to([0.0, 0.0, 1.0], (*shape, 3))
    return flat + sigma / np.sqrt(2.0) * rng.standard_normal(flat.shape) * [1.0, 1.0, 0.0]


@pytest.mark.parametrize("cutoff", [20.0, 40.0, 80.0])
def test_the_transfer_is_that_of_the_gaussian_filter(cutoff):
    x = np.arange(320.0)
    wave = np.broadcast_to(np.cos(2 * np.pi * (x - 160) / 40.0), (320, 320))
    left = high_pass(wave, pixel=1.0, cutoff=cutoff)
    inner = slice(100, 220)
    expected = 1.0 - 2.0 ** (-((cutoff / 40.0) ** 2))
    np.testing.assert_allclose(left[inner, inner], expected * wave[inner, inner], atol=2e-4)


def disc_with_holes(side):
    y, x = np.mgrid[0:side, 0:side]
    disc = (x - side / 2) ** 2 + (y - side / 2) ** 2 < (0.45 * side) ** 2
    return disc & ((x - 40) ** 2 + (y - 45) ** 2 > 30)


@pytest.mark.long
@pytest.mark.parametrize("masked", [False, True])
def test_planes_vanish_to_border_and_bulges_nearly(masked):
    side = 120
    valid = disc_with_holes(side) if masked else None
    y, x = np.mgrid[0:side, 0:side].astype(float)
    plane = 3.0 * x - 2.0 * y + 500.0
    left = high_pass(plane, pixel=1.0, cutoff=30.0, valid=valid)
    assert np.abs(left).max() < 1e-8
    bulge = plane - 0.5 * ((x - 60) ** 2 + (y - 60) ** 2) / 100.0  # 36 px high
    left = high_pass(bulge, pixel=1.0, cutoff=30.0, valid=valid)
    assert np.abs(left).max() < 0.02 * 36.0


def test_filter_without_planes_would_fail_at_border():
    from scipy.ndimage import gaussian_filter

    plane = np.add.outer(np.zeros(120), 3.0 * np.arange(120.0))
    left = plane - gaussian_filter(plane, 0.18739 * 30.0, mode="nearest")
    assert np.abs(left).max() > 5.0


def test_parts_do_not_see_each_other():
    side = 60
    rng = np.random.default_rng(4)
    relief = rng.standard_normal((side, side))
    valid = np.ones((side, side), bool)
    valid[:, 30] = False
    shifted = relief.copy()
    shifted[:, 31:] += 1000.0
    a = high_pass(relief, pixel=1.0, cutoff=15.0, valid=valid)
    b = high_pass(shifted, pixel=1.0, cutoff=15.0, valid=valid)
    np.testing.assert_allclose(a, b, atol=1e-8)
    np.testing.assert_array_equal(a[~valid], 0.0)


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (2, 3)])
def test_narrow_images_are_filtered(shape):
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]].astype(float)
    left = high_pass(2.0 * x - y, pixel=1.0, cutoff=10.0)
    assert np.isfinite(left).all()
    assert np.abs(left).max() < 1e-6


def test_masked_values_do_not_matter():
    side = 50
    valid = disc_with_holes(side)
    relief = np.random.default_rng(1).standard_normal((side, side)).astype(np.float32)
    spoiled = np.where(valid, relief, np.nan).astype(np.float32)
    a = high_pass(np.where(valid, relief, 0), pixel=1.0, cutoff=9.0, valid=valid)
    b = high_pass(spoiled, pixel=1.0, cutoff=9.0, valid=valid)
    assert a.dtype == np.float32
    np.testing.assert_array_equal(a, b)


def test_filters_refuse_invalid_arguments():
    flat = np.zeros((4, 4))
    for call in (
        lambda: high_pass(flat, pixel=1.0, cutoff=0.0),
        lambda: high_pass(np.zeros(4), pixel=1.0, cutoff=1.0),
        lambda: high_pass(flat, pixel=1.0, cutoff=1.0, valid=np.ones((2, 2), bool)),
        lambda: denoise_slopes(slope_fields.from_normals(np.ones((4, 4, 3)))),
        lambda: denoise_slopes(
            slope_fields.from_normals(np.ones((4, 4, 3)), stderr_rad=0.1), sigma_px=9.0
        ),
    ):
        with pytest.raises(IntegrationError, match="got"):
            call()


def test_noise_is_smoothed_and_its_variance_estimated(rng):
    field = slope_fields.from_normals(facing_with_noise((150, 150), 0.02, rng), stderr_rad=0.02)
    smooth = denoise_slopes(field)
    ratio = smooth.gx.var() / field.gx.var()
    assert 1.0 / (4.0 * np.pi) < ratio < 0.2
    told = float(smooth.variance_x.mean() / field.variance_x.mean())
    # weights taken as given: tells at most a third of the variance too little
    assert 0.66 * ratio < told < 1.05 * ratio


def test_the_strength_follows_the_stated_noise(rng):
    normals = facing_with_noise((100, 100), 0.02, rng)
    left = [
        denoise_slopes(slope_fields.from_normals(normals, stderr_rad=sigma)).gx.var()
        for sigma in (0.002, 0.01, 0.02, 0.1)
    ]
    assert left == sorted(left, reverse=True)
    field = slope_fields.from_normals(normals, stderr_rad=0.0002)
    np.testing.assert_allclose(denoise_slopes(field).gx, field.gx, atol=1e-3 * 0.02)
    assert denoise_slopes(field, strength=0.0) is field


def test_slope_edge_is_kept_without_ringing(rng):
    sigma = 0.02
    slope = np.where(np.arange(80) < 40, -0.4, 0.5)
    n = np.stack([-slope, np.zeros(80), np.ones(80)], axis=-1)
    n = np.broadcast_to(n / np.linalg.norm(n, axis=-1, keepdims=True), (60, 80, 3))
    field = slope_fields.from_normals(n, stderr_rad=sigma)
    smooth = denoise_slopes(field)
    step = np.broadcast_to(slope, (60, 80))
    assert np.abs(smooth.gx - step).max() < 0.03 * 0.9
    assert smooth.gx.max() <= 0.5 + 1e-3
    assert smooth.gx.min() >= -0.4 - 1e-3


def test_denoised_slopes_give_a_better_height(rng):
    sigma = 0.1
    y, x = np.mgrid[0:160, 0:160].astype(float)
    truth = 2.0 * np.sin(x / 16.0) * np.cos(y / 20.0)
    right, down = np.cos(x / 16.0) * np.cos(y / 20.0) / 8, -np.sin(x / 16.0) * np.sin(y / 20.0) / 10
    n = np.stack([-right, down, np.ones_like(x)], axis=-1)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    noisy = n + sigma / np.sqrt(2.0) * rng.standard_normal(n.shape)

    def error(height):
        return np.std(high_pass(height - truth, pixel=1.0, cutoff=20.0))

    plain = integrate(noisy, stderr_rad=sigma)
    smooth = integrate_map(noisy, stderr_rad=sigma, denoise=1.0).height
    assert error(smooth) < 0.95 * error(plain)


@pytest.mark.parametrize("cutoff", [None, 100.0])
def test_errors_of_height_are_those_of_repeated_noise(cutoff, rng):
    shape, sigma, pixel = (96, 128), 0.02, 6.0
    squares = []
    for _ in range(12):
        height = integrate(facing_with_noise(shape, sigma, rng), pixel=pixel)
        if cutoff is not None:
            height = high_pass(height, pixel=pixel, cutoff=cutoff)
        squares.append(np.mean(height**2))
    found = np.sqrt(np.mean(squares))
    chance = 0.5 * np.std(squares) / np.sqrt(12) / np.mean(squares)  # relative, one sigma
    spectral = expected_height_rms(shape, sigma / np.sqrt(2.0), pixel=pixel, cutoff=cutoff)
    # 4 sigma of 12 draws (Student: 1 in 500); borders add up to 3 % behind a high-pass
    assert spectral == pytest.approx(found, rel=4 * chance + (0.03 if cutoff else 0.01))
