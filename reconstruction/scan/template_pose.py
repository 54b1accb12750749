"""Find the pose and size of a face template on a scan in an unknown frame.

Without landmarks, the tip of the nose is the start: the point farthest out from the surface around
it. Each such point of the scan, with rotations about its normal, starts an iterative closest point
fit of the template; the best match wins.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Float64Array, FloatArray, Int64Array
from reconstruction.scan.closest_points import ScanSurface
from reconstruction.scan.face_template import FaceTemplate
from reconstruction.scan.repair import ScanMeshError

SPACING_MM: Final = 5.0
"""Spacing of the points at which protrusion is computed."""
PROTRUSION_RADIUS_MM: Final = 22.0
"""Radius of the surroundings from which a nose protrudes."""
MAX_STARTS: Final = 10
"""Largest number of points of the scan that are tried as the tip of the nose."""
START_DISTANCE_MM: Final = 25.0
"""Smallest distance between such points."""
SPINS_PER_START: Final = 10
"""Rotations about the normal of each start."""
COARSE_POINTS, FINE_POINTS = 160, 900
"""Points of the template in the coarse and in the fine fits."""
COARSE_STEPS, FINE_STEPS = 8, 25
REFINED_STARTS: Final = 6
"""Number of best coarse fits that are refined."""
MATCH_MM: Final = 5.0
"""Distance up to which a point of the template counts as matched."""
MATCH_COSINE: Final = 0.9
"""Least cosine between matched normals."""
MIN_COVERAGE: Final = 0.2
"""Least fraction of the template that a scan of a face covers."""
MIN_MATCH: Final = 0.72
"""Least fraction of the covered points that match, for a face."""
CLEAR_MATCH: Final = 0.8
"""The same fraction at which a pose is accepted without a search."""
SCALE_RANGE: Final = (0.75, 1.35)
"""Range of the size of a head, relative to the template."""


@dataclass(frozen=True, slots=True, eq=False)
class TemplatePose:
    """Similarity from the template's frame to the scan's, ``scale * rotation @ p + shift``."""

    rotation: Float64Array
    """Shape (3, 3)."""
    translation_mm: Float64Array
    """Shape (3,)."""
    scale: float
    coverage: float = 0.0
    """Fraction of the template whose closest point is inside the scan, not on its border."""
    match: float = 0.0
    """Fraction of these points within `MATCH_MM` of the scan, with about equal normals."""

    def move(self, points_mm: Float64Array) -> Float64Array:
        """Transform points of the template to the scan's frame."""
        return np.asarray(self.scale * points_mm @ self.rotation.T + self.translation_mm)


def estimate_pose(
    template: FaceTemplate,
    scan: ScanSurface,
    *,
    landmarks_mm: Mapping[str, Float64Array] | None = None,
    search: bool | None = None,
) -> TemplatePose:
    """Estimate where the face is in a scan.

    Parameters
    ----------
    template : FaceTemplate
    scan : ScanSurface
        In millimeters, in any frame.
    landmarks_mm : mapping of str to ndarray, shape (3,), optional
        Points of the scan by name; three or more of the template's names replace the search.
    search : bool, optional
        Whether to search all rotations. By default only where the template's own frame does not
        match; False saves the search and requires a frame within about 20 degrees and 30 mm.

    Returns
    -------
    TemplatePose

    Raises
    ------
    ScanMeshError
        If no pose matches enough of the template: the scan is not of a face.
    """
    fit = _PointFit(template, scan)
    named = [name for name in landmarks_mm or {} if name in template.landmarks_mm]
    pose = None
    if landmarks_mm is not None and len(named) >= 3:
        own = np.array([template.landmarks_mm[name] for name in named])
        pose = fit.refine(fit_similarity(own, np.array([landmarks_mm[name] for name in named])))
    elif search is not True:
        pose = fit.refine(TemplatePose(np.eye(3), np.zeros(3), 1.0))
    if pose is None or (pose.match < CLEAR_MATCH and search is not False and len(named) < 3):
        found = [fit.align(start, COARSE_POINTS, COARSE_STEPS) for start in _starts(template, scan)]
        found.sort(key=_matched)
        refined = [fit.refine(one) for one in found[:REFINED_STARTS]]
        pose = min([*refined, *([] if pose is None else [pose])], key=_matched)
    if pose.match < MIN_MATCH or pose.coverage < MIN_COVERAGE:
        raise ScanMeshError(
            f"scan: got a surface that covers {100 * pose.coverage:.0f} % of the template and "
            f"matches {100 * pose.match:.0f} % of that, expected a face with at least "
            f"{100 * MIN_COVERAGE:.0f} and {100 * MIN_MATCH:.0f} %; check the unit of the scan, or "
            "give landmarks [SR-REC-024]"
        )
    return pose


def _matched(pose: TemplatePose) -> float:
    """Return a key that sorts poses, the best first."""
    return -pose.match * pose.coverage


def fit_similarity(source_mm: Float64Array, target_mm: Float64Array) -> TemplatePose:
    """Return the similarity with the least squared distance between pairs of points.

    Parameters
    ----------
    source_mm, target_mm : ndarray, shape (N, 3)
        At least three pairs that are not on a line.

    Raises
    ------
    ScanMeshError
        If the points are on a line.

    References
    ----------
    Umeyama 1991, doi:10.1109/34.88573.
    """
    a, b = source_mm - source_mm.mean(axis=0), target_mm - target_mm.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    if s[1] < 1e-6 * max(s[0], 1e-300):
        raise ScanMeshError(
            f"landmarks: got {len(a)} points on a line, expected three that span a triangle; "
            "add landmarks [SR-REC-025]"
        )
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = (u * flip) @ vt
    scale = float(np.clip(np.sum(s * flip) / np.sum(a * a), *SCALE_RANGE))
    shift = target_mm.mean(axis=0) - scale * rotation @ source_mm.mean(axis=0)
    return TemplatePose(rotation, shift, scale)


class _PointFit:
    """Iterative closest points of a template and the vertices of a scan."""

    def __init__(self, template: FaceTemplate, scan: ScanSurface) -> None:
        mesh = template.mesh
        area = template.vertex_areas_mm2()
        chosen = np.random.default_rng(0).choice(
            len(area), min(FINE_POINTS, len(area)), replace=False, p=area / area.sum()
        )
        self.points = mesh.vertices_mm[chosen]
        self.normals = mesh.normals()[chosen].astype(np.float64)
        self.scan = scan

    def align(
        self, start: TemplatePose, points: int, steps: int, *, capture_mm: float = 40.0
    ) -> TemplatePose:
        """Return the pose after some steps, with the fraction that matches."""
        p, n, pose = self.points[:points], self.normals[:points], start
        capture = np.geomspace(capture_mm, MATCH_MM, steps)
        for reach in capture:
            pose = self._step(p, n, pose, float(reach))
        found = self.scan.find_closest(pose.move(p))
        cosine = np.einsum("nk,nk->n", n @ pose.rotation.T, found.normals)
        inside = ~found.on_border
        good = inside & (found.distance_mm < MATCH_MM) & (cosine > MATCH_COSINE)
        covered, matched = float(np.mean(inside)), float(np.mean(good))
        match = matched / covered if covered else 0.0
        return TemplatePose(pose.rotation, pose.translation_mm, pose.scale, covered, match)

    def refine(self, start: TemplatePose) -> TemplatePose:
        """Return the pose after the fine fit."""
        return self.align(start, FINE_POINTS, FINE_STEPS, capture_mm=20.0)

    def _step(
        self, p: Float64Array, n: Float64Array, pose: TemplatePose, reach_mm: float
    ) -> TemplatePose:
        """Return the pose after one step of the distances to the planes at the closest points."""
        y = pose.move(p)
        found = self.scan.find_closest(y)
        cosine = np.einsum("nk,nk->n", n @ pose.rotation.T, found.normals)
        ratio = found.distance_mm / reach_mm
        weight = np.where((cosine > 0.3) & ~found.on_border, np.exp(-(ratio**2)), 0.0)
        if np.count_nonzero(weight > 0.01) < 20:
            return pose
        middle = np.average(y, axis=0, weights=weight)
        arm = y - middle
        jacobian = np.concatenate(
            [
                np.cross(arm, found.normals),
                found.normals,
                np.einsum("nk,nk->n", arm, found.normals)[:, None],
            ],
            axis=1,
        )
        residual = np.einsum("nk,nk->n", found.points_mm - y, found.normals)
        matrix = jacobian.T @ (weight[:, None] * jacobian)
        total = float(weight.sum())
        # priors against sliding over round parts: 10 degrees, 10 mm and 5 % in each step
        prior = np.array([0.17] * 3 + [10.0] * 3 + [0.05]) ** -2.0
        step = np.linalg.solve(
            matrix + 0.02 * total * np.diag(prior), jacobian.T @ (weight * residual)
        )
        turn = _rotation(step[:3])
        scale = float(np.clip(pose.scale * (1.0 + step[6]), *SCALE_RANGE))
        rotation = turn @ pose.rotation
        grown = scale / pose.scale
        shift = grown * turn @ (pose.translation_mm - middle) + middle + step[3:6]
        return TemplatePose(rotation, shift, scale)


def _starts(template: FaceTemplate, scan: ScanSurface) -> list[TemplatePose]:
    """Return poses that put the template's most protruding point onto those of the scan."""
    tips, ways = _protruding(template.mesh.vertices_mm, template.mesh.normals(), 1)
    found, normals = _protruding(scan.mesh.vertices_mm, scan.normals, MAX_STARTS)
    poses = []
    for place, normal in zip(found, normals, strict=True):
        base = _turn_onto(ways[0], normal)
        for angle in 2.0 * np.pi * np.arange(SPINS_PER_START) / SPINS_PER_START:
            rotation = _rotation(angle * normal) @ base
            poses.append(TemplatePose(rotation, place - rotation @ tips[0], 1.0))
    return poses


def _protruding(
    vertices_mm: Float64Array, normals: FloatArray, count: int
) -> tuple[Float64Array, Float64Array]:
    """Return the points that protrude most from their surroundings, and the normals of these."""
    rows = _thinned(vertices_mm)
    p, n = vertices_mm[rows], np.asarray(normals, np.float64)[rows]
    tree = cKDTree(p)
    near = tree.query_ball_point(p, PROTRUSION_RADIUS_MM)
    owner = np.repeat(np.arange(len(p)), [len(one) for one in near])
    other = np.concatenate([np.asarray(one, np.int64) for one in near])
    members = np.bincount(owner, minlength=len(p))
    mean_p, mean_n = (
        np.stack([np.bincount(owner, x[other, k], len(p)) for k in range(3)], -1) / members[:, None]
        for x in (p, n)
    )
    mean_n /= np.maximum(np.linalg.norm(mean_n, axis=1, keepdims=True), 1e-9)
    height = np.einsum("nk,nk->n", p - mean_p, mean_n)
    chosen: list[int] = []
    for k in np.argsort(-height).tolist():
        if all(np.linalg.norm(p[k] - p[j]) > START_DISTANCE_MM for j in chosen):
            chosen.append(k)
        if len(chosen) == count:
            break
    return p[chosen], mean_n[chosen]


def _thinned(points: Float64Array) -> Int64Array:
    """Return one point for each cell of a grid."""
    cell = np.floor((points - points.min(axis=0)) / SPACING_MM).astype(np.int64)
    return np.asarray(np.sort(np.unique(cell, axis=0, return_index=True)[1]))


def _turn_onto(a: Float64Array, b: Float64Array) -> Float64Array:
    """Return a rotation that turns a unit vector onto another."""
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-9:
        other = np.eye(3)[int(np.argmin(np.abs(a)))]
        axis, sine = np.cross(a, other), 0.0
    axis = axis / np.linalg.norm(axis)
    return _rotation(np.arctan2(sine, cosine) * axis)


def _rotation(vector: Float64Array) -> Float64Array:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vector).as_matrix())
