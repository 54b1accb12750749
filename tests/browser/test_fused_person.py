"""The page of a fused person: eyes, hair and crown that no rig measured, on its scan."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.head_scans import draw_scan, write_obj

from model import store
from model.skin import SkinAppearance, SkinMap
from reconstruction.surface.errors import interior_error
from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import build_mesh
from skinrig.unmeasured.person import fit_unmeasured
from skinrig.viewer import faces, page

pytestmark = pytest.mark.long

RAISED_MM = 25.0
"""Height of the scan above the mean head: its brows are above 55 mm."""
SIDE = 128
FRONT = {"camera_distance_mm": 620, "camera_target_mm": [0, RAISED_MM, 0], "microstructure": 0}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    scan, _ = draw_scan(305)
    raised = build_mesh(scan.vertices_mm + np.float32([0.0, RAISED_MM, 0.0]), scan.faces, scan.uv)
    atlas = unwrap(raised, SIDE)
    r_d = np.broadcast_to([0.36, 0.26, 0.21], (SIDE, SIDE, 3)).copy()
    valid = {"valid": atlas.covered}
    normals = np.where(atlas.covered[..., None], atlas.normal, (0.0, 0.0, 1.0))
    maps = {
        "position": SkinMap(atlas.position_mm.astype(np.float64), "mm", **valid),
        "normals": SkinMap(normals, "1", np.full_like(normals, 0.01), **valid),
        "r_d": SkinMap(r_d, "1", np.hypot(0.03 * r_d, interior_error(r_d)), **valid),
    }
    files = {"mesh.obj": write_obj(raised)}
    dome = SkinAppearance(maps, "simulated", {"kind": "appearance"}, files=files, seed=0)
    added, described, left_out = fit_unmeasured(dome, None)
    assert left_out == ()
    folder = tmp_path_factory.mktemp("fused") / "double"
    parameters = {**dome.parameters, "unmeasured": described}
    store.write(
        folder, SkinAppearance(maps, "simulated", parameters, files={**files, **added}, seed=0)
    )
    found = faces.build_scene([folder], size=256)
    assert found.provenance["not_measured"] == described["parts"]
    return found


@pytest.fixture(scope="module")
def opened(open_page, scene):
    return open_page(page.build(scene))


def test_parts_are_listed_as_not_measured(opened):
    texts = opened.page.evaluate(
        "() => [...document.querySelectorAll('ul.facts b')].map(one => one.textContent)"
    )
    assert "Not measured: eyes, lids, lashes, brows, hair: " in texts
    assert any(one.startswith("Not measured: crown, neck, sides of the head") for one in texts)
    assert not any(one.startswith("Omitted: eyes") or "crown" in one[:16] for one in texts)
    assert opened.problems == []


def test_lids_open_as_table_states(opened, scene):
    """Within the steps of the table; float32 positions add 1e-5 mm."""
    opened.set(eyes_open=0, eyes_follow=0)
    closed, _ = opened.mesh()
    opened.set(eyes_open=1)
    moved, _ = opened.mesh()
    gaps = []
    for name in ("right", "left"):
        vertices = scene.tables[f"lid_vertices_{name}"][:, 0]
        moves = scene.tables[f"lid_moves_{name}"][:, :3].astype(np.float64) / 512.0
        np.testing.assert_allclose((moved - closed)[vertices], moves, atol=2e-3)
        upper, lower = scene.tables[f"lid_margins_{name}"].T
        gaps.append((moved[upper] - moved[lower])[:, 1].max())
    assert 8.0 < min(gaps) <= max(gaps) < 12.0


def test_change_and_back_draws_equal_bits(opened):
    opened.set(**FRONT, eyes_open=1, brows=1, hair=1)
    before = opened.read("display")
    opened.set(eyes_open=0, brows=0, hair=0)
    assert not np.array_equal(opened.read("display"), before)
    opened.set(eyes_open=1, brows=1, hair=1)
    np.testing.assert_array_equal(opened.read("display"), before)
    assert opened.problems == []


def test_brows_of_high_head_stay_brows(opened, scene):
    """The switch of the scalp's hair draws nothing on the brows' undercoat."""
    opened.set(**FRONT, eyes_open=0, brows=1, hair=0)
    brows = opened.read("hair")[..., 3]
    opened.set(brows=0, hair=1)
    scalp = opened.read("hair")[..., 3]
    rows, columns = np.nonzero(brows > 0.3)
    assert len(rows) > 50
    covered = scene.mesh.vertices_mm[scene.tables["hair_coverage"][:, 1] > 60]
    assert covered[:, 1].min() > 55.0
    inside = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    middle = scalp[inside][:, 10:-10]
    assert middle.max() == 0.0
