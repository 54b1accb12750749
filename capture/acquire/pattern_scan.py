"""Scan patterns with the gradient sphere: upload a table, return the frame of each pattern.

The controller checks its table before it lights anything, then steps on its own; meanwhile the
leases of all registered controllers are renewed. Frames are matched to patterns by time. A pattern
that lacks a camera's frame is taken again: a scan returns all frames.
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from capture.acquire.frames import configure_camera, requested_exposure
from capture.acquire.outcome import CaptureRun
from capture.acquire.table_run import TableRun, count_attempts
from capture.devices.camera import Frame
from capture.devices.gradient_sphere import ANALYZER_DEG, GradientSphereBox, PatternRow
from capture.devices.led_box import TableEvaluation
from capture.devices.port import CommandRefused
from capture.devices.wire import Code
from capture.plan import Step, Value

log = logging.getLogger(__name__)

SCAN_POLL_S = 0.1
SCAN_DARK_GAP_S = 1.1
"""Dark time after which the limits of duty and flashes no longer include an earlier scan, s."""
MAX_DARK_GAPS = 5


@dataclass(frozen=True, slots=True)
class StepFrames:
    """Frames of one step, one per camera."""

    step: Step
    frames: Mapping[str, Frame]
    t_box_s: float
    """Time of the cameras' release, on the sphere's clock."""
    tries: int
    """Number of attempts until all cameras had a frame."""
    token: str
    """Token of the scan."""
    dead_leds: frozenset[int]
    """Numbers of the LEDs that were dark."""


def analyzer_reading_deg(step: Step) -> float:
    """Return the reading of the analyzer that a step requests, degrees.

    Examples
    --------
    >>> analyzer_reading_deg(Step("a", "ball", {}, {"polarizer": "crossed"}, ("cam",)))
    90.0
    """
    given = step.settings.get("analyzer_deg")
    return ANALYZER_DEG[str(step.settings["polarizer"])] if given is None else float(given)


class PatternScanner:
    """Scans with one sphere in one run.

    Parameters
    ----------
    run, sphere
        The run and its sphere.
    keep_alive
        Called several times per second during a scan, so that other controllers keep their lease.
    """

    def __init__(
        self, run: CaptureRun, sphere: GradientSphereBox, keep_alive: Callable[[], object]
    ) -> None:
        self._run, self._sphere, self._keep_alive = run, sphere, keep_alive
        self._scans = 0

    def scan(self, steps: Sequence[Step]) -> list[StepFrames]:
        """Take steps that share exposure and cameras; nothing is committed.

        Raises
        ------
        AcquisitionError
            When a camera loses a step's frame three times.
        """
        found: dict[str, StepFrames] = {}
        why = ""
        for attempt in count_attempts(self._sphere):
            left = [step for step in steps if step.id not in found]
            self._run.retakes += len(left) if attempt > 1 else 0
            taken, why = self._sequence(left, attempt)
            found.update((one.step.id, one) for one in taken)
            if len(found) == len(steps):
                return [found[step.id] for step in steps]
            log.warning("scan of %s, attempt %d: %s", steps[0].id, attempt, why)
        raise self._run.retry_limit_error(f"scan of {steps[0].id}", why)

    def commit(self, taken: Sequence[StepFrames], actual: Mapping[str, Value]) -> None:
        """Commit the frames of a scan, with further journal entries."""
        for one in taken:
            step = one.step
            light: dict[str, Value] = {
                "pattern": str(step.settings["pattern"]),
                "level": float(step.settings["level"]),
                "analyzer_deg": analyzer_reading_deg(step),
            }
            if one.dead_leds:
                light["dead_lights"] = self._run.light_names(sorted(one.dead_leds))
            noted = {"token": one.token, **light, **actual}
            self._run.commit_frames(
                step,
                one.frames,
                light=light,
                tries=one.tries,
                t_box_s=one.t_box_s,
                journal_entries=noted,
            )
            self._keep_alive()

    def encode_frame(self, taken: StepFrames, name: str) -> bytes:
        """Return one camera's frame of a step as a file."""
        light = {"pattern": str(taken.step.settings["pattern"])}
        return self._run.encode_frame(taken.step, name, taken.frames[name], light)

    def rotate_analyzer(self, step: Step) -> None:
        """Start turning the analyzer to the reading of a step."""
        self._sphere.set_analyzer(analyzer_reading_deg(step))

    def pause(self, seconds: float) -> None:
        """Wait while the leases of all controllers are renewed."""
        left_s = seconds
        while left_s > 0.0:
            self._sphere.listen(min(left_s, SCAN_POLL_S))
            self._keep_alive()
            left_s -= SCAN_POLL_S

    # one sequence -----------------------------------------------------------------------------

    def _sequence(self, steps: Sequence[Step], attempt: int) -> tuple[list[StepFrames], str]:
        """Run steps as one table; return those with a frame of every camera."""
        run, sphere = self._run, self._sphere
        for name, camera in run.step_cameras(steps[0]).items():
            configure_camera(name, camera, requested_exposure(steps[0]))
        mask = run.camera_mask(steps[0])
        rows = [
            PatternRow(
                str(step.settings["pattern"]),
                analyzer_reading_deg(step),
                float(step.settings["level"]),
                float(step.settings["dwell_s"]),
                mask,
            )
            for step in steps
        ]
        sphere.load(rows)
        sphere.arm()
        sphere.set_analyzer(rows[0].analyzer_deg)
        sphere.wait_settled()
        log.info("evaluation of the scan by the controller: %s", self._arm_scan(len(rows)))
        self._scans += 1
        token = f"{run.operator.run_id}.{self._scans}.{attempt}"
        table = TableRun(
            run,
            sphere,
            steps,
            dwell_s=min(row.dwell_s for row in rows),
            token=token,
            poll_s=SCAN_POLL_S,
            what=("scan", "patterns"),
            keep_alive=self._keep_alive,
        )
        taken = []
        for number, step in enumerate(steps):
            for row, frames in table.rows(number, number + 1):
                time_s, dead = table.times_s[row], table.dead_leds
                taken.append(StepFrames(step, frames, time_s, attempt, token, dead))
            self._keep_alive()
        return taken, table.end()

    def _arm_scan(self, rows: int) -> TableEvaluation:
        """Arm the table, after a dark time when recent light would exceed the limits."""
        for _ in range(MAX_DARK_GAPS):
            try:
                return self._sphere.arm_scan(rows)
            except CommandRefused as error:
                if error.code not in (Code.DUTY, Code.FLICKER, Code.THERMAL):
                    raise
                log.info("%s; waiting %g s", error, SCAN_DARK_GAP_S)
                self.pause(SCAN_DARK_GAP_S)
        return self._sphere.arm_scan(rows)
