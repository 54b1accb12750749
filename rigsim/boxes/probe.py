"""The contact probe's box: source, shutter, cover of the fibres, suction, camera; sans-I/O.

Its manual is its command table (`ProbeUnit.commands`) and these rules. Light and suction need an
armed box and carry their own end; the shutter pulses the camera's line when its blades have cleared
the fibre, and answers then. No light leaves a head that is not held, because an eye may be before
it: with the LED on, the shutter opens only when the gauge has seen the suction that was asked for,
and shuts when the pump goes off. Before the pump a person has to say with ``HEAD:SITE`` where the
head sits, which means after each change, and after each time that the box has let go by itself:
what makes other boxes dark (``SAFE``, ``ABOR``, ``*RST``, a silent host, the emergency stop, the
loss of power) shuts the shutter, puts the LED out, vents, and forgets the place, because nobody
knows whether a head that nothing holds is still there. ``PUMP VENT`` and the pump's own end keep
it: the skin rests, and is sucked at again. A suction that ends by a fault forgets the place, too.

The box does not know what it sits on: it draws at a `SuctionLoad` and has a gauge.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from capture.devices.wire import Code
from capture.rig import LedLimits, Light, Probe
from rigsim.boxes.controller import Command, Later, Refused, number, word
from rigsim.boxes.source_shutter import COVER_S, LEVEL_STEPS, SHUTTER_MS, SourceLight, SourceShutter
from rigsim.boxes.suction_pump import (
    MAX_PUMPING_S,
    MIN_SUCTION_MBAR,
    MIN_SUCTION_MS,
    PUMP_CONTROL_PERIOD_S,
    Gauge,
    SuctionLoad,
    SuctionPump,
)

__all__ = ["ProbeUnit", "SourceLight"]

(
    STATUS_MOVING,
    STATUS_SUCKING,
    STATUS_LIT,
    STATUS_INTERLOCK,
    STATUS_PLACED,
    STATUS_RESTING,
    STATUS_JAMMED,
) = 16, 32, 64, 256, 512, 1024, 2048
THERMOMETER_C = 0.03
"""Standard deviation of one reading of the camera's thermometer, kelvin."""
_WHOLE_PATTERN = re.compile(r"[0-9]{1,4}")


class ProbeUnit:
    """State of the probe's box behind its controller.

    Parameters
    ----------
    probe
        Its fibres and limits.
    source, limits
        The LED at the source fibre, and what it may do; the dose of one subject among it.
    load
        What the head sits on.
    on_light
        Called with each stretch of light when it ends.
    on_trigger
        Called with the world time in s when the camera's line is pulsed.
    shutter_stuck, shutter_jam, gauge_dead_after, interlock, interlock_after
        See `rigsim.world.faults.Faults`.
    dead, weak
        The LED draws no current; it gives so much of a new one's light, which nobody notices.
    rng
        Noise of gauge and thermometer, and what sticks.
    """

    kind = "probe"
    model = "PROBE1"

    def __init__(
        self,
        probe: Probe,
        source: Light,
        limits: LedLimits,
        load: SuctionLoad,
        *,
        on_light: Callable[[SourceLight], None],
        on_trigger: Callable[[float], None],
        shutter_stuck: float = 0.0,
        shutter_jam: float = 0.0,
        gauge_dead_after: float = math.inf,
        interlock: bool = False,
        interlock_after: float = math.inf,
        dead: bool = False,
        weak: float = 1.0,
        rng: np.random.Generator,
    ) -> None:
        self._probe = probe
        self._source = source
        self._load = load
        self._on_trigger = on_trigger
        self._interlock_at = -math.inf if interlock else interlock_after
        self.interlock = interlock
        self._rng = rng
        self._powered_at = 0.0
        self._events: list[tuple[str, str]] = []
        self.shutter = SourceShutter(
            len(probe.fibres),
            power_w=source.power_w or 0.0,
            dose_ws=limits.dose_ws,
            on_light=on_light,
            on_open=on_trigger,
            say=self._say,
            clock_us=self._clock_us,
            stuck=shutter_stuck,
            jam=shutter_jam,
            dead=dead,
            weak=weak,
            rng=rng,
        )
        self.pump = SuctionPump(
            probe,
            load,
            Gauge(rng=rng, dead_after_s=gauge_dead_after),
            on_end=lambda now: self.shutter.shut(now, "PUMP"),
            say=self._say,
            clock_us=self._clock_us,
        )

    # settings ---------------------------------------------------------------------------------

    def reset(self, now: float, *, power_up: bool) -> None:
        """Return to the settings of power-up: dark, vented, no place, no fibre covered."""
        self.go_dark(now)
        self.shutter.forget(power_up=power_up, now=now)
        if power_up:
            self._powered_at = now
            self._events.clear()
            self.pump.last_report = ""

    def capabilities(self) -> Mapping[str, Any]:
        """Return limits and counts, units in the names."""
        probe = self._probe
        return {
            "fibres": len(probe.fibres),
            "level_steps": LEVEL_STEPS,
            "shutter_min_ms": SHUTTER_MS,
            "shutter_max_ms": round(probe.max_open_s * 1e3, 6),
            "shutter_lag_ms": SHUTTER_MS,
            "cover_ms": COVER_S * 1e3,
            "suction_min_mbar": MIN_SUCTION_MBAR,
            "suction_max_mbar": probe.max_suction_mbar,
            "suction_min_ms": MIN_SUCTION_MS,
            "suction_max_ms": round(probe.max_suction_s * 1e3, 6),
            "reach_ms": MAX_PUMPING_S * 1e3,
            "rest_ms": round(probe.rest_s * 1e3, 6),
            "control_period_ms": PUMP_CONTROL_PERIOD_S * 1e3,
            "camera_c": probe.camera_c,
            "source_w": self._source.power_w,
            "dose_ws": self.shutter.dose_limit_ws,
        }

    def commands(self) -> Mapping[str, Command]:
        """Return the command table: the manual of the box."""
        return {
            "HEAD:SITE": Command(
                self._place,
                "<label>,<deg>",
                armed=True,
                manual="a person says where the head sits, and how it is turned",
            ),
            "HEAD:SITE?": Command(self._get_place, manual="label, degrees; or NONE"),
            "HEAD:FREE": Command(self._take_away, bare=True, manual="the head is taken off: vent"),
            "PUMP": Command(
                self._pump,
                "ON,<ms>,<mbar>|VENT",
                armed=True,
                harmless=("VENT",),
                manual="suck, with an end: number; or vent",
            ),
            "PUMP?": Command(self._get_pump, manual="ON,mbar,ms left; REST,ms left; or VENT"),
            "PUMP:LAST?": Command(
                self._last_suction,
                manual="last suction that ended: number, TIMED, ASKED, LOW, LOST, HIGH, GAUGE, "
                "INTERLOCK or DARK, mbar, us; or NONE",
            ),
            "PRES?": Command(self._pressure, manual="suction, mbar below the air's pressure"),
            "LED": Command(
                self._set_level,
                "<level>",
                armed=True,
                harmless=("0",),
                manual="light of the source's LED, thousandths of full",
            ),
            "LED?": Command(self._get_level, manual="that level"),
            "SHUT": Command(
                self._shut,
                "OPEN,<ms>|CLOSE",
                armed=True,
                harmless=("CLOSE",),
                manual="open, pulsing the camera line, with an end: number, us; or close",
            ),
            "SHUT?": Command(self._get_shutter, manual="OPEN,ms left; CLOSED; or JAM"),
            "SHUT:LAST?": Command(
                self._last_opening,
                manual="last opening: number, OPEN, TIMED, ASKED, PUMP, JAM, INTERLOCK or DARK, "
                "us it opened, us it closed or -; or NONE",
            ),
            "SHUT:COUN?": Command(self._count, manual="openings tried since the box was made"),
            "FIB": Command(
                self._cover, "<n>|ALL", manual="uncover one detection fibre, from 0, or all"
            ),
            "FIB?": Command(self._get_cover, manual="the only one that is not covered, or ALL"),
            "CAM:TRIG": Command(
                self._trigger, "<token>", manual="pulse the camera line without light: token, us"
            ),
            "CAM:TEMP?": Command(self._temperature, manual="of the camera, degrees Celsius"),
            "DOSE?": Command(self._dose, manual="light into this subject, Ws"),
            "DOSE:NEW": Command(
                self._new_subject, "<token>", manual="another subject: count the dose anew"
            ),
        }

    # time -------------------------------------------------------------------------------------

    def deadline(self) -> float:
        """Return when something will next happen by itself, in s."""
        stop = math.inf if self.interlock else self._interlock_at
        return min(stop, self.shutter.deadline(), self.pump.deadline())

    def advance(self, now: float) -> None:
        """Let time pass up to `now`, in s."""
        while (due := self.deadline()) <= now:
            if not self.interlock and self._interlock_at <= due:
                self.interlock = True
                self._let_go(due, "INTERLOCK")
            self.shutter.advance(due)
            self.pump.advance(due)

    def take_events(self) -> list[tuple[str, str]]:
        """Return and forget what the box has to say unasked: name and payload."""
        events = list(self._events)
        self._events.clear()
        return events

    def go_dark(self, now: float) -> None:
        """Shut the shutter, put the LED out, vent, and forget where the head sits."""
        self._let_go(now, "DARK")

    def light_now(self, now: float) -> list[SourceLight]:
        """Return the light that has not ended, as given so far."""
        return self.shutter.light_now(now)

    @property
    def lit(self) -> bool:
        """Whether light comes out of the source."""
        return self.shutter.lit

    def busy(self, now: float) -> bool:
        """Tell whether the shutter is open or the cover moves."""
        return self.shutter.under_way(now)

    def status_bits(self, now: float) -> int:
        """Return 16 busy, 32 sucking, 64 lit, 256 stop, 512 placed, 1024 resting, 2048 jammed."""
        pump, shutter = self.pump, self.shutter
        bits = (
            STATUS_MOVING * self.busy(now)
            + STATUS_SUCKING * pump.drawing
            + STATUS_LIT * shutter.lit
        )
        bits += STATUS_INTERLOCK * self.interlock + STATUS_PLACED * (pump.placement is not None)
        return bits + STATUS_RESTING * (pump.rest_ms(now) > 0) + STATUS_JAMMED * shutter.jammed

    def _let_go(self, now: float, how: str) -> None:
        self.shutter.go_dark(now, how)
        self.pump.vent(now, how)
        self.pump.take_away(now)

    def _say(self, name: str, payload: str) -> None:
        self._events.append((name, payload))

    def _clock_us(self, now: float) -> int:
        return round((now - self._powered_at) * 1e6)

    def _require_stop_closed(self) -> None:
        if self.interlock:
            raise Refused(Code.INTERLOCK)

    # head and pump ----------------------------------------------------------------------------

    def _place(self, arguments: str, now: float) -> str:
        label, _, angle = arguments.partition(",")
        site = word(label)
        angle_deg = number(angle, 0.0, 360.0, "degrees, less than 360")
        if angle_deg == 360.0:
            raise Refused(Code.OUT_OF_RANGE, "expected 0 to less than 360 degrees")
        self.shutter.require_closed(now)
        self.pump.place(site, angle_deg, now)
        return ""

    def _get_place(self, _: str, now: float) -> str:
        if self.pump.placement is None:
            return "NONE"
        site, angle_deg = self.pump.placement
        return f"{site},{angle_deg:g}"

    def _take_away(self, _: str, now: float) -> str:
        self.shutter.shut(now, "ASKED")
        self.pump.vent(now, "ASKED")
        self.pump.take_away(now)
        return ""

    def _pump(self, arguments: str, now: float) -> str:
        if arguments.upper() == "VENT":
            self.pump.vent(now, "ASKED")
            return ""
        on, _, rest = arguments.partition(",")
        length, comma, suction = rest.partition(",")
        if on.upper() != "ON" or not comma:
            raise Refused(Code.SYNTAX, "expected ON,<ms>,<mbar> or VENT")
        span_ms = number(length, MIN_SUCTION_MS, self._probe.max_suction_s * 1e3, "ms")
        mbar = number(suction, MIN_SUCTION_MBAR, self._probe.max_suction_mbar, "mbar")
        self._require_stop_closed()
        return self.pump.draw(span_ms / 1e3, mbar, now)

    def _get_pump(self, _: str, now: float) -> str:
        return self.pump.state(now)

    def _last_suction(self, _: str, now: float) -> str:
        return self.pump.last_report or "NONE"

    def _pressure(self, _: str, now: float) -> str:
        return f"{self.pump.read(now):.1f}"

    # light ------------------------------------------------------------------------------------

    def _set_level(self, arguments: str, now: float) -> str:
        if _WHOLE_PATTERN.fullmatch(arguments) is None:
            raise Refused(Code.SYNTAX, "expected a whole number of thousandths")
        level = int(arguments)
        if level > LEVEL_STEPS:
            raise Refused(Code.OUT_OF_RANGE, f"expected 0 to {LEVEL_STEPS} thousandths")
        if level > 0:
            self._require_stop_closed()
        self.shutter.set_level(level, now)
        return ""

    def _get_level(self, _: str, now: float) -> str:
        return str(self.shutter.level)

    def _shut(self, arguments: str, now: float) -> str | Later:
        if arguments.upper() == "CLOSE":
            self.shutter.close(now)
            return ""
        what, _, length = arguments.partition(",")
        if what.upper() != "OPEN":
            raise Refused(Code.SYNTAX, "expected OPEN,<ms> or CLOSE")
        span_ms = number(length, SHUTTER_MS, self._probe.max_open_s * 1e3, "ms")
        self._require_stop_closed()
        if self.shutter.level > 0 and not self.pump.holds:
            raise Refused(Code.IGNORED, "the head is not held; PUMP ON, and wait")
        at_s, outcome = self.shutter.open(span_ms / 1e3, now)
        return Later(at_s, outcome)

    def _get_shutter(self, _: str, now: float) -> str:
        if self.shutter.jammed:
            return "JAM"
        return f"OPEN,{self.shutter.left_ms(now)}" if self.shutter.is_open else "CLOSED"

    def _last_opening(self, _: str, now: float) -> str:
        return self.shutter.last_report or "NONE"

    def _count(self, _: str, now: float) -> str:
        return str(self.shutter.count)

    def _cover(self, arguments: str, now: float) -> str:
        if arguments.upper() == "ALL":
            self.shutter.cover(None, now)
            return ""
        if _WHOLE_PATTERN.fullmatch(arguments) is None:
            raise Refused(Code.SYNTAX, "expected the number of a fibre, or ALL")
        if int(arguments) >= self.shutter.fibres:
            raise Refused(Code.OUT_OF_RANGE, f"expected 0 to {self.shutter.fibres - 1} or ALL")
        self.shutter.cover(int(arguments), now)
        return ""

    def _get_cover(self, _: str, now: float) -> str:
        return "ALL" if self.shutter.fibre is None else str(self.shutter.fibre)

    def _dose(self, _: str, now: float) -> str:
        return f"{self.shutter.dose_ws:.6f}"

    def _new_subject(self, arguments: str, now: float) -> str:
        word(arguments)
        self.shutter.dose_ws = 0.0
        return ""

    # camera -----------------------------------------------------------------------------------

    def _trigger(self, arguments: str, now: float) -> str:
        token = word(arguments)
        self._on_trigger(now)
        return f"{token},{self._clock_us(now)}"

    def _temperature(self, _: str, now: float) -> str:
        return f"{self._load.camera_c(now) + float(self._rng.normal(0.0, THERMOMETER_C)):.2f}"
