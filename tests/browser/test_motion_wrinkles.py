"""Wrinkles of the page are the model's; leaving detail out changes pixels less than it says."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from fixtures.packed_scenes import as_packed
from scipy import ndimage

from model import wrinkles
from model.wrinkles import WrinkleLayer
from model.wrinkles.evaluation import WrinkleModel
from model.wrinkles.expressions import ExpressionTable
from skinrig.viewer import page
from skinrig.viewer.assets import surface as wrinkle_assets

ZONES = tuple("abcdefgh")
TABLES = (
    {
        "anger": (-0.6, 0.4, 0.0, 0.9, 0.0, -0.3, 0.2, 0.0),
        "surprise": (0.8, 0.5, -0.7, 0.0, 0.3, 0.0, 0.0, 1.0),
    },
    {"surprise": (0.2, 0.0, 0.6, -0.9, 0.0, 0.0, 0.0, 0.5)},
)


@pytest.fixture(scope="module")
def painted(procedural_scene) -> tuple[Any, WrinkleModel]:
    """The procedural head with a base and two wrinkle maps that nothing was fitted to."""
    rng = np.random.default_rng(5)

    def smooth(shape: tuple[int, ...], sigma: float, rms: float) -> Any:
        noise = ndimage.gaussian_filter(rng.standard_normal(shape), (0, sigma, sigma), mode="wrap")
        return (rms * noise / noise.std()).astype(np.float32)

    base = np.moveaxis(smooth((2, 128, 128), 1.5, 0.2), 0, 2)
    layers = []
    for number, rows in enumerate(TABLES):
        wrinkle = np.moveaxis(smooth((2, 64, 64), 1.5, 0.3), 0, 2)
        masks = np.clip(smooth((8, 16, 16), 1.5, 0.5) + 0.3, 0.0, 1.0)
        layers.append(
            WrinkleLayer(wrinkle, masks, ExpressionTable(ZONES, rows, f"painted {number}"))
        )
    model = WrinkleModel(base, tuple(layers))
    bare = replace(
        procedural_scene,
        textures={
            name: texture
            for name, texture in procedural_scene.textures.items()
            if not name.startswith("wrinkle_")
        },
        facts={k: v for k, v in procedural_scene.facts.items() if k != "wrinkles"},
    )

    class Source:
        mesh = procedural_scene.mesh

    added = wrinkle_assets.build_model_assets(model, Source, origin="fitted")  # type: ignore[arg-type]
    return bare.with_assets(added), model


@pytest.fixture(scope="module")
def painted_page(open_page, painted):
    return open_page(page.build(painted[0]))


def packed_model(scene: Any, model: WrinkleModel) -> tuple[Any, list[WrinkleLayer]]:
    """Return base and layers as the page holds them."""
    textures = as_packed(scene).textures
    masks = textures["wrinkle_masks"].values
    layers = [
        WrinkleLayer(textures["wrinkle_maps"].values[i], masks[2 * i : 2 * i + 2], layer.table)
        for i, layer in enumerate(model.layers)
    ]
    return textures["wrinkle_base"].values, layers


@pytest.mark.long
@pytest.mark.parametrize("clamp", ["unit", "signed"])
@pytest.mark.parametrize(
    "weights",
    [{}, {"anger": 1.0}, {"anger": 1.0, "surprise": 0.6}, {"surprise": 1.7}],
    ids=["rest", "anger", "both", "beyond"],
)
def test_derivatives_of_a_wrinkled_face_are_the_models(painted, painted_page, weights, clamp):
    scene, model = painted
    rest = dict.fromkeys(scene.mesh.shapes, 0.0)
    painted_page.set(weights=rest | weights, wrinkle_clamp=clamp)
    found = painted_page.read("wrinkle_derivatives")
    base, layers = packed_model(scene, model)
    known = {"anger": (0.0,) * 8}
    filled = [
        replace(layer, table=ExpressionTable(ZONES, known | dict(layer.table.rows)))  # type: ignore[union-attr]
        for layer in layers
    ]
    normals = wrinkles.combine_layers(base, filled, weights, clamp=clamp)
    expected = wrinkles.encode(normals, limit=None)
    error = np.abs(found[..., :2] - expected)
    # half floats: 2^-12 of values up to 4 and more; graphics samplers place texels to 1/256
    assert np.median(error) < 3e-4
    assert np.percentile(error, 99.9) < 3e-3
    assert error.max() < 6e-3
    np.testing.assert_allclose(found[..., 2:], found[..., :2] ** 2, atol=3e-3, rtol=3e-3)
    if weights:
        plain = np.abs(expected - base)
        assert np.median(plain) > 30 * 3e-4


@pytest.mark.long
def test_clamps_differ_where_expression_only_flattens(painted, painted_page):
    scene, _ = painted
    rest = dict.fromkeys(scene.mesh.shapes, 0.0)
    pictures = []
    for clamp in ("unit", "signed"):
        painted_page.set(weights=rest | {"anger": 1.0}, wrinkle_clamp=clamp)
        pictures.append(painted_page.read("wrinkle_derivatives")[..., :2])
    assert np.abs(pictures[0] - pictures[1]).max() > 0.1


@pytest.mark.long
def test_mip_levels_keep_the_second_moment_of_slopes(painted, painted_page):
    scene, _ = painted
    rest = dict.fromkeys(scene.mesh.shapes, 0.0)
    painted_page.set(weights=rest | {"surprise": 1.0}, wrinkle_clamp="unit")
    found = painted_page.read("wrinkle_derivatives").astype(np.float64)
    blocks = found.reshape(16, 8, 16, 8, 4).mean(axis=(1, 3))
    dropped = blocks[..., 2:] - blocks[..., :2] ** 2
    variance = found[..., :2].reshape(16, 8, 16, 8, 2).var(axis=(1, 3))
    np.testing.assert_allclose(dropped, variance, atol=2e-3)
    assert variance.mean() > 0.01


def face(viewer: Any) -> Any:
    return viewer.read("albedo")[..., 3] > 0.5


@pytest.mark.long
@pytest.mark.parametrize("azimuth", [-50.0, 35.0])
def test_distant_wrinkle_omission_changes_pixels_below_reported_bound(
    viewer, procedural_scene, azimuth
):
    rest = dict.fromkeys(procedural_scene.mesh.shapes, 0.0)
    viewer.set(
        weights=rest | {"surprise": 1.0},
        light_azimuth_deg=azimuth,
        microstructure=0,
        scattering=False,
    )
    told, measured = [], []
    for distance in (620.0, 1500.0, 4000.0, 16000.0):
        pictures = []
        for detail in (0, 1):
            now = viewer.set(camera_distance_mm=distance, detail=1, detail_tolerance=10.0 * detail)
            assert now["detail_wrinkles"] == 1 - detail
            pictures.append(viewer.read("radiance")[face(viewer)][:, :3])
        state = viewer.page.evaluate("() => window.viewer.statistics.detail.wrinkles")
        told.append(state["error"])
        measured.append(float(np.sqrt(np.mean((pictures[0] - pictures[1]) ** 2))))
    for error, expected in zip(measured, told, strict=True):
        assert error <= expected
    assert measured[0] > 2 / 255  # near by, leaving them out is seen
    assert told[-1] < 1 / 255
    viewer.set(detail_tolerance=1 / 255)
    assert viewer.set(camera_distance_mm=620.0)["detail_wrinkles"] == 1
    assert viewer.set(camera_distance_mm=16000.0)["detail_wrinkles"] == 0


@pytest.mark.long
def test_distant_microstructure_omission_changes_pixels_below_reported_bound(
    viewer, procedural_scene
):
    rest = dict.fromkeys(procedural_scene.mesh.shapes, 0.0)
    viewer.set(
        weights=rest,
        scattering=False,
        microstructure=2,
        camera_fov_deg=8.0,
        camera_target_mm=[0.0, 40.0, 0.0],
        microstructure_window_px=512,
    )
    told, measured = [], []
    for distance in (150.0, 800.0, 2000.0):
        pictures, shown = [], []
        for tolerance in (0.0, 10.0):
            now = viewer.set(camera_distance_mm=distance, detail_tolerance=tolerance)
            shown.append(now["microstructure_place"][3])
            picture = viewer.read("radiance")
            side = picture.shape[0] // 4
            pictures.append(picture[side:-side, side:-side, :3])
        assert shown == [1, 0]
        state = viewer.page.evaluate("() => window.viewer.statistics.detail.microstructure")
        told.append(state["error"])
        measured.append(float(np.sqrt(np.mean((pictures[0] - pictures[1]) ** 2))))
    assert measured[0] > 2 / 255
    for error, expected in zip(measured, told, strict=True):
        assert error <= expected


@pytest.mark.long
def test_hybrid_normals_softest_in_red_sharpest_in_highlight(viewer, procedural_scene):
    rest = dict.fromkeys(procedural_scene.mesh.shapes, 0.0)
    viewer.set(weights=rest | {"surprise": 1.0}, hybrid_normals=1)
    source = viewer.read("hybrid_source").astype(np.float64)
    red_green = viewer.read("softened_red_green").astype(np.float64)
    blue = viewer.read("softened_blue").astype(np.float64)
    covered = source[..., 3] > 0.5
    assert covered.mean() > 0.5
    side = source.shape[0]
    from skinrig.viewer.microstructure.assets import compute_px_per_mm

    per_mm = side * float(np.median(compute_px_per_mm(as_packed(procedural_scene).mesh)))
    sigma = np.array(viewer.page.evaluate("() => window.viewer.params.hybrid_sigma_mm")) * per_mm
    radius = int(np.ceil(3.0 * sigma.max()))
    weight = covered.astype(np.float64)
    for channel, found in enumerate((red_green[..., :2], red_green[..., 2:], blue[..., :2])):
        steps = np.arange(-radius, radius + 1)
        kernel = np.exp(-0.5 * steps**2 / max(sigma[channel] ** 2, 1e-6))
        expected = source[..., :2] * weight[..., None]
        for axis in (1, 0):  # each pass counts texels of the face only
            norm = ndimage.correlate1d(weight, kernel, axis=axis, mode="constant")
            expected = ndimage.correlate1d(expected, kernel, axis=axis, mode="constant")
            expected = expected / np.maximum(norm, 1e-20)[..., None] * weight[..., None]
        error = np.abs(found - expected)[covered]
        assert np.median(error) < 2e-4
        assert np.percentile(error, 99.9) < 2e-3
    energy = [
        np.mean(values[covered] ** 2)
        for values in (red_green[..., :2], red_green[..., 2:], blue[..., :2], source[..., :2])
    ]
    assert energy[0] < 0.8 * energy[1] < 0.8 * energy[2]
    assert energy[2] <= energy[3]
