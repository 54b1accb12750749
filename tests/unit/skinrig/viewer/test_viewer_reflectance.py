"""Fitted reflectance for the page: compact lobes, Gaussians of a dipole, traits, presets."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.factored_lobes import factored
from scipy.special import erf

from model import dipole, fresnel
from model.brdf import tables as brdf_tables
from model.traits import lobe_edits
from model.traits import storage as trait_storage
from rigsim.geometry.mesh import build_mesh
from skinrig.viewer import faces
from skinrig.viewer.assets import fitted as trait_assets
from skinrig.viewer.assets import gaussian_profiles
from skinrig.viewer.assets import reflectance as reflectance_assets
from skinrig.viewer.assets.reflectance import PageLobes
from skinrig.viewer.scene import SceneError, SceneSource


@pytest.fixture(scope="module")
def face() -> PageLobes:
    """Three lobes of two materials each over a 6 x 8 texture, some shares 0 as fits have them."""
    rng = np.random.default_rng(12345)
    materials = brdf_tables.default_basis()
    mix = np.zeros((3, materials.size))
    for row in mix:
        row[rng.choice(materials.size, 2, replace=False)] = rng.uniform(0.2, 0.8, 2)
    mix /= mix.sum(axis=1, keepdims=True)
    shares = np.maximum(rng.normal(0.25, 0.25, (6, 8, 3)), 0.0).astype(np.float32)
    return PageLobes(materials.mix_materials(mix), shares, mix, materials.names, "fitted")


@pytest.fixture(scope="module")
def forms(face):
    """Its lobes as separable factors."""
    return factored(face.lobes)


@pytest.fixture(scope="module")
def traits(face):
    """Its surface traits."""
    found = trait_assets.build_surface_traits(face)
    assert found is not None
    return found


def test_chosen_table_meets_bound_and_next_coarser_misses(face):
    found = reflectance_assets.choose_table(face.lobes)
    assert max(found.rms_error, found.strong_error) <= reflectance_assets.MAX_SHAPE_ERROR
    coarser = reflectance_assets.TRIED_SLABS[reflectance_assets.TRIED_SLABS.index(found.slabs) - 1]
    table = face.lobes.table[..., :3].astype(np.float64)
    back = reflectance_assets.average_slabs(table, coarser)
    assert (
        max(reflectance_assets.compute_table_errors(back, table))
        > reflectance_assets.MAX_SHAPE_ERROR
    )


def test_factors_as_accurate_as_table_need_more_lookups(face, forms):
    found = reflectance_assets.choose_table(face.lobes)
    factors = [one for one in forms if one.lookups <= found.lookups]
    assert all(one.rms_error > found.rms_error for one in factors)
    more = [one for one in forms if one.form == "factors"]
    assert min(one.lookups for one in more) > found.lookups


def test_errors_of_factors_fall_with_their_rank(forms):
    by_rank = {one.rank: one.rms_error for one in forms if one.form == "factors"}
    assert by_rank[8] < by_rank[2] < by_rank[1]


def test_atlas_stores_each_lobe_at_its_position(face):
    found = reflectance_assets.choose_table(face.lobes)
    image = reflectance_assets.build_atlas(found)
    assert image.shape == (found.slabs * 32, 90, 4)
    slab, d, h = 5, 17, 40
    expected = face.lobes.table[d, slab * 12 // found.slabs, h, :3]
    np.testing.assert_allclose(image[slab * 32 + d, h, :3], expected, rtol=1e-3)
    assert not image[..., 3].any()


def test_lambertian_lobes_need_no_slabs():
    flat = brdf_tables.tabulate({"flat": lambda light, view: 0.25 + 0.0 * light[..., 2]})
    assert reflectance_assets.choose_table(flat).slabs == 1


def test_slabs_not_dividing_nodes_are_refused(face):
    with pytest.raises(ValueError, match="slabs: got 5"):
        reflectance_assets.average_slabs(face.lobes.table.astype(np.float64), 5)


R_D = np.array([0.45, 0.30, 0.20])
SIGMA_TR = np.array([0.6, 1.07, 1.67])


def _dipole_edge(x_mm: float, channel: int) -> float:
    """Light at a distance from an edge, by brute force over the lit half-plane."""
    sigma_a, sigma_s = dipole.coefficients(
        dipole.invert_to_deficit(R_D, fresnel.ETA_SKIN), SIGMA_TR
    )
    u = np.linspace(-1.0, 1.0, 801) ** 3 * 25.0
    y = 0.5 * (u[1:] + u[:-1])
    dy = np.diff(u)
    x = x_mm - y  # lit where the source lies at more than 0
    lit = x > 0.0
    radius = np.hypot(y[lit][:, None], y[None, :])
    values = dipole.reflectance(radius, sigma_a[channel], sigma_s[channel], fresnel.ETA_SKIN)
    return float((dy[lit] @ values @ dy) / R_D[channel])


def test_gaussians_blur_light_edge_like_dipole():
    found = gaussian_profiles.fit_gaussians(R_D, SIGMA_TR)
    spread = np.sqrt(2.0 * found.variances_mm2)
    for x in (0.0, 0.3, 1.0, 3.0):
        for channel in range(3):
            expected = _dipole_edge(x, channel)
            edge = (0.5 + 0.5 * erf(x / spread)) @ found.weights[:, channel]
            assert abs(edge - expected) < 0.004, (x, channel)


def test_single_gaussian_misses_edge_far_more_than_four():
    one, four = (gaussian_profiles.fit_gaussians(R_D, SIGMA_TR, count=n) for n in (1, 4))
    assert one.edge_error.max() > 0.05
    assert four.edge_error.max() < 0.002


def test_uniform_light_is_kept_and_red_spreads_farthest():
    found = gaussian_profiles.fit_gaussians(R_D, SIGMA_TR)
    np.testing.assert_allclose(found.weights.sum(axis=0), 1.0, atol=1e-12)
    assert (found.weights >= 0.0).all()
    spread = found.variances_mm2 @ found.weights
    assert spread[0] > spread[1] > spread[2]


def test_a_profile_scales_with_the_translucency():
    fine, coarse = (
        gaussian_profiles.fit_gaussians(R_D, SIGMA_TR),
        gaussian_profiles.fit_gaussians(R_D, SIGMA_TR / 2),
    )
    ratio = (coarse.variances_mm2 @ coarse.weights) / (fine.variances_mm2 @ fine.weights)
    np.testing.assert_allclose(ratio, 4.0, rtol=0.02)


@pytest.mark.parametrize(
    ("r_d", "sigma_tr"), [([0.0, 0.3, 0.3], [1, 1, 1]), ([0.3, 0.3, 0.3], [1, 0, 1])]
)
def test_invalid_skin_is_refused(r_d, sigma_tr):
    with pytest.raises(SceneError, match="above 0"):
        gaussian_profiles.fit_gaussians(r_d, sigma_tr)


def test_traits_add_lobes_and_keep_face_bit_exactly(face, traits):
    found = traits
    assert found.lobes.lobes.size > 3
    np.testing.assert_array_equal(found.lobes.lobes.table[..., :3], face.lobes.table[..., :3])
    np.testing.assert_array_equal(found.lobes.shares[..., :3], face.shares)
    assert not found.lobes.shares[..., 3:].any()


def test_zero_traits_keep_weights(traits):
    found = traits
    rows = found.lobes.shares.reshape(-1, found.lobes.lobes.size)
    np.testing.assert_array_equal(found.apply_traits(rows, {}), rows)


@pytest.mark.parametrize("name", ["lotion", "powder", "sweat"])
def test_page_traits_match_editor_within_stated_error(traits, name):
    found = traits
    space = trait_storage.load_packaged_traits().spaces["surface"]
    rows = found.lobes.shares.reshape(-1, found.lobes.lobes.size).astype(np.float64)
    edited = lobe_edits.edit_weights(rows, found.lobes.mix, space, {name: 0.5})
    strength = brdf_tables.default_basis().strength()
    page = found.apply_traits(rows, {name: 0.5}).astype(np.float64) @ found.lobes.mix @ strength
    wanted = edited.weights @ edited.mix @ strength
    asked = np.abs(wanted - rows @ found.lobes.mix @ strength)
    bound = max(found.held_error[name])
    # half a trait is missed by no more than a whole one may be, in the same unit
    assert np.sqrt(np.mean((page - wanted) ** 2)) < 2.0 * bound * np.sqrt(np.mean(asked**2))
    still = rows @ found.lobes.mix @ strength
    assert np.sqrt(np.mean((still - wanted) ** 2)) > 5.0 * np.sqrt(np.mean((page - wanted) ** 2))


def test_two_traits_can_each_bring_a_lobe(face):
    space = trait_storage.load_packaged_traits().spaces["surface"]
    rows = face.shares.reshape(-1, 3).astype(np.float64)
    edited = lobe_edits.edit_weights(rows, face.mix, space, {"lotion": 1.0, "sweat": 1.0})
    assert len(edited.mix) >= 3
    assert np.all(edited.weights >= 0.0)


def test_traits_of_other_materials_are_left_out(face):
    others = PageLobes(
        face.lobes, face.shares, face.mix[:, :5], ("a", "b", "c", "d", "e"), "fitted"
    )
    assert trait_assets.build_surface_traits(others) is None


def test_opposite_traits_share_slider_chance_traits_have_none():
    traits = trait_storage.load_packaged_traits().spaces["albedo"].traits
    names = trait_assets.select_significant_traits(traits)
    assert "caucasian" not in names
    assert "freckles" not in names  # p = 1 in the packaged population
    assert "tan" in names


def test_face_without_fits_shows_population_and_reports(procedural_source):
    found = reflectance_assets.read_lobes(procedural_source)
    assert found.origin == "population"
    assets = reflectance_assets.build_lobe_assets(procedural_source, found)
    assert {what for what, _ in assets["left_out"]} == {
        "basis BRDFs of this face",
        "diffuse mean free path of this face",
    }
    assert "translucency" not in assets["textures"]


@pytest.fixture(scope="module")
def procedural_source() -> SceneSource:
    """A source of which nothing was measured."""

    mesh = build_mesh(10.0 * np.eye(3), [[0, 1, 2]], np.zeros((3, 2)))
    return SceneSource("procedural", mesh, 64, 0, None, None)


def test_filling_keeps_known_values_and_extends_them():
    values = np.zeros((16, 16, 1), np.float32)
    valid = np.zeros((16, 16), bool)
    valid[:, :8], values[:, :8] = True, 3.0
    np.testing.assert_allclose(reflectance_assets.fill_texels(values, valid, 16), 3.0, rtol=1e-5)
    coarse = reflectance_assets.fill_texels(values, valid, 4)
    assert coarse.shape == (4, 4, 1)
    np.testing.assert_allclose(coarse, 3.0, rtol=1e-5)


def test_presets_name_only_available_face_parts():
    found = faces.build_presets(["anger", "surprise", "exercise"])
    assert list(found) == [
        "neutral",
        "surprise",
        "anger",
        "anger and surprise",
        "after exercise",
        "exercise",
    ]
    assert found["after exercise"] == {"anger": 1.0, "surprise": 1.0, "exercise": 1.0}


def test_shapes_of_single_muscles_make_the_six_emotions():
    names = [
        f"{unit}_{side}"
        for unit in (
            "mouthSmile",
            "cheekSquint",
            "browInnerUp",
            "browOuterUp",
            "browDown",
            "eyeWide",
            "noseSneer",
            "mouthFrown",
            "mouthStretch",
        )
        for side in "LR"
    ] + ["jawOpen", "mouthPucker"]
    found = faces.build_presets(names)
    assert set(faces.EMOTION_STATES) <= set(found)
    assert all(0.0 < w <= 1.0 for weights in found.values() for w in weights.values())
    assert "after exercise" not in found  # no blood, no exercise
