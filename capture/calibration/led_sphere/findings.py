"""Findings of a survey: what is wrong with a sphere of lights, in sentences."""

from dataclasses import dataclass

import numpy as np

from capture.arrays import BoolArray, Float64Array
from capture.calibration.led_sphere.glass_ball import Ball
from capture.calibration.led_sphere.lights import SphereFilms, SphereLightTable
from capture.calibration.led_sphere.polarization import FilmFit

MAX_ANALYZER_OFFSET_DEG = 2.0


MAX_POLARIZER_TURN_DEG = 3.0


MAX_LIGHT_OFFSET_SIGMAS = 5.0


MAX_LIGHT_OFFSET_DEG = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class SphereSurvey:
    """What photographs of the ball said.

    Attributes
    ----------
    lights : SphereLightTable
    films : SphereFilms
    ball : Ball
        As found.
    light_scatter_mm : float
        Of the lights about their nominal places, along an axis.
    turn_scatter_rad : float
        Of the lights' polarizers about their nominal axes.
    readings_deg : tuple of float
        Of the analyser.
    findings : tuple of str
        What is wrong with the rig.
    """

    lights: SphereLightTable
    films: SphereFilms
    ball: Ball
    light_scatter_mm: float
    turn_scatter_rad: float
    readings_deg: tuple[float, ...]
    findings: tuple[str, ...]


def describe_findings(
    survey: SphereSurvey,
    place: Float64Array,
    in_field: BoolArray,
    saturated: BoolArray,
    films: FilmFit,
    strays: int,
) -> tuple[str, ...]:
    """Return what is wrong with the rig, one sentence each.

    Parameters
    ----------
    survey : SphereSurvey
    place : ndarray of float64, shape (L, 3)
        Nominal places of the lights, mm.
    in_field, saturated : ndarray of bool, shape (L,)
        Lights mirrored within the image, and saturated in every exposure.
    films : FilmFit
    strays : int
        Number of bright spots that are no light's.
    """
    lights, table = survey.lights, survey.films
    names = np.array(lights.names)
    told = []

    def listed(chosen: BoolArray) -> str:
        return ", ".join(names[chosen])

    if lights.dead.any():
        told.append(f"dead, or hidden from the ball: {listed(lights.dead)}")
    outside = ~in_field
    if outside.any():
        told.append(f"mirrored outside the image, left nominal: {listed(outside)}")
    if saturated.any():
        told.append(f"saturated in every exposure, no intensity: {listed(saturated)}")
    dim = ~lights.valid & ~outside & ~saturated
    if dim.any():
        told.append(f"too dim in the ball to be measured: {listed(dim)}")
    nominal = place / np.linalg.norm(place, axis=1, keepdims=True)
    off = np.linalg.norm(lights.directions - nominal, axis=1)
    usual = np.sqrt(2) * survey.light_scatter_mm / np.linalg.norm(place, axis=1)
    far = lights.seen & (
        off > np.maximum(MAX_LIGHT_OFFSET_SIGMAS * usual, np.radians(MAX_LIGHT_OFFSET_DEG))
    )
    for k in np.flatnonzero(far):
        told.append(f"light {names[k]} stands {np.degrees(off[k]):.2f} degrees from its place")
    zero, error = np.degrees([films.zero_rad, films.zero_stderr_rad])
    if abs(zero) > MAX_ANALYZER_OFFSET_DEG:
        told.append(
            f"the analyser stands {zero:+.2f} ± {error:.2f} degrees off its reading: crossed leaks"
            f" {100 * np.median(table.leakage):.1f} % of reflections; turn it back"
        )
    turn = np.degrees(table.axis_error_rad)
    turned = table.valid & (
        np.abs(turn) > MAX_POLARIZER_TURN_DEG + 3 * np.degrees(table.axis_error_stderr_rad)
    )
    for k in np.flatnonzero(turned):
        told.append(f"the polarizer of light {names[k]} is turned by {turn[k]:+.1f} degrees")
    if not any(1.0 < abs(r % 180.0 - 90.0) < 89.0 for r in survey.readings_deg):
        told.append(
            "only parallel and crossed were photographed: which way single lights' polarizers are"
            " turned stays open, and errors are larger; add readings 80 and 100"
        )
    if strays:
        told.append(f"{strays} bright spots are no light's; keep other light away")
    return tuple(told)
