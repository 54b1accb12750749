"""One shot of the flash rig: its light set, its exposure made, its frames collected and kept."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from capture.acquire.frames import configure, encode, frame_timeout_s, wanted_exposure
from capture.acquire.outcome import Operator
from capture.devices.camera import Camera, CameraError, Exposure, Frame, Trigger, next_frame
from capture.devices.port import CommandRefused
from capture.plan import Step
from capture.rig import Rig
from capture.session import Session

CHARGE_TIMEOUT_S = 60.0
SHUTTER_PRESS_TIMEOUT_S = 60.0
"""How long a person has for pressing a shutter."""
MAX_TOKEN_CHARS = 48
"""Characters of the longest token that a box takes."""


class FlashReport(Protocol):
    """What the box says of a flash that it fired."""

    token: str
    t_box_s: float
    power: float
    polarizer: str
    analyser_deg: float


class Flash(Protocol):
    """The part of the flash driver that a capture needs."""

    @property
    def limits(self) -> Mapping[str, Any]:
        """What the box allows, in its own words and units."""

    def arm(self) -> None:
        """Allow light."""

    def set_polarizer(self, polarizer: str) -> None:
        """Turn the analyser to "parallel" or "crossed"."""

    def set_analyser(self, angle_deg: float) -> None:
        """Turn the analyser to an angle."""

    def set_sync_delay(self, seconds: float) -> None:
        """Set the time from the camera line to the pop."""

    def set_power(self, power: float) -> None:
        """Set the power, 0 to 1."""

    def wait_charged(self, timeout_s: float) -> None:
        """Wait until the packs are charged for the power that is set."""

    def fire(self, token: str) -> Any:
        """Fire once; a retry on the line never fires twice."""

    def ping(self) -> float:
        """Return the box's clock, s since its power-up."""

    def trigger_cameras(self, token: str) -> float:
        """Pulse the camera line without light."""

    def dark(self) -> None:
        """Put all light out and disarm."""


def expose(
    step: Step,
    rig: Rig,
    box: Flash,
    cameras: Mapping[str, Camera],
    operator: Operator,
    token: str,
    *,
    before: Callable[[], None] | None = None,
    meanwhile: Callable[[Any | None], None] | None = None,
) -> tuple[Any | None, dict[str, Frame], int]:
    """Set the cameras, make the exposure, and collect one frame a camera; the light is set.

    Parameters
    ----------
    step, rig, box, cameras, operator
        See `capture.acquire.flash.run.run_flash`.
    token
        Name of the flash.
    before
        Called when all is ready but the flash not armed; returns when the time has come.
    meanwhile
        Called with the box's report while the cameras read out.

    Returns
    -------
    report, frames, stale
        What the box says of the flash (None without one), the frames by view, and how many stale
        frames were dropped.
    """
    want = wanted_exposure(step)
    power = power_of(step)
    chosen = {name: cameras[name] for name in step.cameras}
    lit_by_box = power > 0
    triggers = {name: _parse_trigger(name, camera, lit_by_box) for name, camera in chosen.items()}
    asked: dict[str, Exposure] = {}
    not_before: dict[str, float] = {}
    for name, camera in chosen.items():
        configure(name, camera, want)
        asked[name] = want
        camera.arm(1, triggers[name])
        not_before[name] = camera.clock_s()
    if before is not None:
        before()
    for name, camera in chosen.items():
        if triggers[name] is Trigger.SOFTWARE:
            camera.fire()
    report = None
    if lit_by_box:
        # armed for this pop only: a read-out may outlast any lease
        box.arm()
        report = box.fire(token)
        box.dark()
    elif Trigger.EDGE in triggers.values():
        box.trigger_cameras(token)
    for name, camera in chosen.items():
        if triggers[name] is Trigger.HAND:
            operator.prompt(
                f"step {step.id}: press the shutter of camera {name} ({camera.info.serial}) once, "
                f"at {want.exposure_s:g} s and ISO {want.iso}, without any light; within "
                f"{SHUTTER_PRESS_TIMEOUT_S:g} s"
            )
    if meanwhile is not None:
        meanwhile(report)
    frames: dict[str, Frame] = {}
    stale = 0
    for name, camera in chosen.items():
        timeout_s = frame_timeout_s(step, rig.view(name))
        timeout_s += SHUTTER_PRESS_TIMEOUT_S if triggers[name] is Trigger.HAND else 0.0
        frames[name], dropped = next_frame(
            camera, seq=0, not_before_s=not_before[name], want=asked[name], timeout_s=timeout_s
        )
        stale += dropped
    return report, frames, stale


def _parse_trigger(name: str, camera: Camera, lit: bool) -> Trigger:
    """Return what releases a camera for a step: the box where there is light to meet."""
    known = camera.info.triggers
    if not lit:
        for trigger in (Trigger.SOFTWARE, Trigger.EDGE, Trigger.HAND):
            if trigger in known:
                return trigger
    if Trigger.EDGE not in known:
        # exposing on request would miss the flash: every lit frame would be dark
        raise CameraError(
            f"view {name!r}: the camera {camera.info.serial} cannot be released by the flash "
            "box's trigger line; release it from the box and let a tethering program write "
            "its files into a hot folder"
        )
    return Trigger.EDGE


def token_of(prefix: str, attempt: int, step: Step) -> str:
    """Name one flash: run, number in the run, try; then as much of the step as a box takes."""
    return f"{prefix}.{attempt}.{step.id}"[:MAX_TOKEN_CHARS]


def light_of(report: Any | None) -> dict[str, str | float]:
    """Which light made a frame: what the box acknowledged, not what was asked for."""
    if report is None:
        return {"light": "none", "power": 0.0}
    return {
        "light": "flash",
        "token": str(report.token),
        "power": float(report.power),
        "polarizer": str(report.polarizer),
        "analyser_deg": float(report.analyser_deg),
    }


def power_of(step: Step) -> float:
    """Return the power of a step's flash, 0 for none."""
    return 0.0 if step.kind == "dark" else float(step.settings.get("power", 1.0))


def set_light(step: Step, box: Flash) -> None:
    """Turn the analyser, set the power, and wait until the flash could pop."""
    power = power_of(step)
    if power > 0:
        if "analyser_deg" in step.settings:
            box.set_analyser(float(step.settings["analyser_deg"]))
        else:
            box.set_polarizer(str(step.settings["polarizer"]))
        box.set_power(power)
        box.wait_charged(CHARGE_TIMEOUT_S)


def let_go(step: Step, rig: Rig, cameras: Mapping[str, Camera], error: Exception) -> None:
    """Make the cameras of a step that failed ready for the next one."""
    for name in step.cameras:
        if isinstance(error, CommandRefused):
            # a misfire has pulsed the camera line: a dark frame is being read out, and
            # until it has come the camera would miss the next pulse
            with contextlib.suppress(CameraError):
                cameras[name].frame(frame_timeout_s(step, rig.view(name)))
        cameras[name].abort()


def keep(
    step: Step,
    rig: Rig,
    cameras: Mapping[str, Camera],
    session: Session,
    frames: Mapping[str, Frame],
    *,
    report: Any | None,
    tries: int,
    taken: Mapping[tuple[str, str], int],
    t_host_s: float,
    noted: Mapping[str, str | float | int] | None = None,
) -> None:
    """Commit the frames of a step with the light that made them, and what else was noted."""
    light = light_of(report)
    for name, frame in frames.items():
        blob = encode(frame, rig.view(name), cameras[name], step, session, light)
        session.commit(
            step.id,
            name,
            blob,
            settings=dict(step.settings),
            actual={
                "exposure_s": frame.exposure.exposure_s,
                "iso": frame.exposure.iso,
                "serial": frame.serial,
                "tries": tries,
                **light,
                **(noted or {}),
            },
            t_box_s=None if report is None else float(report.t_box_s),
            t_host_s=t_host_s,
            # a step of which only some cameras were kept is shot again with all of them
            attempt=taken.get((step.id, name), 0) + 1,
        )
