"""Set cameras for a step, and describe their frames for the files of a session."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from capture import raw
from capture.devices.camera import Camera, CameraError, Exposure, Frame, Trigger, next_frame
from capture.plan import Step, Value
from capture.rig import View
from capture.session import Session

FRAME_MARGIN_S = 5.0
"""Largest delay of a frame beyond exposure and readout, s."""


def requested_exposure(step: Step) -> Exposure:
    """Return the exposure that a step requests."""
    return Exposure(float(step.settings["exposure_s"]), int(step.settings["iso"]))


def configure_camera(name: str, camera: Camera, want: Exposure) -> None:
    """Set the camera of view ``name``; reject a deviation of more than a third of a stop."""
    got = camera.configure(want)
    if abs(got.deviation_ev(want)) > 1.0 / 3.0 + 1e-9:
        raise CameraError(
            f"view {name!r}: the camera sets {got.exposure_s:g} s at ISO {got.iso}, the plan "
            f"needs {want.exposure_s:g} s at ISO {want.iso}; choose settings that the camera has"
        )


def arm_cameras(
    cameras: Mapping[str, Camera], want: Exposure, triggers: Mapping[str, Trigger]
) -> dict[str, float]:
    """Set cameras and arm each for one frame; return the arming times, s, by view."""
    armed_s = {}
    for name, camera in cameras.items():
        configure_camera(name, camera, want)
        camera.arm(1, triggers[name])
        armed_s[name] = camera.clock_s()
    return armed_s


def collect_frames(
    cameras: Mapping[str, Camera],
    want: Exposure,
    armed_s: Mapping[str, float],
    timeouts_s: Mapping[str, float],
) -> tuple[dict[str, Frame], int]:
    """Return one accepted frame per camera, by view, and the number of stale ones dropped."""
    frames, stale = {}, 0
    for name, camera in cameras.items():
        frames[name], dropped = next_frame(
            camera, seq=0, not_before_s=armed_s[name], want=want, timeout_s=timeouts_s[name]
        )
        stale += dropped
    return frames, stale


def frame_timeout_s(step: Step, view: View) -> float:
    """Return the timeout of a step's frame, s."""
    return float(step.settings["exposure_s"]) + view.readout_s + FRAME_MARGIN_S


def describe_step_frame(
    frame: Frame,
    view: View,
    camera: Camera,
    step: Step,
    session: Session,
    light: Mapping[str, Value],
    color: raw.CameraColor | None = None,
) -> raw.RawFrame:
    """Return a frame for encoding, with its step, its light and the camera's color.

    A raw file with a color matrix of its own keeps it.
    """
    info = camera.info
    if isinstance(frame.image, bytes):
        # a foreign raw file is encoded again, because its own metadata can name people and places
        where = f"step {step.id}, view {view.name}"
        picture = raw.decode(memoryview(frame.image), where=where)
    else:
        black, white = float(np.mean(info.black)), float(info.white)
        noise = raw.noise_profile(view.gain_e_per_dn, view.read_noise_e, black=black, white=white)
        picture = raw.RawFrame(
            cfa=frame.image,
            pattern=info.pattern,
            black=tuple(map(float, info.black)),
            white=int(info.white),
            noise_profile=noise,
            step_id=step.id,
        )
    if color is not None and picture.pattern != "MONO" and picture.color_matrix is None:
        picture = replace(
            picture, color_matrix=color.matrix, color_illuminant="D65", neutral=color.neutral
        )
    return replace(
        picture,
        exposure_s=frame.exposure.exposure_s,
        iso=frame.exposure.iso,
        camera_model=info.model,
        camera_serial=frame.serial,
        f_number=view.f_number,
        focal_mm=view.focal_mm,
        captured_at=None,
        step_id=step.id,
        session_id=session.id,
        light=light,
    )
