"""Scan a face or a board with the scanner's stripes, pattern by pattern.

Each pattern is shown once for all cameras of its projector: a pattern that lacks one camera's frame
is taken again as a whole. A projector whose lamp fails is omitted, with the reason in the session.
"""

import logging
from collections.abc import Mapping, Sequence
from typing import Any

from capture.acquire.frames import arm_cameras, collect_frames, frame_timeout_s, requested_exposure
from capture.acquire.outcome import (
    MAX_ATTEMPTS,
    AcquisitionError,
    CaptureRun,
    require_trigger_line,
    step_limit_error,
)
from capture.devices.camera import Frame, FrameRefused, FrameTimeout, Trigger
from capture.devices.port import CommandRefused
from capture.devices.scanner import ScannerBox, ShownPattern
from capture.devices.wire import Code
from capture.plan import Step
from capture.rig import SCANNER_BOX

log = logging.getLogger(__name__)

SCANNER_LEASE_S = 2.0
SHOW_MARGIN_S = 0.005
"""Time that a pattern is shown beyond the cameras' exposure, s."""


def prepare_scan(run: CaptureRun, boxes: Mapping[str, Any]) -> "StripeScan":
    """Check the steps of stripes of a run and prepare the scanner; nothing is lit.

    Raises
    ------
    AcquisitionError
        Without the scanner's controller, with open eyes, or beyond the controller's limits.
    """
    if SCANNER_BOX not in boxes:
        raise AcquisitionError(
            f"controller {SCANNER_BOX!r}: no port was given; add --port {SCANNER_BOX}=URL"
        )
    if run.eyes == "open":
        raise AcquisitionError(
            "flicker: the scanner's stripes flicker, open eyes allow none; nothing was lit: close "
            "or shield the eyes and give --eyes"
        )
    scan = StripeScan(run, boxes[SCANNER_BOX])
    for step in run.plan.steps:
        if step.kind == "stripes":
            scan.check(step)
    scan.begin()
    return scan


class StripeScan:
    """Scans with one scanner in one run.

    Parameters
    ----------
    run
        The run; its rig has a scanner.
    box
        The scanner's controller.
    """

    def __init__(self, run: CaptureRun, box: ScannerBox) -> None:
        if run.rig.scanner is None:
            raise AcquisitionError(
                f"scanner: rig {run.rig.name!r} has none, expected a [scanner] section; use the "
                "rig file of this controller"
            )
        self.box = box
        self._run, self._scanner = run, run.rig.scanner
        self._numbers = {p.name: k for k, p in enumerate(self._scanner.projectors)}
        self._shown = 0

    def check(self, step: Step) -> None:
        """Raise an error when a step exceeds the controller's limits or its cameras' means."""
        limits, name = self.box.limits, str(step.settings["projector"])
        number = self._numbers.get(name, len(self._numbers))
        if number >= int(limits["projectors"]):
            raise step_limit_error(step, f"got projector {name!r}, the controller has no such one")
        lines = limits[str(step.settings["axis"])][number]
        same = lines == self._scanner.projectors[number].length_px(str(step.settings["axis"]))
        code = int(limits["period_px"]), int(limits["phase_steps"])
        if not same or code != (self._scanner.period_px, self._scanner.phase_steps):
            what = "the controller shows other patterns than the rig file states"
            raise step_limit_error(step, what)
        shown_ms, most_ms = 1e3 * self._show_s(step), float(limits["max_show_ms"])
        if shown_ms > most_ms:
            what = f"needs light for {shown_ms:g} ms, the controller allows {most_ms:g}"
            raise step_limit_error(step, what)
        for camera in step.cameras:
            why = "scanner's trigger line, and no other way is in time with its light"
            require_trigger_line(camera, self._run.cameras[camera], why)

    def begin(self) -> None:
        """Make the scanner dark and send it lease, subject and eyes."""
        self.box.dark()
        self.box.set_lease(SCANNER_LEASE_S)
        if not self._run.session.frames("stripes"):
            self.box.new_subject(self._run.session.id[:32])
        self.box.set_eyes(self._run.eyes)

    def take(self, steps: Sequence[Step]) -> None:
        """Take steps one by one; those of a projector that fails are omitted."""
        lost: set[str] = set()
        for step in steps:
            if (name := str(step.settings["projector"])) in lost:
                continue
            self._run.operator.stop_if_asked()
            self._run.operator.progress(f"{step.id} {step.kind}")
            why = self._take(step)
            if why:
                left = [
                    s.id for s in self._run.pending_steps() if s.settings.get("projector") == name
                ]
                lost.add(name)
                if len(lost) == len(self._numbers):
                    raise self._run.retry_limit_error(f"step {step.id}", why)
                log.error("projector %s is omitted: %s", name, why)
                self._run.omit_steps(left, f"projector {name}: {why}", {"projector": name})

    def _take(self, step: Step) -> str:
        """Take a step; return why its projector shows nothing, empty when the step is kept."""
        refused, why = 0, ""
        for attempt in range(1, MAX_ATTEMPTS + 1):
            try:
                frames, t_box_s = self._expose(step, attempt)
            except (FrameRefused, FrameTimeout, CommandRefused) as error:
                if isinstance(error, CommandRefused) and error.code != Code.HARDWARE:
                    raise
                refused += isinstance(error, CommandRefused)
                why = self._run.note_retake(step, attempt, error)
                for camera in self._run.step_cameras(step).values():
                    camera.abort()
                continue
            shown = {name: step.settings[name] for name in ("projector", "axis", "stripes")}
            self._run.commit_frames(
                step, frames, light=shown, tries=attempt, t_box_s=t_box_s, journal_entries=shown
            )
            return ""
        if refused == MAX_ATTEMPTS:
            return why
        raise self._run.retry_limit_error(f"step {step.id}", why)

    def _expose(self, step: Step, attempt: int) -> tuple[dict[str, Frame], float]:
        """Show a pattern, and collect one frame per camera of its projector."""
        run, want = self._run, requested_exposure(step)
        chosen = run.step_cameras(step)
        armed_s = arm_cameras(chosen, want, dict.fromkeys(chosen, Trigger.EDGE))
        projector = self._numbers[str(step.settings["projector"])]
        axis, pattern = str(step.settings["axis"]), int(step.settings["stripes"])
        self.box.select_projector(projector)
        self.box.select_pattern(axis, pattern)
        self._shown += 1
        # armed for this pattern only: a readout may last longer than any lease
        self.box.arm()
        token = f"{run.operator.run_id}.{self._shown}.{attempt}"
        t_box_s = self.box.trigger(token, self._show_s(step))
        wanted = ShownPattern(token, t_box_s, projector, axis, pattern)
        if (shown := self.box.last_shown()) != wanted:
            raise FrameRefused(f"step {step.id}: the controller showed {shown}, expected {wanted}")
        timeouts_s = {name: frame_timeout_s(step, run.rig.view(name)) for name in chosen}
        frames, stale = collect_frames(chosen, want, armed_s, timeouts_s)
        run.stale += stale
        self.box.dark()
        return frames, t_box_s

    def _show_s(self, step: Step) -> float:
        lag_s = max(self._run.rig.view(name).shutter_lag_s for name in step.cameras)
        exposure_s = float(step.settings["exposure_s"])
        return self._scanner.settle_s + lag_s + exposure_s + SHOW_MARGIN_S
