"""`fit wrinkles` by derivatives and by differences: both approach the expressions' normals."""

import json

import numpy as np
import pytest

from model import metrics, store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from model.wrinkles.evaluation import DIFFERENCE_MAP, WRINKLE_FILE, WrinkleModel
from model.wrinkles.expressions import WrinkleError
from reconstruction.wrinkles import fit as wrinkle_fit
from reconstruction.wrinkles.normal_differences import fit_difference_map
from skinrig.benchmarks.gradient_rig import wrinkles as bench_wrinkles
from skinrig.cli import main

SIDE = 96


@pytest.fixture(scope="module")
def face():
    return bench_wrinkles.synthesize_wrinkled_face(SIDE, rng=np.random.default_rng(3))


@pytest.fixture(scope="module")
def folders(face, tmp_path_factory):
    root = tmp_path_factory.mktemp("faces")
    neutral, states = face
    for name, normals in {"neutral": neutral, **states}.items():
        unit = MAP_UNITS.get("normals_tangent", "1")
        maps = {"normals_tangent": SkinMap(np.float32(normals), unit, None, None, "drawn")}
        store.write(root / name, SkinAppearance(maps, "simulated", {"state": name}))
    return root


def fit(folders, method, out, capsys):
    argv = ["fit", "wrinkles", *(str(path) for path in sorted(folders.iterdir()))]
    sizes = ["--size-px", "48", "--mask-size", "24"]
    assert main([*argv, *sizes, "--method", method, "--out", str(out), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.long
def test_both_methods_reduce_angle_to_expressions(face, folders, tmp_path, capsys):
    found = {
        method: fit(folders, method, tmp_path / method, capsys)
        for method in ("derivatives", "differences")
    }
    for one in found.values():
        assert one["angle_deg"] < 0.6 * one["neutral_angle_deg"]
    ratio = found["differences"]["angle_deg"] / found["derivatives"]["angle_deg"]
    assert 0.8 < ratio < 1.1
    written = store.read(tmp_path / "differences")
    assert DIFFERENCE_MAP in written.maps
    assert DIFFERENCE_MAP not in store.read(tmp_path / "derivatives").maps
    model = WrinkleModel.from_maps(written.maps, written.files[WRINKLE_FILE])
    shown = model.evaluate({"anger": 1.0}).normals
    angle = np.degrees(metrics.angular_error_rad(shown, face[1]["anger"]).mean())
    rest = np.degrees(metrics.angular_error_rad(face[0], face[1]["anger"]).mean())
    assert angle < 0.8 * rest
    argv = ["apply", "expression", str(tmp_path / "differences"), "--weights", "anger=1"]
    assert main([*argv, "--out", str(tmp_path / "e"), "--json"]) == 0
    np.testing.assert_allclose(store.read(tmp_path / "e").maps["normals"].values, shown, atol=1e-6)


def test_difference_map_returns_planted_differences():
    rng = np.random.default_rng(4)
    slope = 0.2 * rng.standard_normal((32, 32, 2))
    base = np.dstack([slope, np.ones((32, 32))])
    base /= np.linalg.norm(base, axis=2, keepdims=True)
    added = np.dstack([slope + 0.3 * np.sin(np.arange(32))[:, None, None], np.ones((32, 32))])
    added /= np.linalg.norm(added, axis=2, keepdims=True)
    found = wrinkle_fit.fit_wrinkle_map(base, {"smile": added}, np.ones((1, 4, 4)), size=(32, 32))
    strength = found.layer.table.rows["smile"][0]
    difference = fit_difference_map(found, base, {"smile": added})
    np.testing.assert_allclose((2 * difference.values - 1) * strength, added - base, atol=1e-5)


def test_difference_of_two_layers_is_refused():
    layer = wrinkle_fit.WrinkleLayer(np.zeros((2, 2, 2)), np.ones((8, 1, 1)))
    with pytest.raises(WrinkleError, match="layers"):
        WrinkleModel(np.zeros((4, 4, 2)), (layer, layer), difference=np.full((2, 2, 3), 0.5))
