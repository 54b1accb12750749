"""Run a plan on the dome: the box steps through many lights by itself, the frames come after.

Steps that share exposure and place of the target are one sequence. The box judges its table before
it lights anything; while it runs only the lease is renewed. Afterwards the frames are gathered, a
few rows of all cameras at a time: a row that lacks one camera's frame is taken again as a whole.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

from capture.acquire.frame_stream import FrameStream, compare_clocks
from capture.acquire.frames import FRAME_MARGIN_S, configure, encode, wanted_exposure
from capture.acquire.outcome import (
    MAX_ATTEMPTS,
    Acquired,
    AcquisitionError,
    Operator,
    attempts_so_far,
    given_up,
    steps_to_do,
    tear_down,
)
from capture.devices.camera import Camera, CameraError, Frame, Trigger
from capture.devices.dome import Eyes, Judgment, Position, TableRow
from capture.devices.port import CommandRefused
from capture.devices.wire import Code
from capture.plan import Plan, Step
from capture.plan.dose import dose_report
from capture.plan.flicker import flicker_report
from capture.plan.rows import LedRow, led_rows, passes
from capture.rig import LedLimits, Rig
from capture.session import Session

log = logging.getLogger(__name__)

MAX_BUFFERED_PIXEL_BYTES = 384 * 2**20
"""Most pixels that are held at once."""
ROW_POLL_S = 0.2
MIN_DARK_GAP_S = 1.1
"""Darkness between single rows, so that no second sees more than one flash of them."""
DOME_LEASE_S = 2.0


class Dome(Protocol):
    """The part of the dome's driver that a capture needs."""

    failed_leds: set[int]

    @property
    def limits(self) -> Mapping[str, Any]:
        """What the box allows, in its own words and units."""

    def arm(self) -> None:
        """Allow light."""

    def set_lease(self, lease_s: float) -> None:
        """Set after how much silence the box goes dark."""

    def set_cameras(self, mask: int) -> None:
        """Set which cameras are released at all."""

    def set_eyes(self, eyes: Eyes) -> None:
        """Pass on what a person says of the subject's eyes."""

    def new_subject(self, pseudonym: str) -> None:
        """Begin to count the dose anew."""

    def ping(self) -> float:
        """Return the box's clock, s."""

    def load(self, rows: Sequence[TableRow]) -> None:
        """Replace the box's table."""

    def arm_sequence(self, rows: int) -> Judgment:
        """Let the box judge its table."""

    def trigger(self, token: str) -> float:
        """Run the table once; a retry on the line never runs it twice."""

    def listen(self, seconds: float) -> dict[int, float]:
        """Let time pass, renew the lease, and return the releases reported."""

    def position(self) -> Position:
        """Tell where the sequence stands."""

    def step_time(self, row: int) -> float | None:
        """Return when a row released its cameras."""

    def dark(self) -> None:
        """Put all light out and disarm."""


def run_dome(
    plan: Plan,
    rig: Rig,
    *,
    box: Dome,
    cameras: Mapping[str, Camera],
    session: Session,
    operator: Operator,
    eyes: Eyes = "open",
) -> Acquired:
    """Capture what the session still lacks of a plan of the dome; see `run_plan`."""
    check_safety(plan, rig, eyes=eyes)
    _check_box(plan, rig, box.limits)
    _check_cameras(cameras)
    run = _Run(rig, box, cameras, session, operator)
    try:
        box.dark()  # whatever was going on before
        box.set_lease(DOME_LEASE_S)
        box.set_cameras((1 << len(rig.views)) - 1)
        if not session.frames():
            box.new_subject(session.id[:32])
        box.set_eyes(eyes)
        for piece in _pieces(steps_to_do(session), int(box.limits.get("max_rows", 1024))):
            operator.stop_if_asked()
            run.prepare(piece[0])
            run.take(piece)
    finally:
        tear_down(box, cameras)
    return run.account()


def check_safety(plan: Plan, rig: Rig, *, eyes: Eyes = "open") -> None:
    """Raise where a plan goes beyond the rig's own limits of light, before anything is sent.

    Raises
    ------
    AcquisitionError
        For flicker that open eyes must not see, or a light dose above the rig's limit.
    """
    limits = rig.leds or LedLimits()
    flicker, dose = flicker_report(plan, rig), dose_report(plan, rig)
    if eyes == "open" and not flicker.within(limits):
        raise AcquisitionError(
            f"flicker: the plan gives {flicker.flashes_per_s:.1f} flashes per s and rms "
            f"{flicker.rms:.2f} of 3 to 65 Hz, open eyes allow less than "
            f"{limits.max_flashes_per_s:g} and {limits.max_flicker_rms:g}; nothing was lit: order "
            "the lights otherwise, or have the eyes closed or shielded and say so"
        )
    if dose.led_ws > limits.dose_ws:
        raise AcquisitionError(
            f"light dose: {dose.led} would send out {dose.led_ws:.1f} Ws, the rig allows "
            f"{limits.dose_ws:g} Ws to one subject; nothing was lit: shorten the plan"
        )


def _check_box(plan: Plan, rig: Rig, limits: Mapping[str, Any]) -> None:
    """Raise when a step asks for more than the box allows, before anything is sent."""
    if int(limits.get("leds", 0)) != len(rig.lights):
        raise AcquisitionError(
            f"lights: the box drives {limits.get('leds')} LEDs, the rig has {len(rig.lights)}; "
            "numbers would mean other lights: use the rig file of this box"
        )
    if int(limits.get("cameras", 0)) != len(rig.views):
        raise AcquisitionError(
            f"cameras: the box releases {limits.get('cameras')}, the rig has {len(rig.views)}; "
            "use the rig file of this box"
        )
    settle_s, overlap_s = float(limits["settle_us"]) / 1e6, float(limits["overlap_us"]) / 1e6
    low_s, high_s = float(limits["row_min_us"]) / 1e6, float(limits["row_max_us"]) / 1e6
    for step, row in zip(plan.steps, led_rows(plan.steps, rig), strict=True):
        if not low_s <= row.dwell_s <= high_s:
            raise AcquisitionError(
                f"step {step.id}: got dwell_s {row.dwell_s:g}, the box allows {low_s:g} to "
                f"{high_s:g}; nothing was lit: change the plan"
            )
        if len(row.leds) > int(limits["max_at_once"]):
            raise AcquisitionError(
                f"step {step.id}: got {len(row.leds)} lights at once, the box allows "
                f"{limits['max_at_once']}; nothing was lit: change the plan"
            )
        exposure_s = float(step.settings["exposure_s"])
        views = [rig.view(name) for name in step.cameras]
        ends_s = settle_s + max(view.shutter_lag_s for view in views) + exposure_s
        over_s = ends_s + max(view.readout_s for view in views) - settle_s
        if ends_s > row.dwell_s - overlap_s or over_s > row.dwell_s:
            raise AcquisitionError(
                f"step {step.id}: exposure_s {exposure_s:g} and the read-out do not fit into "
                f"dwell_s {row.dwell_s:g}; nothing was lit: change the plan"
            )


def _check_cameras(cameras: Mapping[str, Camera]) -> None:
    for name, camera in cameras.items():
        if Trigger.EDGE not in camera.info.triggers:
            raise CameraError(
                f"view {name!r}: the camera {camera.info.serial} cannot be released by the dome's "
                "trigger line, and no other way keeps pace with its lights"
            )


def _pieces(steps: Sequence[Step], most: int) -> Iterator[list[Step]]:
    for piece in passes(steps):
        for first in range(0, len(piece), most):
            yield piece[first : first + most]


class _Run:
    """One run of a plan: what it uses and what it has done."""

    def __init__(
        self,
        rig: Rig,
        box: Dome,
        cameras: Mapping[str, Camera],
        session: Session,
        operator: Operator,
    ) -> None:
        self._rig = rig
        self._box = box
        self._cameras = cameras
        self._session = session
        self._operator = operator
        self._taken = attempts_so_far(session)
        self._place: str = ""
        self._sequences = 0
        self._steps = self._frames = self._stale = self._retakes = 0

    def account(self) -> Acquired:
        """Return what was done."""
        dead = tuple(self._rig.lights[k].name for k in sorted(self._box.failed_leds))
        return Acquired(self._steps, self._frames, self._stale, self._retakes, dead)

    def prepare(self, step: Step) -> None:
        """Have the target put where a step needs it."""
        for kind in ("pose", "sphere"):
            if kind in step.index and self._place != (place := f"{kind} {step.index[kind]}"):
                self._place = place
                self._operator.prompt(place)

    def take(self, piece: Sequence[Step]) -> None:
        """Take the steps of one sequence, and again those that a camera has missed."""
        left = list(piece)
        why = ""
        for attempt in range(1, MAX_ATTEMPTS + 1):
            self._retakes += len(left) if attempt > 1 else 0
            left, why = self._attempt(left, attempt)
            if not left:
                return
            self._operator.stop_if_asked()
            log.warning("%d steps from %s on, attempt %d: %s", len(left), left[0].id, attempt, why)
        raise given_up(f"{len(left)} steps from {left[0].id} on", why, self._session)

    def _attempt(self, steps: list[Step], attempt: int) -> tuple[list[Step], str]:
        """Run steps as one sequence, or one by one where that would flicker too much.

        The box counts what was lit before, too: after a little darkness a single step passes.
        """
        try:
            return self._sequence(steps, attempt)
        except CommandRefused as error:
            if error.code not in (Code.FLICKER, Code.DUTY):
                raise
            log.info("%s; the %d steps are taken one by one", error, len(steps))
        left: list[Step] = []
        why = ""
        for step in steps:
            self._box.listen(MIN_DARK_GAP_S)
            missing, reason = self._sequence([step], attempt)
            left += missing
            why = reason or why
        return left, why

    def _sequence(self, steps: list[Step], attempt: int) -> tuple[list[Step], str]:
        """Run steps as one sequence; return those that lack a frame, and why."""
        rows = led_rows(steps, self._rig)
        names = steps[0].cameras
        chosen = {name: self._cameras[name] for name in names}
        want = wanted_exposure(steps[0])
        box, mask = self._box, self._mask(names)
        for name, camera in chosen.items():
            configure(name, camera, want)
        box.load([TableRow(row.leds, row.level, row.dwell_s, mask) for row in rows])
        box.arm()
        judged = box.arm_sequence(len(rows))
        log.info("the box judges the table: %s", judged)
        clocks = {name: compare_clocks(camera, box.ping) for name, camera in chosen.items()}
        for camera in chosen.values():
            camera.arm(len(rows), Trigger.EDGE)
        self._sequences += 1
        box.trigger(f"{self._operator.run_id}.{self._sequences}.{attempt}")
        times = self._listen(rows, steps)
        box.dark()
        self._fill_gaps(times, len(rows))
        dwell_s = min(row.dwell_s for row in rows)
        streams = {
            name: FrameStream(
                name,
                camera,
                row_times_s=times,
                dwell_s=dwell_s,
                clock=clocks[name],
                want=want,
                lag_s=self._rig.view(name).shutter_lag_s,
                timeout_s=want.exposure_s + self._rig.view(name).readout_s + FRAME_MARGIN_S,
            )
            for name, camera in chosen.items()
        }
        missing = self._gather(steps, rows, times, streams, attempt)
        for name, camera in chosen.items():
            camera.abort()
            self._stale += streams[name].stale
        reasons = [text for stream in streams.values() for text in stream.refused]
        if len(times) < len(rows):
            reasons.append(f"the sequence ended after {len(times)} of {len(rows)} rows")
        return missing, reasons[-1] if reasons else "frames are missing"

    def _mask(self, names: Sequence[str]) -> int:
        numbers = {view.name: number for number, view in enumerate(self._rig.views)}
        return sum(1 << numbers[name] for name in names)

    def _listen(self, rows: Sequence[LedRow], steps: Sequence[Step]) -> dict[int, float]:
        """Renew the lease until the sequence is over; return when its rows released the cameras."""
        times: dict[int, float] = {}
        while True:
            times.update(self._box.listen(ROW_POLL_S))
            position = self._box.position()
            if position.state != "RUN":
                if position.state != "DONE":
                    log.warning("the sequence stopped after row %d", position.row)
                return times
            step = steps[max(position.row, 0)]
            self._operator.progress(f"{position.row + 1}/{len(rows)} {step.id} {step.kind}")

    def _fill_gaps(self, times: dict[int, float], rows: int) -> None:
        """Ask for the times whose reports were lost on the line."""
        for row in range(rows):
            if row not in times and (time_s := self._box.step_time(row)) is not None:
                times[row] = time_s

    def _gather(
        self,
        steps: Sequence[Step],
        rows: Sequence[LedRow],
        times: Mapping[int, float],
        streams: Mapping[str, FrameStream],
        attempt: int,
    ) -> list[Step]:
        """Commit the rows of which every camera has a frame; return the steps of the others."""
        pixels = sum(2 * view.width_px * view.height_px for view in map(self._rig.view, streams))
        at_once = max(1, MAX_BUFFERED_PIXEL_BYTES // pixels)
        missing: list[Step] = []
        for first in range(0, len(steps), at_once):
            last = min(first + at_once, len(steps))
            # camera by camera, so that each works on what it has just seen
            found = {name: stream.until(last - 1) for name, stream in streams.items()}
            for number in range(first, last):
                frames = {name: some.pop(number) for name, some in found.items() if number in some}
                if len(frames) < len(streams):
                    missing.append(steps[number])
                    continue
                self._commit(steps[number], rows[number], frames, times[number], attempt)
            self._operator.progress(f"{last}/{len(steps)} rows of {len(streams)} cameras kept")
        return missing

    def _commit(
        self, step: Step, row: LedRow, frames: Mapping[str, Frame], t_box_s: float, attempt: int
    ) -> None:
        failed = sorted(set(row.leds) & self._box.failed_leds)
        names = [self._rig.lights[led].name for led in row.leds]
        light: dict[str, str | float] = {"light": "+".join(names) or "none", "level": row.level}
        if failed:
            light["dead_lights"] = "+".join(self._rig.lights[led].name for led in failed)
        for name, frame in frames.items():
            camera = self._cameras[name]
            blob = encode(frame, self._rig.view(name), camera, step, self._session, light)
            self._session.commit(
                step.id,
                name,
                blob,
                settings=dict(step.settings),
                actual={
                    "exposure_s": frame.exposure.exposure_s,
                    "iso": frame.exposure.iso,
                    "serial": frame.serial,
                    "tries": attempt,
                    **light,
                },
                t_box_s=t_box_s,
                t_host_s=self._operator.clock(),
                # a step of which only some cameras were kept is shot again with all of them
                attempt=self._taken.get((step.id, name), 0) + 1,
            )
            self._frames += 1
        self._steps += 1
