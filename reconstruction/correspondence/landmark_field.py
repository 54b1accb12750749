"""Fit a smooth displacement field through landmarks, with a smoothness set by their errors.

Thin-plate splines are the most probable fields when displacements are a Gaussian process whose
generalized covariance is ``strength * r^2 log r`` over an unknown affine map. The strength of the
deformation is estimated from the landmarks by restricted maximum likelihood, given their standard
error. The ratio of error variance to strength is the spline's smoothing. The same process gives the
field's standard error between landmarks.

References
----------
Wahba 1990, Spline Models for Observational Data, chapters 2 and 4, doi:10.1137/1.9781611970128
Cressie 1993, Statistics for Spatial Data, section 3.4, doi:10.1002/9781119115151
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RBFInterpolator
from scipy.optimize import minimize_scalar

from model.checks import Checks
from reconstruction.arrays import Float64Array
from reconstruction.registration import RegistrationError

MIN_FIELD_POINTS = 4
"""Minimum number of points that separates noise from deformation."""
FIELD_GRID_PX = 8
"""Spacing of the nodes at which a field is evaluated before it is interpolated."""
MIN_LANDMARK_STDERR_PX = 1e-3
"""Minimum standard error of a landmark."""
_MAX_STRENGTH = 1e8


class LandmarkFieldError(RegistrationError):
    """Landmarks that determine no displacement field."""


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkField:
    """Displacement of an image's points, known at landmarks.

    Attributes
    ----------
    points_px : ndarray of float64, shape (K, 2)
        Landmarks in the first image, column and row.
    moved_px : ndarray of float64, shape (K, 2)
        The same in the second image.
    stderr_px : float
        Standard error of a landmark's displacement along each axis.
    strength : float
        Strength of the deformation: factor of the generalized covariance, px^2, with lengths in
        units of `scale_px`; 0 when an affine map explains all.
    scale_px : float
        Unit of length: root mean square distance of the landmarks from their centroid.
    leave_one_out_px : ndarray of float64, shape (K,)
        Distance of each landmark from its prediction by the others.
    """

    points_px: Float64Array
    moved_px: Float64Array
    stderr_px: float
    strength: float
    scale_px: float
    leave_one_out_px: Float64Array
    _inverse: Float64Array

    @property
    def smoothing(self) -> float:
        """Smoothing of the thin-plate spline: noise over strength."""
        return self.stderr_px**2 / max(self.strength, self.stderr_px**2 / _MAX_STRENGTH)

    def evaluate_grid(self, shape: tuple[int, int]) -> tuple[Float64Array, Float64Array]:
        """Return the displacement (H, W, 2) and its standard error along each axis (H, W), px.

        Parameters
        ----------
        shape
            Rows and columns of the first image.
        """
        rows = np.arange(0.0, shape[0] - 1 + FIELD_GRID_PX, FIELD_GRID_PX)
        columns = np.arange(0.0, shape[1] - 1 + FIELD_GRID_PX, FIELD_GRID_PX)
        nodes = np.stack(np.meshgrid(columns, rows), axis=-1)
        moved, error = self.evaluate(nodes.reshape(-1, 2))
        coarse = np.dstack([moved.reshape(*nodes.shape[:2], 2), error.reshape(nodes.shape[:2])])
        x, y = np.meshgrid(
            np.arange(shape[1], dtype=np.float32) / FIELD_GRID_PX,
            np.arange(shape[0], dtype=np.float32) / FIELD_GRID_PX,
        )
        fine = cv2.remap(
            coarse.astype(np.float32), x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        ).astype(np.float64)
        return fine[..., :2], np.maximum(fine[..., 2], 0.0)

    def has_folds(self) -> bool:
        """Return whether the field folds, within the landmarks' extent plus a fifth."""
        low, high = self.points_px.min(axis=0), self.points_px.max(axis=0)
        rim = 0.2 * (high - low)
        along = [np.linspace(a - r, b + r, 40) for a, b, r in zip(low, high, rim, strict=True)]
        points = np.stack(np.meshgrid(*along), axis=-1)
        moved = points + self.evaluate(points.reshape(-1, 2))[0].reshape(points.shape)
        du, dv = np.diff(moved, axis=1)[:-1], np.diff(moved, axis=0)[:, :-1]
        return bool(np.any(du[..., 0] * dv[..., 1] - du[..., 1] * dv[..., 0] <= 0.0))

    def evaluate(self, points_px: ArrayLike) -> tuple[Float64Array, Float64Array]:
        """Return displacement (N, 2) and standard error along each axis (N,) at points, px.

        Parameters
        ----------
        points_px
            Shape (N, 2), column and row in the first image.
        """
        points = np.asarray(points_px, np.float64).reshape(-1, 2)
        middle = self.points_px.mean(axis=0)
        at = (points - middle) / self.scale_px
        known = (self.points_px - middle) / self.scale_px
        spline = RBFInterpolator(
            known,
            self.moved_px - self.points_px,
            smoothing=self.smoothing,
            kernel="thin_plate_spline",
        )
        away = np.linalg.norm(at[:, None] - known, axis=-1)
        row = np.hstack([_kernel(away), np.ones((len(at), 1)), at])
        # universal kriging: with the affine map estimated, the variance is -k' S^-1 k times the
        # strength, for the bordered system S of kernel and affine terms and its row k at a point
        rest = np.maximum(-np.einsum("ni,ij,nj->n", row, self._inverse, row), 0.0)
        variance = rest * self.stderr_px**2 / self.smoothing
        return np.asarray(spline(at)), np.sqrt(variance)


def fit_landmark_field(
    points_px: ArrayLike, moved_px: ArrayLike, *, stderr_px: float
) -> LandmarkField:
    """Fit a smooth displacement field to landmarks.

    Parameters
    ----------
    points_px, moved_px : array_like, shape (K, 2)
        Column and row of the same points in two images, K at least `MIN_FIELD_POINTS`.
    stderr_px : float
        Standard error of a displacement along each axis, above 0.

    Returns
    -------
    LandmarkField

    Raises
    ------
    LandmarkFieldError
        For too few points, points on one line, or non-finite values.

    Examples
    --------
    >>> corners = np.array([[0, 0], [0, 90], [90, 0], [90, 90], [40, 50]], float)
    >>> field = fit_landmark_field(corners, 1.1 * corners + 3, stderr_px=0.5)
    >>> field.evaluate([[45, 45]])[0].round(2).tolist()
    [[7.5, 7.5]]
    """
    check = Checks(LandmarkFieldError)
    first = check.numbers("landmarks", np.array(points_px, np.float64), ("K", 2))
    second = check.numbers("landmarks", np.array(moved_px, np.float64), first.shape)
    check.within("landmarks", len(first), f"[{MIN_FIELD_POINTS}, inf)")
    check.within("stderr_px", stderr_px, "(0, inf)")
    noise = max(stderr_px, MIN_LANDMARK_STDERR_PX)
    middle = first.mean(axis=0)
    scale = float(np.sqrt(((first - middle) ** 2).sum(axis=1).mean()))
    known = (first - middle) / max(scale, 1e-12)
    affine = np.column_stack([np.ones(len(first)), known])
    if scale == 0.0 or np.linalg.svd(affine, compute_uv=False)[-1] < 1e-3:
        got = "got points on one line, expected points all over the face"
        raise LandmarkFieldError(f"landmarks: {got}; mark others")
    kernel = _kernel(np.linalg.norm(known[:, None] - known, axis=-1))
    displacement = second - first
    strength = _likeliest_strength(kernel, affine, displacement, noise)
    smoothing = noise**2 / max(strength, noise**2 / _MAX_STRENGTH)
    system = np.zeros((len(first) + 3,) * 2)
    system[: len(first), : len(first)] = kernel + smoothing * np.eye(len(first))
    system[: len(first), len(first) :] = affine
    system[len(first) :, : len(first)] = affine.T
    inverse: Float64Array = np.asarray(np.linalg.inv(system), np.float64)
    # leave-one-out residual i of a linear smoother: (S^-1 d)_i / (S^-1)_ii
    own = inverse[: len(first), : len(first)]
    left_out = (own @ displacement) / np.maximum(np.diag(own), 1e-300)[:, None]
    return LandmarkField(
        first, second, noise, strength, scale, np.linalg.norm(left_out, axis=1), inverse
    )


def _kernel(away: Float64Array) -> Float64Array:
    """Return r^2 log r, 0 at 0."""
    return np.asarray(away**2 * np.log(np.where(away > 0, away, 1.0)))


def _likeliest_strength(
    kernel: Float64Array, affine: Float64Array, displacement: Float64Array, noise: float
) -> float:
    """Estimate the strength of the deformation by restricted maximum likelihood."""
    # contrasts orthogonal to the affine map are independent of it: in the eigenbasis of their
    # kernel their variances are strength * eigenvalue + noise^2
    count = len(kernel)
    free = np.linalg.qr(affine, mode="complete")[0][:, affine.shape[1] :]
    if not free.shape[1]:
        return 0.0
    values, vectors = np.linalg.eigh(free.T @ kernel @ free)
    values = np.maximum(values, 0.0)
    parts = (vectors.T @ (free.T @ displacement)) ** 2

    def cost(log_strength: float) -> float:
        variance = math.exp(log_strength) * values + noise**2
        return float(
            displacement.shape[1] * np.log(variance).sum() + (parts / variance[:, None]).sum()
        )

    unit = noise**2
    low, high = math.log(unit / _MAX_STRENGTH), math.log(_MAX_STRENGTH * unit)
    # the likelihood may have several maxima: start at the best of a coarse grid
    tried = np.linspace(low, high, 2 * count if count < 40 else 80)
    best = int(np.argmin([cost(x) for x in tried]))
    found = minimize_scalar(
        cost,
        bounds=(tried[max(best - 1, 0)], tried[min(best + 1, len(tried) - 1)]),
        method="bounded",
        options={"xatol": 1e-4},
    )
    return math.exp(float(found.x))
