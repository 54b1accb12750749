"""Wrinkle maps, zones and tables for the page."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from model.wrinkles.evaluation import WrinkleModel
from model.wrinkles.expressions import ExpressionTable
from model.wrinkles.partial_derivatives import WrinkleLayer
from skinrig.viewer.assets import surface as wrinkle_assets
from skinrig.viewer.scene import SceneError

ROWS = {"anger": (1.0, -0.5), "joy": (0.0, 1.0)}


def layer(side: int = 16, zones: int = 2, seed: int = 0) -> WrinkleLayer:
    rng = np.random.default_rng(seed)
    names = tuple(f"zone {i}" for i in range(zones))
    rows = {name: (*row, *([0.0] * (zones - 2))) for name, row in ROWS.items()}
    wrinkle = rng.normal(0.0, 0.2, (side, side, 2)).astype(np.float32)
    masks = rng.uniform(0.0, 1.0, (zones, 4, 4)).astype(np.float32)
    return WrinkleLayer(wrinkle, masks, ExpressionTable(names, rows))


def source(*shapes: str, **more: object) -> SimpleNamespace:
    mesh = SimpleNamespace(shapes=dict.fromkeys(shapes))
    return SimpleNamespace(
        mesh=mesh, **({"appearances": {}, "subject": None, "size": 16, "seed": 0} | more)
    )


def test_zones_go_into_two_rgba_textures_a_layer():
    model = WrinkleModel(np.zeros((16, 16, 2), np.float32), (layer(), layer(zones=8, seed=1)))
    made = wrinkle_assets.build_model_assets(model, source("anger"), origin="simulated")
    masks = made["textures"]["wrinkle_masks"].values
    assert masks.shape == (4, 4, 4, 4)
    np.testing.assert_array_equal(masks[0, ..., :2], np.moveaxis(model.layers[0].masks, 0, 2))
    assert (masks[0, ..., 2:] == 0).all()
    assert (masks[1] == 0).all()
    np.testing.assert_array_equal(masks[3, ..., 3], model.layers[1].masks[7])
    assert made["textures"]["wrinkle_maps"].values.shape == (2, 16, 16, 2)
    assert "wrinkle_base" not in made["textures"]


def test_fitted_base_is_included_with_holes_filled():
    base = np.full((16, 16, 2), 0.3, np.float32)
    base[4:8, 4:8] = np.nan
    made = wrinkle_assets.build_model_assets(
        WrinkleModel(base, (layer(),)), source("joy"), origin="fitted"
    )
    np.testing.assert_allclose(made["textures"]["wrinkle_base"].values, 0.3, rtol=1e-6)


def test_retained_rms_is_rms_of_zone_means():
    model = WrinkleModel(np.zeros((16, 16, 2), np.float32), (layer(),))
    rows = wrinkle_assets.compute_retained_rms(model, (16, 16))
    assert len(rows) == wrinkle_assets.ZONES_PER_LAYER
    assert [len(row) for row in rows] == [5] * wrinkle_assets.ZONES_PER_LAYER
    from model.texture_resampling import resample

    mask = resample(model.layers[0].masks[1].astype(float), (16, 16))
    part = mask[..., None] * model.layers[0].wrinkle
    means = part.reshape(4, 4, 4, 4, 2).mean(axis=(1, 3))
    assert rows[1][2] == pytest.approx(np.sqrt(np.mean(np.sum(means**2, axis=2))), rel=1e-5)
    assert all(row == [0.0] * 5 for row in rows[2:])


def test_expressions_missing_in_mesh_omit_wrinkles():
    model = WrinkleModel(np.zeros((16, 16, 2), np.float32), (layer(),))
    made = wrinkle_assets.build_model_assets(model, source("jawOpen"), origin="simulated")
    assert "textures" not in made
    assert made["left_out"] == (
        ("wrinkles", "the mesh has no blend shape of their expressions (anger, joy)"),
    )


def test_maps_or_zones_beyond_shader_limit_are_refused():
    base = np.zeros((16, 16, 2), np.float32)
    with pytest.raises(SceneError, match="got 5 wrinkle maps, expected at most 4"):
        wrinkle_assets.build_model_assets(
            WrinkleModel(base, tuple(layer(seed=i) for i in range(5))), source("anger"), origin=""
        )
    with pytest.raises(SceneError, match="got 9 zones, expected at most 8"):
        wrinkle_assets.build_model_assets(
            WrinkleModel(base, (layer(zones=9),)), source("anger"), origin=""
        )


@pytest.mark.long
def test_wrinkles_of_simulated_person_explain_own_expressions():
    from model.wrinkles.partial_derivatives import encode
    from rigsim.subject.person import make_subject

    person = make_subject("III", seed=0, size=256)
    model = wrinkle_assets.fit_simulated_wrinkles(person, size=256)
    rest = encode(person.tangent_normal(), limit=None).astype(np.float64)
    for state in ("anger", "surprise", "happiness"):
        want = encode(person.with_expression(state).tangent_normal(), limit=None) - rest
        got = encode(model.evaluate({state: 1.0}).normals, limit=None) - model.base
        other = encode(model.evaluate({"disgust": 1.0}).normals, limit=None) - model.base
        left = np.sum((got - want) ** 2) / np.sum(want**2)
        assert left < 0.25
        assert np.sum((other - want) ** 2) / np.sum(want**2) > 0.9
