"""Extremes of diffusion ellipses over directions, and of estimated against listed lights."""

import numpy as np

from reconstruction.anisotropy.diffusion_ellipse import fit_ellipses, relative_sigma_tr
from reconstruction.anisotropy.direction_harmonics import fit_harmonics
from reconstruction.stack_diagnosis.shading_space import Agreement, compare_directions
from skinrig.arrays import Float64Array
from skinrig.extremes.expectations import expect_near, expect_within
from skinrig.extremes.inputs import InputPrecision, ring_directions

TURNS_RAD: Float64Array = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)


def _fit(real: InputPrecision, values: Float64Array, weight: float = 1.0) -> Float64Array:
    given = np.asarray(real(values), np.float64)
    weights = np.full_like(given, weight)
    start = fit_harmonics(TURNS_RAD, given, weights)
    return fit_ellipses(TURNS_RAD, given, weights, start)[0]


def _drawn(uv: tuple[float, float]) -> Float64Array:
    return relative_sigma_tr(TURNS_RAD, np.array([uv]))[0].T


def _circle(real: InputPrecision) -> str:
    found = _fit(real, np.ones((24, 1)))
    return "parameters " + expect_near(found, np.zeros((1, 5)), absolute=1e-6)


def _long_ellipse(real: InputPrecision) -> str:
    return "u, v " + expect_near(_fit(real, _drawn((4.0, 0.0)))[0, 1:3], [4.0, 0.0], absolute=1e-3)


def _faint_weights(real: InputPrecision) -> str:
    found = [_fit(real, _drawn((0.3, 0.2)), weight)[0, 1:3] for weight in (1e-12, 1e12)]
    return "u, v " + expect_near(found, [[0.3, 0.2]] * 2, absolute=1e-5)


def _units_of_values(real: InputPrecision) -> str:
    found = [_fit(real, scale * _drawn((0.3, 0.2)))[0, 1:3] for scale in (1e-6, 1e6)]
    return "u, v " + expect_near(found, [[0.3, 0.2]] * 2, absolute=1e-5)


def _listed_lights() -> Float64Array:
    return np.vstack([ring_directions(10, 0.4), ring_directions(10, 0.9)])


def _compare(real: InputPrecision, lights: Float64Array, listed: Float64Array) -> Agreement:
    found, given = (np.asarray(real(each), np.float64) for each in (lights, listed))
    return compare_directions(found, given, rng=np.random.default_rng(0), draws=60)


def _exact_list(real: InputPrecision) -> str:
    found = _compare(real, _listed_lights(), _listed_lights())
    return expect_within(found.angle_deg, 0.0, 0.05, label="angles, degrees")


def _bas_relief(real: InputPrecision) -> str:
    """Lights are known up to a regular matrix, here one of condition 1,000."""
    found = _compare(real, _listed_lights() @ np.diag([1.0, 30.0, 1e-3 * 30.0]), _listed_lights())
    return expect_within(found.angle_deg, 0.0, 0.1, label="angles, degrees")


def _one_wrong_light(real: InputPrecision) -> str:
    listed = _listed_lights()
    listed[3] *= [-1.0, -1.0, 1.0]
    found = _compare(real, _listed_lights(), listed)
    return "agree " + expect_near(found.agrees, np.arange(20) != 3)


def _units_of_strength(real: InputPrecision) -> str:
    found = [_compare(real, scale * _listed_lights(), _listed_lights()) for scale in (1e-6, 1e6)]
    angles = np.concatenate([each.angle_deg for each in found])
    return expect_within(angles, 0.0, 0.05, label="angles, degrees")
