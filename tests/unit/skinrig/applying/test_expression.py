"""A dynamic appearance evaluated: what weights give, and what is refused."""

import numpy as np
import pytest

from model import store
from model.facial_color import document as facial_color_document
from model.facial_color.rig import HemoglobinRig
from model.facial_color.state_maps import FacialColorError
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from model.wrinkles.evaluation import WRINKLE_FILE as WRINKLE_FILE
from model.wrinkles.evaluation import WrinkleModel
from model.wrinkles.partial_derivatives import WrinkleLayer
from skinrig.appearances import dynamic
from skinrig.applying import expression
from skinrig.applying.expression import (
    ApplyError,
    ExpressionRequest,
    TargetFace,
    apply_expression,
    parse_weights,
)

SIDE = 48


@pytest.fixture
def face(tmp_path):
    """A folder with a hemoglobin rig, melanin and wrinkles."""
    rng = np.random.default_rng(3)
    neutral = 0.02 + 0.004 * rng.standard_normal((SIDE, SIDE)).astype(np.float32)
    neutral = np.clip(neutral, 0.005, 0.05)
    rig = HemoglobinRig.from_maps(
        neutral, {"smile": 1.5 * neutral, "anger": neutral + 0.01}, radius_px=6.0
    )
    maps, document = facial_color_document.to_maps(rig)
    maps["melanin"] = SkinMap(np.full((SIDE, SIDE), 0.03, np.float32), MAP_UNITS["melanin"])
    out = tmp_path / "moving"
    dynamic.add(
        out,
        dynamic.FACIAL_COLOR,
        SkinAppearance(
            maps, "simulated", {}, {}, files={facial_color_document.RIG_DOCUMENT: document}
        ),
    )
    layer = WrinkleLayer(np.full((8, 8, 2), 0.3), np.ones((8, 4, 4)) / 8.0)
    maps, document = WrinkleModel(np.zeros((16, 16, 2)), (layer,)).to_maps()
    dynamic.add(
        out,
        dynamic.WRINKLES,
        SkinAppearance(maps, "simulated", {}, {}, files={WRINKLE_FILE: document}),
    )
    return out, neutral


def test_weights_are_read_by_name():
    assert parse_weights("smile=0.7,anger=-0.3") == {"smile": 0.7, "anger": -0.3}


@pytest.mark.parametrize("text", ["smile", "smile=", "=1", "smile=x", "smile=nan", "a=1,a=2", ""])
def test_invalid_weight_is_named(text):
    with pytest.raises(ApplyError, match=r"^--weights: "):
        parse_weights(text)


def test_state_at_full_weight_has_its_blood(face, tmp_path):
    folder, neutral = face
    apply_expression(folder, ExpressionRequest({"smile": 1.0}), out=tmp_path / "out")
    found = store.read(tmp_path / "out").maps["hemoglobin"]
    np.testing.assert_allclose(found.values, 1.5 * neutral, rtol=0.02)
    # the neutral face has other blood
    apply_expression(folder, ExpressionRequest({"neutral": 1.0}), out=tmp_path / "rest")
    rest = store.read(tmp_path / "rest").maps["hemoglobin"].values
    np.testing.assert_allclose(rest, neutral, rtol=1e-5)


def test_more_blood_makes_skin_redder(face, tmp_path):
    folder, _ = face
    means = []
    for state in ("neutral", "smile"):
        apply_expression(folder, ExpressionRequest({state: 1.0}), out=tmp_path / state)
        means.append(store.read(tmp_path / state).maps["color"].values.mean(axis=(0, 1)))
    lost = 1.0 - means[1] / means[0]
    # blood takes green most (its bands at 540 and 575 nm), blue next, red least
    assert lost[1] > lost[2] > lost[0] > 0.0


def test_anger_and_surprise_wrinkle_by_the_papers_table(face, tmp_path):
    folder, _ = face
    done = apply_expression(
        folder, ExpressionRequest({"anger": 1.0}), out=tmp_path / "a", parts=("wrinkles",)
    )
    assert done.figures["wrinkles"]["zone_weights"][0] == [0.0] * 4 + [0.8, 0.8, 1.0, 0.0]
    signed = apply_expression(
        folder,
        ExpressionRequest({"anger": 1.0}, clamp="signed"),
        out=tmp_path / "s",
        parts=("wrinkles",),
    )
    assert signed.figures["wrinkles"]["zone_weights"][0][:2] == [-0.6, -0.6]
    assert not np.array_equal(done.maps["normals"].values, signed.maps["normals"].values)


def test_weights_not_summing_to_one_write_nothing(face, tmp_path):
    folder, _ = face
    out = tmp_path / "out"
    with pytest.raises(FacialColorError, match=r"^--weights: .*normalize"):
        apply_expression(folder, ExpressionRequest({"smile": 0.7, "anger": 0.7}), out=out)
    assert not out.exists()
    apply_expression(
        folder, ExpressionRequest({"smile": 0.7, "anger": 0.7}, normalize=True), out=out
    )
    assert (out / store.DOCUMENT_FILE).is_file()


def test_state_unknown_to_wrinkles_is_refused(face, tmp_path):
    folder, _ = face
    with pytest.raises(ApplyError, match="smiling"):
        apply_expression(
            folder, ExpressionRequest({"smiling": 1.0}), out=tmp_path / "out", parts=("wrinkles",)
        )


def test_missing_face_parts_are_omitted_with_reason(face, tmp_path):
    folder, _ = face
    done = apply_expression(folder, ExpressionRequest({"smile": 1.0}), out=tmp_path / "out")
    assert ("microstructure", "not in the folder") in done.left_out
    written = store.read(tmp_path / "out")
    assert ("microstructure", "not in the folder") in written.left_out
    with pytest.raises(ApplyError, match="parts"):
        apply_expression(
            folder, ExpressionRequest({"smile": 1.0}), out=tmp_path / "o", parts=("hair",)
        )


def test_a_rig_is_applied_to_another_faces_blood(face, tmp_path):
    folder, _ = face
    rng = np.random.default_rng(8)
    other = (0.04 + 0.002 * rng.standard_normal((60, 40))).astype(np.float32)
    onto = TargetFace(
        SkinAppearance({"hemoglobin": SkinMap(other, MAP_UNITS["hemoglobin"])}, "measured")
    )
    done = apply_expression(
        folder, ExpressionRequest({"smile": 1.0}, target_face=onto), out=tmp_path / "out"
    )
    found = done.maps["hemoglobin"]
    assert found.values.shape == other.shape
    ratio = found.values[found.valid] / other[found.valid]
    assert np.median(ratio) == pytest.approx(1.5, abs=0.03)
    assert ("color", "requires a melanin map") in done.left_out
    empty = TargetFace(SkinAppearance({}, "measured"))
    with pytest.raises(ApplyError, match="hemoglobin"):
        apply_expression(
            folder, ExpressionRequest({"smile": 1.0}, target_face=empty), out=tmp_path / "no"
        )


def test_inputs_of_result_are_never_replaced(face, tmp_path):
    folder, _ = face
    before = (folder / store.DOCUMENT_FILE).read_bytes()
    with pytest.raises(ApplyError, match="the fitted folder itself"):
        apply_expression(folder, ExpressionRequest({"smile": 1.0}), out=folder)
    other = tmp_path / "truth"
    store.write(other, SkinAppearance({}, "simulated", parameters={"kind": "truth"}))
    with pytest.raises(ApplyError, match="it was not changed"):
        apply_expression(folder, ExpressionRequest({"smile": 1.0}), out=other)
    assert (folder / store.DOCUMENT_FILE).read_bytes() == before
    assert store.read(other).parameters["kind"] == "truth"
    # an older result is
    for _ in range(2):
        apply_expression(folder, ExpressionRequest({"smile": 1.0}), out=tmp_path / "out")


def test_weights_are_normalized_for_wrinkles_as_for_blood(face, tmp_path):
    folder, _ = face
    twice = ExpressionRequest({"smile": 2.0, "anger": 2.0}, normalize=True)
    half = ExpressionRequest({"smile": 0.5, "anger": 0.5})
    done = apply_expression(folder, twice, out=tmp_path / "a")
    same = apply_expression(folder, half, out=tmp_path / "b")
    for name in ("hemoglobin", "normals"):
        np.testing.assert_array_equal(done.maps[name].values, same.maps[name].values)
    with pytest.raises(ApplyError, match="sum"):
        apply_expression(
            folder,
            ExpressionRequest({"smile": 1.0, "anger": -1.0}, normalize=True),
            out=tmp_path / "c",
        )


def test_simulated_face_gives_simulated_result_sizes_must_fit(face, tmp_path):
    folder, _ = face
    blood = SkinMap(np.full((60, 40), 0.03, np.float32), MAP_UNITS["hemoglobin"])
    melanin = SkinMap(np.full((30, 40), 0.03, np.float32), MAP_UNITS["melanin"])
    onto = TargetFace(SkinAppearance({"hemoglobin": blood}, "measured"), hashes={"onto": "abc"})
    apply_expression(
        folder, ExpressionRequest({"smile": 1.0}, target_face=onto), out=tmp_path / "out"
    )
    written = store.read(tmp_path / "out")
    assert written.source == "simulated"  # the rig is
    assert written.inputs["onto"] == "abc"
    both = TargetFace(SkinAppearance({"hemoglobin": blood, "melanin": melanin}, "measured"))
    with pytest.raises(ApplyError, match="one size"):
        apply_expression(
            folder, ExpressionRequest({"smile": 1.0}, target_face=both), out=tmp_path / "no"
        )


def test_the_same_evaluation_gives_the_same_bytes(face, tmp_path):
    folder, _ = face
    for name in ("one", "two"):
        apply_expression(folder, ExpressionRequest({"smile": 1.0}), out=tmp_path / name)
    first, second = (
        {path.name: path.read_bytes() for path in sorted((tmp_path / name).iterdir())}
        for name in ("one", "two")
    )
    assert first == second
    assert expression.COLOR_OBSERVER == "linear sRGB"
