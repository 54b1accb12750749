"""Emulate the dome's controller: LEDs stepped by a table, cameras released by a mask.

Its manual is its command table (`DomeUnit.commands`) and these rules. The host uploads a table of
rows, compares its checksum, arms and triggers it; the controller then steps autonomously. The next
row's LEDs come on shortly before the last row's go off, the cameras of the row's mask are released
once its light is steady, and each release is reported as an event ``SEQ:STEP``. A table, and every
``LED:ON``, is refused beyond the duty (101), heat (102) or dose (104) limit of an LED. Until the
operator has confirmed that the subject's eyes are closed or shielded, it is also refused beyond the
flicker limit for open eyes (105). Each command of light includes its end. An LED that draws no
current is refused with -240; it ends a sequence, see `rigsim.boxes.led_sequencer`. Heat, dose and
duty survive a reset.
"""

from collections.abc import Sequence

from capture.devices.wire import Code
from rigsim.boxes import led_table
from rigsim.boxes.command import (
    Command,
    CommandHandler,
    CommandRefused,
    add_us,
    build_command_table,
    parse_decimal,
    parse_integer,
)
from rigsim.boxes.device import Wiring
from rigsim.boxes.led_sequencer import LED_RANGE_MS, LedSequencer, SequenceRun
from rigsim.boxes.led_table import LEVEL_STEPS, LedPulse, LedTableRow, SequenceEvent

DEFAULT_LED_US = 100_000


class DomeUnit(LedSequencer[LedTableRow]):
    """State of the dome's device behind its controller.

    Parameters
    ----------
    wiring
        Its LEDs with their limits, and its cameras; each interval of light is a `LedPulse`.
    """

    kind = "dome"
    model = "DOME1"

    def __init__(self, wiring: Wiring) -> None:
        super().__init__(wiring, wiring.on_light)
        self.reset(0.0, power_up=True)

    def commands(self) -> dict[str, Command]:
        """Return the command table, which is the controller's manual."""
        acts: dict[str, CommandHandler] = {
            "SEQ:DEF": self._define_rows,
            "LED:ON": self._light,
            "LED:OFF": self._put_out,
            "LED?": lambda *_: "+".join(map(str, self.bank.lit)) or "-",
        }
        return super().commands() | build_command_table("dome", acts)

    # sequence ---------------------------------------------------------------------------------

    def _parse_rows(self, text: str) -> list[LedTableRow]:
        return led_table.parse_rows(
            text,
            count=self.bank.count,
            max_leds=self._limits.max_at_once,
            cameras=self._cameras,
            max_us=self._row_max_us,
        )

    def _pulses_from_table(self, rows: Sequence[LedTableRow], now: float) -> list[LedPulse]:
        pulses = led_table.pulses_from_rows(rows, now, overlap_s=self._limits.overlap_s)
        return [pulse for pulse in pulses if pulse.led not in self.bank.failed]

    def _schedule(self, rows: Sequence[LedTableRow]) -> list[SequenceEvent]:
        limits = self._limits
        return led_table.schedule_rows(rows, overlap_s=limits.overlap_s, settle_s=limits.settle_s)

    def _switch_light(
        self, run: SequenceRun[LedTableRow], switch: SequenceEvent, now: float
    ) -> None:
        row = run.rows[switch.row]
        if switch.action == "on":
            before = run.rows[switch.row - 1].leds
            self._turn_on([led for led in row.leds if led not in before], row.level, now)
            return
        held = run.rows[switch.row - 1] if switch.row else LedTableRow((), 0, 0, 0)
        for led in held.leds:
            if led not in row.leds:
                self.bank.switch_off(led, now)
        if switch.row == 0:
            self._turn_on(row.leds, row.level, now)
        elif held.level_steps != row.level_steps:
            self._turn_on([k for k in row.leds if k in held.leds], row.level, now)

    def _turn_on(self, leds: Sequence[int], level: float, now: float) -> None:
        if not self._switch_on(dict.fromkeys(leds, level), now):
            self.go_dark(now)

    def light_now(self, now: float) -> list[LedPulse]:
        """Return the intervals of light in progress, as emitted so far."""
        return self.bank.ongoing_pulses(now)

    # single LEDs ------------------------------------------------------------------------------

    def _leds(self, text: str) -> tuple[int, ...]:
        return led_table.parse_leds(text, count=self.bank.count, max_leds=self._limits.max_at_once)

    def _light(self, arguments: str, now: float) -> None:
        self._require_still()
        parts = arguments.split(",")
        CommandRefused.raise_if(len(parts) > 3, Code.SYNTAX, "expected LEDS,MS,LEVEL")
        leds = self._leds(parts[0])
        longest_ms = min(LED_RANGE_MS[1], self._limits.max_on_s * 1e3)
        span_us = (
            parse_decimal(parts[1], LED_RANGE_MS[0], longest_ms, "ms", digits=3)
            if len(parts) > 1
            else DEFAULT_LED_US
        )
        level = parse_integer(parts[2], 1, LEVEL_STEPS) / LEVEL_STEPS if len(parts) > 2 else 1.0
        if len({*leds, *self.bank.lit}) > self._limits.max_at_once:
            raise CommandRefused(
                Code.OUT_OF_RANGE, f"more than {self._limits.max_at_once} LEDs at once"
            )
        self._require_closed_stop()
        dead = [led for led in leds if not self.bank.draws_current(led, now)]
        if dead:
            raise CommandRefused(Code.HARDWARE, f"LED {dead[0]} draws no current")
        end_s = add_us(now, span_us)
        wanted = [LedPulse(led, level, now, end_s) for led in leds]
        self.bank.require_within_limits(wanted, now)
        self._require_flicker_limits(wanted, now)
        self._sequence_armed = False
        self._switch_on(dict.fromkeys(leds, level), now, end_s=end_s)

    def _put_out(self, arguments: str, now: float) -> None:
        leds = self.bank.lit if arguments.upper() == "ALL" else self._leds(arguments)
        self._require_still()
        for led in leds:
            self.bank.switch_off(led, now)
