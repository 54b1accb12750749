import numpy as np
import pytest
from twins import chromophores as chromophore_reference

from model import color_table
from model.tissue_optics import PAPER_CONSTANTS
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import model_error, shading_prior
from reconstruction.chromophores.inversion import ChromophoreError, invert
from reconstruction.chromophores.model_error import add_brightness_variance
from reconstruction.chromophores.posterior import estimate
from reconstruction.chromophores.shading_prior import lognormal_prior

NOISE = 0.004


@pytest.fixture(scope="module")
def table():
    return color_table.build(
        "Nikon 5100 (NPL)",
        "D55",
        anisotropy=ANISOTROPY_SKIN,
        constants=PAPER_CONSTANTS,
        exact_optics=True,
    )


@pytest.fixture(scope="module")
def prior():
    return shading_prior.face_prior()


def skin(rng, count, prior):
    """Draw skin as the prior says that it is: C_m log-uniform, cube root of C_hd uniform."""
    c_m = np.exp(rng.uniform(np.log(0.004), np.log(0.45), count))
    c_hd = rng.uniform(0.15, 0.6, count) ** 3 * 0.32
    below = np.concatenate([[0.0], np.cumsum(prior.density)])
    edges = prior.low + prior.step * (np.arange(below.size) - 0.5)
    shading = np.exp(np.interp(rng.uniform(0, below[-1], count), below, edges))
    return c_m, c_hd, shading


def seen(table, c_m, c_hd, shading, rng, noise=NOISE):
    clean = shading[:, None] * table.lookup(c_m, c_hd)
    return clean * (1.0 + noise * rng.standard_normal(clean.shape))


@pytest.mark.long
def test_kernel_sum_matches_plain_numpy_over_dense_plane(table, prior, rng):
    c_m, c_hd, shading = skin(rng, 10, prior)
    # down to skin whose blood nobody can see, and up to where melanin has two solutions
    c_m[:4], c_hd[:4], shading[:4] = [0.06, 0.09, 0.15, 0.45], [0.01, 0.1, 0.02, 0.06], 1.0
    noise = 0.006
    rgb = seen(table, c_m, c_hd, shading, rng, noise)
    found = estimate(
        rgb,
        table,
        prior=prior,
        variance=(noise * rgb) ** 2,
        model_error=model_error.load_covariance(),
    )
    covariance = add_brightness_variance(
        model_error.load_covariance() + 1e-12 * np.eye(3)
    ) + noise**2 * np.eye(3)
    slow = np.array(
        [chromophore_reference.estimate(c, table, covariance, prior, size=(900, 300)) for c in rgb]
    )
    for k, (center, reach) in enumerate(
        ((found.melanin, found.stderr_melanin), (found.hemoglobin, found.stderr_hemoglobin))
    ):
        # in standard errors; the kernel's bins and the plane's cells are a twentieth of one
        assert np.abs((center - slow[:, k, 0]) / slow[:, k, 1]).max() < 0.1
        np.testing.assert_allclose(reach, slow[:, k, 1], rtol=0.1)


def test_intervals_cover_68_percent_of_prior_skin(table, prior, rng):
    # 12000 independent pixels: binomial standard error 0.0043; 4 of them are 0.017, the rest is for
    # bins and for blood that is drawn from a narrower range than the prior has (0.012 of 24000).
    c_m, c_hd, shading = skin(rng, 12_000, prior)
    rgb = seen(table, c_m, c_hd, shading, rng)
    found = estimate(rgb, table, prior=prior, variance=(NOISE * rgb) ** 2)
    covered = np.abs(found.melanin - c_m) <= found.stderr_melanin
    assert abs(covered.mean() - 0.683) < 0.03
    blood = np.abs(found.hemoglobin - c_hd) <= found.stderr_hemoglobin
    assert abs(blood.mean() - 0.683) < 0.03
    # a fit decides for one of two solutions, and its intervals are of that one
    dark = c_m > 0.1
    fitted = invert(rgb, table, variance=(NOISE * rgb) ** 2)
    alone = np.abs(fitted.melanin - c_m) <= fitted.stderr_melanin
    assert covered[dark].mean() > 0.6
    assert alone[dark].mean() < 0.3
    halved = np.abs(found.melanin - c_m) <= 0.5 * found.stderr_melanin
    assert halved.mean() < 0.5


def test_light_skin_gets_fit_estimate_and_error(table, prior, rng):
    c_m, c_hd = np.array([0.005, 0.01, 0.02, 0.03]), np.full(4, 0.05)
    rgb = 0.8 * table.lookup(c_m, c_hd)
    noise = (0.002 * rgb) ** 2
    found, fitted = (
        estimate(rgb, table, prior=prior, variance=noise),
        invert(rgb, table, variance=noise),
    )
    np.testing.assert_allclose(found.melanin, c_m, rtol=0.01)
    np.testing.assert_allclose(found.hemoglobin, c_hd, rtol=0.02)
    np.testing.assert_allclose(found.stderr_melanin, fitted.stderr_melanin, rtol=0.08)
    np.testing.assert_allclose(found.stderr_hemoglobin, fitted.stderr_hemoglobin, rtol=0.08)
    np.testing.assert_allclose(found.shading, 0.8, rtol=0.01)


def test_noise_free_estimate_is_true_within_percent(table, prior):
    c_m, c_hd = np.array([0.01, 0.02, 0.03]), np.array([0.03, 0.05, 0.08])
    rgb = 0.6 * table.lookup(c_m, c_hd)
    found = estimate(rgb, table, prior=prior, variance=(1e-5 * rgb) ** 2)
    np.testing.assert_allclose(found.melanin, c_m, rtol=2e-3)
    np.testing.assert_allclose(found.hemoglobin, c_hd, rtol=0.01)
    assert (found.stderr_melanin < 5e-3 * c_m).all()


def test_brightness_separates_dark_skin_from_dimmer_light_skin(table):
    c_m, c_hd = np.array([0.2, 0.35]), np.array([0.05, 0.05])
    rgb = table.lookup(c_m, c_hd)
    noise = (0.004 * rgb) ** 2
    rough = estimate(rgb, table, prior=lognormal_prior(1.0, 0.15), variance=noise)
    np.testing.assert_allclose(rough.melanin, c_m, rtol=0.25)
    free = invert(rgb, table, variance=noise)
    assert (free.melanin < 0.6 * c_m).all()  # what a fit without any knowledge of the light says


def test_two_solutions_give_error_covering_both_and_truth(table):
    truth = 0.12
    rgb = table.lookup([truth], [0.02])
    noise = (0.002 * rgb) ** 2
    lighter = invert(rgb, table, variance=noise)
    assert lighter.melanin[0] + 10.0 * lighter.stderr_melanin[0] < truth  # sure, and wrong
    both = estimate(rgb, table, prior=lognormal_prior(0.7, 1.0), variance=noise)
    assert abs(both.melanin[0] - truth) < both.stderr_melanin[0]
    assert both.stderr_melanin[0] > 10.0 * lighter.stderr_melanin[0]


@pytest.mark.parametrize("factor", [0.3, 1.0, 1.5])
def test_color_decides_for_light_skin_whatever_its_light(factor, table, rng):
    c_m, c_hd = np.array([0.01, 0.03]), np.array([0.05, 0.1])
    rgb = factor * table.lookup(c_m, c_hd)
    found = estimate(rgb, table, prior=lognormal_prior(0.7, 0.6), variance=(0.002 * rgb) ** 2)
    assert np.all(np.abs(found.melanin - c_m) < found.stderr_melanin)
    np.testing.assert_allclose(found.shading, factor, rtol=0.05)


def test_a_model_error_widens_the_interval(table, prior):
    rgb = 0.8 * table.lookup([0.02], [0.05])
    noise = (0.002 * rgb) ** 2
    alone = estimate(rgb, table, prior=prior, variance=noise)
    both = estimate(rgb, table, prior=prior, variance=noise, model_error=0.004)
    assert 1.8 < both.stderr_melanin[0] / alone.stderr_melanin[0] < 2.8  # sqrt(1 + 2^2) = 2.2


def test_unusable_pixels_are_masked_without_affecting_neighbors(table, prior):
    good = table.lookup(0.03, 0.05)
    rgb = np.array([[good, [np.nan, 0.2, 0.1], [0.3, -0.01, 0.1]], [good, good, [0.05, 0.1, 0.4]]])
    found = estimate(
        rgb, table, prior=prior, valid=np.array([[True, True, True], [True, False, True]])
    )
    assert found.valid.tolist() == [[True, False, False], [True, False, False]]
    assert found.outside[1, 2]
    assert np.isnan(found.melanin[0, 1])
    assert np.isfinite(found.stderr_hemoglobin[0, 0])
    assert estimate(np.empty((0, 3)), table, prior=prior).melanin.shape == (0,)
    with pytest.raises(ChromophoreError, match="model_error"):
        estimate(rgb, table, prior=prior, model_error=-1.0)


@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_unexpected_light_levels_leave_finite_numbers(scale, table, prior):
    c_m, c_hd = np.array([6e-5, 0.02, 0.45]), np.array([4e-5, 0.05, 0.3])
    rgb = scale * table.lookup(c_m, c_hd)
    found = estimate(rgb, table, prior=prior, variance=(0.01 * rgb) ** 2)
    for values in (found.melanin, found.hemoglobin, found.stderr_melanin, found.stderr_hemoglobin):
        assert np.isfinite(values).all()
        assert (values > 0).all()


def test_non_skin_by_own_errors_is_masked(prior):
    """White cloth in a photograph whose background is rough: the usual error passes anything."""
    table = color_table.build(
        "linear sRGB",
        "D65",
        anisotropy=ANISOTROPY_SKIN,
        constants=PAPER_CONSTANTS,
        exact_optics=True,
    )
    light = np.exp(np.linspace(np.log(0.05), np.log(2.0), 9))[:, None, None]
    cloth = light * [[1.0, 0.96, 0.99], [1.0, 1.0, 1.0], [0.6, 0.9, 1.0], [0.9, 0.5, 0.9]]
    face = light * table.lookup([0.01, 0.03, 0.1, 0.3], [0.03, 0.03, 0.03, 0.03])
    rgb = np.stack([cloth, face])
    fine, rough = 3e-5 * (3.0 * np.eye(3) - 1.0), 0.05 * (3.0 * np.eye(3) - 1.0)
    errors = np.broadcast_to(fine, (*rgb.shape[:-1], 3, 3)).copy()
    errors[1, ::2] = rough
    found = estimate(rgb, table, prior=prior, variance=(0.01 * rgb) ** 2, model_error=errors)
    assert found.outside[0].all()
    assert not found.valid[0].any()
    assert found.valid[1].all()
    for values in (found.melanin, found.shading, found.stderr_melanin, found.stderr_hemoglobin):
        assert np.isfinite(values[found.valid]).all()
        assert (values[found.valid] > 0).all()
    # by the mean of the pixels' errors all of this could be skin
    assert not invert(
        rgb, table, variance=(0.01 * rgb) ** 2, model_error=errors.mean(axis=(0, 1, 2))
    ).outside.any()
