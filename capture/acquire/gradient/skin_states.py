"""Scan strain steps of skin in a caliper, as far as the skin can be moved.

Per angle a person tapes the jaws to the skin once; neutral is scanned, then the jaws compress step
by step until the skin buckles, go back, and stretch until it comes off. Steps that cannot be
reached are omitted from the session with the reason. All frames of a step are of one scan of one
taping. When the skin is released in between, it is taped again, an image of the new neutral is
taken, the jaws repeat their way, and the whole step is scanned again.
"""

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import Literal, cast

from capture.acquire.outcome import MAX_ATTEMPTS, AcquisitionError, CaptureRun
from capture.acquire.pattern_scan import PatternScanner, StepFrames
from capture.devices.caliper import CaliperBox, MoveReport
from capture.devices.port import CommandRefused, DeviceError
from capture.devices.wire import Code
from capture.plan import Plan, Step, Value
from capture.plan.gradient import state_name, strain_state
from capture.plan.rows import split_passes
from capture.rig import Caliper
from capture.session import Session

EndKind = Literal["buckled", "detached", "force"]

BUCKLING_FORCE_RATIO = 0.7
"""Fraction of its previous growth below which a growth of the push means buckling."""
PLATEAU_FORCE_RATIO = 0.05
"""Fraction of growth below which the previous step had already reached the plateau."""

_END_DESCRIPTIONS: dict[EndKind, str] = {
    "buckled": "the skin buckled: its push no longer grew",
    "detached": "the skin came off the tape",
    "force": "the force limit was reached",
}


@dataclass(frozen=True, slots=True)
class BranchEnd:
    """End of a way from neutral."""

    kind: EndKind
    position: int
    """First position that cannot be reached."""
    reading_mm: float
    """Distance of the jaws at the end, mm."""
    force_n: float
    """Force at the end, N."""


class StrainLimitReached(Exception):
    """Raised when the skin cannot be moved further in this direction.

    Attributes
    ----------
    end : End
    """

    def __init__(self, end: BranchEnd) -> None:
        super().__init__(
            f"{_END_DESCRIPTIONS[end.kind]} at {end.reading_mm:.2f} mm ({end.force_n:+.3f} N)"
        )
        self.end = end


class ForceMonitor:
    """Monitor of the force, step by step in one direction from neutral.

    Parameters
    ----------
    caliper
        Caliper, for the readings.
    direction
        -1 compresses, +1 stretches.
    at_rest_n
        Force at neutral, N.

    Notes
    -----
    Compressed skin pushes the jaws apart, approximately in proportion, until it buckles out of its
    plane; from then on its push stays constant. A position whose push has grown by less than
    `BUCKLING_FORCE_RATIO` of the mean growth per step is beyond the onset. When the push has not
    grown at all, the position before was beyond the onset, too, by less than could be detected
    there: it is omitted as well.
    """

    def __init__(self, caliper: Caliper, direction: int, *, at_rest_n: float) -> None:
        self._caliper = caliper
        self._direction = direction
        self._pushes = [-at_rest_n]

    def check(self, position: int, report: MoveReport, force_n: float) -> None:
        """Check the force at a position that was reached.

        Raises
        ------
        EndOfSkin
            When this position is beyond the limit of the skin.
        """
        if report.ended == "detached":
            raise StrainLimitReached(
                BranchEnd("detached", position, report.reading_mm, report.force_n)
            )
        if report.ended == "force":
            raise StrainLimitReached(
                BranchEnd("force", position, report.reading_mm, report.force_n)
            )
        if self._direction > 0:
            return
        pushes = self._pushes
        pushes.append(-force_n)
        if len(pushes) < 3:
            return
        growth = pushes[-1] - pushes[-2]
        before = (pushes[-2] - pushes[0]) / (len(pushes) - 2)
        if growth >= BUCKLING_FORCE_RATIO * before:
            return
        # of two steps the first may already be on the plateau
        early = growth < PLATEAU_FORCE_RATIO * before and len(pushes) > 3
        first = position + 1 if early else position
        raise StrainLimitReached(BranchEnd("buckled", first, report.reading_mm, force_n))


log = logging.getLogger(__name__)

CALIPER_LEASE_S = 5.0
"""Silence after which the skin is released, s: cameras' frames may keep the host busy."""
N_FORCE_READINGS = 8


class _SkinReleased(Exception):
    """Raised when the skin was released before its limit; it can be taped again."""


@dataclass(frozen=True, slots=True)
class _StrainState:
    """A strain step that is to be scanned."""

    angle_deg: float
    position: int
    steps: tuple[Step, ...]

    @property
    def name(self) -> str:
        return state_name(self.angle_deg, self.position)


class SkinStates:
    """Strain steps of one run: attachment, limits found, and steps still missing."""

    def __init__(
        self, run: CaptureRun, caliper: CaliperBox, scanner: PatternScanner, force_limit_n: float
    ) -> None:
        self._run, self._session, self._operator = run, run.session, run.operator
        self._caliper, self._scanner = caliper, scanner
        self._drawn = cast(Caliper, run.rig.caliper)
        self._force_limit_n = force_limit_n
        self._states = list(_group_states(run.session.plan))
        self._attachment = _count_attachments(run.session)
        self._position = 0
        self._reading_mm = self._force_n = 0.0

    def scan(self) -> None:
        """Scan the missing steps, angle by angle, in the plan's order."""
        for angle_deg in dict.fromkeys(state.angle_deg for state in self._states):
            self._complete_angle(angle_deg)

    def _find_missing_states(self, angle_deg: float) -> list[_StrainState]:
        """Return the steps of an angle that are missing, or not from one taping."""
        left_out = self._session.omitted_steps()
        frames: dict[str, set[object]] = {}
        for record in self._session.frames("gradient"):
            frames.setdefault(record.step_id, set()).add(record.actual.get("attachment"))
        undone = {step.id for step in self._run.pending_steps()}
        found = []
        for state in self._states:
            ids = [step.id for step in state.steps]
            if state.angle_deg != angle_deg or any(step in left_out for step in ids):
                continue
            tapings = set().union(*(frames.get(step, set()) for step in ids))
            if undone & set(ids) or len(tapings) != 1:
                found.append(state)
        return found

    def _complete_angle(self, angle_deg: float) -> None:
        """Scan the steps of an angle; have the skin taped again when it was released."""
        before, tries = len(self._find_missing_states(angle_deg)), 0
        why = ""
        while missing := self._find_missing_states(angle_deg):
            tries = tries + 1 if len(missing) == before else 1
            before = len(missing)
            if tries > MAX_ATTEMPTS:
                raise self._run.retry_limit_error(f"state {missing[0].name}", why)
            try:
                self._attach(angle_deg)
                self._scan_angle(angle_deg)
            except _SkinReleased as stop:
                why = str(stop)
                log.warning("%s; the skin is taped again", why)
            finally:
                release_skin(self._caliper)

    def _attach(self, angle_deg: float) -> None:
        """Move empty jaws to step 0 at an angle and have a person tape them to the skin."""
        caliper = self._caliper
        self._operator.stop_if_asked()
        caliper.dark()
        caliper.set_lease(CALIPER_LEASE_S)
        caliper.arm()
        caliper.set_force_limit(self._force_limit_n)
        report = caliper.move_to(0) if caliper.status().homed else caliper.home()
        if report.ended == "stall":
            report = caliper.home()
        if report.ended != "reached":
            raise AcquisitionError(
                f"caliper: homing ended as {report.ended!r} at {report.reading_mm:.2f} mm; "
                "nothing is held: check the home mark and the motor, then use --resume [SR-CAP-018]"
            )
        caliper.set_angle(angle_deg)
        caliper.dark()  # a person's hands are at the jaws now
        self._operator.prompt(f"tape the skin at {angle_deg:g} degrees")
        caliper.arm()
        caliper.attach()
        self._attachment += 1
        log.info("attachment %d, at %g degrees", self._attachment, angle_deg)

    def _scan_angle(self, angle_deg: float) -> None:
        """Scan what is missing: neutral, then compression, then stretching."""
        self._position = 0
        self._settle(self._drawn.reading_mm(0))
        for state in self._states:
            if (state.angle_deg, state.position) != (angle_deg, 0):
                continue
            if state in self._find_missing_states(angle_deg):
                self._scan_state(state, "reached")
            else:
                self._photograph_neutral(state)
        for direction in (-1, 1):
            self._scan_branch(angle_deg, direction)

    def _scan_branch(self, angle_deg: float, direction: int) -> None:
        """Move from neutral through the missing steps, up to the limit of the skin."""
        wanted = {
            state.position: state
            for state in self._find_missing_states(angle_deg)
            if state.position * direction > 0
        }
        if not wanted:
            return
        if self._position != 0:
            self._move(0)
        watch = ForceMonitor(self._drawn, direction, at_rest_n=self._force_n)
        farthest = max(wanted, key=abs)
        for position in range(direction, farthest + direction, direction):
            self._operator.stop_if_asked()
            try:
                report = self._move(position)
                watch.check(position, report, self._force_n)
                if position in wanted:
                    self._scan_state(wanted[position], report.ended)
            except StrainLimitReached as end:
                self._omit_states(angle_deg, direction, end)
                break
        if not self._caliper.is_attached() and self._find_missing_states(angle_deg):
            raise _SkinReleased("the skin came off")

    def _move(self, position: int) -> MoveReport:
        """Move and let the skin creep; raise `_SkinReleased` after any other release."""
        try:
            self._scanner.rotate_analyzer(self._states[0].steps[0])  # during the move
            report = self._caliper.move_to(position)
        except CommandRefused as error:
            if error.code not in (Code.WATCHDOG_TRIPPED, Code.NOT_ARMED):
                raise
            raise _SkinReleased(str(error)) from error
        if report.ended in ("stopped", "stall", "no_home"):
            raise _SkinReleased(f"position {position}: the move ended as {report.ended!r}")
        self._position = report.step
        if report.ended == "reached":
            self._settle(report.reading_mm)
        return report

    def _settle(self, reading_mm: float) -> None:
        self._scanner.pause(self._drawn.settle_s)
        readings = [self._caliper.force_n() for _ in range(N_FORCE_READINGS)]
        self._reading_mm, self._force_n = reading_mm, sum(readings) / len(readings)

    def _scan_state(self, state: _StrainState, ended: str) -> None:
        """Scan a step and commit it when the skin was held to the end."""
        self._operator.progress(
            f"{state.name}: {self._reading_mm:.2f} mm, {self._force_n:+.3f} N, {ended}"
        )
        taken: list[StepFrames] = []
        for piece in split_passes(state.steps):
            taken += self._scanner.scan(piece)
        self._check_held(state.position)
        self._scanner.commit(taken, self._actual(ended))

    def _check_held(self, position: int) -> None:
        """Raise an error when the skin was released during the scan."""
        if self._caliper.is_attached():
            return
        status = self._caliper.status()
        if position == 0 or status.tripped or status.stopped or not status.armed:
            raise _SkinReleased(
                f"position {position}: the caliper released the skin during the scan"
            )
        raise StrainLimitReached(BranchEnd("detached", position, self._reading_mm, self._force_n))

    def _actual(self, ended: str) -> dict[str, Value]:
        return {
            "aperture_mm": self._reading_mm,
            "force_n": self._force_n,
            "ended": ended,
            "attachment": self._attachment,
        }

    def _photograph_neutral(self, neutral: _StrainState) -> None:
        """Attach one image of newly taped neutral skin, with which tapings can be compared."""
        step = next((s for s in neutral.steps if s.settings["pattern"] == "full"), neutral.steps[0])
        (one,) = self._scanner.scan([step])
        self._check_held(0)
        number = "" if len(one.frames) == 1 else "{}-"
        for name in one.frames:
            file = f"neutral-a{round(neutral.angle_deg):03d}-{number.format(name)}"
            self._session.attach(
                f"{file}{self._attachment}.dng",
                self._scanner.encode_frame(one, name),
                about={
                    "kind": "neutral skin, taped again",
                    "state": neutral.name,
                    "step": step.id,
                    "camera": name,
                    **self._actual("reached"),
                },
            )

    def _omit_states(self, angle_deg: float, direction: int, end: StrainLimitReached) -> None:
        """Record in the session that the skin cannot be moved further."""
        left_out = self._session.omitted_steps()
        first = direction * end.end.position
        ids = [
            step.id
            for state in self._states
            if state.angle_deg == angle_deg and direction * state.position >= first
            for step in state.steps
            if step.id not in left_out
        ]
        reason = f"{angle_deg:g} degrees, from position {end.end.position} on: {end}"
        log.info(reason)
        self._operator.progress(reason)
        if ids:
            about: dict[str, Value] = {
                "angle": angle_deg,
                "caliper": end.end.position,
                "end": end.end.kind,
                "aperture_mm": end.end.reading_mm,
                "force_n": end.end.force_n,
                "attachment": self._attachment,
            }
            self._run.omit_steps(ids, reason, about)


def _group_states(plan: Plan) -> Iterator[_StrainState]:
    for name, group in groupby(plan.steps, key=strain_state):
        if name is not None:
            steps = tuple(group)
            index = steps[0].index
            yield _StrainState(float(index["angle"]), int(index["caliper"]), steps)


def _count_attachments(session: Session) -> int:
    """Return the number of earlier tapings that left frames in the session."""
    lines = [session.attachment_line(name).about for name in session.attachments()]
    lines += [record.actual for record in session.frames("gradient")]
    lines += [session.omission_line(step).about for step in session.omitted_steps()]
    return max((int(line.get("attachment", 0)) for line in lines), default=0)


def release_skin(caliper: CaliperBox) -> None:
    """Release the skin and disarm; errors of the release are logged, not raised."""
    try:
        caliper.dark()
    except DeviceError as error:
        log.error("the caliper did not confirm the release: %s; its lease releases the skin", error)
