"""Pixels of a face that are weighed by what all of them tell together."""

import numpy as np
import pytest
from twins import chromophores as chromophore_reference

from model import color_table
from model.tissue_optics import PAPER_CONSTANTS
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import posterior as chromophore_posterior
from reconstruction.chromophores import shading_prior
from reconstruction.chromophores.face import fit_face_distribution
from reconstruction.chromophores.face_distribution import ContaminatedNormal, FaceDistribution
from reconstruction.chromophores.inversion import ChromophoreError
from reconstruction.chromophores.model_error import add_brightness_variance
from reconstruction.chromophores.posterior import estimate
from reconstruction.chromophores.start import MIN_AXIS_FRACTION

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
    return shading_prior.face_prior(softness=shading_prior.MIN_SOFTNESS)


def face(table, prior, melanin, count, rng, spread=0.15):
    """Draw pixels of one face, lit as the prior says, as a camera sees them."""
    c_m = melanin * np.exp(spread * rng.standard_normal(count))
    c_hd = table.c_hd_max * rng.normal(0.4, 0.05, count) ** 3
    below = np.concatenate([[0.0], np.cumsum(prior.density)])
    edges = prior.low + prior.step * (np.arange(below.size) - 0.5)
    light = np.exp(np.interp(rng.uniform(0, below[-1], count), below, edges))
    clean = light[:, None] * table.lookup(c_m, c_hd)
    return c_m, c_hd, light, clean * (1.0 + NOISE * rng.standard_normal(clean.shape))


def known_face(table, melanin, spread, blood, blood_spread):
    ends = np.log(table.c_m_max * MIN_AXIS_FRACTION**3), np.log(table.c_m_max)
    return FaceDistribution(
        ContaminatedNormal(np.log(melanin), spread, 0.02, *ends),
        ContaminatedNormal(blood, blood_spread, 0.04, MIN_AXIS_FRACTION, 1.0),
    )


@pytest.mark.long
def test_face_kernel_sum_matches_plain_numpy(table, prior, rng):
    """Narrow and wide faces, of the pixels' skin and of darker skin; two skins are possible.

    Against a grid twice as fine the plain sum errs by 0.002 of a width, and 2 % of the width.
    """
    melanin = np.repeat([0.006, 0.03, 0.09, 0.17, 0.45], 3)
    light = np.tile([0.9, 0.2, 0.6], 5)
    rgb = light[:, None] * table.lookup(melanin, np.tile([0.018, 0.03, 0.025], 5))
    rgb *= 1.0 + NOISE * rng.standard_normal(rgb.shape)
    covariance = add_brightness_variance(1e-12 * np.eye(3)) + NOISE**2 * np.eye(3)
    covariance += chromophore_posterior.MIN_RELATIVE_NOISE**2 * np.eye(3)
    for k in range(5):
        here = slice(3 * k, 3 * k + 3)
        true = melanin[3 * k]
        for known in (
            known_face(table, true, 0.06, 0.39, 0.03),
            known_face(table, min(1.3 * true, 0.49), 0.15, 0.4, 0.05),
            known_face(table, true, 0.3, 0.4, 0.12),
        ):
            found = estimate(
                rgb[here], table, prior=prior, face=known, variance=(NOISE * rgb[here]) ** 2
            )
            slow = np.array(
                [
                    chromophore_reference.estimate(
                        color, table, covariance, prior, face=known, size=(600, 150)
                    )
                    for color in rgb[here]
                ]
            )
            for i, (center, reach) in enumerate(
                ((found.melanin, found.stderr_melanin), (found.hemoglobin, found.stderr_hemoglobin))
            ):
                assert np.abs((center - slow[:, i, 0]) / slow[:, i, 1]).max() < 0.1
                np.testing.assert_allclose(reach, slow[:, i, 1], rtol=0.12)


@pytest.mark.long
@pytest.mark.parametrize("melanin", [0.01, 0.09])
def test_shade_is_not_taken_for_darker_skin(melanin, table, prior, rng):
    """The dimmest fifth is held as the rest is, and errs less than by its pixels alone.

    1000 pixels of a fifth: binomial standard error 0.015, 4 of them 0.06; the common error of the
    light, which is 0 here, widens.
    """
    true, _, light, rgb = face(table, prior, melanin, 5000, rng)
    given = {"prior": prior, "variance": (NOISE * rgb) ** 2}
    known = fit_face_distribution(rgb, table, common_light=0.02, **given)
    # standard errors of 1500 pixels, dark ones with errors of a third: 0.01; of the spread 0.02
    assert abs(known.melanin.mean - np.log(melanin)) < 0.04
    assert abs(known.melanin.sd - 0.15) < 0.05
    assert abs(known.blood.mean - 0.4) < 0.03
    dim = light < np.quantile(light, 0.2)
    together, alone = (estimate(rgb, table, face=one, **given) for one in (known, None))
    off = np.abs(together.melanin - true) / together.stderr_melanin
    assert 0.62 < (off < 1.0).mean() < 0.76
    assert 0.60 < (off[dim] < 1.0).mean() < 0.78
    assert (off < 0.5).mean() < 0.5
    error = [np.median(np.abs(found.melanin / true - 1.0)[dim]) for found in (together, alone)]
    assert error[0] < error[1] * (0.8 if melanin > 0.04 else 1.05)


def test_a_mole_in_good_light_keeps_its_melanin(table, prior, rng):
    """3 times the melanin of the face, 1 % of it: as by itself, and no more sure."""
    true, _, _, rgb = face(table, prior, 0.02, 4000, rng)
    true[:40] = 0.06
    rgb[:40] = 0.9 * table.lookup(0.06, 0.02) * (1.0 + NOISE * rng.standard_normal((40, 3)))
    given = {"prior": prior, "variance": (NOISE * rgb) ** 2}
    known = fit_face_distribution(rgb, table, common_light=0.1, **given)
    found = estimate(rgb, table, face=known, **given)
    assert np.median(np.abs(found.melanin[:40] / 0.06 - 1.0)) < 0.12
    inside = np.abs(found.melanin - true)[:40] < 2.5 * found.stderr_melanin[:40]
    assert inside.mean() > 0.85


@pytest.mark.long
def test_common_light_uncertainty_widens_face_error(table, prior, rng):
    """20 % more light on all of a dark face moves its mean by what its error then says."""
    _, _, _, rgb = face(table, prior, 0.15, 2000, rng)
    gain, common = 1.2, np.log(1.2)
    given = {"table": table, "prior": prior}
    sure = fit_face_distribution(rgb, common_light=0.01, variance=(NOISE * rgb) ** 2, **given)
    unsure = fit_face_distribution(rgb, common_light=common, variance=(NOISE * rgb) ** 2, **given)
    brighter = fit_face_distribution(
        gain * rgb, common_light=0.01, variance=(NOISE * gain * rgb) ** 2, **given
    )
    moved = abs(brighter.melanin.mean - sure.melanin.mean)
    assert moved > 0.03
    assert 0.5 * moved < unsure.melanin.stderr < 2.0 * moved
    assert sure.melanin.stderr < 0.3 * unsure.melanin.stderr


@pytest.mark.long
def test_common_color_error_widens_face_error(table, prior, rng):
    _, _, _, rgb = face(table, prior, 0.01, 2000, rng)
    given = {"prior": prior, "common_light": 0.01, "variance": (NOISE * rgb) ** 2}
    plain = fit_face_distribution(rgb, table, **given)
    off = 0.003 * np.array([-0.4, -0.4, 0.8])  # towards less melanin
    common = fit_face_distribution(rgb, table, common_color=np.outer(off, off), **given)
    tinted = fit_face_distribution(rgb * np.exp(off), table, **given)
    moved = abs(tinted.melanin.mean - plain.melanin.mean)
    assert common.melanin.stderr == pytest.approx(np.hypot(moved, plain.melanin.stderr), rel=0.3)
    assert common.melanin.stderr > 2.0 * plain.melanin.stderr


def test_few_pixels_are_not_face(table, prior, rng):
    _, _, _, rgb = face(table, prior, 0.05, 150, rng)
    assert fit_face_distribution(rgb, table, prior=prior, common_light=0.1) is None
    assert (
        fit_face_distribution(np.full((900, 3), np.nan), table, prior=prior, common_light=0.1)
        is None
    )
    with pytest.raises(ChromophoreError, match="common_light"):
        fit_face_distribution(rgb, table, prior=prior, common_light=0.0)
    with pytest.raises(ChromophoreError, match="rgb"):
        fit_face_distribution(rgb[:, :2], table, prior=prior, common_light=0.1)
