"""Define the cameras of renderings: a calibrated view of a rig, or a camera aimed at a point."""

import dataclasses
import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from capture.calibration.geometry import CameraPose
from skinrig.arrays import Float32Array, Float64Array

Camera = CameraPose
"""Pinhole with distortion, in the rig frame; x right, y down, pixel (0, 0)'s center is (0, 0)."""

MAX_SIDE_PX: Final = 16_384
"""Longest side of a rendering."""


class RenderingError(ValueError):
    """Settings that give no image, or images that are not comparable."""


def look_at(
    position_mm: ArrayLike,
    *,
    target_mm: ArrayLike = (0.0, 0.0, 0.0),
    up: ArrayLike = (0.0, 1.0, 0.0),
    fov_deg: float = 25.0,
    size_px: tuple[int, int] = (512, 512),
    name: str = "look-at",
) -> Camera:
    """Create a camera without distortion that is aimed at a point.

    Parameters
    ----------
    position_mm
        Center of projection, shape (3,), mm, rig frame.
    target_mm
        Point on the optical axis, mm.
    up
        Direction of the image's upward axis.
    fov_deg
        Field of view along the longer side, degrees, above 0 and below 170.
    size_px
        Columns and rows.
    name
        Name of the camera in records.

    Raises
    ------
    RenderingError
        If the position is at the target, the view is along `up`, or a number is out of range.

    Examples
    --------
    >>> camera = look_at((0.0, 0.0, 700.0), size_px=(201, 101))
    >>> camera.project([[0.0, 0.0, 0.0]]).tolist()
    [[100.0, 50.0]]
    """
    place, target, upward = (np.asarray(v, np.float64) for v in (position_mm, target_mm, up))
    for field, given in (("place", place), ("target", target), ("up", upward)):
        if given.shape != (3,) or not np.isfinite(given).all():
            raise RenderingError(
                f"view: got {field} {given.tolist()}, expected three finite numbers"
            )
    if not 0.0 < fov_deg < 170.0:
        raise RenderingError(
            f"--fov: got {fov_deg} degrees, expected above 0 and below 170; enter another"
        )
    columns, rows = size_px
    if not (2 <= columns <= MAX_SIDE_PX and 2 <= rows <= MAX_SIDE_PX):
        raise RenderingError(
            f"size: got {columns} x {rows}, expected 2 to {MAX_SIDE_PX} pixels per side"
        )
    back = place - target
    right = np.cross(upward, back)
    if not np.linalg.norm(back) > 0.0 or not np.linalg.norm(right) > 1e-9 * np.linalg.norm(back):
        raise RenderingError(
            f"view: from {place.tolist()} to {target.tolist()} and {upward.tolist()} up do "
            "not define an image; change --view or --look-at"
        )
    back /= np.linalg.norm(back)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, -np.cross(back, right), -back])
    focal = 0.5 * max(columns, rows) / math.tan(0.5 * math.radians(fov_deg))
    matrix = np.array([[focal, 0.0, (columns - 1) / 2], [0.0, focal, (rows - 1) / 2], [0, 0, 1.0]])
    return Camera(name, matrix, np.zeros(5), rotation, -rotation @ place, (columns, rows))


def bin_pixels(camera: Camera, factor: float) -> Camera:
    """Return a camera with larger pixels; `factor` = 2 joins cells of 2 x 2 pixels.

    Parameters
    ----------
    camera
        The camera.
    factor
        Side of a new pixel in old pixels, above 0; below 1: smaller pixels.

    Examples
    --------
    >>> camera = look_at((0.0, 0.0, 700.0), size_px=(200, 100))
    >>> half = bin_pixels(camera, 2)
    >>> half.image_size, half.project([[0.0, 0.0, 0.0]]).tolist()
    ((100, 50), [[49.5, 24.5]])
    """
    if not 0.0 < factor < math.inf:
        raise RenderingError(f"factor: got {factor} old pixels per new one, expected above 0")
    matrix = np.array(camera.matrix)
    matrix[:2] /= factor
    matrix[:2, 2] += 0.5 / factor - 0.5  # centers of pixels are at integers
    columns, rows = (int(side / factor + 1e-6) for side in camera.image_size)
    if not (1 <= columns <= MAX_SIDE_PX and 1 <= rows <= MAX_SIDE_PX):
        raise RenderingError(
            f"size: got {columns} x {rows}, expected 1 to {MAX_SIDE_PX} pixels per side"
        )
    return dataclasses.replace(camera, matrix=matrix, image_size=(columns, rows))


def generate_rays(
    camera: Camera, *, subpixels: int, rows: tuple[int, int] | None = None
) -> tuple[Float32Array, Float32Array]:
    """Generate rays through a regular grid of points in each pixel.

    Parameters
    ----------
    camera
        The camera.
    subpixels
        Rays along each side of a pixel, k.
    rows
        First row of pixels and the one after the last; None: all.

    Returns
    -------
    origins, directions : ndarray of float32
        Shape (H k, W k, 3) each, rig frame in mm, directions of unit length.
    """
    if subpixels < 1:
        raise RenderingError(
            f"samples: got {subpixels} per pixel side, expected 1 or more; enter another"
        )
    columns, height = camera.image_size
    first, last = (0, height) if rows is None else rows
    x = (np.arange(columns * subpixels) + 0.5) / subpixels - 0.5
    y = (np.arange(first * subpixels, last * subpixels) + 0.5) / subpixels - 0.5
    pixels: Float64Array = np.stack(np.meshgrid(x, y), axis=-1)
    directions = camera.rays(pixels).astype(np.float32)
    origin = camera.center_mm.astype(np.float32)
    return np.broadcast_to(origin, directions.shape), directions
