"""Emulate the face scanner's controller: projectors of stripes and the cameras around them.

Its manual is its command table (`ScannerUnit.commands`) and these rules. The host selects a
projector with ``PROJ`` and a pattern with ``PAT``; both are displayed dark. ``TRIG`` switches the
lamp on for a time of at most ``max_show_ms``, releases the projector's cameras once the light is
steady, and answers then. Stripes flicker: light is refused with 105 until the operator has
confirmed that the subject's eyes are closed or shielded, and beyond the subject's dose with 104. A
lamp that draws no current is refused with -240. Any command that makes dark before the release
prevents it (-240 too). The dose survives a reset.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from capture.devices.wire import Code
from capture.rig import LedLimits
from rigsim.boxes.command import (
    Command,
    CommandHandler,
    CommandRefused,
    PendingReply,
    add_us,
    build_command_table,
    elapsed_us,
    parse_choice,
    parse_decimal,
    parse_integer,
    parse_token,
)
from rigsim.boxes.device import Device, Wiring

SCANNER_EYE_STATES = ("OPEN", "CLOSED", "SHIELDED")
MIN_SHOW_MS = 1.0
AXES_BY_WORD = {"COL": "columns", "ROW": "rows"}


@dataclass(frozen=True, slots=True)
class ProjectorLight:
    """An interval of light from a projector that shows one pattern."""

    projector: str
    """Name of the projector."""
    axis: str
    """"columns" or "rows", along which the stripes vary; empty: full white."""
    pattern: int
    """Number of the pattern, see `capture.rig.Scanner`; 0 for full white."""
    level: float
    """Light relative to full, 0 < level <= 1."""
    t_on_s: float
    """World time of its start, s."""
    t_off_s: float
    """World time of its end, s."""


@dataclass(slots=True)
class _Show:
    """One showing of a pattern, from the command on."""

    token: str
    light: ProjectorLight
    release_s: float
    outcome: str | CommandRefused | None = None


class ScannerUnit(Device):
    """State of the scanner's device behind its controller.

    Parameters
    ----------
    wiring
        Its scanner; each interval of light is a `ProjectorLight`. The mask of released cameras is
        that of the scanner's views.
    """

    kind = "scanner"
    model = "SCANNER1"

    def __init__(self, wiring: Wiring) -> None:
        super().__init__(wiring)
        if self.rig.scanner is None:
            raise ValueError(f"scanner: got none in rig {self.rig.name!r}, expected its section")
        self._scanner = self.rig.scanner
        self._dose_limit_ws = (self.rig.leds or LedLimits()).dose_ws
        # state that survives the loss of power: the count and the dose
        self.count = 0
        self.dose_ws = 0.0
        self._show: _Show | None = None
        self._answer_s = 0.0
        self.reset(0.0, power_up=True)

    # settings ---------------------------------------------------------------------------------

    def reset(self, now: float, *, power_up: bool) -> None:
        """Restore the power-up settings: dark, the first projector, full white, eyes open."""
        super().reset(now, power_up=power_up)
        self.projector = 0
        self.axis, self.pattern = "", 0
        self.eyes = "OPEN"
        if power_up:
            self.last_report = ""
            self._answer_s = 0.0

    def capabilities(self) -> Mapping[str, Any]:
        """Return limits and counts; the names include the units."""
        scanner = self._scanner
        return {
            "projectors": len(scanner.projectors),
            "cameras": len(scanner.views),
            "columns": [projector.width_px for projector in scanner.projectors],
            "rows": [projector.height_px for projector in scanner.projectors],
            "period_px": scanner.period_px,
            "phase_steps": scanner.phase_steps,
            "settle_ms": round(scanner.settle_s * 1e3, 6),
            "min_show_ms": MIN_SHOW_MS,
            "max_show_ms": round(scanner.max_show_s * 1e3, 6),
            "dose_ws": self._dose_limit_ws,
        }

    def commands(self) -> dict[str, Command]:
        """Return the command table, which is the controller's manual."""
        acts: dict[str, CommandHandler] = {
            "PROJ": self._select_projector,
            "PROJ?": lambda *_: str(self.projector),
            "PAT": self._select_pattern,
            "PAT?": lambda *_: self._pattern_text(),
            "TRIG": self._trigger,
            "TRIG:LAST?": lambda *_: self.last_report or "NONE",
            "TRIG:COUN?": lambda *_: str(self.count),
            "CAM:TRIG": self._trigger_all,
            "SAFE:EYES": self._set_eyes,
            "SAFE:EYES?": lambda *_: self.eyes,
            "DOSE?": lambda *_: f"{self.dose_ws:.6f}",
            "DOSE:NEW": self._new_subject,
        }
        return build_command_table("scanner", acts)

    # time -------------------------------------------------------------------------------------

    @property
    def lit(self) -> bool:
        """Whether a projector is on."""
        return self._show is not None

    def deadline(self) -> float:
        """Return the time of the cameras' release or the light's end, in s; inf for never."""
        due = self._stop_changes_at_s()
        if self._show is not None:
            waits = self._show.outcome is None
            due = min(due, self._show.release_s if waits else self._show.light.t_off_s)
        return due

    def advance(self, now: float) -> None:
        """Advance time to `now`, in s."""
        while (due := self.deadline()) <= now:
            self._follow_stop(due)
            show = self._show
            if show is None:
                continue
            if show.outcome is None:
                if show.release_s <= due:
                    self._release(show, due)
            elif show.light.t_off_s <= due:
                self._end(show, due)

    def go_dark(self, now: float) -> None:
        """Switch the projectors off; a pending release is prevented."""
        if self._show is not None:
            if self._show.outcome is None:
                self._show.outcome = CommandRefused(Code.HARDWARE, "made dark before the release")
            self._end(self._show, now)

    def is_busy(self, now: float) -> bool:
        """Return whether a pattern is shown."""
        return self.lit

    def states(self, now: float) -> dict[int, bool]:
        """Return bits 16 a pattern is shown, 64 light, 512 eyes closed or shielded."""
        return {16: self.lit, 64: self.lit, 512: self.eyes != "OPEN"}

    def light_now(self, now: float) -> list[ProjectorLight]:
        """Return the light in progress, as emitted so far."""
        return [] if self._show is None else [_cut(self._show.light, now)]

    def _release(self, show: _Show, now: float) -> None:
        names = self._scanner.projectors[self._number(show)].cameras
        mask = sum(1 << k for k, view in enumerate(self._scanner.views) if view.name in names)
        self._on_trigger(now, mask)
        self.count += 1
        what = self._pattern_text(show.light)
        self.last_report = f"{show.token},{self.clock_us(now)},{self._number(show)},{what}"
        show.outcome = f"{show.token},{self.clock_us(now)}"

    def _number(self, show: _Show) -> int:
        names = [projector.name for projector in self._scanner.projectors]
        return names.index(show.light.projector)

    def _end(self, show: _Show, now: float) -> None:
        self._show = None
        light = _cut(show.light, now)
        power_w = self._scanner.projectors[self._number(show)].power_w
        self.dose_ws += power_w * (elapsed_us(light.t_on_s, light.t_off_s) / 1e6)
        if light.t_off_s > light.t_on_s and light.level > 0.0:
            self._on_light(light)

    # commands ---------------------------------------------------------------------------------

    def _pattern_text(self, light: ProjectorLight | None = None) -> str:
        axis, pattern = (self.axis, self.pattern) if light is None else (light.axis, light.pattern)
        words = {axis: word for word, axis in AXES_BY_WORD.items()}
        return f"{words[axis]},{pattern}" if axis else "FULL"

    def _require_dark(self, now: float) -> None:
        # also until a release that was prevented has been answered
        shown = self.lit or now < self._answer_s
        CommandRefused.raise_if(shown, Code.IGNORED, "a pattern is shown")

    def _select_projector(self, arguments: str, now: float) -> None:
        number = parse_integer(arguments, 0, len(self._scanner.projectors) - 1)
        self._require_dark(now)
        self.projector = number

    def _select_pattern(self, arguments: str, now: float) -> None:
        word, comma, number = arguments.partition(",")
        word = parse_choice(word, (*AXES_BY_WORD, "FULL"))
        if word == "FULL":
            CommandRefused.raise_if(comma, Code.SYNTAX, "expected FULL")
            axis, pattern = "", 0
        else:
            axis = AXES_BY_WORD[word]
            projector = self._scanner.projectors[self.projector]
            last = self._scanner.pattern_count(projector, axis) - 1
            pattern = parse_integer(number, 0, last)
        self._require_dark(now)
        self.axis, self.pattern = axis, pattern

    def _trigger(self, arguments: str, now: float) -> PendingReply:
        token, comma, length = arguments.partition(",")
        token = parse_token(token)
        CommandRefused.raise_if(not comma, Code.SYNTAX, "expected TOKEN,MS")
        most_ms = self._scanner.max_show_s * 1e3
        span_us = parse_decimal(length, MIN_SHOW_MS, most_ms, "ms", digits=3)
        self._require_closed_stop()
        self._require_dark(now)
        CommandRefused.raise_if(self.eyes == "OPEN", Code.FLICKER)
        dead = self.faults.is_led_dead(self.projector, now)
        why = f"the lamp of projector {self.projector} draws no current"
        CommandRefused.raise_if(dead, Code.HARDWARE, why)
        projector = self._scanner.projectors[self.projector]
        span_s = span_us / 1e6
        dose_ws = self.dose_ws + projector.power_w * span_s
        if dose_ws > self._dose_limit_ws:
            text = f"{dose_ws:.3f} of {self._dose_limit_ws:g} Ws"
            raise CommandRefused(Code.LIGHT_DOSE, text)
        if span_s < self._scanner.settle_s:
            least = f"expected at least settle_ms {self._scanner.settle_s * 1e3:g}"
            raise CommandRefused(Code.OUT_OF_RANGE, least)
        level = self.faults.weak_leds.get(self.projector, 1.0)
        light = ProjectorLight(
            projector.name, self.axis, self.pattern, level, now, add_us(now, span_us)
        )
        show = _Show(token, light, add_us(now, 1e6 * self._scanner.settle_s))
        self._show, self._answer_s = show, show.release_s

        def outcome() -> str | CommandRefused:
            return show.outcome or CommandRefused(Code.HARDWARE, "the cameras were not released")

        return PendingReply(show.release_s, outcome)

    def _trigger_all(self, arguments: str, now: float) -> str:
        self._require_dark(now)
        token = parse_token(arguments)
        self._on_trigger(now, (1 << len(self._scanner.views)) - 1)
        return f"{token},{self.clock_us(now)}"

    def _set_eyes(self, arguments: str, now: float) -> None:
        self.eyes = parse_choice(arguments, SCANNER_EYE_STATES)
        if self.eyes == "OPEN":
            self.go_dark(now)

    def _new_subject(self, arguments: str, now: float) -> None:
        parse_token(arguments)
        self._require_dark(now)
        self.dose_ws = 0.0
        self.eyes = "OPEN"


def _cut(light: ProjectorLight, now: float) -> ProjectorLight:
    """Return light until now."""
    off_s = max(light.t_on_s, min(light.t_off_s, now)) if math.isfinite(now) else light.t_off_s
    return ProjectorLight(
        light.projector, light.axis, light.pattern, light.level, light.t_on_s, off_s
    )
