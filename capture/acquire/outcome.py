"""State of a run on any rig: devices, frames kept, result, and the end in the dark."""

import contextlib
import logging
import secrets
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import starmap

from capture import raw
from capture.acquire.frames import describe_step_frame
from capture.devices.box import Box
from capture.devices.camera import Camera, CameraError, Frame, Trigger
from capture.devices.led_box import Eyes
from capture.devices.port import SYSTEM_CLOCK, Clock, DeviceError
from capture.plan import Plan, Step, Value
from capture.rig import Rig
from capture.session import NewFrame, Session

log = logging.getLogger(__name__)

MAX_ATTEMPTS = 3
MAX_GROUP_BYTES = 2**26
"""Largest size of pixels that are encoded and written together, but for a single frame."""


class AcquisitionError(DeviceError, RuntimeError):
    """Raised when a plan could not be carried out; captured frames are safe in the session."""


class CaptureInterrupted(KeyboardInterrupt):
    """Raised when the operator stopped the capture; the session can be resumed."""


@dataclass(frozen=True, slots=True)
class AcquisitionResult:
    """Result of a run of a plan.

    Attributes
    ----------
    steps
        Number of steps captured in this run.
    frames
        Number of frames committed.
    stale
        Number of stale frames dropped.
    retakes
        Number of steps that were repeated.
    dead_lights
        Lights that the controller reports as drawing no current.
    """

    steps: int
    frames: int
    stale: int
    retakes: int
    dead_lights: tuple[str, ...] = ()


def _ignore(_: str) -> None:
    """Do nothing."""


@dataclass(frozen=True, slots=True)
class Operator:
    """Interface to the person who runs a plan: prompts, progress, and a stop.

    Attributes
    ----------
    progress
        Called with one line per step, or per second of a sequence.
    prompt
        Called before the first step that needs it with the state ("smile"), with the position of
        the target on the dome ("pose 3"), with the taping of the skin ("tape the skin at 45
        degrees"), or with the placement of the probe ("put the cap on the head", "place the head on
        the cheek at 0 degrees"); returns when the subject or the target is ready. Also called with
        the shutter to press when only a person can release a camera.
    interrupted
        Called before each step, or each sequence; True stops in good order.
    clock
        Time of the host, s since 1970, for the journal.
    run_id
        First part of the token of every flash or sequence of this run; random by default, so that
        all tokens differ, also after a resume.
    signal
        Called in a sequence, at the time, with the state to which the subject shall change; gives a
        sound and returns at once.
    timer
        Timer of a sequence; the simulation's own when it is simulated.
    """

    progress: Callable[[str], None] = _ignore
    prompt: Callable[[str], None] = _ignore
    interrupted: Callable[[], bool] = lambda: False
    clock: Callable[[], float] = time.time
    run_id: str = field(default_factory=lambda: secrets.token_hex(4))
    signal: Callable[[str], None] = _ignore
    timer: Clock = SYSTEM_CLOCK

    def stop_if_asked(self) -> None:
        """Raise `CaptureInterrupted` when the operator has asked for a stop."""
        if self.interrupted():
            raise CaptureInterrupted


@dataclass(slots=True)
class CaptureRun:
    """One run of a plan: its devices, and its results so far.

    Attributes
    ----------
    plan, rig, cameras, session, operator, eyes, force_limit_n, all_brackets, camera_colors
        See `capture.acquire.run.run_plan`.
    steps, frames, stale, retakes : int
        Results so far, see `AcquisitionResult`.
    """

    plan: Plan
    rig: Rig
    cameras: Mapping[str, Camera]
    session: Session
    operator: Operator
    eyes: Eyes = "open"
    force_limit_n: float | None = None
    all_brackets: bool = False
    camera_colors: Mapping[str, raw.CameraColor] = field(default_factory=dict)
    steps: int = 0
    frames: int = 0
    stale: int = 0
    retakes: int = 0
    _attempts: dict[tuple[str, str], int] = field(init=False)
    _buffers: dict[int, bytearray] = field(init=False, default_factory=dict)
    """Memory of the encoded frames that are written together, by their number."""

    def __post_init__(self) -> None:
        """Look up the last attempt of each committed frame."""
        records = self.session.frames()
        self._attempts = {(record.step_id, record.camera): record.attempt for record in records}

    def pending_steps(self) -> list[Step]:
        """Return the steps that lack a frame of any camera, once each, in the plan's order."""
        return list({step.id: step for step, _ in self.session.pending_frames()}.values())

    def step_cameras(self, step: Step) -> dict[str, Camera]:
        """Return the cameras of a step, by view."""
        return {name: self.cameras[name] for name in step.cameras}

    def camera_mask(self, step: Step) -> int:
        """Return the trigger lines of a step's cameras, bit by bit in the order of the views."""
        return sum(1 << k for k, view in enumerate(self.rig.views) if view.name in step.cameras)

    def light_names(self, leds: Sequence[int]) -> str:
        """Return the names of lights by number, joined by +."""
        return "+".join(self.rig.lights[led].name for led in leds)

    def encode_frame(
        self, step: Step, name: str, frame: Frame, light: Mapping[str, Value]
    ) -> bytes:
        """Return a frame of the view ``name`` as our DNG."""
        return raw.encode_frame(self._describe(step, name, frame, light))

    def _describe(
        self, step: Step, name: str, frame: Frame, light: Mapping[str, Value]
    ) -> raw.RawFrame:
        view, camera = self.rig.view(name), self.cameras[name]
        color = self.camera_colors.get(name)
        return describe_step_frame(frame, view, camera, step, self.session, light, color)

    def _allocate(self, number: int, size: int) -> memoryview:
        """Return memory for a frame; the next group uses it again."""
        if len(self._buffers.get(number, b"")) < size:
            self._buffers[number] = bytearray(size)
        return memoryview(self._buffers[number])[:size]

    def commit_frames(
        self,
        step: Step,
        frames: Mapping[str, Frame],
        *,
        light: Mapping[str, Value],
        tries: int,
        t_box_s: float | None,
        journal_entries: Mapping[str, Value],
    ) -> None:
        """Commit the frames of a step, one per camera, together.

        Parameters
        ----------
        step, frames
            The step and its frames by view.
        light
            Light of the frames; written into each file.
        tries
            Number of attempts until all cameras had a frame.
        t_box_s
            Time of the cameras' release, on the controller's clock; None without a controller.
        journal_entries
            Further journal entries of the frames.
        """
        # a step of which only some cameras were kept is repeated with all of them
        attempts = {name: self._attempts.get((step.id, name), 0) + 1 for name in frames}

        def encode(number: int, name: str) -> NewFrame:
            frame = frames[name]
            described = self._describe(step, name, frame, light)
            shot = {"exposure_s": frame.exposure.exposure_s, "iso": frame.exposure.iso}
            return NewFrame(
                camera=name,
                blob=raw.encode_frame_into(described, partial(self._allocate, number)),
                settings=step.settings,
                actual={**shot, "serial": frame.serial, "tries": tries, **journal_entries},
                t_box_s=t_box_s,
                t_host_s=self.operator.clock(),
                attempt=attempts[name],
            )

        views = [self.rig.view(name) for name in frames]
        largest = max((2 * view.width_px * view.height_px for view in views), default=1)
        names, count = list(frames), max(1, MAX_GROUP_BYTES // largest)
        for group in (names[k : k + count] for k in range(0, len(names), count)):
            self.session.commit_step(step.id, starmap(encode, enumerate(group)))
            self._attempts.update({(step.id, name): attempts[name] for name in group})
            self.frames += len(group)
        self.steps += 1

    def note_retake(self, step: Step, attempt: int, reason: object) -> str:
        """Record that a step must be repeated; return the reason."""
        log.warning("step %s, attempt %d: %s", step.id, attempt, reason)
        self.retakes += 1
        return str(reason)

    def omit_steps(self, ids: Sequence[str], reason: str, about: Mapping[str, Value]) -> None:
        """Record in the session that steps are omitted, and why."""
        time_s = self.operator.clock()
        self.session.omit_steps(ids, reason=reason, about=about, t_host_s=time_s)

    def retry_limit_error(self, label: str, reason: str) -> AcquisitionError:
        """Return the error of a step that failed too often, with advice."""
        advice = recovery_advice(captured=bool(self.session.frames()))
        return AcquisitionError(
            f"{label}: failed {MAX_ATTEMPTS} times ({reason}); {advice} [SR-CAP-007]"
        )

    def summarize(self, dead_leds: Iterable[int] = ()) -> AcquisitionResult:
        """Return the result, with the numbers of the LEDs that drew no current."""
        dead = tuple(self.rig.lights[led].name for led in sorted(dead_leds))
        return AcquisitionResult(self.steps, self.frames, self.stale, self.retakes, dead)

    def tear_down(self, box: Box) -> None:
        """Switch the light off and release the cameras; errors here are logged, not raised."""
        try:
            box.dark()
        except DeviceError as error:
            # without the host, the controller's own lease switches the light off
            log.error("the controller did not go dark: %s; its lease ends the light", error)
        for camera in self.cameras.values():
            with contextlib.suppress(DeviceError):
                camera.abort()


def recovery_advice(*, captured: bool) -> str:
    """Return advice after a failed capture, by whether the session has frames."""
    if captured:
        return "the session keeps its frames: remove the cause, then add --resume to the command"
    return "no frame was recorded: remove the cause, then run the command again"


def step_limit_error(step: Step, problem: str, *, action: str = "lit") -> AcquisitionError:
    """Return the error of a step beyond its controller's limits; nothing was ``action``."""
    return AcquisitionError(
        f"step {step.id}: {problem}; nothing was {action}: change the plan [SR-CAP-008]"
    )


def require_trigger_line(name: str, camera: Camera, trigger_line: str) -> None:
    """Raise an error if a camera cannot be released by ``trigger_line``, the name of a line."""
    if Trigger.EDGE not in camera.info.triggers:
        serial = camera.info.serial
        raise CameraError(
            f"view {name!r}: the camera {serial} cannot be released by the {trigger_line}; use a "
            "camera on the controller's line [SR-CAP-009]"
        )
