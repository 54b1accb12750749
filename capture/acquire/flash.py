"""Run a plan on the flash rig: one pop a step, its frame believed or the step shot again."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Mapping
from typing import Any, Protocol

from capture.acquire.frames import configure, encode, frame_timeout_s, wanted_exposure
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
from capture.devices.camera import (
    Camera,
    CameraError,
    Exposure,
    Frame,
    FrameRefused,
    FrameTimeout,
    Trigger,
    next_frame,
)
from capture.devices.port import CommandRefused
from capture.devices.wire import Code
from capture.plan import Plan, Step
from capture.rig import Rig
from capture.session import Session

log = logging.getLogger(__name__)

CHARGE_TIMEOUT_S = 60.0
HAND_S = 60.0
"""How long a person has for pressing a shutter."""
MAX_TOKEN = 48
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

    def trigger_cameras(self, token: str) -> float:
        """Pulse the camera line without light."""

    def dark(self) -> None:
        """Put all light out and disarm."""


def run_flash(
    plan: Plan,
    rig: Rig,
    *,
    box: Flash,
    cameras: Mapping[str, Camera],
    session: Session,
    operator: Operator,
) -> Acquired:
    """Capture what the session still lacks of a plan of the flash rig; see `run_plan`."""
    _check_limits(plan, box.limits)
    lag_s = _sync_delay_s(rig, box.limits)
    steps = steps_to_do(session)
    taken = attempts_so_far(session)
    counts = {"steps": 0, "frames": 0, "stale": 0, "retakes": 0}
    state: str | None = None
    try:
        box.dark()  # whatever was going on before
        if "sync_max_us" in box.limits:
            box.set_sync_delay(lag_s)
        for number, step in enumerate(steps, start=1):
            operator.stop_if_asked()
            wanted = step.index.get("state")
            if wanted is not None and wanted != state:
                state = str(wanted)
                operator.prompt(state)
            operator.progress(f"{number}/{len(steps)} {step.id} {step.kind} {_index_text(step)}")
            prefix = f"{operator.run_id}.{number}"
            _take(step, rig, box, cameras, session, taken, operator, counts, prefix)
    finally:
        tear_down(box, cameras)
    return Acquired(counts["steps"], counts["frames"], counts["stale"], counts["retakes"])


def _index_text(step: Step) -> str:
    return " ".join(f"{name}={value}" for name, value in step.index.items())


def _check_limits(plan: Plan, limits: Mapping[str, Any]) -> None:
    """Raise when a step asks for more than the box allows, before anything is sent."""
    low, high = float(limits.get("power_min", 0.0)), float(limits.get("power_max", 1.0))
    first = float(limits.get("analyser_min_deg", 0.0))
    last = float(limits.get("analyser_max_deg", 360.0))
    for step in plan.steps:
        power = float(step.settings.get("power", 1.0))
        if step.kind == "dark" or power == 0.0:
            continue
        if not low <= power <= high:
            raise AcquisitionError(
                f"step {step.id}: got power {power:g}, the box allows {low:g} to {high:g}; "
                "nothing was fired: change the plan"
            )
        angle_deg = float(step.settings.get("analyser_deg", first))
        if not first <= angle_deg <= last:
            raise AcquisitionError(
                f"step {step.id}: got analyser_deg {angle_deg:g}, the box allows {first:g} to "
                f"{last:g}; nothing was fired: change the plan"
            )


def _sync_delay_s(rig: Rig, limits: Mapping[str, Any]) -> float:
    """Return how long after the camera line the box must pop: when the last shutter is open."""
    lag_s = max((view.shutter_lag_s for view in rig.views), default=0.0)
    most_s = float(limits.get("sync_max_us", 0.0)) / 1e6
    if lag_s > most_s:
        raise AcquisitionError(
            f"shutter_lag_s: got {lag_s:g} s in the rig file, the box waits {most_s:g} s at most "
            "from camera line to pop; nothing was fired: every lit frame would be dark"
        )
    return lag_s


def _take(
    step: Step,
    rig: Rig,
    box: Flash,
    cameras: Mapping[str, Camera],
    session: Session,
    taken: Mapping[tuple[str, str], int],
    operator: Operator,
    counts: dict[str, int],
    prefix: str,
) -> None:
    """Take one step with all its cameras, or none: a step with one bad frame is shot again."""
    refusals: list[str] = []
    for attempt in range(1, MAX_ATTEMPTS + 1):
        try:
            token = _token(prefix, attempt, step)
            report, frames, stale = _expose(step, rig, box, cameras, operator, token)
        except (FrameRefused, FrameTimeout, CommandRefused) as error:
            if isinstance(error, CommandRefused) and error.code != Code.HARDWARE:
                raise
            log.warning("step %s, attempt %d: %s", step.id, attempt, error)
            refusals.append(str(error))
            counts["retakes"] += 1
            for name in step.cameras:
                if isinstance(error, CommandRefused):
                    # a misfire has pulsed the camera line: a dark frame is being read out, and
                    # until it has come the camera would miss the next pulse
                    with contextlib.suppress(CameraError):
                        cameras[name].frame(frame_timeout_s(step, rig.view(name)))
                cameras[name].abort()
            continue
        counts["stale"] += stale
        light = _light(report)
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
                    "tries": attempt,
                    **light,
                },
                t_box_s=None if report is None else float(report.t_box_s),
                t_host_s=operator.clock(),
                # a step of which only some cameras were kept is shot again with all of them
                attempt=taken.get((step.id, name), 0) + 1,
            )
            counts["frames"] += 1
        counts["steps"] += 1
        return
    raise given_up(f"step {step.id}", refusals[-1], session)


def _expose(
    step: Step,
    rig: Rig,
    box: Flash,
    cameras: Mapping[str, Camera],
    operator: Operator,
    token: str,
) -> tuple[Any | None, dict[str, Frame], int]:
    """Set the light and the cameras, make the exposure, and collect one frame a camera."""
    want = wanted_exposure(step)
    power = 0.0 if step.kind == "dark" else float(step.settings.get("power", 1.0))
    if power > 0:
        if "analyser_deg" in step.settings:
            box.set_analyser(float(step.settings["analyser_deg"]))
        else:
            box.set_polarizer(str(step.settings["polarizer"]))
        box.set_power(power)
        box.wait_charged(CHARGE_TIMEOUT_S)
    chosen = {name: cameras[name] for name in step.cameras}
    lit_by_box = power > 0
    triggers = {name: _trigger(name, camera, lit_by_box) for name, camera in chosen.items()}
    asked: dict[str, Exposure] = {}
    not_before: dict[str, float] = {}
    for name, camera in chosen.items():
        configure(name, camera, want)
        asked[name] = want
        camera.arm(1, triggers[name])
        not_before[name] = camera.clock_s()
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
                f"{HAND_S:g} s"
            )
    frames: dict[str, Frame] = {}
    stale = 0
    for name, camera in chosen.items():
        timeout_s = frame_timeout_s(step, rig.view(name))
        timeout_s += HAND_S if triggers[name] is Trigger.HAND else 0.0
        frames[name], dropped = next_frame(
            camera, seq=0, not_before_s=not_before[name], want=asked[name], timeout_s=timeout_s
        )
        stale += dropped
    return report, frames, stale


def _trigger(name: str, camera: Camera, lit: bool) -> Trigger:
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


def _token(prefix: str, attempt: int, step: Step) -> str:
    """Name one flash: run, number in the run, try; then as much of the step as a box takes."""
    return f"{prefix}.{attempt}.{step.id}"[:MAX_TOKEN]


def _light(report: Any | None) -> dict[str, str | float]:
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
