"""Report the flicker and light dose of a plan before the subject is exposed to them."""

from collections.abc import Mapping
from typing import Final

from capture.plan import Plan
from capture.plan.dose import SKIN_APERTURE_MM, dose_report, fiber_light
from capture.plan.flicker import flicker_report
from capture.plan.gradient import group_by_state, scan_duty
from capture.rig import LedLimits, Rig
from skinrig.console import select_attributes

LIGHT_FIGURE_LABELS: Final[Mapping[str, str]] = {
    "flashes_per_s": "flashes in the worst second",
    "flicker_rms": "flicker of 3 to 65 Hz, root mean square over the mean",
    "open_eyes": "open eyes",
    "led": "LED with the highest energy",
    "led_ws": "energy from that LED, Ws",
    "limit_ws": "allowed energy from one LED, Ws",
    "blue_share": "fraction of the blue-light limit, staring into that LED, %",
    "eye_j_m2": "radiant exposure at the eyes, J/m²",
    "state_s": "light per strain step, s",
    "duty": "highest mean level of an LED",
    "placement_ws": "energy per placement, Ws",
    "skin_w_m2": "irradiance of the skin, W/m²",
    "stare_s": "time to the blue-light limit, staring into the bare fiber, s",
}
"""Labels of the figures of `light_figures`, for tables."""


def light_rows(figures: Mapping[str, float | str]) -> list[tuple[str, float | str]]:
    """Label the figures of `light_figures` with quantity and unit, for a table.

    Parameters
    ----------
    figures
        Values by the keys of `light_figures`; fractions become percent.

    Examples
    --------
    >>> light_rows({"open_eyes": "allowed", "blue_share": 0.25})
    [('open eyes', 'allowed'), ('fraction of the blue-light limit, staring into that LED, %', 25.0)]
    """
    return [
        (LIGHT_FIGURE_LABELS[name], 100 * float(value) if name == "blue_share" else value)
        for name, value in figures.items()
    ]


def light_figures(plan: Plan, rig: Rig) -> Mapping[str, float | str]:
    """Compute flicker and light dose of a plan as JSON values, with units in the keys.

    For patterns on skin, the light per strain step and the highest mean level of an LED are added.
    Open eyes are then refused in every case, because the patch may be next to an eye. For the
    fiber probe, whose light stays under its head, the result is the dose and the time to the
    blue-light limit of an eye at the bare fiber.

    Examples
    --------
    >>> from capture.plan.dome import dome_plan
    >>> from capture.rig import load_rig
    >>> figures = light_figures(dome_plan(load_rig("dome")), load_rig("dome"))
    >>> figures["flashes_per_s"], figures["open_eyes"]
    (1.0, 'allowed')
    """
    if rig.probe is not None:
        light = fiber_light(plan, rig)
        names = ("led", "led_ws", "limit_ws", "placement_ws", "skin_w_m2", "stare_s")
        return select_attributes(light, *names)
    flicker, dose = flicker_report(plan, rig), dose_report(plan, rig)
    limits = rig.leds or LedLimits()
    skin: dict[str, float | str] = {}
    for _, steps in group_by_state(plan):  # all states get the same light: the first is enough
        light_s = sum(float(step.settings["dwell_s"]) for step in steps)
        skin = {"state_s": light_s, "duty": scan_duty(steps, rig)}
        break
    striped = any(step.kind == "stripes" for step in plan.steps)
    return {
        "flashes_per_s": flicker.flashes_per_s,
        "flicker_rms": flicker.rms,
        "open_eyes": "refused" if skin or striped or not flicker.within(limits) else "allowed",
        **select_attributes(dose, "led", "led_ws", "limit_ws", "blue_share", "eye_j_m2"),
        **skin,
    }


def light_lines(plan: Plan, rig: Rig) -> list[str]:
    """Describe the figures of `light_figures` in sentences, for the operator.

    Examples
    --------
    >>> from capture.plan.dome import dome_plan
    >>> from capture.rig import load_rig
    >>> light_lines(dome_plan(load_rig("dome")), load_rig("dome"))[0]
    'flicker at the eyes: 1.0 flashes in the worst second, rms 0.12 of 3 to 65 Hz; eyes may be open'
    """
    limits = rig.leds or LedLimits()
    figures = light_figures(plan, rig)
    if rig.probe is not None:
        return [
            f"light into the skin: at most {1e3 * float(figures['placement_ws']):.3g} mWs at one "
            f"placement, {float(figures['led_ws']):.3g} Ws in total, {limits.dose_ws:g} Ws "
            f"allowed; {float(figures['skin_w_m2']):.0f} W/m2 over {SKIN_APERTURE_MM:g} mm",
            f"do not look into the fiber: an eye reaches its blue-light limit after "
            f"{float(figures['stare_s']):.1f} s; the shutter opens only under suction",
        ]
    verdict = "may be open" if figures["open_eyes"] == "allowed" else "must be closed or shielded"
    more = []
    if "state_s" in figures:
        verdict += ": the patch may be next to an eye"
        more = [
            f"patterns: {figures['state_s']:.2f} s of light per strain step, mean level of an LED "
            f"at most {figures['duty']:.3f} over {limits.duty_window_s:g} s, "
            f"{limits.max_duty:g} allowed"
        ]
    return [
        f"flicker at the eyes: {figures['flashes_per_s']:.1f} flashes in the worst second, rms "
        f"{figures['flicker_rms']:.2f} of 3 to 65 Hz; eyes {verdict}",
        f"light dose: at most {figures['led_ws']:.3g} Ws from one LED ({figures['led']}), "
        f"{limits.dose_ws:g} Ws allowed; under {100 * float(figures['blue_share']):.2g} % of its "
        f"blue-light limit for staring eyes; {figures['eye_j_m2']:.2g} J/m2 at the eyes",
        *more,
    ]
