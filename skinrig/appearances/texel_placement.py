"""Place the texels of a mesh in an image by landmarks of both."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import ndimage

from reconstruction.correspondence import landmark_field
from skinrig.arrays import BoolArray, Float64Array, FloatArray

Points2 = Mapping[str, tuple[float, float]]
Points3 = Mapping[str, tuple[float, float, float]]


class PlacementError(ValueError):
    """Landmarks that do not place a mesh in an image."""


MIN_LANDMARKS: Final = 7
"""Minimum number of landmarks: a projective camera has 11 unknowns, a landmark two equations."""
MIN_VIEW_COSINE: Final = 0.3
"""Minimum cosine of normal and view; more oblique texels are not sampled from the image."""
LANDMARK_STDERR_PX: Final = 1.0
"""Standard uncertainty of a landmark per axis."""
MIN_STDERR_PX: Final = 0.5
"""Least standard error of a texel's place, by the mesh between landmarks and the lens."""


@dataclass(frozen=True, slots=True, eq=False)
class TexelPlacement:
    """Positions of a mesh's texels in an image.

    Attributes
    ----------
    pixel : ndarray of float64, shape (N, N, 2)
        Column and row.
    visible : ndarray of bool, shape (N, N)
        Texels visible from the camera.
    leave_one_out_px : float
        Median distance of a landmark from its prediction by the others.
    landmarks : int
        Number of landmarks used.
    """

    pixel: Float64Array
    visible: BoolArray
    leave_one_out_px: float
    landmarks: int

    @property
    def stderr_px(self) -> float:
        """Standard error of a texel's place along each axis, px.

        It is that of a Rayleigh distribution with the median `leave_one_out_px`, at least
        `MIN_STDERR_PX`.
        """
        return max(self.leave_one_out_px / 1.1774, MIN_STDERR_PX)

    def sample(self, values: FloatArray, valid: BoolArray) -> tuple[Float64Array, BoolArray]:
        """Resample a map of the image to the texture, (N, N), with its valid texels.

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
        known = self.visible & (share > 0.5)
        return np.where(known, total / np.maximum(share, 1e-9), 0.0), known


def place_texels(
    position_mm: FloatArray,
    normal: FloatArray,
    covered: BoolArray,
    *,
    landmarks_mm: Points3,
    landmarks_px: Points2,
) -> TexelPlacement:
    """Find the positions of a mesh's texels in an image.

    Parameters
    ----------
    position_mm, normal
        Surface point and unit normal of each texel, (N, N, 3).
    covered
        Texels of the surface, (N, N).
    landmarks_mm, landmarks_px
        Named points of the mesh and of the image; those of equal names are used.

    Raises
    ------
    PlacementError
        If fewer than `MIN_LANDMARKS` names are in both, or points are coplanar or collinear.
    """
    names = sorted(set(landmarks_mm) & set(landmarks_px))
    if len(names) < MIN_LANDMARKS:
        raise PlacementError(
            f"--landmarks: got {len(names)} names of both the image's table and the mesh, "
            f"expected at least {MIN_LANDMARKS}; the mesh has {', '.join(sorted(landmarks_mm))}"
        )
    solid = np.array([landmarks_mm[name] for name in names], np.float64)
    flat = np.array([landmarks_px[name] for name in names], np.float64)
    camera = _camera(solid, flat)
    try:
        field = landmark_field.fit_landmark_field(
            _project(camera, solid), flat, stderr_px=LANDMARK_STDERR_PX
        )
    except landmark_field.LandmarkFieldError as error:
        raise PlacementError(f"landmarks: {error}") from error
    pixel = np.zeros((*covered.shape, 2))
    direct = _project(camera, position_mm[covered].astype(np.float64))
    low = np.floor(direct.min(axis=0))
    # the deformation is smooth: it is evaluated at nodes some pixels apart
    shape = np.ceil(direct.max(axis=0) - low).astype(int) + 1
    nodes = landmark_field.fit_landmark_field(
        field.points_px - low, field.moved_px - low, stderr_px=field.stderr_px
    )
    moved, _ = nodes.evaluate_grid((int(shape[1]), int(shape[0])))
    at = (direct - low).T[::-1]
    shift = np.stack([ndimage.map_coordinates(moved[..., k], at, order=1) for k in range(2)], -1)
    pixel[covered] = direct + shift
    far = np.linalg.svd(camera)[2][-1]  # the projection center is the null space of the camera
    eye = far[:3] / far[3]
    way = eye - position_mm
    way /= np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-12)
    facing = np.sum(way * normal, axis=-1)
    return TexelPlacement(
        pixel,
        covered & (facing > MIN_VIEW_COSINE),
        float(np.median(field.leave_one_out_px)),
        len(names),
    )


def _camera(solid: Float64Array, flat: Float64Array) -> Float64Array:
    """Fit a projective camera, (3, 4), to points by the normalized direct linear transform."""
    middle, size = solid.mean(axis=0), float(np.sqrt(solid.var(axis=0).sum()))
    center, spread = flat.mean(axis=0), float(np.sqrt(flat.var(axis=0).sum()))
    if size == 0.0 or spread == 0.0:
        raise PlacementError(
            "--landmarks: got coincident points, expected points all over the face; correct them"
        )
    X = np.column_stack([(solid - middle) / size, np.ones(len(solid))])
    x = (flat - center) / spread
    zero = np.zeros_like(X)
    rows = np.vstack([np.hstack([X, zero, -x[:, :1] * X]), np.hstack([zero, X, -x[:, 1:] * X])])
    _, values, vectors = np.linalg.svd(rows)
    if values[-2] < 1e-4 * values[0]:
        raise PlacementError(
            "--landmarks: got coplanar points, expected also nose and ears; add them"
        )
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
