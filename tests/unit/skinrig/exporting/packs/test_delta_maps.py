"""The delta-map pack: base plus delta is the expression, in color and in normals."""

import json

import cv2
import numpy as np
import OpenEXR
import pytest

from model import store, wrinkles
from model.facial_color.document import to_maps
from model.facial_color.rig import HemoglobinRig
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from model.texture_resampling import resample
from model.wrinkles.evaluation import WRINKLE_FILE, WrinkleModel
from model.wrinkles.expressions import ExpressionTable
from skinrig.applying import expression
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.packs import color_deltas, delta_maps

SIDE = 64
STATES = ("smile", "anger", "fear", "sadness")


def read(path):
    with OpenEXR.File(str(path)) as file:
        channels = file.channels()
        return channels["RGB" if "RGB" in channels else "Y"].pixels.copy()


def color_parts(rng):
    from scipy.ndimage import gaussian_filter

    smooth = gaussian_filter(rng.standard_normal((SIDE, SIDE)), 3.0)
    neutral = 0.05 + 0.02 * smooth / np.abs(smooth).max()
    states = {s: neutral * (1.1 + 0.15 * k) for k, s in enumerate(STATES)}
    rig = HemoglobinRig.from_maps(neutral, states, radius_px=8.0, stored_size=None)
    maps, document = to_maps(rig)
    melanin = SkinMap(np.full((SIDE, SIDE), 0.04), MAP_UNITS["melanin"])
    return {**maps, "melanin": melanin}, {"facial_color.json": document}


def wrinkle_parts(rng):
    base = 0.1 * rng.standard_normal((SIDE, SIDE, 2))
    wrinkle = 0.4 * rng.standard_normal((SIDE, SIDE, 2))
    masks = np.zeros((2, SIDE, SIDE))
    masks[0, : SIDE // 2], masks[1, SIDE // 2 :] = 1.0, 1.0
    table = ExpressionTable(("upper", "lower"), {"smile": (1.0, 0.0), "anger": (0.5, 1.0)}, "test")
    model = WrinkleModel(base, (wrinkles.WrinkleLayer(wrinkle, masks, table),))
    maps, document = model.to_maps()
    return model, maps, {WRINKLE_FILE: document}


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Sizes of a pack are those of engines; here they only take time, except where they count."""
    monkeypatch.setattr(color_deltas, "COLOR_SIZE", 128)
    monkeypatch.setattr(delta_maps, "NORMAL_SIZE", 128)


@pytest.fixture
def moving(rng):
    color_maps, color_files = color_parts(rng)
    _, wrinkle_maps, wrinkle_files = wrinkle_parts(rng)
    parts = {
        "facial_color": {
            "maps": sorted(color_maps),
            "files": list(color_files),
            "source": "simulated",
        },
        "wrinkles": {
            "maps": sorted(wrinkle_maps),
            "files": list(wrinkle_files),
            "source": "simulated",
            "expressions": ["smile", "anger"],
        },
    }
    return SkinAppearance(
        {**color_maps, **wrinkle_maps},
        "simulated",
        {"kind": "dynamic", "parts": parts},
        files={**color_files, **wrinkle_files},
    )


def test_base_color_plus_delta_gives_expression_color(moving, tmp_path):
    left_out = dict(delta_maps.write(moving, tmp_path, ExportSettings(only=("fear", "smile"))))
    told = json.loads((tmp_path / "delta_maps.json").read_text())["color"]
    assert told["maps"] == {"cm1": "fear", "cm2": "smile"}
    rig = expression.read_hemoglobin_rig(moving)
    melanin = moving.maps["melanin"].values
    for name, state in told["maps"].items():
        blend = rig.evaluate({state: 1.0})
        shown = expression.skin_reflectance(melanin, blend.hemoglobin, blend.valid)
        expected = np.moveaxis(resample(np.moveaxis(shown, -1, 0).astype(float), (128, 128)), 0, 2)
        found = read(tmp_path / "exr/base_color.exr") + read(tmp_path / f"exr/{name}_delta.exr")
        assert found.shape == (128, 128, 3)
        np.testing.assert_allclose(found, expected, atol=2e-6)
        assert told["largest_delta"][name] > 0.001  # blood shows
        codes = cv2.imread(str(tmp_path / f"png/{name}_delta.png"), cv2.IMREAD_UNCHANGED)
        decoded = 2.0 * codes[..., ::-1] / 65535.0 - 1.0
        np.testing.assert_allclose(decoded, read(tmp_path / f"exr/{name}_delta.exr"), atol=2e-5)
    assert "stretched" in told["layout"]
    assert "--target-face" in left_out["colors on the face's texture"]


@pytest.mark.parametrize(("normal_y", "y"), [("gl", 1.0), ("dx", -1.0)])
def test_normals_plus_wrinkle_delta_give_expression_normals(moving, tmp_path, normal_y, y):
    delta_maps.write(moving, tmp_path, ExportSettings(normal_y=normal_y))
    told = json.loads((tmp_path / "delta_maps.json").read_text())["wrinkles"]
    assert told["maps"] == {"wm1": "smile", "wm2": "anger"}
    assert told["measured_size"] == [SIDE, SIDE]
    codes = cv2.imread(str(tmp_path / "png/normal.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert codes.shape == (128, 128, 3)
    base = codes / 32767.5 - 1.0
    model = WrinkleModel.from_maps(moving.maps, moving.files[WRINKLE_FILE])
    for name, row in told["maps"].items():
        delta = read(tmp_path / f"exr/{name}_delta.exr")
        slopes = base[..., :2] / base[..., 2:] + delta[..., :2]
        shown = wrinkles.encode(model.evaluate({row: 1.0}).normals.astype(float), limit=None)
        expected = np.moveaxis(resample(np.moveaxis(shown, -1, 0), (128, 128)), 0, -1)
        np.testing.assert_allclose(slopes * [1.0, y], expected, atol=2e-4)


def test_zone_masks_are_named_with_row_0_top(moving, tmp_path):
    delta_maps.write(moving, tmp_path, ExportSettings())
    told = json.loads((tmp_path / "delta_maps.json").read_text())["wrinkles"]["masks"]
    assert told == {"wrinkle_mask_0_0": "upper", "wrinkle_mask_0_1": "lower"}
    upper = cv2.imread(str(tmp_path / "png/wrinkle_mask_0_0.png"), cv2.IMREAD_UNCHANGED)
    assert (upper[2, 60], upper[120, 60]) == (65535, 0)


def test_states_beyond_three_are_named_as_omitted(moving, tmp_path):
    left_out = [what for what, _ in delta_maps.write(moving, tmp_path, ExportSettings())]
    assert "color of smile" in left_out  # the fourth by name
    with pytest.raises(
        ExportError, match="got 'joy', expected some of anger, fear, sadness, smile"
    ):
        delta_maps.write(moving, tmp_path, ExportSettings(only=("joy",)))


def test_folder_without_wrinkles_or_color_reports_missing_part(moving, tmp_path):
    parts = dict(moving.parameters["parts"])
    del parts["wrinkles"]
    alone = SkinAppearance(
        dict(moving.maps),
        "simulated",
        {"kind": "dynamic", "parts": parts},
        files=dict(moving.files),
    )
    left_out = dict(delta_maps.write(alone, tmp_path, ExportSettings()))
    assert "skinrig fit wrinkles" in left_out["normal, wm1 to wm3, masks, cavity"]
    with pytest.raises(ExportError, match="without fitted parts"):
        delta_maps.write(SkinAppearance({}, "simulated"), tmp_path, ExportSettings())


def test_colors_are_carried_onto_a_texture_by_landmarks(moving, tmp_path, rng):
    """The texture shows the picture turned by a quarter and twice as fine."""
    side = 2 * SIDE
    names = [f"p{k}" for k in range(12)]
    own = rng.uniform(2, SIDE - 3, (12, 2))
    onto = np.stack([side - 1 - 2 * own[:, 1], 2 * own[:, 0]], axis=1)
    for file, points in (("own.csv", own), ("onto.csv", onto)):
        rows = [f"{n},{x:.6f},{y:.6f}" for n, (x, y) in zip(names, points, strict=True)]
        (tmp_path / file).write_text("name,x,y\n" + "\n".join(rows) + "\n")
    albedo = np.full((side, side, 3), (0.5, 0.4, 0.3))
    dome = store.write(
        tmp_path / "dome", SkinAppearance({"r_d": SkinMap(albedo, "1")}, "simulated")
    )
    out = tmp_path / "out"
    out.mkdir()
    order = ExportSettings(
        only=("fear",), target_face=dome, landmarks=(tmp_path / "own.csv", tmp_path / "onto.csv")
    )
    delta_maps.write(moving, out, order)
    base, delta = read(out / "exr/base_color.exr"), read(out / "exr/cm1_delta.exr")
    rig, melanin = expression.read_hemoglobin_rig(moving), moving.maps["melanin"].values
    shown = {}
    for state in ("neutral", "fear"):
        blend = rig.evaluate({state: 1.0})
        shown[state] = expression.skin_reflectance(melanin, blend.hemoglobin, blend.valid)
    ratio = shown["fear"] / shown["neutral"]
    for u, v in ((0.4, 0.5), (0.5, 0.6), (0.6, 0.4)):
        row, column = int(v * 128), int(u * 128)
        x, y = column, row
        at = ratio[round((side - 1 - x) / 2), round(y / 2)]
        found = 1.0 + delta[row, column] / base[row, column]
        np.testing.assert_allclose(found, at, atol=0.01)
        assert np.abs(at - 1.0).max() > 0.03
    np.testing.assert_allclose(base[64, 64], 0.923188 * albedo[0, 0], rtol=1e-4)
    with pytest.raises(ExportError, match="expected two with --target-face"):
        delta_maps.write(moving, out, ExportSettings(target_face=dome))


def test_sizes_are_those_of_engines(moving, tmp_path, monkeypatch):
    monkeypatch.undo()
    assert (color_deltas.COLOR_SIZE, delta_maps.NORMAL_SIZE) == (512, 1024)
    parts = dict(moving.parameters["parts"])
    del parts["wrinkles"]
    color = SkinAppearance(
        dict(moving.maps),
        "simulated",
        {"kind": "dynamic", "parts": parts},
        files=dict(moving.files),
    )
    delta_maps.write(color, tmp_path, ExportSettings(only=("fear",)))
    assert read(tmp_path / "exr/cm1_delta.exr").shape == (512, 512, 3)
