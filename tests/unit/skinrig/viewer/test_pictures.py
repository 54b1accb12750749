"""Pictures: normals and color of an image as the page shows them."""

from __future__ import annotations

import numpy as np
import pytest

from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig.viewer import faces, packing
from skinrig.viewer.scene import SceneError

SHAPE = (24, 40)


def normals(turn, valid=None):
    """Return normals that lean to the right by an angle in radians, with errors of a degree."""
    values = np.zeros((*SHAPE, 3), np.float32)
    values[...] = np.sin(turn), 0.0, np.cos(turn)
    stderr = np.full_like(values, np.radians(1.0) / np.sqrt(2.0))
    return SkinMap(values, "1", stderr, valid)


def write(folder, maps, **parameters):
    """Write an appearance and return its folder."""
    given = {"kind": "appearance", **parameters}
    store.write(folder, SkinAppearance(maps, "measured", given, {}))
    return folder


def test_states_keep_their_order_size_and_errors(tmp_path):
    valid = np.ones(SHAPE, bool)
    valid[:12] = False
    maps = {"normals_b": normals(0.3), "normals_a": normals(-0.2, valid)}
    maps |= {f"height_{s}": SkinMap(np.full(SHAPE, 7.0, np.float32), "um") for s in "ab"}
    folder = write(tmp_path / "a", maps, states=["b", "a"], alpha={"value": 0.4})
    scene = faces.build_scene([folder], size=80)
    facts = scene.facts["picture"]
    assert (scene.page, facts["states"]) == ("picture", ["b", "a"])
    texels = scene.textures["picture_normals"].values
    assert texels.shape == (2, *SHAPE, 3)
    np.testing.assert_allclose(texels[..., 0].mean(axis=(1, 2)), np.sin([0.3, -0.2]), atol=1e-6)
    np.testing.assert_array_equal(texels[1, ..., 2], valid)
    assert facts["layers"]["height_um"] == [7.0, 7.0]
    np.testing.assert_allclose(facts["layers"]["normal_stderr_deg"], 1.0, rtol=1e-5)
    assert scene.params["picture_roughness"] == 0.4
    assert "color" in dict(scene.left_out)
    assert packing.pack(scene).header["page"] == "picture"


def test_averages_and_scale_ignore_values_under_mask(tmp_path):
    """Both at full size and reduced; the brightest color is 1."""
    values = np.full((*SHAPE, 3), 0.2, np.float32)
    valid = np.ones(SHAPE, bool)
    values[::2, ::2], valid[::2, ::2] = 9.0, False
    values, valid = np.tile(values, (4, 4, 1)), np.tile(valid, (4, 4))
    flat = normals(0.1)
    lean = SkinMap(np.tile(flat.values, (4, 4, 1)), "1")
    maps = {"normals": lean, "albedo": SkinMap(values, "1", valid=valid)}
    folder = write(tmp_path / "a", maps)
    for size, shape in ((None, (96, 160)), (80, (48, 80))):
        scene = faces.build_scene([folder], size=size)
        color = scene.textures["picture_color"].values
        assert color.shape == (1, *shape, 3)
        np.testing.assert_allclose(color, 1.0, rtol=1e-6)
        slopes = scene.textures["picture_normals"].values[0]
        np.testing.assert_allclose(slopes[..., 0], np.sin(0.1), rtol=1e-5)


def test_error_of_components_is_that_of_the_angle(tmp_path):
    """Image stacks state an error per component, the gradient rig per tangential axis."""
    lean = normals(0.5)
    axes = np.sqrt(1.0 - np.square(lean.values)) * np.radians(1.0) / np.sqrt(2.0)
    scene = faces.build_scene(
        [write(tmp_path / "a", {"normals": SkinMap(lean.values, "1", axes.astype(np.float32))})]
    )
    found = scene.facts["picture"]["layers"]["normal_stderr_deg"]
    np.testing.assert_allclose(found, 1.0, rtol=1e-5)


@pytest.mark.parametrize(
    ("maps", "options", "match"),
    [
        ({"normals": normals(0.0, np.zeros(SHAPE, bool))}, {}, "no pixel of the normals"),
        ({"normals": normals(0.0)}, {"landmarks": "l.csv"}, "has its own page"),
        (
            {"normals_a": normals(0.0), "normals_b": SkinMap(np.ones((4, 4, 3)), "1")},
            {},
            "several sizes",
        ),
    ],
)
def test_unusable_picture_is_refused_with_reason(tmp_path, maps, options, match):
    with pytest.raises(SceneError, match=match):
        faces.build_scene([write(tmp_path / "a", maps)], **options)


def test_normals_of_a_mesh_are_refused(tmp_path):
    maps = {"normals": normals(0.1), "position": SkinMap(np.zeros((*SHAPE, 3), np.float32), "mm")}
    with pytest.raises(SceneError, match="normals of an image"):
        faces.build_scene([write(tmp_path / "a", maps)])
