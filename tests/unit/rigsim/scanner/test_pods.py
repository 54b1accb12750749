"""The simulated scanner: how far its surface lies from the true one, and what is wrong with it."""

import io
from functools import cache

import numpy as np
import pytest
import trimesh

from reconstruction.scan.mesh import load_ply
from rigsim.geometry.mesh import MeshError, build_mesh
from rigsim.render.caster import Caster
from rigsim.scanner.pods import ScannerSettings, scan_face, wrap_template
from rigsim.subject.head import build_head
from rigsim.subject.person import make_subject

CLEAN = {"flaws": False, "clothes": False}


@cache  # not when tests are read, which each process does
def head():
    return build_head(np.random.default_rng(5))


@cache
def scanned(seed=0, **changes):
    words = {"triangles": 12_000, "resolution_mm": 2.0} | changes
    return scan_face(head(), rng=np.random.default_rng(seed), scanner=ScannerSettings(**words))


def in_dome(scan, points=None):
    points = scan.vertices_mm if points is None else points
    return points @ scan.to_dome[:3, :3].T + scan.to_dome[:3, 3]


def heights(points, normals, mesh=None):
    """Return how far points lie above a mesh along their normals, mm; NaN beyond 6 mm."""
    mesh = head() if mesh is None else mesh
    caster = Caster(mesh)
    best = np.full(len(points), np.nan)
    for sign in (1.0, -1.0):
        start = points + 6.0 * sign * normals
        prim, weight = caster.first_hit(start, -sign * normals)
        corners = mesh.vertices_mm[mesh.faces[prim]]
        hit = (
            corners[:, 0]
            + weight[:, :1] * (corners[:, 1] - corners[:, 0])
            + weight[:, 1:] * (corners[:, 2] - corners[:, 0])
        )
        found = -np.einsum("nk,nk->n", hit - points, normals)
        closer = (prim >= 0) & ~(np.abs(found) >= np.abs(best))
        best = np.where(closer & (np.abs(found) < 6), found, best)
    return best


def clean_surface(scan):
    mesh = trimesh.Trimesh(in_dome(scan), scan.faces, process=False)
    return mesh, heights(mesh.vertices, mesh.vertex_normals)


@pytest.mark.long
def test_same_seed_gives_same_bytes_another_seed_others():
    scanner = ScannerSettings(triangles=12_000, resolution_mm=2.0)
    again = scan_face(head(), rng=np.random.default_rng(0), scanner=scanner)
    assert again.ply == scanned().ply
    assert scanned(1).ply != scanned().ply


def test_the_file_holds_the_mesh():
    loaded = trimesh.load(io.BytesIO(scanned().ply), file_type="ply", process=False)
    np.testing.assert_array_equal(loaded.faces, scanned().faces)
    np.testing.assert_array_equal(np.asarray(loaded.vertices, np.float32), scanned().vertices_mm)


@pytest.mark.long
@pytest.mark.parametrize("triangles", [4_000, 30_000])
def test_triangle_count_is_near_request(triangles):
    found = scanned(triangles=triangles, **CLEAN)
    assert len(found.faces) == pytest.approx(triangles, rel=0.2)


@pytest.mark.long
def test_scanned_surface_matches_truth_and_faces_outward():
    """Median error below 0.1 mm; the frames' offset left in, it is a hundred times larger."""
    scan = scanned(triangles=30_000, resolution_mm=1.0, **CLEAN)
    mesh, height = clean_surface(scan)
    known = np.isfinite(height)
    assert known.mean() > 0.98
    assert np.median(np.abs(height[known])) < 0.1
    outward = mesh.vertices - [0, 0, -80]
    assert np.median(np.einsum("vk,vk->v", mesh.vertex_normals, outward)) > 0
    shifted = trimesh.Trimesh(scan.vertices_mm, scan.faces, process=False)
    left_in = heights(shifted.vertices, shifted.vertex_normals)
    assert np.nanmedian(np.abs(left_in)) > 1.0


@pytest.mark.long
def test_noise_grows_with_the_setting():
    spreads = []
    for noise_mm in (0.05, 0.4):
        _, height = clean_surface(
            scanned(triangles=12_000, noise_mm=noise_mm, warp_mm=0.0, **CLEAN)
        )
        spreads.append(np.subtract(*np.nanpercentile(height, [75, 25])))
    assert spreads[1] > 2 * spreads[0]


@pytest.mark.long
def test_features_below_resolution_are_lost_larger_ones_stay():
    """A plane with ripples of 1 mm and of 10 mm, blurred by a Gaussian of 2 mm at half height.

    What stays of a wave is exp(-2 (pi sigma / period)^2): 3e-6 and 0.867; the triangles take up
    to 6 % more.
    """
    side = np.linspace(-40, 40, 401)
    x, y = np.meshgrid(side, side)
    at = np.arange(x.size).reshape(x.shape)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, :-1], at[1:, 1:]
    faces = np.concatenate([np.stack(f, -1).reshape(-1, 3) for f in ([a, b, c], [b, d, c])])
    kept = {}
    for period in (1.0, 10.0):
        z = 0.2 * np.cos(2 * np.pi * x / period)
        points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
        uv = np.clip(points[:, :2] / 80 + 0.5, 0, 1)
        plane = build_mesh(points, faces, uv)
        words = {"noise_mm": 0.0, "warp_mm": 0.0, "resolution_mm": 2.0}
        scan = scan_face(
            plane,
            rng=np.random.default_rng(0),
            scanner=ScannerSettings(triangles=30_000, **words, **CLEAN),
        )
        found = in_dome(scan)
        found = found[np.abs(found[:, :2]).max(axis=1) < 30]
        phase = 2 * np.pi * found[:, 0] / period
        waves = np.stack([np.cos(phase), np.sin(phase), np.ones(len(phase))], axis=-1)
        kept[period] = np.linalg.lstsq(waves, found[:, 2], rcond=None)[0][0] / 0.2
    sigma = 2.0 / np.sqrt(8 * np.log(2))
    for period, share in kept.items():
        assert share == pytest.approx(np.exp(-2 * (np.pi * sigma / period) ** 2), abs=0.06)


def test_area_hidden_from_camera_projector_pairs_is_hole():
    """Rays to the two projectors from points below the chin and beside the ears are barred."""
    scan = scanned(triangles=30_000, **CLEAN)
    mesh = trimesh.Trimesh(in_dome(scan), scan.faces, process=False)
    near = trimesh.Trimesh(head().vertices_mm, head().faces, process=False)
    edges = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)[1]
    assert (edges == 1).sum() > 300  # its rim, and the rims of its holes
    down = head().normals[:, 1] < -0.9
    front = head().normals[:, 2] > 0.8
    from scipy.spatial import cKDTree

    distance, _ = cKDTree(mesh.vertices).query(near.vertices)
    assert np.median(distance[front]) < scan.edge_mm
    assert (distance[front] < 2 * scan.edge_mm).mean() > 0.97
    assert (distance[down] > 2 * scan.edge_mm).mean() > 0.3


def test_flawed_triangles_are_there_to_be_repaired():
    flawed = scanned(triangles=12_000)
    welded = trimesh.Trimesh(flawed.vertices_mm, flawed.faces, process=False)
    welded.merge_vertices()
    _, counts = np.unique(np.sort(welded.edges, axis=1), axis=0, return_counts=True)
    assert (counts > 2).sum() > 10  # non-manifold edges
    assert (welded.area_faces < 1e-9).sum() > 20  # without area
    assert len(welded.vertices) < len(flawed.vertices_mm)  # doubled vertices
    assert not welded.is_winding_consistent
    sizes = [len(part.faces) for part in welded.split(only_watertight=False)]
    assert sum(size < 50 for size in sizes) > 5  # islands
    assert welded.bounds[0, 1] < head().vertices_mm[:, 1].min() - 10  # the collar


@pytest.mark.parametrize(("offset_mm", "offset_deg"), [(0.0, 0.0), (8.0, 3.0)])
def test_frame_offset_has_requested_size(offset_mm, offset_deg):
    scan = scanned(triangles=1_000, offset_mm=offset_mm, offset_deg=offset_deg, **CLEAN)
    turn = scan.to_dome[:3, :3]
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))
    assert angle == pytest.approx(offset_deg, abs=1e-5)
    assert np.linalg.norm(turn.T @ scan.to_dome[:3, 3]) == pytest.approx(offset_mm)


def test_a_face_that_looks_away_cannot_be_scanned():
    points = np.array([[-50.0, -50, 0], [50, -50, 0], [0, 50, 0]])
    back = build_mesh(points, [[0, 2, 1]], np.clip(points[:, :2] / 100 + 0.5, 0, 1))
    with pytest.raises(MeshError, match="no triangle"):
        scan_face(back, rng=np.random.default_rng(0), scanner=ScannerSettings(**CLEAN))


@pytest.mark.parametrize(
    "wrong", [{"triangles": 10}, {"resolution_mm": 0.0}, {"noise_mm": -1}, {"offset_deg": 90}]
)
def test_settings_out_of_range_are_named(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        ScannerSettings(**wrong)


def test_wrapped_template_fits_face_keeping_texture_in_expressions():
    """Expected: off the surface by its noise, 0.06 mm rms, and the warp; along it by 0.25 mm."""
    face = make_subject("III", seed=0, size=64)
    for state in ("neutral", "surprise"):
        mesh = face.with_expression(state).mesh
        scan = wrap_template(mesh, rng=np.random.default_rng(2))
        loaded = load_ply(scan.ply)
        np.testing.assert_array_equal(loaded.faces, mesh.faces)
        np.testing.assert_allclose(loaded.corner_uv, mesh.uv[mesh.faces], atol=1e-6)
        there = in_dome(scan) - mesh.vertices_mm
        across = np.sum(there * mesh.normals, axis=-1)
        along = np.linalg.norm(there - across[:, None] * mesh.normals, axis=-1)
        assert 0.04 < np.sqrt(np.mean(across**2)) < 0.1
        assert 0.2 < np.sqrt(np.mean(along**2)) < 0.6
