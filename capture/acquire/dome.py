"""Run a plan on the dome: the controller steps through the lights, then frames are fetched.

Steps that share exposure and target position are one sequence. The controller checks its table
before it lights anything; while it runs only the lease is renewed. Afterwards the frames are
fetched, a few rows of all cameras at a time: a row that lacks one camera's frame is taken again as
a whole.
"""

import logging
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Any

from capture.acquire.frames import configure_camera, requested_exposure
from capture.acquire.outcome import (
    AcquisitionError,
    AcquisitionResult,
    CaptureRun,
    require_trigger_line,
    step_limit_error,
)
from capture.acquire.stripes import prepare_scan
from capture.acquire.table_run import TableRun, count_attempts
from capture.devices.dome import DomeBox, TableRow
from capture.devices.led_box import Eyes, LedBox
from capture.devices.port import CommandRefused
from capture.devices.wire import Code
from capture.plan import Plan, Step, Value
from capture.plan.dose import dose_report
from capture.plan.flicker import flicker_report
from capture.plan.rows import LedRow, led_rows, split_passes
from capture.rig import LedLimits, Rig

log = logging.getLogger(__name__)

MAX_BUFFERED_PIXEL_BYTES = 384 * 2**20
"""Largest number of pixels in memory at once."""
ROW_POLL_S = 0.2
MIN_DARK_GAP_S = 1.1
"""Dark time between parts of a sequence, s, after which the light of before does not count."""
DOME_LEASE_S = 2.0


def acquire(run: CaptureRun, boxes: Mapping[str, Any]) -> AcquisitionResult:
    """Capture the missing steps of a plan on the dome; see `run_plan`."""
    box: DomeBox = boxes["dome"]
    check_safety(run.plan, run.rig, eyes=run.eyes)
    _check_box(run.plan, run.rig, box.limits)
    for name, camera in run.cameras.items():
        why = "dome's trigger line, and no other way keeps pace with its lights"
        require_trigger_line(name, camera, why)
    sequences = _Sequences(run, box)
    missing = run.pending_steps()
    scan = prepare_scan(run, boxes) if any(step.kind == "stripes" for step in missing) else None
    try:
        begin_lit_run(run, box, DOME_LEASE_S)
        for stripes, group in groupby(missing, key=lambda step: step.kind == "stripes"):
            steps = list(group)
            if stripes and scan is not None:
                sequences.prepare(steps[0])
                scan.take(steps)
                continue
            for piece in _split_sequences(steps, int(box.limits.get("max_rows", 1024))):
                run.operator.stop_if_asked()
                sequences.prepare(piece[0])
                sequences.take(piece)
    finally:
        if scan is not None:
            run.tear_down(scan.box)
        run.tear_down(box)
    return run.summarize(box.failed_leds)


def begin_lit_run(run: CaptureRun, box: LedBox, lease_s: float) -> None:
    """Prepare a controller of LEDs for a run: dark, lease, cameras, subject and eyes."""
    box.dark()  # stop any sequence of before
    box.set_lease(lease_s)
    box.set_cameras((1 << len(run.rig.views)) - 1)
    if not run.session.frames():
        box.new_subject(run.session.id[:32])
    box.set_eyes(run.eyes)


def check_safety(plan: Plan, rig: Rig, *, eyes: Eyes = "open") -> None:
    """Raise an error when a plan exceeds the rig's own limits of light, before anything is sent.

    Raises
    ------
    AcquisitionError
        For flicker that is not allowed for open eyes, or a light dose above the rig's limit.
    """
    limits = rig.leds or LedLimits()
    flicker, dose = flicker_report(plan, rig), dose_report(plan, rig)
    if eyes == "open" and not flicker.within(limits):
        raise AcquisitionError(
            f"flicker: the plan gives {flicker.flashes_per_s:.1f} flashes per s and rms "
            f"{flicker.rms:.2f} of 3 to 65 Hz, open eyes allow less than "
            f"{limits.max_flashes_per_s:g} and {limits.max_flicker_rms:g}; nothing was lit: "
            "change the order of the lights, or close or shield the eyes and give --eyes "
            "[SR-CAP-011]"
        )
    if dose.led_ws > limits.dose_ws:
        raise AcquisitionError(
            f"light dose: {dose.led} would emit {dose.led_ws:.1f} Ws, the rig allows "
            f"{limits.dose_ws:g} Ws per subject; nothing was lit: shorten the plan [SR-CAP-012]"
        )


def _check_box(plan: Plan, rig: Rig, limits: Mapping[str, Any]) -> None:
    """Raise an error when a step exceeds the controller's limits, before anything is sent."""
    if int(limits.get("leds", 0)) != len(rig.lights):
        raise AcquisitionError(
            f"lights: the controller drives {limits.get('leds')} LEDs, the rig has "
            f"{len(rig.lights)}; numbers would mean other lights: use the rig file of this "
            "controller [SR-CAP-013]"
        )
    if int(limits.get("cameras", 0)) != len(rig.views):
        raise AcquisitionError(
            f"cameras: the controller releases {limits.get('cameras')}, the rig has "
            f"{len(rig.views)}; use the rig file of this controller"
        )
    settle_s, overlap_s = float(limits["settle_us"]) / 1e6, float(limits["overlap_us"]) / 1e6
    lit = [step for step in plan.steps if step.kind != "stripes"]
    for step, row in zip(lit, led_rows(lit, rig), strict=True):
        check_dwell(step, row.dwell_s, limits)
        if len(row.leds) > int(limits["max_at_once"]):
            what = (
                f"got {len(row.leds)} lights at once, the controller allows {limits['max_at_once']}"
            )
            raise step_limit_error(step, what)
        exposure_s = float(step.settings["exposure_s"])
        views = [rig.view(name) for name in step.cameras]
        ends_s = settle_s + max(view.shutter_lag_s for view in views) + exposure_s
        over_s = ends_s + max(view.readout_s for view in views) - settle_s
        if ends_s > row.dwell_s - overlap_s or over_s > row.dwell_s:
            raise row_overrun_error(step, row.dwell_s)


def check_dwell(step: Step, dwell_s: float, limits: Mapping[str, Any]) -> None:
    """Raise an error when a step's row is shorter or longer than the controller allows."""
    low_s, high_s = float(limits["row_min_us"]) / 1e6, float(limits["row_max_us"]) / 1e6
    if not low_s <= dwell_s <= high_s:
        what = f"got dwell_s {dwell_s:g}, the controller allows {low_s:g} to {high_s:g}"
        raise step_limit_error(step, what)


def row_overrun_error(step: Step, dwell_s: float) -> AcquisitionError:
    """Return the error of a step whose exposure does not fit into its row."""
    exposure_s = float(step.settings["exposure_s"])
    what = f"exposure_s {exposure_s:g} and the read-out do not fit into dwell_s {dwell_s:g}"
    return step_limit_error(step, what)


def _split_sequences(steps: Sequence[Step], max_steps: int) -> Iterator[list[Step]]:
    for piece in split_passes(steps):
        for first in range(0, len(piece), max_steps):
            yield piece[first : first + max_steps]


class _Sequences:
    """Sequences of one run."""

    def __init__(self, run: CaptureRun, box: DomeBox) -> None:
        self._run, self._box = run, box
        self._place = ""
        self._count = 0

    def prepare(self, step: Step) -> None:
        """Prompt for the target at the position that a step needs."""
        for kind in ("pose", "sphere"):
            if kind in step.index and self._place != (place := f"{kind} {step.index[kind]}"):
                self._place = place
                self._run.operator.prompt(place)

    def take(self, piece: Sequence[Step]) -> None:
        """Take the steps of one sequence, and repeat those that a camera has missed."""
        left = list(piece)
        why = ""
        for attempt in count_attempts(self._box):
            self._run.retakes += len(left) if attempt > 1 else 0
            left, why = self._attempt(left, attempt)
            if not left:
                return
            self._run.operator.stop_if_asked()
            log.warning("%d steps from %s on, attempt %d: %s", len(left), left[0].id, attempt, why)
        raise self._run.retry_limit_error(f"{len(left)} steps from {left[0].id} on", why)

    def _attempt(self, steps: list[Step], attempt: int) -> tuple[list[Step], str]:
        """Run steps as one sequence, or in halves when that would flicker too much.

        The controller also counts light of before: each half follows a short dark time, after which
        a single step passes. A dead LED makes its row dark, which is a flash between lit rows.
        """
        try:
            return self._sequence(steps, attempt)
        except CommandRefused as error:
            if error.code not in (Code.FLICKER, Code.DUTY):
                raise
            log.info("%s; the %d steps are taken in parts", error, len(steps))
        half = (len(steps) + 1) // 2
        left: list[Step] = []
        why = ""
        for part in filter(None, (steps[:half], steps[half:])):
            self._box.listen(MIN_DARK_GAP_S)
            take = self._attempt if len(part) > 1 else self._sequence
            missing, reason = take(part, attempt)
            left += missing
            why = reason or why
        return left, why

    def _sequence(self, steps: list[Step], attempt: int) -> tuple[list[Step], str]:
        """Run steps as one sequence; return those that lack a frame, and the reason."""
        run, box = self._run, self._box
        rows = led_rows(steps, run.rig)
        for name, camera in run.step_cameras(steps[0]).items():
            configure_camera(name, camera, requested_exposure(steps[0]))
        mask = run.camera_mask(steps[0])
        box.load([TableRow(row.leds, row.level, row.dwell_s, mask) for row in rows])
        box.arm()
        log.info("evaluation of the table by the controller: %s", box.arm_sequence(len(rows)))
        self._count += 1
        table = TableRun(
            run,
            box,
            steps,
            dwell_s=min(row.dwell_s for row in rows),
            token=f"{run.operator.run_id}.{self._count}.{attempt}",
            poll_s=ROW_POLL_S,
            what=("sequence", "rows"),
        )
        missing = self._gather(steps, rows, table, attempt)
        return missing, table.end()

    def _gather(
        self, steps: list[Step], rows: Sequence[LedRow], table: TableRun, attempt: int
    ) -> list[Step]:
        """Keep the rows with a frame of every camera; return the steps of the others."""
        run, names = self._run, steps[0].cameras
        pixels = sum(2 * view.width_px * view.height_px for view in map(run.rig.view, names))
        at_once = max(1, MAX_BUFFERED_PIXEL_BYTES // pixels)
        kept = set()
        for first in range(0, len(steps), at_once):
            last = min(first + at_once, len(steps))
            for number, frames in table.rows(first, last):
                dead = sorted(table.dead_leds & set(rows[number].leds))
                light = self._journal_light(rows[number], dead)
                run.commit_frames(
                    steps[number],
                    frames,
                    light=light,
                    tries=attempt,
                    t_box_s=table.times_s[number],
                    journal_entries=light,
                )
                kept.add(number)
            run.operator.progress(f"{last}/{len(steps)} rows of {len(names)} cameras kept")
        return [step for number, step in enumerate(steps) if number not in kept]

    def _journal_light(self, row: LedRow, dead: Sequence[int]) -> dict[str, Value]:
        """Return the light of a row for the journal, with the LEDs of it that were dark."""
        names = self._run.light_names
        light: dict[str, Value] = {"light": names(row.leds) or "none", "level": row.level}
        return light | ({"dead_lights": names(dead)} if dead else {})
