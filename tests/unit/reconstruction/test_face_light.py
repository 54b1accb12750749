"""Light on a face's pixels: its level by brightness, its pattern by color, and its uncertainty."""

import dataclasses

import numpy as np
import pytest

from model import color_table
from model.color_table import with_exact_optics
from reconstruction.chromophores import shading_prior
from reconstruction.chromophores.face import estimate_face
from reconstruction.face_light import estimate_face_light

NOISE = 3e-3
SIDE = 48


@pytest.fixture(scope="module")
def table():
    return color_table.build("Nikon 5100 (NPL)", "D55")


def draw_light(rng):
    """Light of a face, drawn from the measured histogram; neighbors are alike."""
    prior = shading_prior.face_prior(softness=shading_prior.MIN_SOFTNESS)
    share = (np.cumsum(prior.density) - 0.5 * prior.density) * prior.step
    drawn = np.interp(rng.uniform(0.02, 0.98, SIDE * SIDE), share, prior.nodes)
    return np.sort(drawn).reshape(SIDE, SIDE)


def estimate(table, melanin, log_light, rng, *, off=0.0, has_white=True):
    """Estimate the light of colors whose optics are `off` the table's, relative per channel."""
    rgb = table.lookup(melanin, np.full_like(melanin, 0.012)) * np.exp(log_light[..., None] + off)
    rgb = (rgb * (1.0 + NOISE * rng.standard_normal(rgb.shape))).astype(np.float32)
    prior = shading_prior.face_prior()
    whole = estimate_face(
        rgb,
        table,
        prior=prior,
        variance=np.square(NOISE * rgb),
        model_error=np.zeros((3, 3)),
        has_white=has_white,
    )
    return whole, estimate_face_light(whole, rgb)


@pytest.mark.long
@pytest.mark.parametrize("typical", [0.012, 0.15])
def test_brightness_corrects_level_of_unknown_optics(table, typical):
    rng = np.random.default_rng(5)
    melanin = typical * np.exp(0.12 * rng.standard_normal((SIDE, SIDE)))
    truth = draw_light(rng)
    # one standard deviation of the tissue's optics, along their largest component
    covariance = table.log_covariance(np.array([typical]), np.array([0.012]))[0]
    values, axes = np.linalg.eigh(covariance)
    off = np.sqrt(values[-1]) * axes[:, -1]
    _, found = estimate(table, melanin, truth, rng, off=off)
    good = found.valid
    assert good.mean() > 0.8
    exact = estimate(with_exact_optics(table), melanin, truth, rng, off=off)[0]
    by_color = np.median(np.log(exact.by_face.shading[good]) - truth[good])
    by_brightness = np.median(found.log_light[good] - truth[good])
    assert abs(by_brightness) < 0.03
    assert abs(by_brightness) < max(0.5 * abs(by_color), 0.015)


@pytest.mark.long
def test_light_far_from_the_reference_is_within_interval(table):
    """Face positions and optics are drawn as assumed, so the coverage is nominal."""
    covered = []
    for seed in range(16):
        rng = np.random.default_rng([7, seed])
        melanin = 0.03 * np.exp(0.12 * rng.standard_normal((SIDE, SIDE)))
        level = shading_prior.LOG_SHADING_SOFTNESS * rng.standard_normal()
        covariance = table.log_covariance(np.array([0.03]), np.array([0.012]))[0]
        off = rng.multivariate_normal(np.zeros(3), covariance)
        truth = draw_light(rng) + level
        _, found = estimate(table, melanin, truth, rng, off=off)
        error = np.median((found.log_light - truth)[found.valid])
        covered.append(abs(error) <= found.common_log_sd)
    # binomial of 16 at 68 %: 6 to 15 contain 99.6 %
    assert 6 <= sum(covered) <= 15


def test_exact_optics_leave_only_errors_of_pixels(table):
    rng = np.random.default_rng(6)
    melanin = 0.015 * np.exp(0.12 * rng.standard_normal((SIDE, SIDE)))
    truth = draw_light(rng)
    _, found = estimate(with_exact_optics(table), melanin, truth, rng, has_white=False)
    assert found.common_log_sd == 0.0
    error = found.log_light[found.valid] - truth[found.valid]
    assert np.median(np.abs(error)) < 0.03


def test_image_without_skin_has_no_light(table):
    rng = np.random.default_rng(8)
    whole, _ = estimate(table, np.full((SIDE, SIDE), 0.03), draw_light(rng), rng)
    nothing = np.zeros((SIDE, SIDE), bool)
    blank = dataclasses.replace(whole, found=dataclasses.replace(whole.found, valid=nothing))
    found = estimate_face_light(blank, np.ones((SIDE, SIDE, 3)))
    assert not found.valid.any()
    assert not found.log_light.any()
