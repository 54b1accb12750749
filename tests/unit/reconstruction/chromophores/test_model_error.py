"""Estimates of the deviation of an image's colors from the model's."""

import tracemalloc

import numpy as np
import pytest

from model import color_table
from model.tissue_optics import PAPER_CONSTANTS
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import model_error
from reconstruction.chromophores.inversion import ChromophoreError
from reconstruction.chromophores.posterior import estimate
from reconstruction.chromophores.shading_prior import lognormal_prior

SIZE = 48


@pytest.fixture(scope="module")
def table():
    return color_table.build(
        "Nikon 5100 (NPL)",
        "D55",
        anisotropy=ANISOTROPY_SKIN,
        constants=PAPER_CONSTANTS,
        exact_optics=True,
    )


def picture(table, melanin=0.02, shading=1.0):
    color = table.lookup(np.full((SIZE, SIZE), melanin), np.full((SIZE, SIZE), 0.02))
    return color * np.broadcast_to(shading, (SIZE, SIZE))[..., None]


def everywhere():
    return np.ones((SIZE, SIZE), bool)


def test_cubic_shading_over_five_pixels_is_not_structure(table):
    rows, columns = np.indices((SIZE, SIZE)) / SIZE
    rgb = picture(table, shading=np.exp(-2.0 * rows**2 + columns**3))
    assert model_error.fine_structure(rgb, 0.0 * rgb, everywhere()).max() < 1e-20


def test_fine_structure_detects_pixel_texture_but_barely_coarse(table, rng):
    fine = picture(table, shading=np.exp(0.02 * rng.standard_normal((SIZE, SIZE))))
    rows, columns = np.indices((SIZE, SIZE))
    wave = np.sin(2 * np.pi * rows / 20) * np.sin(2 * np.pi * columns / 20)
    coarse = picture(table, shading=np.exp(0.04 * wave))
    found = [
        np.median(model_error.fine_structure(rgb, 0.0 * rgb, everywhere()))
        for rgb in (fine, coarse)
    ]
    # white texture of 2 %: 70 / 36 of its square
    assert found[0] == pytest.approx(70 / 36 * 0.02**2, rel=0.2)
    assert found[1] < 0.01 * found[0]


def test_noise_of_stated_variance_is_not_fine_structure(table, rng):
    """The mean over the picture is 0 within 4 standard errors, and is not if noise is denied."""
    rgb = picture(table)
    noisy = rgb * (1.0 + 0.01 * rng.standard_normal(rgb.shape))
    texture = rgb * np.exp(0.02 * rng.standard_normal((SIZE, SIZE)))[..., None]
    both = texture * (1.0 + 0.01 * rng.standard_normal(rgb.shape))
    with_noise = model_error.fine_structure(both, (0.01 * both) ** 2, everywhere()).mean()
    without = model_error.fine_structure(texture, 0.0 * rgb, everywhere()).mean()
    denied = model_error.fine_structure(both, 0.0 * rgb, everywhere()).mean()
    error = 70 / 36 * (0.02**2 + 0.01**2) * np.sqrt(2 * 2 / SIZE**2)
    assert abs(with_noise - without) < 4 * error < denied - without
    left = model_error.fine_structure(noisy, (0.01 * noisy) ** 2, everywhere())
    assert np.median(left) < 0.2 * 70 / 36 * 0.01**2


def test_non_skin_pixels_keep_only_transport_term(table, rng):
    rgb = picture(table, shading=np.exp(0.02 * rng.standard_normal((SIZE, SIZE))))
    valid = everywhere()
    valid[:, 20:] = False
    wild = rgb.copy()
    wild[:, 20:] = np.nan
    wild[:, 30:] = -1.0
    for other in (rgb, wild):
        found = model_error.image_covariance(other, 0.0 * rgb, valid)
        assert np.isfinite(found).all()
        np.testing.assert_allclose(
            found[:, 20:],
            np.broadcast_to(model_error.load_error_terms().transport, (SIZE, 28, 3, 3)),
        )
    assert np.median(found[:, :20, 0, 0]) > 1.5 * model_error.load_error_terms().transport[0, 0]


def test_interreflection_error_is_larger_on_light_skin(table):
    transport = model_error.load_error_terms().transport
    spreads = []
    for melanin in (0.006, 0.05, 0.4):
        rgb = picture(table, melanin)
        found = model_error.image_covariance(rgb, 0.0 * rgb, everywhere())[5, 5] - transport
        spreads.append(np.trace(found))
        # all of it is of the skin's own color, less brightness
        own = rgb[5, 5] - rgb[5, 5].mean()
        np.testing.assert_allclose(found @ own, np.trace(found) * own, rtol=1e-9, atol=1e-20)
    assert spreads[0] > 2 * spreads[1] > 4 * spreads[2]


def test_the_error_of_colors_has_no_brightness(table, rng):
    rgb = picture(table, shading=np.exp(0.03 * rng.standard_normal((SIZE, SIZE))))
    found = model_error.image_covariance(rgb, 0.0 * rgb, everywhere())
    size = np.trace(found, axis1=-2, axis2=-1)
    assert np.abs(found.sum(axis=-1)).max() < 1e-6 * size.max()
    assert np.linalg.eigvalsh(found).min() > -1e-9 * size.max()


def test_pixels_are_weighted_by_own_error(table):
    rgb = np.repeat(table.lookup([[0.01]], [[0.03]]), 2, axis=1)
    prior, variance = lognormal_prior(0.7, 0.6), (1e-3 * rgb) ** 2
    errors = np.stack([model_error.load_covariance(), 9.0 * model_error.load_covariance()])[None]
    found = estimate(rgb, table, prior=prior, variance=variance, model_error=errors)
    for k in range(2):
        alone = estimate(
            rgb[:, k], table, prior=prior, variance=variance[:, k], model_error=errors[0, k]
        )
        np.testing.assert_allclose(found.melanin[:, k], alone.melanin, rtol=1e-3)
        np.testing.assert_allclose(found.stderr_melanin[:, k], alone.stderr_melanin, rtol=1e-3)
    assert found.stderr_melanin[0, 1] > 1.5 * found.stderr_melanin[0, 0]


def test_pixel_covariance_errors_are_covered_doubled_ones_not(table, rng):
    """68 % of 2304 pixels within 4 sigma of a share, and 5 points for the bend of the table."""
    texture = np.where(np.arange(SIZE) < SIZE // 2, 0.005, 0.03)[None, :]
    rgb = picture(table, shading=np.exp(texture * rng.standard_normal((SIZE, SIZE))))
    covariance = model_error.image_covariance(rgb, 0.0 * rgb, everywhere())
    values, vectors = np.linalg.eigh(covariance)
    drawn = rng.standard_normal((SIZE, SIZE, 3)) * np.sqrt(np.maximum(values, 0.0))
    error = np.einsum("hwij,hwj->hwi", vectors, drawn)
    shares = []
    for factor in (1.0, 2.0):
        seen = rgb * np.exp(factor * error)
        found = estimate(
            seen,
            table,
            prior=lognormal_prior(1.0, 0.6),
            variance=(1e-4 * seen) ** 2,
            model_error=covariance,
        )
        inside = np.abs(found.melanin - 0.02) < found.stderr_melanin
        shares.append(inside.mean())
        if factor == 1.0:
            # in smooth and in textured skin alike
            halves = inside[:, : SIZE // 2].mean(), inside[:, SIZE // 2 :].mean()
            assert abs(halves[0] - halves[1]) < 0.12
    assert abs(shares[0] - 0.683) < 0.04 + 0.05
    assert shares[1] < 0.5


@pytest.mark.parametrize(
    "errors", [np.zeros((3, 3, 3)), np.full((4, 3, 3), np.nan), -np.ones((4, 3, 3))]
)
def test_mismatched_pixel_covariances_are_refused(table, errors):
    rgb = np.repeat(table.lookup([0.01], [0.03]), 4, axis=0)
    with pytest.raises(ChromophoreError, match="model_error"):
        estimate(rgb, table, prior=lognormal_prior(0.7, 0.6), variance=1e-6, model_error=errors)


@pytest.mark.parametrize("pixels", [1, SIZE, 7 * SIZE])
def test_banded_image_matches_whole_image_bit_exact(table, rng, monkeypatch, pixels):
    rgb = picture(table, shading=np.exp(0.05 * rng.standard_normal((SIZE, SIZE))))
    valid = rng.random((SIZE, SIZE)) < 0.95
    valid[:12, :12] = False
    valid[5, 5] = True  # with nothing near by: gets the mean of all
    whole = model_error.image_covariance(rgb, (0.01 * rgb) ** 2, valid)
    monkeypatch.setattr(model_error, "_BAND_PIXELS", pixels)
    np.testing.assert_array_equal(
        model_error.image_covariance(rgb, (0.01 * rgb) ** 2, valid), whole
    )
    assert np.ptp(whole[..., 0, 0]) > 0


def test_image_error_uses_little_memory_beyond_itself(table, rng):
    rgb = np.tile(picture(table), (12, 12, 1)).astype(np.float32)
    tracemalloc.start()
    found = model_error.image_covariance(rgb, (0.01 * rgb) ** 2, np.ones(rgb.shape[:2], bool))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2.0 * found.nbytes  # 2.5 times it when copies were made of the whole picture
