"""Cameras set as a step wants them, and their frames as files of a session."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from capture import raw
from capture.devices.camera import Camera, CameraError, Exposure, Frame
from capture.plan import Step
from capture.rig import View
from capture.session import Session

FRAME_MARGIN_S = 5.0
"""How much longer than exposure and read-out a frame may take to come."""


def wanted_exposure(step: Step) -> Exposure:
    """Return the exposure that a step asks for."""
    return Exposure(float(step.settings["exposure_s"]), int(step.settings["iso"]))


def configure(name: str, camera: Camera, want: Exposure) -> None:
    """Set the camera of view ``name``; raise where it is off by more than a third of a stop."""
    got = camera.configure(want)
    if abs(got.deviation_ev(want)) > 1.0 / 3.0 + 1e-9:
        raise CameraError(
            f"view {name!r}: the camera sets {got.exposure_s:g} s at ISO {got.iso}, the plan "
            f"wants {want.exposure_s:g} s at ISO {want.iso}; choose settings it has"
        )


def frame_timeout_s(step: Step, view: View) -> float:
    """Return how long a step's frame may take to come, s."""
    return float(step.settings["exposure_s"]) + view.readout_s + FRAME_MARGIN_S


def encode(
    frame: Frame,
    view: View,
    camera: Camera,
    step: Step,
    session: Session,
    light: Mapping[str, str | float],
) -> bytes:
    """Encode a frame as our DNG, with the step and the light in it."""
    if isinstance(frame.image, bytes):
        # a maker's raw file is written anew: its own metadata can name people and places
        picture = raw.decode(memoryview(frame.image), where=f"step {step.id}, view {view.name}")
        cfa, pattern, black, white = picture.cfa, picture.pattern, picture.black, picture.white
        matrix, profile, neutral = picture.color_matrix, picture.noise_profile, picture.neutral
    else:
        info = camera.info
        cfa, pattern, black, white = frame.image, info.pattern, info.black, info.white
        matrix, neutral = None, None
        profile = raw.noise_profile(
            view.gain_e_per_dn,
            view.read_noise_e,
            black=float(np.mean(info.black)),
            white=float(info.white),
        )
    return raw.encode_dng(
        cfa,
        pattern=pattern,
        black=black,
        white=white,
        exposure_s=frame.exposure.exposure_s,
        iso=frame.exposure.iso,
        camera_model=camera.info.model,
        camera_serial=frame.serial,
        color_matrix=matrix,
        neutral=neutral,
        noise_profile=profile,
        f_number=view.f_number,
        focal_mm=view.focal_mm,
        step_id=step.id,
        session_id=session.id,
        light=light,
    )
