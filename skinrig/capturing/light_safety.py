"""What the light of LEDs will be for the subject, said before it is given."""

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
    "led": "LED that gives most",
    "led_ws": "energy from that LED, Ws",
    "limit_ws": "energy from an LED that is allowed, Ws",
    "blue_share": "of the blue-light limit of one that is stared at, %",
    "eye_j_m2": "light at the eyes, J/m²",
    "state_s": "light in a state of the skin, s",
    "duty": "mean level of an LED",
    "placement_ws": "energy in a placement, Ws",
    "skin_w_m2": "light into the skin, W/m²",
    "stare_s": "until an eye at the bare fibre would be at its blue-light limit, s",
}
"""What the figures of `light_figures` are, for tables that people read."""


def light_rows(figures: Mapping[str, float | str]) -> list[tuple[str, float | str]]:
    """Return figures of `light_figures` in words, with units, for a table.

    Parameters
    ----------
    figures
        By the names that `light_figures` gives them.

    Examples
    --------
    >>> light_rows({"open_eyes": "allowed", "blue_share": 0.25})
    [('open eyes', 'allowed'), ('of the blue-light limit of one that is stared at, %', 25.0)]
    """
    return [
        (LIGHT_FIGURE_LABELS[name], 100 * float(value) if name == "blue_share" else value)
        for name, value in figures.items()
    ]


def light_figures(plan: Plan, rig: Rig) -> Mapping[str, float | str]:
    """Return flicker and dose of a plan as JSON values, units in the names.

    Of patterns on skin also the light of a state, and the most mean level of an LED; open eyes are
    refused whatever the figures say, because the patch may lie beside an eye. Of the fibre probe,
    whose light stays under its head, the dose, and how long an eye could bear the bare fibre.

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
    for _, steps in group_by_state(plan):  # one is like the other
        light_s = sum(float(step.settings["dwell_s"]) for step in steps)
        skin = {"state_s": light_s, "duty": scan_duty(steps, rig)}
        break
    return {
        "flashes_per_s": flicker.flashes_per_s,
        "flicker_rms": flicker.rms,
        "open_eyes": "allowed" if flicker.within(limits) and not skin else "refused",
        **select_attributes(dose, "led", "led_ws", "limit_ws", "blue_share", "eye_j_m2"),
        **skin,
    }


def light_lines(plan: Plan, rig: Rig) -> list[str]:
    """Return the same as sentences, for the person who asks the subject.

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
            f"placement, {float(figures['led_ws']):.3g} Ws in all, {limits.dose_ws:g} Ws allowed; "
            f"{float(figures['skin_w_m2']):.0f} W/m2 over {SKIN_APERTURE_MM:g} mm",
            f"the fibre is not to be looked into: an eye would be at its blue-light limit after "
            f"{float(figures['stare_s']):.1f} s; the shutter opens only while the head is held on",
        ]
    verdict = "may be open" if figures["open_eyes"] == "allowed" else "must be closed or shielded"
    more = []
    if "state_s" in figures:
        verdict += ": the patch may lie beside one"
        more = [
            f"patterns: {figures['state_s']:.2f} s of light a state of the skin, mean level of an "
            f"LED at most {figures['duty']:.3f} over {limits.duty_window_s:g} s, "
            f"{limits.max_duty:g} allowed"
        ]
    return [
        f"flicker at the eyes: {figures['flashes_per_s']:.1f} flashes in the worst second, rms "
        f"{figures['flicker_rms']:.2f} of 3 to 65 Hz; eyes {verdict}",
        f"light dose: at most {figures['led_ws']:.3g} Ws from one LED ({figures['led']}), "
        f"{limits.dose_ws:g} Ws allowed; under {100 * float(figures['blue_share']):.2g} % of the "
        f"blue-light limit of one that is stared at; {figures['eye_j_m2']:.2g} J/m2 at the eyes",
        *more,
    ]
