"""Pose and projection of a camera in the rig frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from capture.arrays import Float64Array
from capture.calibration.record import (
    Calibration,
    Origin,
    Quantity,
    freeze_arrays,
    make_device_calibration,
)
from capture.rig import Rig, View

_OMITTED: Any = None  # __post_init__ replaces it by an array

MAX_UNDISTORT_STEPS = 50
MAX_UNDISTORT_STEP = 10.0  # a step beyond it diverges
UNDISTORT_TOL = 1e-12  # of normalized coordinates; a pixel is about 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class CameraPose:
    """A camera in the rig frame: pinhole, lens distortion, rotation and translation.

    Camera axes are x right, y down, z forward; pixel (0, 0)'s center is (0, 0).

    Attributes
    ----------
    serial : str
        Serial number of the camera.
    matrix : ndarray of float64, shape (3, 3)
        Focal lengths and principal point in px.
    distortion : ndarray of float64, shape (5,)
        k1, k2, p1, p2, k3 of Brown's model (Brown 1966), on normalized coordinates.
    rotation : ndarray of float64, shape (3, 3)
        Rotates rig coordinates into camera axes; its rows are the camera's axes.
    translation_mm : ndarray of float64, shape (3,)
        A point X is at ``rotation @ X + translation_mm`` in camera axes.
    image_size : tuple of int
        Columns and rows.
    matrix_stderr, distortion_stderr : ndarray of float64, shapes (3, 3) and (5,)
        Standard errors; 0 where a parameter was held fixed.
    rotation_stderr_rad, translation_stderr_mm : ndarray of float64, shape (3,)
        Standard errors of small rotations about the camera's own axes, and of `translation_mm`.
    """

    serial: str
    matrix: Float64Array
    distortion: Float64Array
    rotation: Float64Array
    translation_mm: Float64Array
    image_size: tuple[int, int]
    matrix_stderr: Float64Array = _OMITTED
    distortion_stderr: Float64Array = _OMITTED
    rotation_stderr_rad: Float64Array = _OMITTED
    translation_stderr_mm: Float64Array = _OMITTED

    def __post_init__(self) -> None:
        """Convert to float64 and reject invalid cameras."""
        freeze_arrays(self, (3, 3), "matrix", "matrix_stderr", "rotation")
        freeze_arrays(self, (5,), "distortion", "distortion_stderr")
        freeze_arrays(self, (3,), "translation_mm", "translation_stderr_mm", "rotation_stderr_rad")
        K, R = self.matrix, self.rotation
        if not (K[0, 0] > 0 and K[1, 1] > 0 and np.array_equal(K[2], [0.0, 0.0, 1.0])):
            raise ValueError(
                f"CameraPose.matrix: got {K.tolist()}, expected positive focal lengths and last row"
                " 0 0 1"
            )
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-6) or np.linalg.det(R) < 0:
            raise ValueError(f"CameraPose.rotation: got {R.tolist()}, expected a rotation")
        if min(self.image_size) < 1:
            raise ValueError(f"CameraPose.image_size: got {self.image_size}, expected >= 1")

    @classmethod
    def nominal(cls, view: View) -> CameraPose:
        """Return the nominal camera from the rig file: no distortion, errors 0.

        Parameters
        ----------
        view : View
            Nominal camera.

        Examples
        --------
        >>> from capture.rig import load_rig
        >>> camera = CameraPose.nominal(load_rig("dome").view("C00"))
        >>> camera.project([[0.0, 0.0, 0.0]]).round(6).tolist()
        [[649.5, 514.5]]
        """
        right, up, back = (np.array(axis) for axis in view.axes)
        rotation = np.stack([right, -up, -back])
        matrix = np.diag([view.focal_px, view.focal_px, 1.0])
        matrix[:2, 2] = (view.width_px - 1) / 2, (view.height_px - 1) / 2
        shift, size = -rotation @ np.array(view.position_mm), (view.width_px, view.height_px)
        return cls(view.serial, matrix, np.zeros(5), rotation, shift, size)

    @property
    def center_mm(self) -> Float64Array:
        """Center of projection, mm, rig frame, shape (3,)."""
        return -self.rotation.T @ self.translation_mm

    def project(self, points_mm: ArrayLike) -> Float64Array:
        """Project points into the image.

        Parameters
        ----------
        points_mm : array_like, shape (..., 3)
            Rig frame, mm.

        Returns
        -------
        ndarray of float64, shape (..., 2)
            Column and row in px; NaN for points that are not in front of the camera.
        """
        local = np.asarray(points_mm, dtype=np.float64) @ self.rotation.T + self.translation_mm
        depth = local[..., 2:]
        front = depth > 0
        xy = distort(
            np.where(front, local[..., :2], np.nan) / np.where(front, depth, 1.0), self.distortion
        )
        return xy @ self.matrix[:2, :2].T + self.matrix[:2, 2]

    def rays(self, pixels: ArrayLike) -> Float64Array:
        """Return the viewing directions of pixels; the inverse of `project`.

        Parameters
        ----------
        pixels : array_like, shape (..., 2)
            Column and row in px.

        Returns
        -------
        ndarray of float64, shape (..., 3)
            Unit vectors from `center_mm`, rig frame.

        Raises
        ------
        ValueError
            When the lens distortion has no inverse there.
        """
        px = np.asarray(pixels, dtype=np.float64)
        seen = (px - self.matrix[:2, 2]) @ np.linalg.inv(self.matrix[:2, :2]).T
        xy = seen.copy()
        if self.distortion.any() and xy.size:
            for _ in range(MAX_UNDISTORT_STEPS):
                step = seen - distort(xy, self.distortion)
                xy = xy + step
                size = float(np.nanmax(np.abs(step)))
                if not UNDISTORT_TOL < size < MAX_UNDISTORT_STEP:
                    break
            if not size <= UNDISTORT_TOL:
                raise ValueError(
                    f"pixels: got some where the distortion {self.distortion.tolist()} of camera"
                    f" {self.serial!r} has no inverse, expected pixels within the image"
                )
        local = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return local @ self.rotation


def distort(xy: ArrayLike, distortion: ArrayLike) -> Float64Array:
    """Apply Brown's lens distortion to normalized image coordinates.

    Parameters
    ----------
    xy : array_like, shape (..., 2)
        Coordinates over depth.
    distortion : array_like, shape (5,)
        k1, k2, p1, p2, k3.

    Returns
    -------
    ndarray of float64, shape (..., 2)

    References
    ----------
    D. C. Brown, "Decentering distortion of lenses", Photogrammetric Engineering 32(3), 1966.
    """
    points = np.asarray(xy, dtype=np.float64)
    k1, k2, p1, p2, k3 = np.asarray(distortion, dtype=np.float64)
    x, y = points[..., 0], points[..., 1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bent_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    bent_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([bent_x, bent_y], axis=-1)


def nominal_cameras(rig: Rig) -> dict[str, CameraPose]:
    """Return the rig's nominal cameras by the names of its views."""
    return {view.name: CameraPose.nominal(view) for view in rig.views}


def to_calibration(
    cameras: Mapping[str, CameraPose],
    *,
    reprojection_px: Mapping[str, float] | None = None,
    kind: str = "geometry",
    **about: Unpack[Origin],
) -> Calibration:
    """Return cameras as a `Calibration`, keyed by serial.

    Parameters
    ----------
    cameras : mapping of str to CameraPose
        By any name; serials must differ.
    rig, source, created, valid_until, inputs, versions
        As the fields of `Calibration`; `valid_until` None: the default validity.
    reprojection_px : mapping of str to float, optional
        RMS reprojection error by the same names.
    kind : str
        "geometry", or "scanner" for cameras and projectors of a scanner.
    """
    serials = tuple(camera.serial for camera in cameras.values())
    if len(set(serials)) != len(serials):
        raise ValueError(f"cameras: got serials {serials}, expected ones that differ")
    values = {}
    for name, c in cameras.items():
        values[c.serial] = {
            "matrix": Quantity(c.matrix, c.matrix_stderr),
            "distortion": Quantity(c.distortion, c.distortion_stderr),
            "rotation": Quantity(c.rotation),
            "rotation_stderr_rad": Quantity(c.rotation_stderr_rad),
            "translation_mm": Quantity(c.translation_mm, c.translation_stderr_mm),
            "image_size": Quantity(np.array(c.image_size, dtype=np.float64)),
        }
        if reprojection_px is not None:
            rms = np.array(reprojection_px[name])
            values[c.serial]["reprojection_px"] = Quantity(rms)
    notes = {
        "frame": "x_camera = rotation x_rig + translation_mm; x right, y down, z forward",
        "distortion": "k1 k2 p1 p2 k3 on normalized coordinates",
    }
    return make_device_calibration(kind, values, notes, **about)


def cameras_from_calibration(calibration: Calibration, rig: Rig) -> dict[str, CameraPose]:
    """Return the calibrated cameras of a rig's views, by view name.

    Raises
    ------
    CalibrationMismatch
        If the calibration lacks a camera of the rig.
    """
    return poses_from_calibration(calibration, {view.name: view.serial for view in rig.views})


def poses_from_calibration(
    calibration: Calibration, serials: Mapping[str, str]
) -> dict[str, CameraPose]:
    """Return calibrated cameras or projectors by name, given their serials by name.

    Raises
    ------
    CalibrationMismatch
        If the calibration lacks one of them.
    """
    poses = {}
    for name, serial in serials.items():
        got = partial(calibration.quantity, serial)
        matrix, distortion, shift = got("matrix"), got("distortion"), got("translation_mm")
        columns, rows = got("image_size").value
        poses[name] = CameraPose(
            serial,
            matrix.value,
            distortion.value,
            got("rotation").value,
            shift.value,
            (int(columns), int(rows)),
            matrix.stderr_or_zero,
            distortion.stderr_or_zero,
            got("rotation_stderr_rad").value,
            shift.stderr_or_zero,
        )
    return poses
