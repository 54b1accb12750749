"""A face with wrinkles kept as maps: what is read back evaluates to the same normals."""

import json
import math

import numpy as np
import pytest

from model import store, wrinkles
from model.skin import SkinAppearance
from model.wrinkles.evaluation import WRINKLE_FILE, WrinkleModel
from model.wrinkles.expressions import JIMENEZ2011_TABLE, ExpressionTable, WrinkleError
from model.wrinkles.partial_derivatives import WrinkleLayer


@pytest.fixture
def face(rng):
    rows = dict.fromkeys(JIMENEZ2011_TABLE.rows, (0.0,)) | {"lemon": (0.5,)}
    lemon = WrinkleLayer(
        rng.uniform(-0.3, 0.3, (4, 4, 2)).astype(np.float32),
        np.ones((1, 2, 2), np.float32),
        ExpressionTable(("all",), rows, "drawn"),
    )
    first = WrinkleLayer(
        rng.uniform(-0.3, 0.3, (8, 8, 2)).astype(np.float32),
        rng.random((8, 4, 4), np.float32),
        {**JIMENEZ2011_TABLE.rows, "lemon": (0.0,) * 8},
        np.full((8, 8, 2), 0.01, np.float32),
        rng.random((8, 8)) > 0.1,
    )
    base = rng.uniform(-0.5, 0.5, (16, 12, 2)).astype(np.float32)
    base[3, 4] = np.nan
    return WrinkleModel(
        base,
        (first, lemon),
        "signed",
        base_stderr=np.full((16, 12, 2), 0.02, np.float32),
        weight_stderr={"joy": (0.1, math.inf, *[0.2] * 6)},
    )


def test_a_model_comes_back_from_its_folder(face, tmp_path):
    maps, document = face.to_maps()
    store.write(tmp_path / "a", SkinAppearance(maps, "simulated", files={WRINKLE_FILE: document}))
    appearance = store.read(tmp_path / "a")
    again = WrinkleModel.from_maps(appearance.maps, appearance.files[WRINKLE_FILE])
    weights = {"joy": 0.8, "anger": 0.5, "lemon": 1.0}
    np.testing.assert_array_equal(again.evaluate(weights).normals, face.evaluate(weights).normals)
    assert again.clamp == "signed"
    assert again.weight_stderr == face.weight_stderr
    np.testing.assert_array_equal(again.valid, face.valid)
    np.testing.assert_array_equal(again.layers[0].stderr, face.layers[0].stderr)
    np.testing.assert_array_equal(again.layers[0].valid, face.layers[0].valid)
    assert again.layers[1].table == face.layers[1].table


def test_base_hole_is_hole_of_face(face):
    got = face.evaluate({"joy": 1.0})
    assert not got.valid[3, 4]
    assert not got.normals[3, 4].any()
    assert np.count_nonzero(~got.valid) == 1


def test_neutral_weights_give_the_base(face):
    np.testing.assert_array_equal(
        face.evaluate({}).normals[face.valid], wrinkles.decode(face.base)[face.valid]
    )


def test_clamp_effect_is_reported(face):
    calm = face.evaluate({"joy": 0.5})
    assert calm.clamped_fraction == 0.0
    np.testing.assert_array_equal(calm.zone_sums[0], calm.zone_weights[0])
    loud = face.evaluate({"joy": 1.0, "surprise": 1.0})
    assert loud.clamped_fraction == 1.0
    assert loud.zone_sums[0].max() == pytest.approx(1.8)
    assert loud.zone_weights[0].max() == 1.0


def test_a_document_of_another_kind_is_refused(face):
    maps, document = face.to_maps()
    fields = json.loads(document)
    broken = {
        "expected 'skinrig.wrinkles/1'": {**fields, "schema": "skinrig.wrinkles/2"},
        "is missing; export": {**fields, "layers": [{**fields["layers"][0], "map": "tea"}]},
        "wrong kind": {**fields, "layers": [{}]},
        "clamp: got 'tight'": {**fields, "clamp": "tight"},
    }
    for says, text in broken.items():
        with pytest.raises(WrinkleError, match=says):
            WrinkleModel.from_maps(maps, json.dumps(text).encode())
    with pytest.raises(WrinkleError, match="not JSON"):
        WrinkleModel.from_maps(maps, b"{")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"base": np.zeros((4, 4, 3))}, r"expected \(H, W, 2\)"),
        ({"valid": np.zeros((4, 5), bool)}, "valid: got"),
        ({"base": np.full((4, 4, 2), np.nan), "valid": np.ones((4, 4), bool)}, "valid pixel"),
        ({"base_stderr": np.zeros((4, 4))}, "base_stderr"),
    ],
)
def test_a_model_that_contradicts_itself_is_refused(change, says):
    with pytest.raises(WrinkleError, match=says):
        WrinkleModel(**({"base": np.zeros((4, 4, 2)), "layers": ()} | change))
