"""Scans of the gradient sphere: a table of patterns in, the frame that each of them made out.

The box judges its table before it lights anything, then steps by itself; meanwhile only leases are
renewed, those of everybody who asked for it. Frames are matched to patterns by time. A pattern that
lacks a camera's frame is taken again; what a scan gives is whole.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from capture.acquire.frame_stream import FrameStream, compare_clocks
from capture.acquire.frames import FRAME_MARGIN_S, configure, encode, wanted_exposure
from capture.acquire.outcome import MAX_ATTEMPTS, Operator, attempts_so_far, given_up
from capture.devices.camera import Camera, Frame, Trigger
from capture.devices.gradient_sphere import ANALYZER_DEG, Eyes, Judgment, PatternRow, Position
from capture.devices.port import CommandRefused
from capture.devices.wire import Code
from capture.plan import Step, Value
from capture.rig import Rig
from capture.session import Session

log = logging.getLogger(__name__)

SCAN_POLL_S = 0.1
SCAN_DARK_GAP_S = 1.1
"""Darkness after which no window of duty, and no second of flashes, holds an earlier scan."""
MAX_DARK_GAPS = 5


class Sphere(Protocol):
    """The part of the gradient sphere's driver that a capture needs."""

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

    def set_analyser(self, angle_deg: float) -> None:
        """Begin to turn the analyser."""

    def wait_settled(self, timeout_s: float = 5.0) -> None:
        """Wait until the analyser stands still."""

    def load(self, rows: Sequence[PatternRow]) -> None:
        """Replace the box's table."""

    def arm_scan(self, rows: int) -> Judgment:
        """Let the box judge its table."""

    def trigger(self, token: str) -> float:
        """Run the table once; a retry on the line never runs it twice."""

    def listen(self, seconds: float) -> dict[int, float]:
        """Let time pass, renew the lease, and return the releases reported."""

    def position(self) -> Position:
        """Tell where the scan stands."""

    def step_time(self, row: int) -> float | None:
        """Return when a row released its cameras."""

    def dark(self) -> None:
        """Put all light out and disarm."""


@dataclass(frozen=True, slots=True)
class Taken:
    """The frames of one step, one a camera."""

    step: Step
    frames: Mapping[str, Frame]
    t_box_s: float
    """When its light released the cameras, on the sphere's clock."""
    tries: int
    """How often the step was shot until all cameras had it."""
    token: str
    """Name of the scan."""


def reading_deg(step: Step) -> float:
    """Return the reading of the analyser that a step asks for, degrees.

    Examples
    --------
    >>> reading_deg(Step("a", "ball", {}, {"polarizer": "crossed"}, ("cam",)))
    90.0
    """
    given = step.settings.get("analyser_deg")
    return ANALYZER_DEG[str(step.settings["polarizer"])] if given is None else float(given)


class Scanner:
    """Scans with one sphere and its cameras into one session.

    Parameters
    ----------
    rig, sphere, cameras, session, operator
        As of the run.
    keep_alive
        Called a few times a second while a scan is going on, so that other boxes know that the
        host is there.

    Attributes
    ----------
    steps, frames, stale, retakes : int
        What was done so far, see `capture.acquire.outcome.Acquired`.
    """

    def __init__(
        self,
        rig: Rig,
        sphere: Sphere,
        cameras: Mapping[str, Camera],
        session: Session,
        operator: Operator,
        *,
        keep_alive: Callable[[], object] = lambda: None,
    ) -> None:
        self._rig = rig
        self._sphere = sphere
        self._cameras = cameras
        self._session = session
        self._operator = operator
        self._keep_alive = keep_alive
        self._attempts = attempts_so_far(session)
        self._scans = 0
        self.steps = self.frames = self.stale = self.retakes = 0

    def scan(self, steps: Sequence[Step]) -> list[Taken]:
        """Take steps that share exposure and cameras; nothing is committed.

        Raises
        ------
        AcquisitionError
            When a camera loses a step's frame three times.
        """
        found: dict[str, Taken] = {}
        why = ""
        for attempt in range(1, MAX_ATTEMPTS + 1):
            left = [step for step in steps if step.id not in found]
            self.retakes += len(left) if attempt > 1 else 0
            taken, why = self._sequence(left, attempt)
            found.update((one.step.id, one) for one in taken)
            if len(found) == len(steps):
                return [found[step.id] for step in steps]
            log.warning("scan of %s, attempt %d: %s", steps[0].id, attempt, why)
        raise given_up(f"scan of {steps[0].id}", why, self._session)

    def commit(self, taken: Sequence[Taken], actual: Mapping[str, Value]) -> None:
        """Commit the frames of a scan, with what else is known of them."""
        dead = "+".join(self._rig.lights[led].name for led in sorted(self._sphere.failed_leds))
        for one in taken:
            step = one.step
            light: dict[str, str | float] = {
                "pattern": str(step.settings["pattern"]),
                "level": float(step.settings["level"]),
                "analyser_deg": reading_deg(step),
            }
            if dead:
                light["dead_lights"] = dead
            for name, frame in one.frames.items():
                attempt = self._attempts.get((step.id, name), 0) + 1
                view, camera = self._rig.view(name), self._cameras[name]
                self._session.commit(
                    step.id,
                    name,
                    encode(frame, view, camera, step, self._session, light),
                    settings=dict(step.settings),
                    actual={
                        "exposure_s": frame.exposure.exposure_s,
                        "iso": frame.exposure.iso,
                        "serial": frame.serial,
                        "tries": one.tries,
                        "token": one.token,
                        **light,
                        **actual,
                    },
                    t_box_s=one.t_box_s,
                    t_host_s=self._operator.clock(),
                    attempt=attempt,
                )
                self._attempts[step.id, name] = attempt
                self.frames += 1
            self.steps += 1
            self._keep_alive()

    def encoded(self, one: Taken, name: str) -> bytes:
        """Return one camera's frame of a step as a file."""
        light = {"pattern": str(one.step.settings["pattern"])}
        view, camera = self._rig.view(name), self._cameras[name]
        return encode(one.frames[name], view, camera, one.step, self._session, light)

    def turn_to(self, step: Step) -> None:
        """Begin to turn the analyser to where a step wants it."""
        self._sphere.set_analyser(reading_deg(step))

    def pause(self, seconds: float) -> None:
        """Let time pass while all boxes know that the host is there."""
        left_s = seconds
        while left_s > 0.0:
            self._sphere.listen(min(left_s, SCAN_POLL_S))
            self._keep_alive()
            left_s -= SCAN_POLL_S

    # one sequence -----------------------------------------------------------------------------

    def _sequence(self, steps: Sequence[Step], attempt: int) -> tuple[list[Taken], str]:
        """Run steps as one table; return those of which every camera has a frame."""
        names = steps[0].cameras
        chosen = {name: self._cameras[name] for name in names}
        want = wanted_exposure(steps[0])
        for name, camera in chosen.items():
            configure(name, camera, want)
        sphere = self._sphere
        rows = self._rows(steps)
        sphere.load(rows)
        sphere.arm()
        sphere.set_analyser(rows[0].analyser_deg)
        sphere.wait_settled()
        log.info("the box judges the scan: %s", self._judged(len(rows)))
        clocks = {name: compare_clocks(camera, sphere.ping) for name, camera in chosen.items()}
        self._keep_alive()
        for camera in chosen.values():
            camera.arm(len(rows), Trigger.EDGE)
        self._scans += 1
        token = f"{self._operator.run_id}.{self._scans}.{attempt}"
        sphere.trigger(token)
        times = self._listen(steps)
        sphere.dark()
        for row in range(len(rows)):
            if row not in times and (time_s := sphere.step_time(row)) is not None:
                times[row] = time_s
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
        taken = []
        for number, step in enumerate(steps):
            found = {name: stream.until(number) for name, stream in streams.items()}
            frames = {name: some[number] for name, some in found.items() if number in some}
            if len(frames) == len(streams):
                taken.append(Taken(step, frames, times[number], attempt, token))
            self._keep_alive()
        for name, camera in chosen.items():
            camera.abort()
            self.stale += streams[name].stale
        reasons = [text for stream in streams.values() for text in stream.refused]
        if len(times) < len(rows):
            reasons.append(f"the scan ended after {len(times)} of {len(rows)} patterns")
        return taken, reasons[-1] if reasons else "frames are missing"

    def _rows(self, steps: Sequence[Step]) -> list[PatternRow]:
        numbers = {view.name: number for number, view in enumerate(self._rig.views)}
        mask = sum(1 << numbers[name] for name in steps[0].cameras)
        return [
            PatternRow(
                str(step.settings["pattern"]),
                reading_deg(step),
                float(step.settings["level"]),
                float(step.settings["dwell_s"]),
                mask,
            )
            for step in steps
        ]

    def _judged(self, rows: int) -> Judgment:
        """Arm the table, after darkness where the light of a moment ago makes it too much."""
        for _ in range(MAX_DARK_GAPS):
            try:
                return self._sphere.arm_scan(rows)
            except CommandRefused as error:
                if error.code not in (Code.DUTY, Code.FLICKER, Code.THERMAL):
                    raise
                log.info("%s; waiting %g s", error, SCAN_DARK_GAP_S)
                self.pause(SCAN_DARK_GAP_S)
        return self._sphere.arm_scan(rows)

    def _listen(self, steps: Sequence[Step]) -> dict[int, float]:
        """Renew the leases until the scan is over; return when its rows released the cameras."""
        times: dict[int, float] = {}
        while True:
            times.update(self._sphere.listen(SCAN_POLL_S))
            self._keep_alive()
            position = self._sphere.position()
            if position.state != "RUN":
                if position.state != "DONE":
                    log.warning("the scan stopped after row %d", position.row)
                return times
            step = steps[max(position.row, 0)]
            self._operator.progress(f"{position.row + 1}/{len(steps)} {step.id} {step.kind}")
