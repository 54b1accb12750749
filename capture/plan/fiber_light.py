"""How much light a plan of the fibre probe gives, before it is given.

The light of a milliwatt leaves a core of a fifth of a millimetre: nothing for skin, which spreads
it at once, but nobody may look into the fibre. So the shutter opens only while suction holds the
head on something, and the time is told after which an eye would be at its limit: the blue-light
limit of a source that somebody stares at is a weighted radiance times time of 1e6 J m^-2 sr^-1
within 1e4 s (IEC 62471:2006, section 4.3.3), of which here all light counts as blue. A laboratory
must measure.
"""

import math
from dataclasses import dataclass

from capture.plan.dose import BLUE_LIMIT_J_M2_SR
from capture.plan.probe import all_series
from capture.plan.steps import Plan, Step, require
from capture.rig import Light, Probe, Rig

SKIN_APERTURE_MM = 3.5
"""Over which irradiance of skin is averaged (ICNIRP 2013, doi:10.1097/HP.0b013e3182983fd4)."""


@dataclass(frozen=True, slots=True)
class FiberLight:
    """Light out of the source fibre."""

    led: str
    """Name of the light."""
    led_ws: float
    """All that a plan sends out, Ws."""
    placement_ws: float
    """The most of it at one placement of the head, Ws."""
    limit_ws: float
    """What may be sent out to one subject, Ws; inf where the rig names no limit."""
    skin_w_m2: float
    """Irradiance of the skin, averaged over `SKIN_APERTURE_MM`, W/m^2."""
    stare_s: float
    """After which an eye at the fibre would be at the blue-light limit, s."""


def fiber_light(plan: Plan, rig: Rig) -> FiberLight:
    """Return the light that a plan of the fibre probe gives.

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
    for placement, steps in all_series(plan):
        given_ws = sum(_given_ws(step, source) for step in steps)
        by_placement[placement] = by_placement.get(placement, 0.0) + given_ws
    core_m2 = math.pi * (0.5e-3 * probe.source_core_mm) ** 2
    # a cone of half angle asin(NA), evenly filled: etendue of the core
    etendue_m2_sr = core_m2 * math.pi * probe.source_numerical_aperture**2
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
    """Return the light that the source fibre sends out in a plan, Ws."""
    _, source = _source(rig)
    return sum(_given_ws(step, source) for step in plan.steps if step.kind != "dark")


def _given_ws(step: Step, source: Light) -> float:
    level = float(step.settings["level"])
    return (source.power_w or 0.0) * level * float(step.settings["exposure_s"])


def _source(rig: Rig) -> tuple[Probe, Light]:
    require(rig.probe is not None, "rig", rig.name, "one with a probe")
    return rig.probe, rig.lights[0]  # type: ignore[return-value]
