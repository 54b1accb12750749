"""Driver of the contact probe: one method per command, physical units, no policy.

A person puts the head on the skin. Light and suction need an armed controller and end on their own,
at the latest after ``shutter_max_ms`` and ``suction_max_ms``; then the skin rests. An armed
controller that receives nothing during its lease closes the shutter, switches the LED off, vents
and disarms: renew the lease (`ProbeBox.listen`, or any query) while a camera exposes.
`ProbeBox.dark` and closing the driver do the same. Any venting except `ProbeBox.vent` and the
pump's own end clears the placement: a person has to check the head, then `ProbeBox.place` has to be
called again.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, Final, Literal, get_args

from capture.devices.box import Box, BoxStatus, StatusBit, format_decimal

ShutterEnd = Literal["open", "timed", "asked", "pump", "jam", "interlock", "dark"]
SuctionEnd = Literal["timed", "asked", "low", "lost", "high", "gauge", "interlock", "dark"]
_SHUTTER_ENDS_BY_WORD: dict[str, ShutterEnd] = {word.upper(): word for word in get_args(ShutterEnd)}
_SUCTION_ENDS_BY_WORD: dict[str, SuctionEnd] = {word.upper(): word for word in get_args(SuctionEnd)}
_VALVE_POLL_S = 0.1
"""Interval between two renewals of the lease, s; shorter than the shortest lease."""
_VALVE_MARGIN_S = 2.0
"""Largest time that a movement may take beyond its nominal duration, s."""


@dataclass(frozen=True, slots=True)
class ShutterOpening:
    """One opening of the source's shutter, on the controller's clock."""

    number: int
    """Number of openings since manufacture, failed ones and this one included."""
    t_open_s: float
    """Time when the blades had cleared the fiber and the camera line was pulsed, s since power-up.
    """
    ended: ShutterEnd
    """open: not ended yet. timed: by its own end. asked: by `ProbeBox.close_shutter`, or the head
    was taken off. pump: the suction ended. jam: the blades did not close, and the LED was switched
    off. interlock, dark: the controller has shut everything down.
    """
    t_shut_s: float
    """Time when its light ended, s since power-up; inf when not yet."""


@dataclass(frozen=True, slots=True)
class SuctionReport:
    """Outcome of a period of suction."""

    number: int
    """Number of suction periods since manufacture, this one included."""
    ended: SuctionEnd
    """timed: by its own end. asked: by `ProbeBox.vent`. low: not reached in time, so a leak or a
    pump that does not turn. lost: it dropped at once, the head has come off. high: the regulator
    does not hold it. gauge: the gauge has failed. interlock, dark: the controller has shut
    everything down. Only the first two keep the placement of the head.
    """
    suction_mbar: float
    """Last reading of the gauge before its end, mbar."""
    t_box_s: float
    """When it ended, s since power-up."""


@dataclass(frozen=True, slots=True)
class SuctionState:
    """State of the pump."""

    on: bool
    """Whether the pump is on."""
    wanted_mbar: float
    """Requested suction, mbar; 0 when the pump is off."""
    left_s: float
    """Time until the suction ends, s; when the pump is off, until the skin's rest ends."""


class ProbeStatus(BoxStatus):
    """Bits of ``STAT?``; the source of light is the source fiber."""

    __slots__ = ()

    busy = StatusBit(4)
    """Whether the shutter is open or opens, or the cover moves."""
    sucking = StatusBit(5)
    """Whether the pump is on."""
    placed = StatusBit(9)
    """Whether a person has confirmed the placement of the head, and it is still valid."""
    resting = StatusBit(10)
    """Whether the skin still has to rest."""
    jammed = StatusBit(11)
    """Whether the shutter is stuck open."""


class ProbeBox(Box):
    """Driver of the contact probe's controller; see `capture.devices.box.Box`.

    Keys of ``limits``: ``fibers``, ``level_steps``, ``shutter_min_ms``, ``shutter_max_ms``,
    ``shutter_lag_ms`` (command to open blades), ``cover_ms``, ``suction_min_mbar``,
    ``suction_max_mbar``, ``suction_min_ms``, ``suction_max_ms``, ``reach_ms`` (time in which the
    suction must be reached), ``rest_ms``, ``control_period_ms``, ``camera_c``, ``source_w``,
    ``dose_ws``.

    One measurement::

        operator.prompt(...)              # a person puts the head on
        box.arm(); box.place("cheek", 0.0)
        box.set_level(1.0); box.suck(60.0, 50.0)
        box.listen(1.0); box.pressure_mbar()
        camera.arm(1, Trigger.EDGE)
        box.open_shutter(0.5); box.listen(0.5)
        box.vent()
    """

    kind: ClassVar[str] = "probe"

    def status(self) -> ProbeStatus:
        """Return the status bits."""
        return ProbeStatus(int(self._number("STAT?")))

    # head and suction -------------------------------------------------------------------------

    def place(self, site: str, angle_deg: float) -> None:
        """Report site and rotation (0 to 360 degrees about its axis) of the placed head.

        Raises
        ------
        CommandRefused
            Unless armed (-203, 108); while the pump is on or the shutter open (-213).
        """
        self._port.ask(f"HEAD:SITE {site},{format_decimal('angle_deg', angle_deg, 6)}")

    def placement(self) -> tuple[str, float] | None:
        """Return site and angle in degrees of the placement; None when it is not valid."""
        return self._read_or_none("HEAD:SITE?", _placement, "a number")

    def take_away(self) -> None:
        """Report that the head is taken off: the controller vents it and clears the placement."""
        self._port.ask("HEAD:FREE")

    def suck(self, mbar: float, seconds: float) -> int:
        """Switch the pump on for `seconds` from now; return the number of this suction period.

        The command returns at once; poll `pressure_mbar` until the suction is reached. A repeated
        request never starts it twice.

        Raises
        ------
        CommandRefused
            Nothing was switched on: not armed (-203), lease expired (108), head not placed or pump
            on (-213), the skin rests (103), beyond the limits (-222), gauge failed (-240),
            emergency stop open (107).
        """
        span_ms = format_decimal("seconds", seconds * 1e3, 6)
        text = f"PUMP ON,{span_ms},{format_decimal('mbar', mbar, 6)}"
        return self._count(text, "the number of the suction", shown="PUMP ON")

    def vent(self) -> None:
        """Switch the pump off and open the vent; the placement stays valid, and the skin rests."""
        self._port.ask("PUMP VENT")

    def suction(self) -> SuctionState:
        """Return the state of the pump."""
        return self._read("PUMP?", _suction_state, "ON,mbar,ms or REST,ms or VENT")

    def last_suction(self) -> SuctionReport | None:
        """Return the outcome of the last suction, None when there was none since power-up."""
        return self._read_or_none("PUMP:LAST?", _suction_report, "number,END,mbar,us")

    def pressure_mbar(self) -> float:
        """Return the suction under the head, mbar below ambient pressure; has noise."""
        return self._number("PRES?")

    # light ------------------------------------------------------------------------------------

    def set_level(self, level: float) -> None:
        """Drive the LED behind the closed shutter at 0 to 1 of full, in steps of 1/1000.

        Raises
        ------
        CommandRefused
            Not armed (-203, 108), shutter open (-213), LED or shutter failed (-240), emergency stop
            open (107). 0 is never refused.
        """
        steps = int(self.limits["level_steps"])
        if not 0.0 <= level <= 1.0:
            raise ValueError(f"level: got {level}, expected 0 to 1")
        self._port.ask(f"LED {round(level * steps)}")

    def level(self) -> float:
        """Return the drive level of the LED, 0 to 1 of full."""
        return self._number("LED?") / float(self.limits["level_steps"])

    def open_shutter(self, seconds: float) -> ShutterOpening:
        """Open the shutter for `seconds`; the camera line is pulsed when the blades are clear.

        With the LED on it opens only while the head is held, because an eye might be in front of
        the fiber. The call returns when the shutter is open. A repeated request never opens it
        twice.

        Raises
        ------
        CommandRefused
            Nothing opened: not armed (-203), lease expired (108), already open, cover moving, or
            LED on and head not held (-213), beyond the limits (-222), blades stuck or made dark
            meanwhile (-240), dose limit reached (104), emergency stop open (107).
        """
        span_ms = format_decimal("seconds", seconds * 1e3, 6)
        return self._read(
            f"SHUT OPEN,{span_ms}", _parse_suction_number, "number,us", shown="SHUT OPEN"
        )

    def close_shutter(self) -> None:
        """Close the shutter early; when it is stuck open, try to close it again."""
        self._port.ask("SHUT CLOSE")

    def last_opening(self) -> ShutterOpening | None:
        """Return the last opening and its end, None when there was none since power-up."""
        return self._read_or_none("SHUT:LAST?", _opening, "number,END,us,us")

    def count_openings(self) -> int:
        """Return the number of openings since manufacture, failed ones included."""
        return int(self._number("SHUT:COUN?"))

    def cover(self, fiber: int | None) -> None:
        """Cover all detection fibers except number `fiber`, from 0, and wait; None: uncover all.

        Raises
        ------
        CommandRefused
            While the shutter is open (-213), or without such a fiber (-222).
        PortTimeout
            When the cover does not arrive.
        """
        self._port.ask(f"FIB {'ALL' if fiber is None else fiber}")
        self._wait(float(self.limits["cover_ms"]) / 1e3 + _VALVE_MARGIN_S)

    def uncovered_fiber(self) -> int | None:
        """Return the number of the only uncovered fiber; None when none is covered."""
        return self._read("FIB?", lambda got: None if got == "ALL" else int(float(got)), "a number")

    def dose_ws(self) -> float:
        """Return the light energy emitted into this subject, Ws."""
        return self._number("DOSE?")

    def new_subject(self, pseudonym: str) -> None:
        """Restart the dose counter for a new subject."""
        self._port.ask(f"DOSE:NEW {pseudonym}")

    # camera -----------------------------------------------------------------------------------

    def camera_c(self) -> float:
        """Return the temperature of the camera, degrees Celsius; has noise."""
        return self._number("CAM:TEMP?")

    def trigger_camera(self, token: str) -> float:
        """Pulse the camera line without light; return the controller's time, s."""
        return self._token_time("CAM:TRIG", token, shown=f"CAM:TRIG {token}")

    # time -------------------------------------------------------------------------------------

    def listen(self, seconds: float, *, every_s: float = _VALVE_POLL_S) -> None:
        """Wait for `seconds` while the controller holds its state: the lease is renewed.

        Parameters
        ----------
        seconds
            Duration, s.
        every_s
            Interval between two renewals, s; shorter than the lease.
        """
        self._keep_lease(seconds, every_s)

    def _wait(self, timeout_s: float) -> None:
        fault = f"the probe still moves after {timeout_s:.1f} s; check it"
        self._wait_settled(timeout_s, _VALVE_POLL_S, self._port.listen, fault)


def _placement(payload: str) -> tuple[str, float]:
    site, _, angle = payload.partition(",")
    return site, float(angle)


def _suction_state(payload: str) -> SuctionState:
    match payload.split(","):
        case ["ON", mbar, left_ms]:
            return SuctionState(True, float(mbar), int(left_ms) / 1e3)
        case ["REST", left_ms]:
            return SuctionState(False, 0.0, int(left_ms) / 1e3)
        case ["VENT"]:
            return SuctionState(False, 0.0, 0.0)
    raise ValueError(payload)


def _suction_report(payload: str) -> SuctionReport:
    number, ended, mbar, t_us = payload.split(",")
    return SuctionReport(int(number), _SUCTION_ENDS_BY_WORD[ended], float(mbar), int(t_us) / 1e6)


def _parse_suction_number(payload: str) -> ShutterOpening:
    number, t_us = payload.split(",")
    return ShutterOpening(int(number), int(t_us) / 1e6, "open", math.inf)


def _opening(payload: str) -> ShutterOpening:
    number, ended, open_us, shut_us = payload.split(",")
    shut_s = math.inf if shut_us == "-" else int(shut_us) / 1e6
    return ShutterOpening(int(number), int(open_us) / 1e6, _SHUTTER_ENDS_BY_WORD[ended], shut_s)


DRIVER: Final = ProbeBox
