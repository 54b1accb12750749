"""Patterns of light as the gradient sphere's box is told them, and as it steps through them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture.devices.wire import Code
from capture.plan.steps import LIGHT_PATTERNS
from capture.rig import Light
from rigsim.arrays import Float64Array
from rigsim.boxes.controller import Refused, number
from rigsim.boxes.led_table import LEVEL_STEPS, ROW_US, Switch

ANALYZER_RANGE_DEG = (0.0, 180.0)
_ROW_PATTERN = re.compile(
    r"([A-Za-z-]{1,4}):([0-9]{1,3}(?:\.[0-9]{1,3})?):([0-9]{1,4}):([0-9]{1,7}):([0-9A-Fa-f]{1,8})"
)


@dataclass(frozen=True, slots=True)
class PatternRow:
    """One row of a scan."""

    pattern: str
    """full, x, y, z, -x, -y, -z or dark."""
    analyser_deg: float
    """Reading of the analyser, degrees; where it differs from the row before, it is turned."""
    level_steps: int
    """Light in thousandths of full, 0 when dark."""
    dwell_us: int
    """How long, us, without the turning before."""
    mask: int
    """Cameras that are released: bit 0 is the first."""

    @property
    def level(self) -> float:
        """Light relative to full."""
        return self.level_steps / LEVEL_STEPS

    def __str__(self) -> str:
        """Return the row in the one spelling that the table's checksum is taken of."""
        angle = f"{self.analyser_deg:.3f}".rstrip("0").rstrip(".")
        text = f"{self.pattern.upper()}:{angle}:{self.level_steps}:{self.dwell_us}"
        return f"{text}:{self.mask:X}"


def pattern_name(text: str) -> str:
    """Return the pattern that a command names, or refuse."""
    name = text.lower()
    if name not in LIGHT_PATTERNS:
        raise Refused(Code.SYNTAX, f"expected {' or '.join(LIGHT_PATTERNS).upper()}")
    return name


def parse_patterns(text: str, *, cameras: int, most_us: int) -> list[PatternRow]:
    """Return rows separated by ``;``, each ``pattern:degrees:level:us:mask``."""
    rows = []
    for part in text.split(";"):
        found = _ROW_PATTERN.fullmatch(part)
        if found is None:
            raise Refused(Code.SYNTAX, "expected PATTERN:DEGREES:LEVEL:US:MASK;...")
        name, angle, level, dwell, mask = found.groups()
        pattern = pattern_name(name)
        angle_deg = number(angle, *ANALYZER_RANGE_DEG, "degrees")
        row = PatternRow(pattern, angle_deg, int(level), int(dwell), int(mask, 16))
        if row.level_steps > LEVEL_STEPS or (pattern == "dark") != (row.level_steps == 0):
            raise Refused(Code.OUT_OF_RANGE, f"expected level 1 to {LEVEL_STEPS}, 0 when dark")
        if not ROW_US[0] <= row.dwell_us <= most_us:
            raise Refused(Code.OUT_OF_RANGE, f"expected {ROW_US[0]} to {most_us} us")
        if row.mask >= 1 << cameras:
            raise Refused(Code.OUT_OF_RANGE, f"expected a mask of {cameras} cameras")
        rows.append(row)
    return rows


def pattern_shares(lights: Sequence[Light]) -> dict[str, Float64Array]:
    """Return what each pattern asks of each LED, 0 to 1: pattern -> (L,).

    Examples
    --------
    >>> led = Light(name="a", position_mm=(0, 300, 400), radius_mm=3, power_w=1)
    >>> {name: float(share[0].round(9)) for name, share in pattern_shares([led]).items()}
    {'full': 1.0, 'x': 0.5, 'y': 0.8, 'z': 0.9, '-x': 0.5, '-y': 0.2, '-z': 0.1, 'dark': 0.0}
    """
    places = np.array([light.position_mm for light in lights], np.float64)
    ways = places / np.linalg.norm(places, axis=1, keepdims=True)
    shares = {"full": np.ones(len(lights)), "dark": np.zeros(len(lights))}
    for column, name in enumerate("xyz"):
        shares[name] = 0.5 * (1.0 + ways[:, column])
        shares["-" + name] = 0.5 * (1.0 - ways[:, column])
    return {name: shares[name] for name in LIGHT_PATTERNS}


def starts(
    rows: Sequence[PatternRow], *, reading_deg: float, s_per_deg: float
) -> list[tuple[float, float]]:
    """Return when each row's turning of the analyser begins and when its light does, s.

    Parameters
    ----------
    rows
        The scan; it begins at 0 s.
    reading_deg
        Where the analyser stands before it, degrees.
    s_per_deg
        How long it takes per degree.
    """
    found = []
    t_s = 0.0
    for row in rows:
        lit_s = t_s + abs(row.analyser_deg - reading_deg) * s_per_deg
        found.append((t_s, lit_s))
        reading_deg = row.analyser_deg
        t_s = lit_s + row.dwell_us * 1e-6
    return found


def schedule(
    rows: Sequence[PatternRow], *, reading_deg: float, s_per_deg: float, settle_s: float
) -> list[Switch]:
    """Return everything that happens in a scan, in order of time.

    ``rotate``: dark, and the analyser begins to turn; ``light``: a row's pattern comes on in place
    of the last; ``pulse``: its cameras are released, `settle_s` later; ``end``.
    """
    found: list[Switch] = []
    end_s = 0.0
    times = starts(rows, reading_deg=reading_deg, s_per_deg=s_per_deg)
    for place, (row, (turn_s, lit_s)) in enumerate(zip(rows, times, strict=True)):
        if not math.isclose(turn_s, lit_s, abs_tol=1e-12):
            found.append(Switch(turn_s, "rotate", place))
        found.append(Switch(lit_s, "light", place))
        found.append(Switch(lit_s + settle_s, "pulse", place))
        end_s = lit_s + row.dwell_us * 1e-6
    return [*found, Switch(end_s, "end", len(rows) - 1)]
