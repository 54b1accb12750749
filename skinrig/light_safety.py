"""What the dome's light will be for the subject, said before it is given."""

from __future__ import annotations

from collections.abc import Mapping

from capture.plan import Plan
from capture.plan.dose import dose_report
from capture.plan.flicker import flicker_report
from capture.rig import LedLimits, Rig


def light_figures(plan: Plan, rig: Rig) -> Mapping[str, float | str]:
    """Return flicker and dose of a plan of the dome as JSON values, units in the names.

    Examples
    --------
    >>> from capture.plan.dome import dome_plan
    >>> from capture.rig import load_rig
    >>> figures = light_figures(dome_plan(load_rig("dome")), load_rig("dome"))
    >>> figures["flashes_per_s"], figures["open_eyes"]
    (1.0, 'allowed')
    """
    flicker, dose = flicker_report(plan, rig), dose_report(plan, rig)
    limits = rig.leds or LedLimits()
    return {
        "flashes_per_s": flicker.flashes_per_s,
        "flicker_rms": flicker.rms,
        "open_eyes": "allowed" if flicker.within(limits) else "refused",
        "led": dose.led,
        "led_ws": dose.led_ws,
        "limit_ws": dose.limit_ws,
        "blue_share": dose.blue_share,
        "eye_j_m2": dose.eye_j_m2,
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
    verdict = "may be open" if figures["open_eyes"] == "allowed" else "must be closed or shielded"
    return [
        f"flicker at the eyes: {figures['flashes_per_s']:.1f} flashes in the worst second, rms "
        f"{figures['flicker_rms']:.2f} of 3 to 65 Hz; eyes {verdict}",
        f"light dose: at most {figures['led_ws']:.3g} Ws from one LED ({figures['led']}), "
        f"{limits.dose_ws:g} Ws allowed; under {100 * float(figures['blue_share']):.2g} % of the "
        f"blue-light limit of one that is stared at; {figures['eye_j_m2']:.2g} J/m2 at the eyes",
    ]
