"""Emulate the contact probe's controller: source, shutter, fiber cover, suction, camera (sans-I/O).

Its manual is its command table (`ProbeUnit.commands`) and these rules. Light and suction require an
armed controller and include their own end. The shutter pulses the camera's line when its blades
have cleared the fiber, and answers then. No light leaves a head that suction does not hold, because
an eye may be in front of it: with the LED on, the shutter opens only once the gauge has measured
the requested suction, and closes when the pump goes off. Before the pump starts, the operator
declares the head's site with ``HEAD:SITE``: after each change of site, and after each time that the
controller has released the head by itself. Everything that makes other controllers dark (``SAFE``,
``ABOR``, ``*RST``, a silent host, the emergency stop, the loss of power) closes the shutter,
switches off the LED, vents, and clears the site, because a released head may have moved. ``PUMP
VENT`` and the pump's own end keep the site: the skin rests and takes suction again. A suction that
ends by a fault clears the site, too.

The controller has no model of the skin: it acts on a `SuctionLoad` and reads a gauge.
"""

import re
from collections.abc import Mapping
from typing import Any

from capture.devices.wire import Code
from rigsim.boxes.command import (
    Command,
    CommandHandler,
    CommandRefused,
    PendingReply,
    build_command_table,
    parse_decimal,
    parse_token,
)
from rigsim.boxes.contact_probe.source_shutter import (
    COVER_MOVE_S,
    LEVEL_STEPS,
    MIN_OPENING_MS,
    SourceLight,
    SourceShutter,
)
from rigsim.boxes.contact_probe.suction_pump import (
    MAX_PUMPING_S,
    MIN_SUCTION_MBAR,
    MIN_SUCTION_MS,
    PUMP_CONTROL_PERIOD_S,
    Gauge,
    SuctionPump,
)
from rigsim.boxes.device import Device, Wiring

__all__ = ["ProbeUnit", "SourceLight"]

THERMOMETER_STD_C = 0.03
"""Standard deviation of one reading of the camera's thermometer, kelvin."""
_WHOLE_PATTERN = re.compile(r"[0-9]{1,4}")


class ProbeUnit(Device):
    """State of the probe's device behind its controller.

    Parameters
    ----------
    wiring
        Its probe, the LED at the source fiber, the head; each interval of light is a `SourceLight`.
    """

    kind = "probe"
    model = "PROBE1"

    def __init__(self, wiring: Wiring) -> None:
        super().__init__(wiring)
        rig, load = wiring.rig, wiring.head
        if rig.probe is None or load is None:
            raise ValueError(f"probe: got none in rig {rig.name!r}, expected its description")
        self._probe = rig.probe
        self._load = load
        self.shutter = SourceShutter(self, wiring)
        gauge = Gauge(rng=wiring.rng, dead_after_s=self.faults.gauge_dead_after)
        self.pump = SuctionPump(self, rig.probe, load, gauge, self.shutter)

    # settings ---------------------------------------------------------------------------------

    def reset(self, now: float, *, power_up: bool) -> None:
        """Restore the power-up settings: dark, vented, no site, no fiber covered."""
        super().reset(now, power_up=power_up)
        self.shutter.forget(power_up=power_up, now=now)
        if power_up:
            self.pump.last_report = ""

    def capabilities(self) -> Mapping[str, Any]:
        """Return limits and counts; the names include the units."""
        probe = self._probe
        return {
            "fibres": len(probe.fibers),  # the wire protocol spells its key so
            "level_steps": LEVEL_STEPS,
            "shutter_min_ms": MIN_OPENING_MS,
            "shutter_max_ms": round(probe.max_open_s * 1e3, 6),
            "shutter_lag_ms": MIN_OPENING_MS,
            "cover_ms": COVER_MOVE_S * 1e3,
            "suction_min_mbar": MIN_SUCTION_MBAR,
            "suction_max_mbar": probe.max_suction_mbar,
            "suction_min_ms": MIN_SUCTION_MS,
            "suction_max_ms": round(probe.max_suction_s * 1e3, 6),
            "reach_ms": MAX_PUMPING_S * 1e3,
            "rest_ms": round(probe.rest_s * 1e3, 6),
            "control_period_ms": PUMP_CONTROL_PERIOD_S * 1e3,
            "camera_c": probe.camera_c,
            "source_w": self.rig.lights[0].power_w,
            "dose_ws": self.shutter.dose_limit_ws,
        }

    def commands(self) -> dict[str, Command]:
        """Return the command table, which is the controller's manual."""
        acts: dict[str, CommandHandler] = {
            "HEAD:SITE": self._place,
            "HEAD:SITE?": self._get_place,
            "HEAD:FREE": self._remove_head,
            "PUMP": self._pump,
            "PUMP?": lambda _, now: self.pump.state(now),
            "PUMP:LAST?": lambda *_: self.pump.last_report or "NONE",
            "PRES?": lambda _, now: f"{self.pump.read(now):.1f}",
            "LED": self._set_level,
            "LED?": lambda *_: str(self.shutter.level),
            "SHUT": self._shut,
            "SHUT?": self._get_shutter,
            "SHUT:LAST?": lambda *_: self.shutter.last_report or "NONE",
            "SHUT:COUN?": lambda *_: str(self.shutter.count),
            "FIB": self._cover,
            "FIB?": lambda *_: "ALL" if self.shutter.fiber is None else str(self.shutter.fiber),
            "CAM:TRIG": self._trigger_camera,
            "CAM:TEMP?": lambda _, now: (
                f"{self._load.camera_c(now) + float(self._rng.normal(0.0, THERMOMETER_STD_C)):.2f}"
            ),
            "DOSE?": lambda *_: f"{self.shutter.dose_ws:.6f}",
            "DOSE:NEW": self._new_subject,
        }
        return build_command_table("probe", acts)

    # time -------------------------------------------------------------------------------------

    def deadline(self) -> float:
        """Return the time of the next change of its own, in s."""
        return min(self._stop_changes_at_s(), self.shutter.deadline(), self.pump.deadline())

    def advance(self, now: float) -> None:
        """Advance time to `now`, in s."""
        while (due := self.deadline()) <= now:
            self._follow_stop(due)
            self.shutter.advance(due)
            self.pump.advance(due)

    def go_dark(self, now: float) -> None:
        """Close the shutter, switch off the LED, vent, and clear the head's site."""
        self._release_head(now, "DARK")

    def _make_dark_at_stop(self, now: float) -> None:
        self._release_head(now, "INTERLOCK")

    def light_now(self, now: float) -> list[SourceLight]:
        """Return the light that has not ended, as emitted so far."""
        return self.shutter.light_now(now)

    @property
    def lit(self) -> bool:
        """Whether the source emits light."""
        return self.shutter.lit

    def is_busy(self, now: float) -> bool:
        """Return whether the shutter is open or the cover moves."""
        return self.shutter.is_moving(now)

    def states(self, now: float) -> dict[int, bool]:
        """Return bits 16 busy, 32 suction, 64 lit, 512 placed, 1024 resting, 2048 jammed."""
        pump, shutter = self.pump, self.shutter
        lit = {16: self.is_busy(now), 32: pump.is_pumping, 64: shutter.lit, 2048: shutter.jammed}
        return lit | {512: pump.placement is not None, 1024: pump.remaining_rest_ms(now) > 0}

    def _release_head(self, now: float, how: str) -> None:
        self.shutter.go_dark(now, how)
        self.pump.vent(now, how)
        self.pump.remove_head(now)

    # head and pump ----------------------------------------------------------------------------

    def _place(self, arguments: str, now: float) -> None:
        label, _, angle = arguments.partition(",")
        site = parse_token(label)
        angle_mdeg = parse_decimal(angle, 0.0, 360.0, "degrees, less than 360", digits=3)
        angle_deg = angle_mdeg / 1e3
        CommandRefused.raise_if(
            angle_deg == 360.0, Code.OUT_OF_RANGE, "expected 0 to less than 360 degrees"
        )
        self.shutter.require_closed(now)
        self.pump.place(site, angle_deg, now)

    def _get_place(self, _: str, now: float) -> str:
        if self.pump.placement is None:
            return "NONE"
        site, angle_deg = self.pump.placement
        return f"{site},{angle_deg:g}"

    def _remove_head(self, _: str, now: float) -> None:
        self.shutter.abort_opening(now, "ASKED")
        self.pump.vent(now, "ASKED")
        self.pump.remove_head(now)

    def _pump(self, arguments: str, now: float) -> str:
        if arguments.upper() == "VENT":
            self.pump.vent(now, "ASKED")
            return ""
        on, _, rest = arguments.partition(",")
        length, comma, suction = rest.partition(",")
        if on.upper() != "ON" or not comma:
            raise CommandRefused(Code.SYNTAX, "expected ON,<ms>,<mbar> or VENT")
        longest_ms = self._probe.max_suction_s * 1e3
        span_us = parse_decimal(length, MIN_SUCTION_MS, longest_ms, "ms", digits=3)
        most_mbar = self._probe.max_suction_mbar
        ubar = parse_decimal(suction, MIN_SUCTION_MBAR, most_mbar, "mbar", digits=3)
        self._require_closed_stop()
        return self.pump.draw(span_us, ubar / 1e3, now)

    # light ------------------------------------------------------------------------------------

    def _set_level(self, arguments: str, now: float) -> None:
        if _WHOLE_PATTERN.fullmatch(arguments) is None:
            raise CommandRefused(Code.SYNTAX, "expected a whole number of thousandths")
        level = int(arguments)
        if level > LEVEL_STEPS:
            raise CommandRefused(Code.OUT_OF_RANGE, f"expected 0 to {LEVEL_STEPS} thousandths")
        if level > 0:
            self._require_closed_stop()
        self.shutter.set_level(level, now)

    def _shut(self, arguments: str, now: float) -> str | PendingReply:
        if arguments.upper() == "CLOSE":
            self.shutter.close(now)
            return ""
        what, _, length = arguments.partition(",")
        CommandRefused.raise_if(what.upper() != "OPEN", Code.SYNTAX, "expected OPEN,<ms> or CLOSE")
        longest_ms = self._probe.max_open_s * 1e3
        span_us = parse_decimal(length, MIN_OPENING_MS, longest_ms, "ms", digits=3)
        self._require_closed_stop()
        if self.shutter.level > 0 and not self.pump.has_reached_target:
            raise CommandRefused(Code.IGNORED, "the head is not held; PUMP ON, and wait")
        at_s, outcome = self.shutter.open(span_us, now)
        return PendingReply(at_s, outcome)

    def _get_shutter(self, _: str, now: float) -> str:
        if self.shutter.jammed:
            return "JAM"
        return f"OPEN,{self.shutter.remaining_ms(now)}" if self.shutter.is_open else "CLOSED"

    def _cover(self, arguments: str, now: float) -> None:
        if arguments.upper() == "ALL":
            self.shutter.cover(None, now)
            return
        if _WHOLE_PATTERN.fullmatch(arguments) is None:
            raise CommandRefused(Code.SYNTAX, "expected the number of a fiber, or ALL")
        if int(arguments) >= self.shutter.fibers:
            raise CommandRefused(
                Code.OUT_OF_RANGE, f"expected 0 to {self.shutter.fibers - 1} or ALL"
            )
        self.shutter.cover(int(arguments), now)

    def _new_subject(self, arguments: str, now: float) -> None:
        parse_token(arguments)
        self.shutter.dose_ws = 0.0
