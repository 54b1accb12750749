"""Parse and schedule the rows of light that hosts send to controllers with LEDs."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from capture.devices import wire
from capture.devices.wire import Code
from capture.plan.steps import LIGHT_PATTERNS
from capture.rig import Light
from rigsim.arrays import Float64Array
from rigsim.boxes.command import CommandRefused, add_us, parse_number, rotation_us

LEVEL_STEPS = 1000
ROW_RANGE_US = (2_000, 500_000)
ANALYZER_RANGE_DEG = (0.0, 180.0)
_PATTERN_ROW_PATTERN = re.compile(
    r"([A-Za-z-]{1,4}):([0-9]{1,3}(?:\.[0-9]{1,3})?):([0-9]{1,4}):([0-9]{1,7}):([0-9A-Fa-f]{1,8})"
)
_ROW_PATTERN = re.compile(r"(-|[0-9+]{1,400}):([0-9]{1,4}):([0-9]{1,7}):([0-9A-Fa-f]{1,8})")


@dataclass(frozen=True, slots=True)
class LedPulse:
    """Light of one LED between two switching times, past or to come."""

    led: int
    """Number of the LED, an index into the rig's lights."""
    level: float
    """Emitted light relative to full, 0 to 1; a weak LED emits less than requested."""
    t_on_s: float
    """World time when it came on, s."""
    t_off_s: float
    """World time when it went off, s."""


class TableRow:
    """Fields of the rows of all tables; the checksum covers the text of a row."""

    __slots__ = ()
    level_steps: int
    """Light in thousandths of full, 0 when dark."""
    dwell_us: int
    """Time for which it is lit, us."""
    mask: int
    """Cameras that are released: bit 0 is the first."""

    @property
    def level(self) -> float:
        """Light relative to full."""
        return self.level_steps / LEVEL_STEPS

    @property
    def dwell_s(self) -> float:
        """Time for which it is lit, s."""
        return self.dwell_us * 1e-6

    def require_valid(self, is_dark: bool, *, cameras: int, max_us: int) -> Self:
        """Return the row, or refuse values that the controller does not support."""
        if self.level_steps > LEVEL_STEPS or is_dark != (self.level_steps == 0):
            raise CommandRefused(
                Code.OUT_OF_RANGE, f"expected level 1 to {LEVEL_STEPS}, 0 when dark"
            )
        if not ROW_RANGE_US[0] <= self.dwell_us <= max_us:
            raise CommandRefused(Code.OUT_OF_RANGE, f"expected {ROW_RANGE_US[0]} to {max_us} us")
        if self.mask >= 1 << cameras:
            raise CommandRefused(Code.OUT_OF_RANGE, f"expected a mask of {cameras} cameras")
        return self


@dataclass(frozen=True, slots=True)
class LedTableRow(TableRow):
    """One row of the table."""

    leds: tuple[int, ...]
    """Numbers of the lit LEDs, ascending; empty: dark."""
    level_steps: int
    """Light in thousandths of full."""
    dwell_us: int
    """Time for which it is lit, us."""
    mask: int
    """Cameras that are released: bit 0 is the first."""

    def __str__(self) -> str:
        """Return the row in the canonical spelling that the table's checksum covers."""
        leds = "+".join(map(str, self.leds)) or "-"
        return f"{leds}:{self.level_steps}:{self.dwell_us}:{self.mask:X}"


def parse_leds(text: str, *, count: int, max_leds: int) -> tuple[int, ...]:
    """Parse ``3+17`` to ascending numbers; refuse text that is not a list of existing LEDs."""
    parts = text.split("+")
    if not all(part.isdecimal() and len(part) <= 4 for part in parts):
        raise CommandRefused(Code.SYNTAX, "expected LED numbers joined by +")
    numbers = tuple(sorted({int(part) for part in parts}))
    CommandRefused.raise_if(len(numbers) != len(parts), Code.SYNTAX, "an LED is listed twice")
    CommandRefused.raise_if(
        numbers[-1] >= count, Code.OUT_OF_RANGE, f"expected LED 0 to {count - 1}"
    )
    if len(numbers) > max_leds:
        raise CommandRefused(Code.OUT_OF_RANGE, f"expected at most {max_leds} LEDs at once")
    return numbers


def parse_rows(
    text: str, *, count: int, max_leds: int, cameras: int, max_us: int
) -> list[LedTableRow]:
    """Parse rows separated by ``;``, each ``leds:level:us:mask``."""
    rows = []
    for part in text.split(";"):
        found = _ROW_PATTERN.fullmatch(part)
        if found is None:
            raise CommandRefused(Code.SYNTAX, "expected LEDS:LEVEL:US:MASK;...")
        leds_text, level, dwell, mask = found.groups()
        leds = () if leds_text == "-" else parse_leds(leds_text, count=count, max_leds=max_leds)
        row = LedTableRow(leds, int(level), int(dwell), int(mask, 16))
        rows.append(row.require_valid(not leds, cameras=cameras, max_us=max_us))
    return rows


def table_crc(rows: Sequence[object]) -> str:
    """Return the checksum of a table: CRC-16/IBM-3740 of its rows' texts joined by newlines."""
    return f"{wire.crc16(chr(10).join(map(str, rows)).encode()):04X}"


@dataclass(frozen=True, slots=True)
class SequenceEvent:
    """An action of the sequencer at a time."""

    t_s: float
    """Time since the sequence began, s."""
    action: str
    """``on``, ``turn`` (from one row to the next), ``pulse`` or ``end``."""
    row: int
    """Row that it belongs to."""


def schedule_rows(
    rows: Sequence[LedTableRow], *, overlap_s: float, settle_s: float
) -> list[SequenceEvent]:
    """Return all events of a sequence, in order of time.

    The next row's LEDs come on `overlap_s` before the last row's go off. Cameras are released
    `settle_s` after the row's turn, when only its own LEDs are on and steady.
    """
    found: list[SequenceEvent] = []
    overlap_us, settle_us = round(1e6 * overlap_s), round(1e6 * settle_s)
    start_us = 0
    for place, row in enumerate(rows):
        if place:
            found.append(SequenceEvent((start_us - overlap_us) / 1e6, "on", place))
        found.append(SequenceEvent(start_us / 1e6, "turn", place))
        found.append(SequenceEvent((start_us + settle_us) / 1e6, "pulse", place))
        start_us += row.dwell_us
    found.append(SequenceEvent(start_us / 1e6, "end", len(rows) - 1))
    return sorted(found, key=lambda switch: switch.t_s)


def pulses_from_rows(
    rows: Sequence[LedTableRow], start_s: float, *, overlap_s: float
) -> list[LedPulse]:
    """Return the light of a sequence that begins at `start_s`, per LED without gaps or overlap."""
    found: list[LedPulse] = []
    going: dict[int, tuple[float, float]] = {}  # LED -> level, since
    t_us = 0
    for place, row in enumerate(rows):
        t_s = add_us(start_s, t_us)
        for led in [k for k in going if k not in row.leds or going[k][0] != row.level]:
            level, since = going.pop(led)
            found.append(LedPulse(led, level, since, t_s))
        before = rows[place - 1].leds if place else ()
        for led in row.leds:
            early = overlap_s if place and led not in before else 0.0
            going.setdefault(led, (row.level, add_us(t_s, -1e6 * early)))
        t_us += row.dwell_us
    t_s = add_us(start_s, t_us)
    return found + [LedPulse(led, level, since, t_s) for led, (level, since) in going.items()]


@dataclass(frozen=True, slots=True)
class PatternRow(TableRow):
    """One row of a scan."""

    pattern: str
    """full, x, y, z, -x, -y, -z or dark."""
    analyzer_deg: float
    """Reading of the analyzer, degrees; where it differs from the row before, the analyzer
    turns."""
    level_steps: int
    """Light in thousandths of full, 0 when dark."""
    dwell_us: int
    """Time for which it is lit, us, without the turning before."""
    mask: int
    """Cameras that are released: bit 0 is the first."""

    def __str__(self) -> str:
        """Return the row in the canonical spelling that the table's checksum covers."""
        angle = f"{self.analyzer_deg:.3f}".rstrip("0").rstrip(".")
        text = f"{self.pattern.upper()}:{angle}:{self.level_steps}:{self.dwell_us}"
        return f"{text}:{self.mask:X}"


def parse_pattern_name(text: str) -> str:
    """Parse the pattern name of a command, or refuse."""
    name = text.lower()
    if name not in LIGHT_PATTERNS:
        raise CommandRefused(Code.SYNTAX, f"expected {' or '.join(map(str.upper, LIGHT_PATTERNS))}")
    return name


def parse_pattern_rows(text: str, *, cameras: int, max_us: int) -> list[PatternRow]:
    """Parse rows separated by ``;``, each ``pattern:degrees:level:us:mask``."""
    rows = []
    for part in text.split(";"):
        found = _PATTERN_ROW_PATTERN.fullmatch(part)
        if found is None:
            raise CommandRefused(Code.SYNTAX, "expected PATTERN:DEGREES:LEVEL:US:MASK;...")
        name, angle, level, dwell, mask = found.groups()
        pattern = parse_pattern_name(name)
        angle_deg = parse_number(angle, *ANALYZER_RANGE_DEG, "degrees")
        row = PatternRow(pattern, angle_deg, int(level), int(dwell), int(mask, 16))
        rows.append(row.require_valid(pattern == "dark", cameras=cameras, max_us=max_us))
    return rows


def pattern_led_fractions(lights: Sequence[Light]) -> dict[str, Float64Array]:
    """Return each LED's level in each pattern, 0 to 1: pattern -> (L,).

    Examples
    --------
    >>> led = Light(name="a", position_mm=(0, 300, 400), radius_mm=3, power_w=1)
    >>> {name: float(share[0].round(9)) for name, share in pattern_led_fractions([led]).items()}
    {'full': 1.0, 'x': 0.5, 'y': 0.8, 'z': 0.9, '-x': 0.5, '-y': 0.2, '-z': 0.1, 'dark': 0.0}
    """
    places = np.array([light.position_mm for light in lights], np.float64)
    ways = places / np.linalg.norm(places, axis=1, keepdims=True)
    shares = {"full": np.ones(len(lights)), "dark": np.zeros(len(lights))}
    for column, name in enumerate("xyz"):
        shares[name] = 0.5 * (1.0 + ways[:, column])
        shares["-" + name] = 0.5 * (1.0 - ways[:, column])
    return {name: shares[name] for name in LIGHT_PATTERNS}


def pattern_start_times(
    rows: Sequence[PatternRow], *, reading_deg: float, quarter_turn_us: int
) -> list[tuple[float, float]]:
    """Return the start of each row's analyzer rotation and of its light, s.

    Parameters
    ----------
    rows
        The scan; it begins at 0 s.
    reading_deg
        Reading of the analyzer before the scan, degrees.
    quarter_turn_us
        Time of a rotation by 90 degrees, us.
    """
    found = []
    t_us = 0
    for row in rows:
        angle_mdeg = round(1e3 * (row.analyzer_deg - reading_deg))
        lit_us = t_us + rotation_us(angle_mdeg, quarter_turn_us)
        found.append((t_us / 1e6, lit_us / 1e6))
        reading_deg = row.analyzer_deg
        t_us = lit_us + row.dwell_us
    return found


def schedule_pattern_rows(
    rows: Sequence[PatternRow], *, reading_deg: float, quarter_turn_us: int, settle_s: float
) -> list[SequenceEvent]:
    """Return all events of a scan, in order of time.

    ``rotate``: dark, and the analyzer begins to turn. ``light``: a row's pattern replaces the last.
    ``pulse``: its cameras are released, `settle_s` later. ``end``: the scan ends.
    """
    found: list[SequenceEvent] = []
    end_s = 0.0
    times = pattern_start_times(rows, reading_deg=reading_deg, quarter_turn_us=quarter_turn_us)
    for place, (row, (turn_s, lit_s)) in enumerate(zip(rows, times, strict=True)):
        if turn_s != lit_s:
            found.append(SequenceEvent(turn_s, "rotate", place))
        found.append(SequenceEvent(lit_s, "light", place))
        found.append(SequenceEvent(add_us(lit_s, 1e6 * settle_s), "pulse", place))
        end_s = add_us(lit_s, row.dwell_us)
    return [*found, SequenceEvent(end_s, "end", len(rows) - 1)]
