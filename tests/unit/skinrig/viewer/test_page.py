"""One page, whole and closed: policy, hashes, the same bytes; written whole or not at all."""

from __future__ import annotations

import base64
import hashlib
import re
from pathlib import Path

import numpy as np
import pytest

from model.skin import SkinAppearance, SkinMap
from rigsim.geometry.mesh import Mesh
from skinrig import atomic_file
from skinrig.viewer import faces, page
from skinrig.viewer.scene import SceneError, Texture, ViewerScene


@pytest.fixture
def scene():
    mesh = Mesh(
        vertices_mm=np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0]], np.float32),
        normals=np.tile(np.float32([0, 0, 1]), (3, 1)),
        uv=np.array([[0, 0], [1, 0], [0, 1]], np.float32),
        faces=np.array([[0, 1, 2]], np.int32),
    )
    return ViewerScene(
        mesh=mesh,
        textures={"noise": Texture(np.zeros((4, 4, 1), np.float32))},
        provenance={"name": "</script><script>alert(1)</script>"},
        left_out=(("color", "none was measured"),),
    )


def _policy(text):
    return re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)[1]


def _inline(text):
    return re.findall(r"<script>(.*?)</script>", text, re.DOTALL)


def test_page_allows_own_script_and_style_without_network(scene):
    text = page.build(scene)
    policy = _policy(text)
    assert "default-src 'none'" in policy
    assert "connect-src 'none'" in policy
    (code,) = _inline(text)
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    assert f"'sha256-{digest}'" in policy
    assert "unsafe" not in policy
    assert not re.search(r"""(?:src|href)\s*=\s*["']?(?:https?:)?//""", text)
    assert "connect-src 'self'" in _policy(page.build(scene, connect=True))


def test_names_cannot_break_out_of_their_block(scene):
    text = page.build(scene)
    assert "<script>alert(1)" not in text
    assert len(_inline(text)) == 1


def test_the_same_scene_gives_the_same_page(scene):
    assert page.build(scene) == page.build(scene)


def test_every_script_is_packed_and_starter_is_last():
    folder = Path(page.__file__).parent
    for kind, names in (("js", page.SCRIPT_NAMES), ("glsl", page.GLSL_NAMES)):
        used = {f"{name}.{kind}" for names_of_page in names.values() for name in names_of_page}
        assert {path.name for path in folder.joinpath(kind).iterdir()} == used
    for scripts in page.SCRIPT_NAMES.values():
        assert (scripts[0], scripts[-1]) == ("graph", "main")


def test_comments_are_removed_from_page_but_code_kept():
    assert page._bare("  // why\n  a = 'x // y';\n\tb();\n") == "a = 'x // y';\nb();\n"


def test_page_replaces_older_page_completely(scene, tmp_path):
    out = tmp_path / "deep" / "face.html"
    first = page.write(scene, out)
    assert out.stat().st_size == first["bytes"]
    page.write(scene, out)
    assert sorted(p.name for p in out.parent.iterdir()) == ["face.html"]


def test_page_with_failed_packing_leaves_older_page(scene, tmp_path, monkeypatch):
    out = tmp_path / "face.html"
    out.write_text("older")

    def full(*_):
        raise OSError(28, "No space left on device", "face.html")

    monkeypatch.setattr(atomic_file.os, "replace", full)
    with pytest.raises(OSError, match="No space"):
        page.write(scene, out)
    assert [p.name for p in tmp_path.iterdir()] == ["face.html"]
    assert out.read_text() == "older"


@pytest.mark.parametrize("size", [32, 8192])
def test_size_too_large_for_page_is_refused(size):
    with pytest.raises(SceneError, match="expected 64 to 4096"):
        faces.build_scene(size=size)


def test_landmarks_without_image_are_refused(tmp_path):
    with pytest.raises(SceneError, match="give the folder, too"):
        faces.build_scene(landmarks=tmp_path / "landmarks.csv")


def test_maps_unusable_on_face_are_refused_with_remedy(tmp_path):
    from model import store

    flat = SkinAppearance(
        maps={"shading": SkinMap(np.zeros((4, 4), np.float32), "1")},
        source="measured",
        parameters={"kind": "appearance"},
        inputs={},
        versions={},
    )
    store.write(tmp_path / "appearance", flat)
    with pytest.raises(SceneError, match="skinrig fit facial-color"):
        faces.build_scene([tmp_path / "appearance"], size=64)


@pytest.mark.parametrize("name", ["panel", "controls", "costs", "drag", "probes", "tiles"])
def test_page_texts_use_field_terms(name):
    code = Path(page.__file__).with_name("js").joinpath(f"{name}.js").read_text(encoding="utf-8")
    code = re.sub(r"^\s*//.*$|\$\{[^}]*\}", "", code, flags=re.MULTILINE)
    texts = [text for text in re.findall(r'"[^"\n]*"|`[^`]*`', code) if " " in text]
    words = r"\b(told|tells|says|stands|lies|beside|anew|mend|pictures?|gloss|lobes?|left out)\b"
    assert texts
    assert [text for text in texts if re.search(words, text, re.IGNORECASE)] == []
