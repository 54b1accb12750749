"""Maps of one picture brought to the texture of a mesh, through landmarks of both.

Named points of the mesh and of the picture tell the picture's camera (a projective one), and a
smooth field takes up what is left: another head's shape. Texels that the camera saw aslant or not
at all are left empty.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import ndimage

from reconstruction.correspondence import landmark_field
from skinrig.arrays import BoolArray, Float64Array, FloatArray

Points2 = Mapping[str, tuple[float, float]]
Points3 = Mapping[str, tuple[float, float, float]]

MIN_LANDMARKS: Final = 7
"""Landmarks; a projective camera has 11 unknowns, and each landmark tells two."""
MIN_VIEW_COSINE: Final = 0.3
"""Between surface and view: texels more aslant are not taken from the picture."""
LANDMARK_STDERR_PX: Final = 1.0
"""Of a landmark along each axis."""


class PlacingError(ValueError):
    """Landmarks that do not tell where a picture lies on a mesh."""


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Where each texel of a mesh lies in a picture.

    Attributes
    ----------
    pixel : ndarray of float64, shape (N, N, 2)
        Column and row.
    seen : ndarray of bool, shape (N, N)
        Texels that the camera faced.
    leave_one_out_px : float
        Median distance of a landmark from where the others put it.
    landmarks : int
        How many were used.
    """

    pixel: Float64Array
    seen: BoolArray
    leave_one_out_px: float
    landmarks: int

    def sampled(self, values: FloatArray, valid: BoolArray) -> tuple[Float64Array, BoolArray]:
        """Return a map of the picture in the texture, (N, N), and where it is known.

        Parameters
        ----------
        values
            (H, W).
        valid
            (H, W).
        """
        at = np.stack([self.pixel[..., 1], self.pixel[..., 0]])
        share = ndimage.map_coordinates(valid.astype(np.float64), at, order=1, cval=0.0)
        held = np.where(valid, values, 0.0).astype(np.float64)
        total = ndimage.map_coordinates(held, at, order=1, cval=0.0)
        known = self.seen & (share > 0.5)
        return np.where(known, total / np.maximum(share, 1e-9), 0.0), known


def place(
    position_mm: FloatArray,
    normal: FloatArray,
    covered: BoolArray,
    *,
    landmarks_mm: Points3,
    landmarks_px: Points2,
) -> Placement:
    """Find where the texels of a mesh lie in a picture.

    Parameters
    ----------
    position_mm, normal
        Surface point and unit normal of each texel, (N, N, 3).
    covered
        Texels that have a surface, (N, N).
    landmarks_mm, landmarks_px
        Named points of the mesh and of the picture; those of the same name are used.

    Raises
    ------
    PlacingError
        Fewer than `MIN_LANDMARKS` names in both, or points that lie too flat or on a line.
    """
    names = sorted(set(landmarks_mm) & set(landmarks_px))
    if len(names) < MIN_LANDMARKS:
        raise PlacingError(
            f"landmarks: {len(names)} names are in both the picture's table and the mesh, "
            f"expected at least {MIN_LANDMARKS}; the mesh has {', '.join(sorted(landmarks_mm))}"
        )
    solid = np.array([landmarks_mm[name] for name in names], np.float64)
    flat = np.array([landmarks_px[name] for name in names], np.float64)
    camera = _camera(solid, flat)
    try:
        field = landmark_field.fit(_project(camera, solid), flat, stderr_px=LANDMARK_STDERR_PX)
    except landmark_field.LandmarkFieldError as error:
        raise PlacingError(f"landmarks: {error}") from error
    pixel = np.zeros((*covered.shape, 2))
    direct = _project(camera, position_mm[covered].astype(np.float64))
    low = np.floor(direct.min(axis=0))
    # the field is smooth: nodes some pixels apart are enough
    shape = np.ceil(direct.max(axis=0) - low).astype(int) + 1
    moved, _ = _on_nodes(field, low, (int(shape[1]), int(shape[0])))
    at = (direct - low).T[::-1]
    shift = np.stack([ndimage.map_coordinates(moved[..., k], at, order=1) for k in range(2)], -1)
    pixel[covered] = direct + shift
    eye = _center(camera)
    way = eye - position_mm
    way /= np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-12)
    facing = np.sum(way * normal, axis=-1)
    return Placement(
        pixel,
        covered & (facing > MIN_VIEW_COSINE),
        float(np.median(field.leave_one_out_px)),
        len(names),
    )


def _on_nodes(
    field: landmark_field.LandmarkField, low: Float64Array, shape: tuple[int, int]
) -> tuple[Float64Array, Float64Array]:
    shifted = landmark_field.fit(
        field.points_px - low, field.moved_px - low, stderr_px=field.stderr_px
    )
    return shifted.on_grid(shape)


def _camera(solid: Float64Array, flat: Float64Array) -> Float64Array:
    """Return the projective camera (3, 4) through points, by the normalized linear method."""
    middle, size = solid.mean(axis=0), float(np.sqrt(solid.var(axis=0).sum()))
    center, spread = flat.mean(axis=0), float(np.sqrt(flat.var(axis=0).sum()))
    if size == 0.0 or spread == 0.0:
        raise PlacingError("landmarks: all lie at one place, expected points all over the face")
    X = np.column_stack([(solid - middle) / size, np.ones(len(solid))])
    x = (flat - center) / spread
    zero = np.zeros_like(X)
    rows = np.vstack([np.hstack([X, zero, -x[:, :1] * X]), np.hstack([zero, X, -x[:, 1:] * X])])
    _, values, vectors = np.linalg.svd(rows)
    if values[-2] < 1e-4 * values[0]:
        raise PlacingError("landmarks: lie in one plane, expected nose and ears among them")
    P = vectors[-1].reshape(3, 4)
    from_solid = np.eye(4)
    from_solid[:3, :3] /= size
    from_solid[:3, 3] = -middle / size
    to_flat = np.array([[spread, 0.0, center[0]], [0.0, spread, center[1]], [0.0, 0.0, 1.0]])
    full = to_flat @ P @ from_solid
    front = (full @ np.append(middle, 1.0))[2]
    return np.asarray(full * np.sign(front))


def _project(camera: Float64Array, points: Float64Array) -> Float64Array:
    seen = np.column_stack([points, np.ones(len(points))]) @ camera.T
    return np.asarray(seen[:, :2] / np.where(seen[:, 2:] > 1e-12, seen[:, 2:], np.inf))


def _center(camera: Float64Array) -> Float64Array:
    """Return where the camera stands: what it maps to nothing."""
    _, _, vectors = np.linalg.svd(camera)
    far = vectors[-1]
    return np.asarray(far[:3] / far[3])
