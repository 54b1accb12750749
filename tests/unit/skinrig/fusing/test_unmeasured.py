"""Parts that no rig measures change no map of a fused person, and can be left out."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.head_scans import draw_scan

from model import store
from model.skin import SkinAppearance, SkinMap
from reconstruction.surface.errors import interior_error
from skinrig.fusing.double import FusionInputs, fuse, fuse_sources
from skinrig.fusing.sources import read_sources
from skinrig.fusing.unmeasured import UNMEASURED_NAME, add_unmeasured
from skinrig.unmeasured.person import HEAD_FILE, UNMEASURED_KEY

SIDE = 12


def _write_obj(mesh):
    """Return the bytes of a mesh as an .obj file."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices_mm.tolist()]
    lines += [f"vt {u:.9g} {v:.9g}" for u, v in mesh.uv.tolist()]
    lines += [f"f {a}/{a} {b}/{b} {c}/{c}" for a, b, c in (mesh.faces + 1).tolist()]
    return "\n".join(lines).encode()


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
    store.write(dome, _draw_dome({"mesh.obj": _write_obj(draw_scan(303)[0])}))
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
    assert any("not measured" in text for text in found.parameters["assumed"])


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
