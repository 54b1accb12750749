"""Eyes, hair, crown and neck of a scanned person: where they are, what they leave alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fixtures.head_scans import crop_below, draw_scan, write_obj
from scipy.spatial import cKDTree

from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from reconstruction.scan.closest_points import ScanSurface
from reconstruction.scan.repair import TriangleMesh
from rigsim.face_parts import eyelids
from rigsim.geometry.mesh import build_mesh
from skinrig.rendering.hole_patches import ClosedMesh, close_holes
from skinrig.unmeasured import person as assembly
from skinrig.unmeasured import rim
from skinrig.unmeasured.head_fit import FittedHead, HeadFitError, fit_head
from skinrig.unmeasured.person import FACE_PARTS, HEAD_FILE, assemble_person, fit_unmeasured

pytestmark = pytest.mark.long

SEEDS = (300, 301, 302)


def _surface(mesh):
    return ScanSurface(
        TriangleMesh(mesh.vertices_mm.astype(np.float64), mesh.faces.astype(np.int64))
    )


@pytest.fixture(scope="module", params=SEEDS)
def scanned(request):
    """Scan, true head, fit, and the person as displayed."""
    scan, head = draw_scan(request.param)
    fitted = fit_head(scan)
    melanin = SkinMap(np.full((4, 4), 0.04, np.float32), MAP_UNITS["melanin"])
    files = {HEAD_FILE: fitted.to_bytes()}
    appearance = SkinAppearance({"melanin": melanin}, "simulated", {}, files=files, seed=3)
    return scan, head, fitted, assemble_person(appearance, ClosedMesh(scan, (), ()), 3)


def test_eye_centers_are_those_of_subject(scanned):
    _, head, _, person = scanned
    for found, true in zip(person.parts.lids, eyelids.build_eyelids(head), strict=True):
        assert np.linalg.norm(found.center_mm - true.center_mm) < 1.0


def test_measured_vertices_stay_and_rim_is_smooth(scanned):
    scan, _, _, person = scanned
    points = scan.vertices_mm
    kept = person.chart.head.trimmed.vertices
    np.testing.assert_array_equal(person.mesh.vertices_mm[: len(kept)], points[kept])
    before = rim.measure_raggedness(points[rim.find_rim(points, scan.faces)].astype(np.float64))
    # the lids' margins, which join with open eyes only, are shorter than the head's rim
    outer = person.mesh.vertices_mm[rim.find_rim(person.mesh.vertices_mm, person.mesh.faces)]
    after = rim.measure_raggedness(outer.astype(np.float64))
    assert before > 1.2
    assert after < 1.05
    assert np.ptp(outer[:, 1]) > np.ptp(points[:, 1])


def test_unfilled_vertices_lie_on_scan(scanned):
    scan, _, _, person = scanned
    on_scan = person.mesh.vertices_mm[~person.filled].astype(np.float64)
    assert _surface(scan).find_closest(on_scan).distance_mm.max() < 0.006
    assert not person.stderr_mm[~person.filled].any()


def test_filled_surface_errs_less_than_stated(scanned):
    """Coverage of 68 % intervals exceeds 68 %: simulated crowns differ little from their mean."""
    _, head, _, person = scanned
    found = _surface(head).find_closest(person.mesh.vertices_mm[person.filled].astype(np.float64))
    inside = ~found.on_border
    away = person.mesh.vertices_mm[person.filled] - found.points_mm
    across = np.abs(np.einsum("nk,nk->n", away, found.normals))[inside]
    stated = person.stderr_mm[person.filled][inside]
    assert np.mean(across < stated) > 0.68
    assert np.sqrt(np.mean(across**2)) < 1.0
    assert stated.min() >= 0.12
    assert np.median(stated) < 0.5


def test_surface_is_closed_between_scan_and_crown(scanned):
    """Only the outer rim and both slits of the lids are borders."""
    _, _, _, person = scanned
    place = rim.weld_positions(person.mesh.vertices_mm)
    sides = place[person.mesh.faces][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    _, number, counts = np.unique(
        np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    border = np.unique(sides[counts[number.reshape(-1)] == 1])
    slits = np.unique(np.concatenate([[*one.upper, *one.lower] for one in person.parts.lids]))
    outer = rim.find_rim(person.mesh.vertices_mm, person.mesh.faces)
    assert set(border.tolist()) <= set(place[slits].tolist()) | set(outer.tolist())


@pytest.mark.parametrize("weight", [0.3, 0.7, 1.0])
def test_lids_open_around_eyeball(scanned, weight):
    _, _, _, person = scanned
    moved = person.mesh.vertices_mm.astype(np.float64)
    for lids in person.parts.lids:
        moved[lids.vertices] += lids.displacement_mm(weight)
        off = np.linalg.norm(moved[lids.vertices] - lids.center_mm, axis=-1)
        assert off.min() > eyelids.APEX_MM
        gap = (moved[lids.upper] - moved[lids.lower])[:, 1]
        assert gap.min() > -0.01
        if weight == 1.0:
            assert 8.0 <= gap.max() <= 12.0
            assert 26.0 <= np.ptp(moved[lids.upper][:, 0]) <= 33.0


def test_hair_grows_on_skin_of_person(scanned):
    _, _, _, person = scanned
    hair = person.parts.hair
    brows, lashes, _ = hair.counts
    tree = cKDTree(person.mesh.vertices_mm)
    grown = np.concatenate([hair.points_mm[:brows], hair.points_mm[brows + lashes :]])[:, 0]
    assert np.quantile(tree.query(grown)[0], 0.99) < 3.0
    high = person.mesh.vertices_mm[:, 1] > 120.0
    assert hair.coverage[high, 0].min() > 0.9


def test_labels_name_what_was_not_measured(scanned):
    _, _, _, person = scanned
    assert person.omitted() == ()
    surface, parts = (name for name, _ in person.added())
    assert parts == "eyes, lids, lashes, brows, hair"
    assert surface.startswith("crown, neck, sides of the head")
    area = _areas(person.mesh)
    share = area[person.filled[person.mesh.faces].any(axis=1)].sum() / area.sum()
    found = float(dict(person.added())[surface].partition(" %")[0])
    assert found == pytest.approx(100.0 * share, abs=1.0)


def _areas(mesh):
    a, b, c = (mesh.vertices_mm[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1)


def test_scan_without_eyes_gets_no_eyes():
    """A scan that ends below the eyes: the drawn upper face is named, and does not open."""
    scan = crop_below(draw_scan(300)[0], 5.0)
    given = SkinAppearance({}, "simulated", {}, files={"mesh.obj": write_obj(scan)})
    files, described, left_out = fit_unmeasured(given, None)
    assert described["parts"][:4] == ["crown", "neck", "sides of the head", "upper face"]
    assert described["filled_fraction"] > 0.6
    assert "expected a scan of both" in dict(left_out)["eyes and hair"]
    person = assemble_person(replace(given, files=files), close_holes(scan), 0)
    assert person.parts is None
    assert person.names == tuple(described["parts"])
    assert "upper face 100 %" in dict(person.added())[", ".join(person.names)]


def test_scan_below_hairline_has_brows_alone(scanned, monkeypatch):
    """Without space in the texture nothing is added around the scan."""
    scan, _, fitted, _ = scanned
    low = crop_below(scan, 62.0)
    front = (low.vertices_mm[low.faces][..., 2] > -40.0).all(axis=1)
    low = build_mesh(low.vertices_mm, low.faces[front], low.uv)
    monkeypatch.setattr(assembly, "place_disc", lambda *_, **__: None)
    appearance = SkinAppearance({}, "simulated", {}, files={HEAD_FILE: fitted.to_bytes()})
    person = assemble_person(appearance, ClosedMesh(low, (), ()), 0)
    assert person.names == FACE_PARTS
    assert person.parts.hair.counts[2] == 0
    assert set(dict(person.omitted())) == {"crown and neck", "hair of the scalp"}


def test_hair_has_size_of_head(scanned):
    """The same scan 1.2 times as large has the same brows, 1.2 times as large."""
    scan, _, fitted, person = scanned
    large = build_mesh(1.2 * scan.vertices_mm, scan.faces, scan.uv)
    head = FittedHead(1.2 * fitted.vertices_mm, 1.2 * fitted.stderr_mm, fitted.measured)
    files = {HEAD_FILE: head.to_bytes()}
    found = assemble_person(
        SkinAppearance({}, "simulated", {}, files=files), ClosedMesh(large, (), ()), 3
    )
    brows = person.parts.hair.counts[0]
    off = found.parts.hair.points_mm[:brows] - 1.2 * person.parts.hair.points_mm[:brows]
    assert np.median(np.abs(off)) < 0.05


def test_rim_colors_continue_on_added_surface(scanned):
    """A constant map stays constant, and a map keeps its values on the scan."""
    _, _, _, person = scanned
    flat = np.full((128, 128, 3), 0.25, np.float32)
    np.testing.assert_allclose(person.paint(flat), flat, atol=1e-6)
    ramp = np.broadcast_to(np.linspace(0.0, 0.7, 128, dtype=np.float32), (128, 128))
    painted = person.paint(ramp)
    # texels well within the trimmed scan, whose texture is 0.02 to 0.72
    rows = 1.0 - (np.arange(128) + 0.5) / 128
    on_scan = np.ix_((rows > 0.12) & (rows < 0.58), (rows > 0.12) & (rows < 0.58))
    np.testing.assert_array_equal(painted[on_scan], ramp[on_scan])
    assert not np.array_equal(painted, ramp)


def test_file_keeps_fit_and_damage_is_refused(scanned):
    _, _, fitted, _ = scanned
    again = FittedHead.from_bytes(fitted.to_bytes(), "x.npz")
    np.testing.assert_allclose(again.vertices_mm, fitted.vertices_mm, atol=1e-5)
    np.testing.assert_array_equal(again.measured, fitted.measured)
    with pytest.raises(HeadFitError, match=r"x\.npz: not readable"):
        FittedHead.from_bytes(fitted.to_bytes()[:900], "x.npz")
    small = replace(fitted, vertices_mm=fitted.vertices_mm[1:])
    with pytest.raises(HeadFitError, match=r"x\.npz: got arrays of shape"):
        FittedHead.from_bytes(small.to_bytes(), "x.npz")


def test_face_without_lids_keeps_its_crown(scanned):
    """A hole at an eye leaves out eyes and hair, with the reason."""
    scan, _, fitted, _ = scanned
    middle = scan.vertices_mm[scan.faces].mean(axis=1)
    kept = np.linalg.norm(middle - np.array([31.5, 18.0, -12.0]), axis=1) > 18.0
    holed = build_mesh(scan.vertices_mm, scan.faces[kept], scan.uv)
    appearance = SkinAppearance({}, "simulated", {}, files={HEAD_FILE: fitted.to_bytes()})
    person = assemble_person(appearance, ClosedMesh(holed, (), ()), 0)
    assert person.parts is None
    assert "vertices along the lids" in dict(person.omitted())["eyes and hair"]
    assert person.filled.any()
