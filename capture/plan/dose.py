"""Predict the light dose of a plan of LEDs for the subject.

The blue-light limit of a source that a person looks at is a weighted radiance times time of 1e6 J
m^-2 sr^-1 within 1e4 s (IEC 62471:2006, section 4.3.3). Here all of an LED's radiance counts as
blue, which no spectrum exceeds, so the figure is an upper bound. A laboratory must measure.
"""

import math
from dataclasses import dataclass

import numpy as np

from capture.plan.eye_light import eye_irradiance, radiant_intensity
from capture.plan.probe import group_by_series
from capture.plan.rows import led_rows
from capture.plan.steps import Plan, Step, require_argument
from capture.rig import Light, Probe, Rig

BLUE_LIMIT_J_M2_SR = 1e6


@dataclass(frozen=True, slots=True)
class DoseReport:
    """Light dose of a plan."""

    led: str
    """Name of the light with the largest dose."""
    led_ws: float
    """Energy that it emits, Ws."""
    limit_ws: float
    """Energy that it may emit to one subject, Ws; inf without a limit in the rig."""
    blue_share: float
    """Its radiance times its time over the blue-light limit, with all of it counted as blue."""
    eye_j_m2: float
    """Radiant exposure at the eyes from all lights, J/m^2."""


def dose_report(plan: Plan, rig: Rig) -> DoseReport:
    """Return the light dose of a plan of the dome or of the gradient sphere.

    Parameters
    ----------
    plan : Plan
    rig : Rig
        Rig with the lights that the plan names.

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
        on_s += row.light_levels(len(rig.lights)) * row.dwell_s
    power_w = np.array([light.power_w or 0.0 for light in rig.lights])
    area_m2 = [math.pi * (light.radius_mm * 1e-3) ** 2 for light in rig.lights]
    radiance = np.array([radiant_intensity(light) for light in rig.lights]) / area_m2
    most = int(np.argmax(on_s * power_w))
    return DoseReport(
        led=rig.lights[most].name,
        led_ws=float(on_s[most] * power_w[most]),
        limit_ws=rig.leds.dose_ws if rig.leds is not None else math.inf,
        blue_share=float((radiance * on_s).max() / BLUE_LIMIT_J_M2_SR),
        eye_j_m2=float(eye_irradiance(rig) @ on_s),
    )


SKIN_APERTURE_MM = 3.5
"""Diameter over which the irradiance of skin is averaged (ICNIRP 2013,
doi:10.1097/HP.0b013e3182983fd4).
"""


@dataclass(frozen=True, slots=True)
class FiberLight:
    """Light dose from the source fiber."""

    led: str
    """Name of the light."""
    led_ws: float
    """Energy that a plan emits, Ws."""
    placement_ws: float
    """Largest energy at one placement of the head, Ws."""
    limit_ws: float
    """Energy that may be emitted to one subject, Ws; inf without a limit in the rig."""
    skin_w_m2: float
    """Irradiance of the skin, averaged over `SKIN_APERTURE_MM`, W/m^2."""
    stare_s: float
    """Time after which an eye at the fiber would be at the blue-light limit, s."""


def fiber_light(plan: Plan, rig: Rig) -> FiberLight:
    """Return the light dose of a plan of the fiber probe.

    Examples
    --------
    >>> from capture.plan.probe import probe_plan
    >>> from capture.rig import load_rig
    >>> rig = load_rig("probe")
    >>> light = fiber_light(probe_plan(rig), rig)
    >>> round(light.led_ws, 3), round(light.placement_ws, 3), round(light.skin_w_m2)
    (0.243, 0.081, 104)
    """
    probe, source = _source(rig)
    power_w = (source.power_w or 0.0) * max(
        (float(step.settings["level"]) for step in plan.steps), default=0.0
    )
    by_placement: dict[object, float] = {}
    for placement, steps in group_by_series(plan):
        given_ws = sum(_given_ws(step, source) for step in steps)
        by_placement[placement] = by_placement.get(placement, 0.0) + given_ws
    core_m2 = math.pi * (0.5e-3 * probe.source_core_mm) ** 2
    # etendue of the core: area times pi NA^2, a cone of half angle asin(NA), evenly filled
    etendue_m2_sr = core_m2 * math.pi * probe.source_numerical_aperture**2
    # Radiance is power over etendue; the limit is a radiance times time.
    stare_s = BLUE_LIMIT_J_M2_SR * etendue_m2_sr / power_w if power_w > 0 else math.inf
    return FiberLight(
        led=source.name,
        led_ws=source_energy_ws(plan, rig),
        placement_ws=max(by_placement.values(), default=0.0),
        limit_ws=rig.leds.dose_ws if rig.leds is not None else math.inf,
        skin_w_m2=power_w / (math.pi * (0.5e-3 * SKIN_APERTURE_MM) ** 2),
        stare_s=stare_s,
    )


def source_energy_ws(plan: Plan, rig: Rig) -> float:
    """Return the energy that the source fiber emits in a plan, Ws."""
    _, source = _source(rig)
    return sum(_given_ws(step, source) for step in plan.steps if step.kind != "dark")


def _given_ws(step: Step, source: Light) -> float:
    level = float(step.settings["level"])
    return (source.power_w or 0.0) * level * float(step.settings["exposure_s"])


def _source(rig: Rig) -> tuple[Probe, Light]:
    require_argument(rig.probe is not None, "rig", rig.name, "one with a probe")
    return rig.probe, rig.lights[0]  # type: ignore[return-value]
