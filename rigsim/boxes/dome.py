"""The dome's box: LEDs stepped by a table, cameras released by a mask.

Its manual is its command table (`DomeUnit.commands`) and these rules. A table of rows is uploaded,
compared by its checksum, armed and triggered; the box then steps by itself: the next row's LEDs
come on shortly before the last row's go off, the cameras of the row's mask are released once its
light is steady, and each release is reported as an event ``SEQ:STEP``. A table, and every
``LED:ON``, is refused beyond the duty (101), heat (102) or dose (104) that an LED may give, and, as
long as a person has not said that the subject's eyes are closed or shielded, beyond the flicker
that open eyes may see (105). Light carries its own end; LEDs that draw no current are refused with
-240, or reported as ``LED:FAIL`` in a sequence. Heat, dose and duty survive a reset.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from capture.devices.wire import Code
from capture.rig import LedLimits, Light

from .controller import Command, Refused, choice, number, word
from .eye_guard import EyeGuard, Lit
from .led_bank import LedBank
from .led_table import (
    LEVEL_STEPS,
    ROW_US,
    Row,
    Switch,
    lit_by,
    parse_leds,
    parse_rows,
    switches,
    table_crc,
)

__all__ = ["DomeUnit", "LedPulse"]

_MASK = re.compile(r"[0-9A-Fa-f]{1,8}")
LED_MS = (1.0, 500.0)
DEFAULT_MS = 100.0
EYES = ("OPEN", "CLOSED", "SHIELDED")
HISTORY_S = 1.0
"""Light so long ago counts as one with light to come."""

RUNNING, SEQUENCE_ARMED, LIT, HOT, INTERLOCK, EYES_SAFE = 16, 32, 64, 128, 256, 512


@dataclass(frozen=True, slots=True)
class LedPulse:
    """Light of one LED from one switching to the next."""

    led: int
    """Number of the LED, an index into the rig's lights."""
    level: float
    """Light given relative to full, 0 to 1; a weak LED gives less than it was asked for."""
    t_on_s: float
    """World time when it came on, s."""
    t_off_s: float
    """World time when it went off, s."""


@dataclass(slots=True)
class _Run:
    """A sequence that was triggered."""

    token: str
    start_s: float
    rows: list[Row]
    todo: list[Switch]
    state: str = "RUN"
    row: int = -1


class DomeUnit:
    """State of the dome's box behind its controller.

    Parameters
    ----------
    lights, limits
        Its LEDs, and what they may do.
    cameras
        How many cameras hang on it.
    on_pulse
        Called with each stretch of light when it has ended.
    on_trigger
        Called with the world time in s and the mask of each release of cameras.
    dead, weak, heat, interlock
        See `rigsim.faults.Faults`; dead and weak LEDs by number.
    """

    kind = "dome"
    model = "DOME1"

    def __init__(
        self,
        lights: Sequence[Light],
        limits: LedLimits,
        *,
        cameras: int,
        on_pulse: Callable[[LedPulse], None],
        on_trigger: Callable[[float, int], None],
        dead: frozenset[int] = frozenset(),
        weak: Mapping[int, float] | None = None,
        heat: float = 0.0,
        interlock: bool = False,
    ) -> None:
        self._limits = limits
        self._cameras = cameras
        self._on_trigger = on_trigger
        self.interlock = interlock

        def pass_on(lit: Lit) -> None:
            on_pulse(LedPulse(lit.led, lit.level, lit.on_s, lit.off_s))

        self.bank = LedBank(lights, limits, on_light=pass_on, dead=dead, weak=weak, heat=heat)
        self._guard = EyeGuard(lights)
        self._events: list[tuple[str, str]] = []
        self._run: _Run | None = None
        # tokens and times of all sequences since the box was made
        self.runs: list[tuple[str, float]] = []
        self.reset(0.0, power_up=True)

    def reset(self, now: float, *, power_up: bool) -> None:
        """Return to the settings of power-up: no table, all cameras, open eyes, dark."""
        self.go_dark(now)
        if power_up:
            self._powered_at = now
            self._events.clear()
        self.table: list[Row] = []
        self.mask = (1 << self._cameras) - 1
        self.eyes = "OPEN"
        self._sequence_armed = False
        self._run = None
        self._steps: dict[int, int] = {}

    def capabilities(self) -> Mapping[str, Any]:
        """Return limits and counts, units in the names."""
        limits = self._limits
        return {
            "leds": self.bank.count,
            "cameras": self._cameras,
            "max_rows": limits.max_rows,
            "row_min_us": ROW_US[0],
            "row_max_us": self._row_max_us,
            "level_steps": LEVEL_STEPS,
            "max_at_once": limits.max_at_once,
            "led_max_ms": min(LED_MS[1], limits.max_on_s * 1e3),
            "max_duty": limits.max_duty,
            "duty_window_s": limits.duty_window_s,
            "thermal_tau_s": limits.thermal_tau_s,
            "thermal_trip": limits.thermal_trip,
            "dose_ws": limits.dose_ws,
            "max_flashes_per_s": limits.max_flashes_per_s,
            "max_flicker_rms": limits.max_flicker_rms,
            "overlap_us": round(limits.overlap_s * 1e6),
            "settle_us": round(limits.settle_s * 1e6),
        }

    @property
    def _row_max_us(self) -> int:
        return min(ROW_US[1], round(self._limits.max_on_s * 1e6))

    def commands(self) -> Mapping[str, Command]:
        """Return the command table: the manual of the box."""
        return {
            "SEQ:CLE": Command(self._clear_table, manual="empty the table"),
            "SEQ:DEF": Command(
                self._define_rows,
                "<first>,<leds>:<level>:<us>:<mask>;...",
                manual="rows from number first: LEDs 3+17 or -, thousandths, us, hex cameras",
            ),
            "SEQ:CRC?": Command(self._checksum, manual="rows and checksum of the table"),
            "SEQ:ARM": Command(
                self._arm_sequence,
                "<rows>",
                armed=True,
                manual="judge the table: flashes per s, flicker rms, duty, heat, dose in Ws",
            ),
            "TRIG": Command(
                self._trigger, "<token>", armed=True, manual="run the armed table: token, box us"
            ),
            "SEQ:POS?": Command(
                self._position, manual="IDLE, READY, RUN, DONE or STOP, row, rows, token"
            ),
            "SEQ:STEP?": Command(
                self._step_time, "<row>", manual="box us of a row's release in the last run, NONE"
            ),
            "LED:ON": Command(
                self._light,
                "<leds>[,<ms>[,<level>]]",
                armed=True,
                manual="light LEDs 3+17 for 1 to 500 ms (100), in thousandths (1000)",
            ),
            "LED:OFF": Command(self._put_out, "<leds>|ALL", manual="put LEDs out"),
            "LED?": Command(self._lit_now, manual="LEDs that are on, as 3+17, or -"),
            "CAM:MASK": Command(
                self._set_mask, "<hex>", manual="cameras that are released at all; bit 0 the first"
            ),
            "CAM:MASK?": Command(self._get_mask, manual="that mask"),
            "CAM:TRIG": Command(
                self._release, "<token>", manual="release the cameras without light: token, us"
            ),
            "SAFE:EYES": Command(
                self._set_eyes,
                "OPEN|CLOSED|SHIELDED",
                manual="what a person says of the subject's eyes; OPEN at power-up",
            ),
            "SAFE:EYES?": Command(self._get_eyes, manual="what was said of the eyes"),
            "DOSE?": Command(self._dose, "<led>", manual="sent out to this subject, Ws"),
            "DOSE:NEW": Command(
                self._new_subject, "<token>", manual="another subject: count the dose anew"
            ),
        }

    # time -------------------------------------------------------------------------------------

    def deadline(self) -> float:
        """Return when the sequence or an LED will next change, in s; inf for never."""
        run = self._run
        due = self.bank.deadline()
        if run is not None and run.todo:
            due = min(due, run.start_s + run.todo[0].t_s)
        return due

    def advance(self, now: float) -> None:
        """Let time pass up to `now`, in s."""
        while (due := self.deadline()) <= now:
            self._pass_until(due)
            run = self._run
            while run is not None and run.todo and run.start_s + run.todo[0].t_s <= due:
                self._switch(run, run.todo.pop(0), due)
        self._pass_until(now)

    def _pass_until(self, now: float) -> None:
        tripped = self.bank.advance(now)
        if tripped:
            self._events += [("LED:HOT", str(led)) for led in tripped]
            self.go_dark(now)

    def _switch(self, run: _Run, switch: Switch, now: float) -> None:
        row = run.rows[switch.row]
        if switch.what == "on":
            before = run.rows[switch.row - 1].leds
            self._turn_on([led for led in row.leds if led not in before], row.level, now)
        elif switch.what == "turn":
            held = run.rows[switch.row - 1] if switch.row else Row((), 0, 0, 0)
            for led in held.leds:
                if led not in row.leds:
                    self.bank.switch_off(led, now)
            if switch.row == 0:
                self._turn_on(row.leds, row.level, now)
            elif held.level_steps != row.level_steps:
                self._turn_on([k for k in row.leds if k in held.leds], row.level, now)
        elif switch.what == "pulse":
            run.row = switch.row
            self._steps[switch.row] = self._clock_us(now)
            self._on_trigger(now, row.mask & self.mask)
            self._events.append(("SEQ:STEP", f"{switch.row},{self._clock_us(now)}"))
        else:
            self.bank.all_off(now)
            run.state = "DONE"
            self._events.append(("SEQ:DONE", f"{len(run.rows)},{self._clock_us(now)}"))

    def _turn_on(self, leds: Sequence[int], level: float, now: float) -> None:
        for led in leds:
            if not self.bank.switch_on(led, level, now):
                self._events.append(("LED:FAIL", str(led)))

    def take_events(self) -> list[tuple[str, str]]:
        """Return and forget what the box has to say unasked: name and payload."""
        events, self._events = self._events, []
        return events

    def go_dark(self, now: float) -> None:
        """Put every LED out and stop the sequence."""
        self.bank.all_off(now)
        self._sequence_armed = False
        run = self._run
        if run is not None and run.todo:
            run.todo.clear()
            run.state = "STOP"
            self._events.append(("SEQ:STOP", f"{run.row},{self._clock_us(now)}"))

    @property
    def lit(self) -> bool:
        """Whether an LED is on."""
        return bool(self.bank.lit)

    @property
    def running(self) -> bool:
        """Whether a sequence is stepping."""
        return self._run is not None and self._run.state == "RUN"

    def busy(self, now: float) -> bool:
        """Tell whether a sequence is stepping."""
        return self.running

    def light_now(self, now: float) -> list[LedPulse]:
        """Return the stretches of light that are going on, as given so far."""
        return [LedPulse(p.led, p.level, p.on_s, p.off_s) for p in self.bank.going_on(now)]

    def status_bits(self, now: float) -> int:
        """Return 16 running, 32 sequence armed, 64 lit, 128 hot, 256 stop open, 512 eyes safe."""
        bits = RUNNING * self.running + SEQUENCE_ARMED * self._sequence_armed + LIT * self.lit
        bits += HOT * self.bank.any_hot + INTERLOCK * self.interlock
        return bits + EYES_SAFE * (self.eyes != "OPEN")

    # sequence ---------------------------------------------------------------------------------

    def _require_still(self) -> None:
        if self.running:
            raise Refused(Code.IGNORED, "a sequence is running")

    def _clear_table(self, _: str, now: float) -> str:
        self._require_still()
        self.table.clear()
        self._sequence_armed = False
        return ""

    def _define_rows(self, arguments: str, now: float) -> str:
        self._require_still()
        first_text, comma, rest = arguments.partition(",")
        if not comma:
            raise Refused(Code.SYNTAX, "expected FIRST,LEDS:LEVEL:US:MASK;...")
        # a gap in the table would be a row that nobody described
        first = _whole(first_text, 0, len(self.table))
        rows = parse_rows(
            rest,
            count=self.bank.count,
            at_once=self._limits.max_at_once,
            cameras=self._cameras,
            most_us=self._row_max_us,
        )
        if first + len(rows) > self._limits.max_rows:
            raise Refused(Code.OUT_OF_RANGE, f"expected at most {self._limits.max_rows} rows")
        settle_us = self._limits.settle_s * 1e6
        if any(row.dwell_us < settle_us for row in rows):
            raise Refused(Code.OUT_OF_RANGE, f"expected rows longer than {settle_us:g} us")
        self.table[first : first + len(rows)] = rows
        self._sequence_armed = False
        return ""

    def _checksum(self, _: str, now: float) -> str:
        return f"{len(self.table)},{table_crc(self.table)}"

    def _arm_sequence(self, arguments: str, now: float) -> str:
        self._require_still()
        rows = _whole(arguments, 1, self._limits.max_rows)
        if rows != len(self.table):
            raise Refused(Code.OUT_OF_RANGE, f"the table has {len(self.table)} rows")
        self._require_closed_stop()
        wanted = lit_by(self.table, now, overlap_s=self._limits.overlap_s)
        duty, heat, dose_ws = self.bank.require(wanted, now)
        flashes, rms = self._require_calm(wanted, now)
        self._sequence_armed = True
        return f"{flashes:.2f},{rms:.4f},{duty:.4f},{heat:.4f},{dose_ws:.4f}"

    def _require_calm(self, wanted: Sequence[Lit], now: float) -> tuple[float, float]:
        """Return flashes per second and rms of what is wanted; refuse what open eyes must not see.

        Flashes are counted together with those of the last second.
        """
        limits = self._limits
        past = [pulse for pulse in self.bank.since(now - HISTORY_S) if pulse.on_s < now]
        flashes, rms = self._guard.flashes_per_s([*past, *wanted]), self._guard.rms(wanted)
        if self.eyes == "OPEN":
            if flashes >= limits.max_flashes_per_s:
                raise Refused(Code.FLICKER, f"{flashes:.1f} flashes per s at open eyes")
            if rms > limits.max_flicker_rms:
                raise Refused(Code.FLICKER, f"rms {rms:.2f} of 3 to 65 Hz at open eyes")
        return flashes, rms

    def _require_closed_stop(self) -> None:
        if self.interlock:
            raise Refused(Code.INTERLOCK)

    def _trigger(self, arguments: str, now: float) -> str:
        token = word(arguments)
        self._require_still()
        self._require_closed_stop()
        if not self._sequence_armed:
            raise Refused(Code.NOT_ARMED, "SEQ:ARM judges the table first")
        self._sequence_armed = False
        self.bank.all_off(now)
        limits = self._limits
        rows = list(self.table)
        todo = switches(rows, overlap_s=limits.overlap_s, settle_s=limits.settle_s)
        self._steps = {}
        self._run = _Run(token, now, rows, todo)
        self.runs.append((token, now))
        self.advance(now)
        return f"{token},{self._clock_us(now)}"

    def _position(self, _: str, now: float) -> str:
        run = self._run
        if self._sequence_armed:
            return f"READY,-1,{len(self.table)},-"
        if run is None:
            return f"IDLE,-1,{len(self.table)},-"
        return f"{run.state},{run.row},{len(run.rows)},{run.token}"

    def _step_time(self, arguments: str, now: float) -> str:
        row = _whole(arguments, 0, self._limits.max_rows - 1)
        return str(self._steps[row]) if row in self._steps else "NONE"

    # single LEDs ------------------------------------------------------------------------------

    def _leds(self, text: str) -> tuple[int, ...]:
        return parse_leds(text, count=self.bank.count, at_once=self._limits.max_at_once)

    def _light(self, arguments: str, now: float) -> str:
        self._require_still()
        parts = arguments.split(",")
        if len(parts) > 3:
            raise Refused(Code.SYNTAX, "expected LEDS,MS,LEVEL")
        leds = self._leds(parts[0])
        longest_ms = min(LED_MS[1], self._limits.max_on_s * 1e3)
        span_ms = number(parts[1], LED_MS[0], longest_ms, "ms") if len(parts) > 1 else DEFAULT_MS
        level = _whole(parts[2], 1, LEVEL_STEPS) / LEVEL_STEPS if len(parts) > 2 else 1.0
        if len({*leds, *self.bank.lit}) > self._limits.max_at_once:
            raise Refused(Code.OUT_OF_RANGE, f"more than {self._limits.max_at_once} LEDs at once")
        self._require_closed_stop()
        dead = [led for led in leds if led in self.bank.dead]
        if dead:
            raise Refused(Code.HARDWARE, f"LED {dead[0]} draws no current")
        end_s = now + span_ms / 1e3
        wanted = [Lit(led, level, now, end_s) for led in leds]
        self.bank.require(wanted, now)
        self._require_calm(wanted, now)
        self._sequence_armed = False
        for led in leds:
            self.bank.switch_on(led, level, now, end_s=end_s)
        return ""

    def _put_out(self, arguments: str, now: float) -> str:
        leds = self.bank.lit if arguments.upper() == "ALL" else self._leds(arguments)
        self._require_still()
        for led in leds:
            self.bank.switch_off(led, now)
        return ""

    def _lit_now(self, _: str, now: float) -> str:
        return "+".join(map(str, self.bank.lit)) or "-"

    # cameras, eyes, dose ----------------------------------------------------------------------

    def _set_mask(self, arguments: str, now: float) -> str:
        if _MASK.fullmatch(arguments) is None:
            raise Refused(Code.SYNTAX, "expected a mask in hexadecimal digits")
        mask = int(arguments, 16)
        if mask >= 1 << self._cameras:
            raise Refused(Code.OUT_OF_RANGE, f"expected a mask of {self._cameras} cameras")
        self._require_still()
        self.mask = mask
        return ""

    def _get_mask(self, _: str, now: float) -> str:
        return f"{self.mask:X}"

    def _release(self, arguments: str, now: float) -> str:
        token = word(arguments)
        self._require_still()
        self._on_trigger(now, self.mask)
        return f"{token},{self._clock_us(now)}"

    def _set_eyes(self, arguments: str, now: float) -> str:
        self.eyes = choice(arguments, EYES)
        self._sequence_armed = False
        return ""

    def _get_eyes(self, _: str, now: float) -> str:
        return self.eyes

    def _dose(self, arguments: str, now: float) -> str:
        return f"{self.bank.dose_ws(_whole(arguments, 0, self.bank.count - 1)):.6f}"

    def _new_subject(self, arguments: str, now: float) -> str:
        word(arguments)
        self._require_still()
        self.bank.new_subject()
        # eyes are a person's, and so is what was said of them
        self.eyes = "OPEN"
        return ""

    def _clock_us(self, now: float) -> int:
        return round((now - self._powered_at) * 1e6)


def _whole(text: str, low: int, high: int) -> int:
    """Return a whole number that a command gives, or refuse with -102 or -222."""
    if not (text.isascii() and text.isdecimal() and len(text) <= 9):
        raise Refused(Code.SYNTAX, "expected a whole number")
    value = int(text)
    if not low <= value <= high:
        raise Refused(Code.OUT_OF_RANGE, f"expected {low} to {high}")
    return value
