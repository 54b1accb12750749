"""Take one shot of the flash rig: set the light, expose, collect and keep the frames."""

import contextlib
from collections.abc import Mapping

from capture.acquire.frames import arm_cameras, collect_frames, frame_timeout_s, requested_exposure
from capture.acquire.outcome import CaptureRun, require_trigger_line
from capture.devices.camera import Camera, CameraError, Frame, FrameRefused, FrameTimeout, Trigger
from capture.devices.flash import FlashBox, FlashReport
from capture.devices.port import CommandRefused
from capture.devices.wire import Code
from capture.plan import Step, Value
from capture.plan.led_bands import parse_led

CHARGE_TIMEOUT_S = 60.0
SHUTTER_PRESS_TIMEOUT_S = 60.0
"""Time in which a person has to press a shutter, s."""
MAX_TOKEN_CHARS = 48
"""Maximum length of a token that a controller accepts."""
STOP_READING_DEG: Mapping[str, float] = {"parallel": 0.0, "crossed": 90.0}
MAX_POWER_ROUNDING = 1e-8
MAX_READING_ROUNDING_DEG = 1e-3
"""Digits of the controller's report."""


class ShotTiming:
    """Timing of one shot: before it, at it, and during readout; this one is immediate."""

    def __init__(self, step: Step, box: FlashBox) -> None:
        self.step, self.box = step, box
        self.noted: Mapping[str, Value] = {}

    def prepare(self) -> None:
        """Set the light of the shot."""
        set_light(self.step, self.box)

    def wait(self) -> None:
        """Wait until the shot is due; everything is ready, but the flash is not armed."""

    def use_readout_time(self, report: FlashReport | None) -> None:
        """Use the time of the readout; ``report`` is the controller's report of the flash."""


def shoot(run: CaptureRun, timing: ShotTiming, prefix: str, attempt: int) -> str:
    """Take a step with all its cameras and keep it, or none: one bad frame invalidates the step.

    Parameters
    ----------
    run
        The run.
    moment
        The step, its controller and its time.
    prefix
        First part of the token of the flash: the run, and the number in the run.
    attempt
        Number of this attempt at the step, from 1.

    Returns
    -------
    str
        Reason to repeat the step; empty when it is kept.
    """
    step = timing.step
    try:
        timing.prepare()
        # run, number in the run, attempt; then as much of the step's id as the controller accepts
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
    """Set the cameras, expose, and collect one frame per camera; the light is set."""
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
        # armed for this flash only: a readout may last longer than any lease
        box.arm()
        report = box.fire(token)
        box.dark()
        check_report(step, token, report)
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


def check_report(step: Step, token: str, report: FlashReport) -> None:
    """Refuse a flash whose report by the controller differs from what the step requests.

    Raises
    ------
    FrameRefused
        When token, LED, power, polarizer or analyzer reading differ.
    """
    power, led = flash_power(step), step_led(step) or "the flash tube"
    lit = report.led or "the flash tube"
    stop = str(step.settings["polarizer"])
    at_stop = "analyzer_deg" not in step.settings
    reading_deg = STOP_READING_DEG[stop] if at_stop else float(step.settings["analyzer_deg"])
    checks = (
        ("token", report.token, token, report.token == token),
        ("light", lit, led, lit == led),
        ("power", report.power, power, abs(report.power - power) <= MAX_POWER_ROUNDING),
        ("polarizer", report.polarizer, stop, report.polarizer == stop or not at_stop),
        (
            *("analyzer_deg", report.analyzer_deg, reading_deg),
            abs(report.analyzer_deg - reading_deg) <= MAX_READING_ROUNDING_DEG,
        ),
    )
    for name, got, wanted, same in checks:
        if not same:
            raise FrameRefused(f"flash of step {step.id}: {name} {got}, expected {wanted}")


def _choose_trigger(name: str, camera: Camera, lit: bool) -> Trigger:
    """Return the trigger of a camera for a step: the controller, when light is synchronized."""
    if not lit:
        for trigger in (Trigger.SOFTWARE, Trigger.EDGE, Trigger.HAND):
            if trigger in camera.info.triggers:
                return trigger
    # an exposure on request would miss the flash: every lit frame would be dark
    why = (
        "flash controller's trigger line; release it from the controller and let a tethering "
        "program write its files into a hot folder"
    )
    require_trigger_line(name, camera, why)
    return Trigger.EDGE


def _describe_light(report: FlashReport | None) -> dict[str, Value]:
    """Return the light of a frame: as acknowledged by the controller, not as requested."""
    if report is None:
        return {"light": "none", "power": 0.0}
    return {
        "light": str(report.led or "flash"),
        "token": str(report.token),
        "power": float(report.power),
        "polarizer": str(report.polarizer),
        "analyzer_deg": float(report.analyzer_deg),
    }


def flash_power(step: Step) -> float:
    """Return the power of a step's flash, 0 for none."""
    return 0.0 if step.kind == "dark" else float(step.settings.get("power", 1.0))


def step_led(step: Step) -> str:
    """Return the name of a step's LED, empty for the flash tube."""
    return str(step.settings.get("light", ""))


def set_light(step: Step, box: FlashBox) -> None:
    """Turn the analyzer, set the power, and wait until a flash is possible."""
    power = flash_power(step)
    if power > 0:
        if "analyzer_deg" in step.settings:
            box.set_analyzer(float(step.settings["analyzer_deg"]))
        else:
            box.set_polarizer(str(step.settings["polarizer"]))
        box.set_power(power)
        if led := step_led(step):
            box.set_led(*parse_led(led))
        box.wait_charged(CHARGE_TIMEOUT_S)


def _abort_cameras(run: CaptureRun, step: Step, error: Exception) -> None:
    """Prepare the cameras of a failed step for the next one."""
    for name, camera in run.step_cameras(step).items():
        if isinstance(error, CommandRefused):
            # A misfire has pulsed the camera line: a dark frame is being read out, and until it has
            # come the camera would miss the next pulse.
            with contextlib.suppress(CameraError):
                camera.frame(frame_timeout_s(step, run.rig.view(name)))
        camera.abort()
