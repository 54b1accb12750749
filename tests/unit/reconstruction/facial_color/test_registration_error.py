"""Color errors due to the registration of two images."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates, shift

from model import color_table
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import shading_prior
from reconstruction.correspondence.expression_alignment import Alignment
from reconstruction.facial_color import registration_error as misplacement
from reconstruction.facial_color import shared_melanin
from reconstruction.registration import dense_flow

SIZE = 96


def laid_over(error_px, size=SIZE):
    rows, columns = np.indices((size, size))
    everywhere = np.ones((size, size), bool)
    return Alignment(
        np.stack([columns, rows], axis=-1).astype(np.float32),
        everywhere,
        np.full((size, size), error_px, np.float32),
        np.zeros((size, size), np.float32),
        everywhere,
        0.0,
        {},
        0.0,
        "landmarks",
        (size, size),
    )


def skin(rng, size=SIZE):
    texture = gaussian_filter(rng.standard_normal((size, size)), 1.5, mode="wrap")
    texture *= 0.05 / texture.std()
    return np.exp(texture[..., None] * np.array([0.5, 1.0, 1.4])) * [0.5, 0.3, 0.2]


def test_brightness_error_is_slope_times_position_error(rng):
    """A ramp of brightness: slope squared times the variance along its axis."""
    columns = np.indices((SIZE, SIZE))[1]
    rgb = np.exp(0.02 * columns)[..., None] * np.array([0.3, 0.2, 0.1])
    found = misplacement.registration_covariance(
        rgb, 0.0 * rgb, np.ones((SIZE, SIZE), bool), laid_over(0.4)
    )
    # at borders pixels have fewer neighbors along one axis than along the other
    np.testing.assert_allclose(found[8:-8, 8:-8], 0.02**2 * 0.4**2 / 2, rtol=1e-4)


def test_uniform_light_slope_is_not_error_when_tracked(rng):
    """A ramp with texture on it: with the window of `light_change` texture alone errs.

    The texture is finer than 3 px; of a Gaussian of 1 px slopes less their mean over 3 px keep
    more than 90 % of their square.
    """
    columns = np.indices((SIZE, SIZE))[1]
    texture = 0.01 * gaussian_filter(rng.standard_normal((SIZE, SIZE)), 1.0)
    everywhere, inside = np.ones((SIZE, SIZE), bool), slice(12, -12)

    def error(log_light, window_px):
        rgb = np.exp(log_light)[..., None] * np.array([0.3, 0.2, 0.1])
        found = misplacement.registration_covariance(
            rgb, 0.0 * rgb, everywhere, laid_over(0.4), light_window_px=window_px
        )
        return found[inside, inside].mean()

    ramp, fine = error(0.02 * columns, None), error(texture, None)
    assert error(0.02 * columns, 3.0) < 1e-6 * ramp
    assert 0.9 * fine < error(texture + 0.02 * columns, 3.0) < 1.01 * fine


@pytest.mark.parametrize("window_px", [0.0, -1.0, np.nan, np.inf])
def test_invalid_window_is_refused_by_name(window_px):
    rgb = np.ones((SIZE, SIZE, 3))
    with pytest.raises(ValueError, match="light_window_px"):
        misplacement.registration_covariance(
            rgb, 0.0 * rgb, np.ones((SIZE, SIZE), bool), laid_over(0.4), light_window_px=window_px
        )


def test_tracked_light_leaves_stated_brightness_covariance(rng):
    """Truth: one smooth misplacement of a shaded, textured skin, whose light `light_change` would
    average over 3 px. What is left of the difference is the stated covariance, to 30 % for the
    bends of the texture between pixels and of the place within the window."""
    texture = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 1.2, mode="wrap")
    texture *= 0.03 / texture.std()
    rows, columns = np.indices((SIZE, SIZE))
    log_light = texture + 0.6 * np.sin(2 * np.pi * columns / SIZE)
    stated, squares = 0.3, []
    for _ in range(40):
        field = gaussian_filter(rng.standard_normal((2, SIZE, SIZE)), (0, 8, 8), mode="wrap")
        field *= stated / np.sqrt(2.0) / field.std(axis=(1, 2), keepdims=True)
        moved = map_coordinates(
            log_light, [rows + field[0], columns + field[1]], order=3, mode="grid-wrap"
        )
        off = moved - log_light
        squares.append(np.square(off - gaussian_filter(off, 3.0, mode="wrap")))
    rgb = np.exp(log_light)[..., None] * np.ones(3)
    told, denied = (
        misplacement.registration_covariance(
            rgb, 0.0 * rgb, np.ones((SIZE, SIZE), bool), laid_over(stated), light_window_px=window
        )[12:-12, 12:-12, 0, 0].mean()
        for window in (3.0, None)
    )
    seen = np.mean(squares, axis=0)[12:-12, 12:-12].mean()
    assert told == pytest.approx(seen, rel=0.3)
    assert denied > 1.5 * seen


@pytest.mark.long
def test_shifted_image_differences_match_stated_covariance(rng):
    """Shifts drawn with the stated error; brightness once, colors `SCALE` times; 25 % for the
    bend of the texture between pixels and for 200 shifts."""
    rgb, stated = skin(rng), 0.3
    everywhere = np.ones((SIZE, SIZE), bool)
    covariance = misplacement.registration_covariance(rgb, 0.0 * rgb, everywhere, laid_over(stated))
    squares = np.zeros((3, 3))
    for _ in range(200):
        by = rng.normal(0.0, stated / np.sqrt(2.0), 2)
        moved = shift(np.log(rgb), (*by, 0), order=3, mode="grid-wrap")
        off = (moved - np.log(rgb)).reshape(-1, 3)
        squares += off.T @ off / len(off) / 200
    brightness = np.ones(3) / 3.0
    told = covariance.mean(axis=(0, 1))
    assert brightness @ told @ brightness == pytest.approx(
        brightness @ squares @ brightness, rel=0.25
    )
    color = np.array([1.0, 0.0, -1.0])
    assert color @ told @ color == pytest.approx(
        misplacement.MOTION_VARIANCE_SCALE * color @ squares @ color, rel=0.25
    )


def test_noise_is_not_slope_masked_pixels_are_ignored(rng):
    rgb = np.broadcast_to([0.5, 0.3, 0.2], (SIZE, SIZE, 3))
    noise = 0.02 * rgb
    noisy = rgb + noise * rng.standard_normal(rgb.shape)
    valid = np.ones((SIZE, SIZE), bool)
    valid[:, 40:] = False
    wild = np.where(valid[..., None], noisy, np.nan)
    told = misplacement.registration_covariance(wild, noise**2, valid, laid_over(0.5))
    denied = misplacement.registration_covariance(wild, 0.0 * noise, valid, laid_over(0.5))
    assert np.isfinite(told).all()
    assert not told[:, 40:].any()
    # what is left of it by chance is positive: directions below 0 are 0
    assert np.trace(told[:, :40].mean(axis=(0, 1))) < 0.35 * np.trace(
        denied[:, :40].mean(axis=(0, 1))
    )
    assert np.linalg.eigvalsh(told).min() > -1e-9


def test_misplaced_face_coverage_requires_registration_error(rng):
    """Two pictures of one skin, the second 0.35 px off along each axis; true change 0.

    Expected: at least the 68 % of the interval, less 8 for the texture of one face; without the
    error of place far less.
    """
    table = color_table.build(
        "Nikon 5100 (NPL)", "D55", anisotropy=ANISOTROPY_SKIN, exact_optics=True
    )
    blood = 0.03 * np.exp(0.25 * _texture(rng))
    melanin = 0.015 * np.exp(0.15 * _texture(rng))
    clean = 0.7 * table.lookup(melanin, blood)
    moved = shift(clean, (0.35, 0.35, 0), order=3, mode="grid-wrap")
    rgb = np.stack([clean, moved])
    rgb *= 1.0 + 5e-4 * rng.standard_normal(rgb.shape)
    variance = (5e-4 * np.stack([clean, moved])) ** 2
    place = misplacement.registration_covariance(
        rgb[1], variance[1], np.ones((SIZE, SIZE), bool), laid_over(0.35 * np.sqrt(2.0))
    )
    shares = []
    for own in (np.stack([0.0 * place, place]), None):
        found = shared_melanin.estimate_shared_melanin(
            rgb,
            table,
            prior=shading_prior.face_prior(),
            variance=variance,
            state_covariance=own,
            shading_window_px=shared_melanin.SHADING_WINDOW_PX,
        )
        good = found.valid_states[1] & ~found.is_misfit[1]
        shares.append(np.mean(np.abs(found.change[1]) < found.stderr_change[1], where=good))
    assert shares[0] > 0.6
    assert shares[1] < shares[0] - 0.1


def _texture(rng):
    texture = gaussian_filter(rng.standard_normal((SIZE, SIZE)), 1.2, mode="wrap")
    return texture / texture.std()


@pytest.mark.parametrize("along", [(0.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.3, 0.8)])
def test_interpolated_noise_matches_stated_noise(rng, along):
    """Against noise that OpenCV interpolates; 3 % is 4 sigma of 40 000 pixels that share some."""
    noise = rng.standard_normal((200, 200)).astype(np.float32)
    at = dense_flow.pixel_grid((200, 200)) + np.asarray(along, np.float32)
    seen = dense_flow.sample_image(noise, at, interpolation=2)[5:-5, 5:-5]
    told = dense_flow.interpolated_noise_variance(at)[5:-5, 5:-5]
    assert seen.var() == pytest.approx(float(told.mean()), rel=0.05)
