"""Register a scan to the dome: find the rigid motion that makes its normals match photographs.

Each view alone gives normals by photometric stereo, which needs no exact geometry: a scan that is a
few millimeters off moves the directions to the lights by a fraction of a degree. The motion is
the one under which the scan's normals, rotated and projected into all views, agree with these.
Rotating the scan rotates its normals, so rotation follows from thousands of normals; translation
follows from the curvature at nose, eyes and mouth. Texture, landmarks or a true mesh are not used.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage
from scipy.spatial.transform import Rotation

from model.checks import Checks
from model.solver_outcome import SolverOutcome, estimate_condition
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int64Array
from reconstruction.lumitexels import LightSources, SampledSurface, compute_visibility
from reconstruction.lumitexels.ray_casting import RayCaster
from reconstruction.scan.repair import TriangleMesh
from reconstruction.scan.rough_normals import (
    NormalEvidence,
    RayCamera,
    ScanRegistrationError,
    estimate_rough_normals,
)

_log = logging.getLogger(__name__)

MAX_IMAGE_WIDTH_PX: Final = 320
"""Width down to which larger images are binned 2 x 2."""
MAX_BLUR_STEPS: Final = 12
"""Gauss-Newton steps for each blur."""
MIN_SCAN_COSINE: Final = 0.35
"""Least cosine between normal and view of a used point: 70 degrees."""
ERROR_CELL_MM: Final = 20.0
"""Side of the cubes within which errors are taken as fully correlated."""
NOD_BIAS_RAD: Final = 0.0018
"""Standard deviation of a common error of photometric normals about the horizontal axis.

Light from below is weaker and returns from chin and chest, so that photographs turn all normals of
a head alike. Set on two dome sessions (types III and V) and four rendered heads: rotations about x
erred by -2.1, -2.7, -0.7, -1.5, -1.9 and -0.9 mrad, of which their scatter states 1.0."""
TURN_TOL_RAD: Final = 1e-4
SHIFT_TOL_MM: Final = 1e-2
"""Steps below which a registration ends."""
OSCILLATION_TOLS: Final = 10.0
"""Last step, in these tolerances, up to which an unfinished registration gives no warning."""
MAX_STILL_CHI_SQUARE: Final = 16.81
"""99 % quantile of chi-square of six degrees of freedom."""


@dataclass(frozen=True, slots=True, eq=False)
class RigidFit:
    """The motion from the scan's frame to the rig's, ``rotation @ p + translation_mm``."""

    rotation: Float64Array
    """Shape (3, 3)."""
    translation_mm: Float64Array
    """Shape (3,)."""
    center_mm: Float64Array
    """Center of the scan in the rig frame; errors of rotation and shift refer to it."""
    stderr: Float64Array
    """Of the rotation about x, y, z, rad, and of the shift of `center_mm` along x, y, z, mm: (6,).
    From the scatter of residuals between cells of the surface, and from how far the last blur
    moved the fit: a blur of curved surfaces shifts them."""
    residual_deg: float
    """Median angle between the scan's normals and the photographs'."""
    samples: int
    """Number of pairs of point and view used."""
    outcome: SolverOutcome
    """Of the steps at all blurs; the residual is the last step's size over its tolerance."""

    def move(self, points_mm: ArrayLike) -> Float64Array:
        """Transform points of the scan to the rig frame."""
        return np.asarray(points_mm, np.float64) @ self.rotation.T + self.translation_mm

    def is_significant(self) -> bool:
        """Return whether the motion differs from none by more than its standard errors explain.

        The sum of the squared motions over their variances, of six numbers, exceeds its 99 %
        quantile.
        """
        turn = Rotation.from_matrix(self.rotation).as_rotvec()
        before = (self.center_mm - self.translation_mm) @ self.rotation
        motion = np.concatenate([turn, self.center_mm - before])
        ratio = np.square(motion / np.maximum(self.stderr, 1e-12)).sum()
        return bool(ratio > MAX_STILL_CHI_SQUARE)


def register_scan(
    points_mm: ArrayLike,
    normals: ArrayLike,
    evidence: Sequence[NormalEvidence],
    *,
    visible: BoolArray | None = None,
    start: tuple[ArrayLike, ArrayLike] | None = None,
    blurs_px: Sequence[float] = (8.0, 3.0, 1.5, 0.5),
) -> RigidFit:
    """Find the rigid motion of a scan under which its normals match those of the views.

    Parameters
    ----------
    points_mm, normals : array_like, shape (P, 3)
        Of the scan, in its own frame; some thousand suffice.
    evidence : sequence of NormalEvidence
        One view or more; several for shifts along each view's axis.
    visible : ndarray of bool, shape (V, P), optional
        Points visible to each view; by default those that face it.
    start : (rotation, translation_mm), optional
        Initial guess; no motion by default.
    blurs_px : sequence of float
        Standard deviations of the blur of the normal maps, px, from coarse to fine.

    Returns
    -------
    RigidFit

    Raises
    ------
    ScanRegistrationError
        With fewer than 200 pairs of point and view, or if the motion is not determined.
    """
    p = np.asarray(points_mm, np.float64)
    n = np.asarray(normals, np.float64)
    Checks(ScanRegistrationError).shape("points_mm", p, ("P", 3))
    Checks(ScanRegistrationError).shape("normals", n, p.shape)
    if visible is None:
        visible = np.ones((len(evidence), len(p)), np.bool_)
    turn = np.eye(3) if start is None else np.asarray(start[0], np.float64)
    shift = np.zeros(3) if start is None else np.asarray(start[1], np.float64)
    middle = p.mean(axis=0)
    system = _System(np.zeros((6, 6)), np.zeros(6), np.zeros((0, 6)), np.zeros(0), 0)
    iterations, residual, step = 0, np.inf, np.zeros(6)
    at_blur: list[tuple[Float64Array, Float64Array]] = []
    for blur in blurs_px:
        maps = [_blurred(view, blur) for view in evidence]
        for _ in range(MAX_BLUR_STEPS):
            center = turn @ middle + shift
            system = _gauss_newton(p, n, turn, shift, center, maps, evidence, visible)
            if system.samples < 200:
                raise ScanRegistrationError(
                    f"samples: got {system.samples} visible points, expected at least 200; "
                    "check the calibration, and the scan's unit and frame"
                )
            step = -np.asarray(np.linalg.solve(system.matrix, system.gradient), np.float64)
            small = _rotation(step[:3])
            turn = small @ turn
            shift = small @ (shift - center) + center + step[3:]
            # bilinear maps have kinks between which steps of this size oscillate
            iterations += 1
            residual = float(
                max(
                    np.linalg.norm(step[:3]) / TURN_TOL_RAD, np.linalg.norm(step[3:]) / SHIFT_TOL_MM
                )
            )
            if residual < 1.0:
                break
        at_blur.append((turn, turn @ middle + shift))
    stderr = _clustered(system, p)
    if len(at_blur) > 1:
        (turn_before, center_before), (turn_last, center_last) = at_blur[-2:]
        turned = turn_last @ turn_before.T
        vector = 0.5 * np.array(
            [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
        )
        # the last step measures the size of the blur's error, not its direction
        sizes = [np.linalg.norm(v) / np.sqrt(3) for v in (vector, center_last - center_before)]
        stderr = np.hypot(stderr, np.repeat(sizes, 3))
    angle = np.degrees(2.0 * np.arcsin(np.clip(0.5 * np.median(system.size), 0.0, 1.0)))
    outcome = SolverOutcome(
        iterations,
        residual,
        estimate_condition(system.matrix),
        "tolerance" if residual < 1.0 else "limit",
    )
    # a fit that oscillates by less than its error is good
    level = np.maximum(stderr, OSCILLATION_TOLS * np.repeat([TURN_TOL_RAD, SHIFT_TOL_MM], 3))
    if (np.abs(step) > level).any():
        outcome.warn_unless_converged("registration of the scan", _log)
    return RigidFit(
        turn, shift, turn @ middle + shift, stderr, float(angle), system.samples, outcome
    )


def align_scan(
    mesh: TriangleMesh,
    *,
    cameras: Sequence[RayCamera],
    lights: LightSources,
    stacks: Callable[[int], FloatArray],
    binning: int = 1,
    points: int = 6000,
    rounds: int = 3,
    rng: np.random.Generator,
) -> RigidFit:
    """Register a scan to a dome from its own images.

    Parameters
    ----------
    mesh : TriangleMesh
        The cleaned scan in its own frame, within about 10 mm and 5 degrees of the rig's.
    cameras : sequence of RayCamera
    lights : LightSources
        Those of the images; 20 to 40 well distributed ones suffice.
    stacks : callable
        Returns the images of a view by its index, shape (L, H, W), NaN where not valid.
    binning : int
        Camera pixels along each side of an image pixel.
    points : int
        Number of vertices of the mesh used.
    rounds : int
        Rounds of photometric normals and fit; each uses the motion found before.
    rng : numpy.random.Generator
        Draws the points.

    Returns
    -------
    RigidFit
    """
    normals = mesh.normals()
    rows = rng.permutation(len(mesh.vertices_mm))[:points]
    p, n = mesh.vertices_mm[rows], normals[rows]
    images = []
    for view in range(len(cameras)):
        image, side = _binned(stacks(view))
        images.append((image, side * binning))
    fit: RigidFit | None = None
    for number in range(rounds):
        moved = mesh.vertices_mm if fit is None else fit.move(mesh.vertices_mm)
        caster = RayCaster(moved, mesh.faces)
        evidence = [
            estimate_rough_normals(
                image,
                camera,
                lights,
                caster,
                surface_normals=_face_normals(mesh.faces, normals, fit),
                binning=side,
            )
            for (image, side), camera in zip(images, cameras, strict=True)
        ]
        here = p if fit is None else fit.move(p)
        facing = n if fit is None else n @ fit.rotation.T
        seen = compute_visibility(
            SampledSurface(here.astype(np.float32), facing.astype(np.float32)),
            caster,
            cameras_mm=np.array([camera.center_mm for camera in cameras]),
            lights_mm=np.zeros((0, 3)),
            min_cosine=MIN_SCAN_COSINE,
        ).view
        fit = register_scan(
            p,
            n,
            evidence,
            visible=seen,
            start=None if fit is None else (fit.rotation, fit.translation_mm),
            blurs_px=(8.0, 3.0, 1.5, 0.5) if number == 0 else (1.5, 0.5),
        )
    if fit is None:
        raise ScanRegistrationError(f"rounds: got {rounds}, expected at least 1; set it higher")
    stderr = np.hypot(fit.stderr, [NOD_BIAS_RAD, 0.0, 0.0, 0.0, 0.0, 0.0])
    return replace(fit, stderr=stderr)


def _binned(stack: FloatArray) -> tuple[Float32Array, int]:
    """Return images up to `MAX_IMAGE_WIDTH_PX` wide, and the side of their pixels, with NaN."""
    image, side = np.asarray(stack, np.float32), 1
    while max(image.shape[1:]) > MAX_IMAGE_WIDTH_PX:
        height, width = (n - n % 2 for n in image.shape[1:])
        blocks = image[:, :height, :width].reshape(len(image), height // 2, 2, width // 2, 2)
        image, side = blocks.mean(axis=(2, 4)), 2 * side
    return image, side


def _face_normals(faces: Int64Array, normals: FloatArray, fit: RigidFit | None) -> Float64Array:
    """Return the mean vertex normal of each triangle, rotated by the fit."""
    mean = np.asarray(normals, np.float64)[faces].sum(axis=1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return mean if fit is None else mean @ fit.rotation.T


@dataclass(frozen=True, slots=True, eq=False)
class _System:
    """Normal equations of one Gauss-Newton step."""

    matrix: Float64Array
    gradient: Float64Array
    by_point: Float64Array
    """Gradient of each point, shape (P, 6)."""
    size: Float64Array
    """Length of each residual."""
    samples: int


def _blurred(view: NormalEvidence, blur_px: float) -> Float32Array:
    """Return weighted and blurred normals, and the weight, shape (H, W, 4)."""
    weight = ndimage.gaussian_filter(view.weight, blur_px)
    layers = [
        ndimage.gaussian_filter(view.normals[..., k] * view.weight, blur_px) for k in range(3)
    ]
    normals = np.stack(layers, axis=-1) / np.maximum(weight, 1e-6)[..., None]
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    known = (view.weight > 0) & (weight > 0.25 * float(weight.max()))
    # the rim is omitted, since a mean from one side is tilted
    inner = ndimage.binary_erosion(view.weight > 0, iterations=max(round(blur_px), 1))
    normals = np.where(length > 0.2, normals / np.maximum(length, 1e-6), 0.0)
    trust = np.where(known & inner, view.weight, 0.0)
    return np.concatenate([normals, trust[..., None]], axis=-1).astype(np.float32)


def _gauss_newton(
    p: Float64Array,
    n: Float64Array,
    rotation: Float64Array,
    shift: Float64Array,
    center: Float64Array,
    maps: Sequence[Float32Array],
    evidence: Sequence[NormalEvidence],
    visible: BoolArray,
) -> _System:
    points, model = p @ rotation.T + shift, n @ rotation.T
    rows, residuals, jacobians, trusts = [], [], [], []
    for view, layers, seen in zip(evidence, maps, visible, strict=True):
        to_camera = view.camera.center_mm - points
        to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
        cosine = np.einsum("pk,pk->p", to_camera, model)
        row = np.flatnonzero(seen & (cosine > MIN_SCAN_COSINE))
        at = _pixels(view, points[row])
        here = _sampled(layers, at)
        good = here[:, 3] > 0
        row, at, here = row[good], at[good], here[good]
        along = [
            0.5 * (_sampled(layers, at + d) - _sampled(layers, at - d))[:, :3] for d in np.eye(2)
        ]
        slope = np.stack(along, axis=-1)  # (K, 3, 2): of the normal over the pixels
        by_mm = np.stack(
            [(_pixels(view, points[row] + 0.05 * e) - at) / 0.05 for e in np.eye(3)], axis=-1
        )  # (K, 2, 3)
        by_point = slope @ by_mm
        # residual m(x) - R n; a small rotation w moves x by w x (x - c) and R n by w x R n
        jacobian = np.concatenate(
            [-by_point @ _cross(points[row] - center) + _cross(model[row]), by_point], axis=-1
        )
        rows.append(row)
        residuals.append(here[:, :3] - model[row])
        jacobians.append(jacobian)
        trusts.append(here[:, 3] * cosine[row])
    row = np.concatenate(rows)
    r, jacobian = np.concatenate(residuals), np.concatenate(jacobians)
    size = np.linalg.norm(r, axis=1)
    scale = 1.5 * float(np.median(size)) + 1e-6 if len(size) else 1.0
    # Cauchy weights, scaled by the median residual
    weight = np.concatenate(trusts) / (1.0 + (size / scale) ** 2)
    each = np.einsum("k,kij,ki->kj", weight, jacobian, r)
    by_point = np.stack([np.bincount(row, each[:, j], minlength=len(p)) for j in range(6)], axis=-1)
    matrix = np.einsum("k,kij,kil->jl", weight, jacobian, jacobian)
    matrix += 1e-9 * np.diag(np.diag(matrix)) + 1e-12 * np.eye(6)
    return _System(matrix, each.sum(axis=0), by_point, size, len(row))


def _clustered(system: _System, p: Float64Array) -> Float64Array:
    """Return standard errors from the scatter of the gradient between cells of the surface.

    The cluster-robust sandwich H^-1 (sum g_c g_c') H^-1, g_c the gradient's part of a cell.
    """
    _, cell = np.unique(np.floor(p / ERROR_CELL_MM).astype(int), axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    sums = np.stack([np.bincount(cell, system.by_point[:, j]) for j in range(6)], axis=-1)
    used = np.count_nonzero(np.abs(sums).sum(axis=1))
    Checks(ScanRegistrationError).within("cells with points", used, "(6, inf)")
    inverse = np.linalg.inv(system.matrix)
    spread = inverse @ (sums.T @ sums) @ inverse * used / (used - 6)
    return np.sqrt(np.diag(spread))


def _pixels(view: NormalEvidence, points: Float64Array) -> Float64Array:
    return (view.camera.project(points) - 0.5 * (view.binning - 1)) / view.binning


def _sampled(layers: Float32Array, at: Float64Array) -> Float64Array:
    place = [np.nan_to_num(at[:, 1], nan=-9.0), np.nan_to_num(at[:, 0], nan=-9.0)]
    return np.stack(
        [
            ndimage.map_coordinates(layers[..., k], place, order=1, mode="constant")
            for k in range(4)
        ],
        axis=-1,
    ).astype(np.float64)


def _cross(vectors: Float64Array) -> Float64Array:
    """Return the matrices of the cross product by vectors, shape (K, 3, 3)."""
    x, y, z = vectors.T
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(-1, 3, 3)


def _rotation(vector: Float64Array) -> Float64Array:
    """Return the rotation by a vector, Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-15:
        return np.eye(3)
    k = _cross(vector[None] / angle)[0]
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)
