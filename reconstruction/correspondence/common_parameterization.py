"""Common parameterization (u, v) of many faces: a face unrolled, and warped by its landmarks.

A face is unrolled onto a cylinder about a vertical axis behind its nose, without a seam in the
visible face. A thin-plate spline through named landmarks (a radial basis with an affine part) then
warps it to their common positions. Texels are averaged into the common map, and values are read
back at the same coordinates. A change made in the common map is therefore continuous over the face,
however its own texture is divided into islands.

References
----------
Pighin, Hecker, Lischinski, Szeliski, Salesin 1998, doi:10.1145/280814.280825
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 10.2 (20 points per face)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import Float64Array
from reconstruction.correspondence import landmark_field
from reconstruction.correspondence.landmark_field import LandmarkField, LandmarkFieldError

Point = tuple[float, float, float]

CYLINDER_RADIUS_MM: Final = 90.0
"""Radius of the cylinder, about that of a head, so that lengths on a cheek are about preserved."""
MIN_SHARED_LANDMARKS: Final = 6
"""Minimum number of landmarks common to two faces: three for the affine part, three to fit."""
NOSE_TIP_FRACTION: Final = 1e-3
"""Fraction of foremost texels whose mean replaces the tip of the nose without its landmark."""
MIN_CHART_PX, MAX_CHART_PX = 16, 4096
_TEXELS_PER_BATCH: Final = 40_000
NOSE_LANDMARK: Final = "nose tip"


class ParameterizationError(ValueError):
    """Landmarks or positions that do not determine a common parameterization."""


@dataclass(frozen=True, slots=True)
class Cylinder:
    """Cylinder onto which a face is unrolled.

    Attributes
    ----------
    tip_mm
        Tip of the nose, rig frame (+y up, +z out of the face); the axis is vertical,
        `CYLINDER_RADIUS_MM` behind it.
    """

    tip_mm: Point

    def unroll(self, position_mm: ArrayLike) -> Float64Array:
        """Return (u, v), mm: arc to the image's right of the nose's tip, and height above it.

        Parameters
        ----------
        position_mm
            Shape (..., 3), rig frame.

        Examples
        --------
        >>> Cylinder((0.0, 10.0, 20.0)).unroll([[90.0, 15.0, -70.0]]).round(2).tolist()
        [[141.37, 5.0]]
        """
        at = np.asarray(position_mm, np.float64) - np.asarray(self.tip_mm)
        arc = CYLINDER_RADIUS_MM * np.arctan2(at[..., 0], at[..., 2] + CYLINDER_RADIUS_MM)
        return np.stack([arc, at[..., 1]], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class CommonFrame:
    """The common map: positions of its landmarks, and the range of the plane that it covers.

    Attributes
    ----------
    names
        Names of the landmarks.
    landmarks_mm
        (K, 2), u to the right and v up from the nose's tip.
    center_mm
        Center of the map, (u, v).
    side_mm
        Length of its sides, above 0.
    size
        Pixels per side, 16 to 4096.
    """

    names: tuple[str, ...]
    landmarks_mm: Float64Array
    center_mm: tuple[float, float]
    side_mm: float
    size: int

    def __post_init__(self) -> None:
        """Check shapes and ranges."""
        check = Checks(ParameterizationError)
        check.numbers("landmarks_mm", self.landmarks_mm, (len(self.names), 2))
        check.within("center_mm", self.center_mm)
        check.settings(self, side_mm="(0, inf)", size=f"[{MIN_CHART_PX}, {MAX_CHART_PX}]")

    @property
    def pixel_mm(self) -> float:
        """Side of a pixel, mm."""
        return self.side_mm / self.size

    def to_pixel(self, uv_mm: ArrayLike) -> Float64Array:
        """Return (column, row) of positions, (..., 2); the center of pixel (0, 0) is at 0, 0."""
        uv = (np.asarray(uv_mm, np.float64) - self.center_mm) / self.pixel_mm
        middle = 0.5 * (self.size - 1)
        return np.stack([middle + uv[..., 0], middle - uv[..., 1]], axis=-1)

    def grid_mm(self) -> Float64Array:
        """Return (u, v) of each pixel, (N, N, 2), row 0 at the top."""
        along = (np.arange(self.size) - 0.5 * (self.size - 1)) * self.pixel_mm
        u, v = np.meshgrid(along + self.center_mm[0], self.center_mm[1] - along)
        return np.stack([u, v], axis=-1)

    def landmark(self, name: str) -> Float64Array:
        """Return a landmark's position, (2,), mm."""
        Checks(ParameterizationError).choice("landmark", name, sorted(self.names))
        return self.landmarks_mm[self.names.index(name)]

    def to_document(self) -> dict[str, object]:
        """Return the frame as JSON values; `from_document` reads them back."""
        return {
            "names": list(self.names),
            "landmarks_mm": self.landmarks_mm.tolist(),
            "center_mm": list(self.center_mm),
            "side_mm": self.side_mm,
            "size": self.size,
            "radius_mm": CYLINDER_RADIUS_MM,
        }

    @staticmethod
    def from_document(document: Mapping[str, object]) -> CommonFrame:
        """Return the frame of a document by `to_document`.

        Raises
        ------
        ParameterizationError
            When a value is missing or of another type; the message names it.
        """
        values: Any = document
        try:
            radius_mm = float(values["radius_mm"])
            u, v = map(float, values["center_mm"])
            names = tuple(map(str, values["names"]))
            places = np.asarray(values["landmarks_mm"], np.float64).reshape(-1, 2)
            side_mm, size = float(values["side_mm"]), int(values["size"])
        except (KeyError, TypeError, ValueError) as error:
            raise ParameterizationError(f"common parameterization: {error}") from error
        Checks(ParameterizationError).choice("radius_mm", radius_mm, (CYLINDER_RADIUS_MM,))
        return CommonFrame(names, places, (u, v), side_mm, size)


@dataclass(frozen=True, slots=True, eq=False)
class Correspondence:
    """Map from one face to the common map.

    Attributes
    ----------
    cylinder
        Cylinder onto which the face is unrolled.
    field
        Warps its landmarks to the common ones; None: the face is only unrolled.
    """

    cylinder: Cylinder
    field: LandmarkField | None = None

    def map_points(self, position_mm: ArrayLike) -> tuple[Float64Array, Float64Array]:
        """Return common (u, v) of points, (..., 2), and their standard error, (...), mm.

        Parameters
        ----------
        position_mm
            Shape (..., 3), rig frame.

        Returns
        -------
        tuple of ndarray
            The error along each axis contains the landmarks' errors and the variation of faces
            between them; NaN without landmarks, where it is not known.
        """
        flat = self.cylinder.unroll(position_mm).reshape(-1, 2)
        shape = np.shape(position_mm)[:-1]
        if self.field is None:
            return flat.reshape(*shape, 2), np.full(shape, np.nan)
        moved, error = np.empty_like(flat), np.empty(len(flat))
        for start in range(0, len(flat), _TEXELS_PER_BATCH):
            part = slice(start, start + _TEXELS_PER_BATCH)
            by, off = self.field.evaluate(flat[part])
            moved[part], error[part] = flat[part] + by, np.hypot(off, self.field.stderr_px)
        return moved.reshape(*shape, 2), error.reshape(shape)


def find_cylinder(position_mm: ArrayLike, valid: ArrayLike) -> Cylinder:
    """Find a face's cylinder by its foremost texels, without a landmark of the nose.

    Parameters
    ----------
    position_mm
        (H, W, 3), rig frame.
    valid
        (H, W), texels of the surface.

    Raises
    ------
    ParameterizationError
        When no texel is valid.
    """
    points = np.asarray(position_mm, np.float64)[np.asarray(valid, np.bool_)]
    if not len(points):
        got = "got no valid texel, expected some"
        raise ParameterizationError(f"position: {got}; check the mask")
    count = max(1, round(NOSE_TIP_FRACTION * len(points)))
    front = points[np.argpartition(points[:, 2], len(points) - count)[-count:]]
    x, y, z = np.median(front, axis=0)
    return Cylinder((float(x), float(y), float(z)))


def average_landmarks(faces: Sequence[Mapping[str, Point]]) -> tuple[tuple[str, ...], Float64Array]:
    """Return the landmarks common to all faces, and their mean positions in the unrolled plane.

    Parameters
    ----------
    faces
        One or more: name to x, y, z, mm, rig frame; each with "nose tip".

    Returns
    -------
    names : tuple of str
    landmarks_mm : ndarray, shape (K, 2)
        Mean of the faces, each scaled first to the mean size about the landmarks' center.

    Raises
    ------
    ParameterizationError
        When fewer than `MIN_SHARED_LANDMARKS` are common, or a face lacks the tip of the nose.
    """
    if not faces:
        raise ParameterizationError("landmarks: got no face, expected at least one; add a face")
    names = tuple(name for name in faces[0] if all(name in face for face in faces))
    if NOSE_LANDMARK not in names:
        raise ParameterizationError(
            f"landmarks: a face lacks {NOSE_LANDMARK!r}, expected it in all; mark it"
        )
    if len(names) < MIN_SHARED_LANDMARKS:
        raise ParameterizationError(
            f"landmarks: all faces have {len(names)} in common ({', '.join(names) or 'none'}), "
            f"expected at least {MIN_SHARED_LANDMARKS}, better 20; mark more"
        )
    places = np.stack([_unrolled(face, names) for face in faces])
    middle = places.mean(axis=1, keepdims=True)
    spread = np.sqrt(((places - middle) ** 2).sum(axis=2).mean(axis=1))[:, None, None]
    if not np.all(spread > 0):
        got = "got one point for all of a face, expected points all over it"
        raise ParameterizationError(f"landmarks: {got}; mark them again")
    mean = ((places - middle) / spread).mean(axis=0) * float(spread.mean())
    return names, mean - mean[names.index(NOSE_LANDMARK)]


def _unrolled(landmarks: Mapping[str, Point], names: Sequence[str]) -> Float64Array:
    """Return landmarks of a face unrolled about its nose, (K, 2)."""
    return Cylinder(landmarks[NOSE_LANDMARK]).unroll([landmarks[name] for name in names])


def fit_correspondence(
    landmarks: Mapping[str, Point], frame: CommonFrame, *, stderr_mm: float = 1.0
) -> Correspondence:
    """Fit the warp of a face's landmarks to those of the common map.

    Parameters
    ----------
    landmarks
        Name to x, y, z, mm, rig frame; only those in the frame are used.
    frame
        The common map.
    stderr_mm
        Standard error of a landmark's position along each axis, above 0.

    Returns
    -------
    Correspondence

    Raises
    ------
    ParameterizationError
        For too few landmarks, landmarks on one line, or a map with folds; the message names the
        landmark that fits the others least.
    """
    names = [name for name in frame.names if name in landmarks]
    if NOSE_LANDMARK not in names or len(names) < MIN_SHARED_LANDMARKS:
        raise ParameterizationError(
            f"landmarks: got {len(names)} of the common map "
            f"({', '.join(names) or 'none'}), expected at least {MIN_SHARED_LANDMARKS}, "
            f"{NOSE_LANDMARK!r} among them; mark more"
        )
    cylinder = Cylinder(landmarks[NOSE_LANDMARK])
    own = _unrolled(landmarks, names)
    common = np.array([frame.landmark(name) for name in names])
    try:
        field = landmark_field.fit_landmark_field(own, common, stderr_px=stderr_mm)
    except LandmarkFieldError as error:
        raise ParameterizationError(str(error).replace("stderr_px", "stderr_mm")) from error
    if field.has_folds():
        worst = names[int(np.argmax(field.leave_one_out_px))]
        raise ParameterizationError(
            f"landmarks: the map through them has folds; {worst!r} is "
            f"{field.leave_one_out_px.max():.0f} mm from where the others put it; check that no "
            "two of them are exchanged, nor left and right (as seen in the image)"
        )
    return Correspondence(cylinder, field)


def fit_common_frame(
    names: tuple[str, ...],
    landmarks_mm: Float64Array,
    positions_mm: Sequence[Float64Array],
    *,
    size: int,
) -> CommonFrame:
    """Return a square common map that covers the range of most faces.

    Parameters
    ----------
    names, landmarks_mm
        See `average_landmarks`.
    positions_mm
        Unrolled positions of each face's texels, (n, 2).
    size
        Pixels per side.
    """
    low = np.median([np.quantile(at, 0.01, axis=0) for at in positions_mm], axis=0)
    high = np.median([np.quantile(at, 0.99, axis=0) for at in positions_mm], axis=0)
    # at most a quarter turn to either side: beyond it are ears and hair
    reach = 0.5 * math.pi * CYLINDER_RADIUS_MM
    low[0], high[0] = max(low[0], -reach), min(high[0], reach)
    middle = 0.5 * (low + high)
    side = float(np.max(high - low))
    return CommonFrame(names, landmarks_mm, (float(middle[0]), float(middle[1])), side, size)
