"""Estimate the head's motion during a dome session, and select the usable images."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from capture import raw
from capture.calibration.geometry import CameraPose
from capture.session import Session
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.pipeline.dome.images import DomeImage, DomeImages
from reconstruction.pipeline.inputs import InputsError
from reconstruction.registration import head_motion
from reconstruction.scan.mesh import RefinedScan

TRACKED_POINTS: Final = 6_000
MAX_STILL_MOTION_PX: Final = 0.15
"""Motion, in image pixels, below which the head counts as still."""


class HalfResolutionCamera:
    """Camera model for images with one pixel per 2 x 2 cell of the sensor."""

    def __init__(self, camera: CameraPose) -> None:
        self._camera = camera
        self.center_mm = camera.center_mm

    def project(self, points_mm: FloatArray) -> Float64Array:
        """Project points to column and row in pixels of the images."""
        return DomeImage.from_sensor_px(self._camera.project(points_mm))


@dataclass(frozen=True, slots=True, eq=False)
class DomeHeadMotion:
    """Pose of the head in each image.

    Attributes
    ----------
    poses
        (N, 4, 4): transforms points from the head's mean pose to the pose in each image.
    usable
        (N,) bool; False where the face moved non-rigidly.
    head
        The motion in the tracking frames.
    displacement_mm
        Root mean square displacement of the face's points from their mean position, (N,).
    """

    poses: Float64Array
    usable: BoolArray
    head: head_motion.HeadMotion
    displacement_mm: Float64Array
    still: bool
    """Whether the motion is below `MAX_STILL_MOTION_PX`: exposures are merged, poses ignored."""

    def record(self) -> dict[str, Any]:
        """Return the motion for the record of the maps, as JSON values."""
        return {
            "tracking_frames": len(self.head.times_s),
            "displacement_mm_max": float(self.displacement_mm.max(initial=0.0)),
            "displacement_mm_median": float(np.median(self.displacement_mm)),
            "images_left_out": int(np.count_nonzero(~self.usable)),
            "still": self.still,
        }


def follow_head(
    session: Session,
    images: DomeImages,
    cameras: Sequence[CameraPose],
    surface: RefinedScan,
    pixel_mm: float,
) -> DomeHeadMotion | None:
    """Estimate the head's motion from a session's tracking frames.

    Parameters
    ----------
    session
        Of the dome.
    images
        Its images, with separate exposures.
    cameras
        Calibrated, in the order of ``images.views``.
    surface
        The scan in the head's mean pose.
    pixel_mm
        Size of an image's pixel on the subject.

    Returns
    -------
    DomeHeadMotion or None
        One row for each of ``images.captures``; None where fewer than two tracking frames are
        complete over all views.
    """
    by_step: dict[str, dict[str, Any]] = {}
    for record in session.frames("tracking"):
        by_step.setdefault(record.step_id, {})[record.camera] = record
    whole = [shots for shots in by_step.values() if set(images.views) <= set(shots)]
    if len(whole) < 2:
        return None
    times = np.array([_time_s(shots[images.views[0]]) for shots in whole])
    order = np.argsort(times)
    frames = [[_gray(session, whole[k][view]) for view in images.views] for k in order]
    light = [_light(whole[k][images.views[0]]) for k in order]
    step = max(1, len(surface.points_mm) // TRACKED_POINTS)
    points = surface.points_mm[::step].astype(np.float64)
    found = head_motion.estimate(
        frames,
        [HalfResolutionCamera(camera) for camera in cameras],
        points,
        surface.normals[::step].astype(np.float64),
        times[order],
        light=light,
        reference=len(order) // 2,
    )
    when = np.array([np.mean(images.times_s(images.views[0], *key)) for key in images.captures])
    if not found.usable.any():
        raise InputsError(
            f"{session.path}: the head was found in no tracking frame, expected at least one; "
            "check that the scan is of this subject and that the cameras are calibrated "
            "[SR-REC-011]"
        )
    # the scan was registered to all images jointly, so it is in the head's mean pose
    turn, shift = found.interpolate(when)
    mean = np.eye(4)
    mean[:3, :3] = head_motion.rotation_matrix(turn.mean(axis=0))
    mean[:3, 3] = shift.mean(axis=0)
    poses = found.matrices(when) @ np.linalg.inv(mean)
    moved = np.einsum("nij,pj->npi", poses[:, :3, :3], points) + poses[:, None, :3, 3] - points
    apart = np.sqrt(np.mean(np.sum(moved**2, axis=-1), axis=-1))
    usable = found.is_covered(when)
    still = bool(usable.all() and apart.max(initial=0.0) < MAX_STILL_MOTION_PX * pixel_mm)
    if not usable.any():
        raise InputsError(
            f"{session.path}: got no image between two tracking frames with a known head pose, "
            "expected at least one; capture again, with the face at rest"
        )
    return DomeHeadMotion(poses, usable, found, apart, still)


def _time_s(record: Any) -> float:
    time = record.line.t_box_s
    if time is None:
        raise InputsError(f"{record.file}: lacks the time of its light; capture it again")
    return float(time)


def _gray(session: Session, record: Any) -> Float32Array:
    """Return a tracking frame over its light, as levels and exposures differ between frames."""
    frame = session.read(record)
    image = raw.linear_rgb(frame, demosaic="centered")
    return np.asarray(image.rgb.mean(axis=-1) / _light(record), np.float32)


def _light(record: Any) -> float:
    """Return the level of the LEDs times the exposure time."""
    level, exposure_s = (float(record.settings.get(key, 1.0)) for key in ("level", "exposure_s"))
    return max(level * exposure_s, 1e-9)
