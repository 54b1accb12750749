"""Model the light source of a contact probe: LED, shutter, and the cover of the fibers.

The LED shines on the closed shutter and is steady when it opens. A sensor monitors the blades: an
opening that fails is detected, and when blades stay open the LED is switched off instead.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from capture.devices.wire import Code
from capture.rig import LedLimits
from rigsim.boxes.command import CommandRefused, add_us, ceil_ms, elapsed_s, elapsed_us
from rigsim.boxes.device import Device, Wiring

LEVEL_STEPS = 1000
MIN_OPENING_MS = 1.0
"""Shortest opening, ms, and time from the command until the blades have cleared the fiber."""
JAM_DETECTION_S = 0.02
"""Time after which blades that have not closed count as stuck, s."""
COVER_MOVE_S = 0.3
"""Time of the cover from any position to any other, s."""


@dataclass(frozen=True, slots=True)
class SourceLight:
    """An interval of light from the probe's source fiber."""

    level: float
    """Light relative to full, 0 < level <= 1."""
    t_on_s: float
    """World time of its start, s."""
    t_off_s: float
    """World time of its end, s."""
    fiber: int | None
    """Number of the only detection fiber that is not covered, from 0; None: none is covered."""


@dataclass(slots=True)
class _Opening:
    """One opening of the shutter, from the command on."""

    number: int
    clears_s: float
    ends_s: float
    outcome: str | CommandRefused | None = None  # answer to the command, once known
    open: bool = False
    jams_s: float = math.inf  # when the LED is switched off because the blades do not close


class SourceShutter:
    """LED, shutter and cover with their state.

    Parameters
    ----------
    box
        Sender of events.
    wiring
        The rig with fibers and LED, the faults, and the observers of light; the camera line is
        pulsed when the blades have cleared the fiber.
    """

    def __init__(self, box: Device, wiring: Wiring) -> None:
        rig, faults, self._rng = wiring.rig, wiring.faults, wiring.rng
        self._box = box
        self.fibers = 0 if rig.probe is None else len(rig.probe.fibers)
        self._power_w = rig.lights[0].power_w or 0.0
        self.dose_limit_ws = (rig.leds or LedLimits()).dose_ws
        self._on_light, self._on_open = wiring.on_light, wiring.on_trigger
        self._stuck, self._jam = faults.shutter_stuck, faults.shutter_jam
        self._faults = faults
        self._weak = faults.weak_leds.get(0, 1.0)
        self._opening: _Opening | None = None
        self._light_since: float | None = None
        self._settled_s = 0.0
        self._answer_s = 0.0  # when the answer to the last opening is due
        self.level = 0
        self.count = 0
        self.dose_ws = 0.0
        self.fiber: int | None = None
        self.jammed = False
        self.last_report = ""

    # now --------------------------------------------------------------------------------------

    @property
    def is_open(self) -> bool:
        """Whether the blades leave the fiber free."""
        return self.jammed or (self._opening is not None and self._opening.open)

    @property
    def lit(self) -> bool:
        """Whether the source emits light."""
        return self._light_since is not None

    def is_moving(self, now: float) -> bool:
        """Return whether an opening is in progress or the cover moves."""
        return self._opening is not None or now < self._settled_s

    def light_now(self, now: float) -> list[SourceLight]:
        """Return the light that has not ended, as emitted so far."""
        if self._light_since is None:
            return []
        return [self._light_interval(self._light_since, max(now, self._light_since))]

    def remaining_ms(self, now: float) -> int:
        """Return the remaining open time of the shutter, ms."""
        if self._opening is None or math.isinf(self._opening.ends_s):
            return 0
        return max(0, ceil_ms(elapsed_us(now, self._opening.ends_s)))

    def _light_interval(self, t_on_s: float, t_off_s: float) -> SourceLight:
        return SourceLight(self.level / LEVEL_STEPS * self._weak, t_on_s, t_off_s, self.fiber)

    # time -------------------------------------------------------------------------------------

    def deadline(self) -> float:
        """Return the time of the next change of blades or LED of their own, in s."""
        opening = self._opening
        if opening is None:
            return math.inf
        return min(opening.ends_s, opening.jams_s) if opening.open else opening.clears_s

    def advance(self, now: float) -> None:
        """Advance time to `now`, at most one deadline."""
        opening = self._opening
        if opening is None or self.deadline() > now:
            return
        if not opening.open:
            self._clear(opening, now)
        elif opening.jams_s <= now:
            self._give_up(opening, now)
        else:
            self._shut(opening, "TIMED", now)

    def _clear(self, opening: _Opening, now: float) -> None:
        if self._rng.random() < self._stuck:
            opening.outcome = CommandRefused(Code.HARDWARE, "the shutter did not open")
            self._opening = None
            return
        opening.open = True
        self._begin_light(now)
        self.last_report = f"{opening.number},OPEN,{self._box.clock_us(now)},-"
        opening.outcome = f"{opening.number},{self._box.clock_us(now)}"
        self._on_open(now)

    def _shut(self, opening: _Opening, how: str, now: float) -> None:
        """Close the blades at a time chosen by the controller or the host."""
        if self._rng.random() < self._jam:
            opening.ends_s, opening.jams_s = math.inf, add_us(now, 1e6 * JAM_DETECTION_S)
            return
        self._end(opening, how, now)

    def _give_up(self, opening: _Opening, now: float) -> None:
        """Switch off the LED because the blades do not close."""
        self._put_out(now)
        self.jammed = True
        self._end(opening, "JAM", now)

    def _end(self, opening: _Opening, how: str, now: float) -> None:
        self._end_light(now)
        self._opening = None
        opened = self.last_report.split(",")[2]
        self.last_report = f"{opening.number},{how},{opened},{self._box.clock_us(now)}"
        self._box.queue_event("SHUT:END", self.last_report)

    def _begin_light(self, now: float) -> None:
        if self.level > 0:
            self._light_since = now

    def _end_light(self, now: float) -> None:
        if self._light_since is None:
            return
        light = self._light_interval(self._light_since, now)
        self._light_since = None
        lit_s = elapsed_s(light.t_on_s, now)
        self.dose_ws += self._power_w * self.level / LEVEL_STEPS * lit_s
        if light.t_off_s > light.t_on_s:
            self._on_light(light)

    def _put_out(self, now: float) -> None:
        self._end_light(now)
        self.level = 0

    # commands ------------------------------------------------------------------------

    def open(self, span_us: int, now: float) -> tuple[float, Callable[[], str | CommandRefused]]:
        """Begin an opening; return when its outcome is known, and the function that returns it."""
        CommandRefused.raise_if(self.jammed, Code.HARDWARE, "the shutter is stuck open; SHUT CLOSE")
        self.require_closed(now)
        CommandRefused.raise_if(now < self._answer_s, Code.IGNORED, "the shutter is open")
        give_ws = self._power_w * self.level / LEVEL_STEPS * (span_us / 1e6)
        if self.dose_ws + give_ws > self.dose_limit_ws:
            dose = f"{self.dose_ws + give_ws:.3f} of {self.dose_limit_ws:g} Ws"
            raise CommandRefused(Code.LIGHT_DOSE, dose)
        self.count += 1
        self._answer_s = clears_s = add_us(now, 1e3 * MIN_OPENING_MS)
        opening = _Opening(self.count, clears_s, add_us(clears_s, span_us))
        self._opening = opening

        def outcome() -> str | CommandRefused:
            return opening.outcome or CommandRefused(Code.HARDWARE, "made dark before it opened")

        return clears_s, outcome

    def close(self, now: float) -> None:
        """Close the blades by command; retry where they are stuck."""
        if self.jammed:
            self.jammed = self._rng.random() < self._jam
            CommandRefused.raise_if(self.jammed, Code.HARDWARE, "the shutter is stuck open")
        elif self._opening is not None and not self._opening.open:
            self._opening = None
        elif self._opening is not None and math.isinf(self._opening.jams_s):
            self._shut(self._opening, "ASKED", now)

    def go_dark(self, now: float, outcome: str) -> None:
        """Switch off the LED and close the blades, at once."""
        self._put_out(now)
        self.abort_opening(now, outcome)

    def abort_opening(self, now: float, outcome: str) -> None:
        """End an opening at once, for a reason of the controller's own."""
        opening = self._opening
        if opening is None or not opening.open:
            self._opening = None
        elif math.isfinite(opening.jams_s) or self._rng.random() < self._jam:
            self._give_up(opening, now)
        else:
            self._end(opening, outcome, now)

    def require_closed(self, now: float) -> None:
        """Refuse while the shutter is open or opening, or the cover moves."""
        if self._opening is not None:
            raise CommandRefused(Code.IGNORED, "the shutter is open")
        CommandRefused.raise_if(now < self._settled_s, Code.IGNORED, "the cover moves")

    def set_level(self, level: int, now: float) -> None:
        """Drive the LED behind the closed shutter, 0 to 1000 thousandths of full."""
        if level > 0:
            self.require_closed(now)
            CommandRefused.raise_if(
                self.jammed, Code.HARDWARE, "the shutter is stuck open; SHUT CLOSE"
            )
            dead = self._faults.is_led_dead(0, now)
            CommandRefused.raise_if(dead, Code.HARDWARE, "the LED draws no current")
            self.level = level
        else:
            self._put_out(now)

    def cover(self, fiber: int | None, now: float) -> None:
        """Begin to move the cover: over all detection fibers but one, or off all of them."""
        self.require_closed(now)
        if fiber != self.fiber:
            self.fiber = fiber
            self._settled_s = add_us(now, 1e6 * COVER_MOVE_S)

    def forget(self, *, power_up: bool, now: float) -> None:
        """Restore the power-up settings; the source is dark already, no fiber covered."""
        if power_up:
            self.last_report = ""
            self._answer_s = now
        if self.fiber is not None:
            self.fiber = None
            self._settled_s = add_us(now, 1e6 * COVER_MOVE_S)
