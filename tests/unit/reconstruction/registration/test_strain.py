"""Strain measured between two pictures of pigment whose deformation is known."""

import math

import numpy as np
import pytest
from scipy import ndimage

from reconstruction.registration.strain import measure_strain
from reconstruction.registration.tracking import RegistrationError

SIDE = 1100


@pytest.fixture(scope="module")
def pigment():
    """Return a texture with spots of 6 and 15 px, and without an outline."""
    rng = np.random.default_rng(11)
    fine, coarse = (
        ndimage.gaussian_filter(rng.standard_normal((SIDE, SIDE)), sigma) for sigma in (2.5, 6.0)
    )
    return 0.25 * (1 + 0.08 * coarse / coarse.std() + 0.04 * fine / fine.std())


def picture(pigment, gradient, shift_px, *, seed, side=256, noise=0.003):
    """Draw deformed pigment: what was at x lies at gradient x + shift (+y up)."""
    rows, columns = np.mgrid[0:side, 0:side]
    there = np.stack([columns - (side - 1) / 2, (side - 1) / 2 - rows], axis=-1)
    rest = (there - shift_px) @ np.linalg.inv(gradient).T
    places = [(SIDE - 1) / 2 - rest[..., 1], (SIDE - 1) / 2 + rest[..., 0]]
    clean = ndimage.map_coordinates(pigment, places, order=3)
    return clean + noise * np.random.default_rng(seed).standard_normal((side, side))


CASES = {
    "stretched": (np.diag([1.10, 0.97]), [3.3, -4.0]),
    "moved 20 px": (np.eye(2), [20.0, 0.0]),
    "sheared and turned": (np.array([[1.05, 0.04], [-0.01, 0.98]]), [1.0, 2.0]),
    "compressed far": (np.diag([0.73, 1.10]), [8.0, 5.0]),
    "stretched far": (np.diag([1.28, 0.90]), [5.0, -6.0]),
    "strain 2": (np.diag([2.0, 0.8]), [0.0, 0.0]),
}


@pytest.mark.parametrize("case", list(CASES)[:5])
def test_the_strain_comes_back_within_its_standard_errors(pigment, case):
    gradient, shift = CASES[case]
    first = picture(pigment, np.eye(2), np.zeros(2), seed=1)
    found = measure_strain(first, picture(pigment, gradient, np.array(shift), seed=2))
    assert found.valid
    off = np.concatenate([(found.gradient - gradient).ravel(), found.shift_px - shift])
    # windows share texture, so scatter tells a little less than all: 5 of 6 numbers in 1e4 runs
    assert (np.abs(off) < 5 * np.sqrt(np.diag(found.covariance))).all()
    assert np.abs(off[:4]).max() < 0.005


def test_initial_reading_reaches_strains_beyond_search_range(pigment):
    gradient, shift = CASES["strain 2"]
    first = picture(pigment, np.eye(2), np.zeros(2), seed=1)
    second = picture(pigment, gradient, np.array(shift), seed=2)
    found = measure_strain(first, second, start=np.diag([1.95, 0.85]))
    assert found.valid
    assert np.abs(found.gradient - gradient).max() < 0.005


def test_standard_errors_match_the_scatter_of_strains(pigment):
    """Squared normalized errors of 12 x 4 entries: 48 expected, chi-square at 1e-4 on either side.

    The lower bound is wider: what neighbors share can only make standard errors larger.
    """
    gradient = np.diag([1.04, 0.98])
    normalized = []
    for number in range(12):
        origin = np.array([37.0 * (number % 4) - 55, 41.0 * (number // 4) - 40])
        first = picture(pigment, np.eye(2), origin, seed=100 + number)
        second = picture(pigment, gradient, gradient @ origin, seed=200 + number)
        found = measure_strain(first, second)
        stderr = np.sqrt(np.diag(found.covariance))[:4]
        normalized.append((found.gradient - gradient).ravel() / stderr)
    total = float(np.sum(np.square(normalized)))
    assert 12.0 < total < 89.0


def test_stretch_shear_and_rotation_follow_from_gradient(pigment):
    angle = math.radians(30)
    turn = np.array([[math.cos(0.02), -math.sin(0.02)], [math.sin(0.02), math.cos(0.02)]])
    axis = np.array([math.cos(angle), math.sin(angle)])
    gradient = turn @ (np.eye(2) + 0.08 * np.outer(axis, axis))
    first = picture(pigment, np.eye(2), np.zeros(2), seed=1)
    found = measure_strain(first, picture(pigment, gradient, np.zeros(2), seed=2))
    r_s, r_s_error = found.stretch_along(angle)
    r_t, _ = found.stretch_along(angle + math.pi / 2)
    assert (r_s, r_t) == (pytest.approx(1.08, abs=5e-3), pytest.approx(1.0, abs=5e-3))
    assert 0 < r_s_error < 2e-3
    assert found.rotation[0] == pytest.approx(0.02, abs=2e-3)
    assert found.shear(angle)[0] == pytest.approx(0.0, abs=5e-3)
    # along another line it is something else
    assert abs(found.stretch_along(0.0)[0] - 1.08) > 0.01


def test_images_of_different_skin_have_no_strain(pigment):
    first = picture(pigment, np.eye(2), np.zeros(2), seed=1)
    other = picture(pigment.T[::-1], np.eye(2), np.array([170.0, 90.0]), seed=2)
    found = measure_strain(first, other)
    assert not found.valid
    assert np.isinf(found.covariance).all()


def test_stationary_jaws_are_not_skin(pigment):
    """Where both pictures show the same jaws, only the mask keeps them from being followed."""
    gradient = np.diag([0.95, 1.0])
    first = picture(pigment, np.eye(2), np.zeros(2), seed=1)
    second = picture(pigment, gradient, np.zeros(2), seed=2)
    skin = np.zeros(first.shape, bool)
    skin[:, 60:196] = True
    bars = 0.1 + 0.05 * (np.indices(first.shape).sum(axis=0) // 8 % 2)
    first, second = (np.where(skin, shown, bars) for shown in (first, second))
    masked = measure_strain(first, second, valid=skin, valid_second=skin)
    assert masked.stretch_along(0.0)[0] == pytest.approx(0.95, abs=0.005)
    assert abs(measure_strain(first, second).stretch_along(0.0)[0] - 0.95) > 0.02


@pytest.mark.parametrize("shape", [(256, 255), (40, 40)])
def test_mismatched_images_are_refused(pigment, shape):
    first = picture(pigment, np.eye(2), np.zeros(2), seed=1)
    with pytest.raises(RegistrationError, match="expected"):
        measure_strain(first[: shape[0], : shape[0]], first[: shape[0], : shape[1]])
