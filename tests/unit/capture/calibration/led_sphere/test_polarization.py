"""Films of a polarized sphere: fitted fluxes against the films they were made with."""

from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

from capture.calibration.geometry.intrinsics import CameraPose
from capture.calibration.led_sphere.polarization import fit_polarizers, leakage
from capture.calibration.lights.reflection import mirror_lights
from capture.calibration.polarization.malus import PolarizationError
from capture.calibration.polarization.polarized_reflection import FacetReflection
from capture.rig import load_rig

RIG = load_rig("gradient")
VIEW = RIG.view("cam")
CAMERA = CameraPose.nominal(VIEW)
PLACE = np.array([light.position_mm for light in RIG.lights])
ALARM = 1e-3  # false alarm rate of each chi-square
BOTH_SIDES = ((0, 0.2), (0, 1.0), (0, 8.0), (80, 8.0), (90, 8.0), (90, 60.0), (100, 8.0))
TWO_STATES = ((0, 0.2), (0, 1.0), (0, 8.0), (90, 8.0), (90, 60.0))


def reflection(eta, to_light, to_camera):
    return FacetReflection.of(
        RIG.lights, CAMERA, VIEW.analyzer_axis_deg, eta, to_light=to_light, to_camera=to_camera
    )


SHOWN = mirror_lights(CAMERA, np.array([0.0, 0.0, -3.0]), 6.0, PLACE)
GLASS = reflection(1.52, SHOWN.to_light, SHOWN.to_camera)
SKIN = reflection(
    1.4, PLACE / np.linalg.norm(PLACE, axis=1, keepdims=True), np.tile([0.0, 0.0, 1.0], (132, 1))
)


def spots(
    rng, *, zero_deg, turn_deg, light_leak=1 / 2000, analyzer_leak=1 / 3000, series=BOTH_SIDES
):
    """Return readings, rates, variances, which are good, and the truth."""
    turn = np.radians(rng.normal(0.0, turn_deg, len(PLACE)))
    strength = 1.3e7 * rng.normal(1.0, 0.1, len(PLACE))  # photo-electrons at amount 1
    readings = np.radians([r for r, _ in series])
    amount = np.array([a for _, a in series])[:, None]
    zero = np.radians(zero_deg)
    electrons = (
        strength
        * amount
        * GLASS.transmit_through_analyzer(readings, turn, zero, light_leak, analyzer_leak)
    )
    variance = electrons + 1000 * 13.0**2
    counted = electrons + np.sqrt(variance) * rng.standard_normal(electrons.shape)
    good = electrons < 9e5
    leaked = SKIN.transmit_through_analyzer([0.0, np.pi / 2], turn, zero, light_leak, analyzer_leak)
    truth = {"turn": turn, "zero": zero, "strength": strength, "leak": leaked[1] / leaked[0]}
    return readings, counted / amount, variance / amount**2, good, truth


@cache
def fitted(zero_deg):
    """Return the readings of a sphere, and the films fitted to them."""
    *data, truth = spots(np.random.default_rng(12345), zero_deg=zero_deg, turn_deg=0.3)
    return data, truth, fit_polarizers(*data, GLASS)


@pytest.mark.long
@pytest.mark.parametrize(("turn_deg", "seed"), [(1.0, 2), (1.0, 3), (3.0, 2)])
def test_far_axes_converge_from_two_readings(turn_deg, seed, caplog):
    """Gauss and Newton's steps alone halve the distance of a crossed light, and reach the limit."""
    rng = np.random.default_rng(seed)
    *data, _ = spots(rng, zero_deg=0.6, turn_deg=turn_deg, series=TWO_STATES)
    fit_polarizers(*data, GLASS)
    assert caplog.records == []


@pytest.mark.parametrize("zero_deg", [0.0, 0.6, -10.0])
def test_analyzer_polarizers_and_axes_are_within_their_errors(zero_deg):
    data, truth, fit = fitted(zero_deg)
    assert abs(np.degrees(fit.zero_rad - truth["zero"])) < 0.1
    assert abs(fit.zero_rad - truth["zero"]) < 4 * fit.zero_stderr_rad
    for leak, error, true in zip(
        (fit.light_leak, fit.analyzer_leak), fit.leak_stderr, (1 / 2000, 1 / 3000), strict=True
    ):
        assert abs(leak - true) < 4 * error
        assert error < 0.3 * true
    bound = chi2.ppf(1 - ALARM, len(PLACE))
    pull = (fit.strength - truth["strength"]) / fit.strength_stderr
    assert np.sum(pull**2) < bound
    # axes share the error of the analyzer's zero, which all of them are measured against
    gap = fit.axis_error_rad - truth["turn"]
    own = gap - np.median(gap)
    assert np.sqrt(np.mean((own / fit.axis_error_stderr_rad) ** 2)) < 1.5
    # it could have failed: lights as drawn leave a hundred times the noise
    readings, rates, variance, good, _ = (*data, truth)
    drawn = truth["strength"] * GLASS.transmit_through_analyzer(
        readings, 0.0, truth["zero"], 1 / 2000, 1 / 3000
    )
    assert np.sum(((rates - drawn) ** 2 / variance)[good]) > 100 * good.sum()


@pytest.mark.parametrize("zero_deg", [0.6, -10.0])
def test_skin_leakage_follows_from_glass_leakage(zero_deg):
    _, truth, fit = fitted(zero_deg)
    value, error = leakage(fit, SKIN)
    pull = (value - truth["leak"]) / error
    assert np.mean(np.abs(pull) < 2) > 0.85
    assert np.median(error / truth["leak"]) < 0.05
    # glass's own ratio is no substitute
    glass = GLASS.transmit_through_analyzer(
        [0.0, np.pi / 2], truth["turn"], truth["zero"], 1 / 2000, 1 / 3000
    )
    assert np.median(np.abs(glass[1] / glass[0] - truth["leak"])) > 5 * np.median(error)


@pytest.mark.long
def test_two_readings_errors_reflect_open_signs(rng):
    *data, truth = spots(rng, zero_deg=0.6, turn_deg=0.3, series=TWO_STATES)
    fit = fit_polarizers(*data, GLASS)
    assert abs(fit.zero_rad - truth["zero"]) < 4 * fit.zero_stderr_rad
    gap = np.abs(fit.axis_error_rad - truth["turn"])
    assert np.mean(gap < 3 * fit.axis_error_stderr_rad) > 0.95
    *both, _ = spots(rng, zero_deg=0.6, turn_deg=0.3)
    better = fit_polarizers(*both, GLASS)
    assert np.median(fit.axis_error_stderr_rad) > 2 * np.median(better.axis_error_stderr_rad)


@pytest.mark.long
def test_zero_errors_match_stated_over_many_spheres(rng):
    pulls = []
    for _ in range(12):
        *data, truth = spots(rng, zero_deg=rng.normal(0, 0.7), turn_deg=0.5)
        fit = fit_polarizers(*data, GLASS)
        pulls.append((fit.zero_rad - truth["zero"]) / fit.zero_stderr_rad)
    low, high = chi2.ppf([ALARM / 2, 1 - ALARM / 2], len(pulls))
    assert low < np.sum(np.square(pulls)) < high


def test_single_outlier_light_does_not_rotate_analyzer(rng):
    readings, rates, variance, good, truth = spots(rng, zero_deg=0.5, turn_deg=0.0)
    turn = np.zeros(len(PLACE))
    turn[7] = np.radians(8.0)
    off = truth["strength"] * GLASS.transmit_through_analyzer(
        readings, turn, truth["zero"], 1 / 2000, 1 / 3000
    )
    rates[:, 7] = off[:, 7]
    fit = fit_polarizers(readings, rates, variance, good, GLASS)
    assert abs(np.degrees(fit.zero_rad) - 0.5) < 0.02
    assert abs(np.degrees(fit.axis_error_rad[7]) - 8.0) < 0.1


def test_dead_lights_have_no_strength_and_no_weight(rng):
    readings, rates, variance, good, truth = spots(rng, zero_deg=0.5, turn_deg=0.2)
    rates[:, :13] = rng.standard_normal((len(readings), 13)) * np.sqrt(variance[:, :13])
    fit = fit_polarizers(readings, rates, variance, good, GLASS)
    # a strength is no better known than the turn that decides how much glass reflects
    assert (np.abs(fit.strength[:13]) < 5 * fit.strength_stderr[:13]).all()
    assert abs(fit.zero_rad - truth["zero"]) < 4 * fit.zero_stderr_rad


def test_weak_lights_are_measured_and_move_no_other(rng):
    """LEDs that emit 90 to 20 % of the requested light, which no controller measures."""
    readings, rates, variance, good, truth = spots(rng, zero_deg=0.5, turn_deg=0.2)
    whole = fit_polarizers(readings, rates, variance, good, GLASS)
    share = np.ones(len(PLACE))
    share[:8] = np.linspace(0.9, 0.2, 8)
    weak = fit_polarizers(readings, rates * share, variance, good, GLASS)
    pull = (weak.strength - share * truth["strength"]) / weak.strength_stderr
    assert np.abs(pull[:8]).max() < 4.0
    assert ((1.0 - share) * truth["strength"] > 5.0 * weak.strength_stderr)[:8].all()
    change = np.abs(weak.strength - whole.strength)[8:] / whole.strength_stderr[8:]
    assert change.max() < 0.5


def test_single_reading_or_saturated_spots_are_refused(rng):
    readings, rates, variance, good, _ = spots(rng, zero_deg=0.5, turn_deg=0.2)
    with pytest.raises(PolarizationError, match="two that differ"):
        fit_polarizers(readings[:3], rates[:3], variance[:3], good[:3], GLASS)
    with pytest.raises(PolarizationError, match="shorter exposure"):
        fit_polarizers(readings, rates, variance, np.zeros_like(good), GLASS)
