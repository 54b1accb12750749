"""Brows, lashes and hair of the scalp: where they grow, what they absorb, what they leave alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rigsim.face_parts import eyelids, hair
from rigsim.subject.head import build_head


@pytest.fixture(scope="module")
def mesh():
    return build_head(np.random.default_rng([2, 0]))


@pytest.fixture(scope="module")
def drawn(mesh):
    return hair.draw_hair(mesh, "III", seed=2)


def test_equal_seeds_draw_equal_hair(mesh, drawn):
    again = hair.draw_hair(mesh, "III", seed=2)
    np.testing.assert_array_equal(again.points_mm, drawn.points_mm)
    other = hair.draw_hair(mesh, "III", seed=3)
    assert not np.array_equal(other.points_mm[:100], drawn.points_mm[:100])


def test_absorption_is_sum_of_melanins(drawn):
    """Brown hair of pbrt, eumelanin 1.3: 0.545, 0.906, 1.781 per radius."""
    brown = np.array(hair.EUMELANIN_PER_RADIUS) * 1.3
    np.testing.assert_allclose(brown, [0.5447, 0.9061, 1.781], atol=1e-4)
    expected = drawn.eumelanin / 1.3 * brown
    expected += drawn.pheomelanin * np.array(hair.PHEOMELANIN_PER_RADIUS)
    np.testing.assert_allclose(drawn.absorption_per_radius(), expected)


def test_darker_skin_has_darker_hair(mesh):
    pale, dark = (hair.draw_hair(mesh, name, seed=5) for name in ("I", "VI"))
    assert (pale.absorption_per_radius() < dark.absorption_per_radius()).all()
    assert pale.iris_melanin < dark.iris_melanin


def test_brows_and_hair_lie_on_skin(mesh, drawn):
    """No point is more than 0.6 mm behind the plane of its nearest vertex of the mesh."""
    brows, lashes, scalp = drawn.counts
    assert len(drawn.points_mm) == brows + lashes + scalp
    tree = cKDTree(mesh.vertices_mm)

    def depth(points):
        _, near = tree.query(points.reshape(-1, 3))
        off = points.reshape(-1, 3) - mesh.vertices_mm[near]
        return -np.sum(off * mesh.normals[near], axis=-1)

    grown = np.concatenate([drawn.points_mm[:brows], drawn.points_mm[brows + lashes :]])
    assert np.quantile(depth(grown), 0.99) < 0.6
    assert depth(drawn.points_mm[:brows] - np.float32([0.0, 0.0, 3.0])).max() > 0.6


def test_lashes_stay_outside_of_eyeballs(mesh, drawn):
    brows, lashes, _ = drawn.counts
    closed = drawn.points_mm[brows : brows + lashes].astype(np.float64)
    eyes = eyelids.build_eyelids(mesh)
    moved = mesh.vertices_mm.astype(np.float64)
    for lids in eyes:
        moved[lids.vertices] += lids.displacement_mm(1.0)
    roots = drawn.roots[brows : brows + lashes]
    opened = closed + drawn.opening_mm + (moved - mesh.vertices_mm)[roots][:, None]
    for lids, half in zip(eyes, (slice(None, lashes // 2), slice(lashes // 2, None)), strict=True):
        for points in (closed[half], opened[half]):
            assert np.linalg.norm(points - lids.center_mm, axis=-1).min() > eyelids.APEX_MM


def test_hair_covers_crown_and_no_cheek(mesh, drawn):
    height = mesh.vertices_mm[:, 1]
    front = mesh.vertices_mm[:, 2] > -45.0
    scalp, brow = drawn.coverage.T
    assert scalp[height > 120.0].min() > 0.9
    assert drawn.coverage[front & (height < 30.0)].max() < 0.05
    at_brow = front & (np.abs(height - 42.0) < 8.0)
    assert 0.3 < brow[at_brow].max() < 0.5
    assert scalp[at_brow].max() < 0.01
    assert brow[height > 70.0].max() == 0.0


def test_skin_below_hairline_gets_no_hair(mesh):
    """Brows and lashes are the same as on the whole head."""
    corners = mesh.vertices_mm[mesh.faces]
    face = (corners[..., 1] < 62.0).all(axis=1) & (corners[..., 2] > -40.0).all(axis=1)
    front = replace(mesh, faces=mesh.faces[face])
    found = hair.draw_hair(front, "III", seed=2, lids=eyelids.build_eyelids(mesh))
    assert found.counts[2] == 0
    assert np.isfinite(found.points_mm).all()
    whole = hair.draw_hair(mesh, "III", seed=2)
    np.testing.assert_array_equal(found.points_mm, whole.points_mm[: sum(whole.counts[:2])])
