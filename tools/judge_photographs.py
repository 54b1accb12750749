"""Judge photographs of a face under near lights, a chart and boards, for judge_real_sets.py."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.io import loadmat

from capture.calibration.color import colorimetry
from capture.calibration.color.chart import find_chart, measure_patches
from capture.calibration.color.matrix import fit_matrix
from capture.calibration.geometry import calibrate_intrinsics
from model.vectors import unit_vectors
from reconstruction.photometric_stereo import estimate_normals
from reconstruction.stack_diagnosis import diagnose_stack

Array = NDArray[Any]

FACE_NUMBERS = (1, 2, 3, 4, 6, 7, 8)
"""LEDs whose photographs are pinned; that of LED 5 is larger than what was verified."""
FACE_DISTANCE_MM = 700.0
FACE_REDUCTION = 8
MAX_FACE_UNFIT = 0.2
"""Of the pixels: those without a normal that faces the camera."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One row of the table; `ours` may be at most `limit`."""

    data: str
    figure: str
    authors: float | None
    ours: float
    limit: float

    @property
    def passes(self) -> bool:
        """Whether our figure is within its limit."""
        return self.ours <= self.limit

    def row(self) -> str:
        """Return the row as text."""
        authors = "none" if self.authors is None else f"{self.authors:.3g}"
        mark = "" if self.passes else "  MISSED"
        return f"{self.data} | {self.figure} | {authors} | {self.ours:.3g} | {self.limit:.3g}{mark}"


def read_image(path: Path, flag: int = cv2.IMREAD_UNCHANGED) -> Array:
    """Return the pixels of an image file, B G R where it has colors.

    Raises
    ------
    FileNotFoundError
        For files that are missing or cannot be decoded.
    """
    pixels = cv2.imread(str(path), flag)
    if pixels is None:
        raise FileNotFoundError(f"{path}: not an image; fetch its set again")
    return np.asarray(pixels)


def load_face(sets: Path) -> tuple[Array, Array, Array, float, Array]:
    """Return gray (7, H, W), mask, positions in mm, focal length in pixels and center of a face.

    Positions are in the camera's axes: x right, y up, z against the view.
    """
    folder = sets / "near-face/Datasets"
    lights, matrix = loadmat(folder / "light.mat"), loadmat(folder / "camera.mat")["K"]
    at = [number - 1 for number in FACE_NUMBERS]
    height, width = 1728, 2592  # of the camera matrix; the JPEG images have twice of it

    def read(name: str) -> Array:
        file = folder / f"Human1/photometric_sample_jpg_{name}.png"
        values = read_image(file)[..., :3].mean(axis=-1, dtype=np.float32) / 255.0
        linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
        size = (width // FACE_REDUCTION, height // FACE_REDUCTION)
        return np.asarray(cv2.resize(linear, size, interpolation=cv2.INTER_AREA))

    ambient = read("ambient")
    gray = np.stack([read(f"{number:04d}") - ambient for number in FACE_NUMBERS])
    mask = read_image(folder / "Human1/photometric_sample_mask_raw.png", cv2.IMREAD_GRAYSCALE)
    mask = mask[:height, :width]
    small = cv2.resize(mask, gray.shape[:0:-1], interpolation=cv2.INTER_AREA) == 255
    strength = lights["Phi"].mean(axis=1)[at]
    gray = gray / (strength / strength.mean())[:, None, None]
    center = (matrix[:2, 2] + 0.5) / FACE_REDUCTION - 0.5
    flip = np.array([1.0, -1.0, -1.0])
    return gray, small, lights["S"][at] * flip, float(matrix[0, 0]) / FACE_REDUCTION, center


def fit_face(gray: Array, mask: Array, points: Array, positions: Array) -> tuple[Array, Array]:
    """Return median residual over albedo, and the fraction of pixels without a facing normal.

    Both are (2,): with the lights taken as distant, and as near.
    """
    distant = unit_vectors(positions - points[mask].mean(axis=0))
    near_lights: dict[str, Any] = {"light_positions_mm": positions, "points_mm": points}
    residual, unfit = [], []
    for near in ({}, near_lights):
        maps = estimate_normals(gray, distant, valid=mask, robust=False, **near)
        good = maps.valid & mask
        residual.append(np.median(maps.residual[good] / maps.albedo[good]))
        unfit.append(1.0 - np.count_nonzero(maps.normals[good][:, 2] > 0.0) / mask.sum())
    return np.array(residual), np.array(unfit)


def face_points_mm(mask: Array, focal_px: float, center: Array) -> Array:
    """Return the pixels' points (H, W, 3) on a plane across the view."""
    y, x = np.mgrid[0 : mask.shape[0], 0 : mask.shape[1]].astype(np.float64)
    rays = [(x - center[0]) / focal_px, (center[1] - y) / focal_px, -np.ones_like(x)]
    return FACE_DISTANCE_MM * np.stack(rays, axis=-1)


def judge_face(sets: Path) -> Iterator[Figure]:
    """Yield how well near and distant lights explain a face; no truth exists."""
    gray, mask, positions, focal_px, center = load_face(sets)
    points = face_points_mm(mask, focal_px, center)
    residual, unfit = fit_face(gray, mask, points, positions)
    for number, kind in enumerate(("distant", "near")):
        limits = (np.inf, np.inf) if kind == "distant" else (0.8 * residual[0], MAX_FACE_UNFIT)
        text = f"median residual over albedo, {kind} lights"
        yield Figure("face", text, None, float(residual[number]), float(limits[0]))
        text = f"pixels without a normal to the camera, {kind} lights"
        yield Figure("face", text, None, float(unfit[number]), limits[1])
    distant = unit_vectors(positions - points[mask].mean(axis=0))
    found = diagnose_stack(gray, distant, inside=mask, rng=np.random.default_rng(0))
    missed = float(not found.findings)
    yield Figure("face", "near lights taken for distant, not found", None, missed, 0.0)


def judge_chart(data: Path) -> Iterator[Figure]:
    """Yield errors of patches and colors of a photographed ColorChecker."""
    folder = data / "colorchecker"
    photograph = read_image(folder / "colorchecker_classic_photo.png")[..., ::-1]
    published = np.loadtxt(
        folder / "classic_patch_centres_and_srgb8.csv", delimiter=",", skiprows=1, usecols=range(5)
    )
    centers = find_chart(photograph)
    patches = measure_patches(photograph.astype(np.float64), centers)
    error = float(np.abs(centers - published[:, :2]).max())
    yield Figure("chart", "centers of patches, largest, px of 82", 0.0, error, 5.0)
    error = float(np.abs(patches.rgb - published[:, 2:]).max())
    yield Figure("chart", "levels of patches, largest, of 255", 0.0, error, 2.5)
    values = photograph / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    patches = measure_patches(linear, find_chart(linear))
    fit = fit_matrix(patches.rgb, colorimetry.chart_reference(), valid=patches.valid)
    yield Figure("chart", "colors, mean CIEDE2000", None, float(fit.mean_delta_e), 3.0)


def judge_board(data: Path) -> Iterator[Figure]:
    """Yield the camera of photographed chessboards against the published one."""
    folder = data / "chessboard"
    storage = cv2.FileStorage(str(folder / "left_intrinsics.yml"), cv2.FILE_STORAGE_READ)
    published = storage.getNode("camera_matrix").mat()
    error_px = storage.getNode("avg_reprojection_error").real()
    storage.release()
    found = calibrate_intrinsics(sorted(folder.glob("left*.jpg")), square_mm=25.0)
    yield Figure("board", "reprojection, rms px", error_px, float(found.rms_px), error_px)
    focal = float(abs(found.matrix[0, 0] / published[0, 0] - 1.0))
    yield Figure("board", "focal length, relative difference", 0.0, focal, 0.01)
    center = float(np.abs(found.matrix[:2, 2] - published[:2, 2]).max())
    yield Figure("board", "principal point, difference, px", 0.0, center, 3.0)
