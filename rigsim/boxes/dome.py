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

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from capture.devices.wire import Code
from capture.rig import Rig
from rigsim.boxes import led_table
from rigsim.boxes.command import Act, Command, Refused, command_table, number, whole
from rigsim.boxes.eye_guard import Lit
from rigsim.boxes.faults import Faults
from rigsim.boxes.led_sequencer import LED_MS, LedSequencer, Run
from rigsim.boxes.led_table import LEVEL_STEPS, Row, Switch

DEFAULT_LED_MS = 100.0


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


class DomeUnit(LedSequencer[Row]):
    """State of the dome's box behind its controller.

    Parameters
    ----------
    rig, faults
        Its LEDs, what they may do, and its cameras; what is wrong with it.
    on_pulse
        Called with each stretch of light when it has ended.
    on_trigger
        Called with the world time in s and the mask of each release of cameras.
    """

    kind = "dome"
    model = "DOME1"

    def __init__(
        self,
        rig: Rig,
        faults: Faults,
        *,
        on_pulse: Callable[[LedPulse], None],
        on_trigger: Callable[[float, int], None],
    ) -> None:
        def pass_on(lit: Lit) -> None:
            on_pulse(LedPulse(lit.led, lit.level, lit.on_s, lit.off_s))

        super().__init__(rig, faults, on_light=pass_on, on_trigger=on_trigger)
        self.reset(0.0, power_up=True)

    def commands(self) -> dict[str, Command]:
        """Return the command table: the manual of the box."""
        acts: dict[str, Act] = {
            "SEQ:DEF": self._define_rows,
            "LED:ON": self._light,
            "LED:OFF": self._put_out,
            "LED?": lambda *_: "+".join(map(str, self.bank.lit)) or "-",
        }
        return super().commands() | command_table("dome", acts)

    # sequence ---------------------------------------------------------------------------------

    def _parse_rows(self, text: str) -> list[Row]:
        return led_table.parse_rows(
            text,
            count=self.bank.count,
            at_once=self._limits.max_at_once,
            cameras=self._cameras,
            most_us=self._row_max_us,
        )

    def _lit_by(self, rows: Sequence[Row], now: float) -> list[Lit]:
        return led_table.lit_by(rows, now, overlap_s=self._limits.overlap_s)

    def _schedule(self, rows: Sequence[Row]) -> list[Switch]:
        limits = self._limits
        return led_table.switches(rows, overlap_s=limits.overlap_s, settle_s=limits.settle_s)

    def _switch_light(self, run: Run[Row], switch: Switch, now: float) -> None:
        row = run.rows[switch.row]
        if switch.what == "on":
            before = run.rows[switch.row - 1].leds
            self._turn_on([led for led in row.leds if led not in before], row.level, now)
            return
        held = run.rows[switch.row - 1] if switch.row else Row((), 0, 0, 0)
        for led in held.leds:
            if led not in row.leds:
                self.bank.switch_off(led, now)
        if switch.row == 0:
            self._turn_on(row.leds, row.level, now)
        elif held.level_steps != row.level_steps:
            self._turn_on([k for k in row.leds if k in held.leds], row.level, now)

    def _turn_on(self, leds: Sequence[int], level: float, now: float) -> None:
        for led in leds:
            if not self.bank.switch_on(led, level, now):
                self.say("LED:FAIL", str(led))

    def light_now(self, now: float) -> list[LedPulse]:
        """Return the stretches of light that are going on, as given so far."""
        return [LedPulse(p.led, p.level, p.on_s, p.off_s) for p in self.bank.going_on(now)]

    # single LEDs ------------------------------------------------------------------------------

    def _leds(self, text: str) -> tuple[int, ...]:
        return led_table.parse_leds(text, count=self.bank.count, at_once=self._limits.max_at_once)

    def _light(self, arguments: str, now: float) -> None:
        self._require_still()
        parts = arguments.split(",")
        if len(parts) > 3:
            raise Refused(Code.SYNTAX, "expected LEDS,MS,LEVEL")
        leds = self._leds(parts[0])
        longest_ms = min(LED_MS[1], self._limits.max_on_s * 1e3)
        span_ms = (
            number(parts[1], LED_MS[0], longest_ms, "ms") if len(parts) > 1 else DEFAULT_LED_MS
        )
        level = whole(parts[2], 1, LEVEL_STEPS) / LEVEL_STEPS if len(parts) > 2 else 1.0
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

    def _put_out(self, arguments: str, now: float) -> None:
        leds = self.bank.lit if arguments.upper() == "ALL" else self._leds(arguments)
        self._require_still()
        for led in leds:
            self.bank.switch_off(led, now)
