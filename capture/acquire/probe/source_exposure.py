"""Make one exposure of the probe: light through the source fiber, and the resulting frame.

The shutter pulses the camera line when its blades are clear, and closes at the end of its time. A
frame is accepted when it began with that pulse and has the requested exposure, and when the
reported opening of the shutter lasted as long.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from capture.acquire.frames import arm_cameras, collect_frames, requested_exposure
from capture.acquire.outcome import CaptureRun
from capture.acquire.probe.head import HeadLost
from capture.devices.camera import Frame, FrameRefused, Trigger
from capture.devices.port import CommandRefused
from capture.devices.probe import ProbeBox, ShutterOpening
from capture.devices.wire import Code
from capture.plan import Step

LEASE_RENEWAL_S = 1.0
"""Interval between two renewals of the lease while waiting, s."""
FRAME_TIMEOUT_S = 3.0
"""Delay of a frame after its readout, s: the controller waits slightly longer for its host."""
SHUTTER_REPORT_TIMEOUT_S = 0.2
"""Delay of the report of a shutter's end, s."""
MAX_SHUTTER_DEVIATION = 0.02
"""Relative tolerance of the light's duration; a fiber's light has the same tolerance."""
SHUTTER_MARGIN_S = 5e-5
"""Additional tolerance, s: a twentieth of a stop of the shortest exposure."""


class ShutterFault(FrameRefused):
    """Raised when the shutter was not open for the requested time."""


@dataclass(frozen=True, slots=True)
class SourceExposure:
    """One accepted exposure, with one frame per camera."""

    step: Step
    frames: Mapping[str, Frame]
    t_box_s: float
    """Time of the cameras' release, on the controller's clock."""
    open_s: float
    """Duration of the light, s; 0 in the dark."""


def expose_dark(run: CaptureRun, box: ProbeBox, step: Step, *, token: str) -> SourceExposure:
    """Expose without light; see `expose`."""
    return _expose(run, box, step, lambda: (box.trigger_camera(token), 0.0))


def expose(run: CaptureRun, box: ProbeBox, step: Step) -> SourceExposure:
    """Open the shutter once, and collect one frame per camera.

    Raises
    ------
    FrameRefused, FrameTimeout
        When a frame is not accepted or does not come; it can be repeated.
    HeadLost
        When the controller has released the head meanwhile.
    CommandRefused
        When the controller refuses it for another reason.
    """
    seconds = float(step.settings["exposure_s"])

    def release() -> tuple[float, float]:
        try:
            opening = box.open_shutter(seconds)
        except CommandRefused as error:
            if error.code == Code.HARDWARE:
                recover_shutter(box, step)
                raise ShutterFault(str(error)) from error
            if error.code in (Code.WATCHDOG_TRIPPED, Code.NOT_ARMED, Code.IGNORED):
                raise HeadLost("the controller did not hold the head") from error
            raise
        try:
            return opening.t_open_s, _light_s(step, box, opening)
        except (ShutterFault, HeadLost):
            # the camera still exposes or reads out, and would miss the next pulse
            over_s = opening.t_open_s + seconds + readout_s(run, step) + SHUTTER_REPORT_TIMEOUT_S
            box.listen(over_s - box.ping(), every_s=LEASE_RENEWAL_S)
            raise

    return _expose(run, box, step, release)


def _light_s(step: Step, box: ProbeBox, opening: ShutterOpening) -> float:
    """Wait until the shutter has closed and return the duration of its light, s."""
    seconds = float(step.settings["exposure_s"])
    box.listen(seconds, every_s=LEASE_RENEWAL_S)
    last = box.last_opening()
    waited_s = 0.0
    while last is not None and last.ended == "open" and waited_s < SHUTTER_REPORT_TIMEOUT_S:
        box.listen(SHUTTER_REPORT_TIMEOUT_S / 10.0)
        waited_s += SHUTTER_REPORT_TIMEOUT_S / 10.0
        last = box.last_opening()
    ended = "not at all" if last is None or last.number != opening.number else last.ended
    if last is None or ended != "timed":
        if ended in ("pump", "interlock", "dark"):
            raise HeadLost("the suction failed while the shutter was open")
        recover_shutter(box, step)
        raise ShutterFault(f"the shutter closed as {ended!r} instead of by its own end")
    open_s = last.t_shut_s - last.t_open_s
    if abs(open_s - seconds) > MAX_SHUTTER_DEVIATION * seconds + SHUTTER_MARGIN_S:
        raise ShutterFault(f"the shutter was open for {open_s:g} s, expected {seconds:g} s")
    level, steps = box.level(), int(box.limits["level_steps"])
    if round(steps * level) != round(steps * (wanted := float(step.settings["level"]))):
        recover_shutter(box, step)
        raise ShutterFault(f"the source was at level {level:g}, expected {wanted:g}")
    return open_s


def recover_shutter(box: ProbeBox, step: Step) -> None:
    """Try to close a stuck shutter, and to light again the LED that was switched off for it."""
    try:
        box.close_shutter()
        box.set_level(float(step.settings["level"]))
    except CommandRefused as error:
        if error.code != Code.HARDWARE:
            raise HeadLost("the controller had released the head") from error


def readout_s(run: CaptureRun, step: Step) -> float:
    """Return the longest readout of a step's cameras, s."""
    return max(run.rig.view(name).readout_s for name in step.cameras)


def _expose(
    run: CaptureRun, box: ProbeBox, step: Step, release: Callable[[], tuple[float, float]]
) -> SourceExposure:
    want, chosen = requested_exposure(step), run.step_cameras(step)
    armed_s = arm_cameras(chosen, want, dict.fromkeys(chosen, Trigger.EDGE))
    t_box_s, open_s = release()
    # the lease is renewed until the frame is due
    dark_s = 0.0 if open_s else want.exposure_s
    box.listen(dark_s + readout_s(run, step), every_s=LEASE_RENEWAL_S)
    frames, stale = collect_frames(chosen, want, armed_s, dict.fromkeys(chosen, FRAME_TIMEOUT_S))
    run.stale += stale
    return SourceExposure(step, frames, t_box_s, open_s)
