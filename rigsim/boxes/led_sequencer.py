"""Emulate controllers that step LEDs by a table: rows, cameras, eyes, dose (sans-I/O).

The host uploads a table of rows, compares its checksum, arms and triggers it. The controller then
steps autonomously, releases the cameras of a row's mask once its light is steady, and reports each
release as an event ``SEQ:STEP``. Light is refused beyond the duty (101), heat (102) or dose (104)
limit of an LED. Until the operator has confirmed that the subject's eyes are closed or shielded, it
is also refused beyond the flicker limit for open eyes (105). Heat, dose and duty survive a reset.

A table is judged as if its LEDs were lit. Where one is found to draw no current, the sequence ends
in darkness (``LED:FAIL``, ``SEQ:STOP``). Until the next reset the LED is neither driven nor judged
as lit; ``LED:FAIL?`` lists such LEDs.
"""

import math
import re
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

from capture.devices.wire import Code
from rigsim.boxes.command import (
    Command,
    CommandHandler,
    CommandRefused,
    PendingReply,
    add_us,
    build_command_table,
    parse_choice,
    parse_integer,
    parse_token,
)
from rigsim.boxes.device import Device, Wiring
from rigsim.boxes.eye_guard import EyeFlickerMonitor
from rigsim.boxes.led_bank import LedBank
from rigsim.boxes.led_table import (
    LEVEL_STEPS,
    ROW_RANGE_US,
    LedPulse,
    SequenceEvent,
    TableRow,
    table_crc,
)

_MASK_PATTERN = re.compile(r"[0-9A-Fa-f]{1,8}")
LED_RANGE_MS = (1.0, 500.0)
EYE_STATES = ("OPEN", "CLOSED", "SHIELDED")
FLICKER_FUSION_US = 15_385
"""Shortest darkness that an eye perceives, us."""
FLICKER_HISTORY_S = 1.0
"""Past interval whose light is evaluated together with the requested light, s."""


RowT = TypeVar("RowT", bound=TableRow)


@dataclass(slots=True)
class SequenceRun(Generic[RowT]):
    """A triggered sequence."""

    token: str
    start_s: float
    rows: list[RowT]
    pending: list[SequenceEvent]
    state: str = "RUN"
    row: int = -1

    @property
    def next_s(self) -> float:
        """World time of the next event, s."""
        return add_us(self.start_s, 1e6 * self.pending[0].t_s)


class LedSequencer(Device, Generic[RowT]):
    """State of a device with LEDs and a table, behind its controller.

    Parameters
    ----------
    wiring
        Its LEDs with their limits, and its cameras.
    on_light
        Called with each interval of an LED's light when it has ended.
    """

    def __init__(self, wiring: Wiring, on_light: Callable[[LedPulse], None]) -> None:
        super().__init__(wiring)
        rig = self.rig
        self._cameras = len(rig.views)
        self.bank = LedBank(rig, self.faults, on_light)
        self._limits = self.bank.limits
        self._guard = EyeFlickerMonitor(rig.lights)
        self._run: SequenceRun[RowT] | None = None
        self._judgment: PendingReply | None = None
        # tokens and times of all sequences since the controller was built
        self.runs: list[tuple[str, float]] = []

    # specific to the kind of box ----------------------------------------------------------------

    @abstractmethod
    def _parse_rows(self, text: str) -> list[RowT]:
        """Parse the rows of ``SEQ:DEF``, or refuse."""

    @abstractmethod
    def _pulses_from_table(self, rows: Sequence[RowT], now: float) -> list[LedPulse]:
        """Return the light of a sequence that would begin at `now`."""

    @abstractmethod
    def _schedule(self, rows: Sequence[RowT]) -> list[SequenceEvent]:
        """Return all events of a sequence, in order of time."""

    @abstractmethod
    def _switch_light(self, run: SequenceRun[RowT], switch: SequenceEvent, now: float) -> None:
        """Carry out an event other than ``pulse`` and ``end``."""

    # settings ---------------------------------------------------------------------------------

    def reset(self, now: float, *, power_up: bool) -> None:
        """Restore the power-up settings: no table, all cameras, open eyes, dark."""
        super().reset(now, power_up=power_up)
        self.table: list[RowT] = []
        self.mask = (1 << self._cameras) - 1
        self.eyes = "OPEN"
        self.bank.failed.clear()
        self._sequence_armed = False
        self._run = None
        self._steps: dict[int, int] = {}

    def capabilities(self) -> Mapping[str, Any]:
        """Return limits and counts; the names include the units."""
        limits = self._limits
        return {
            "leds": self.bank.count,
            "cameras": self._cameras,
            "max_rows": limits.max_rows,
            "row_min_us": ROW_RANGE_US[0],
            "row_max_us": self._row_max_us,
            "level_steps": LEVEL_STEPS,
            "max_at_once": limits.max_at_once,
            "led_max_ms": min(LED_RANGE_MS[1], limits.max_on_s * 1e3),
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
        return min(ROW_RANGE_US[1], round(self._limits.max_on_s * 1e6))

    def commands(self) -> dict[str, Command]:
        """Return the commands that these controllers share."""
        acts: dict[str, CommandHandler] = {
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
            "LED:FAIL?": self._list_failed,
            "DOSE?": self._dose,
            "DOSE:NEW": self._new_subject,
        }
        return build_command_table("led_sequencer", acts)

    # time -------------------------------------------------------------------------------------

    def deadline(self) -> float:
        """Return when the sequence, an LED or the stop will next change, in s; inf for never."""
        run = self._run
        due = min(self._stop_changes_at_s(), self.bank.deadline())
        if run is not None and run.pending:
            due = min(due, run.next_s)
        return due

    def advance(self, now: float) -> None:
        """Advance time to `now`, in s."""
        while (due := self.deadline()) <= now:
            self._follow_stop(due)
            self._advance_bank(due)
            run = self._run
            while run is not None and run.pending and run.next_s <= due:
                self._switch(run, run.pending.pop(0), due)
        self._advance_bank(now)

    def _advance_bank(self, now: float) -> None:
        tripped = self.bank.advance(now)
        if tripped:
            self._events += [("LED:HOT", str(led)) for led in tripped]
            self.go_dark(now)

    def _switch_on(self, leds: Mapping[int, float], now: float, *, end_s: float = math.inf) -> bool:
        """Light LEDs at their levels; report those newly found dead, and return False for any."""
        found = [
            led
            for led, level in leds.items()
            if not self.bank.switch_on(led, level, now, end_s=end_s)
        ]
        for led in found:
            self.queue_event("LED:FAIL", str(led))
        return not found

    def _switch(self, run: SequenceRun[RowT], switch: SequenceEvent, now: float) -> None:
        if switch.action == "pulse":
            run.row = switch.row
            self._steps[switch.row] = self.clock_us(now)
            self._on_trigger(now, run.rows[switch.row].mask & self.mask)
            self.queue_event("SEQ:STEP", f"{switch.row},{self.clock_us(now)}")
        elif switch.action == "end":
            self.bank.all_off(now)
            run.state = "DONE"
            self.queue_event("SEQ:DONE", f"{len(run.rows)},{self.clock_us(now)}")
        else:
            self._switch_light(run, switch, now)

    def go_dark(self, now: float) -> None:
        """Switch off every LED and stop the sequence."""
        self.bank.all_off(now)
        self._sequence_armed = False
        if self._judgment is not None:
            self._judgment.end(now, Code.HARDWARE, "made dark before the table was judged")
            self._judgment = None
        run = self._run
        if run is not None and run.pending:
            run.pending.clear()
            run.state = "STOP"
            self.queue_event("SEQ:STOP", f"{run.row},{self.clock_us(now)}")

    @property
    def lit(self) -> bool:
        """Whether an LED is on."""
        return bool(self.bank.lit)

    @property
    def is_running(self) -> bool:
        """Whether a sequence is stepping."""
        return self._run is not None and self._run.state == "RUN"

    def is_busy(self, now: float) -> bool:
        """Return whether a sequence is stepping or a table is being judged."""
        return self.is_running or self._judgment is not None

    def states(self, now: float) -> dict[int, bool]:
        """Return bits 16 running, 32 sequence armed, 64 lit, 128 hot, 512 eyes safe."""
        running = {16: self.is_running, 32: self._sequence_armed, 64: self.lit}
        return running | {128: self.bank.has_tripped, 512: self.eyes != "OPEN"}

    # sequence ---------------------------------------------------------------------------------

    def _require_still(self) -> None:
        CommandRefused.raise_if(self._judgment is not None, Code.IGNORED, "a table is being judged")
        CommandRefused.raise_if(self.is_running, Code.IGNORED, "a sequence is running")

    def _clear_table(self, _: str, now: float) -> None:
        self._require_still()
        self.table.clear()
        self._sequence_armed = False

    def _define_rows(self, arguments: str, now: float) -> None:
        self._require_still()
        first_text, comma, rest = arguments.partition(",")
        CommandRefused.raise_if(not comma, Code.SYNTAX, "expected FIRST,ROW;...")
        # a gap in the table would leave a row undefined
        first = parse_integer(first_text, 0, len(self.table))
        rows = self._parse_rows(rest)
        if first + len(rows) > self._limits.max_rows:
            raise CommandRefused(
                Code.OUT_OF_RANGE, f"expected at most {self._limits.max_rows} rows"
            )
        settle_us = self._limits.settle_s * 1e6
        if any(row.dwell_us < settle_us for row in rows):
            raise CommandRefused(Code.OUT_OF_RANGE, f"expected rows longer than {settle_us:g} us")
        self.table[first : first + len(rows)] = rows
        self._sequence_armed = False

    def _arm_sequence(self, arguments: str, now: float) -> str | PendingReply:
        self._require_still()
        rows = parse_integer(arguments, 1, self._limits.max_rows)
        if rows != len(self.table):
            raise CommandRefused(Code.OUT_OF_RANGE, f"the table has {len(self.table)} rows")
        self._require_closed_stop()
        wanted = self._pulses_from_table(self.table, now)
        self.bank.all_off(now)  # else light whose end is not known would precede the table
        duty, heat, dose_ws = self.bank.require_within_limits(wanted, now)
        flicker = self._flicker(wanted, now, gap_us=FLICKER_FUSION_US)

        def conclude() -> str:
            flashes, rms = self._require_no_flicker(*flicker)
            self._sequence_armed = True
            return f"{flashes:.2f},{rms:.4f},{duty:.4f},{heat:.4f},{dose_ws:.4f}"

        if self.faults.slow_judgment == 0.0:
            return conclude()
        due_s = add_us(now, 1e6 * self.faults.slow_judgment)
        self._judgment = PendingReply(due_s, lambda: self._end_judgment(conclude))
        return self._judgment

    def _end_judgment(self, conclude: Callable[[], str]) -> str | CommandRefused:
        self._judgment = None
        try:
            return conclude()
        except CommandRefused as refused:
            return refused

    def _require_flicker_limits(
        self, wanted: Sequence[LedPulse], now: float
    ) -> tuple[float, float]:
        """Return flashes per second and rms of the request, or refuse it for open eyes."""
        return self._require_no_flicker(*self._flicker(wanted, now))

    def _flicker(
        self, wanted: Sequence[LedPulse], now: float, *, gap_us: int = 0
    ) -> tuple[float, float]:
        """Return flashes per second, with those of the last second, and rms of the request.

        Light of the last second is moved `gap_us` back: a table may begin at any time after this.
        """
        past = [
            replace(
                pulse, t_on_s=add_us(pulse.t_on_s, -gap_us), t_off_s=add_us(pulse.t_off_s, -gap_us)
            )
            for pulse in self.bank.pulses_since(now - FLICKER_HISTORY_S)
            if pulse.t_on_s < now
        ]
        return self._guard.flashes_per_s([*past, *wanted]), self._guard.rms(wanted)

    def _require_no_flicker(self, flashes: float, rms: float) -> tuple[float, float]:
        limits = self._limits
        if self.eyes == "OPEN":
            if flashes >= limits.max_flashes_per_s:
                raise CommandRefused(Code.FLICKER, f"{flashes:.1f} flashes per s at open eyes")
            if rms > limits.max_flicker_rms:
                raise CommandRefused(Code.FLICKER, f"rms {rms:.2f} of 3 to 65 Hz at open eyes")
        return flashes, rms

    def _trigger(self, arguments: str, now: float) -> str:
        token = parse_token(arguments)
        self._require_still()
        self._require_closed_stop()
        CommandRefused.raise_if(
            not self._sequence_armed, Code.NOT_ARMED, "SEQ:ARM checks the table first"
        )
        self._sequence_armed = False
        self.bank.all_off(now)
        rows = list(self.table)
        self._steps = {}
        self._run = SequenceRun(token, now, rows, self._schedule(rows))
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
        row = parse_integer(arguments, 0, self._limits.max_rows - 1)
        return str(self._steps[row]) if row in self._steps else "NONE"

    # cameras, eyes, dose ----------------------------------------------------------------------

    def _set_mask(self, arguments: str, now: float) -> None:
        if _MASK_PATTERN.fullmatch(arguments) is None:
            raise CommandRefused(Code.SYNTAX, "expected a mask in hexadecimal digits")
        mask = int(arguments, 16)
        if mask >= 1 << self._cameras:
            raise CommandRefused(Code.OUT_OF_RANGE, f"expected a mask of {self._cameras} cameras")
        self._require_still()
        self.mask = mask

    def _release(self, arguments: str, now: float) -> str:
        token = parse_token(arguments)
        self._require_still()
        self._on_trigger(now, self.mask)
        return f"{token},{self.clock_us(now)}"

    def _set_eyes(self, arguments: str, now: float) -> None:
        before, self.eyes = self.eyes, parse_choice(arguments, EYE_STATES)
        self._sequence_armed = False
        if before != self.eyes == "OPEN":  # what runs was judged for eyes that were not open
            self.go_dark(now)

    def _list_failed(self, _: str, now: float) -> str:
        mask = sum(1 << led for led in self.bank.failed)
        return f"{mask:0{-(-self.bank.count // 4)}X}"

    def _dose(self, arguments: str, now: float) -> str:
        return f"{self.bank.dose_ws(parse_integer(arguments, 0, self.bank.count - 1)):.6f}"

    def _new_subject(self, arguments: str, now: float) -> None:
        parse_token(arguments)
        self._require_still()
        self.bank.new_subject()
        # the eye state was confirmed for the previous subject only; the table was judged with it
        self.eyes = "OPEN"
        self._sequence_armed = False
