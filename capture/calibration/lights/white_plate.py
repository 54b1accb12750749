"""White plate with markers at its edge: its pose, and the brightness of its parts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from capture.arrays import BoolArray, Float64Array, Int64Array
from capture.calibration.geometry import CameraPose
from capture.calibration.geometry.board import CornerObservation, find_markers
from capture.calibration.geometry.board_pose import BoardPose

PLATE_CELLS = (6, 4)  # columns and rows of parts into which the bare white is divided
MIN_CELL_PIXELS = 12  # of a part in an image
MIN_CELL_FILL = 0.5  # fraction of a part's pixels that must be usable
MARKER_MARGIN_MM = 3.0  # width of the bare white at the markers that is not used


@dataclass(frozen=True)
class WhitePlate:
    """Flat white diffuser with eight markers around its bare middle.

    x right, y down as seen from its front, z into it; the origin is its top left corner. The
    markers are in the corners and in the middles of the sides, row by row from the top left.

    Attributes
    ----------
    size_mm : tuple of float
        Width and height.
    marker_mm, margin_mm : float
        Side of a marker, and its distance from the plate's edge.
    dictionary : str
        ArUco dictionary, see `capture.calibration.geometry.board.Board`.
    first_marker : int
        Number of the first of the eight markers.
    reflectance, reflectance_stderr : float
        Reflectance of the bare white: sintered PTFE between 400 and 700 nm is 0.99 (Weidner and
        Hsia 1981, doi:10.1364/JOSA.71.000856); the error is common to all intensities.
    slope_rad : float
        Root mean square slope of its surface in each direction: its deviation from flatness.
    """

    size_mm: tuple[float, float] = (252.0, 198.0)
    marker_mm: float = 27.0
    margin_mm: float = 4.5
    dictionary: str = "4X4_50"
    first_marker: int = 30
    reflectance: float = 0.99
    reflectance_stderr: float = 0.003
    slope_rad: float = 1e-3

    @cached_property
    def points_mm(self) -> Float64Array:
        """Corners of the markers, clockwise from each one's top left, shape (32, 3)."""
        steps = [
            (self.margin_mm, (side - self.marker_mm) / 2, side - self.marker_mm - self.margin_mm)
            for side in self.size_mm
        ]
        places = [(x, y) for y in steps[1] for x in steps[0]]
        del places[4]
        square = self.marker_mm * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        corners = (np.array(places)[:, None] + square).reshape(-1, 2)
        return np.column_stack([corners, np.zeros(len(corners))])

    @cached_property
    def bare_mm(self) -> tuple[Float64Array, Float64Array]:
        """Top left and bottom right corner of the bare white."""
        inset = self.margin_mm + self.marker_mm + MARKER_MARGIN_MM
        return np.array([inset, inset]), np.array(self.size_mm) - inset

    def find(self, image: NDArray) -> CornerObservation | None:
        """Return the corners of the markers in an image, or None."""
        ids = range(self.first_marker, self.first_marker + 8)
        return find_markers(image, self.dictionary, ids)


@dataclass(frozen=True, slots=True, eq=False)
class PlateSamples:
    """Brightness of the parts of a plate in one frame.

    Attributes
    ----------
    view : str
        Name of the camera.
    light : str
        Name of the only light that was on.
    on_s : float
        Duration of the light times its level, s, > 0.
    rotation : ndarray of float64, shape (3, 3)
        Axes of the plate as columns, rig frame; the third points into it.
    part : ndarray of int64, shape (n,)
        Number of each part on the plate.
    points_mm : ndarray of float64, shape (n, 3)
        Centers of the parts, rig frame.
    pixels : ndarray of float64, shape (n, 2)
        Image positions of the parts, px.
    signal, variance : ndarray of float64, shape (n, 3)
        Mean camera RGB, fraction of full scale, and its variance.
    """

    view: str
    light: str
    on_s: float
    rotation: Float64Array
    part: Int64Array
    points_mm: Float64Array
    pixels: Float64Array
    signal: Float64Array
    variance: Float64Array

    @property
    def normal(self) -> Float64Array:
        """Normal of the plate, towards its front, rig frame, shape (3,)."""
        return -self.rotation[:, 2]


@dataclass(frozen=True, slots=True, eq=False)
class PlateWindow:
    """Assignment of a camera's pixels to parts of a plate; made once for a camera and a pose.

    Attributes
    ----------
    rows, columns : slice
        Window of the half-size image with one RGB pixel per 2 x 2 cell.
    part : ndarray of int64
        Number of the part at each pixel of the window, -1 outside all.
    points_mm, pixels : ndarray of float64, shapes (n, 3) and (n, 2)
        Center of each part's pixels, rig frame and full-size image.
    count : ndarray of int64, shape (n,)
        Pixels of each part.
    rotation : ndarray of float64, shape (3, 3)
        As in `PlateSamples`.
    """

    rows: slice
    columns: slice
    part: Int64Array
    points_mm: Float64Array
    pixels: Float64Array
    count: Int64Array
    rotation: Float64Array

    @classmethod
    def of(cls, camera: CameraPose, pose: BoardPose, plate: WhitePlate) -> PlateWindow | None:
        """Return the window of a plate in a camera; None when the camera is not in front of it."""
        normal = -pose.rotation[:, 2]
        low, high = plate.bare_mm
        corners = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
        px = camera.project(pose.to_rig(corners))
        if normal @ (camera.center_mm - pose.translation_mm) <= 0 or not np.isfinite(px).all():
            return None
        # pixel k of the half-size image has its center at 2 k + 1/2
        half = (np.array(camera.image_size) // 2).astype(int)
        first = np.clip(np.floor((px.min(axis=0) - 0.5) / 2), 0, half).astype(int)
        last = np.clip(np.ceil((px.max(axis=0) - 0.5) / 2) + 1, 0, half).astype(int)
        x, y = np.meshgrid(np.arange(first[0], last[0]), np.arange(first[1], last[1]))
        if not x.size:
            return None
        pixels = 2.0 * np.stack([x, y], axis=-1) + 0.5
        rays = camera.rays(pixels) @ pose.rotation
        eye = (camera.center_mm - pose.translation_mm) @ pose.rotation
        hit = eye[:2] - eye[2] * rays[..., :2] / rays[..., 2:]
        share = (hit - low) / (high - low)
        cell = np.floor(share * PLATE_CELLS).astype(np.int64)
        inside = (share >= 0).all(axis=-1) & (share < 1).all(axis=-1)
        # a pixel is interpolated from its neighbors: none of them may show a marker
        inside = binary_erosion(inside, iterations=2)
        part = np.where(inside, cell[..., 1] * PLATE_CELLS[0] + cell[..., 0], -1)
        number = part[inside]
        count = np.bincount(number, minlength=PLATE_CELLS[0] * PLATE_CELLS[1])
        safe = np.maximum(count, 1)
        means = [
            np.bincount(number, weights=values[inside], minlength=len(count)) / safe
            for values in (hit[..., 0], hit[..., 1], pixels[..., 0], pixels[..., 1])
        ]
        flat = np.column_stack([means[0], means[1], np.zeros(len(count))])
        box = slice(int(first[1]), int(last[1])), slice(int(first[0]), int(last[0]))
        middles = pose.to_rig(flat), np.column_stack(means[2:])
        return cls(*box, part, *middles, count, pose.rotation)

    def sample(
        self,
        rgb: NDArray,
        variance: NDArray,
        valid: BoolArray,
        *,
        view: str,
        light: str,
        on_s: float,
    ) -> PlateSamples:
        """Return the mean of each part of the plate in a frame.

        Parameters
        ----------
        rgb, variance : ndarray of float, shape (H/2, W/2, 3)
            Linear camera RGB with a pixel per 2 x 2 cell, dark subtracted.
        valid : ndarray of bool, shape (H/2, W/2)
        view, light, on_s
            As in `PlateSamples`.
        """
        box = (self.rows, self.columns)
        part = np.where(valid[box], self.part, -1)
        good = part >= 0
        number = part[good]
        n = len(self.count)
        count = np.bincount(number, minlength=n)
        safe = np.maximum(count, 1)[:, None]
        values, spread = rgb[box][good], variance[box][good]
        mean = np.stack([np.bincount(number, weights=v, minlength=n) for v in values.T], axis=1)
        noise = np.stack([np.bincount(number, weights=v, minlength=n) for v in spread.T], axis=1)
        kept = (count >= MIN_CELL_PIXELS) & (count >= MIN_CELL_FILL * self.count)
        parts = np.nonzero(kept)[0], self.points_mm[kept], self.pixels[kept]
        seen = (mean / safe)[kept], (noise / safe**2)[kept]
        return PlateSamples(view, light, on_s, self.rotation, *parts, *seen)
