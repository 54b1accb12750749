"""Series of exposures of one placement of the probe's head: held, watched, ended when it is enough.

All frames of a series are of one placement; they are committed when the last is there. When the
head is lost in between, it is placed anew and the series begins again. Exposures run from short to
long, and those that can show no more are left out, with the reason. No short one ever is: whether
one saturates nowhere is known only when it is there, and it costs a read-out.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence

import numpy as np

from capture import raw
from capture.acquire.frames import encode
from capture.acquire.outcome import MAX_ATTEMPTS, Operator, attempts_so_far, given_up, steps_to_do
from capture.acquire.probe.driver import ProbeDriver
from capture.acquire.probe.fiber_signal import FiberSignal, describe_fibers, why_enough
from capture.acquire.probe.head import Head, HeadLost, NotHeld
from capture.acquire.probe.mask_choice import masks_not_needed
from capture.acquire.probe.source_exposure import Exposed, ShutterFault, expose, expose_dark
from capture.devices.camera import Camera, CameraError, Frame, FrameRefused, FrameTimeout
from capture.plan import Step, Value
from capture.plan.probe import all_series
from capture.plan.suction import Placement
from capture.rig import Probe, Rig
from capture.session import Session

log = logging.getLogger(__name__)


class BracketSeries:
    """The series of one run.

    Parameters
    ----------
    rig, box, cameras, session, operator
        As of the run.
    all_brackets
        Whether exposures are taken that can show no more.

    Attributes
    ----------
    steps, frames, stale, retakes : int
        What was done so far, see `capture.acquire.outcome.Acquired`.
    """

    def __init__(
        self,
        rig: Rig,
        box: ProbeDriver,
        cameras: Mapping[str, Camera],
        session: Session,
        operator: Operator,
        *,
        all_brackets: bool,
    ) -> None:
        self._rig = rig
        self._probe: Probe = rig.probe  # type: ignore[assignment]
        self._box = box
        self._cameras = cameras
        self._session = session
        self._operator = operator
        self._all_brackets = all_brackets
        self._attempts = attempts_so_far(session)
        self._head = Head(self._probe, box, operator, placements=_placements_so_far(session))
        self._tokens = 0
        self.steps = self.frames = self.stale = self.retakes = 0

    # darks ------------------------------------------------------------------------------------

    def darks(self) -> None:
        """Take the frames without light that are missing, with the head capped."""
        missing = [step for step in steps_to_do(self._session) if step.kind == "dark"]
        if missing:
            self._head.cap()
            self._box.cover(None)
        for number, step in enumerate(missing, start=1):
            self._operator.stop_if_asked()
            seconds = float(step.settings["exposure_s"])
            self._operator.progress(f"dark {number}/{len(missing)} {step.id} {seconds:.3g} s")
            self._commit(self._dark(step), {})

    def _dark(self, step: Step) -> tuple[Exposed, dict[str, Value], int]:
        why = ""
        for attempt in range(1, MAX_ATTEMPTS + 1):
            before_c = self._head.temperature_c()
            self._head.keep_capped()
            self._tokens += 1
            token = f"{self._operator.run_id}.{self._tokens}"
            try:
                exposed = expose_dark(step, self._rig, self._box, self._cameras, token=token)
            except (FrameRefused, FrameTimeout) as error:
                why = self._not_taken(step, attempt, error)
                continue
            self.stale += exposed.stale
            if not self._box.status().placed:
                why = self._not_taken(step, attempt, ShutterFault("the box has let go of the cap"))
                continue
            after_c = self._head.temperature_c()
            return exposed, {"light": "none", "camera_c": 0.5 * (before_c + after_c)}, attempt
        raise given_up(f"step {step.id}", why, self._session)

    # series -----------------------------------------------------------------------------------

    def run(self) -> None:
        """Take the series that are missing, in the plan's order, with the head placed as needed."""
        for placement, steps in all_series(self._session.plan):
            if steps[0].kind == "mask" and not self._all_brackets:
                self._leave_out(*masks_not_needed(self._session))
            if self._is_missing(steps):
                self._series(placement, steps)

    def _is_missing(self, steps: Sequence[Step]) -> bool:
        """Tell whether a series lacks frames, or has some of several placements."""
        left_out = self._session.left_out()
        ids = {step.id for step in steps if step.id not in left_out}
        found = [record for record in self._session.frames() if record.step_id in ids]
        placements = {record.actual.get("placement") for record in found}
        return bool(ids) and ({record.step_id for record in found} != ids or len(placements) != 1)

    def _series(self, placement: Placement, steps: Sequence[Step]) -> None:
        left_out = self._session.left_out()
        wanted = [step for step in steps if step.id not in left_out]
        for attempt in range(1, MAX_ATTEMPTS + 1):
            try:
                taken, reason = self._once(placement, wanted)
            except HeadLost as lost:
                log.warning("%s, placement %d: %s", placement, attempt, lost)
                why = str(lost)
                self._head.lost(why)
                self.retakes += 1
                continue
            for one in taken:
                self._commit(one, {"placement": self._head.placements})
            self._leave_out(wanted[len(taken) :], reason)
            return
        raise self._head.refusal(placement, why, captured=bool(self._session.frames()))

    def _once(
        self, placement: Placement, wanted: Sequence[Step]
    ) -> tuple[list[tuple[Exposed, dict[str, Value], int]], str]:
        """Take a series of one placement; return it, and why the rest of it is not needed."""
        signal = FiberSignal(self._probe, self._rig.view(wanted[0].cameras[0]))
        taken: list[tuple[Exposed, dict[str, Value], int]] = []
        self._head.at(placement)
        fibre = wanted[0].settings.get("fibre")
        self._box.cover(None if fibre is None else int(fibre))
        for number, step in enumerate(wanted):
            self._operator.stop_if_asked()
            taken.append(self._exposure(placement, step))
            exposed, actual, _ = taken[-1]
            self._operator.progress(
                f"{placement}: {number + 1}/{len(wanted)} {step.id} "
                f"{float(step.settings['exposure_s']):.3g} s, "
                f"{float(actual['suction_mbar']):.1f} mbar"
            )
            left = wanted[number + 1 :]
            if fibre is not None:
                continue
            first = exposed.frames[step.cameras[0]]
            signal.look(_pixels(first, step), float(step.settings["exposure_s"]))
            if not left:
                self._tell_what_is_missing(placement, signal)
            elif not self._all_brackets and (reason := why_enough(signal, step, left)):
                return taken, f"{placement}: {reason}"
        return taken, ""

    def _exposure(self, placement: Placement, step: Step) -> tuple[Exposed, dict[str, Value], int]:
        """Take one exposure with the head held before and after, or take it again."""
        why = ""
        needs_s = float(step.settings["exposure_s"])
        needs_s += max(self._rig.view(name).readout_s for name in step.cameras)
        level = float(step.settings["level"])
        held = True
        for attempt in range(1, MAX_ATTEMPTS + 1):
            try:
                self._head.hold(level, needs_s)
                before_mbar, before_c = self._head.readings()
                exposed = expose(step, self._rig, self._box, self._cameras)
                after_mbar, after_c = self._head.readings()
            except NotHeld as error:
                why, held = str(error), False
                self._drop_frames(step)
                log.warning("step %s, attempt %d: %s", step.id, attempt, error)
                self.retakes += 1
                continue
            except HeadLost:
                self._drop_frames(step)
                raise
            except (FrameRefused, FrameTimeout) as error:
                why, held = self._not_taken(step, attempt, error), True
                continue
            self.stale += exposed.stale
            actual: dict[str, Value] = {
                "light": "source",
                "level": level,
                "open_s": exposed.open_s,
                "run": self._operator.run_id,
                "suction_mbar": 0.5 * (before_mbar + after_mbar),
                "suction_before_mbar": before_mbar,
                "suction_after_mbar": after_mbar,
                "camera_c": 0.5 * (before_c + after_c),
            }
            if "fibre" in step.settings:
                actual["fibre"] = step.settings["fibre"]
            return exposed, actual, attempt
        if held:
            raise given_up(f"step {step.id}", why, self._session)
        raise self._head.refusal(placement, why, captured=bool(self._session.frames()))

    def _not_taken(self, step: Step, attempt: int, error: CameraError) -> str:
        log.warning("step %s, attempt %d: %s", step.id, attempt, error)
        self.retakes += 1
        self._drop_frames(step)
        return str(error)

    def _drop_frames(self, step: Step) -> None:
        for name in step.cameras:
            self._cameras[name].abort()

    # what is not needed -----------------------------------------------------------------------

    def _tell_what_is_missing(self, placement: Placement, signal: FiberSignal) -> None:
        """Say of a whole series which fibres it does not show."""
        verdict = signal.verdict([])
        for pairs, what in (
            (verdict.hopeless, "stays in the noise"),
            (verdict.saturated, "is saturated in every exposure: less level shows it"),
        ):
            if pairs:
                self._operator.progress(
                    f"{placement}: {describe_fibers(pairs, signal.probe)} {what}"
                )

    def _leave_out(self, steps: Sequence[Step], reason: str) -> None:
        if not steps:
            return
        self._operator.progress(reason)
        log.info(reason)
        self._session.leave_out(
            [step.id for step in steps], reason=reason, t_host_s=self._operator.clock()
        )

    # commit -----------------------------------------------------------------------------------

    def _commit(
        self, one: tuple[Exposed, dict[str, Value], int], more: Mapping[str, Value]
    ) -> None:
        exposed, actual, tries = one
        step = exposed.step
        for name, frame in exposed.frames.items():
            view, camera = self._rig.view(name), self._cameras[name]
            light: dict[str, str | float] = {
                "light": str(actual["light"]),
                "level": float(step.settings["level"]),
            }
            attempt = self._attempts.get((step.id, name), 0) + 1
            self._session.commit(
                step.id,
                name,
                encode(frame, view, camera, step, self._session, light),
                settings=dict(step.settings),
                actual={
                    "exposure_s": frame.exposure.exposure_s,
                    "iso": frame.exposure.iso,
                    "serial": frame.serial,
                    "tries": tries,
                    **actual,
                    **more,
                },
                t_box_s=exposed.t_box_s,
                t_host_s=self._operator.clock(),
                attempt=attempt,
            )
            self._attempts[step.id, name] = attempt
            self.frames += 1
        self.steps += 1


def _pixels(frame: Frame, step: Step) -> np.ndarray:
    """Return the sensor values of a frame, also of one that is a maker's raw file."""
    if isinstance(frame.image, bytes):
        return np.asarray(raw.decode(memoryview(frame.image), where=f"step {step.id}").cfa)
    return frame.image


def _placements_so_far(session: Session) -> int:
    """Return how often the head was placed in earlier runs, as far as anything came of it."""
    return max((int(r.actual.get("placement", 0)) for r in session.frames()), default=0)
