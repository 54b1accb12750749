"""Parts that no rig measures change no map of a fused person, and can be left out."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from fixtures.head_scans import draw_scan, write_obj

from model import store
from model.skin import SkinAppearance, SkinMap
from reconstruction.surface.errors import interior_error
from rigsim.geometry.mesh import build_mesh
from skinrig.cli import main
from skinrig.fusing.double import FusionInputs, fuse, fuse_sources
from skinrig.fusing.sources import read_sources
from skinrig.fusing.unmeasured import (
    UNMEASURED_NAME,
    UNMEASURED_SOURCE,
    add_unmeasured,
    find_unmeasured,
)
from skinrig.unmeasured.person import HEAD_FILE, UNMEASURED_KEY

SIDE = 12


def _draw_dome(files):
    """Dome maps of a bulged patch with a mesh of their own."""
    y, x = np.meshgrid(np.linspace(40, -40, SIDE), np.linspace(-40, 40, SIDE), indexing="ij")
    z = 20.0 - (x**2 + y**2) / 160.0
    normals = np.stack([x / 80.0, y / 80.0, np.ones_like(x)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    r_d = np.broadcast_to([0.36, 0.26, 0.21], (SIDE, SIDE, 3)).copy()
    maps = {
        "position": SkinMap(np.stack([x, y, z], axis=-1), "mm"),
        "normals": SkinMap(normals, "1", np.full_like(normals, 0.01)),
        "r_d": SkinMap(r_d, "1", np.hypot(0.03 * r_d, interior_error(r_d))),
    }
    return SkinAppearance(maps, "simulated", {"kind": "appearance"}, files=files, seed=0)


def _content(folder):
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.mark.long
def test_option_leaves_equal_bytes_and_default_adds_file(tmp_path):
    dome = tmp_path / "dome"
    store.write(dome, _draw_dome({"mesh.obj": write_obj(draw_scan(303)[0])}))
    given = FusionInputs((dome,))
    plain = fuse_sources(read_sources(given.paths), given)
    store.write(tmp_path / "plain", plain.appearance)
    fuse(FusionInputs((dome,), without=(UNMEASURED_NAME,)), out=tmp_path / "off")
    assert _content(tmp_path / "off") == _content(tmp_path / "plain")
    found = fuse(given, out=tmp_path / "double").appearance
    more, less = _content(tmp_path / "double"), _content(tmp_path / "plain")
    assert set(more) - set(less) == {HEAD_FILE}
    assert {name for name in less if more[name] != less[name]} == {"appearance.json"}
    assert found.parameters[UNMEASURED_KEY]["measured"] is False
    assert sum(one.endswith(UNMEASURED_SOURCE) for one in found.parameters["assumed"]) == 1
    assert {"eyes", "hair", "crown", "neck"} <= set(found.parameters[UNMEASURED_KEY]["parts"])
    fuse(given, out=tmp_path / "ahead", unmeasured=find_unmeasured(store.read(dome)))
    assert _content(tmp_path / "ahead") == more


@pytest.mark.long
def test_turned_face_prints_reason(tmp_path, capsys):
    """By 30 degrees about y: the eyes would look elsewhere."""
    scan, _ = draw_scan(303)
    c, s = np.cos(np.pi / 6.0), np.sin(np.pi / 6.0)
    turn = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]], np.float32)
    turned = build_mesh(scan.vertices_mm @ turn.T, scan.faces, scan.uv)
    store.write(tmp_path / "dome", _draw_dome({"mesh.obj": write_obj(turned)}))
    argv = ["fuse", str(tmp_path / "dome"), "--out", str(tmp_path / "double"), "--json"]
    assert main(argv) == 0
    printed = capsys.readouterr()
    assert "omitted: unmeasured parts: scan: got a face turned by 30 degrees" in printed.err
    document = json.loads(printed.out)
    assert "turned by 30 degrees" in dict(document["left_out"])["unmeasured parts"]
    assert document["unmeasured"] is None


@pytest.mark.parametrize(
    ("data", "reason"),
    [(b"v 1 2\nnonsense", "mesh.obj"), (b"v 0 0 0\nv 9 0 0\nv 0 9 0\nf 1 2 3", "texture")],
)
def test_fusion_survives_mesh_that_is_not_usable(tmp_path, data, reason):
    store.write(tmp_path / "dome", _draw_dome({"mesh.obj": data}))
    found = fuse(FusionInputs((tmp_path / "dome",)), out=tmp_path / "double")
    assert reason in dict(found.left_out)["unmeasured parts"]
    assert HEAD_FILE not in store.read(tmp_path / "double").files


def test_parts_of_fused_input_are_dropped(tmp_path):
    dome = _draw_dome({HEAD_FILE: b"of another fusion"})
    own = {UNMEASURED_KEY: {"parts": ["eyes"]}, "assumed": [f"eyes: {UNMEASURED_SOURCE}", "light"]}
    rows = (("unmeasured parts: hair", "none"), ("color", "none"))
    dome = replace(dome, parameters={**dome.parameters, **own}, left_out=rows)
    store.write(tmp_path / "dome", dome)
    given = FusionInputs((tmp_path / "dome",), without=(UNMEASURED_NAME,))
    found = fuse(given, out=tmp_path / "double").appearance
    assert HEAD_FILE not in found.files
    assert UNMEASURED_KEY not in found.parameters
    assert "dome: light" in found.parameters["assumed"]
    assert not any("eyes" in one for one in found.parameters["assumed"])
    assert "color" in dict(found.left_out)
    assert "unmeasured parts: hair" not in dict(found.left_out)


def test_appearance_without_mesh_stays_as_it_is(tmp_path):
    given = _draw_dome({})
    assert add_unmeasured(given, tmp_path, None, progress=lambda _: None) is given


def test_mesh_without_face_is_reported(tmp_path):
    """A flat sheet of the size of a face has no nose."""
    y, x = np.mgrid[-90.0:90.0:19j, -90.0:90.0:19j]
    i = (np.arange(18)[:, None] * 19 + np.arange(18)).ravel() + 1
    lines = [f"v {a:g} {b:g} 0" for a, b in zip(x.ravel(), y.ravel(), strict=True)]
    lines += [
        f"vt {a / 200 + 0.5:g} {b / 200 + 0.5:g}" for a, b in zip(x.flat, y.flat, strict=True)
    ]
    lines += [f"f {k}/{k} {k + 1}/{k + 1} {k + 20}/{k + 20}" for k in i]
    lines += [f"f {k}/{k} {k + 20}/{k + 20} {k + 19}/{k + 19}" for k in i]
    given = _draw_dome({"mesh.obj": "\n".join(lines).encode()})
    found = add_unmeasured(given, tmp_path, None, progress=lambda _: None)
    assert HEAD_FILE not in found.files
    assert "expected a face" in dict(found.left_out)["unmeasured parts"]
    ahead = find_unmeasured(given)
    again = add_unmeasured(given, tmp_path, None, progress=lambda _: None, found=ahead)
    assert again.left_out == found.left_out
