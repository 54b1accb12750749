"""Rows of light as the dome's box is told them, and as it switches them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from capture.devices import wire
from capture.devices.wire import Code
from rigsim.boxes.controller import Refused
from rigsim.boxes.eye_guard import Lit

LEVEL_STEPS = 1000
ROW_US = (2_000, 500_000)
_ROW_PATTERN = re.compile(r"(-|[0-9+]{1,400}):([0-9]{1,4}):([0-9]{1,7}):([0-9A-Fa-f]{1,8})")


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the table."""

    leds: tuple[int, ...]
    """Numbers of the LEDs that are on, rising; empty: dark."""
    level_steps: int
    """Light in thousandths of full."""
    dwell_us: int
    """How long, us."""
    mask: int
    """Cameras that are released: bit 0 is the first."""

    @property
    def level(self) -> float:
        """Light relative to full."""
        return self.level_steps / LEVEL_STEPS

    @property
    def dwell_s(self) -> float:
        """How long, s."""
        return self.dwell_us * 1e-6

    def __str__(self) -> str:
        """Return the row in the one spelling that the table's checksum is taken of."""
        leds = "+".join(map(str, self.leds)) or "-"
        return f"{leds}:{self.level_steps}:{self.dwell_us}:{self.mask:X}"


def parse_leds(text: str, *, count: int, at_once: int) -> tuple[int, ...]:
    """Return the numbers in ``3+17``, rising; refuse what is no list of existing LEDs."""
    parts = text.split("+")
    if not all(part.isdecimal() and len(part) <= 4 for part in parts):
        raise Refused(Code.SYNTAX, "expected LED numbers joined by +")
    numbers = tuple(sorted({int(part) for part in parts}))
    if len(numbers) != len(parts):
        raise Refused(Code.SYNTAX, "an LED stands twice")
    if numbers[-1] >= count:
        raise Refused(Code.OUT_OF_RANGE, f"expected LED 0 to {count - 1}")
    if len(numbers) > at_once:
        raise Refused(Code.OUT_OF_RANGE, f"expected at most {at_once} LEDs at once")
    return numbers


def parse_rows(text: str, *, count: int, at_once: int, cameras: int, most_us: int) -> list[Row]:
    """Return rows separated by ``;``, each ``leds:level:us:mask``."""
    rows = []
    for part in text.split(";"):
        found = _ROW_PATTERN.fullmatch(part)
        if found is None:
            raise Refused(Code.SYNTAX, "expected LEDS:LEVEL:US:MASK;...")
        leds_text, level, dwell, mask = found.groups()
        leds = () if leds_text == "-" else parse_leds(leds_text, count=count, at_once=at_once)
        row = Row(leds, int(level), int(dwell), int(mask, 16))
        if row.level_steps > LEVEL_STEPS or bool(leds) != bool(row.level_steps):
            raise Refused(Code.OUT_OF_RANGE, f"expected level 1 to {LEVEL_STEPS}, 0 when dark")
        if not ROW_US[0] <= row.dwell_us <= most_us:
            raise Refused(Code.OUT_OF_RANGE, f"expected {ROW_US[0]} to {most_us} us")
        if row.mask >= 1 << cameras:
            raise Refused(Code.OUT_OF_RANGE, f"expected a mask of {cameras} cameras")
        rows.append(row)
    return rows


def table_crc(rows: Sequence[object]) -> str:
    """Return the checksum of a table: CRC-16/IBM-3740 of its rows' texts joined by newlines."""
    return f"{wire.crc16(chr(10).join(map(str, rows)).encode()):04X}"


@dataclass(frozen=True, slots=True)
class Switch:
    """Something that the sequencer does at a time."""

    t_s: float
    """Since the sequence began, s."""
    what: str
    """``on``, ``turn`` (of one row into the next), ``pulse`` or ``end``."""
    row: int
    """Row that it belongs to."""


def switches(rows: Sequence[Row], *, overlap_s: float, settle_s: float) -> list[Switch]:
    """Return everything that happens in a sequence, in order of time.

    The next row's LEDs come on `overlap_s` before the last row's go off; cameras are released
    `settle_s` after the row's turn, when only its own LEDs are on and steady.
    """
    found: list[Switch] = []
    start_s = 0.0
    for number, row in enumerate(rows):
        if number:
            found.append(Switch(start_s - overlap_s, "on", number))
        found.append(Switch(start_s, "turn", number))
        found.append(Switch(start_s + settle_s, "pulse", number))
        start_s += row.dwell_s
    found.append(Switch(start_s, "end", len(rows) - 1))
    return sorted(found, key=lambda switch: switch.t_s)


def lit_by(rows: Sequence[Row], start_s: float, *, overlap_s: float) -> list[Lit]:
    """Return the light of a sequence that begins at `start_s`, per LED without gaps or overlap."""
    found: list[Lit] = []
    going: dict[int, tuple[float, float]] = {}  # LED -> level, since
    t_s = start_s
    for number, row in enumerate(rows):
        for led in [k for k in going if k not in row.leds or going[k][0] != row.level]:
            level, since = going.pop(led)
            found.append(Lit(led, level, since, t_s))
        before = rows[number - 1].leds if number else ()
        for led in row.leds:
            early = overlap_s if number and led not in before else 0.0
            going.setdefault(led, (row.level, t_s - early))
        t_s += row.dwell_s
    return found + [Lit(led, level, since, t_s) for led, (level, since) in going.items()]
