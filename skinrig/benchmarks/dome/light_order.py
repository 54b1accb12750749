"""Benchmark of the order in which the dome shows its lights: flicker against planning time."""

from collections.abc import Callable
from functools import partial

from capture.plan.eye_light import eye_light
from capture.plan.flicker import FlickerReport, flicker_of_rows
from capture.plan.light_order import LIGHT_ORDERS, best_order
from capture.plan.rows import LedRow
from capture.rig import LedLimits, Rig, load_rig
from skinrig.benchmarks.results import BandError
from skinrig.benchmarks.stage import Stage

DWELL_S = 1.0 / 12.0
DARK_TIME_FRACTION = 0.3
"""Share of each light's time that is dark where lights do not overlap."""


def light_order(stage: Stage) -> None:
    """Time each order of the lights and take the flicker of one pass at open eyes."""
    rig = load_rig("dome")
    rig = rig.subset(lights=[light.name for light in rig.lights[::3]]) if stage.toy else rig
    limits = rig.leds or LedLimits()
    found = {}
    orders: dict[str, Callable[[Rig], list[int]]] = dict(LIGHT_ORDERS)
    orders["chosen"] = partial(best_order, dwell_s=DWELL_S)
    for name, order in orders.items():
        timing, shown = stage.time(partial(order, rig), repeats=1)
        for gaps in (False, True) if name == "spiral" else (False,):
            found[name, gaps] = flicker = _flicker(rig, shown, gaps=gaps)
            stage.add(
                {"order": name, "gaps": "dark" if gaps else "none"},
                timing,
                BandError.around(100.0 * flicker.rms, 0.0),
                {"flashes a second": flicker.flashes_per_s},
            )
    chosen, worst = found["chosen", False], found["spiral", True]
    stage.limits = {
        "flashes": (chosen.flashes_per_s, limits.max_flashes_per_s - 0.5),
        "rms": (chosen.rms, limits.max_flicker_rms),
        "reduction": worst.rms / chosen.rms,
    }


def _flicker(rig: Rig, shown: list[int], *, gaps: bool) -> FlickerReport:
    rows = []
    for light in shown:
        lit_s = DWELL_S * (1.0 - DARK_TIME_FRACTION * gaps)
        rows.append(LedRow((light,), 1.0, lit_s))
        if gaps:
            rows.append(LedRow((), 0.0, DWELL_S - lit_s))
    overlap_s = rig.leds.overlap_s if rig.leds is not None and not gaps else 0.0
    return flicker_of_rows(rows, eye_light(rig), overlap_s=overlap_s)
