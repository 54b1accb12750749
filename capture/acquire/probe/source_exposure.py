"""One exposure of the probe: light through the source fibre, and the frame that it made.

The shutter pulses the camera's line when its blades are clear and ends the light by itself. A frame
is believed when it began with that pulse and has the exposure that was asked for, and when the
shutter says that its light lasted as long.
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
"""Silence between two renewals of the lease while nothing but time is waited for."""
FRAME_TIMEOUT_S = 3.0
"""How long a frame may take after its read-out, s: the box waits a little longer for its host."""
SHUTTER_REPORT_TIMEOUT_S = 0.2
"""How long the end of an opening may take to be told, s."""
MAX_SHUTTER_DEVIATION = 0.02
"""How far the light's time may be off what was asked for, relative; a fibre's light is as much."""
SHUTTER_MARGIN_S = 5e-5
"""And beyond that, s: of the shortest exposure this is within a stop's twentieth."""


class ShutterFault(FrameRefused):
    """The shutter did not let light through for as long as it was asked to."""


@dataclass(frozen=True, slots=True)
class SourceExposure:
    """One exposure that is believed, one frame a camera."""

    step: Step
    frames: Mapping[str, Frame]
    t_box_s: float
    """When the cameras were released, on the box's clock."""
    open_s: float
    """How long the light lasted, s; 0 in the dark."""


def expose_dark(run: CaptureRun, box: ProbeBox, step: Step, *, token: str) -> SourceExposure:
    """Expose without light; see `expose`."""
    return _expose(run, box, step, lambda: (box.trigger_camera(token), 0.0))


def expose(run: CaptureRun, box: ProbeBox, step: Step) -> SourceExposure:
    """Open the shutter once, and collect one frame a camera.

    Raises
    ------
    FrameRefused, FrameTimeout
        Where a frame is not believed or does not come; it can be tried again.
    HeadLost
        Where the box has let go of the head meanwhile.
    CommandRefused
        Where the box forbids it for another reason.
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
                raise HeadLost("the box did not hold the head") from error
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
    """Wait until the shutter has closed and return how long its light lasted, s."""
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
    return open_s


def recover_shutter(box: ProbeBox, step: Step) -> None:
    """Try to close a shutter that is stuck, and to light the LED again that was put out for it."""
    try:
        box.close_shutter()
        box.set_level(float(step.settings["level"]))
    except CommandRefused as error:
        if error.code != Code.HARDWARE:
            raise HeadLost("the box had let go of the head") from error


def readout_s(run: CaptureRun, step: Step) -> float:
    """Return the longest read-out of a step's cameras, s."""
    return max(run.rig.view(name).readout_s for name in step.cameras)


def _expose(
    run: CaptureRun, box: ProbeBox, step: Step, release: Callable[[], tuple[float, float]]
) -> SourceExposure:
    want, chosen = requested_exposure(step), run.step_cameras(step)
    armed_s = arm_cameras(chosen, want, dict.fromkeys(chosen, Trigger.EDGE))
    t_box_s, open_s = release()
    # the lease is renewed up to the moment at which the frame should be there
    dark_s = 0.0 if open_s else want.exposure_s
    box.listen(dark_s + readout_s(run, step), every_s=LEASE_RENEWAL_S)
    frames, stale = collect_frames(chosen, want, armed_s, dict.fromkeys(chosen, FRAME_TIMEOUT_S))
    run.stale += stale
    return SourceExposure(step, frames, t_box_s, open_s)
