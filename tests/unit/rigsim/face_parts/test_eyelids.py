"""Lids of the simulated head: closed as drawn, open around an eyeball that pierces nothing."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from rigsim.face_parts import eyelids
from rigsim.geometry.mesh import build_mesh
from rigsim.subject.head import build_head

SEEDS = (0, 3, 8)


@pytest.fixture(scope="module", params=SEEDS)
def head(request):
    mesh = build_head(np.random.default_rng([request.param, 0]))
    return mesh, eyelids.build_eyelids(mesh)


def _open_faces(mesh, lids):
    return np.concatenate([np.delete(mesh.faces, lids.faces, axis=0), lids.edges])


def _segment_distance(a, b):
    """Return the distances of the origin from segments, shape (N,)."""
    way = b - a
    t = np.clip(-np.sum(a * way, axis=-1) / np.sum(way * way, axis=-1), 0.0, 1.0)
    return np.linalg.norm(a + t[:, None] * way, axis=-1)


def _triangle_distance(corners):
    """Return the exact distances of the origin from triangles, (N, 3, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    height = np.sum(a * normal, axis=-1)
    foot = height[:, None] * normal
    pairs = ((a, b), (b, c), (c, a))
    turns = [np.sum(np.cross(q - p, foot - p) * normal, axis=-1) for p, q in pairs]
    edges = np.min([_segment_distance(p, q) for p, q in pairs], axis=0)
    return np.where(np.min(turns, axis=0) >= 0.0, np.abs(height), edges)


def _clearance(mesh, lids, displacement, faces):
    """Return the smallest distance of the skin from the sphere that holds eye and cornea, mm."""
    moved = mesh.vertices_mm.astype(np.float64)
    moved[lids.vertices] += displacement
    corners = moved[faces] - lids.center_mm
    near = np.linalg.norm(corners, axis=-1).min(axis=1) < eyelids.APEX_MM + 4.0
    return _triangle_distance(corners[near]).min() - eyelids.APEX_MM


@pytest.mark.long
def test_weight_zero_moves_no_vertex(head):
    _, eyes = head
    for lids in eyes:
        assert not lids.displacement_mm(0.0).any()
        assert np.abs(lids.displacement_mm(1.0)).max() > 8.0


@pytest.mark.long
def test_eyeball_stays_behind_lids_at_any_weight(head):
    mesh, eyes = head
    for lids in eyes:
        assert _clearance(mesh, lids, 0.0, mesh.faces) >= 0.0
        faces = _open_faces(mesh, lids)
        for weight in np.linspace(0.05, 1.15, 12):
            assert _clearance(mesh, lids, lids.displacement_mm(weight), faces) >= 0.0


@pytest.mark.long
def test_straight_opening_without_arc_pierces_lids(head):
    mesh, (lids, _) = head
    straight = 0.5 * lids.opening_mm
    assert _clearance(mesh, lids, straight, _open_faces(mesh, lids)) < 0.0


@pytest.mark.long
def test_margins_are_only_new_border(head):
    """Each eye opens one loop, through its margins' vertices and no other."""
    mesh, eyes = head

    def border(faces):
        sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        return {edge for edge, count in Counter(map(tuple, sides.tolist())).items() if count == 1}

    before = border(mesh.faces)
    for lids in eyes:
        new = border(_open_faces(mesh, lids)) - before
        used = Counter(vertex for edge in new for vertex in edge)
        assert set(used.values()) == {2}
        margin = set(lids.upper[1:-1]) | set(lids.lower[1:-1])
        assert margin <= set(used) <= margin | set(lids.upper) | set(lids.lower)


@pytest.mark.long
def test_open_fissure_has_size_of_adults(head):
    """Width 27 to 33 mm and height 8 to 12 mm, adults of Farkas 1994."""
    mesh, eyes = head
    for lids in eyes:
        moved = mesh.vertices_mm.astype(np.float64)
        moved[lids.vertices] += lids.displacement_mm(1.0)
        upper, lower = moved[lids.upper[1:-1]], moved[lids.lower[1:-1]]
        assert 27.0 <= np.ptp(upper[:, 0]) <= 33.0
        assert 8.0 <= (upper[:, 1] - lower[:, 1]).max() <= 12.0


@pytest.mark.long
def test_eyes_are_mirror_images(head):
    _, (right, left) = head
    np.testing.assert_allclose(left.center_mm, right.center_mm * (-1.0, 1.0, 1.0), atol=1e-3)


def test_mesh_without_grid_is_refused():
    triangle = build_mesh(
        [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0]],
        [[0, 1, 2]],
        [[0.1, 0.2], [0.9, 0.1], [0.4, 0.8]],
    )
    with pytest.raises(eyelids.EyelidError, match="3 vertices"):
        eyelids.build_eyelids(triangle)
