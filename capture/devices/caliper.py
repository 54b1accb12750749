"""The stretching caliper's box: one method a command, units in and out, no policy.

Its jaws are taped to the skin by a person. Nothing moves unless the box is armed, homed, and has
been told a force limit, for which there is no default. An armed box that hears nothing for its
lease lets the skin go: renew the lease (`CaliperBox.listen`, or any question) while another box
lights and cameras look. `CaliperBox.dark`, `release` and the closing of the driver let go, too.

What the caliper reads is the distance of its jaws; the skin between them has stretched by less,
because the tape gives way.
"""

from dataclasses import dataclass
from typing import ClassVar, Final, Literal, get_args

from capture.devices.box import Box, BoxStatus, StatusBit, format_decimal

MoveEnd = Literal["reached", "force", "stall", "detached", "no_home", "stopped"]
_MOVE_ENDS_BY_WORD: dict[str, MoveEnd] = {
    word.replace("_", "").upper(): word for word in get_args(MoveEnd)
}
_TRAVEL_POLL_S = 0.1
"""Silence between two renewals of the lease; shorter than the shortest lease."""
_TRAVEL_MARGIN_S = 2.0
"""Longer than this over its own time no move may take."""


@dataclass(frozen=True, slots=True)
class MoveReport:
    """How a move ended."""

    number: int
    """Moves since the box was made, this one included."""
    ended: MoveEnd
    """reached: the jaws stand where they were sent. force: the limit was met; the jaws have gone
    back to where they stood before. stall: the motor has lost steps; home again. detached: the
    force fell to nothing at once; the jaws stand where that was. no_home: the home mark was not
    found. stopped: the move was cut short by a release, whatever its reason."""
    step: int
    """Step that the jaws stand at or nearest to, now."""
    reading_mm: float
    """Distance of the jaws by the box's own count when the move ended, mm; of a force trip: when
    the limit was met."""
    force_n: float
    """Force between the jaws then, N; > 0 when the skin pulls them together, < 0 when it pushes
    them apart. One that grows no more from step to step tells of skin that has buckled."""
    t_box_s: float
    """Time of the end on the box's clock, s since its power-up."""


class CaliperStatus(BoxStatus):
    """The bits of ``STAT?``."""

    __slots__ = ()

    moving = StatusBit(4)
    """Whether something moves."""
    homed = StatusBit(5)
    """Whether the box knows where its jaws are."""
    attached = StatusBit(9)
    """Whether the box holds skin, as far as it knows."""
    force_tripped = StatusBit(10)
    """Whether the last move met the force limit."""


class CaliperBox(Box):
    """Driver of the caliper's box; see `capture.devices.box.Box`.

    Its limits (``limits``): ``step_min``, ``step_max``, ``step_mm``, ``aperture_mm`` (at step 0),
    ``angles_deg``, ``speed_mm_per_s``, ``turn_deg_per_s``, ``force_limit_min_n``,
    ``force_limit_max_n``, ``control_period_ms``.

    One angle of a capture::

        box.arm(); box.set_force_limit(newton); box.home(); box.set_angle(45.0)
        operator.prompt(...)          # a person tapes the jaws to the skin; the lease may run out
        box.arm(); box.attach()
        box.move_to(-1)               # ... and listen() or force_n() while others work
        box.release()
    """

    kind: ClassVar[str] = "caliper"

    def status(self) -> CaliperStatus:
        """Return the status bits."""
        return CaliperStatus(int(self._number("STAT?")))

    # settings ---------------------------------------------------------------------------------

    def set_force_limit(self, newton: float) -> None:
        """Set the greatest force between the jaws, N, pulling or pushing; a reset forgets it.

        Raises
        ------
        CommandRefused
            Out of the range of the sensor (-222), or below the force that there is now (106).
        """
        self._port.ask(f"CAL:FORC:LIM {format_decimal('newton', newton, 4)}")

    def force_limit_n(self) -> float | None:
        """Return the force limit, N; None: nobody has set one, and nothing will move."""
        return self._read_or_none("CAL:FORC:LIM?", float, "a number")

    def force_n(self) -> float:
        """Return the force between the jaws, N; > 0 pulls them together. Renews the lease."""
        return self._number("CAL:FORC?")

    def reading_mm(self) -> float | None:
        """Return the distance of the jaws by the box's count, mm; None: it is not homed."""
        return self._read_or_none("CAL:POS?", float, "a number")

    # moves ------------------------------------------------------------------------------------

    def home(self) -> MoveReport:
        """Find the home mark and stand at step 0; refused while skin is held."""
        return self._finish("CAL:HOME")

    def set_angle(self, angle_deg: float) -> None:
        """Turn the jaws to one of ``limits["angles_deg"]`` and wait; refused while skin is held."""
        self._port.ask(f"CAL:ANG {format_decimal('angle_deg', angle_deg, 4)}")
        self._wait(360.0 / float(self.limits["turn_deg_per_s"]) + _TRAVEL_MARGIN_S)

    def angle_deg(self) -> float:
        """Return the angle that the jaws have or turn to, degrees."""
        return self._number("CAL:ANG?")

    def attach(self) -> None:
        """Pass on that a person has taped the jaws to the skin: the box tares and holds it.

        Raises
        ------
        CommandRefused
            Unless the box is armed, homed, at rest, and at step 0.
        """
        self._port.ask("CAL:ATT")

    def is_attached(self) -> bool:
        """Tell whether the box holds skin, as far as its force sensor can tell."""
        return self._flag("CAL:ATT?")

    def move_to(self, step: int) -> MoveReport:
        """Move the jaws to a step (n x ``step_mm`` from step 0) and wait until they stand.

        The lease is renewed meanwhile. A retry on the line never moves twice.

        Raises
        ------
        CommandRefused
            Nothing moved: not armed (-203), 108 after the lease ran out, no force limit or not
            homed (-213), beyond the travel (-222), the force sensor dead (-240), the emergency
            stop open (107), or the last trip of the force was on the way there (106).
        PortTimeout
            When the box does not report the end.
        """
        return self._finish(f"CAL:STEP:ABS {step}")

    def last_move(self) -> MoveReport | None:
        """Return how the last move ended, None when there was none since power-up."""
        return self._read_or_none("CAL:LAST?", _parse_report, "number,END,step,mm,N,us")

    def release(self) -> None:
        """Let the skin go, at once; a person has to tape the jaws again."""
        self._port.ask("CAL:REL")

    def listen(self, seconds: float) -> None:
        """Let `seconds` pass while the box holds what it holds: the lease is renewed."""
        self._keep_lease(seconds, _TRAVEL_POLL_S)

    def _finish(self, text: str) -> MoveReport:
        """Begin a move and wait for its end."""
        number = self._count(text, "the number of the move", shown="CAL:STEP:ABS")
        limits = self.limits
        travel_mm = (limits["step_max"] - limits["step_min"] + 2) * float(limits["step_mm"])
        self._wait(4.0 * travel_mm / float(limits["speed_mm_per_s"]) + _TRAVEL_MARGIN_S)
        report = self.last_move()
        if report is None or report.number != number:
            raise self._bad_answer("CAL:LAST?", str(report), f"the end of move {number}")
        return report

    def _wait(self, timeout_s: float) -> None:
        fault = f"the caliper still moves after {timeout_s:.1f} s; stop it"
        self._wait_settled(timeout_s, _TRAVEL_POLL_S, self._port.listen, fault)


def _parse_report(payload: str) -> MoveReport:
    number, ended, step, mm, newton, t_us = payload.split(",")
    end, t_s = _MOVE_ENDS_BY_WORD[ended], int(t_us) / 1e6
    return MoveReport(int(number), end, int(step), float(mm), float(newton), t_s)


DRIVER: Final = CaliperBox
