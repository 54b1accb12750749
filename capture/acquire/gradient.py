"""Run a plan on the gradient sphere: skin in a caliper, state of strain by state, or a target.

Per angle a person tapes the jaws to the skin once; neutral is scanned, then the jaws go step by
step to where the skin buckles, back, and to where it comes off. What cannot be reached is left out
of the session with the reason. All frames of a state are of one scan of one taping: when the skin
is let go in between, for whatever reason, it is taped again, the newly taped neutral is pictured
once, the jaws walk the same way, and the state is scanned anew.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby
from typing import Any, Protocol, cast

from capture.acquire.dome import check_safety
from capture.acquire.outcome import (
    MAX_ATTEMPTS,
    Acquired,
    AcquisitionError,
    Operator,
    given_up,
    steps_to_do,
    tear_down,
)
from capture.acquire.pattern_scan import Scanner, Sphere, Taken, reading_deg
from capture.acquire.skin_end import End, EndOfSkin, ForceWatch
from capture.devices.caliper import CaliperStatus, MoveReport
from capture.devices.camera import Camera, CameraError, Trigger
from capture.devices.gradient_sphere import Eyes
from capture.devices.port import CommandRefused, DeviceError
from capture.devices.wire import Code
from capture.plan import Plan, Step, Value
from capture.plan.gradient import state_name, state_of
from capture.plan.rows import passes
from capture.rig import Caliper, Rig
from capture.session import Session

log = logging.getLogger(__name__)

SPHERE_LEASE_S = 2.0
CALIPER_LEASE_S = 5.0
"""A camera's frames may keep the host busy for a while; after this silence the skin is let go."""
FORCE_READINGS = 8


class CaliperDriver(Protocol):
    """The part of the caliper's driver that a capture needs."""

    @property
    def limits(self) -> Mapping[str, Any]:
        """What the box allows, in its own words and units."""

    def arm(self) -> None:
        """Allow moves."""

    def dark(self) -> None:
        """Let the skin go and disarm."""

    def ping(self) -> float:
        """Return the box's clock, s; renews the lease."""

    def set_lease(self, lease_s: float) -> None:
        """Set after how much silence the box lets the skin go."""

    def set_force_limit(self, newton: float) -> None:
        """Set the greatest force between the jaws, N."""

    def status(self) -> CaliperStatus:
        """Return the status bits."""

    def home(self) -> MoveReport:
        """Find the home mark and stand at step 0."""

    def set_angle(self, angle_deg: float) -> None:
        """Turn the jaws."""

    def attach(self) -> None:
        """Pass on that a person has taped the jaws to the skin."""

    def attached(self) -> bool:
        """Tell whether the box holds skin."""

    def move_to(self, step: int) -> MoveReport:
        """Move the jaws to a step."""

    def force_n(self) -> float:
        """Return the force between the jaws, N."""

    def release(self) -> None:
        """Let the skin go."""


class _LetGo(Exception):
    """The skin was let go though nothing ended; it can be taped again."""


def run_gradient(
    plan: Plan,
    rig: Rig,
    *,
    boxes: Mapping[str, Any],
    cameras: Mapping[str, Camera],
    session: Session,
    operator: Operator,
    eyes: Eyes = "open",
    force_limit_n: float | None = None,
) -> Acquired:
    """Capture what the session still lacks of a plan of the gradient sphere; see `run_plan`.

    Everything that can be refused is, before anything is lit or moves.
    """
    skin = any(state_of(step) is not None for step in plan.steps)
    sphere = cast(Sphere, boxes["gradient_sphere"])
    caliper = cast(CaliperDriver | None, boxes.get("caliper")) if skin else None
    _check_eyes(plan, rig, eyes, skin=skin)
    _check_sphere(plan, rig, sphere.limits)
    _check_cameras(cameras)
    if skin:
        if caliper is None:
            raise AcquisitionError("box 'caliper': no port was given; add --port caliper=URL")
        _check_caliper(plan, rig, caliper.limits)
        _check_force(force_limit_n, caliper.limits)
    keep_alive = caliper.ping if caliper is not None else _nothing
    scanner = Scanner(rig, sphere, cameras, session, operator, keep_alive=keep_alive)
    try:
        sphere.dark()  # whatever was going on before
        sphere.set_lease(SPHERE_LEASE_S)
        sphere.set_cameras((1 << len(rig.views)) - 1)
        if not session.frames():
            sphere.new_subject(session.id[:32])
        sphere.set_eyes(eyes)
        flat = [step for step in steps_to_do(session) if state_of(step) is None]
        for piece in passes(flat):
            operator.stop_if_asked()
            scanner.commit(scanner.scan(piece), {})
        if caliper is not None and force_limit_n is not None:
            _Skin(rig, caliper, scanner, session, operator, force_limit_n).run()
    finally:
        if caliper is not None:
            _let_go(caliper)
        tear_down(sphere, cameras)
    dead = tuple(rig.lights[led].name for led in sorted(sphere.failed_leds))
    return Acquired(scanner.steps, scanner.frames, scanner.stale, scanner.retakes, dead)


# before anything is lit or moves ----------------------------------------------------------------


def _check_eyes(plan: Plan, rig: Rig, eyes: Eyes, *, skin: bool) -> None:
    """Raise where light would be too much; patterns on skin may come close to an eye."""
    check_safety(plan, rig, eyes=eyes)
    if skin and eyes == "open":
        raise AcquisitionError(
            "eyes: patterns change many times a second, and the patch may lie beside an eye; "
            "nothing was lit: have the eyes closed or shielded and say so with --eyes"
        )


def _check_sphere(plan: Plan, rig: Rig, limits: Mapping[str, Any]) -> None:
    for name, what, count in (
        ("leds", "lights", len(rig.lights)),
        ("cameras", "cameras", len(rig.views)),
    ):
        if int(limits.get(name, 0)) != count:
            raise AcquisitionError(
                f"{what}: the sphere's box has {limits.get(name)}, the rig {count}; nothing was "
                "lit: use the rig file of this box"
            )
    settle_s = float(limits["settle_us"]) / 1e6
    low_s, high_s = float(limits["row_min_us"]) / 1e6, float(limits["row_max_us"]) / 1e6
    for step in plan.steps:
        dwell_s, exposure_s = float(step.settings["dwell_s"]), float(step.settings["exposure_s"])
        if not low_s <= dwell_s <= high_s:
            raise AcquisitionError(
                f"step {step.id}: got dwell_s {dwell_s:g}, the box allows {low_s:g} to "
                f"{high_s:g}; nothing was lit: change the plan"
            )
        views = [rig.view(name) for name in step.cameras]
        over_s = max(view.shutter_lag_s + view.readout_s for view in views) + exposure_s
        if settle_s + exposure_s > dwell_s or over_s > dwell_s:
            raise AcquisitionError(
                f"step {step.id}: exposure_s {exposure_s:g} and the read-out do not fit into "
                f"dwell_s {dwell_s:g}; nothing was lit: change the plan"
            )
        angle_deg = reading_deg(step)
        low_deg, high_deg = float(limits["analyser_min_deg"]), float(limits["analyser_max_deg"])
        if not low_deg <= angle_deg <= high_deg:
            raise AcquisitionError(
                f"step {step.id}: got analyser_deg {angle_deg:g}, the box turns from {low_deg:g} "
                f"to {high_deg:g}; nothing was lit: change the plan"
            )
    longest = max(len(piece) for piece in passes(plan.steps))
    if longest > int(limits["max_rows"]):
        raise AcquisitionError(
            f"plan: a scan has {longest} patterns, the box holds {limits['max_rows']}; nothing "
            "was lit: change the plan"
        )


def _check_caliper(plan: Plan, rig: Rig, limits: Mapping[str, Any]) -> None:
    drawn = rig.caliper
    if drawn is None:
        raise AcquisitionError("caliper: the rig file has none; use that of this rig")
    for name, expected in (("aperture_mm", drawn.aperture_mm), ("step_mm", drawn.step_mm)):
        if abs(float(limits.get(name, 0.0)) - expected) > 1e-6:
            raise AcquisitionError(
                f"caliper: its box says {name} {limits.get(name)}, the rig file {expected:g}; "
                "nothing has moved: use the rig file of this box"
            )
    known = [float(angle) for angle in limits["angles_deg"]]
    low, high = int(limits["step_min"]), int(limits["step_max"])
    for step in plan.steps:
        if state_of(step) is None:
            continue
        angle, position = float(step.index["angle"]), int(step.index["caliper"])
        if angle not in known or not low <= position <= high:
            raise AcquisitionError(
                f"step {step.id}: got position {position} at {angle:g} degrees, the caliper has "
                f"{low} to {high} at {', '.join(f'{a:g}' for a in known)}; nothing has moved: "
                "change the plan, or use the rig file of this box"
            )


def _check_force(limit_n: float | None, limits: Mapping[str, Any]) -> None:
    low, high = float(limits["force_limit_min_n"]), float(limits["force_limit_max_n"])
    if limit_n is None:
        raise AcquisitionError(
            "force limit: none was given, and there is no default: decide what this skin may "
            f"bear and say it with --force-limit N ({low:g} to {high:g} newton); nothing has moved"
        )
    if not low <= limit_n <= high:
        raise AcquisitionError(
            f"force limit: got {limit_n:g} N, the caliper's sensor tells {low:g} to {high:g} N; "
            "nothing has moved"
        )


def _check_cameras(cameras: Mapping[str, Camera]) -> None:
    for name, camera in cameras.items():
        if Trigger.EDGE not in camera.info.triggers:
            raise CameraError(
                f"view {name!r}: the camera {camera.info.serial} cannot be released by the "
                "sphere's trigger line, and no other way keeps pace with its patterns"
            )


# skin in the caliper ----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class _State:
    """A state of the skin that is to be scanned."""

    angle_deg: float
    position: int
    steps: tuple[Step, ...]

    @property
    def name(self) -> str:
        return state_name(self.angle_deg, self.position)


class _Skin:
    """The states of one run: what is held, how far it went, what is left."""

    def __init__(
        self,
        rig: Rig,
        caliper: CaliperDriver,
        scanner: Scanner,
        session: Session,
        operator: Operator,
        force_limit_n: float,
    ) -> None:
        self._drawn = cast(Caliper, rig.caliper)
        self._caliper = caliper
        self._scanner = scanner
        self._session = session
        self._operator = operator
        self._force_limit_n = force_limit_n
        self._states = list(_states(session.plan))
        self._attachment = _attachments_so_far(session)
        self._position = 0
        self._reading_mm = self._force_n = 0.0

    def run(self) -> None:
        """Scan what is missing, angle by angle, in the plan's order."""
        for angle_deg in dict.fromkeys(state.angle_deg for state in self._states):
            self._angle(angle_deg)

    def _missing(self, angle_deg: float) -> list[_State]:
        """Return the states of an angle that are not there, or not from one taping."""
        left_out = self._session.left_out()
        frames: dict[str, set[object]] = {}
        for record in self._session.frames("gradient"):
            frames.setdefault(record.step_id, set()).add(record.actual.get("attachment"))
        undone = {step.id for step in steps_to_do(self._session)}
        found = []
        for state in self._states:
            ids = [step.id for step in state.steps]
            if state.angle_deg != angle_deg or any(step in left_out for step in ids):
                continue
            tapings = set().union(*(frames.get(step, set()) for step in ids))
            if undone & set(ids) or len(tapings) != 1:
                found.append(state)
        return found

    def _angle(self, angle_deg: float) -> None:
        """Scan an angle's states; tape the skin again where it was let go."""
        before, tries = len(self._missing(angle_deg)), 0
        why = ""
        while missing := self._missing(angle_deg):
            tries = tries + 1 if len(missing) == before else 1
            before = len(missing)
            if tries > MAX_ATTEMPTS:
                raise given_up(f"state {missing[0].name}", why, self._session)
            try:
                self._attach(angle_deg)
                self._scan_angle(angle_deg)
            except _LetGo as stop:
                why = str(stop)
                log.warning("%s; the skin is taped again", why)
            finally:
                _let_go(self._caliper)

    def _attach(self, angle_deg: float) -> None:
        """Bring empty jaws to step 0 at an angle and have a person tape them to the skin."""
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
                "nothing is held: check the home mark and the motor, then use --resume"
            )
        caliper.set_angle(angle_deg)
        caliper.dark()  # a person's hands are at the jaws now
        self._operator.prompt(f"tape the skin at {angle_deg:g} degrees")
        caliper.arm()
        caliper.attach()
        self._attachment += 1
        log.info("attachment %d, at %g degrees", self._attachment, angle_deg)

    def _scan_angle(self, angle_deg: float) -> None:
        """Scan neutral, then compression, then stretching, of what is missing."""
        self._position = 0
        self._settle(self._drawn.reading_mm(0))
        for state in self._states:
            if (state.angle_deg, state.position) != (angle_deg, 0):
                continue
            if state in self._missing(angle_deg):
                self._take(state, "reached")
            else:
                self._picture_neutral(state)
        for direction in (-1, 1):
            self._branch(angle_deg, direction)

    def _branch(self, angle_deg: float, direction: int) -> None:
        """Walk from neutral as far as states are missing, or as the skin lets itself be moved."""
        wanted = {
            state.position: state
            for state in self._missing(angle_deg)
            if state.position * direction > 0
        }
        if not wanted:
            return
        if self._position != 0:
            self._move(0)
        watch = ForceWatch(self._drawn, direction, at_rest_n=self._force_n)
        farthest = max(wanted, key=abs)
        for position in range(direction, farthest + direction, direction):
            self._operator.stop_if_asked()
            try:
                report = self._move(position)
                watch.check(position, report, self._force_n)
                if position in wanted:
                    self._take(wanted[position], report.ended)
            except EndOfSkin as end:
                self._leave_out(angle_deg, direction, end)
                break
        if not self._caliper.attached() and self._missing(angle_deg):
            raise _LetGo("the skin came off")

    def _move(self, position: int) -> MoveReport:
        """Move, and let the skin creep; raise `_LetGo` where it was let go for another reason."""
        try:
            self._scanner.turn_to(self._states[0].steps[0])  # while the jaws are on their way
            report = self._caliper.move_to(position)
        except CommandRefused as error:
            if error.code not in (Code.WATCHDOG_TRIPPED, Code.NOT_ARMED):
                raise
            raise _LetGo(str(error)) from error
        if report.ended in ("stopped", "stall", "no_home"):
            raise _LetGo(f"position {position}: the move ended as {report.ended!r}")
        self._position = report.step
        if report.ended == "reached":
            self._settle(report.reading_mm)
        return report

    def _settle(self, reading_mm: float) -> None:
        self._scanner.pause(self._drawn.settle_s)
        readings = [self._caliper.force_n() for _ in range(FORCE_READINGS)]
        self._reading_mm, self._force_n = reading_mm, sum(readings) / len(readings)

    def _take(self, state: _State, ended: str) -> None:
        """Scan a state and commit it when it was held to the end."""
        self._operator.progress(
            f"{state.name}: {self._reading_mm:.2f} mm, {self._force_n:+.3f} N, {ended}"
        )
        taken: list[Taken] = []
        for piece in passes(state.steps):
            taken += self._scanner.scan(piece)
        self._still_held(state.position)
        self._scanner.commit(taken, self._actual(ended))

    def _still_held(self, position: int) -> None:
        """Raise where the skin was lost while it was scanned."""
        if self._caliper.attached():
            return
        status = self._caliper.status()
        if position == 0 or status.tripped or status.stopped or not status.armed:
            raise _LetGo(f"position {position}: the caliper let the skin go while it was scanned")
        raise EndOfSkin(End("detached", position, self._reading_mm, self._force_n))

    def _actual(self, ended: str) -> dict[str, Value]:
        return {
            "aperture_mm": self._reading_mm,
            "force_n": self._force_n,
            "ended": ended,
            "attachment": self._attachment,
        }

    def _picture_neutral(self, neutral: _State) -> None:
        """Attach one picture of newly taped neutral skin, by which tapings can be compared."""
        step = next((s for s in neutral.steps if s.settings["pattern"] == "full"), neutral.steps[0])
        (one,) = self._scanner.scan([step])
        self._still_held(0)
        number = "" if len(one.frames) == 1 else "{}-"
        for name in one.frames:
            file = f"neutral-a{round(neutral.angle_deg):03d}-{number.format(name)}"
            self._session.attach(
                f"{file}{self._attachment}.dng",
                self._scanner.encoded(one, name),
                about={
                    "kind": "neutral skin, taped again", "state": neutral.name,
                    "step": step.id, "camera": name, **self._actual("reached"),
                },
            )  # fmt: skip

    def _leave_out(self, angle_deg: float, direction: int, end: EndOfSkin) -> None:
        """Note in the session that this way goes no further."""
        left_out = self._session.left_out()
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
                "angle": angle_deg, "caliper": end.end.position, "end": end.end.kind,
                "aperture_mm": end.end.reading_mm, "force_n": end.end.force_n,
                "attachment": self._attachment,
            }  # fmt: skip
            self._session.leave_out(
                ids, reason=reason, about=about, t_host_s=self._operator.clock()
            )


def _states(plan: Plan) -> Iterator[_State]:
    for name, group in groupby(plan.steps, key=state_of):
        if name is not None:
            steps = tuple(group)
            index = steps[0].index
            yield _State(float(index["angle"]), int(index["caliper"]), steps)


def _attachments_so_far(session: Session) -> int:
    """Return how often the skin was taped before, as far as anything came of it."""
    lines = [session.attachment_line(name).about for name in session.attachments()]
    lines += [record.actual for record in session.frames("gradient")]
    lines += [session.left_out_line(step).about for step in session.left_out()]
    return max((int(line.get("attachment", 0)) for line in lines), default=0)


def _let_go(caliper: CaliperDriver) -> None:
    """Release the skin and disarm; nothing here hides the error that led here."""
    try:
        caliper.dark()
    except DeviceError as error:
        log.error("the caliper could not be told to let go: %s; its lease does", error)


def _nothing() -> None:
    """Do nothing."""
