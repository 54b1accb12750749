"""Fit the mean head to a person's scan, for parts of the head that no rig measures."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from scipy.interpolate import RegularGridInterpolator

from model.checks.files import read_arrays
from reconstruction.scan.face_template import FaceTemplate
from reconstruction.scan.repair import TriangleMesh
from reconstruction.scan.template_wrapping import wrap_template
from rigsim.geometry.mesh import Mesh, build_mesh
from rigsim.subject.head import build_head
from skinrig.arrays import BoolArray, Float64Array

FIT_GRID: Final = (61, 57)
"""Rows and columns of the fitted grid, 6 mm apart: a finer one fits no better within the scan."""
FIT_STEPS: Final = 4
"""Stiffnesses of the fit; eight move the crown by less than the stated error, in 1.5 times the
time."""
DRAWN_GRID: Final = (121, 113)
"""Rows and columns of the head as drawn, 3 mm apart."""
MIN_STDERR_MM: Final = 0.12
"""Least standard error across the surface, the scan's noise."""
EYE_MM: Final = (31.5, 21.0, -12.0)
"""Middle of the right closed lids of the mean head."""
EYE_REACH_MM: Final = 14.0
"""Standard deviation of the weights with which the surroundings of an eye locate it."""
MAX_TURN_RAD: Final = 0.35
"""Largest rotation of a head that the drawn eyes, which look along z, allow."""

_ARRAYS: Final = ("vertices_mm", "stderr_mm", "measured")


class HeadFitError(ValueError):
    """A fitted head that is damaged, or not usable for drawing."""


@dataclass(frozen=True, slots=True, eq=False)
class FittedHead:
    """The mean head, deformed to a scan.

    Attributes
    ----------
    vertices_mm : ndarray of float64, shape (R, C, 3)
        Positions on the grid of `rigsim.subject.head.build_head`, frame of the scan, mm.
    stderr_mm : ndarray of float64, shape (R, C)
        Standard error across the surface.
    measured : ndarray of bool, shape (R, C)
        Whether the scan has data there; elsewhere the position is the template's.
    """

    vertices_mm: Float64Array
    stderr_mm: Float64Array
    measured: BoolArray

    def to_bytes(self) -> bytes:
        """Return the fit as the bytes of an .npz file."""
        stream = io.BytesIO()
        np.savez_compressed(
            stream,
            vertices_mm=self.vertices_mm.astype(np.float32),
            stderr_mm=self.stderr_mm.astype(np.float32),
            measured=self.measured,
        )
        return stream.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes, name: str) -> FittedHead:
        """Read a fit.

        Raises
        ------
        HeadFitError
            If it is damaged; the message has the name of the file.
        """
        try:
            arrays = read_arrays(data)
            vertices, stderr = (np.asarray(arrays[key], np.float64) for key in _ARRAYS[:2])
            measured = np.asarray(arrays[_ARRAYS[2]], bool)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise HeadFitError(
                f"{name}: not readable ({error}); run `skinrig fuse` again"
            ) from error
        shape = FIT_GRID
        if (vertices.shape, stderr.shape, measured.shape) != ((*shape, 3), shape, shape) or not (
            np.isfinite(vertices).all() and np.isfinite(stderr).all()
        ):
            raise HeadFitError(
                f"{name}: got arrays of shape {vertices.shape}, {stderr.shape}, {measured.shape}, "
                f"expected finite numbers for {shape[0]} x {shape[1]} points; run `skinrig fuse` "
                "again"
            )
        return cls(vertices, stderr, measured)

    def draw(self) -> tuple[Mesh, Float64Array]:
        """Return the head on a grid of `DRAWN_GRID`, and the standard error of its vertices.

        Returns
        -------
        mesh
            The mean head with the interpolated displacement of the fit.
        stderr_mm : ndarray of float64, shape (V,)
        """
        mean = mean_head(DRAWN_GRID)
        moved = self.vertices_mm - mean_head(FIT_GRID).vertices_mm.reshape(*FIT_GRID, 3)
        both = np.concatenate([moved, self.stderr_mm[..., None]], axis=-1)
        axes = tuple(np.linspace(0.0, 1.0, count) for count in FIT_GRID)
        found = RegularGridInterpolator(axes, both)(mean.uv[:, ::-1].astype(np.float64))
        return build_mesh(mean.vertices_mm + found[:, :3], mean.faces, mean.uv), found[:, 3]

    def locate_eye(self, side: float) -> tuple[Float64Array, Float64Array]:
        """Return the rotation and the translation from the mean head's eye to the person's.

        Eyes keep the mean head's size.

        Parameters
        ----------
        side
            1 for the eye on the image's right (x > 0), -1 for the other one.

        Returns
        -------
        rotation : ndarray of float64, shape (3, 3)
        translation_mm : ndarray of float64, shape (3,)
            A point p of the mean head is at ``rotation @ p + translation_mm``.
        """
        mean = mean_head(FIT_GRID).vertices_mm.astype(np.float64)
        rotation, a, b, _ = _fit_similarity(
            mean, self.vertices_mm.reshape(-1, 3), _weigh_eye(mean, side)
        )
        return rotation, b - rotation @ a

    def measured_near_eye(self, side: float) -> float:
        """Return the fraction of the surroundings of an eye where the scan has data, 0 to 1.

        Parameters
        ----------
        side
            As of `locate_eye`.
        """
        weight = _weigh_eye(mean_head(FIT_GRID).vertices_mm.astype(np.float64), side)
        return float(weight @ self.measured.reshape(-1) / weight.sum())

    def locate_head(self) -> tuple[Float64Array, Float64Array, float]:
        """Return the similarity from the mean head to the person's.

        Returns
        -------
        rotation : ndarray of float64, shape (3, 3)
        translation_mm : ndarray of float64, shape (3,)
        scale : float
            A point p of the mean head is at ``scale * rotation @ p + translation_mm``.
        """
        mean = mean_head(FIT_GRID).vertices_mm.astype(np.float64)
        weight = self.measured.reshape(-1) / self.stderr_mm.reshape(-1) ** 2
        rotation, a, b, scale = _fit_similarity(mean, self.vertices_mm.reshape(-1, 3), weight)
        return rotation, b - scale * rotation @ a, scale


@lru_cache(maxsize=2)
def mean_head(shape: tuple[int, int]) -> Mesh:
    """Return the mean head of the simulation on a grid of rows and columns of vertices."""
    return build_head(None, rows=shape[0] - 1, columns=shape[1] - 1)


def fit_head(
    scan: Mesh, landmarks_mm: Mapping[str, tuple[float, float, float]] | None = None
) -> FittedHead:
    """Fit the mean head to a scan of a face.

    Parameters
    ----------
    scan
        Mesh of the maps, mm; the face looks along +z.
    landmarks_mm
        Points of the scan by name, mm; those of the mean head's names guide the fit.

    Raises
    ------
    reconstruction.scan.repair.ScanMeshError
        If the scan does not contain a face.
    HeadFitError
        If the face looks elsewhere.
    """
    from rigsim.subject.landmarks import find_landmarks

    mean = mean_head(FIT_GRID)
    faces = mean.faces.astype(np.int64)
    known = find_landmarks(mean)
    places = dict(zip(known.names, known.positions_on(mean), strict=True))
    given = {name: np.array(at) for name, at in (landmarks_mm or {}).items() if name in places}
    uv = mean.uv.astype(np.float64)[faces]
    template = FaceTemplate(TriangleMesh(mean.vertices_mm.astype(np.float64), faces, uv), places)
    surface = TriangleMesh(scan.vertices_mm.astype(np.float64), scan.faces.astype(np.int64))
    wrapped = wrap_template(
        template, surface, landmarks_mm=given or None, search=False, steps=FIT_STEPS
    )
    stderr = np.hypot(wrapped.across_mm, MIN_STDERR_MM)
    fit = FittedHead(
        wrapped.mesh.vertices_mm.reshape(*FIT_GRID, 3),
        stderr.reshape(FIT_GRID),
        wrapped.valid.reshape(FIT_GRID),
    )
    turn = float(np.arccos(np.clip(0.5 * (np.trace(fit.locate_head()[0]) - 1.0), -1.0, 1.0)))
    if turn > MAX_TURN_RAD:
        raise HeadFitError(
            f"scan: got a face turned by {np.degrees(turn):.0f} degrees, expected at most "
            f"{np.degrees(MAX_TURN_RAD):.0f} from +z; rotate the scan"
        )
    return fit


def _weigh_eye(mean_mm: Float64Array, side: float) -> Float64Array:
    """Return the weights of the mean head's vertices around an eye, shape (V,)."""
    away = mean_mm - np.array(EYE_MM) * (side, 1.0, 1.0)
    return np.asarray(np.exp(-0.5 * np.sum((away / EYE_REACH_MM) ** 2, axis=1)))


def _fit_similarity(
    source: Float64Array, target: Float64Array, weight: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array, float]:
    """Return rotation, both centroids and scale of least weighted squares (Umeyama 1991)."""
    weight = weight / weight.sum()
    a, b = weight @ source, weight @ target
    spread = weight[:, None] * (source - a)
    covariance = (target - b).T @ spread
    u, _, vt = np.linalg.svd(covariance)
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * flip) @ vt
    scale = float(np.sum(rotation * covariance) / np.sum(spread * (source - a)))
    return rotation, a, b, scale
