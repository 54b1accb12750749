"""Make reconstruction/data/face_template.npz: an average face with its own triangles.

    python tools/make_face_template.py

Shape: mean of the simulator's heads of seeds 50,000 to 50,063, which no test or benchmark uses.
Triangles: points drawn with a spacing of 2.4 mm at eyes, nose and mouth and up to 5.5 mm elsewhere,
joined by a Delaunay triangulation in the heads' ray coordinates; edges are then flipped where this
increases the least angle on the skin.
"""

from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.interpolate import RectBivariateSpline
from scipy.spatial import Delaunay, cKDTree

from rigsim.geometry.mesh import build_mesh, vertex_normals
from rigsim.subject.head import build_head
from rigsim.subject.landmarks import find_landmarks

SEEDS = range(50_000, 50_064)
U_RANGE, V_RANGE = (0.045, 0.955), (0.09, 0.94)
"""Texture coordinates of the template: from ear to ear, from below the chin to above the hairline.
"""
FINE_MM, COARSE_MM = 2.4, 5.5
FINE_BOX_MM = ((-52.0, -72.0, -28.0), (52.0, 52.0, 60.0))
"""Box of eyes, nose and mouth."""
FADE_MM = 45.0
"""Distance from the box over which the spacing grows."""
RELAXATIONS = 12
TARGET = Path(__file__).resolve().parents[1] / "reconstruction/data/face_template.npz"


def average_head():
    """Return the average head on the simulator's texture grid."""
    heads = [build_head(np.random.default_rng([seed, 0])) for seed in SEEDS]
    points = np.mean([head.vertices_mm.astype(np.float64) for head in heads], axis=0)
    return build_mesh(points, heads[0].faces, heads[0].uv)


def spacing_mm(points):
    """Return the distance between neighboring points of the template, mm."""
    low, high = (np.array(corner) for corner in FINE_BOX_MM)
    away = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=-1)
    return FINE_MM + (COARSE_MM - FINE_MM) * np.clip(away / FADE_MM, 0.0, 1.0)


def rim(surface):
    """Return texture coordinates along the rim, at the spacing of the points."""
    (u0, u1), (v0, v1) = U_RANGE, V_RANGE
    corners = np.array([(u0, v0), (u1, v0), (u1, v1), (u0, v1), (u0, v0)])
    found = []
    for a, b in pairwise(corners):
        line = a + np.linspace(0.0, 1.0, 2001)[:, None] * (b - a)
        points = surface(line)
        length = np.linalg.norm(np.diff(points, axis=0), axis=1)
        steps = np.concatenate([[0.0], np.cumsum(length / spacing_mm(points[1:]))])
        count = max(round(float(steps[-1])), 2)
        at = np.interp(np.linspace(0.0, steps[-1], count + 1)[:-1], steps, np.arange(2001.0))
        found.append(a + (at / 2000.0)[:, None] * (b - a))
    return np.concatenate(found)


def draw_inside(surface, head, edge, rng):
    """Return texture coordinates inside the rim: dart throwing on the skin, then relaxation."""
    (u0, u1), (v0, v1) = U_RANGE, V_RANGE
    a, b, c = (head.vertices_mm.astype(np.float64)[head.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    triangle = rng.choice(len(area), 200_000, p=area / area.sum())
    weights = rng.dirichlet(np.ones(3), len(triangle))
    uv = np.einsum("nk,nkd->nd", weights, head.uv.astype(np.float64)[head.faces[triangle]])
    uv = uv[((uv > (u0, v0)) & (uv < (u1, v1))).all(axis=1)]
    points = surface(uv)
    need = 0.8 * spacing_mm(points)
    near = cKDTree(points).query_ball_point(points, need)
    free = cKDTree(surface(edge)).query(points)[0] > need
    kept = []
    for k in range(len(uv)):
        if free[k]:
            kept.append(k)
            free[near[k]] = False
    inner = uv[kept]
    for _ in range(RELAXATIONS):
        sites = np.concatenate([surface(inner), surface(edge)])
        weight = spacing_mm(points) ** -2.0
        owner = cKDTree(sites).query(points)[1]
        total = np.bincount(owner, weight, minlength=len(sites))[: len(inner)]
        moved = [
            np.bincount(owner, weight * uv[:, k], minlength=len(sites))[: len(inner)]
            for k in range(2)
        ]
        inner = np.where(
            total[:, None] > 0, np.stack(moved, -1) / np.maximum(total, 1e-12)[:, None], inner
        )
    return inner


def least_angle_cosine(points, triangles):
    """Return the cosine of the least angle of each triangle; a larger one is worse."""
    corners = points[triangles]
    sides = np.roll(corners, -1, axis=1) - corners
    sides /= np.maximum(np.linalg.norm(sides, axis=-1, keepdims=True), 1e-12)
    return np.max(-np.sum(sides * np.roll(sides, 1, axis=1), axis=-1), axis=1)


def flip_edges(points, plane, faces):
    """Return triangles with edges flipped where the least angle on the skin increases."""
    faces = faces.copy()
    for _ in range(20):
        sides, normals = {}, vertex_normals(points, faces).astype(np.float64)
        for t, (a, b, c) in enumerate(faces.tolist()):
            sides |= {(a, b): (t, c), (b, c): (t, a), (c, a): (t, b)}
        changed = set()
        for (a, b), (t, c) in sides.items():
            other, d = sides.get((b, a), (t, c))
            if a > b or other == t or t in changed or other in changed:
                continue
            new = np.array([(c, a, d), (d, b, c)])
            p = plane[new]
            one, two = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
            if (one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]).min() <= 0.0:
                continue
            across = np.cross(*np.moveaxis(np.diff(points[new], axis=1), 1, 0))
            if np.sum(across * normals[new].sum(axis=1), axis=1).min() <= 0.0:
                continue
            pair = faces[[t, other]]
            worst = least_angle_cosine(points, np.concatenate([pair, new]))
            if worst[2:].max() < worst[:2].max() - 1e-6:
                faces[[t, other]] = new
                changed |= {t, other}
        if not changed:
            break
    return faces


def main() -> None:
    """Write the template."""
    head = average_head()
    grid = head.vertices_mm.astype(np.float64)
    u, v = (np.unique(head.uv[:, k].astype(np.float64)) for k in range(2))
    grid = grid.reshape(len(v), len(u), 3)
    splines = [RectBivariateSpline(v, u, grid[..., k]) for k in range(3)]

    def at(uv):
        return np.stack([spline.ev(uv[:, 1], uv[:, 0]) for spline in splines], axis=-1)

    edge = rim(at)
    uv = np.concatenate([edge, draw_inside(at, head, edge, np.random.default_rng(0))])
    # lengths across the cheeks and along the profile, so that u and v are about equal on the skin
    across, along = (
        np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))
        for line in (grid[len(v) // 2], grid[:, len(u) // 2])
    )
    plane = np.stack(
        [np.interp(uv[:, 0], u[1:], across), np.interp(uv[:, 1], v[1:], along)], axis=-1
    )
    faces = Delaunay(plane).simplices
    a, b, c = (plane[faces[:, k]] for k in range(3))
    ab, ac = b - a, c - a
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    faces = np.where((area < 0)[:, None], faces[:, ::-1], faces)[np.abs(area) > 1e-3]
    faces = flip_edges(at(uv), plane, faces)
    found = find_landmarks(head)
    np.savez_compressed(
        TARGET,
        vertices_mm=at(uv).astype(np.float32),
        faces=faces.astype(np.uint16),
        uv=uv.astype(np.float32),
        landmark_names=np.array(found.names),
        landmarks_mm=found.positions_on(head).astype(np.float32),
    )
    print(f"{TARGET}: {len(uv)} vertices, {len(faces)} triangles")


if __name__ == "__main__":
    main()
