"""Wrap a face template onto a scan, so that the faces of any scanner share triangles and texture.

Non-rigid iterative closest points with decreasing stiffness. Each step moves the template towards
the planes at the closest points of the scan, so that it may slide along the surface, and penalizes
the bending of its displacement. Vertices without counterpart (holes, borders, other normals,
outliers) follow their neighbors.

References
----------
Amberg, Romdhani and Vetter 2007, "Optimal step nonrigid ICP algorithms for surface registration",
doi:10.1109/CVPR.2007.383165; distances to planes as in Chen and Medioni 1992,
doi:10.1016/0262-8856(92)90066-C.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from model.checks import Checks
from model.solver_outcome import UNKNOWN_CONDITION, SolverOutcome
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.scan.closest_points import ScanSurface, closest_barycentric
from reconstruction.scan.face_template import FaceTemplate, vertex_areas_mm2
from reconstruction.scan.repair import ScanMeshError, TriangleMesh
from reconstruction.scan.surface_stiffness import SurfaceStiffness, surface_stiffness
from reconstruction.scan.template_pose import TemplatePose, estimate_pose

_log = logging.getLogger(__name__)

LENGTH_RANGE_MM: Final = (5.0, 100.0)
"""Smoothing lengths of the last and of the first step."""
FREE_STRETCH, LANDMARK_STRETCH = 3e-4, 0.03
"""Weights of stretch relative to bending, without and with landmarks. Stretch bounds displacements
without a scan; with landmarks, it keeps their displacement from growing beyond them."""
ROUNDS_PER_STEP: Final = 2
"""Searches of closest points for each stiffness."""
SLIDE_WEIGHT: Final = 3e-3
"""Weight of distances along the surface, relative to those across it."""
MIN_COSINE: Final = 0.6
"""Least cosine between the normals of a vertex and of its closest point."""
MIN_SCALE_MM: Final = 0.6
"""Least distance at which robust weights fall to a quarter."""
ROBUST_SIGMAS: Final = 3.0
"""The same distance in standard deviations of the distances."""
MAX_DISTANCE_SCALES: Final = 2.5
"""Distance, in that unit, beyond which a closest point is rejected."""
MIN_REACH_MM: Final = 3.0
"""Least distance at which closest points are rejected."""
MIN_VALID_WEIGHT: Final = 0.25
"""Least robust weight of a valid vertex."""
LANDMARK_STIFFNESS: Final = 5.0
"""Weight of a landmark relative to the stiffness of a point, length squared."""
MAX_UNFOLDINGS: Final = 12
"""Largest number of attempts to unfold triangles by a locally higher stiffness."""
UNFOLD_FACTOR: Final = 8.0
"""Factor of the stiffness around folded triangles, per attempt."""
SOLVER_TOLERANCE, SOLVER_STEPS = 1e-4, 200
"""Relative residual and largest number of the conjugate gradients."""
MAX_LANDMARK_MM: Final = 5.0
"""Largest distance over which a landmark is moved to the closest point of the scan."""
PRIOR_LENGTH_MM: Final = 20.0
"""Stiffness of the model of the errors: deformations that the steps before the last excluded."""
UNCERTAINTY_SAMPLES: Final = 16
"""Number of draws; the standard uncertainties scatter by about 15 %."""
FREE_SCALES_MM, LANDMARK_SCALES_MM = (3.0, 9.0), (4.3, 17.0)
"""Standard deviations of errors of unit weight, across and along the surface, without and with
landmarks, from simulated people of seeds 0 to 7; evaluate them on other seeds."""


@dataclass(frozen=True, slots=True, eq=False)
class WrappedTemplate:
    """A template on a scan."""

    mesh: TriangleMesh
    """The template's triangles and texture coordinates at positions in the scan's frame, mm."""
    valid: BoolArray
    """Whether the scan has data at a vertex, shape (V,); other vertices are extrapolated."""
    across_mm: Float64Array
    """Standard uncertainty of each vertex across the surface, mm, shape (V,)."""
    along_mm: Float64Array
    """Standard uncertainty along the surface, mm, of both directions together, shape (V,)."""
    pose: TemplatePose
    """Pose and size of the template before it was deformed."""
    folded: int
    """Number of triangles that remain folded."""
    rms_mm: float
    """RMS distance of the valid vertices from the planes at their closest points."""


def wrap_template(
    template: FaceTemplate,
    scan: TriangleMesh | ScanSurface,
    *,
    landmarks_mm: Mapping[str, Float64Array] | None = None,
    search: bool | None = None,
    steps: int = 8,
    progress: Callable[[str], None] | None = None,
) -> WrappedTemplate:
    """Deform a template onto a scan.

    Parameters
    ----------
    template : FaceTemplate
    scan : TriangleMesh or ScanSurface
        A scan in millimeters, in any frame, with defects.
    landmarks_mm : mapping of str to ndarray, shape (3,), optional
        Positions of the template's named points in the scan's frame, mm.
    search : bool, optional
        See `reconstruction.scan.template_pose.estimate_pose`.
    steps : int
        Number of stiffnesses, 2 to 100.
    progress : callable, optional
        Receives a text for each step.

    Returns
    -------
    WrappedTemplate

    Raises
    ------
    ScanMeshError
        If the scan is empty or does not contain a face, or for unknown names of landmarks.

    Notes
    -----
    Along smooth skin only stiffness determines the correspondence: see `WrappedTemplate.along_mm`.
    """
    Checks(ScanMeshError).within("steps", steps, "[2, 100]")
    given = dict(landmarks_mm or {})
    unknown = sorted(set(given) - set(template.landmarks_mm))
    if unknown:
        raise ScanMeshError(
            f"landmarks: got {', '.join(unknown)}, expected names of the template: "
            f"{', '.join(template.landmarks_mm)}; correct the names [SR-REC-027]"
        )
    surface = scan if isinstance(scan, ScanSurface) else ScanSurface(scan)
    report = progress or (lambda text: None)
    report("pose of the template")
    pose = estimate_pose(template, surface, landmarks_mm=given, search=search)
    fit = _Wrapping(template, surface, pose, given)
    lengths = np.geomspace(LENGTH_RANGE_MM[1], LENGTH_RANGE_MM[0], steps) * pose.scale
    for number, length_mm in enumerate(lengths, start=1):
        for _ in range(ROUNDS_PER_STEP):
            fit.step(float(length_mm))
        report(f"wrapping {number} of {steps}: {fit.rms_mm:.2f} mm RMS")
    fit.unfold(float(lengths[-1]))
    return fit.result()


class _Wrapping:
    """State of a wrapping: displacements of the template's vertices from its pose."""

    def __init__(
        self,
        template: FaceTemplate,
        scan: ScanSurface,
        pose: TemplatePose,
        landmarks_mm: Mapping[str, Float64Array],
    ) -> None:
        self.scan, self.pose = scan, pose
        self.start = pose.move(template.mesh.vertices_mm)
        posed = TriangleMesh(self.start, template.mesh.faces, template.mesh.corner_uv)
        self.template = posed
        self.area = vertex_areas_mm2(posed)
        self.stiffness: SurfaceStiffness = surface_stiffness(posed)
        self.factor = np.ones(len(self.start))
        self.moved = np.zeros_like(self.start)
        self.rms_mm = np.inf
        self.stretch = LANDMARK_STRETCH if landmarks_mm else FREE_STRETCH
        names = list(landmarks_mm)
        own = np.array([pose.move(template.landmarks_mm[name]) for name in names]).reshape(-1, 3)
        self.pins = _surface_points(posed, own)
        goal = np.array([landmarks_mm[name] for name in names], np.float64).reshape(-1, 3)
        if len(goal):  # depth follows from the scan, not from the landmark
            on_scan = scan.find_closest(goal)
            near = (on_scan.distance_mm < MAX_LANDMARK_MM) & ~on_scan.on_border
            goal = np.where(near[:, None], on_scan.points_mm, goal)
        self.goals = goal - self.pins @ self.start
        self.equations = self._equations()

    def mesh(self) -> TriangleMesh:
        """Return the template at its present positions."""
        there = self.start + self.moved
        return TriangleMesh(there, self.template.faces, self.template.corner_uv)

    def step(self, length_mm: float) -> None:
        """Find closest points and solve for the displacements at one stiffness."""
        self.equations = self._equations()
        self.moved = self._solve(length_mm, self.moved)

    def _equations(self) -> _PlaneEquations:
        """Return the equations of the planes at the closest points."""
        mesh = self.mesh()
        found = self.scan.find_closest(mesh.vertices_mm)
        gap = found.points_mm - mesh.vertices_mm
        away = np.abs(np.einsum("nk,nk->n", gap, found.normals))
        cosine = np.einsum("nk,nk->n", mesh.normals(), found.normals)
        usable = ~found.on_border & (cosine > MIN_COSINE)
        deviation = 1.4826 * float(np.median(away[usable])) if usable.any() else np.inf
        scale = max(ROBUST_SIGMAS * deviation, MIN_SCALE_MM)
        usable &= found.distance_mm < max(MAX_DISTANCE_SCALES * scale, MIN_REACH_MM)
        # weights of the Geman-McClure function
        robust = np.where(usable, (1.0 + (away / scale) ** 2) ** -2.0, 0.0)
        self.rms_mm = float(np.sqrt(np.mean(away[usable] ** 2))) if usable.any() else np.inf
        return _PlaneEquations(robust, found.normals, found.points_mm - self.start)

    def _solve(self, length_mm: float, guess: Float64Array) -> Float64Array:
        system = self._system(length_mm)
        planes = self.equations
        weight = system.weight
        right = (weight * np.einsum("nk,nk->n", planes.normals, planes.targets))[:, None]
        right = right * planes.normals + SLIDE_WEIGHT * weight[:, None] * planes.targets
        right += LANDMARK_STIFFNESS * length_mm**2 * (self.pins.T @ self.goals)
        return system.solve(right, guess)

    def _system(self, length_mm: float) -> _System:
        matrix = self.stiffness.matrix(length_mm, self.stretch, self.factor)
        matrix += LANDMARK_STIFFNESS * length_mm**2 * (self.pins.T @ self.pins)
        return _System(matrix, self.area * self.equations.weight, self.equations.normals)

    def unfold(self, length_mm: float) -> None:
        """Increase the stiffness around folded triangles until none is left."""
        for _ in range(MAX_UNFOLDINGS):
            folded = folded_triangles(self.mesh())
            if not folded.any():
                return
            near = np.zeros(len(self.start), np.bool_)
            near[self.template.faces[folded]] = True
            for _ in range(2):  # two rings around them
                near[self.template.faces[near[self.template.faces].any(axis=1)]] = True
            self.factor[near] *= UNFOLD_FACTOR
            self.moved = self._solve(length_mm, self.moved)

    def result(self) -> WrappedTemplate:
        """Return the wrapped template with its uncertainty."""
        self.equations = self._equations()
        mesh = self.mesh()
        across, along = self._uncertainty(mesh)
        return WrappedTemplate(
            mesh,
            self.equations.weight > MIN_VALID_WEIGHT,
            across,
            along,
            self.pose,
            int(np.count_nonzero(folded_triangles(mesh))),
            self.rms_mm,
        )

    def _uncertainty(self, mesh: TriangleMesh) -> tuple[Float64Array, Float64Array]:
        """Return standard uncertainties across and along the surface.

        Samples of a Gaussian whose precision is that of the planes and of the stiffness: with
        precision J' J and white noise e, the solution for J' e has its covariance.
        """
        rng = np.random.default_rng(0)
        length_mm = PRIOR_LENGTH_MM * self.pose.scale
        system, planes = self._system(length_mm), self.equations
        root = np.sqrt(system.weight)
        normals = mesh.normals().astype(np.float64)
        total = np.zeros((len(self.start), 2))
        bend = length_mm**2 * sparse.diags(np.sqrt(self.factor)[self.stiffness.vertex])
        bend = (bend @ self.stiffness.bending).T
        stretch = (np.sqrt(self.stretch) * length_mm * self.stiffness.stretch).T
        for _ in range(UNCERTAINTY_SAMPLES):
            right = (root * rng.standard_normal(len(root)))[:, None] * planes.normals
            slide = rng.standard_normal(self.start.shape)
            right += np.sqrt(SLIDE_WEIGHT) * root[:, None] * slide
            right += bend @ rng.standard_normal((bend.shape[1], 3))
            right += stretch @ rng.standard_normal((stretch.shape[1], 3))
            pins = rng.standard_normal(self.goals.shape)
            right += np.sqrt(LANDMARK_STIFFNESS) * length_mm * (self.pins.T @ pins)
            drawn = system.solve(right, np.zeros_like(right))
            across = np.einsum("nk,nk->n", drawn, normals)
            total[:, 0] += across**2
            total[:, 1] += np.sum(drawn**2, axis=1) - across**2
        across, along = np.sqrt(total / UNCERTAINTY_SAMPLES).T
        scales = LANDMARK_SCALES_MM if len(self.goals) else FREE_SCALES_MM
        return scales[0] * across, scales[1] * along


@dataclass(frozen=True, slots=True, eq=False)
class _PlaneEquations:
    """Distances to planes: ``normals . (x - targets)``, with robust weights."""

    weight: Float64Array
    """Shape (V,), 0 to 1."""
    normals: Float64Array
    """Shape (V, 3)."""
    targets: Float64Array
    """Displacement to each closest point, shape (V, 3), mm."""


class _System:
    """Normal equations: a matrix common to the three coordinates, and planes that join them."""

    def __init__(
        self, matrix: sparse.csc_matrix, weight: Float64Array, normals: Float64Array
    ) -> None:
        self.matrix, self.weight, self.normals = matrix.tocsr(), weight, normals
        middle = weight * (1.0 / 3.0 + SLIDE_WEIGHT) + 1e-9
        self._factor = splu(
            (matrix + sparse.diags(middle)).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )

    def _times(self, x: Float64Array) -> Float64Array:
        across = (self.weight * np.einsum("nk,nk->n", self.normals, x))[:, None] * self.normals
        return np.asarray(self.matrix @ x + SLIDE_WEIGHT * self.weight[:, None] * x + across)

    def solve(self, right: Float64Array, guess: Float64Array) -> Float64Array:
        """Solve by conjugate gradients, preconditioned with planes of all directions at once."""
        x = guess.copy()
        r = right - self._times(x)
        z = self._factor.solve(r)
        p, rz = z.copy(), float(np.sum(r * z))
        target = SOLVER_TOLERANCE**2 * float(np.sum(right * self._factor.solve(right)))
        for _ in range(SOLVER_STEPS):
            if rz <= target:
                break
            q = self._times(p)
            a = rz / float(np.sum(p * q))
            x, r = x + a * p, r - a * q
            z = self._factor.solve(r)
            rz, before = float(np.sum(r * z)), rz
            p = z + (rz / before) * p
        if not rz <= target:
            ratio = math.sqrt(rz / target) if target > 0.0 else math.inf
            SolverOutcome(SOLVER_STEPS, ratio, UNKNOWN_CONDITION, "limit").warn_unless_converged(
                "equations of the template", _log
            )
        return x


def folded_triangles(mesh: TriangleMesh) -> BoolArray:
    """Return the triangles whose normals oppose those of the surface around them, shape (F,).

    Examples
    --------
    >>> flat = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 0]])
    >>> faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    >>> bool(folded_triangles(TriangleMesh(flat, faces)).any())
    False
    >>> flat[4] = [0.5, -0.2, 0]
    >>> folded_triangles(TriangleMesh(flat, faces)).tolist()
    [True, False, False, False]
    """
    around = mesh.normals().astype(np.float64)[mesh.faces].sum(axis=1)
    return np.asarray(np.einsum("fk,fk->f", mesh.face_vectors(), around) <= 0.0)


def _surface_points(mesh: TriangleMesh, points_mm: Float64Array) -> sparse.csr_matrix:
    """Return weights of the vertices for the points of a surface closest to some, (N, V)."""
    corners = mesh.vertices_mm[mesh.faces]
    rows = np.repeat(np.arange(len(points_mm)), 3)
    columns, weights = [], []
    for point in points_mm:
        weight = closest_barycentric(np.broadcast_to(point, (len(corners), 3)), corners)
        away = np.linalg.norm(np.einsum("fc,fcd->fd", weight, corners) - point, axis=1)
        nearest = int(np.argmin(away))
        columns.append(mesh.faces[nearest])
        weights.append(weight[nearest])
    where = rows, np.concatenate([*columns, np.zeros(0, np.int64)])
    shape = len(points_mm), len(mesh.vertices_mm)
    return sparse.csr_matrix((np.concatenate([*weights, np.zeros(0)]), where), shape)
