"""Optics common to a face: its melanin and blood with calibrated errors, better than by color."""

import numpy as np
import pytest

from model import color_table
from reconstruction.chromophores.common_optics import FACE_BLOOD_LOG_SD, estimate_common_optics
from reconstruction.chromophores.face import estimate_face
from reconstruction.chromophores.pixel_checks import ChromophoreError
from reconstruction.chromophores.shading_prior import lognormal_prior
from reconstruction.chromophores.table_fit.fitting import POPULATION_BLOOD, POPULATION_MELANIN

COMMON_LIGHT = 0.1
PRIOR = lognormal_prior(0.7, 0.4)
FALSE_ALARM = 1e-3
"""Probability that a right estimator fails one of the tests of coverage."""


@pytest.fixture(scope="module")
def table():
    return color_table.build("Nikon 5100 (NPL)", "D55")


def draw_face(table, rng, *, pixels=60):
    """Return colors, log melanin and log blood of a face drawn from all the priors."""
    melanin = np.clip(POPULATION_MELANIN * np.exp(rng.standard_normal()), 1e-3, 0.4)
    blood = np.clip(
        POPULATION_BLOOD * np.exp(FACE_BLOOD_LOG_SD * rng.standard_normal()), 5e-4, 0.25
    )
    optics = rng.multivariate_normal(np.zeros(3), table.log_covariance(melanin, blood))
    light = PRIOR.mean + COMMON_LIGHT * rng.standard_normal()
    each = light + 0.4 * rng.standard_normal((pixels, 1))
    each += light - np.median(each)  # the median is the common light
    rgb = table.lookup(melanin, blood) * np.exp(optics + each)
    return rgb.astype(np.float32), np.log(melanin), np.log(blood)


@pytest.mark.long
def test_intervals_of_drawn_faces_cover_nominally(table, rng):
    """Over 300 faces the count within one half-width is binomial about 68 %.

    Medians of pixels are not those of the face's posterior, so the band is that of 60 to 76 %
    widened by the sampling error.
    """
    faces, inside, narrow = 300, np.zeros(2), np.zeros(2)
    for _ in range(faces):
        rgb, log_melanin, log_blood = draw_face(table, rng)
        found = estimate_common_optics(rgb, table, prior=PRIOR, common_light=COMMON_LIGHT)
        plain = rgb * np.exp(-found.log_color)
        exact = color_table.with_exact_optics(table)
        fitted = estimate_face(
            plain,
            exact,
            prior=PRIOR,
            variance=(1e-3 * plain) ** 2,
            model_error=1e-8 * np.eye(3),
            has_white=False,
        ).found
        for k, (values, truth, half_width) in enumerate(
            (
                (fitted.melanin, log_melanin, found.melanin_half_width),
                (fitted.hemoglobin, log_blood, found.blood_half_width),
            )
        ):
            off = abs(np.exp(truth) / np.median(values) - 1.0)
            inside[k] += off < half_width
            narrow[k] += off < 0.5 * half_width
    sampling = 3.3 * np.sqrt(0.68 * 0.32 / faces)
    assert ((inside / faces > 0.60 - sampling) & (inside / faces < 0.76 + sampling)).all()
    assert (narrow / faces < 0.60 - sampling).all()


@pytest.mark.long
def test_known_light_separates_optics_from_pigment(table, rng):
    """Melanin of 100 faces errs less than where color alone estimates it."""
    errors = {True: [], False: []}
    for _ in range(100):
        rgb, log_melanin, _ = draw_face(table, rng)
        for weighted in (True, False):
            found = estimate_face(
                rgb,
                table if weighted else color_table.with_exact_optics(table),
                prior=PRIOR,
                variance=(1e-3 * rgb) ** 2,
                model_error=1e-8 * np.eye(3),
                has_white=True,
            ).found
            errors[weighted].append(abs(np.log(np.median(found.melanin)) - log_melanin))
    assert np.mean(errors[True]) < 0.8 * np.mean(errors[False])


def test_face_of_model_optics_has_small_error(table):
    rgb = 0.7 * table.lookup(np.full(50, POPULATION_MELANIN), POPULATION_BLOOD)
    found = estimate_common_optics(rgb, table, prior=PRIOR, common_light=COMMON_LIGHT)
    assert np.abs(found.log_color).max() < 0.03
    assert 0.1 < found.melanin_half_width < 0.5


def test_exact_optics_have_no_common_error(table):
    exact = color_table.with_exact_optics(table)
    rgb = 0.7 * table.lookup(np.full(50, 0.03), 0.01)
    assert estimate_common_optics(rgb, exact, prior=PRIOR, common_light=0.1) is None
    dark = np.full((50, 3), np.nan)
    assert estimate_common_optics(dark, table, prior=PRIOR, common_light=0.1) is None


@pytest.mark.parametrize("given", [{"common_light": 0.0}, {"common_color": np.ones(3)}])
def test_impossible_common_errors_are_refused(table, given):
    known = {"prior": PRIOR, "common_light": 0.1} | given
    with pytest.raises(ChromophoreError, match=next(iter(given))):
        estimate_common_optics(np.ones((5, 3)), table, **known)
