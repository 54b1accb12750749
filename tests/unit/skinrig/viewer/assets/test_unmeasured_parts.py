"""Eyes and hair of a fused person on the page: labelled, on the person's own mesh."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures.head_scans import draw_scan

from model.skin import SkinAppearance
from skinrig.rendering.hole_patches import ClosedMesh
from skinrig.unmeasured.head_fit import fit_head
from skinrig.unmeasured.person import HEAD_FILE, assemble_person
from skinrig.viewer import faces
from skinrig.viewer.assets import face_parts

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def person():
    scan, _ = draw_scan(304)
    files = {HEAD_FILE: fit_head(scan).to_bytes()}
    appearance = SkinAppearance({}, "simulated", {}, files=files)
    return assemble_person(appearance, ClosedMesh(scan, (), ()), 1)


def _source(person, parts):
    rest = SimpleNamespace(preset="III", rest=None)
    return SimpleNamespace(mesh=person.mesh, subject=rest, seed=1, own_mesh=True, parts=parts)


def test_parts_of_scan_are_labelled_not_measured(person):
    found = face_parts.build_assets(_source(person, person.parts))
    assert found["facts"]["face_parts"]["label"].startswith("Not measured")
    assert found["params"]["eyes_open"] == 1
    count = len(person.mesh.vertices_mm)
    for name, lids in zip(("right", "left"), person.parts.lids, strict=True):
        assert found["tables"][f"lid_vertices_{name}"].max() < count
        assert found["tables"][f"lid_faces_{name}"].shape == (0, 1)
        moves = found["tables"][f"lid_moves_{name}"].astype(np.float64) / 512.0
        np.testing.assert_allclose(moves[:, :3], lids.opening_mm, atol=1.0 / 512.0)


def test_provenance_lists_parts_that_are_displayed(person):
    """Crown without eyes, and eyes without a crown."""
    given = SimpleNamespace(kind="dome", appearances={"dome": SkinAppearance({}, "simulated", {})})

    def listed(**changes):
        found = faces._provenance(given, [], replace(person, **changes), "mesh.obj")
        return found.get("not_measured")

    assert listed()[:6] == ["eyes", "lids", "lashes", "brows", "hair", "crown"]
    assert listed(parts=None)[:2] == ["crown", "neck"]
    assert listed(fractions={}) == ["eyes", "lids", "lashes", "brows", "hair"]
    assert listed(parts=None, fractions={}) is None


def test_scan_without_parts_has_no_eyes(person):
    found = face_parts.build_assets(_source(person, None))
    assert "tables" not in found
    assert dict(found["left_out"])["eyes and hair"]
