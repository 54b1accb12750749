"""A box's table of light run once, and the frames that its rows made.

The box steps through its table by itself; meanwhile only leases are renewed, those of everybody who
asked for it. Afterwards the frames are gathered and matched to rows by time.
"""

import logging
from collections.abc import Callable, Iterator, Sequence

from capture.acquire.frame_stream import FrameStream, compare_clocks
from capture.acquire.frames import frame_timeout_s, wanted_exposure
from capture.acquire.outcome import CaptureRun
from capture.devices.camera import Frame, Trigger
from capture.devices.led_box import LedBox
from capture.plan import Step

log = logging.getLogger(__name__)


class TableRun:
    """The rows of an armed table, one a step, run once.

    Parameters
    ----------
    run, box, steps
        The steps share exposure and cameras, which are set; the box's table is armed.
    dwell_s
        Length of the shortest row, s.
    token
        Name of the run of the table.
    poll_s
        How often the box is asked where it stands, s.
    what
        Words for a table and its rows.
    keep_alive
        Called at every look at the box, so that other boxes know that the host is there.

    Attributes
    ----------
    times_s : dict of int to float
        When each row released the cameras, on the box's clock.
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
        self._cameras = run.cameras_of(steps[0])
        clocks = {name: compare_clocks(camera, box.ping) for name, camera in self._cameras.items()}
        keep_alive()
        for camera in self._cameras.values():
            camera.arm(len(steps), Trigger.EDGE)
        box.trigger(token)
        self.times_s = self._listen(poll_s, keep_alive)
        box.dark()
        for row in range(len(steps)):  # ask for the times whose reports were lost on the line
            if row not in self.times_s and (time_s := box.step_time(row)) is not None:
                self.times_s[row] = time_s
        self._streams = {
            name: FrameStream(
                name,
                camera,
                row_times_s=self.times_s,
                dwell_s=dwell_s,
                clock=clocks[name],
                want=wanted_exposure(steps[0]),
                lag_s=run.rig.view(name).shutter_lag_s,
                timeout_s=frame_timeout_s(steps[0], run.rig.view(name)),
            )
            for name, camera in self._cameras.items()
        }

    def _listen(self, poll_s: float, keep_alive: Callable[[], object]) -> dict[int, float]:
        """Renew the leases until the table is over; return when its rows released the cameras."""
        times: dict[int, float] = {}
        while True:
            times.update(self._box.listen(poll_s))
            keep_alive()
            position = self._box.position()
            if position.state != "RUN":
                if position.state != "DONE":
                    log.warning("the %s stopped after row %d", self._what[0], position.row)
                return times
            step = self._steps[max(position.row, 0)]
            count = f"{position.row + 1}/{len(self._steps)}"
            self._run.operator.progress(f"{count} {step.id} {step.kind}")

    def rows(self, first: int, last: int) -> Iterator[tuple[int, dict[str, Frame]]]:
        """Yield the rows before ``last`` of which every camera has its frame, with the frames."""
        # camera by camera, so that each works on what it has just seen
        found = {name: stream.until(last - 1) for name, stream in self._streams.items()}
        for row in range(first, last):
            frames = {name: some.pop(row) for name, some in found.items() if row in some}
            if len(frames) == len(self._streams):
                yield row, frames

    def end(self) -> str:
        """Let the cameras go; return why rows lack frames, where some do."""
        for name, camera in self._cameras.items():
            camera.abort()
            self._run.stale += self._streams[name].stale
        reasons = [text for stream in self._streams.values() for text in stream.refused]
        table, rows = self._what
        if len(self.times_s) < len(self._steps):
            done = f"{len(self.times_s)} of {len(self._steps)} {rows}"
            reasons.append(f"the {table} ended after {done}")
        return reasons[-1] if reasons else "frames are missing"
