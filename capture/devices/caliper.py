"""Driver of the stretching caliper: one method per command, physical units, no policy.

A person tapes the jaws to the skin. Nothing moves unless the controller is armed, homed and has a
force limit, which has no default. An armed controller that receives nothing during its
lease releases the skin. Renew the lease (`CaliperBox.listen`, or any query) while another
controller lights and cameras expose. `CaliperBox.dark`, `release` and closing the driver release
the skin, too.

The caliper measures the distance of its jaws. The skin between them stretches by less, because the
tape yields.
"""

from dataclasses import dataclass
from typing import ClassVar, Final, Literal, get_args

from capture.devices.box import Box, BoxStatus, StatusBit, format_decimal

MoveEnd = Literal["reached", "force", "stall", "detached", "no_home", "stopped"]
_MOVE_ENDS_BY_WORD: dict[str, MoveEnd] = {
    word.replace("_", "").upper(): word for word in get_args(MoveEnd)
}
_TRAVEL_POLL_S = 0.1
"""Interval between two renewals of the lease, s; shorter than the shortest lease."""
_TRAVEL_MARGIN_S = 2.0
"""Largest time that a move may take beyond its nominal duration, s."""


@dataclass(frozen=True, slots=True)
class MoveReport:
    """Outcome of a move."""

    number: int
    """Number of moves since manufacture, this one included."""
    ended: MoveEnd
    """reached: the jaws are at the target step. force: the limit was exceeded; the jaws have gone
    back to where the move began. stall: the motor has lost steps; home again. detached: the force
    dropped to zero at once; the jaws have stopped there. no_home: the home mark was not found.
    stopped: a release interrupted the move.
    """
    step: int
    """Step nearest to the present position of the jaws."""
    reading_mm: float
    """Distance of the jaws by the step counter when the move ended, mm; for ``force``: when the
    limit was exceeded.
    """
    force_n: float
    """Force between the jaws then, N; > 0 when the skin pulls them together, < 0 when it pushes
    them apart. A force that no longer grows from step to step indicates buckled skin.
    """
    t_box_s: float
    """Time of the end on the controller's clock, s since power-up."""


class CaliperStatus(BoxStatus):
    """Bits of ``STAT?``."""

    __slots__ = ()

    moving = StatusBit(4)
    """Whether a motor moves."""
    homed = StatusBit(5)
    """Whether the position of the jaws is known."""
    attached = StatusBit(9)
    """Whether skin is attached, as far as the controller can detect."""
    force_tripped = StatusBit(10)
    """Whether the last move exceeded the force limit."""


class CaliperBox(Box):
    """Driver of the caliper's controller; see `capture.devices.box.Box`.

    Keys of ``limits``: ``step_min``, ``step_max``, ``step_mm``, ``aperture_mm`` (at step 0),
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
        """Set the largest force between the jaws, N, pulling or pushing; a reset clears it.

        Raises
        ------
        CommandRefused
            Outside the range of the sensor (-222), or below the present force (106).
        """
        self._port.ask(f"CAL:FORC:LIM {format_decimal('newton', newton, 4)}")

    def force_limit_n(self) -> float | None:
        """Return the force limit, N; None when none is set, and then nothing moves."""
        return self._read_or_none("CAL:FORC:LIM?", float, "a number")

    def force_n(self) -> float:
        """Return the force between the jaws, N (> 0 pulls them together), and renew the lease."""
        return self._number("CAL:FORC?")

    def reading_mm(self) -> float | None:
        """Return the distance of the jaws by the step counter, mm; None before homing."""
        return self._read_or_none("CAL:POS?", float, "a number")

    # moves ------------------------------------------------------------------------------------

    def home(self) -> MoveReport:
        """Find the home mark and move to step 0; refused while skin is attached."""
        return self._finish("CAL:HOME")

    def set_angle(self, angle_deg: float) -> None:
        """Turn the jaws to one of ``limits["angles_deg"]`` and wait; refused with skin attached."""
        self._port.ask(f"CAL:ANG {format_decimal('angle_deg', angle_deg, 4)}")
        self._wait(360.0 / float(self.limits["turn_deg_per_s"]) + _TRAVEL_MARGIN_S)

    def angle_deg(self) -> float:
        """Return the present or target angle of the jaws, degrees."""
        return self._number("CAL:ANG?")

    def attach(self) -> None:
        """Report that a person has taped the jaws to the skin: the controller tares and holds it.

        Raises
        ------
        CommandRefused
            Unless the controller is armed, homed, at rest, and at step 0.
        """
        self._port.ask("CAL:ATT")

    def is_attached(self) -> bool:
        """Return whether skin is attached, as far as the force sensor can detect."""
        return self._flag("CAL:ATT?")

    def move_to(self, step: int) -> MoveReport:
        """Move the jaws to a step (n x ``step_mm`` from step 0) and wait for the end of the move.

        The lease is renewed meanwhile. A repeated request never moves the jaws twice.

        Raises
        ------
        CommandRefused
            Nothing moved: not armed (-203), lease expired (108), no force limit or not homed
            (-213), beyond the travel (-222), force sensor failed (-240), emergency stop open (107),
            or the last force trip was on the way to this step (106).
        PortTimeout
            When the controller does not report the end.
        """
        return self._finish(f"CAL:STEP:ABS {step}")

    def last_move(self) -> MoveReport | None:
        """Return the outcome of the last move, None when there was none since power-up."""
        return self._read_or_none("CAL:LAST?", _parse_report, "number,END,step,mm,N,us")

    def release(self) -> None:
        """Release the skin at once; a person has to tape the jaws again."""
        self._port.ask("CAL:REL")

    def listen(self, seconds: float) -> None:
        """Wait for `seconds` while the controller holds its state: the lease is renewed."""
        self._keep_lease(seconds, _TRAVEL_POLL_S)

    def _finish(self, text: str) -> MoveReport:
        """Start a move and wait for its end."""
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
