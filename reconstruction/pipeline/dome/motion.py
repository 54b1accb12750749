"""How the head moved during a dome session, and which images that leaves usable."""

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
"""Motion, in pixels of an image, below which the head counts as still."""


class HalfResolutionCamera:
    """A camera seen through images of one pixel for each 2 x 2 cell of its sensor."""

    def __init__(self, camera: CameraPose) -> None:
        self._camera = camera
        self.center_mm = camera.center_mm

    def project(self, points_mm: FloatArray) -> Float64Array:
        """Return column and row in pixels of the images."""
        return DomeImage.from_sensor_px(self._camera.project(points_mm))


@dataclass(frozen=True, slots=True, eq=False)
class DomeHeadMotion:
    """Where the head was in each image.

    Attributes
    ----------
    poses
        (N, 4, 4): take points from the head's mean place to where they were.
    usable
        (N,) bool; False while the face moved otherwise than as a whole.
    head
        The motion in the tracking frames.
    displacement_mm
        How far the face's points were from their mean place, root mean square, (N,).
    """

    poses: Float64Array
    usable: BoolArray
    head: head_motion.HeadMotion
    displacement_mm: Float64Array
    still: bool
    """Whether the head hardly moved: then exposures can be merged and poses ignored."""

    def record(self) -> dict[str, Any]:
        """Return what the record of the maps says of the motion, as JSON values."""
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
        Its images, exposures apart.
    cameras
        Calibrated, in the order of ``images.views``.
    surface
        The scan where the head is on average.
    pixel_mm
        Size of an image's pixel on the subject.

    Returns
    -------
    Motion or None
        One row for each of ``images.captures``; None where fewer than two tracking frames show
        all views.
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
    step = max(1, len(surface.points_mm) // TRACKED_POINTS)
    points = surface.points_mm[::step].astype(np.float64)
    found = head_motion.estimate(
        frames,
        [HalfResolutionCamera(camera) for camera in cameras],
        points,
        surface.normals[::step].astype(np.float64),
        times[order],
        reference=len(order) // 2,
    )
    when = np.array([np.mean(images.times_s(images.views[0], *key)) for key in images.captures])
    if not found.usable.any():
        raise InputsError(
            f"{session.path}: no tracking frame tells where the head was; is the scan of "
            "this subject, and are the cameras calibrated?"
        )
    # the scan was laid onto all images together: it stands where the head was on average
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
            f"{session.path}: no image lies between two tracking frames that tell where the "
            "head was; capture again, with the face at rest"
        )
    return DomeHeadMotion(poses, usable, found, apart, still)


def _time_s(record: Any) -> float:
    time = record.line.t_box_s
    if time is None:
        raise InputsError(f"{record.file}: does not say when it was lit")
    return float(time)


def _gray(session: Session, record: Any) -> Float32Array:
    """Return a tracking frame over its light: their levels and exposures differ."""
    frame = session.read(record)
    light = float(record.settings.get("level", 1.0)) * float(frame.exposure_s or 1.0)
    image = raw.linear_rgb(frame, demosaic="centered")
    return np.asarray(image.rgb.mean(axis=-1) / max(light, 1e-9), np.float32)
