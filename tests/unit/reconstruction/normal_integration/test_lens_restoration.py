"""Slopes that a lens has blurred, given back as far as noise allows."""

import numpy as np
import pytest
from scipy import fft

from reconstruction.normal_integration.lens_restoration import (
    Aperture,
    RestorationError,
    restore_normals,
)

SIDE = 192
LENS = Aperture(17.9, 6.0)


def bumps(seed=0, correlation_px=5.0, slope=0.15):
    """Return slopes of a random relief with waves of about 6 correlation lengths, both axes."""
    rng = np.random.default_rng(seed)
    fy, fx = fft.fftfreq(SIDE)[:, None], fft.fftfreq(SIDE)[None]
    shape = np.exp(-0.5 * (2 * np.pi * correlation_px * np.hypot(fx, fy)) ** 2)
    height = fft.ifft2(fft.fft2(rng.standard_normal((SIDE, SIDE))) * shape)
    x = fft.ifft2(fft.fft2(height) * 2j * np.pi * fx).real
    y = fft.ifft2(fft.fft2(height) * 2j * np.pi * fy).real
    return slope * x / x.std(), slope * y / y.std()


def seen(slopes, noise, seed=1):
    """Blur slopes by the lens, in a way of its own: a sum over waves; add white noise."""
    rng = np.random.default_rng(seed)
    fy, fx = fft.fftfreq(SIDE, 6.0)[:, None], fft.fftfreq(SIDE, 6.0)[None]
    radius = np.minimum(np.hypot(fx, fy) * 17.9, 1.0)
    angle = 2 * np.arccos(radius)
    through = (angle - np.sin(angle)) / np.pi * np.sinc(6 * fx) * np.sinc(6 * fy)
    return [
        fft.ifft2(fft.fft2(s) * through).real + noise * rng.standard_normal(s.shape) for s in slopes
    ]


def normals_of(slopes):
    n = np.stack([-slopes[0], -slopes[1], np.ones_like(slopes[0])], axis=-1)
    return n / np.linalg.norm(n, axis=-1, keepdims=True)


def slope_error(found, true):
    inner = np.s_[24:-24, 24:-24]
    back = [-found.normals[..., k] / found.normals[..., 2] for k in (0, 1)]
    return float(
        np.sqrt(np.mean([np.mean((a - b)[inner] ** 2) for a, b in zip(back, true, strict=True)]))
    )


ALL = np.ones((SIDE, SIDE), bool)


def test_waves_that_the_lens_weakens_come_back():
    true = bumps()
    blurred = seen(true, 1e-4)
    left = slope_error(restore_normals(normals_of(blurred), lens=LENS, valid=ALL), true)
    inner = np.s_[24:-24, 24:-24]
    lost = np.sqrt(np.mean((blurred[0] - true[0])[inner] ** 2))
    assert left < 0.2 * lost


def test_the_wrong_lens_gives_less_back():
    true = bumps()
    pictured = normals_of(seen(true, 1e-3))
    right = slope_error(restore_normals(pictured, lens=LENS, valid=ALL), true)
    wrong = slope_error(restore_normals(pictured, lens=Aperture(13.0, 6.0), valid=ALL), true)
    assert right < 0.7 * wrong


def test_noise_is_estimated_beyond_lens_cutoff():
    found = restore_normals(normals_of(seen(bumps(slope=0.05), 0.02)), lens=LENS, valid=ALL)
    # about 9,000 independent powers beyond the cutoff: 1 % scatter; normals bend slopes by < 1 %
    assert found.noise == pytest.approx(0.02, rel=0.05)
    assert found.kept_noise < found.noise


def test_sampled_errors_match_those_of_the_restored_slopes():
    """Noise that passes the filter and relief that does not; noise alone is less.

    A fraction of signal scatters above 0 where there is none, so that errors may be 1.5 times.
    """
    true = bumps(correlation_px=2.5)
    found = restore_normals(normals_of(seen(true, 0.05)), lens=LENS, valid=ALL)
    drawn = found.sample_errors(np.random.default_rng(5))
    left = slope_error(found, true)
    assert 0.95 * left < np.std(drawn) < 1.5 * left
    assert found.kept_noise < left


def test_a_flat_patch_stays_flat():
    flat = normals_of([np.zeros((SIDE, SIDE))] * 2)
    found = restore_normals(flat, lens=LENS, valid=ALL)
    assert np.array_equal(found.normals, flat)


def test_pure_noise_is_omitted():
    rng = np.random.default_rng(2)
    noise = [0.05 * rng.standard_normal((SIDE, SIDE)) for _ in range(2)]
    found = restore_normals(normals_of(noise), lens=LENS, valid=ALL)
    assert slope_error(found, [np.zeros((SIDE, SIDE))] * 2) < 0.5 * 0.05


def test_a_mean_tilt_is_kept():
    x, y = bumps()
    found = restore_normals(normals_of([x + 0.2, y - 0.1]), lens=LENS, valid=ALL)
    slopes = [-found.normals[..., k] / found.normals[..., 2] for k in (0, 1)]
    assert np.mean(slopes[0]) == pytest.approx(0.2, abs=2e-3)
    assert np.mean(slopes[1]) == pytest.approx(-0.1, abs=2e-3)


def test_invalid_pixels_get_upright_normals():
    valid = ALL.copy()
    valid[40:60, 40:60] = False
    found = restore_normals(normals_of(bumps()), lens=LENS, valid=valid)
    assert (found.normals[~valid] == (0.0, 0.0, 1.0)).all()


@pytest.mark.parametrize(
    ("lens", "valid", "words"), [(Aperture(17.9, 30.0), ALL, "pixel_um"), (LENS, ~ALL, "valid")]
)
def test_invalid_restoration_input_is_refused(lens, valid, words):
    with pytest.raises(RestorationError, match=words):
        restore_normals(normals_of(bumps()), lens=lens, valid=valid)
