"""Take a series of exposures of one placement of the probe's head, up to the last useful one.

All frames of a series are of one placement; they are committed when the last one has come. When the
head is lost in between, a person places it again and the series starts over. Exposures run from
short to long. Long ones that cannot add information are omitted, with the reason; short ones never
are, because only the frame itself shows whether it saturates, and it costs one readout.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from capture import raw
from capture.acquire.outcome import MAX_ATTEMPTS, CaptureRun
from capture.acquire.probe.fiber_signal import (
    FiberSignal,
    describe_fibers,
    find_unneeded_masks,
    stop_reason,
)
from capture.acquire.probe.head import Head, HeadLost, HoldOutOfTolerance
from capture.acquire.probe.source_exposure import (
    ShutterFault,
    SourceExposure,
    expose,
    expose_dark,
    readout_s,
)
from capture.devices.camera import Frame, FrameRefused, FrameTimeout
from capture.devices.probe import ProbeBox
from capture.plan import Step, Value
from capture.plan.probe import group_by_series
from capture.plan.suction import HeadPlacement
from capture.rig import Probe
from capture.session import Session

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _TakenExposure:
    """An exposure that will be kept."""

    exposed: SourceExposure
    actual: dict[str, Value]
    tries: int


class BracketSeries:
    """Series of exposures of one run."""

    def __init__(self, run: CaptureRun, box: ProbeBox) -> None:
        self._run, self._session, self._operator = run, run.session, run.operator
        self._box = box
        self._probe: Probe = run.rig.probe  # type: ignore[assignment]
        placements = _count_placements(run.session)
        self._head = Head(self._probe, box, run.operator, placements=placements)
        self._tokens = 0

    # darks ------------------------------------------------------------------------------------

    def darks(self) -> None:
        """Take the missing frames without light, with the head capped."""
        missing = [step for step in self._run.pending_steps() if step.kind == "dark"]
        if missing:
            self._head.cap()
            self._box.cover(None)
        for number, step in enumerate(missing, start=1):
            self._operator.stop_if_asked()
            seconds = float(step.settings["exposure_s"])
            self._operator.progress(f"dark {number}/{len(missing)} {step.id} {seconds:.3g} s")
            self._commit_exposure(self._take_dark(step), {})

    def _take_dark(self, step: Step) -> _TakenExposure:
        why = ""
        for attempt in range(1, MAX_ATTEMPTS + 1):
            before_c = self._head.temperature_c()
            self._head.keep_capped()
            self._tokens += 1
            token = f"{self._operator.run_id}.{self._tokens}"
            try:
                exposed = expose_dark(self._run, self._box, step, token=token)
            except (FrameRefused, FrameTimeout) as error:
                why = self._note_retake(step, attempt, error)
                continue
            if not self._box.status().placed:
                why = self._note_retake(
                    step, attempt, ShutterFault("the controller has released the cap")
                )
                continue
            after_c = self._head.temperature_c()
            actual: dict[str, Value] = {"light": "none", "camera_c": 0.5 * (before_c + after_c)}
            return _TakenExposure(exposed, actual, attempt)
        raise self._run.retry_limit_error(f"step {step.id}", why)

    # series -----------------------------------------------------------------------------------

    def run(self) -> None:
        """Take the missing series, in the plan's order, with the head placed as needed."""
        for placement, steps in group_by_series(self._session.plan):
            if steps[0].kind == "mask" and not self._run.all_brackets:
                self._omit_steps(*find_unneeded_masks(self._session))
            if self._is_missing(steps):
                self._complete_series(placement, steps)

    def _is_missing(self, steps: Sequence[Step]) -> bool:
        """Return whether a series lacks frames, or has frames of several placements."""
        left_out = self._session.omitted_steps()
        ids = {step.id for step in steps if step.id not in left_out}
        found = [record for record in self._session.frames() if record.step_id in ids]
        placements = {record.actual.get("placement") for record in found}
        return bool(ids) and ({record.step_id for record in found} != ids or len(placements) != 1)

    def _complete_series(self, placement: HeadPlacement, steps: Sequence[Step]) -> None:
        left_out = self._session.omitted_steps()
        wanted = [step for step in steps if step.id not in left_out]
        for attempt in range(1, MAX_ATTEMPTS + 1):
            try:
                taken, reason = self._take_series(placement, wanted)
            except HeadLost as lost:
                log.warning("%s, placement %d: %s", placement, attempt, lost)
                why = str(lost)
                self._head.note_loss(why)
                self._run.retakes += 1
                continue
            for one in taken:
                self._commit_exposure(one, {"placement": self._head.placements})
            self._omit_steps(wanted[len(taken) :], reason)
            return
        raise self._head.placement_error(placement, why, captured=bool(self._session.frames()))

    def _take_series(
        self, placement: HeadPlacement, wanted: Sequence[Step]
    ) -> tuple[list[_TakenExposure], str]:
        """Take a series of one placement; return it, and the reason to omit the rest."""
        signal = FiberSignal(self._probe, self._run.rig.view(wanted[0].cameras[0]))
        taken: list[_TakenExposure] = []
        self._head.require_placement(placement)
        fiber = wanted[0].settings.get("fiber")
        self._box.cover(None if fiber is None else int(fiber))
        for number, step in enumerate(wanted):
            self._operator.stop_if_asked()
            taken.append(self._take_exposure(placement, step))
            exposed, actual = taken[-1].exposed, taken[-1].actual
            self._operator.progress(
                f"{placement}: {number + 1}/{len(wanted)} {step.id} "
                f"{float(step.settings['exposure_s']):.3g} s, "
                f"{float(actual['suction_mbar']):.1f} mbar"
            )
            left = wanted[number + 1 :]
            if fiber is not None:
                continue
            first = exposed.frames[step.cameras[0]]
            signal.add_exposure(_pixels(first, step), float(step.settings["exposure_s"]))
            if not left:
                self._report_missing_fibers(placement, signal)
            elif not self._run.all_brackets and (reason := stop_reason(signal, step, left)):
                return taken, f"{placement}: {reason}"
        return taken, ""

    def _take_exposure(self, placement: HeadPlacement, step: Step) -> _TakenExposure:
        """Take one exposure with the head held before and after, or repeat it."""
        why = ""
        needs_s = float(step.settings["exposure_s"]) + readout_s(self._run, step)
        level = float(step.settings["level"])
        held = True
        for attempt in range(1, MAX_ATTEMPTS + 1):
            try:
                self._head.hold(level, needs_s)
                before_mbar, before_c = self._head.readings()
                exposed = expose(self._run, self._box, step)
                after_mbar, after_c = self._head.readings()
            except HoldOutOfTolerance as error:
                why, held = self._note_retake(step, attempt, error), False
                continue
            except HeadLost:
                self._drop_frames(step)
                raise
            except (FrameRefused, FrameTimeout) as error:
                why, held = self._note_retake(step, attempt, error), True
                continue
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
            if "fiber" in step.settings:
                actual["fiber"] = step.settings["fiber"]
            return _TakenExposure(exposed, actual, attempt)
        if held:
            raise self._run.retry_limit_error(f"step {step.id}", why)
        raise self._head.placement_error(placement, why, captured=bool(self._session.frames()))

    def _note_retake(self, step: Step, attempt: int, error: Exception) -> str:
        self._drop_frames(step)
        return self._run.note_retake(step, attempt, error)

    def _drop_frames(self, step: Step) -> None:
        for camera in self._run.step_cameras(step).values():
            camera.abort()

    # omission of exposures --------------------------------------------------------------------

    def _report_missing_fibers(self, placement: HeadPlacement, signal: FiberSignal) -> None:
        """Log the fibers without a signal in a whole series."""
        verdict = signal.verdict([])
        for pairs, what in (
            (verdict.hopeless, "stays in the noise"),
            (verdict.saturated, "is saturated in every exposure: less level shows it"),
        ):
            if pairs:
                self._operator.progress(
                    f"{placement}: {describe_fibers(pairs, signal.probe)} {what}"
                )

    def _omit_steps(self, steps: Sequence[Step], reason: str) -> None:
        if not steps:
            return
        self._operator.progress(reason)
        log.info(reason)
        self._run.omit_steps([step.id for step in steps], reason, {})

    def _commit_exposure(self, one: _TakenExposure, more: dict[str, Value]) -> None:
        step = one.exposed.step
        light: dict[str, Value] = {
            "light": str(one.actual["light"]),
            "level": float(step.settings["level"]),
        }
        self._run.commit_frames(
            step,
            one.exposed.frames,
            light=light,
            tries=one.tries,
            t_box_s=one.exposed.t_box_s,
            journal_entries={**one.actual, **more},
        )


def _pixels(frame: Frame, step: Step) -> np.ndarray:
    """Return the sensor values of a frame, also of a foreign raw file."""
    if isinstance(frame.image, bytes):
        return np.asarray(raw.decode(memoryview(frame.image), where=f"step {step.id}").cfa)
    return frame.image


def _count_placements(session: Session) -> int:
    """Return the number of placements in earlier runs that left frames in the session."""
    return max((int(r.actual.get("placement", 0)) for r in session.frames()), default=0)
