"""One map (u, v) for many faces: a face unrolled, and bent until its landmarks lie on the common.

A face is unrolled onto a cylinder about a vertical axis behind its nose, which has no seams where a
face shows, and a thin-plate spline through named landmarks (a radial basis with an affine part)
takes it to where all faces have them. Texels are averaged into the common map and values read back
from it by the same coordinates, so that a change made there is continuous over the face, whatever
islands its own texture consists of.

References
----------
Pighin, Hecker, Lischinski, Szeliski, Salesin 1998, doi:10.1145/280814.280825
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 10.2 (20 points a face)
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
"""Of the cylinder; about that of a head, so that lengths on a cheek stay about what they are."""
MIN_SHARED_LANDMARKS: Final = 6
"""Named landmarks that two faces need in common: three for the affine part, as many again."""
NOSE_TIP_FRACTION: Final = 1e-3
"""Foremost texels that stand for the tip of the nose where no landmark names it."""
MIN_CHART_PX, MAX_CHART_PX = 16, 4096
_TEXELS_PER_BATCH: Final = 40_000
NOSE_LANDMARK: Final = "nose tip"


class ParameterizationError(ValueError):
    """Landmarks or positions that no common parameterization follows from."""


@dataclass(frozen=True, slots=True)
class Cylinder:
    """What a face is unrolled from.

    Attributes
    ----------
    tip_mm
        Tip of the nose, rig frame (+y up, +z out of the face); the axis is vertical,
        `CYLINDER_RADIUS_MM` behind it.
    """

    tip_mm: Point

    def unroll(self, position_mm: ArrayLike) -> Float64Array:
        """Return (u, v), mm: arc to the right of the nose's tip as seen, and height above it.

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
    """The common map: where its landmarks lie, and which part of the plane it shows.

    Attributes
    ----------
    names
        Of the landmarks.
    landmarks_mm
        (K, 2), u to the right and v up from the nose's tip.
    center_mm
        Middle of the map, (u, v).
    side_mm
        Length of its sides, above 0.
    size
        Pixels a side, 16 to 4096.
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
        """Side of a pixel."""
        return self.side_mm / self.size

    def to_pixel(self, uv_mm: ArrayLike) -> Float64Array:
        """Return (column, row) of places in the map, (..., 2); pixel (0, 0) is centred at 0, 0."""
        uv = (np.asarray(uv_mm, np.float64) - self.center_mm) / self.pixel_mm
        middle = 0.5 * (self.size - 1)
        return np.stack([middle + uv[..., 0], middle - uv[..., 1]], axis=-1)

    def grid_mm(self) -> Float64Array:
        """Return (u, v) of each pixel, (N, N, 2), row 0 at the top."""
        along = (np.arange(self.size) - 0.5 * (self.size - 1)) * self.pixel_mm
        u, v = np.meshgrid(along + self.center_mm[0], self.center_mm[1] - along)
        return np.stack([u, v], axis=-1)

    def landmark(self, name: str) -> Float64Array:
        """Return where a landmark lies, (2,), mm."""
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
        """Return the frame that `to_document` described.

        Raises
        ------
        ParameterizationError
            Naming what is missing or of another kind.
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
    """How one face lies in the common map.

    Attributes
    ----------
    cylinder
        What it is unrolled from.
    field
        Bends its landmarks onto the common ones; None: it is unrolled and no more.
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
            The error along each axis holds how precisely landmarks were placed and what a face
            may do between them; NaN without landmarks, where nothing says it.
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
    """Find what to unroll a face from by its foremost texels, where no landmark names its nose.

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
        raise ParameterizationError("position: no texel is valid")
    count = max(1, round(NOSE_TIP_FRACTION * len(points)))
    front = points[np.argpartition(points[:, 2], len(points) - count)[-count:]]
    x, y, z = np.median(front, axis=0)
    return Cylinder((float(x), float(y), float(z)))


def average_landmarks(faces: Sequence[Mapping[str, Point]]) -> tuple[tuple[str, ...], Float64Array]:
    """Return the landmarks that all faces have, and their mean places in the unrolled plane.

    Parameters
    ----------
    faces
        One or more: name to x, y, z, mm, rig frame; each with "nose tip".

    Returns
    -------
    names : tuple of str
    landmarks_mm : ndarray, shape (K, 2)
        Mean of the faces, each brought to the mean size about the landmarks' middle first.

    Raises
    ------
    ParameterizationError
        When fewer than `MIN_SHARED_LANDMARKS` are common, or one face lacks the nose's tip.
    """
    if not faces:
        raise ParameterizationError("landmarks: got no face")
    names = tuple(name for name in faces[0] if all(name in face for face in faces))
    if NOSE_LANDMARK not in names:
        raise ParameterizationError(
            f"landmarks: {NOSE_LANDMARK!r} is missing of a face, expected it of all"
        )
    if len(names) < MIN_SHARED_LANDMARKS:
        raise ParameterizationError(
            f"landmarks: all faces have {len(names)} in common ({', '.join(names) or 'none'}), "
            f"expected at least {MIN_SHARED_LANDMARKS}, better 20"
        )
    places = np.stack([_unrolled(face, names) for face in faces])
    middle = places.mean(axis=1, keepdims=True)
    spread = np.sqrt(((places - middle) ** 2).sum(axis=2).mean(axis=1))[:, None, None]
    if not np.all(spread > 0):
        raise ParameterizationError("landmarks: all of a face lie at one point")
    mean = ((places - middle) / spread).mean(axis=0) * float(spread.mean())
    return names, mean - mean[names.index(NOSE_LANDMARK)]


def _unrolled(landmarks: Mapping[str, Point], names: Sequence[str]) -> Float64Array:
    """Return some landmarks of a face unrolled by its nose, (K, 2)."""
    return Cylinder(landmarks[NOSE_LANDMARK]).unroll([landmarks[name] for name in names])


def fit_correspondence(
    landmarks: Mapping[str, Point], frame: CommonFrame, *, stderr_mm: float = 1.0
) -> Correspondence:
    """Find how a face's landmarks lie in the common map.

    Parameters
    ----------
    landmarks
        Name to x, y, z, mm, rig frame; those that the frame knows count.
    frame
        The common map.
    stderr_mm
        Of a landmark's place along each axis, above 0.

    Returns
    -------
    Correspondence

    Raises
    ------
    ParameterizationError
        For too few landmarks, some on one line, or such that the map folds, naming the one that
        fits the others least.
    """
    names = [name for name in frame.names if name in landmarks]
    if NOSE_LANDMARK not in names or len(names) < MIN_SHARED_LANDMARKS:
        raise ParameterizationError(
            f"landmarks: got {len(names)} that the common map knows "
            f"({', '.join(names) or 'none'}), expected at least {MIN_SHARED_LANDMARKS} and "
            f"{NOSE_LANDMARK!r} among them"
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
            f"landmarks: no map without folds goes through them; {worst!r} lies "
            f"{field.leave_one_out_px.max():.0f} mm from where the others put it: are two of "
            "them exchanged, or left and right (as seen in the image)?"
        )
    return Correspondence(cylinder, field)


def fit_common_frame(
    names: tuple[str, ...],
    landmarks_mm: Float64Array,
    positions_mm: Sequence[Float64Array],
    *,
    size: int,
) -> CommonFrame:
    """Return a square map that shows what most faces show.

    Parameters
    ----------
    names, landmarks_mm
        As `average_landmarks` gives them.
    places_mm
        Of each face, unrolled places of its texels, (n, 2).
    size
        Pixels a side.
    """
    low = np.median([np.quantile(at, 0.01, axis=0) for at in positions_mm], axis=0)
    high = np.median([np.quantile(at, 0.99, axis=0) for at in positions_mm], axis=0)
    # no wider than a quarter turn to either side: beyond it a face shows ears and hair
    reach = 0.5 * math.pi * CYLINDER_RADIUS_MM
    low[0], high[0] = max(low[0], -reach), min(high[0], reach)
    middle = 0.5 * (low + high)
    side = float(np.max(high - low))
    return CommonFrame(names, landmarks_mm, (float(middle[0]), float(middle[1])), side, size)
