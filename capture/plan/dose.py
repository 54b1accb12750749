"""How much light a plan of LEDs gives to the subject, before it is given.

The blue-light limit of a source that somebody stares at is a weighted radiance times time of
1e6 J m^-2 sr^-1 within 1e4 s (IEC 62471:2006, section 4.3.3). Here all of an LED's radiance counts
as blue, which no spectrum exceeds, so the figure is an upper bound. A laboratory must measure.
"""

import math
from dataclasses import dataclass

import numpy as np

from capture.plan.eye_light import eye_light, radiant_intensity
from capture.plan.rows import led_rows
from capture.plan.steps import Plan
from capture.rig import Rig

BLUE_LIMIT_J_M2_SR = 1e6


@dataclass(frozen=True, slots=True)
class DoseReport:
    """Light that a plan gives."""

    led: str
    """Name of the light that gives most."""
    led_ws: float
    """What it sends out, Ws."""
    limit_ws: float
    """What it may send out to one subject, Ws; inf where the rig names no limit."""
    blue_share: float
    """Its radiance times its time over the blue-light limit, all of it counted as blue."""
    eye_j_m2: float
    """Radiant exposure at the eyes from all lights, J/m^2."""


def dose_report(plan: Plan, rig: Rig) -> DoseReport:
    """Return the light that a plan of the dome, or of the gradient sphere, gives.

    Parameters
    ----------
    plan : Plan
    rig : Rig
        With the lights that the plan names.

    Examples
    --------
    >>> from capture.plan.dome import dome_plan
    >>> from capture.rig import load_rig
    >>> dome = load_rig("dome")
    >>> report = dose_report(dome_plan(dome), dome)
    >>> report.led_ws < 0.05 * report.limit_ws, report.blue_share < 0.01
    (True, True)
    """
    on_s = np.zeros(len(rig.lights))
    for row in led_rows(plan.steps, rig):
        on_s += row.given(len(rig.lights)) * row.dwell_s
    power_w = np.array([light.power_w or 0.0 for light in rig.lights])
    radiance = np.array(
        [
            radiant_intensity(light) / (math.pi * (light.radius_mm * 1e-3) ** 2)
            for light in rig.lights
        ]
    )
    most = int(np.argmax(on_s * power_w))
    return DoseReport(
        led=rig.lights[most].name,
        led_ws=float(on_s[most] * power_w[most]),
        limit_ws=rig.leds.dose_ws if rig.leds is not None else math.inf,
        blue_share=float((radiance * on_s).max() / BLUE_LIMIT_J_M2_SR),
        eye_j_m2=float(eye_light(rig) @ on_s),
    )
