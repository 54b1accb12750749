"""Fitted lobes, traits and translucency of the page are the model's, pixel by pixel.

A face of three lobes with shares of its own at each texel is put on the procedural head. The page
computes in single precision, keeps tables and buffers as half floats and lets the device filter
the table: bounds below are some times what one software driver showed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from fixtures.packed_scenes import as_packed
from numpy.typing import NDArray

from model import skin_reflectance
from model.brdf import tables as brdf_tables
from skinrig.viewer.assets import fitted as trait_assets
from skinrig.viewer.assets import reflectance as reflectance_assets
from skinrig.viewer.assets.fitted import AlbedoTraitLayers, LobeTraits
from skinrig.viewer.assets.reflectance import PageLobes
from skinrig.viewer.scene import SceneSource, Texture

pytestmark = pytest.mark.long

Floats = NDArray[np.floating]
FLAT = {
    "relief": 0,
    "wrinkles": 0,
    "microstructure": 0,
    "hybrid_normals": 0,
    "detail": 0,
    "shadows": 0,
}
"""Nothing that tilts the normals of the mesh or takes light from it."""
HALF = 2.0**-11
"""Relative rounding of a half float."""


@dataclass(frozen=True)
class FittedPage:
    """A page of a face with fitted lobes, and what was put in."""

    viewer: Any
    traits: LobeTraits
    albedo: AlbedoTraitLayers
    scene: Any


def smooth(shape: tuple[int, ...], rng: np.random.Generator) -> Floats:
    """Return values of -1 to 1 that change slowly along the first two axes."""
    y, x = np.mgrid[: shape[0], : shape[1]] / shape[0]
    phase = rng.uniform(0.0, 6.0, (2, *shape[2:]))
    waves = np.sin(5.0 * x[..., None] + phase[0].reshape(-1)) * np.cos(
        4.0 * y[..., None] + phase[1].reshape(-1)
    )
    return np.asarray(waves.reshape(shape))


@pytest.fixture(scope="module")
def fitted_page(procedural_scene, open_page) -> FittedPage:
    """The procedural head with lobes, translucency and traits that a dome could have given."""
    from skinrig.viewer import page

    rng = np.random.default_rng(12345)
    materials = brdf_tables.default_basis()
    mix = rng.uniform(0.0, 1.0, (3, materials.size)) ** 6
    mix /= mix.sum(axis=1, keepdims=True)
    shares = np.maximum(0.3 + 0.4 * smooth((16, 16, 3), rng), 0.0).astype(np.float32)
    face = PageLobes(materials.mix_materials(mix), shares, mix, materials.names, "fitted")
    traits = trait_assets.build_surface_traits(face)
    assert traits is not None
    base = reflectance_assets.build_lobe_assets(
        SceneSource("dome", procedural_scene.mesh, 64, 0, None, None), traits.lobes
    )
    ends = (0.3 * smooth((16, 16, 12), rng)).astype(np.float32)
    albedo = AlbedoTraitLayers(
        ("tan", "beard"),
        np.moveaxis(ends.reshape(16, 16, 4, 3), 2, 0).copy(),
        {"tan": 0.2, "beard": 0.1},
        {"tan": 0.001, "beard": 0.002},
    )
    widths = (1.0 + 0.4 * smooth((16, 16, 1), rng)).astype(np.float32)
    scene = replace(
        procedural_scene,
        textures={
            **procedural_scene.textures,
            **base["textures"],
            "translucency": Texture(widths, "u8"),
            "albedo_traits": albedo.texture(),
        },
        facts={
            **procedural_scene.facts,
            **base["facts"],
            "surface_traits": trait_assets.describe_surface_traits(traits),
            "albedo_traits": albedo.facts(),
        },
        params={
            **procedural_scene.params,
            "traits": dict.fromkeys([*traits.pull, "tan", "beard"], 0.0),
        },
    )
    viewer = open_page(page.build(scene))
    viewer.set(**FLAT)
    return FittedPage(viewer, traits, albedo, scene)


@pytest.fixture
def fitted(fitted_page) -> Any:
    """That page; parameters are put back after the test."""
    before = fitted_page.viewer.page.evaluate("() => window.viewer.params")
    yield fitted_page
    fitted_page.viewer.set(**before)


def sampled(values: Floats, uv: Floats) -> Floats:
    """Return a texture (H, W, C), row 0 at the top, at (..., 2): linear, held at its rim."""
    height, width = values.shape[:2]
    x = np.clip(uv[..., 0] * width - 0.5, 0.0, width - 1.0)
    y = np.clip((1.0 - uv[..., 1]) * height - 0.5, 0.0, height - 1.0)
    i, j = np.minimum(y.astype(int), height - 2), np.minimum(x.astype(int), width - 2)
    a, b = (y - i)[..., None], (x - j)[..., None]
    upper = (1 - b) * values[i, j] + b * values[i, j + 1]
    lower = (1 - b) * values[i + 1, j] + b * values[i + 1, j + 1]
    return np.asarray((1 - a) * upper + a * lower)


def direction(azimuth_deg: float, elevation_deg: float) -> Floats:
    """Return the unit vector that the page has for two angles."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])


def towards_the_eye(params: dict[str, Any], shape: tuple[int, int]) -> Floats:
    """Return unit vectors from the pixels' points to the camera."""
    back = direction(params["camera_yaw_deg"], params["camera_pitch_deg"])
    right = direction(params["camera_yaw_deg"] + 90.0, 0.0)
    up = np.cross(back, right)
    height, width = shape
    tangent = np.tan(0.5 * np.radians(params["camera_fov_deg"]))
    x = ((np.arange(width) + 0.5) / width * 2.0 - 1.0) * tangent * width / height
    y = (1.0 - (np.arange(height) + 0.5) / height * 2.0) * tangent
    away = -back + x[None, :, None] * right + y[:, None, None] * up
    return np.asarray(-away / np.linalg.norm(away, axis=-1, keepdims=True))


def expected_specular(
    page: FittedPage, shares: Floats, params: dict[str, Any], *, slope: Floats | None = None
) -> Floats:
    """Return what the model reflects at each pixel of the face, and 0 beside it.

    A slope tilts the normals of the lobes, not the surface that takes the light.
    """
    viewer = page.viewer
    inspect, normal = viewer.read("inspect"), viewer.read("normal")
    on = viewer.read("albedo")[..., 3] > 0
    n = normal[..., :3][on].astype(np.float64)
    n /= np.linalg.norm(n, axis=-1, keepdims=True)
    light = direction(params["light_azimuth_deg"], params["light_elevation_deg"])
    eye = towards_the_eye(params, on.shape)[on]
    weights = sampled(shares, inspect[..., :2][on])
    m = n
    if slope is not None:
        t = np.cross(n, [0.31, 0.82, 0.48])
        t /= np.linalg.norm(t, axis=-1, keepdims=True)
        m = n - slope[0] * t - slope[1] * np.cross(n, t)
        m /= np.linalg.norm(m, axis=-1, keepdims=True)
    brdf = skin_reflectance.lobe_brdf(page.traits.lobes.lobes, weights, light, eye, m)
    maps = as_packed(page.scene).textures["surface_maps"].values
    brdf *= sampled(maps[..., 1:2], inspect[..., :2][on])[:, 0]  # brows reflect less
    out = np.zeros(on.shape)
    out[on] = np.pi * params["light_intensity"] * np.clip(n @ light, 0.0, None) * brdf
    return out


@pytest.mark.parametrize("azimuth", [0.0, 35.0, -70.0])
def test_page_reflection_matches_fitted_basis_brdfs(fitted, azimuth):
    params = fitted.viewer.set(specular_model="fitted", light_azimuth_deg=azimuth)
    shares = reflectance_assets.round_weights(fitted.traits.lobes.shares)  # shaders, not storage
    wanted = expected_specular(fitted, shares, params)
    found = fitted.viewer.read("specular")
    assert wanted.max() > 0.5
    np.testing.assert_allclose(found[..., 0], found[..., 2], rtol=1e-6)  # one lobe for all colors
    lit = wanted > 0.01 * wanted.max()
    relative = np.abs(found[..., 0][lit] - wanted[lit]) / wanted[lit]
    assert np.median(relative) < 1e-3
    assert np.percentile(relative, 99.0) < 0.02  # nearest slabs of phi_d differ at ties
    assert np.abs(found[..., 0] - wanted).max() < 0.05 * wanted.max()


def test_subpixel_slopes_widen_fitted_basis_brdfs(fitted):
    """The mean over normals, by 11 x 11 Gauss-Hermite nodes; the page takes seven."""
    rms = 0.1
    params = fitted.viewer.set(specular_model="fitted", lobe_slope_rms=rms)
    found = fitted.viewer.read("specular")[..., 0]
    x, w = np.polynomial.hermite_e.hermegauss(11)
    w = w / w.sum()
    wanted = np.zeros(found.shape)
    for i in range(len(x)):
        for j in range(len(x)):
            if w[i] * w[j] > 1e-5:
                slope = rms * np.array([x[i], x[j]])
                wanted += (
                    w[i]
                    * w[j]
                    * expected_specular(fitted, fitted.traits.lobes.shares, params, slope=slope)
                )
    lit = wanted > 0.05 * wanted.max()
    relative = np.abs(found[lit] - wanted[lit]) / wanted[lit]
    assert np.median(relative) < 0.03
    plain = expected_specular(fitted, fitted.traits.lobes.shares, params)
    assert found.max() < 0.9 * plain.max()
    assert np.median(np.abs(plain[lit] - wanted[lit]) / wanted[lit]) > 2.0 * np.median(relative)


def test_analytic_formula_differs_from_fitted_basis_brdfs(fitted):
    params = fitted.viewer.set(specular_model="analytic")
    wanted = expected_specular(fitted, fitted.traits.lobes.shares, params)
    found = fitted.viewer.read("specular")[..., 0]
    lit = wanted > 0.01 * wanted.max()
    assert np.median(np.abs(found[lit] - wanted[lit]) / wanted[lit]) > 0.05


@pytest.mark.parametrize(
    "amounts", [{}, {"lotion": 1.0}, {"powder": -0.7}, {"sweat": 0.5, "cold": 0.5}]
)
def test_surface_traits_change_weights_as_reference_does(fitted, amounts):
    fitted.viewer.set(traits=amounts)
    rows = as_packed(fitted.scene).textures["lobe_shares"].values
    rows = np.moveaxis(rows, 0, 2).reshape(16 * 16, -1)[:, : len(fitted.traits.scale)]
    wanted = fitted.traits.apply_traits(rows.astype(np.float64), amounts)
    buffers = [fitted.viewer.read(f"lobe_shares_{i}") for i in range(2)]
    found = np.concatenate(buffers, axis=-1).reshape(16 * 16, -1)[:, : wanted.shape[1]]
    # compare light: shares of lobes that look alike are exchanged by rounding
    strength = fitted.traits.lobes.mix @ brdf_tables.default_basis().strength()
    asked = np.abs((wanted - rows) @ strength).max()
    assert asked > 0.0 or not amounts
    np.testing.assert_allclose(
        found @ strength, wanted @ strength, rtol=4 * HALF, atol=0.01 * asked
    )
    if not amounts:
        np.testing.assert_array_equal(found, rows)


def test_trait_changes_image_according_to_its_weights(fitted):
    params = fitted.viewer.set(specular_model="fitted", traits={"lotion": 1.0})
    rows = fitted.traits.lobes.shares
    moved = fitted.traits.apply_traits(rows.reshape(256, -1).astype(np.float64), {"lotion": 1.0})
    wanted = expected_specular(fitted, moved.reshape(rows.shape), params)
    plain = expected_specular(fitted, rows, params)
    found = fitted.viewer.read("specular")[..., 0]
    off = np.sqrt(np.mean((found - wanted) ** 2))
    assert off < 0.05 * np.sqrt(np.mean((plain - wanted) ** 2))


def factor(names, log_factor, amounts):
    """The factor of the albedo under some traits, as the page computes it."""
    total = np.zeros(log_factor.shape[1:], np.float32)
    for i, name in enumerate(names):
        amount = amounts.get(name, 0.0)
        total += np.float32(abs(amount)) * log_factor[2 * i + (amount > 0.0)]
    return np.exp(total)


@pytest.mark.parametrize("amounts", [{"tan": 1.0}, {"tan": -0.5, "beard": 0.8}])
def test_albedo_traits_multiply_albedo_along_logarithm(fitted, amounts):
    before = fitted.viewer.read("albedo")[..., :3]
    fitted.viewer.set(traits=amounts)
    packed = as_packed(fitted.scene).textures["albedo_traits"].values
    wanted = factor(fitted.albedo.names, packed, amounts)
    found = fitted.viewer.read("albedo_factor")[..., :3]
    np.testing.assert_allclose(found, wanted, rtol=4 * HALF)
    uv = fitted.viewer.read("inspect")[..., :2]
    after = fitted.viewer.read("albedo")
    on = after[..., 3] > 0
    expected = before[on] * sampled(found, uv[on])
    np.testing.assert_allclose(after[..., :3][on], expected, rtol=0.02)
    assert np.abs(after[..., :3][on] / before[on] - 1.0).max() > 0.1


def test_translucency_trait_widens_profile_where_enabled(fitted):
    uv = fitted.viewer.read("inspect")[..., :2]
    on = fitted.viewer.read("albedo")[..., 3] > 0
    np.testing.assert_array_equal(fitted.viewer.read("specular")[..., 3][on], 1.0)
    before = fitted.viewer.read("radiance")
    fitted.viewer.set(measured_translucency=True)
    widths = as_packed(fitted.scene).textures["translucency"].values
    wanted = sampled(widths, uv[on])[:, 0]
    np.testing.assert_allclose(fitted.viewer.read("specular")[..., 3][on], wanted, rtol=2e-3)
    assert np.abs(fitted.viewer.read("radiance") - before).max() > 1e-3


def test_trait_passes_are_drawn_only_when_traits_change(fitted):
    count = "() => window.viewer.statistics.passes.surface_traits.draws"
    fitted.viewer.set(traits={"lotion": 0.3})
    before = fitted.viewer.page.evaluate(count)
    fitted.viewer.set(light_azimuth_deg=10)
    fitted.viewer.set(melanin_gain=1.3)
    assert fitted.viewer.page.evaluate(count) == before
    fitted.viewer.set(traits={"lotion": 0.4})
    assert fitted.viewer.page.evaluate(count) == before + 1


def test_the_page_states_its_errors(fitted):
    text = fitted.viewer.page.locator("#panel").text_content()
    told = fitted.scene.facts["reflectance"]
    assert f"{100 * told['rms_error']:.2f} %" in text
    assert "Surface error:" in text
    assert "of R_d at half strength" in text
    assert fitted.viewer.problems == []
