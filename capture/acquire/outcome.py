"""What a run of a plan comes to, on any rig: its account, its errors, its end in the dark."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from capture.devices.camera import Camera
from capture.devices.port import SYSTEM_CLOCK, Clock, DeviceError
from capture.plan import Step
from capture.session import Session

log = logging.getLogger(__name__)

MAX_ATTEMPTS = 3


class AcquisitionError(DeviceError, RuntimeError):
    """A plan could not be carried out; what was captured is safe in the session."""


class Interrupted(KeyboardInterrupt):
    """The operator stopped the capture; the session can be resumed."""


@dataclass(frozen=True, slots=True)
class Acquired:
    """What a run of a plan did.

    Attributes
    ----------
    steps
        Steps captured in this run.
    frames
        Frames committed.
    stale
        Stale frames that were dropped.
    retakes
        Steps that had to be shot again.
    dead_lights
        Lights that the box reports as drawing no current.
    """

    steps: int
    frames: int
    stale: int
    retakes: int
    dead_lights: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Operator:
    """Who runs a plan: asked, told, and able to stop it."""

    progress: Callable[[str], None]
    """Told what is going on, in one line."""
    prompt: Callable[[str], None]
    """Asked to make something ready; returns when it is."""
    interrupted: Callable[[], bool]
    """Asked whether to stop in good order."""
    clock: Callable[[], float]
    """The host's time, s since 1970."""
    run_id: str
    """Begins every token of this run."""
    signal: Callable[[str], None] = lambda text: None
    """Gives the subject a sound, and returns at once."""
    timer: Clock = SYSTEM_CLOCK
    """What the times of a sequence are kept by."""

    def stop_if_asked(self) -> None:
        """Raise `Interrupted` when the capture is to stop."""
        if self.interrupted():
            raise Interrupted


class _Darkened(Protocol):
    """The part of a driver that ends every capture."""

    def dark(self) -> None:
        """Put all light out and disarm."""


def steps_to_do(session: Session) -> list[Step]:
    """Return the steps that lack a frame of any camera, once each, in the plan's order."""
    found: dict[str, Step] = {}
    for step, _ in session.todo():
        found.setdefault(step.id, step)
    return list(found.values())


def attempts_so_far(session: Session) -> dict[tuple[str, str], int]:
    """Return the last attempt of each committed frame, by step and camera."""
    return {(record.step_id, record.camera): record.attempt for record in session.frames()}


def given_up(what: str, why: str, session: Session) -> AcquisitionError:
    """Return the error of a step that failed too often, with what to do about it."""
    safe = "what was captured is safe: mend the cause and run the same command with --resume"
    return AcquisitionError(
        f"{what}: failed {MAX_ATTEMPTS} times ({why}); "
        + (safe if session.frames() else "nothing was captured: mend the cause and start again")
    )


def tear_down(box: _Darkened, cameras: Mapping[str, Camera]) -> None:
    """Put the light out and let the cameras go; nothing here hides the error that led here."""
    try:
        box.dark()
    except DeviceError as error:
        # the box's own lease puts the light out when the host is not heard
        log.error("the box could not be told to go dark: %s; its lease ends the light", error)
    for camera in cameras.values():
        with contextlib.suppress(DeviceError):
            camera.abort()
