"""`skinrig analyse relief`: steps at seams of charts, and octaves against the patches'."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

from model import store
from model.microstructure.kernel_table import FOREHEAD
from model.skin import SkinAppearance, SkinMap
from rigsim.geometry.atlas import Atlas
from rigsim.skin_patch.microrelief import make_micro_skin
from skinrig.analysing import relief as analysing
from skinrig.analysing.relief import measure_relief
from skinrig.appearances import dynamic
from skinrig.appearances.contents import hash_file
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


def flat_atlas(side, texel_mm):
    empty = np.zeros((side, side, 3), np.float32)
    along_u, along_v = (empty + np.float32(side * texel_mm) * np.eye(3)[k] for k in (0, 1))
    return Atlas(np.zeros((side, side), np.int32), empty, empty, along_u, along_v)


def test_stated_error_of_octaves_is_their_spread(rng):
    atlas = flat_atlas(256, 0.12)
    drawn = []
    for _ in range(40):
        white = ndimage.gaussian_filter(rng.standard_normal((512, 512)), 1.0, mode="wrap")
        windows = analysing.draw_windows(white, atlas, rng, 5000.0)
        drawn.append(analysing.mean_octaves(windows))
    mean, error, count = (np.array(part)[:, :3] for part in zip(*drawn, strict=True))
    assert count.min() >= 4
    spread = mean.std(axis=0, ddof=1) / mean.mean(axis=0)
    stated = np.sqrt(np.mean(error**2, axis=0))
    np.testing.assert_allclose(stated, spread, rtol=0.35)
    places = analysing.draw_windows(np.arange(512.0**2).reshape(512, 512), atlas, rng, 5000.0)
    pixels = np.concatenate([window.ravel() for window, _ in places])
    assert len(np.unique(pixels)) == len(pixels)  # windows that overlap have errors too small
    alone = analysing.mean_octaves(windows[:1])
    assert np.all(np.isnan(alone[1]))
    assert alone[2][0] == 1


@pytest.mark.parametrize("side", [397, 400, 404])
def test_wave_between_octaves_counts_half_in_each(side):
    wave = np.cos(2.0 * np.pi * np.arange(side) / 100.0)  # 1 mm
    window = np.broadcast_to(wave, (side, side))
    found = analysing.mean_octaves([(window, (10.0, 10.0))], (2000.0, 1000.0, 500.0))[0]
    np.testing.assert_allclose(found, 0.25, atol=0.03)


@pytest.mark.long
def test_map_without_fading_has_steps_at_seams(moving, tmp_path, monkeypatch):
    mesh = write_sheet(tmp_path / "sheet.npz")
    how = {"moving": moving, "mesh": mesh, "seed": 0}
    joined = measure_relief(tmp_path / "a", synthesize(moving, mesh, tmp_path / "r", 2048), **how)
    assert joined["seam"]["99"] <= joined["interior"]["99"]
    monkeypatch.setattr(applying, "join_charts", lambda *given: 0.0)
    split = measure_relief(tmp_path / "b", synthesize(moving, mesh, tmp_path / "s", 2048), **how)
    assert split["seam"]["99"] > 3.0 * split["interior"]["99"]
    for one in joined["octaves"]:
        assert abs(one["ratio"] - 1.0) < 0.05 + 2.0 * one["stderr"]
    assert max(one["stderr"] for one in joined["octaves"][1:4]) < 0.06


def write_relief(folder, kept, large=None):
    """A folder that lists the large map, if any, in its record."""
    files = {} if large is None else {f"{analysing.MAP_NAME}.npy": hash_file(large)}
    figures = {"figures": {dynamic.MICROSTRUCTURE: {"files": files}}}
    maps = {analysing.MAP_NAME: SkinMap(kept.astype(np.float32), "um")}
    store.write(folder, SkinAppearance(maps, "measured", figures, {}))


def test_large_map_counts_if_folder_lists_it(tmp_path, monkeypatch):
    small, large = np.zeros((8, 8)), np.ones((16, 16))
    file = tmp_path / "relief-large" / f"{analysing.MAP_NAME}.npy"
    file.parent.mkdir()
    np.save(file, large)
    write_relief(tmp_path / "relief", small)
    np.testing.assert_array_equal(analysing._open_map(tmp_path / "relief"), small)
    write_relief(tmp_path / "relief", small, file)
    monkeypatch.chdir(tmp_path / "relief")
    np.testing.assert_array_equal(analysing._open_map(Path()), large)
    whole = file.read_bytes()
    for stale in (b"", whole[:-100], whole[:-1] + b"\1"):
        file.write_bytes(stale)
        with pytest.raises(UnusableError, match="got a file of another run"):
            analysing._open_map(Path())
    file.unlink()
    with pytest.raises(UnusableError, match="got no such file"):
        analysing._open_map(Path())


def test_unknown_octaves_are_null_in_json(moving, tmp_path, rng):
    mesh = write_sheet(tmp_path / "sheet.npz")
    write_relief(tmp_path / "relief", rng.standard_normal((64, 64)))
    measure_relief(tmp_path / "a", tmp_path / "relief", moving=moving, mesh=mesh, seed=0)
    document = json.loads((tmp_path / "a" / "relief.json").read_text(), parse_constant=pytest.fail)
    assert document["octaves"][4]["ratio"] is None
    assert document["octaves"][4]["windows"] == 0


def test_map_that_is_not_square_is_refused(tmp_path):
    write_relief(tmp_path / "relief", np.zeros((8, 6)))
    with pytest.raises(UnusableError, match="8 x 6 pixels, expected a square map"):
        analysing._open_map(tmp_path / "relief")


def test_folder_without_relief_is_refused(moving, tmp_path):
    mesh = write_sheet(tmp_path / "sheet.npz")
    store.write(tmp_path / "maps", SkinAppearance({}, "measured", {}, {}))
    with pytest.raises(UnusableError, match="displacement_neutral"):
        measure_relief(tmp_path / "a", tmp_path / "maps", moving=moving, mesh=mesh, seed=0)
