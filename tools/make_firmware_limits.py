"""Write the headers of limits of the reference firmware from the shipped rig files.

Usage: python tools/make_firmware_limits.py

Each header of firmware/limits contains one box: its identity, its commands with their arguments,
its limits as the text of SYST:CAP?, and the numbers that its code computes with. Nothing of them is
written by hand, so that the firmware and the emulated box cannot drift apart.
"""

# ruff: noqa: SLF001 - the numbers are those that the emulated boxes compute with
import json
from pathlib import Path

import numpy as np

from capture.rig import Rig, load_rig
from rigsim.boxes.controller import FIRMWARE_VERSION, Controller
from rigsim.boxes.device import Wiring
from rigsim.boxes.faults import NO_FAULTS, Faults
from rigsim.package_data import package_table
from rigsim.world.rig_boxes import BOXES, make_box

ROOT = Path(__file__).parents[1]
LIMITS = ROOT / "firmware" / "limits"
SECTIONS = {"dome": ("led_sequencer",), "gradient_sphere": ("led_sequencer",)}
"""Sections of the manuals beside those of all boxes and the box's own."""


class _NoLoad:
    """Stand for the skin and the head while a box is built for its limits."""

    force_n = 0.0

    def __getattr__(self, name: str) -> object:
        return lambda *_: 0.0


def reference_box(name: str, rig: Rig, faults: Faults = NO_FAULTS) -> Controller:
    """Return the emulated box of a rig, which is connected to nothing."""
    load = _NoLoad()
    rng = np.random.default_rng(0)
    return make_box(name, Wiring(rig=rig, rng=rng, faults=faults, skin=load, head=load))


def _quoted(text: str) -> str:
    return json.dumps(text)


def _define(name: str, value: object) -> str:
    return f"#define {name} {value}"


def _array(kind: str, name: str, values: object) -> str:
    body = ", ".join(format(v, "d") if isinstance(v, int) else repr(float(v)) for v in values)
    return f"static const FLASH {kind} {name}[] = {{{body}}};"


def handler_name(header: str) -> str:
    """Return the name of the C function that carries out a command.

    Examples
    --------
    >>> handler_name("FLAS:POL?"), handler_name("*RST")
    ('get_flas_pol', 'do_rst')
    """
    word = header.rstrip("?").lstrip("*").replace(":", "_").lower()
    return ("get_" if header.endswith("?") else "do_") + word


def command_rows(name: str) -> list[str]:
    """Return the rows of a box's command table, from the manuals."""
    manuals = package_table("box_commands")
    found = []
    for section in ("any", *SECTIONS.get(name, ()), name):
        for header, row in manuals[section].items():
            needs = [flag.upper() for flag in ("armed", "bare") if row.get(flag)]
            fields = (
                handler_name(header),
                _quoted(header),
                _quoted(row.get("arguments", "")),
                " | ".join(needs) or "0",
                _quoted("".join(row.get("harmless", ()))),
            )
            found.append(f"  X({', '.join(fields)})")
    return found


def _us(seconds: float) -> int:
    return round(1e6 * seconds)


def _flash(box: Controller) -> list[str]:
    unit = box.device
    return [
        _define("RECYCLE_US", _us(unit.rig.recycle_s)),
        _define("POPS_PER_MIN", unit._pops_per_min),
        _define("QUARTER_TURN_US", _us(unit.rig.polarizer_move_s)),
        _define("CHARGE_TAU_S", repr(unit._charge_tau_s)),
        _define("INITIAL_HEAT", repr(float(unit.faults.heat))),
    ]


def _leds(box: Controller) -> list[str]:
    unit = box.device
    limits = unit.bank.limits
    return [
        _define("LEDS", unit.bank.count),
        _define("CAMERAS", unit._cameras),
        _define("MAX_ROWS", limits.max_rows),
        _define("MAX_AT_ONCE", limits.max_at_once),
        _define("ROW_MAX_US", unit._row_max_us),
        _define("LED_MAX_US", _us(min(0.5, limits.max_on_s))),
        _define("MAX_DUTY", repr(float(limits.max_duty))),
        _define("DUTY_WINDOW_US", _us(limits.duty_window_s)),
        _define("THERMAL_TAU_S", repr(float(limits.thermal_tau_s))),
        _define("THERMAL_TRIP", repr(float(limits.thermal_trip))),
        _define("DOSE_NANO_WS", round(1e9 * limits.dose_ws)),
        _define("DOSE_WS", repr(float(limits.dose_ws))),
        _define("MAX_FLASHES_PER_S", repr(float(limits.max_flashes_per_s))),
        _define("MAX_FLICKER_RMS", repr(float(limits.max_flicker_rms))),
        _define("OVERLAP_US", _us(limits.overlap_s)),
        _define("SETTLE_US", _us(limits.settle_s)),
        _define("INITIAL_HEAT", repr(float(unit.faults.heat))),
        _array("double", "LED_POWER_W", unit.bank._power_w),
        _array("double", "LED_EYE_WEIGHT", unit._guard.weights),
    ]


def _gradient_sphere(box: Controller) -> list[str]:
    shares = box.device._shares
    names = ("full", "x", "y", "z", "-x", "-y", "-z")
    rows = [", ".join(repr(float(v)) for v in shares[name]) for name in names]
    body = ",\n".join(f"  {{{row}}}" for row in rows)
    return [
        *_leds(box),
        _define("QUARTER_TURN_US", _us(box.device.rig.polarizer_move_s)),
        f"static const FLASH double PATTERN_SHARE[{len(names)}][LEDS] = {{\n{body}}};",
    ]


def _caliper(box: Controller) -> list[str]:
    unit = box.device
    caliper = unit._caliper
    return [
        _define("STEP_MIN", f"({unit.step_min})"),
        _define("STEP_MAX", unit.step_max),
        _define("STEP_MM", repr(float(caliper.step_mm))),
        _define("APERTURE_MM", repr(float(caliper.aperture_mm))),
        _define("SPEED_MM_PER_S", repr(float(caliper.speed_mm_per_s))),
        _define("TRAVEL_LOW_MM", repr(float(unit._ends_mm[0]))),
        _define("TRAVEL_HIGH_MM", repr(float(unit._ends_mm[1]))),
        _array("int32_t", "ANGLES_MDEG", [round(1e3 * angle) for angle in caliper.angles_deg]),
        _define("ANGLE_COUNT", len(caliper.angles_deg)),
    ]


def _probe(box: Controller) -> list[str]:
    unit = box.device
    probe = unit._probe
    return [
        _define("FIBERS", len(probe.fibers)),
        _define("SHUTTER_MAX_US", _us(probe.max_open_s)),
        _define("SUCTION_MAX_UBAR", _us(probe.max_suction_mbar * 1e-3)),
        _define("SUCTION_MAX_US", _us(probe.max_suction_s)),
        _define("REST_US", _us(probe.rest_s)),
        _define("SOURCE_W", repr(float(unit.shutter._power_w))),
        _define("DOSE_WS", repr(float(unit.shutter.dose_limit_ws))),
        _define("DOSE_NANO_WS", round(1e9 * unit.shutter.dose_limit_ws)),
    ]


def _scanner(box: Controller) -> list[str]:
    unit = box.device
    scanner = unit._scanner
    projectors, views = scanner.projectors, scanner.views
    counts = {
        axis: [scanner.pattern_count(projector, axis) for projector in projectors]
        for axis in ("columns", "rows")
    }
    masks = [
        sum(1 << number for number, view in enumerate(views) if view.name in projector.cameras)
        for projector in projectors
    ]
    return [
        _define("PROJECTORS", len(projectors)),
        _define("CAMERAS", len(views)),
        _define("SETTLE_US", _us(scanner.settle_s)),
        _define("MAX_SHOW_US", _us(scanner.max_show_s)),
        _define("DOSE_NANO_WS", round(1e9 * unit._dose_limit_ws)),
        _define("DOSE_WS", repr(float(unit._dose_limit_ws))),
        _array("uint16_t", "COLUMN_PATTERNS", counts["columns"]),
        _array("uint16_t", "ROW_PATTERNS", counts["rows"]),
        _array("uint32_t", "RELEASED_CAMERAS", masks),
        _array("double", "PROJECTOR_W", [projector.power_w for projector in projectors]),
    ]


NUMBERS = {
    "flash": _flash,
    "dome": _leds,
    "gradient_sphere": _gradient_sphere,
    "caliper": _caliper,
    "probe": _probe,
    "scanner": _scanner,
}
"""Numbers of each box."""


def limits_header(name: str, rig: Rig, faults: Faults = NO_FAULTS) -> str:
    """Return the header of one box of a rig."""
    box = reference_box(name, rig, faults)
    limits = box._get_capabilities("", 0.0).rpartition("*")[0]
    lines = [
        f"/* Limits of the {name} box of rig {rig.name!r}.",
        " * Made by tools/make_firmware_limits.py. */",
        "#ifndef FIRMWARE_LIMITS_H",
        "#define FIRMWARE_LIMITS_H",
        "",
        '#include "core/text.h"',
        "",
        _define("BOX_KIND", _quoted(box.device.kind)),
        _define("BOX_MODEL", _quoted(box.device.model)),
        "#ifndef BOX_SERIAL",
        _define("BOX_SERIAL", _quoted(box.serial)),
        "#endif",
        _define("BOX_FIRMWARE", _quoted(FIRMWARE_VERSION)),
        _define("BOX_PROTOCOL", _quoted(str(box._protocol))),
        _define("BOX_CAPABILITIES", _quoted(limits)),
        "",
        *NUMBERS[name](box),
        "",
        "/* X(handler, header, arguments, needs, arguments that make dark) */",
        "#define BOX_COMMANDS(X) \\\n" + " \\\n".join(command_rows(name)),
        "",
        "#endif",
        "",
    ]
    return "\n".join(lines)


def shipped_headers() -> dict[str, str]:
    """Return the headers of all boxes with the limits of the shipped rigs, by box."""
    return {name: limits_header(name, load_rig(BOXES[name].rig)) for name in NUMBERS}


def main() -> None:
    for name, text in shipped_headers().items():
        folder = LIMITS / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "limits.h").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
