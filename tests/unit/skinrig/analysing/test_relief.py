"""`skinrig analyse relief`: steps at seams of charts, and octaves against the patches'."""

import numpy as np
import pytest

from model import store
from model.microstructure.kernel_table import FOREHEAD
from model.skin import SkinAppearance, SkinMap
from rigsim.skin_patch.microrelief import make_micro_skin
from skinrig.analysing.relief import measure_relief
from skinrig.appearances import dynamic
from skinrig.applying import relief as applying
from skinrig.applying.chart_seams import ChartSeams, sample_map
from skinrig.applying.expression import ExpressionRequest, apply_expression
from skinrig.applying.relief import ReliefEvaluator, ReliefRequest
from skinrig.errors import UnusableError

WIDTH_MM = 20.0


def write_sheet(path, *, bent=True):
    """A sheet of two charts; the right half is turned by 180 degrees in the texture."""
    x, y = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 17))
    half = np.stack([x.ravel(), y.ravel()], axis=1)
    k = np.arange(16 * 9).reshape(16, 9)[:, :8].ravel()
    faces = np.concatenate([np.stack([k, k + 1, k + 10], 1), np.stack([k, k + 10, k + 9], 1)])
    left = half * [0.44, 0.88] + [0.04, 0.06]
    right = [0.96, 0.94] - half * [0.44, 0.88]
    plane = np.concatenate([half * [0.5, 1.0], half * [0.5, 1.0] + [0.5, 0.0]]) * WIDTH_MM
    depth = 0.02 * (plane[:, :1] - 0.5 * WIDTH_MM) ** 2 if bent else 0.0 * plane[:, :1]
    np.savez(
        path,
        vertices_mm=np.concatenate([plane, -depth], axis=1).astype(np.float32),
        uv=np.concatenate([left, right]).astype(np.float32),
        faces=np.concatenate([faces, faces + len(half)]).astype(np.int32),
        shape_names=np.array(["drawn"]),
        shape_deltas_mm=np.zeros((1, 2 * len(half), 3), np.float16),
    )
    return path


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit") / "moving"
    skin = make_micro_skin("forehead", seed=4, size_mm=8.0, texel_um=16.0)
    maps = {"microrelief_forehead": SkinMap(skin.height_um.astype(np.float32), "um")}
    site = {"pixel_um": 16.0, "map": "microrelief_forehead", "table": "kernel_table_forehead.json"}
    files = {"kernel_table_forehead.json": FOREHEAD.to_json().encode()}
    part = SkinAppearance(maps, "measured", {"sites": {"forehead": site}}, {}, files=files)
    dynamic.add(folder, dynamic.MICROSTRUCTURE, part)
    return folder


def synthesize(moving, mesh, out, size_px):
    request = ReliefRequest(size_px, seed=1)
    relief = ReliefEvaluator.of(mesh, {}, request, out=out, progress=lambda text: None)
    parts = (dynamic.MICROSTRUCTURE,)
    apply_expression(moving, ExpressionRequest({}), out=out, parts=parts, relief=relief)
    return out


def test_seam_is_found_once_and_both_sides_meet(tmp_path):
    with np.load(write_sheet(tmp_path / "sheet.npz", bent=False)) as mesh:
        seams = ChartSeams.of(mesh["vertices_mm"], mesh["faces"], mesh["uv"])
    assert seams.length_mm.sum() == pytest.approx(WIDTH_MM)
    first, second = seams.sample(0.001)
    np.testing.assert_allclose(first[:, 1] + second[:, 1], 1.0, atol=1e-6)


def test_bilinear_samples_of_a_plane_are_exact(rng):
    side = 32
    at = (np.arange(side) + 0.5) / side
    plane = 3.0 * at[None] - 2.0 * at[::-1, None]
    uv = rng.uniform(0.1, 0.9, (50, 2))
    np.testing.assert_allclose(sample_map(plane, uv), 3.0 * uv[:, 0] - 2.0 * uv[:, 1], atol=1e-12)


@pytest.mark.long
def test_map_without_fading_has_steps_at_seams(moving, tmp_path, monkeypatch):
    mesh = write_sheet(tmp_path / "sheet.npz")
    how = {"moving": moving, "mesh": mesh, "seed": 0}
    joined = measure_relief(tmp_path / "a", synthesize(moving, mesh, tmp_path / "r", 2048), **how)
    assert joined["seam"]["99"] <= joined["interior"]["99"]
    monkeypatch.setattr(applying, "join_charts", lambda *given: 0.0)
    split = measure_relief(tmp_path / "b", synthesize(moving, mesh, tmp_path / "s", 2048), **how)
    assert split["seam"]["99"] > 3.0 * split["interior"]["99"]
    for one in joined["octaves"][1:4]:
        assert abs(one["ratio"] - 1.0) < 0.05 + 2.0 * one["stderr"]
        assert one["stderr"] < 0.05


def test_folder_without_relief_is_refused(moving, tmp_path):
    mesh = write_sheet(tmp_path / "sheet.npz")
    store.write(tmp_path / "maps", SkinAppearance({}, "measured", {}, {}))
    with pytest.raises(UnusableError, match="displacement_neutral"):
        measure_relief(tmp_path / "a", tmp_path / "maps", moving=moving, mesh=mesh, seed=0)
