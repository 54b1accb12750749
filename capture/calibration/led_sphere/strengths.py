"""Intensities and films of the lights, from what their spots in the ball give in each exposure."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from capture.arrays import BoolArray, Float64Array
from capture.calibration.fiber.spot_photometry import Shot, measure_flux
from capture.calibration.geometry import CameraPose
from capture.calibration.led_sphere.glass_ball import Ball
from capture.calibration.led_sphere.lights import SphereFilms, SphereLightTable
from capture.calibration.led_sphere.polarization import FilmFit, leakage
from capture.calibration.lights.reflection import Mirrored, mirror_lights
from capture.calibration.polarization.polarized_reflection import Reflection
from capture.rig import Rig

EXPOSURE_REPEATABILITY = 1e-3  # how well an exposure's light repeats


PIXEL_RESPONSE_STDERR = 1e-3  # how well pixels' responses are known over a spot


@dataclass(frozen=True, slots=True, eq=False)
class Rates:
    """Light per second of each light's spot in each exposure, with what may be used of it.

    Attributes
    ----------
    readings_deg : ndarray of float64, shape (E,)
        Of the analyser.
    rate, variance : ndarray of float64, shape (E, L)
    good : ndarray of bool, shape (E, L)
        Whole and not saturated.
    saturated : ndarray of bool, shape (L,)
        In every exposure.
    """

    readings_deg: Float64Array
    rate: Float64Array
    variance: Float64Array
    good: BoolArray
    saturated: BoolArray

    @property
    def fluxed(self) -> BoolArray:
        """Which lights have usable rates at two or more readings, shape (L,)."""
        return np.array([len(set(self.readings_deg[ok] % 180.0)) >= 2 for ok in self.good.T])


def measure_rates(
    shots: Sequence[Shot], at: Float64Array, aperture_px: Float64Array, within: Float64Array
) -> Rates:
    """Return the rates of spots at places (L, 2), of which apertures hold a share `within`."""
    rows = []
    for shot in shots:
        flux = measure_flux(shot, at, aperture_px=aperture_px)
        scale = 1.0 / (within * shot.amount_s)
        rate = flux.value * scale
        variance = flux.variance * scale**2 + (EXPOSURE_REPEATABILITY * rate) ** 2
        rows.append((rate, variance, flux.whole & ~flux.saturated, flux.saturated))
    rates, variances, good, saturated = (np.array(part) for part in zip(*rows, strict=True))
    readings = np.array([shot.reading_deg for shot in shots])
    return Rates(readings, rates, variances, good, np.logical_and.reduce(saturated))


def add_geometry_errors(
    films: FilmFit, glass: Reflection, eta_stderr: float, angle_rad: Float64Array
) -> FilmFit:
    """Return the films with what errors of directions and of the glass's index add to theirs.

    What is measured is how the reflected light is polarized and how much it is. Near Brewster's
    angle glass turns the polarization of light fast with the angle, and reflects little.
    """

    def seen(turn: Float64Array, reflection: Reflection) -> tuple[Float64Array, Float64Array]:
        field = reflection.fields(turn)[:, 0]
        doubled = (field[:, 0] + 1j * field[:, 1]) ** 2
        return doubled, np.log(np.abs(doubled))

    h = 1e-4
    turn = films.turn_rad

    def change(
        high: tuple[Float64Array, Float64Array], low: tuple[Float64Array, Float64Array]
    ) -> Any:
        return 0.5 * np.angle(high[0] / low[0]), high[1] - low[1]

    by_turn = [v / (2 * h) for v in change(seen(turn + h, glass), seen(turn - h, glass))]
    slope = np.where(np.abs(by_turn[0]) > 1e-3, by_turn[0], 1e-3)
    first = np.cross(glass.to_light, glass.to_camera)
    first /= np.maximum(np.linalg.norm(first, axis=1, keepdims=True), 1e-12)
    turn2 = np.zeros_like(turn)
    share2 = np.zeros_like(turn)
    shifts = [
        (h * first, 0.0, angle_rad / h),
        (h * np.cross(first, glass.to_light), 0.0, angle_rad / h),
        (0.0 * first, 0.5 * eta_stderr, 2.0),
    ]
    for move, index, scale in shifts:
        ends = [
            seen(turn, glass.moved(glass.to_light + sign * move, glass.eta + sign * index))
            for sign in (0.5, -0.5)
        ]
        angle, share = (v * scale for v in change(*ends))
        turned = -angle / slope
        turn2 += turned**2
        share = share + by_turn[1] * turned
        # what the index changes for all is no difference between lights
        share2 += (share - np.median(share) if index else share) ** 2
    covariance = films.covariance.copy()
    covariance[:, 0, 0] += turn2
    return replace(
        films,
        covariance=covariance,
        turn_stderr_rad=np.sqrt(covariance[:, 0, 0]),
        strength_stderr=np.hypot(films.strength_stderr, np.sqrt(share2) * np.abs(films.strength)),
    )


def measure_intensities(
    rig: Rig,
    camera: CameraPose,
    ball: Ball,
    films: FilmFit,
    shown: Mirrored,
    direction: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Return the light that each light sends to the origin, any common unit, with errors."""
    place = direction * np.linalg.norm([light.position_mm for light in rig.lights], axis=1)[:, None]
    distance2 = np.sum(place**2, axis=1)
    # lights point at the origin, the ball mirrors them a little beside it
    off = np.arccos(np.clip(np.sum(shown.to_light * direction, axis=1), -1.0, 1.0))
    lobe = np.array([led.intensity(float(a)) for led, a in zip(rig.lights, off, strict=True)])
    per_strength = 1.0 / (shown.magnification_px2 * lobe * distance2)
    value = films.strength * per_strength
    # what the ball's own numbers change, beyond a factor that all lights have in common
    shares = []
    root = np.linalg.cholesky(ball.covariance_mm2 + 1e-18 * np.eye(4))
    for column in root.T:
        other = mirror_lights(
            camera, ball.center_mm + column[:3], ball.radius_mm + column[3], place
        )
        shares.append(np.log(other.magnification_px2 / shown.magnification_px2))
    known = np.array(shares)
    known -= known.mean(axis=1, keepdims=True)
    common2 = np.sum(known**2, axis=0) + PIXEL_RESPONSE_STDERR**2
    return value, np.sqrt((films.strength_stderr * per_strength) ** 2 + common2 * value**2)


def film_table(
    lights: SphereLightTable, films: FilmFit, skin: Reflection, rates: Rates, eta: float
) -> SphereFilms:
    """Return the films of the lights, with their leakage and the ratio of crossed to parallel."""
    usable = rates.good & rates.fluxed
    weight = np.where(usable, 1.0 / np.where(rates.variance > 0, rates.variance, 1.0), 0.0)
    states = []
    for state in (0.0, 90.0):
        rows = np.isclose(rates.readings_deg % 180.0, state, atol=0.01)
        whole = weight[rows].sum(axis=0)
        mean = (weight * rates.rate)[rows].sum(axis=0) / np.where(whole > 0, whole, 1.0)
        states.append((mean, 1.0 / np.where(whole > 0, whole, np.inf), whole > 0))
    (parallel, p_var, p_seen), (crossed, c_var, c_seen) = states
    seen = p_seen & c_seen & (parallel > 3 * np.sqrt(p_var)) & ~lights.dead
    safe = np.where(seen, parallel, 1.0)
    ratio = np.where(seen, crossed / safe, 0.0)
    ratio_stderr = np.where(seen, np.sqrt(c_var + ratio**2 * p_var) / safe, 0.0)
    light_error, analyser_error = films.leak_stderr
    # axes are measured from the horizontal, which turns fast with the direction near the poles
    upward = lights.directions[:, 1]
    horizon = np.linalg.norm(lights.directions_stderr, axis=1) / np.sqrt(2)
    horizon = horizon * np.abs(upward) / np.sqrt(np.maximum(1.0 - upward**2, 1e-6))
    turns = films.turn_rad, np.hypot(films.turn_stderr_rad, horizon)
    zero = films.zero_rad, films.zero_stderr_rad
    leaks = films.light_leak, light_error, films.analyser_leak, analyser_error
    return SphereFilms(
        lights.names, *leakage(films, skin), ratio, ratio_stderr, *turns, seen, *zero, *leaks, eta
    )
