"""Simulate a camera: shots, exposures and sensor.

The camera opens its shutter when it is fired, or on the edge that the flash controller puts on the
camera line. It integrates the light that pops while the shutter is open, is busy until the frame is
read out, and misses edges meanwhile. The pixels are computed when a client requests the frame.
"""

import dataclasses
import math
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from capture.devices.camera import CameraError, CameraInfo, Exposure, Frame, FrameTimeout, Trigger
from capture.rig import View
from rigsim.arrays import UInt16Array
from rigsim.boxes.command import add_us
from rigsim.boxes.faults import Faults
from rigsim.world.light_record import Light

ISO_RANGE = (50, 25_600)


EXPOSURE_RANGE_S = (1.0 / 8000.0, 30.0)


CLOCK_ROUNDING_US = 1e-3
"""Rounding error of a time in floating-point seconds, us."""
CLOCK_STEP_S = 1e-6
"""Step of the controllers' clock, s: a pulse is at the nearest one."""
FOREIGN_SERIAL = "SR-9999"


@dataclass(frozen=True, slots=True)
class _Shot:
    """An exposure whose pixels are not computed yet."""

    number: int
    seq: int
    start_s: float
    exposure: Exposure
    late_s: float = 0.0
    """Delay after the read-out, s; a late frame is under way, and cannot be dropped."""

    @property
    def end_s(self) -> float:
        return self.start_s + self.exposure.exposure_s


class CameraWorld(Protocol):
    """Interface of the world that a camera requires."""

    faults: Faults
    lock: threading.RLock
    virtual: bool

    @property
    def now(self) -> float:
        """World time, s."""

    def rng_for(self, *names: str) -> np.random.Generator:
        """Return the random generator of these names."""

    def advance(self, now: float) -> float:
        """Advance every controller to this time; return when the next event is due, s."""

    def wait(self, until: float) -> None:
        """Advance time to this moment, s."""

    def light_between(self, start: float, end: float) -> tuple[Light, ...]:
        """Return the light of a time interval."""

    def expose(
        self,
        view_name: str,
        exposure: Exposure,
        start_s: float,
        *,
        seed: int,
        pops: Sequence[Light],
    ) -> UInt16Array:
        """Return the pixels of an exposure."""


class CameraBody:
    """One camera of a world.

    Parameters
    ----------
    world
        The camera's world.
    view
        Its view in the rig.
    first_shot
        Number of its next shot, >= 0. It seeds the noise, so that no two shots may share one: a
        camera that continues another world's sequence continues its count, too.

    Attributes
    ----------
    missed_edges : int
        Triggers that arrived while it was not armed or busy.
    """

    def __init__(self, world: CameraWorld, view: View, *, first_shot: int = 0) -> None:
        self.world = world
        self.view = view
        self.info = CameraInfo(
            serial=view.serial,
            model=view.camera_model,
            width_px=view.width_px,
            height_px=view.height_px,
            pattern=view.cfa,
            black=(float(view.black_level),) * (1 if view.cfa == "MONO" else 4),
            white=view.white_level,
            triggers=(Trigger.SOFTWARE, Trigger.EDGE),
            pixel_um=view.pixel_um,
        )
        self.exposure = Exposure(0.01, 100)
        self.missed_edges = 0
        self._rng = world.rng_for("camera", view.name)
        self._delays = world.rng_for("late frames", view.name)
        self._armed = 0
        self._trigger = Trigger.SOFTWARE
        self._seq = 0
        self._shots = first_shot
        self._busy_until = -math.inf
        self._waiting: deque[_Shot] = deque()
        self._previous: _Shot | None = None

    def clock_s(self) -> float:
        """Return the camera's own clock, in s; it drifts by the world's fault settings."""
        return self._stamp(self.world.now)

    def _stamp(self, now: float) -> float:
        # whole microseconds, as controllers count: an exposure never precedes its own request
        now_s = math.floor(1e6 * now + CLOCK_ROUNDING_US) / 1e6
        return now_s * (1.0 + self.world.faults.drift_ppm * 1e-6)

    def configure(self, want: Exposure) -> Exposure:
        """Set an exposure, limited to the camera's ranges, and return it."""
        self.exposure = Exposure(
            min(max(want.exposure_s, EXPOSURE_RANGE_S[0]), EXPOSURE_RANGE_S[1]),
            min(max(want.iso, ISO_RANGE[0]), ISO_RANGE[1]),
        )
        return self.exposure

    def arm(self, count: int, trigger: Trigger) -> None:
        """Prepare `count` exposures and drop pending frames."""
        if count < 1:
            raise CameraError(f"count: got {count}, expected 1 or more")
        if trigger not in self.info.triggers:
            raise CameraError(f"camera {self.info.serial}: does not support {trigger} triggers")
        with self.world.lock:
            self._drop_waiting()
            if self._previous is not None and self._rng.random() < self.world.faults.stale:
                self._waiting.append(self._previous)
            self._armed, self._trigger, self._seq = count, trigger, 0

    def abort(self) -> None:
        """Cancel armed exposures; an exposure that has begun is dropped."""
        with self.world.lock:
            self._armed = 0
            self._drop_waiting()

    def _drop_waiting(self) -> None:
        self._waiting = deque(shot for shot in self._waiting if shot.late_s > 0.0)

    def close(self) -> None:
        """Release the camera; its state persists."""
        self.abort()

    def edge(self, now: float) -> None:
        """Handle a pulse on the camera line."""
        is_ready = now + CLOCK_STEP_S > self._busy_until
        if self._trigger is Trigger.EDGE and self._armed and is_ready:
            self._open_shutter(now)
        else:
            self.missed_edges += 1

    @property
    def is_exposing(self) -> bool:
        """Whether an exposure or its read-out is in progress."""
        return self.world.now < self._busy_until

    def fire(self) -> None:
        """Start an exposure now."""
        with self.world.lock:
            self.world.advance(self.world.now)
            now = self.world.now
            if self._trigger is not Trigger.SOFTWARE or not self._armed:
                raise CameraError(
                    f"camera {self.view.serial}: not armed for software triggers; arm it"
                )
            if now < self._busy_until:
                raise CameraError(f"camera {self.view.serial}: still reading out; retry later")
            self._open_shutter(now)

    def _open_shutter(self, now: float) -> None:
        lag_s = self.view.shutter_lag_s
        # on the controllers' clock: else a pop delayed by the lag can be early by a rounding error
        start_s = add_us(now, 1e6 * lag_s) if lag_s > 0.0 else now
        shot = _Shot(self._shots, self._seq, start_s, self.exposure)
        self._shots += 1
        self._seq += 1
        self._armed -= 1
        self._busy_until = shot.end_s + self.view.readout_s
        if self._rng.random() >= self.world.faults.drop_frame:
            self._send(shot)

    def _send(self, shot: _Shot) -> None:
        """Put a frame on its way: in time, late, or in time and late again."""
        faults = self.world.faults
        chance = self._delays.random()
        late = dataclasses.replace(shot, late_s=faults.late_frame_s * self._delays.uniform(0.01, 1))
        if chance >= faults.late_frame:
            self._waiting.append(shot)
        if chance < faults.late_frame + faults.repeat_frame:
            self._waiting.append(late)

    def _ready_s(self, shot: _Shot) -> float:
        return shot.end_s + self.view.readout_s + shot.late_s

    def next_shot(self, timeout_s: float) -> _Shot:
        """Wait until the next frame has been read out."""
        world = self.world
        until = world.now + timeout_s
        while True:
            with world.lock:
                world.advance(world.now)
                # late frames are overtaken: the earliest comes first
                first = min(self._waiting, key=self._ready_s, default=None)
                ready = math.inf if first is None else self._ready_s(first)
                if first is not None and ready <= world.now:
                    self._waiting.remove(first)
                    self._previous = dataclasses.replace(first, late_s=0.0)
                    return first
                now = world.now
            if now >= until:
                raise FrameTimeout(f"camera {self.view.serial}: no frame in {timeout_s:g} s")
            # an edge from another thread may begin an exposure meanwhile
            pause = min(ready, until) if world.virtual else min(ready, until, now + 0.01)
            world.wait(pause)

    def frame(self, timeout_s: float) -> Frame:
        """Return the next frame, or raise `FrameTimeout`."""
        return self.develop(self.next_shot(timeout_s))

    def develop(self, shot: _Shot) -> Frame:
        """Compute the pixels of an exposure and return them with the camera's metadata."""
        faults = self.world.faults
        rng = self.world.rng_for("frame", self.view.name, str(shot.number))
        foreign = rng.random() < faults.wrong_camera
        exposure = shot.exposure
        if rng.random() < faults.wrong_exposure:
            exposure = dataclasses.replace(exposure, exposure_s=2.0 * exposure.exposure_s)
        light = self.world.light_between(shot.start_s, shot.start_s + exposure.exposure_s)
        image = self.world.expose(
            self.view.name, exposure, shot.start_s, seed=int(rng.integers(0, 2**63)), pops=light
        )
        return Frame(
            serial=FOREIGN_SERIAL if foreign else self.view.serial,
            seq=shot.seq,
            t_start_s=self._stamp(shot.start_s),
            t_end_s=self._stamp(shot.start_s + exposure.exposure_s),
            exposure=exposure,
            image=image,
        )
