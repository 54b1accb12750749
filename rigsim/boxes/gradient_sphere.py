"""Emulate the gradient sphere's controller: LED patterns and a turning analyzer (sans-I/O).

Its manual is its command table (`GradientSphereUnit.commands`) and these rules. A pattern lights
all LEDs at once: at full level, or weighted by (1 + w) / 2 or (1 - w) / 2 with w a coordinate of
the unit direction to the LED. ``PATT`` includes its own end. A scan is a table of patterns with
readings of the analyzer, see `rigsim.boxes.led_sequencer`, and the controller steps it
autonomously. Where a row requests another reading than the row before, the light goes out, the
analyzer turns, and only then the row's light comes on. Outside of scans, light while the analyzer
turns and turning in the light are refused (-213). Gains scale the level of each LED relative to the
pattern's. An LED that draws no current ends a scan, and is reported as ``LED:FAIL``. The controller
does not detect LEDs that emit less light than they are driven for.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from capture.devices.wire import Code
from rigsim.boxes import led_table
from rigsim.boxes.command import (
    Command,
    CommandHandler,
    CommandRefused,
    add_us,
    build_command_table,
    ceil_ms,
    elapsed_us,
    parse_choice,
    parse_decimal,
    parse_integer,
    rotation_us,
)
from rigsim.boxes.device import Wiring
from rigsim.boxes.led_sequencer import LED_RANGE_MS, LedSequencer, SequenceRun
from rigsim.boxes.led_table import LEVEL_STEPS, LedPulse, SequenceEvent, table_crc

DEFAULT_LED_US = 100_000
_GAINS_PATTERN = re.compile(r"[0-9]{1,4}(\+[0-9]{1,4})*")


@dataclass(frozen=True, slots=True)
class PatternLight:
    """Light of one pattern between two switching times."""

    pattern: str
    """full, x, y, z, -x, -y or -z."""
    level: float
    """Drive level of all LEDs relative to full, 0 to 1."""
    t_on_s: float
    """World time when it came on, s."""
    t_off_s: float
    """World time when it went off, s."""
    analyzer_deg: float
    """Reading of the analyzer meanwhile, degrees; 0 parallel, 90 crossed."""
    led_shares: tuple[float, ...] = ()
    """Light of each LED relative to the pattern at this level: its gain, times its health (0 when
    dead, less than 1 when weak); empty: 1 for all."""


class GradientSphereUnit(LedSequencer[led_table.PatternRow]):
    """State of the gradient sphere's device behind its controller.

    Parameters
    ----------
    wiring
        Its LEDs with limits, analyzer and cameras; each interval of light is a `PatternLight`.
    """

    kind = "gradient_sphere"
    model = "SPHERE1"

    def __init__(self, wiring: Wiring) -> None:
        rig, faults = wiring.rig, wiring.faults
        self._s_per_deg = rig.polarizer_move_s / 90.0
        self._quarter_turn_us = round(1e6 * rig.polarizer_move_s)
        self._shares = led_table.pattern_led_fractions(rig.lights)
        health = np.ones(len(rig.lights))
        for led, share in faults.weak_leds.items():
            health[led] = share
        self._health = health
        self._shining: PatternLight | None = None  # light in progress; its end is not known yet
        self.analyzer_deg = 0.0
        self._settled_at = 0.0
        super().__init__(wiring, self._on_pulse_end)
        self.reset(0.0, power_up=True)

    def reset(self, now: float, *, power_up: bool) -> None:
        """Restore the power-up settings; the analyzer turns to parallel."""
        super().reset(now, power_up=power_up)
        self.gains = [LEVEL_STEPS] * self.bank.count
        self._gains_sent: list[int] = []
        self._turn(0.0, now)

    def capabilities(self) -> Mapping[str, Any]:
        """Return limits and counts; the names include the units."""
        return {
            **super().capabilities(),
            "analyser_min_deg": led_table.ANALYZER_RANGE_DEG[0],
            "analyser_max_deg": led_table.ANALYZER_RANGE_DEG[1],
            "move_s_per_deg": round(self._s_per_deg, 9),
        }

    def commands(self) -> dict[str, Command]:
        """Return the command table, which is the controller's manual."""
        acts: dict[str, CommandHandler] = {
            "SEQ:DEF": self._define_rows,
            "PATT": self._light,
            "PATT?": self._lit_now,
            "POL": self._set_stop,
            "POL:ANG": self._set_angle,
            "POL?": lambda *_: f"{self.analyzer_deg:.3f}",
            "GAIN:CLE": self._clear_gains,
            "GAIN:DEF": self._define_gains,
            "GAIN:CRC?": lambda *_: f"{len(self._gains_sent)},{table_crc(self._gains_sent)}",
        }
        return super().commands() | build_command_table("gradient_sphere", acts)

    # analyzer ---------------------------------------------------------------------------------

    def is_analyzer_rotating(self, now: float) -> bool:
        """Return whether the analyzer turns."""
        return now < self._settled_at

    def is_busy(self, now: float) -> bool:
        """Return whether a scan is stepping or the analyzer turns."""
        return super().is_busy(now) or self.is_analyzer_rotating(now)

    def states(self, now: float) -> dict[int, bool]:
        """Return the bits of all controllers with LEDs, and 1024 turning."""
        return super().states(now) | {1024: self.is_analyzer_rotating(now)}

    def _turn(self, reading_deg: float, now: float) -> None:
        turn_mdeg = round(1e3 * (reading_deg - self.analyzer_deg))
        turn_us = rotation_us(turn_mdeg, self._quarter_turn_us)
        self._settled_at = add_us(max(now, self._settled_at), turn_us)
        self.analyzer_deg = reading_deg

    def _set_stop(self, arguments: str, now: float) -> None:
        self._set_angle(parse_choice(arguments, ("0", "90")), now)

    def _set_angle(self, arguments: str, now: float) -> None:
        limits_deg = led_table.ANALYZER_RANGE_DEG
        reading_deg = parse_decimal(arguments, *limits_deg, "degrees", digits=3) / 1e3
        self._require_still()
        CommandRefused.raise_if(self.lit, Code.IGNORED, "a light is on; PATT DARK first")
        self._sequence_armed = False
        self._turn(reading_deg, now)

    def _require_settled(self, now: float) -> None:
        if self.is_analyzer_rotating(now):
            wait_ms = ceil_ms(elapsed_us(now, self._settled_at))
            raise CommandRefused(Code.IGNORED, f"analyzer turning, {wait_ms} ms")

    # light ------------------------------------------------------------------------------------

    def light_now(self, now: float) -> list[PatternLight]:
        """Return the light in progress, as emitted so far."""
        shining = self._shining
        if shining is None or not self.lit:
            return []
        return [self._with_end(shining, max(now, shining.t_on_s))]

    def _with_end(self, light: PatternLight, t_off_s: float) -> PatternLight:
        return replace(light, t_off_s=t_off_s)

    def _on_pulse_end(self, lit: LedPulse) -> None:
        """Report a pattern when its first LED goes out: all LEDs go out at once."""
        shining, self._shining = self._shining, None
        if shining is not None:
            self._on_light(self._with_end(shining, lit.t_off_s))

    def _levels(self, pattern: str, level: float) -> list[float]:
        """Return the drive level of each LED."""
        gains = np.array(self.gains) / LEVEL_STEPS
        driven: list[float] = (level * gains * self._shares[pattern]).tolist()
        return driven

    def _start_pattern(
        self, pattern: str, level: float, now: float, *, end_s: float = math.inf
    ) -> bool:
        """Replace the light in progress by a pattern; return False when an LED is found dead."""
        self.bank.all_off(now)
        if pattern == "dark":
            return True
        works = self._switch_on(dict(enumerate(self._levels(pattern, level))), now, end_s=end_s)
        shares = np.array(self.gains) / LEVEL_STEPS * self._health
        shares[list(self.bank.failed)] = 0.0
        given = () if (shares == 1.0).all() else tuple(shares.tolist())
        self._shining = PatternLight(pattern, level, now, now, self.analyzer_deg, given)
        return works

    def _requested_pulses(
        self, pattern: str, level: float, on_s: float, off_s: float
    ) -> list[LedPulse]:
        levels = self._levels(pattern, level)
        return [
            LedPulse(led, driven, on_s, off_s)
            for led, driven in enumerate(levels)
            if driven > 0.0 and led not in self.bank.failed
        ]

    def _light(self, arguments: str, now: float) -> None:
        self._require_still()
        name, *more = arguments.split(",")
        CommandRefused.raise_if(len(more) > 2, Code.SYNTAX, "expected PATTERN,MS,LEVEL")
        pattern = led_table.parse_pattern_name(name)
        if pattern == "dark":
            CommandRefused.raise_if(more, Code.SYNTAX, "expected DARK")
            self.bank.all_off(now)
            return
        longest_ms = min(LED_RANGE_MS[1], self._limits.max_on_s * 1e3)
        span_us = (
            parse_decimal(more[0], LED_RANGE_MS[0], longest_ms, "ms", digits=3)
            if more
            else DEFAULT_LED_US
        )
        level = parse_integer(more[1], 1, LEVEL_STEPS) / LEVEL_STEPS if len(more) > 1 else 1.0
        self._require_closed_stop()
        self._require_settled(now)
        end_s = add_us(now, span_us)
        wanted = self._requested_pulses(pattern, level, now, end_s)
        self.bank.require_within_limits(wanted, now)
        self._require_flicker_limits(wanted, now)
        self._sequence_armed = False
        self._start_pattern(pattern, level, now, end_s=end_s)

    def _lit_now(self, _: str, now: float) -> str:
        shining = self._shining
        return shining.pattern.upper() if self.lit and shining is not None else "DARK"

    # scans ------------------------------------------------------------------------------------

    def _parse_rows(self, text: str) -> list[led_table.PatternRow]:
        return led_table.parse_pattern_rows(text, cameras=self._cameras, max_us=self._row_max_us)

    def _pulses_from_table(
        self, rows: Sequence[led_table.PatternRow], now: float
    ) -> list[LedPulse]:
        self._require_settled(now)
        times = led_table.pattern_start_times(
            rows, reading_deg=self.analyzer_deg, quarter_turn_us=self._quarter_turn_us
        )
        found: list[LedPulse] = []
        for row, (_, lit_s) in zip(rows, times, strict=True):
            start_s = add_us(now, 1e6 * lit_s)
            end_s = add_us(start_s, row.dwell_us)
            found += self._requested_pulses(row.pattern, row.level, start_s, end_s)
        return found

    def _schedule(self, rows: Sequence[led_table.PatternRow]) -> list[SequenceEvent]:
        return led_table.schedule_pattern_rows(
            rows,
            reading_deg=self.analyzer_deg,
            quarter_turn_us=self._quarter_turn_us,
            settle_s=self._limits.settle_s,
        )

    def _switch_light(
        self, run: SequenceRun[led_table.PatternRow], switch: SequenceEvent, now: float
    ) -> None:
        row = run.rows[switch.row]
        if switch.action == "rotate":
            self.bank.all_off(now)
            self._turn(row.analyzer_deg, now)
        elif not self._start_pattern(row.pattern, row.level, now):
            self.go_dark(now)

    # gains ------------------------------------------------------------------------------------

    def _clear_gains(self, _: str, now: float) -> None:
        self._require_still()
        self.gains = [LEVEL_STEPS] * self.bank.count
        self._gains_sent = []
        self._sequence_armed = False

    def _define_gains(self, arguments: str, now: float) -> None:
        self._require_still()
        first_text, _, rest = arguments.partition(",")
        if _GAINS_PATTERN.fullmatch(rest) is None:
            raise CommandRefused(Code.SYNTAX, "expected FIRST,GAIN+GAIN...")
        first = parse_integer(first_text, 0, len(self._gains_sent))
        gains = [int(part) for part in rest.split("+")]
        if first + len(gains) > self.bank.count or max(gains) > LEVEL_STEPS:
            raise CommandRefused(
                Code.OUT_OF_RANGE, f"expected 0 to {LEVEL_STEPS} for {self.bank.count} LEDs"
            )
        self._gains_sent[first : first + len(gains)] = gains
        self.gains[first : first + len(gains)] = gains
        self._sequence_armed = False
