"""What boxes have that step through LEDs by themselves: tables, cameras, eyes, dose; sans-I/O.

A table of rows is uploaded, compared by its checksum, armed and triggered; the box then steps by
itself, releases the cameras of a row's mask once its light is steady, and reports each release as
an event ``SEQ:STEP``. Light is refused beyond the duty (101), heat (102) or dose (104) that an LED
may give, and, as long as a person has not said that the subject's eyes are closed or shielded,
beyond the flicker that open eyes may see (105). Heat, dose and duty survive a reset.
"""

import re
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from capture.devices.wire import Code
from rigsim.boxes.command import Act, Command, Refused, choice, command_table, whole, word
from rigsim.boxes.device import Device, Wiring
from rigsim.boxes.eye_guard import EyeGuard
from rigsim.boxes.led_bank import LedBank
from rigsim.boxes.led_table import LEVEL_STEPS, ROW_US, LedPulse, Switch, TableRow, table_crc

_MASK_PATTERN = re.compile(r"[0-9A-Fa-f]{1,8}")
LED_MS = (1.0, 500.0)
EYE_STATES = ("OPEN", "CLOSED", "SHIELDED")
HISTORY_S = 1.0
"""Light so long ago counts as one with light to come."""


RowT = TypeVar("RowT", bound=TableRow)


@dataclass(slots=True)
class Run(Generic[RowT]):
    """A sequence that was triggered."""

    token: str
    start_s: float
    rows: list[RowT]
    todo: list[Switch]
    state: str = "RUN"
    row: int = -1


class LedSequencer(Device, Generic[RowT]):
    """State of a box with LEDs and a table, behind its controller.

    Parameters
    ----------
    wiring
        Its LEDs, what they may do, and its cameras.
    on_light
        Called with each stretch of light of an LED when it has ended.
    """

    def __init__(self, wiring: Wiring, on_light: Callable[[LedPulse], None]) -> None:
        super().__init__(wiring)
        rig = self.rig
        self._cameras = len(rig.views)
        self.bank = LedBank(rig, self.faults, on_light)
        self._limits = self.bank.limits
        self._guard = EyeGuard(rig.lights)
        self._run: Run[RowT] | None = None
        # tokens and times of all sequences since the box was made
        self.runs: list[tuple[str, float]] = []

    # what a box of a kind does ----------------------------------------------------------------

    @abstractmethod
    def _parse_rows(self, text: str) -> list[RowT]:
        """Return the rows that ``SEQ:DEF`` gives, or refuse."""

    @abstractmethod
    def _lit_by(self, rows: Sequence[RowT], now: float) -> list[LedPulse]:
        """Return the light of a sequence that would begin at `now`."""

    @abstractmethod
    def _schedule(self, rows: Sequence[RowT]) -> list[Switch]:
        """Return everything that happens in a sequence, in order of time."""

    @abstractmethod
    def _switch_light(self, run: Run[RowT], switch: Switch, now: float) -> None:
        """Do what a switch says that is neither ``pulse`` nor ``end``."""

    # settings ---------------------------------------------------------------------------------

    def reset(self, now: float, *, power_up: bool) -> None:
        """Return to the settings of power-up: no table, all cameras, open eyes, dark."""
        super().reset(now, power_up=power_up)
        self.table: list[RowT] = []
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

    def commands(self) -> dict[str, Command]:
        """Return the commands that these boxes share."""
        acts: dict[str, Act] = {
            "SEQ:CLE": self._clear_table,
            "SEQ:CRC?": lambda *_: f"{len(self.table)},{table_crc(self.table)}",
            "SEQ:ARM": self._arm_sequence,
            "TRIG": self._trigger,
            "SEQ:POS?": self._position,
            "SEQ:STEP?": self._step_time,
            "CAM:MASK": self._set_mask,
            "CAM:MASK?": lambda *_: f"{self.mask:X}",
            "CAM:TRIG": self._release,
            "SAFE:EYES": self._set_eyes,
            "SAFE:EYES?": lambda *_: self.eyes,
            "DOSE?": self._dose,
            "DOSE:NEW": self._new_subject,
        }
        return command_table("led_sequencer", acts)

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

    def _switch(self, run: Run[RowT], switch: Switch, now: float) -> None:
        if switch.what == "pulse":
            run.row = switch.row
            self._steps[switch.row] = self.clock_us(now)
            self._on_trigger(now, run.rows[switch.row].mask & self.mask)
            self.say("SEQ:STEP", f"{switch.row},{self.clock_us(now)}")
        elif switch.what == "end":
            self.bank.all_off(now)
            run.state = "DONE"
            self.say("SEQ:DONE", f"{len(run.rows)},{self.clock_us(now)}")
        else:
            self._switch_light(run, switch, now)

    def go_dark(self, now: float) -> None:
        """Put every LED out and stop the sequence."""
        self.bank.all_off(now)
        self._sequence_armed = False
        run = self._run
        if run is not None and run.todo:
            run.todo.clear()
            run.state = "STOP"
            self.say("SEQ:STOP", f"{run.row},{self.clock_us(now)}")

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

    def states(self, now: float) -> dict[int, bool]:
        """Return 16 running, 32 sequence armed, 64 lit, 128 hot, 512 eyes safe."""
        running = {16: self.running, 32: self._sequence_armed, 64: self.lit}
        return running | {128: self.bank.any_hot, 512: self.eyes != "OPEN"}

    # sequence ---------------------------------------------------------------------------------

    def _require_still(self) -> None:
        Refused.when(self.running, Code.IGNORED, "a sequence is running")

    def _clear_table(self, _: str, now: float) -> None:
        self._require_still()
        self.table.clear()
        self._sequence_armed = False

    def _define_rows(self, arguments: str, now: float) -> None:
        self._require_still()
        first_text, comma, rest = arguments.partition(",")
        Refused.when(not comma, Code.SYNTAX, "expected FIRST,ROW;...")
        # a gap in the table would be a row that nobody described
        first = whole(first_text, 0, len(self.table))
        rows = self._parse_rows(rest)
        if first + len(rows) > self._limits.max_rows:
            raise Refused(Code.OUT_OF_RANGE, f"expected at most {self._limits.max_rows} rows")
        settle_us = self._limits.settle_s * 1e6
        if any(row.dwell_us < settle_us for row in rows):
            raise Refused(Code.OUT_OF_RANGE, f"expected rows longer than {settle_us:g} us")
        self.table[first : first + len(rows)] = rows
        self._sequence_armed = False

    def _arm_sequence(self, arguments: str, now: float) -> str:
        self._require_still()
        rows = whole(arguments, 1, self._limits.max_rows)
        if rows != len(self.table):
            raise Refused(Code.OUT_OF_RANGE, f"the table has {len(self.table)} rows")
        self._require_closed_stop()
        wanted = self._lit_by(self.table, now)
        duty, heat, dose_ws = self.bank.require(wanted, now)
        flashes, rms = self._require_calm(wanted, now)
        self._sequence_armed = True
        return f"{flashes:.2f},{rms:.4f},{duty:.4f},{heat:.4f},{dose_ws:.4f}"

    def _require_calm(self, wanted: Sequence[LedPulse], now: float) -> tuple[float, float]:
        """Return flashes per second and rms of what is wanted; refuse what open eyes must not see.

        Flashes are counted together with those of the last second.
        """
        limits = self._limits
        past = [pulse for pulse in self.bank.since(now - HISTORY_S) if pulse.t_on_s < now]
        flashes, rms = self._guard.flashes_per_s([*past, *wanted]), self._guard.rms(wanted)
        if self.eyes == "OPEN":
            if flashes >= limits.max_flashes_per_s:
                raise Refused(Code.FLICKER, f"{flashes:.1f} flashes per s at open eyes")
            if rms > limits.max_flicker_rms:
                raise Refused(Code.FLICKER, f"rms {rms:.2f} of 3 to 65 Hz at open eyes")
        return flashes, rms

    def _trigger(self, arguments: str, now: float) -> str:
        token = word(arguments)
        self._require_still()
        self._require_closed_stop()
        Refused.when(not self._sequence_armed, Code.NOT_ARMED, "SEQ:ARM judges the table first")
        # light that was under way at SEQ:ARM, or came after it, has been given by now
        self.bank.require(self._lit_by(self.table, now), now)
        self._sequence_armed = False
        self.bank.all_off(now)
        rows = list(self.table)
        self._steps = {}
        self._run = Run(token, now, rows, self._schedule(rows))
        self.runs.append((token, now))
        self.advance(now)
        return f"{token},{self.clock_us(now)}"

    def _position(self, _: str, now: float) -> str:
        run = self._run
        if self._sequence_armed:
            return f"READY,-1,{len(self.table)},-"
        if run is None:
            return f"IDLE,-1,{len(self.table)},-"
        return f"{run.state},{run.row},{len(run.rows)},{run.token}"

    def _step_time(self, arguments: str, now: float) -> str:
        row = whole(arguments, 0, self._limits.max_rows - 1)
        return str(self._steps[row]) if row in self._steps else "NONE"

    # cameras, eyes, dose ----------------------------------------------------------------------

    def _set_mask(self, arguments: str, now: float) -> None:
        if _MASK_PATTERN.fullmatch(arguments) is None:
            raise Refused(Code.SYNTAX, "expected a mask in hexadecimal digits")
        mask = int(arguments, 16)
        if mask >= 1 << self._cameras:
            raise Refused(Code.OUT_OF_RANGE, f"expected a mask of {self._cameras} cameras")
        self._require_still()
        self.mask = mask

    def _release(self, arguments: str, now: float) -> str:
        token = word(arguments)
        self._require_still()
        self._on_trigger(now, self.mask)
        return f"{token},{self.clock_us(now)}"

    def _set_eyes(self, arguments: str, now: float) -> None:
        self.eyes = choice(arguments, EYE_STATES)
        self._sequence_armed = False

    def _dose(self, arguments: str, now: float) -> str:
        return f"{self.bank.dose_ws(whole(arguments, 0, self.bank.count - 1)):.6f}"

    def _new_subject(self, arguments: str, now: float) -> None:
        word(arguments)
        self._require_still()
        self.bank.new_subject()
        # eyes are a person's, and so is what was said of them
        self.eyes = "OPEN"
