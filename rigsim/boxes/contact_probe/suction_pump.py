"""Model the suction control of a contact probe: gauge, end time, rest, and faults.

The controller has the pump's switch, its vent, and the gauge's reading. It samples the gauge once
per control period and vents when the suction is not reached, is lost, or exceeds the limit. The
skin rests between two intervals of suction. Only a requested vent and the pump's own end keep the
head's site; after anything else the head may have moved.
"""

import math
from dataclasses import dataclass

import numpy as np

from capture.devices.wire import Code
from capture.rig import Probe
from rigsim.boxes.command import CommandRefused, add_us, ceil_ms, elapsed_us
from rigsim.boxes.contact_probe.source_shutter import SourceShutter
from rigsim.boxes.device import Device, SuctionLoad

PUMP_CONTROL_PERIOD_S = 0.05
"""Sampling period of the gauge while the pump runs, s."""
MAX_PUMPING_S = 2.0
"""Time within which `HELD_SHARE` of the suction must be reached, s."""
HELD_SHARE, LOST_SHARE = 0.7, 0.4
"""Fractions of the requested suction: reached from the first on, lost below the second."""
MAX_SUCTION_RATIO = 1.1
"""Suction relative to the maximum of requests, above which the regulator counts as broken."""
MIN_SUCTION_MBAR = 10.0
"""Smallest suction that may be requested, well above the gauge's deviation."""
MIN_SUCTION_MS = 100.0
GAUGE_NOISE_MBAR = 0.3
GAUGE_ZERO_DEVIATION_MBAR = 0.7
"""Standard deviations of one reading of the gauge, and of its zero between controllers."""


class Gauge:
    """A pressure sensor with a zero offset and noise.

    Parameters
    ----------
    rng
        Draws both.
    dead_after_s
        World time from which it draws no current, s.
    """

    def __init__(self, *, rng: np.random.Generator, dead_after_s: float = math.inf) -> None:
        self._rng = rng
        self._dead_after_s = dead_after_s
        self._zero_mbar = float(rng.normal(0.0, GAUGE_ZERO_DEVIATION_MBAR))

    def read(self, true_mbar: float, now: float) -> float | None:
        """Return a reading, mbar; None when it is dead."""
        if now >= self._dead_after_s:
            return None
        return true_mbar + self._zero_mbar + float(self._rng.normal(0.0, GAUGE_NOISE_MBAR))


@dataclass(slots=True)
class _Draw:
    """An interval of suction in progress."""

    number: int
    start_s: float
    ends_s: float
    wanted_mbar: float
    ticks: int = 0
    held: bool = False
    mbar: float = 0.0  # last reading

    @property
    def next_s(self) -> float:
        tick_us = (self.ticks + 1) * 1e6 * PUMP_CONTROL_PERIOD_S
        return min(add_us(self.start_s, tick_us), self.ends_s)


class SuctionPump:
    """Pump, vent and gauge, and the declared site of the head.

    Parameters
    ----------
    box
        Sender of events.
    probe
        Its limits and the skin's rest time.
    load
        The head on the skin.
    gauge
        Gauge of the suction under the head.
    shutter
        Closes when the suction has ended, whatever the reason.
    """

    def __init__(
        self, box: Device, probe: Probe, load: SuctionLoad, gauge: Gauge, shutter: SourceShutter
    ) -> None:
        self._box, self._probe, self._load, self._gauge = box, probe, load, gauge
        self._shutter = shutter
        self._draw: _Draw | None = None
        # a separate clock keeps the skin's rest through a reset of the controller
        self._rested_s = 0.0
        self.count = 0
        self.placement: tuple[str, float] | None = None
        self.last_report = ""

    # now --------------------------------------------------------------------------------------

    @property
    def is_pumping(self) -> bool:
        """Whether the pump is on."""
        return self._draw is not None

    @property
    def has_reached_target(self) -> bool:
        """Whether the requested suction has been reached since the pump went on."""
        return self._draw is not None and self._draw.held

    def remaining_rest_ms(self, now: float) -> int:
        """Return the remaining rest time of the skin, ms."""
        return 0 if self.is_pumping else ceil_ms(max(0, elapsed_us(now, self._rested_s)))

    def state(self, now: float) -> str:
        """Return ``ON,mbar,ms left``, ``REST,ms left`` or ``VENT``."""
        if self._draw is not None:
            left_ms = ceil_ms(elapsed_us(now, self._draw.ends_s))
            return f"ON,{self._draw.wanted_mbar:g},{left_ms}"
        rest_ms = self.remaining_rest_ms(now)
        return f"REST,{rest_ms}" if rest_ms else "VENT"

    def read(self, now: float) -> float:
        """Return the gauge's reading, mbar."""
        reading = self._gauge.read(self._load.suction_mbar(now), now)
        if reading is None:
            raise CommandRefused(Code.HARDWARE, "the pressure gauge is dead")
        return reading

    # time -------------------------------------------------------------------------------------

    def deadline(self) -> float:
        """Return when the gauge will next be sampled, or the pump ends by itself, in s."""
        return math.inf if self._draw is None else self._draw.next_s

    def advance(self, now: float) -> None:
        """Advance time to `now`, at most one deadline."""
        draw = self._draw
        if draw is None or draw.next_s > now:
            return
        draw.ticks += 1
        reading = self._gauge.read(self._load.suction_mbar(now), now)
        if reading is None:
            self._fail(draw, "GAUGE", now)
            return
        draw.mbar = reading
        draw.held = draw.held or reading >= HELD_SHARE * draw.wanted_mbar
        if reading > MAX_SUCTION_RATIO * self._probe.max_suction_mbar:
            self._fail(draw, "HIGH", now)
        elif draw.held and reading < LOST_SHARE * draw.wanted_mbar:
            self._fail(draw, "LOST", now)
        elif not draw.held and elapsed_us(draw.start_s, now) >= 1e6 * MAX_PUMPING_S:
            self._fail(draw, "LOW", now)
        elif now >= draw.ends_s:
            self._end(draw, "TIMED", now)

    def _end(self, draw: _Draw, how: str, now: float) -> None:
        self._draw = None
        self._load.vent(now)
        self._rested_s = add_us(now, 1e6 * self._probe.rest_s)
        self.last_report = f"{draw.number},{how},{draw.mbar:.1f},{self._box.clock_us(now)}"
        self._box.queue_event("PUMP:END", self.last_report)
        self._shutter.abort_opening(now, "PUMP")

    def _fail(self, draw: _Draw, how: str, now: float) -> None:
        self._end(draw, how, now)
        self.remove_head(now)

    # commands ------------------------------------------------------------------------

    def place(self, site: str, angle_deg: float, now: float) -> None:
        """Record the head's site as the operator declares it."""
        if self._draw is not None:
            raise CommandRefused(Code.IGNORED, "the pump is on; PUMP VENT first")
        self._load.place(site, angle_deg, now)
        self.placement = (site, angle_deg)

    def remove_head(self, now: float) -> None:
        """Clear the head's site: the head is taken off."""
        self.placement = None
        self._load.remove(now)

    def draw(self, span_us: int, mbar: float, now: float) -> str:
        """Switch the pump on until its own end; return the number of this interval of suction."""
        if self._draw is not None:
            raise CommandRefused(Code.IGNORED, "the pump is on; PUMP VENT first")
        if self.placement is None:
            raise CommandRefused(Code.IGNORED, "HEAD:SITE first")
        if rest_ms := self.remaining_rest_ms(now):
            raise CommandRefused(Code.RECYCLE, f"skin, {rest_ms} ms")
        self.read(now)
        self.count += 1
        self._draw = _Draw(self.count, now, add_us(now, span_us), mbar)
        self._load.start_suction(mbar, now)
        return str(self.count)

    def vent(self, now: float, outcome: str) -> None:
        """Switch the pump off and open the vent."""
        if self._draw is not None:
            self._end(self._draw, outcome, now)
