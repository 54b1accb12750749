"""Calibrate a scanner's cameras and projectors at once: a projector is an inverse camera.

A board is lit by stripes along both axes. Each camera decodes the projector's column and row at
its pixels, and so at the board's corners: these are the corners in the image of a camera in the
projector's place (Moreno and Taubin 2012, doi:10.1109/3DIMPVT.2012.77).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from capture.arrays import Float64Array
from capture.calibration.geometry import bundle
from capture.calibration.geometry.board import Board, CornerObservation
from capture.calibration.geometry.bundle import BundleError, BundleResult
from capture.calibration.geometry.bundle_equations import N_CAMERA, Gauge, step_camera
from capture.calibration.geometry.intrinsics import CameraPose

WINDOW_PITCH = 0.45  # radius of the window around a corner over the distance of neighbors
MIN_WINDOW_PIXELS = 12  # of six unknowns per axis
DEPTH_STEP_MM = 0.01
PARAMETER_STEP = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class DecodedImage:
    """Projector coordinates at the pixels of a camera, from stripes along both axes.

    Attributes
    ----------
    columns, rows : ndarray of float64, shape (H, W)
        Column and row of the projector, px; NaN where not decoded.
    columns_stderr, rows_stderr : ndarray of float64, shape (H, W)
        Standard errors, px.
    """

    columns: Float64Array
    rows: Float64Array
    columns_stderr: Float64Array
    rows_stderr: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class ScannerGeometry:
    """Calibrated cameras and projectors of a scanner.

    Attributes
    ----------
    devices : dict of str to CameraPose
        Cameras and projectors by name.
    rms_px : dict of str to float
        RMS distance of the corners to the fitted ones, px of each device.
    depth_stderr_mm : dict of (camera, projector) to float
        Standard error of points along the camera's rays that the calibration causes, RMS over the
        board's corners.
    sigma_px : float
        Noise of a corner's coordinate, px of the cameras.
    """

    devices: dict[str, CameraPose]
    rms_px: dict[str, float]
    depth_stderr_mm: dict[tuple[str, str], float]
    sigma_px: float


def locate_corners_in_projector(
    corners: CornerObservation, decoded: DecodedImage
) -> CornerObservation | None:
    """Return the corners of a board in a projector's image, by a camera that sees its stripes.

    Around each corner a quadratic polynomial of the camera's pixel is fitted to the decoded
    coordinates, weighted by their errors.

    Parameters
    ----------
    corners : CornerObservation
        In the camera's image.
    decoded : DecodedImage
        Of the same camera.

    Returns
    -------
    CornerObservation or None
        None when no corner has enough decoded pixels.
    """
    tree = cKDTree(corners.pixels)
    pitch = tree.query(corners.pixels, k=2)[0][:, 1]
    kept, found = [], []
    height, width = decoded.columns.shape
    for number, pixel, gap in zip(corners.ids, corners.pixels, pitch, strict=True):
        radius = WINDOW_PITCH * gap
        low = np.maximum(np.floor(pixel - radius).astype(int), 0)
        high = np.minimum(np.ceil(pixel + radius).astype(int) + 1, [width, height])
        part = slice(low[1], high[1]), slice(low[0], high[0])
        v, u = np.mgrid[part]
        u, v = (u - pixel[0]) / radius, (v - pixel[1]) / radius
        place = []
        for values, stderr in (
            (decoded.columns[part], decoded.columns_stderr[part]),
            (decoded.rows[part], decoded.rows_stderr[part]),
        ):
            good = np.isfinite(values) & (u * u + v * v <= 1.0)
            if np.count_nonzero(good) < MIN_WINDOW_PIXELS:
                break
            x, y = u[good], v[good]
            terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
            weight = 1.0 / np.maximum(stderr[good], 1e-6)
            fit, _, rank, _ = np.linalg.lstsq(terms * weight[:, None], values[good] * weight)
            if rank < terms.shape[1]:
                break
            place.append(fit[0])
        if len(place) == 2:
            kept.append(number)
            found.append(place)
    return CornerObservation(np.array(kept, np.int64), np.array(found)) if kept else None


def calibrate_scanner(
    cameras: Mapping[tuple[str, int], CornerObservation],
    projectors: Mapping[tuple[str, int], Sequence[CornerObservation]],
    board: Board,
    start: Mapping[str, CameraPose],
    pairs: Sequence[tuple[str, str]],
) -> ScannerGeometry:
    """Calibrate cameras and projectors of a scanner from a board in several poses.

    Parameters
    ----------
    cameras : mapping of (camera, pose) to CornerObservation
        Corners in the cameras' images. Pose 0 is the board in its jig, which fixes the rig frame.
    projectors : mapping of (projector, pose) to observations
        Corners in the projectors' images, by each camera that decoded them.
    board : Board
    start : mapping of str to CameraPose
        Nominal cameras and projectors by name.
    pairs : sequence of (camera, projector)
        Pairs that triangulate.

    Raises
    ------
    BundleError
        If a device shares too few poses with the others.
    """
    names = {name for name, _ in projectors}
    focal = np.median([start[name].matrix[0, 0] for name in {name for name, _ in cameras}])
    # a projector's pixels are rescaled to those of the cameras, whose noise they have
    scale = {name: float(focal / start[name].matrix[0, 0]) for name in names}
    scaled = {name: _rescale(start[name], k) for name, k in scale.items()}
    sightings = dict(cameras)
    for (name, pose), seen in projectors.items():
        joined = _join(seen)
        pixels = _rescale_pixels(joined.pixels, scale[name])
        sightings[name, pose] = CornerObservation(joined.ids, pixels)
    in_jig = any(pose == 0 for _, pose in sightings)
    gauge: Gauge = "board" if in_jig else "cameras"
    result = bundle.adjust(sightings, board, {**start, **scaled}, gauge=gauge)
    ranges = {
        (camera, projector): _depth_stderr_mm(result, board, camera, projector)
        for camera, projector in pairs
        if camera in result.cameras and projector in result.cameras
    }
    devices = {
        name: replace(_rescale(device, 1.0 / scale[name]), image_size=start[name].image_size)
        if name in names
        else device
        for name, device in result.cameras.items()
    }
    rms = {name: value / scale.get(name, 1.0) for name, value in result.rms_px.items()}
    return ScannerGeometry(devices, rms, ranges, result.sigma_px)


def _join(seen: Sequence[CornerObservation]) -> CornerObservation:
    """Return the mean of a corner's places over the cameras that decoded it."""
    if not seen:
        raise BundleError("projector: got no corners, expected those of one camera at least")
    ids = np.concatenate([one.ids for one in seen])
    pixels = np.concatenate([one.pixels for one in seen])
    unique, place = np.unique(ids, return_inverse=True)
    count = np.bincount(place)
    mean = np.stack([np.bincount(place, pixels[:, k]) / count for k in (0, 1)], axis=-1)
    return CornerObservation(unique, mean)


def _rescale_pixels(pixels: Float64Array, scale: float) -> Float64Array:
    """Return pixels of an image that is enlarged; the first pixel's corner stays in place."""
    return (pixels + 0.5) * scale - 0.5


def _rescale(camera: CameraPose, scale: float) -> CameraPose:
    matrix = camera.matrix.copy()
    matrix[:2, :2] *= scale
    matrix[:2, 2] = _rescale_pixels(matrix[:2, 2], scale)
    width, height = camera.image_size
    size = max(round(width * scale), 1), max(round(height * scale), 1)
    errors = camera.matrix_stderr * scale
    return replace(camera, matrix=matrix, matrix_stderr=errors, image_size=size)


def _depth_stderr_mm(result: BundleResult, board: Board, camera: str, projector: str) -> float:
    """Return the RMS standard error of points along the rays, by both devices' covariance."""
    names = sorted(result.cameras)
    both = [result.cameras[camera], result.cameras[projector]]
    points = np.concatenate([pose.to_rig(board.points_mm) for pose in result.poses.values()])
    at = [names.index(name) * N_CAMERA + np.arange(N_CAMERA) for name in (camera, projector)]
    covariance = result.camera_covariance[np.ix_(np.concatenate(at), np.concatenate(at))]
    pixels = both[0].project(points)
    rays = both[0].rays(pixels)
    distance = np.linalg.norm(points - both[0].center_mm, axis=1)
    column = both[1].project(points)[:, 0]
    per_mm = (both[1].project(points + DEPTH_STEP_MM * rays)[:, 0] - column) / DEPTH_STEP_MM
    slopes = []
    for device in (0, 1):
        for k in range(N_CAMERA):
            size = PARAMETER_STEP * (max(abs(both[device].matrix[0, 0]), 1.0) if k < 4 else 1.0)
            moved = list(both)
            moved[device] = step_camera(both[device], size * np.eye(N_CAMERA)[k])
            # pixel and column stay: the point follows along the new ray
            way = moved[0].rays(pixels)
            there = moved[0].center_mm + distance[:, None] * way
            there += ((column - moved[1].project(there)[:, 0]) / per_mm)[:, None] * way
            slopes.append(np.einsum("nk,nk->n", there - points, rays) / size)
    gradient = np.stack(slopes, axis=-1)
    variance = np.einsum("nk,kl,nl->n", gradient, covariance, gradient)
    good = np.isfinite(variance)
    return float(np.sqrt(np.mean(np.clip(variance[good], 0.0, None)))) if good.any() else 0.0
