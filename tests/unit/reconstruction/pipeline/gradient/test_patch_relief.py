"""Relief and normals of a patch: blur undone, noise that belongs to no surface removed."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import fft

from reconstruction.gradient_normals import SphereLights
from reconstruction.normal_integration import Perspective
from reconstruction.normal_integration.lens_restoration import Aperture
from reconstruction.normal_maps import NormalMaps
from reconstruction.pipeline.gradient import patch_relief
from reconstruction.pipeline.gradient.patch_relief import PatchOptics, estimate_relief

SIDE, PIXEL_UM, NOISE = 160, 6.0, 0.03
INNER = np.s_[20:-20, 20:-20]
FREE = np.ones((SIDE, SIDE), bool)


def waves():
    return fft.fftfreq(SIDE, PIXEL_UM)[:, None], fft.fftfreq(SIDE, PIXEL_UM)[None]


def true_relief(rms_slope=0.08):
    """Return heights, um, and slopes of a periodic random relief with periods above 60 um."""
    rng = np.random.default_rng(5)
    y, x = waves()
    shape = np.exp(-(np.hypot(y, x) ** 2) * 50.0**2) * (np.hypot(y, x) > 1 / 400)
    height = fft.fft2(rng.standard_normal((SIDE, SIDE))) * shape
    parts = [fft.ifft2(height * factor).real for factor in (1.0, 2j * np.pi * x, 2j * np.pi * y)]
    height, right, down = (rms_slope / parts[1].std() * part for part in parts)
    return height, (right, -down)  # y up


def blurred(slopes):
    """Blur slopes by the lens, in a way of its own: a sum over waves."""
    y, x = waves()
    angle = 2 * np.arccos(np.minimum(np.hypot(y, x) * 17.9, 1.0))
    lens = (angle - np.sin(angle)) / np.pi * np.sinc(PIXEL_UM * x) * np.sinc(PIXEL_UM * y)
    return [fft.ifft2(fft.fft2(slope) * lens).real for slope in slopes]


def maps(slopes, noise=0.0, seed=1):
    rng = np.random.default_rng(seed)
    x, y = (slope + noise * rng.standard_normal(slope.shape) for slope in slopes)
    normals = np.stack([-x, -y, np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    flat = np.zeros(FREE.shape)
    stderr = np.full(FREE.shape, max(noise, 1e-4) * math.sqrt(2.0))
    return NormalMaps(normals, flat, flat, FREE, stderr)


def optics():
    z = 1.0 - (2.0 * np.arange(100) + 1.0) / 100
    turn = math.pi * (1.0 + math.sqrt(5.0)) * np.arange(100)
    across = np.sqrt(1.0 - z**2)
    lights = SphereLights(np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1))
    camera = Perspective(1e6, ((SIDE - 1) / 2, (SIDE - 1) / 2))
    return PatchOptics(PIXEL_UM, camera, Aperture(17.9, PIXEL_UM), lights, 0.25)


def estimate(slopes, noise=0.0, clear=None, skin=FREE):
    seen = blurred(slopes)
    sharp = maps(slopes if clear is None else clear, noise, seed=2)
    return estimate_relief(sharp, maps(seen, noise), maps(seen), skin, optics(), name="rest")


def tilt_error(found, true):
    """Return the root mean square difference of slopes inside, of both axes."""
    back = [-found[..., k] / found[..., 2] for k in (0, 1)]
    return float(np.sqrt(np.mean([(a - b)[INNER] ** 2 for a, b in zip(back, true, strict=True)])))


@pytest.fixture(scope="module")
def shallow():
    """Return a relief that hides hardly any light from itself, with its estimate."""
    height, slopes = true_relief()
    return height, slopes, estimate(slopes)


def test_relief_of_clear_normals_is_the_true_one(shallow):
    height, slopes, found = shallow
    error = (found.height() - height)[INNER]
    assert np.std(error) < 0.05 * np.std(height[INNER])
    lost = estimate(slopes, clear=blurred(slopes)).height()
    assert np.std((lost - height)[INNER]) > 0.1 * np.std(height[INNER])  # without the restoration


def test_normals_are_those_that_the_lens_resolves(shallow):
    _, slopes, found = shallow
    normals = found.seen_normals()
    assert np.linalg.norm(normals, axis=-1) == pytest.approx(np.ones(FREE.shape), abs=1e-6)
    assert tilt_error(normals, blurred(slopes)) < 0.05 * np.std(slopes)
    assert tilt_error(normals, slopes) > 0.1 * np.std(slopes)


def test_continuous_surface_halves_the_noise(shallow):
    """Half the variance of slopes' noise is along the crests of its waves, and of no surface.

    The lens's blur removes more: the noise of the normals that are compared is blurred alike.
    """
    _, slopes, clean = shallow
    noisy = estimate(slopes, NOISE).seen_normals()
    added = maps([np.zeros(FREE.shape)] * 2, NOISE, seed=2).normals
    white = [-added[..., k] / added[..., 2] for k in (0, 1)]
    known = clean.seen_normals()
    left = tilt_error(noisy, [-known[..., k] / known[..., 2] for k in (0, 1)])
    whole = math.sqrt(np.mean([slope[INNER] ** 2 for slope in blurred(white)]))
    assert left**2 == pytest.approx(0.5 * whole**2, rel=0.25)


def test_deep_grooves_are_corrected_for_hidden_light():
    _, slopes = true_relief(rms_slope=0.5)
    found = estimate(slopes).surface.height
    alone = patch_relief._integrate(maps(slopes).normals, FREE, np.full(FREE.shape, 1e-4), optics())
    assert np.std(np.diff(found)) > 1.01 * np.std(np.diff(alone.height))


def test_errors_of_heights_follow_those_of_normals(shallow):
    _, slopes, _ = shallow
    some, more = (estimate(slopes, noise).sample_errors() for noise in (NOISE, 2 * NOISE))
    assert np.median(more[0] / some[0]) == pytest.approx(2.0, rel=0.3)
    assert np.mean(more[1]) / np.mean(some[1]) == pytest.approx(4.0, rel=0.5)


def test_errors_without_pixels_are_zero(shallow):
    _, _, found = shallow
    none = dataclasses.replace(found.surface, valid=np.zeros_like(FREE))
    stderr, noise = dataclasses.replace(found, surface=none).sample_errors()
    assert np.isinf(stderr).all()
    assert not noise.any()


def test_skin_alone_has_relief(shallow):
    _, slopes, _ = shallow
    skin = FREE.copy()
    skin[:, 100:] = False
    assert (estimate(slopes, skin=skin).surface.valid == skin).all()
