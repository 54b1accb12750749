"""Run a controller's table of light once, and match the frames to its rows.

The controller steps through its table on its own; meanwhile the leases of all registered
controllers are renewed. Afterwards the frames are fetched and matched to rows by time.
"""

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from capture.acquire.frames import frame_timeout_s, requested_exposure
from capture.acquire.outcome import MAX_ATTEMPTS, CaptureRun
from capture.devices.camera import (
    Camera,
    CameraError,
    Exposure,
    Frame,
    FrameRefused,
    FrameTimeout,
    Trigger,
    check_frame,
)
from capture.devices.led_box import LedBox
from capture.plan import Step

log = logging.getLogger(__name__)

N_CLOCK_READINGS = 8
CLOCK_DRIFT_S_PER_S = 2e-4
"""Largest drift of a camera's clock, s per s."""
MAX_ROW_TIME_DEVIATION = 0.25
"""Largest deviation of a frame from its row's time, of the shortest row."""


@dataclass(frozen=True, slots=True)
class _ClockOffset:
    """Offset of a camera's clock from the controller's."""

    offset_s: float
    """Camera time minus controller time, s."""
    uncertainty_s: float
    """Half the duration of the comparison, s."""
    box_s: float
    """Controller time of the comparison, s."""


def compare_clocks(camera: Camera, box_clock_s: Callable[[], float]) -> _ClockOffset:
    """Return the offset of a camera's clock from the controller's: the best of some comparisons."""
    best = _ClockOffset(0.0, float("inf"), 0.0)
    for _ in range(N_CLOCK_READINGS):
        before = camera.clock_s()
        box_s = box_clock_s()
        after = camera.clock_s()
        half = 0.5 * (after - before)
        if half < best.uncertainty_s:
            best = _ClockOffset(0.5 * (before + after) - box_s, half, box_s)
        if best.uncertainty_s < 2e-3:
            break
    return best


def arm_camera(camera: Camera, count: int, box_clock_s: Callable[[], float]) -> _ClockOffset:
    """Arm a camera for a table and return the offset of its clock afterwards.

    A link that was lost and made again may reach a program with another clock: the offset is that
    of the link in use. A link that was lost since the arming needs another arming.
    """
    camera.arm(count, Trigger.EDGE)
    try:
        return compare_clocks(camera, box_clock_s)
    except FrameRefused as error:
        log.info("%s", error)
    camera.arm(count, Trigger.EDGE)
    return compare_clocks(camera, box_clock_s)


def count_attempts(box: LedBox) -> Iterator[int]:
    """Yield the number of each attempt at a table, from 1 to `MAX_ATTEMPTS` or beyond.

    A controller ends a table at an LED that it finds to draw no current; such an attempt is one
    more.
    """
    number, most = 0, MAX_ATTEMPTS
    while number < most:
        number, known = number + 1, len(box.failed_leds)
        yield number
        most += len(box.failed_leds) > known


class FrameStream:
    """Frames of one camera as they come from a sequence, each assigned to its row.

    Parameters
    ----------
    name
        Name of the view.
    camera
        Armed for the sequence, which has ended.
    row_times_s
        Controller time at which each row released the cameras, by row.
    dwell_s
        Length of the shortest row, s.
    clock
        Offset of the camera's clock from the controller's.
    want
        Requested exposure.
    lag_s
        Time from release to open shutter, s.
    timeout_s
        Timeout of the next frame, s.

    Raises
    ------
    CameraError
        When the clocks cannot be compared precisely enough to distinguish rows.

    Attributes
    ----------
    stale : int
        Number of dropped frames that belong to no row of the sequence.
    refused : list of str
        Reasons of rejected frames.
    """

    def __init__(
        self,
        name: str,
        camera: Camera,
        *,
        row_times_s: Mapping[int, float],
        dwell_s: float,
        clock: _ClockOffset,
        want: Exposure,
        lag_s: float,
        timeout_s: float,
    ) -> None:
        if clock.uncertainty_s > MAX_ROW_TIME_DEVIATION * dwell_s:
            raise CameraError(
                f"view {name!r}: the clocks of camera and controller could be compared to "
                f"{1e3 * clock.uncertainty_s:.1f} ms only, too coarse for rows of "
                f"{1e3 * dwell_s:.1f} ms; take load off this machine, or use slower rows"
            )
        self._camera = camera
        self._rows = sorted(row_times_s)
        self._times = np.array([row_times_s[row] + lag_s for row in self._rows])
        self._dwell_s = dwell_s
        self._clock = clock
        self._want = want
        self._timeout_s = timeout_s
        self._next: tuple[int, Frame] | None = None
        self._ended = not self._rows
        self._last_row = -1
        self.stale = 0
        self.refused: list[str] = []

    def read_until(self, row: int) -> dict[int, Frame]:
        """Return the frames of all rows up to `row` that were not returned before."""
        found: dict[int, Frame] = {}
        while not self._ended:
            if self._next is None and not self._fetch():
                continue
            if self._next is None or self._next[0] > row:
                break
            found[self._next[0]] = self._next[1]
            self._ended = self._next[0] == self._rows[-1]
            self._next = None
        return found

    def _fetch(self) -> bool:
        """Fetch one more frame; return whether it belongs to a row still to come."""
        try:
            frame = self._camera.frame(self._timeout_s)
        except FrameTimeout as error:
            self._ended = True
            self.refused.append(str(error))
            return False
        except FrameRefused as error:
            self.refused.append(str(error))
            return False
        row = self._find_row(frame)
        if row is None or row <= self._last_row:
            self.stale += 1
            return False
        self._last_row = row
        try:
            # time determines the row; camera and settings are left to check
            check_frame(
                frame,
                self._camera.info,
                seq=frame.seq,
                not_before_s=frame.t_start_s,
                want=self._want,
            )
        except FrameRefused as error:
            self.refused.append(str(error))
            return False
        self._next = (row, frame)
        return True

    def _find_row(self, frame: Frame) -> int | None:
        box_s = frame.t_start_s - self._clock.offset_s
        place = int(np.argmin(np.abs(self._times - box_s)))
        allowed_s = self._clock.uncertainty_s + CLOCK_DRIFT_S_PER_S * abs(box_s - self._clock.box_s)
        allowed_s = min(allowed_s + 1e-3, MAX_ROW_TIME_DEVIATION * self._dwell_s + 1e-3)
        return self._rows[place] if abs(self._times[place] - box_s) <= allowed_s else None


class TableRun:
    """The rows of an armed table, one per step, run once.

    Parameters
    ----------
    run, box, steps
        Steps that share exposure and cameras, which are set; the controller's table is armed.
    dwell_s
        Length of the shortest row, s.
    token
        Token of the run of the table.
    poll_s
        Interval between two polls of the controller, s.
    what
        Words for a table and its rows.
    keep_alive
        Called at every poll of the controller, so that other controllers keep their lease.

    Attributes
    ----------
    times_s : dict of int to float
        Time at which each row released the cameras, on the controller's clock.
    dead_leds : frozenset of int
        Numbers of the LEDs that were dark in these rows. A new failure ends the table, so that it
        is in none of them; controllers of revisions before 1.3 continue, and theirs are included.
    """

    def __init__(
        self,
        run: CaptureRun,
        box: LedBox,
        steps: Sequence[Step],
        *,
        dwell_s: float,
        token: str,
        poll_s: float,
        what: tuple[str, str],
        keep_alive: Callable[[], object] = lambda: None,
    ) -> None:
        self._run, self._box, self._steps, self._what = run, box, steps, what
        self._cameras = run.step_cameras(steps[0])
        clocks = {
            name: arm_camera(camera, len(steps), box.ping) for name, camera in self._cameras.items()
        }
        keep_alive()
        before = box.find_failed_leds()
        began_s = box.trigger(token)
        self.times_s = self._listen(token, began_s, poll_s, keep_alive)
        after = box.find_failed_leds()
        self.dead_leds = before if box.stops_at_failure else after
        self._streams = {
            name: FrameStream(
                name,
                camera,
                row_times_s=self.times_s,
                dwell_s=dwell_s,
                clock=clocks[name],
                want=requested_exposure(steps[0]),
                lag_s=run.rig.view(name).shutter_lag_s,
                timeout_s=frame_timeout_s(steps[0], run.rig.view(name)),
            )
            for name, camera in self._cameras.items()
        }

    def _listen(
        self, token: str, began_s: float, poll_s: float, keep_alive: Callable[[], object]
    ) -> dict[int, float]:
        """Renew the leases until the table has ended; return when its rows released the cameras."""
        times: dict[int, float] = {}
        while True:
            reported = self._box.listen(poll_s)
            times.update((row, time_s) for row, time_s in reported.items() if time_s >= began_s)
            keep_alive()
            position = self._box.position()
            if position.state != "RUN":
                break
            step = self._steps[max(position.row, 0)]
            count = f"{position.row + 1}/{len(self._steps)}"
            self._run.operator.progress(f"{count} {step.id} {step.kind}")
        if position.state != "DONE":
            log.warning("the %s stopped after row %d", self._what[0], position.row)
        self._box.dark()
        if (position.token, position.rows) != (token, len(self._steps)):
            log.warning("the controller ran %s, expected %s", position, token)
            return {}
        for row in range(len(self._steps)):  # query the times whose reports were lost on the line
            if row not in times and (time_s := self._box.step_time(row)) is not None:
                times[row] = time_s
        if position.state != "DONE":  # the light of its last row was cut short
            times.pop(position.row, None)
        return times

    def rows(self, first: int, last: int) -> Iterator[tuple[int, dict[str, Frame]]]:
        """Yield the rows before ``last`` with a frame of every camera, with the frames."""
        # camera by camera, so that each can process frames while they are in its cache
        found = {name: stream.read_until(last - 1) for name, stream in self._streams.items()}
        for row in range(first, last):
            frames = {name: some.pop(row) for name, some in found.items() if row in some}
            if len(frames) == len(self._streams):
                yield row, frames

    def end(self) -> str:
        """Release the cameras; return why rows lack frames, if any do."""
        for name, camera in self._cameras.items():
            camera.abort()
            self._run.stale += self._streams[name].stale
        reasons = [text for stream in self._streams.values() for text in stream.refused]
        table, rows = self._what
        if len(self.times_s) < len(self._steps):
            done = f"{len(self.times_s)} of {len(self._steps)} {rows}"
            reasons.append(f"the {table} ended after {done}")
        return reasons[-1] if reasons else "frames are missing"
