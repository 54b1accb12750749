"""Find chessboards and ChArUco boards in images, and calibrate one camera's lens from them."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from capture.arrays import Float64Array, Int64Array, UInt8Array
from capture.calibration.record import CalibrationError

logger = logging.getLogger(__name__)

Pattern: TypeAlias = tuple[str, int, int] | tuple[str, int, int, str]

MARKER_SIDE_RATIO = 0.75  # side of a marker over that of a square, as most boards are printed
MIN_BOARD_CORNERS = 6  # corners of a board in an image: fewer determine its pose badly
MIN_BOARD_IMAGES = 3
MIN_POSE_SHIFT_PX = 2.0
"""Mean shift of the corners below which two images show one pose."""
REFINE_HALF_WINDOW_PITCH = 0.35  # half window of corner refinement over the distance of neighbors
N_SIDE_SAMPLES = 17  # across each side of a marker
SIDE_SEARCH_BITS = 0.45  # of a marker's bit, on both sides of its border
CORNER_STOP_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-3)


class BoardError(CalibrationError):
    """Raised for images or a board that cannot calibrate a camera; the message names them."""


@dataclass(frozen=True)
class Board:
    """Flat board of squares; x right, y down as seen from its front, z into it.

    Attributes
    ----------
    kind : {"chessboard", "charuco"}
        Plain, or with a marker in every white square.
    columns, rows : int
        Inner corners of a chessboard, squares of a ChArUco board.
    square_mm : float
        Side of a square, > 0.
    marker_mm : float
        Side of a marker.
    dictionary : str
        ArUco dictionary by OpenCV's name without its prefix, such as "4X4_50".
    """

    kind: Literal["chessboard", "charuco"]
    columns: int
    rows: int
    square_mm: float = 1.0
    marker_mm: float = 0.0
    dictionary: str = ""

    @classmethod
    def of(cls, pattern: Pattern, *, square_mm: float = 1.0) -> Board:
        """Return the board that a pattern names.

        Parameters
        ----------
        pattern : tuple
            ``("chessboard", inner columns, inner rows)`` or ``("charuco", columns, rows,
            dictionary)``, the latter in squares; markers have 3/4 of a square's side.
        square_mm : float
            Side of a square, > 0.

        Examples
        --------
        >>> Board.of(("charuco", 7, 5, "4X4_50"), square_mm=36.0).points_mm.shape
        (24, 3)
        """
        kind = pattern[0] if pattern else None
        sizes = {"chessboard": 3, "charuco": 4}
        if kind not in sizes or len(pattern) != sizes[kind] or min(pattern[1:3]) < 3:
            raise BoardError(
                f"pattern: got {pattern!r}, expected ('chessboard', columns, rows) or"
                " ('charuco', columns, rows, dictionary) with at least 3 columns and rows"
            )
        if not 0 < square_mm < np.inf:
            raise BoardError(f"square_mm: got {square_mm}, expected > 0")
        dictionary = str(pattern[3]).removeprefix("DICT_") if len(pattern) == 4 else ""
        if dictionary and not hasattr(cv2.aruco, f"DICT_{dictionary}"):
            raise BoardError(f"dictionary: got {dictionary!r}, expected one such as '4X4_50'")
        marker = MARKER_SIDE_RATIO * square_mm if dictionary else 0.0
        chosen: Any = kind
        return cls(chosen, int(pattern[1]), int(pattern[2]), square_mm, marker, dictionary)

    @cached_property
    def points_mm(self) -> Float64Array:
        """Inner corners, shape (N, 3), from the board's top left outer corner, z = 0."""
        if self.kind == "charuco":
            return np.asarray(self._charuco.getChessboardCorners(), np.float64)
        y, x = np.mgrid[1 : self.rows + 1, 1 : self.columns + 1]
        grid = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
        return np.asarray(grid * self.square_mm, np.float64)

    @cached_property
    def size_mm(self) -> tuple[float, float]:
        """Width and height."""
        more = 0 if self.kind == "charuco" else 1
        return (self.columns + more) * self.square_mm, (self.rows + more) * self.square_mm

    @cached_property
    def _charuco(self) -> Any:
        dictionary = cv2.aruco.getPredefinedDictionary(
            getattr(cv2.aruco, f"DICT_{self.dictionary}")
        )
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_mm, self.marker_mm, dictionary
        )

    @cached_property
    def detector(self) -> Any:
        """OpenCV's detector of a ChArUco board."""
        return cv2.aruco.CharucoDetector(self._charuco)


@dataclass(frozen=True, slots=True, eq=False)
class CornerObservation:
    """Corners of a target found in an image.

    Attributes
    ----------
    ids : ndarray of int64, shape (n,)
        Indices into the target's points.
    pixels : ndarray of float64, shape (n, 2)
        Column and row, px; pixel (0, 0)'s center is (0, 0).
    """

    ids: Int64Array
    pixels: Float64Array


@dataclass(frozen=True, slots=True, eq=False)
class Intrinsics:
    """Pinhole and lens of one camera.

    Attributes
    ----------
    matrix : ndarray of float64, shape (3, 3)
        Focal lengths and principal point, px.
    distortion : ndarray of float64, shape (5,)
        k1, k2, p1, p2, k3.
    image_size : tuple of int
        Columns and rows.
    rms_px : float
        Root mean square distance of the corners to the fitted ones.
    stderr : ndarray of float64, shape (9,)
        Standard errors of fx, fy, cx, cy (px), k1, k2, p1, p2, k3.
    per_image_px : ndarray of float64, shape (used images,)
        RMS distance of each image that shows the board.
    used, missing : tuple of str
        Names of the images with and without the board.
    """

    matrix: Float64Array
    distortion: Float64Array
    image_size: tuple[int, int]
    rms_px: float
    stderr: Float64Array
    per_image_px: Float64Array
    used: tuple[str, ...]
    missing: tuple[str, ...]


def _gray8(image: NDArray) -> UInt8Array:
    """Return an image as 8-bit gray, stretched between its 1 % and 99.5 % quantiles.

    Parameters
    ----------
    image : ndarray of uint8, uint16 or float, shape (H, W) or (H, W, 3)
        Any linear or display scale. Channels are balanced first, so that a gray target is gray.
    """
    values = np.asarray(image)
    if values.ndim == 3 and values.shape[2] == 3:
        planes = values.astype(np.float32)
        level = np.asarray(planes.reshape(-1, 3).mean(axis=0), np.float32)
        values = (planes / np.where(level > 0, level, np.float32(1))).sum(axis=2)
    if values.ndim != 2 or min(values.shape, default=0) < 8:
        raise BoardError(f"image: got shape {np.shape(image)}, expected (H, W) or (H, W, 3)")
    if values.dtype == np.uint8:
        return values
    low, high = np.quantile(values[::2, ::2], [0.01, 0.995])
    scale = 255.0 / max(float(high) - float(low), 1e-30)
    scaled = np.clip((values.astype(np.float32) - np.float32(low)) * np.float32(scale), 0, 255)
    return np.asarray(np.rint(scaled), np.uint8)


def find_board(image: NDArray, board: Board) -> CornerObservation | None:
    """Find a board's inner corners to a fraction of a pixel.

    Parameters
    ----------
    image : ndarray
        See `_gray8`.
    board : Board
        Board to find.

    Returns
    -------
    Sighting or None
        At least 6 corners (all of a chessboard's), or None when the board is not found.
    """
    gray = _gray8(image)
    if board.kind == "chessboard":
        flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
        found, corners = cv2.findChessboardCorners(gray, (board.columns, board.rows), flags=flags)
        if not found:
            return None
        pixels = np.asarray(corners, np.float64).reshape(-1, 2)
        return CornerObservation(np.arange(len(pixels)), _refined(gray, pixels, board))
    corners, ids, _, _ = board.detector.detectBoard(gray)
    if ids is None or len(ids) < MIN_BOARD_CORNERS:
        return None
    number = np.asarray(ids, np.int64).ravel()
    pixels = np.asarray(corners, np.float64).reshape(-1, 2)
    if np.linalg.matrix_rank(board.points_mm[number, :2] - board.points_mm[number[0], :2]) < 2:
        return None  # all on one line of the board
    return CornerObservation(number, pixels)


def _refined(gray: UInt8Array, pixels: Float64Array, board: Board) -> Float64Array:
    grid = pixels.reshape(board.rows, board.columns, 2)
    gaps = [np.linalg.norm(np.diff(grid, axis=k), axis=-1).min() for k in (0, 1)]
    half = int(np.clip(REFINE_HALF_WINDOW_PITCH * min(gaps), 2, 11))
    points = pixels.astype(np.float32)
    cv2.cornerSubPix(gray, points, (half, half), (-1, -1), CORNER_STOP_CRITERIA)
    return points.astype(np.float64)


def find_markers(image: NDArray, dictionary: str, ids: Iterable[int]) -> CornerObservation | None:
    """Find the corners of single markers.

    Parameters
    ----------
    image : ndarray
        See `_gray8`.
    dictionary : str
        As in `Board`.
    ids : iterable of int
        Numbers of the markers; the k-th of them has the points 4 k to 4 k + 3, clockwise from
        its top left.

    Returns
    -------
    Sighting or None
        None when fewer than two of the markers are found.
    """
    wanted = {number: k for k, number in enumerate(ids)}
    detector = cv2.aruco.ArucoDetector(
        cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}")),
        cv2.aruco.DetectorParameters(),
    )
    gray = _gray8(image)
    corners, found, _ = detector.detectMarkers(gray)
    smooth = gray.astype(np.float64)
    rows: list[tuple[int, Float64Array]] = []
    for number, square in zip([] if found is None else np.ravel(found), corners, strict=True):
        if int(number) in wanted:
            places = _square_corners(smooth, np.asarray(square, np.float64).reshape(4, 2))
            if places is not None:
                rows += [(4 * wanted[int(number)] + k, place) for k, place in enumerate(places)]
    if len(rows) < 8:
        return None
    return CornerObservation(np.array([row[0] for row in rows]), np.array([row[1] for row in rows]))


def _square_corners(gray: Float64Array, corners: Float64Array) -> Float64Array | None:
    """Return a dark square's corners as the crossings of lines fitted to its four sides.

    None when a side has no clear edge.
    """
    along = np.linspace(0.12, 0.88, N_SIDE_SAMPLES)[:, None]
    places = corners.copy()
    for _ in range(2):
        lines = []
        middle = places.mean(axis=0)
        cell = np.linalg.norm(np.diff(places, axis=0, append=places[:1]), axis=1).min() / 6
        reach = max(SIDE_SEARCH_BITS * cell, 1.5)
        steps = np.arange(-reach, reach + 0.125, 0.25)
        for k in range(4):
            a, b = places[k], places[(k + 1) % 4]
            outward = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
            outward *= np.sign(outward @ (0.5 * (a + b) - middle))
            start = a + along * (b - a)
            at = start[:, None] + steps[:, None] * outward
            profile = map_coordinates(gray, [at[..., 1], at[..., 0]], order=1, mode="nearest")
            slope = np.clip(np.gradient(profile, axis=1), 0.0, None)  # brighter outside
            slope -= 0.2 * slope.max(axis=1, keepdims=True)
            slope = np.clip(slope, 0.0, None)
            if not (slope.sum(axis=1) > 0).all():
                return None
            edge = start + (slope @ steps / slope.sum(axis=1))[:, None] * outward
            lines.append(_line(edge))
        places = np.array([_crossing(lines[k - 1], lines[k]) for k in range(4)])
        if not np.isfinite(places).all() or np.abs(places - corners).max() > 2 * reach:
            return None
    return places


def _line(points: Float64Array) -> Float64Array:
    """Return a, b, c of the line a x + b y = c through points; the two farthest are omitted."""
    for _ in range(2):
        middle = points.mean(axis=0)
        normal = np.linalg.svd(points - middle)[2][1]
        off = np.abs((points - middle) @ normal)
        points = points[np.argsort(off)[: max(len(points) - 2, 4)]]
    return np.array([*normal, normal @ middle])


def _crossing(a: Float64Array, b: Float64Array) -> Float64Array:
    lines = np.array([a[:2], b[:2]])
    if abs(np.linalg.det(lines)) < 1e-6:
        return np.full(2, np.nan)
    return np.asarray(np.linalg.solve(lines, [a[2], b[2]]))


def calibrate_intrinsics(
    images: Sequence[NDArray | str | Path],
    *,
    pattern: Pattern = ("chessboard", 9, 6),
    square_mm: float = 1.0,
) -> Intrinsics:
    """Calibrate one camera's pinhole and lens from images of a flat board.

    Parameters
    ----------
    images : sequence of ndarray or path
        At least 3 that show the board at different tilts, all of one size.
    pattern : tuple
        ``("chessboard", inner columns, inner rows)`` or ``("charuco", columns, rows,
        dictionary)``, see `Board.of`.
    square_mm : float
        Side of a square; it does not change the result.

    Returns
    -------
    Intrinsics
        The images without a board are named in ``missing``.

    Raises
    ------
    BoardError
        If fewer than 3 images show the board, at fewer than 3 poses, or sizes differ.

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", doi:10.1109/34.888718; solved by
    OpenCV, which also gives the standard errors.
    """
    board = Board.of(pattern, square_mm=square_mm)
    used: list[str] = []
    missing: list[str] = []
    sightings: list[CornerObservation] = []
    sizes: dict[str, tuple[int, int]] = {}
    for k, entry in enumerate(images):
        name = Path(entry).name if isinstance(entry, str | Path) else f"image {k}"
        image = _read(entry) if isinstance(entry, str | Path) else entry
        sizes[name] = (image.shape[1], image.shape[0])
        sighting = find_board(image, board)
        if sighting is None:
            missing.append(name)
            logger.warning("%s: no %s of %d x %d found", name, *pattern[:3])
        else:
            used.append(name)
            sightings.append(sighting)
    for (one, a), (other, b) in itertools.pairwise(sizes.items()):
        if a != b:
            raise BoardError(
                f"images: got {a} px of {one} and {b} px of {other}, expected one size"
            )
    if len(used) < MIN_BOARD_IMAGES:
        raise BoardError(
            f"images: the {board.kind} of {board.columns} x {board.rows} was found in"
            f" {len(used)} of {len(sizes)}, expected at least {MIN_BOARD_IMAGES}; not in"
            f" {', '.join(missing) or 'any, there were none'}"
        )
    poses = _count_poses(sightings)
    if poses < MIN_BOARD_IMAGES:
        raise BoardError(
            f"images: got {poses} poses of the board in {len(used)} images, expected at least "
            f"{MIN_BOARD_IMAGES} that differ; tilt it between images"
        )
    size = next(iter(sizes.values()))
    objects = [board.points_mm[s.ids].astype(np.float32) for s in sightings]
    pixels = [s.pixels.astype(np.float32) for s in sightings]
    try:
        rms, matrix, distortion, _, _, errors, _, each = cv2.calibrateCameraExtended(
            objects, pixels, size, None, None
        )
    except cv2.error as exc:
        raise BoardError(f"images: no camera fits them ({exc}); tilt the board more") from exc
    found = (matrix, distortion, errors[:9], each)
    if not all(np.isfinite(values).all() for values in found):
        raise BoardError("images: no camera fits them; show the board at different tilts")
    return Intrinsics(
        np.asarray(matrix, np.float64),
        np.asarray(distortion, np.float64).ravel()[:5],
        size,
        float(rms),
        np.asarray(errors, np.float64).ravel()[:9],
        np.asarray(each, np.float64).ravel(),
        tuple(used),
        tuple(missing),
    )


def _count_poses(sightings: Sequence[CornerObservation]) -> int:
    """Return how many of the images differ from all before them."""
    kept: list[CornerObservation] = []
    for one in sightings:
        for other in kept:
            _, here, there = np.intersect1d(one.ids, other.ids, return_indices=True)
            shift = np.linalg.norm(one.pixels[here] - other.pixels[there], axis=1)
            if len(shift) and shift.mean() < MIN_POSE_SHIFT_PX:
                break
        else:
            kept.append(one)
    return len(kept)


def _read(path: str | Path) -> UInt8Array:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise BoardError(f"{path}: got no image, expected a JPEG, PNG or TIFF that can be read")
    return np.asarray(image, np.uint8)
