"""Intensities and polarizers of the lights, from the fluxes of their spots in the ball."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from capture.arrays import BoolArray, Float64Array
from capture.calibration.fiber.spot_photometry import SpotImage, measure_flux
from capture.calibration.geometry import CameraPose
from capture.calibration.led_sphere.glass_ball import BallPosition
from capture.calibration.led_sphere.lights import SphereLightTable, SpherePolarizers
from capture.calibration.led_sphere.polarization import PolarizerFit, leakage
from capture.calibration.lights.reflection import MirroredLights, mirror_lights
from capture.calibration.polarization.polarized_reflection import FacetReflection
from capture.rig import Rig

EXPOSURE_REPEATABILITY = 1e-3  # relative repeatability of an exposure's light


PIXEL_RESPONSE_STDERR = 1e-3  # relative error of the pixels' responses, averaged over a spot


@dataclass(frozen=True, slots=True, eq=False)
class SpotRates:
    """Flux of each light's spot in each exposure, with masks of usable values.

    Attributes
    ----------
    readings_deg : ndarray of float64, shape (E,)
        Readings of the analyzer.
    rate, variance : ndarray of float64, shape (E, L)
    good : ndarray of bool, shape (E, L)
        Inside the image and not saturated.
    saturated : ndarray of bool, shape (L,)
        Saturated in every exposure.
    """

    readings_deg: Float64Array
    rate: Float64Array
    variance: Float64Array
    good: BoolArray
    saturated: BoolArray

    @property
    def is_measured(self) -> BoolArray:
        """Whether a light has usable rates at two or more readings, shape (L,)."""
        return np.array([len(set(self.readings_deg[ok] % 180.0)) >= 2 for ok in self.good.T])


def measure_rates(
    shots: Sequence[SpotImage],
    position_px: Float64Array,
    aperture_px: Float64Array,
    aperture_fraction: Float64Array,
) -> SpotRates:
    """Return rates of spots at positions (L, 2); apertures collect `aperture_fraction` of each."""
    rows = []
    for shot in shots:
        flux = measure_flux(shot, position_px, aperture_px=aperture_px)
        scale = 1.0 / (aperture_fraction * shot.amount_s)
        rate = flux.value * scale
        variance = flux.variance * scale**2 + (EXPOSURE_REPEATABILITY * rate) ** 2
        rows.append((rate, variance, flux.whole & ~flux.saturated, flux.saturated))
    rates, variances, good, saturated = (np.array(part) for part in zip(*rows, strict=True))
    readings = np.array([shot.reading_deg for shot in shots])
    return SpotRates(readings, rates, variances, good, np.logical_and.reduce(saturated))


def add_geometry_errors(
    polarizers: PolarizerFit, glass: FacetReflection, eta_stderr: float, angle_rad: Float64Array
) -> PolarizerFit:
    """Return the polarizers with errors that include those of directions and of the glass's index.

    Both the polarization and the amount of the reflected light depend on the angle of incidence:
    near Brewster's angle glass rotates the polarization fast with the angle, and reflects little.
    """

    def seen(turn: Float64Array, reflection: FacetReflection) -> tuple[Float64Array, Float64Array]:
        field = reflection.reflected_fields(turn)[:, 0]
        # Squared, an axis and its opposite are equal; the phase is twice the angle, the modulus the
        # reflected intensity.
        doubled = (field[:, 0] + 1j * field[:, 1]) ** 2
        return doubled, np.log(np.abs(doubled))

    h = 1e-4
    turn = polarizers.axis_error_rad

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
            seen(
                turn, glass.with_directions(glass.to_light + sign * move, glass.eta + sign * index)
            )
            for sign in (0.5, -0.5)
        ]
        angle, share = (v * scale for v in change(*ends))
        turned = -angle / slope
        turn2 += turned**2
        share = share + by_turn[1] * turned
        # a change of the index that is common to all lights is not a difference between them
        share2 += (share - np.median(share) if index else share) ** 2
    covariance = polarizers.covariance.copy()
    covariance[:, 0, 0] += turn2
    return replace(
        polarizers,
        covariance=covariance,
        axis_error_stderr_rad=np.sqrt(covariance[:, 0, 0]),
        strength_stderr=np.hypot(
            polarizers.strength_stderr, np.sqrt(share2) * np.abs(polarizers.strength)
        ),
    )


def measure_intensities(
    rig: Rig,
    camera: CameraPose,
    ball: BallPosition,
    polarizers: PolarizerFit,
    mirrored: MirroredLights,
    direction: Float64Array,
) -> tuple[Float64Array, Float64Array]:
    """Return the irradiance of each light at the origin, in any common unit, with errors."""
    place = direction * np.linalg.norm([light.position_mm for light in rig.lights], axis=1)[:, None]
    distance2 = np.sum(place**2, axis=1)
    # lights are aimed at the origin, whereas the ball mirrors them from slightly next to it
    off = np.arccos(np.clip(np.sum(mirrored.to_light * direction, axis=1), -1.0, 1.0))
    lobe = np.array([led.intensity(float(a)) for led, a in zip(rig.lights, off, strict=True)])
    # A spot's flux is radiance x emitting area x magnification x lobe towards the ball; the
    # irradiance at the origin is radiance x emitting area / distance^2.
    per_strength = 1.0 / (mirrored.magnification_px2 * lobe * distance2)
    value = polarizers.strength * per_strength
    # effect of the ball's own parameters, except a factor that is common to all lights
    shares = []
    root = np.linalg.cholesky(ball.covariance_mm2 + 1e-18 * np.eye(4))
    for column in root.T:
        other = mirror_lights(
            camera, ball.center_mm + column[:3], ball.radius_mm + column[3], place
        )
        shares.append(np.log(other.magnification_px2 / mirrored.magnification_px2))
    known = np.array(shares)
    known -= known.mean(axis=1, keepdims=True)
    common2 = np.sum(known**2, axis=0) + PIXEL_RESPONSE_STDERR**2
    return value, np.sqrt((polarizers.strength_stderr * per_strength) ** 2 + common2 * value**2)


def polarizer_table(
    lights: SphereLightTable,
    polarizers: PolarizerFit,
    skin: FacetReflection,
    rates: SpotRates,
    eta: float,
) -> SpherePolarizers:
    """Return the polarizers, with their leakage and the ratio of crossed to parallel."""
    usable = rates.good & rates.is_measured
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
    light_error, analyzer_error = polarizers.leak_stderr
    # axes are measured from the horizontal, which rotates fast with the direction near the poles
    upward = lights.directions[:, 1]
    horizon = np.linalg.norm(lights.directions_stderr, axis=1) / np.sqrt(2)
    horizon = horizon * np.abs(upward) / np.sqrt(np.maximum(1.0 - upward**2, 1e-6))
    turns = polarizers.axis_error_rad, np.hypot(polarizers.axis_error_stderr_rad, horizon)
    zero = polarizers.zero_rad, polarizers.zero_stderr_rad
    leaks = polarizers.light_leak, light_error, polarizers.analyzer_leak, analyzer_error
    return SpherePolarizers(
        lights.names,
        *leakage(polarizers, skin),
        ratio,
        ratio_stderr,
        *turns,
        seen,
        *zero,
        *leaks,
        eta,
    )
