"""One shot of the flash rig: its light set, its exposure made, its frames collected and kept."""

import contextlib
from collections.abc import Mapping

from capture.acquire.frames import arm_cameras, collect_frames, frame_timeout_s, requested_exposure
from capture.acquire.outcome import CaptureRun, require_trigger_line
from capture.devices.camera import Camera, CameraError, Frame, FrameRefused, FrameTimeout, Trigger
from capture.devices.flash import FlashBox, FlashReport
from capture.devices.port import CommandRefused
from capture.devices.wire import Code
from capture.plan import Step, Value

CHARGE_TIMEOUT_S = 60.0
SHUTTER_PRESS_TIMEOUT_S = 60.0
"""How long a person has for pressing a shutter."""
MAX_TOKEN_CHARS = 48
"""Characters of the longest token that a box takes."""


class ShotTiming:
    """One shot's time: before it, at it, and while the cameras read out; here at once."""

    def __init__(self, step: Step, box: FlashBox) -> None:
        self.step, self.box = step, box
        self.noted: Mapping[str, Value] = {}

    def prepare(self) -> None:
        """Set the light of the shot."""
        set_light(self.step, self.box)

    def wait(self) -> None:
        """Wait until the shot is due; all is ready but the flash not armed."""

    def use_readout_time(self, report: FlashReport | None) -> None:
        """Use the time while the cameras read out; the report is what the box says of the flash."""


def shoot(run: CaptureRun, timing: ShotTiming, prefix: str, attempt: int) -> str:
    """Take a step with all its cameras and keep it, or none: one bad frame spoils the step.

    Parameters
    ----------
    run
        The run.
    moment
        The step, its box and its time.
    prefix
        Begins the name of the flash: the run, and the number in the run.
    attempt
        How often the step is tried, this time included.

    Returns
    -------
    str
        Why the step can be tried again; nothing where it is kept.
    """
    step = timing.step
    try:
        timing.prepare()
        # run, number in the run, try; then as much of the step as a box takes
        token = f"{prefix}.{attempt}.{step.id}"[:MAX_TOKEN_CHARS]
        report, frames = _expose(run, timing, token)
    except (FrameRefused, FrameTimeout, CommandRefused) as error:
        if isinstance(error, CommandRefused) and error.code != Code.HARDWARE:
            raise
        why = run.note_retake(step, attempt, error)
        _abort_cameras(run, step, error)
        return why
    light = _describe_light(report)
    run.commit_frames(
        step,
        frames,
        light=light,
        tries=attempt,
        t_box_s=None if report is None else float(report.t_box_s),
        journal_entries={**light, **timing.noted},
    )
    return ""


def _expose(
    run: CaptureRun, timing: ShotTiming, token: str
) -> tuple[FlashReport | None, dict[str, Frame]]:
    """Set the cameras, make the exposure, and collect one frame a camera; the light is set."""
    step, box = timing.step, timing.box
    want, chosen = requested_exposure(step), run.step_cameras(step)
    lit = flash_power(step) > 0
    triggers = {name: _choose_trigger(name, camera, lit) for name, camera in chosen.items()}
    armed_s = arm_cameras(chosen, want, triggers)
    timing.wait()
    for name, camera in chosen.items():
        if triggers[name] is Trigger.SOFTWARE:
            camera.fire()
    report = None
    if lit:
        # armed for this pop only: a read-out may outlast any lease
        box.arm()
        report = box.fire(token)
        box.dark()
    elif Trigger.EDGE in triggers.values():
        box.trigger_cameras(token)
    timeouts_s = {name: frame_timeout_s(step, run.rig.view(name)) for name in chosen}
    for name, camera in chosen.items():
        if triggers[name] is Trigger.HAND:
            timeouts_s[name] += SHUTTER_PRESS_TIMEOUT_S
            run.operator.prompt(
                f"step {step.id}: press the shutter of camera {name} ({camera.info.serial}) once, "
                f"at {want.exposure_s:g} s and ISO {want.iso}, without any light; within "
                f"{SHUTTER_PRESS_TIMEOUT_S:g} s"
            )
    timing.use_readout_time(report)
    frames, stale = collect_frames(chosen, want, armed_s, timeouts_s)
    run.stale += stale
    return report, frames


def _choose_trigger(name: str, camera: Camera, lit: bool) -> Trigger:
    """Return what releases a camera for a step: the box where there is light to meet."""
    if not lit:
        for trigger in (Trigger.SOFTWARE, Trigger.EDGE, Trigger.HAND):
            if trigger in camera.info.triggers:
                return trigger
    # exposing on request would miss the flash: every lit frame would be dark
    why = (
        "flash box's trigger line; release it from the box and let a tethering program write "
        "its files into a hot folder"
    )
    require_trigger_line(name, camera, why)
    return Trigger.EDGE


def _describe_light(report: FlashReport | None) -> dict[str, Value]:
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


def flash_power(step: Step) -> float:
    """Return the power of a step's flash, 0 for none."""
    return 0.0 if step.kind == "dark" else float(step.settings.get("power", 1.0))


def set_light(step: Step, box: FlashBox) -> None:
    """Turn the analyser, set the power, and wait until the flash could pop."""
    power = flash_power(step)
    if power > 0:
        if "analyser_deg" in step.settings:
            box.set_analyzer(float(step.settings["analyser_deg"]))
        else:
            box.set_polarizer(str(step.settings["polarizer"]))
        box.set_power(power)
        box.wait_charged(CHARGE_TIMEOUT_S)


def _abort_cameras(run: CaptureRun, step: Step, error: Exception) -> None:
    """Make the cameras of a step that failed ready for the next one."""
    for name, camera in run.step_cameras(step).items():
        if isinstance(error, CommandRefused):
            # a misfire has pulsed the camera line: a dark frame is being read out, and
            # until it has come the camera would miss the next pulse
            with contextlib.suppress(CameraError):
                camera.frame(frame_timeout_s(step, run.rig.view(name)))
        camera.abort()
