import dataclasses

import numpy as np
import pytest
from numpy.typing import NDArray

from rigsim.geometry.polygon_net import polygon_edge_distance
from rigsim.skin_patch.microrelief import SITE_NAMES, MicroSkin, MicroSkinError, make_micro_skin


def slopes(skin: MicroSkin) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    by_row, by_column = np.gradient(skin.height_um.astype(np.float64), skin.texel_um)
    return by_column, -by_row


@pytest.mark.parametrize("site", SITE_NAMES)
@pytest.mark.parametrize("seed", [0, 5])
def test_facets_of_every_site_tilt_11_to_20deg(site: str, seed: int) -> None:
    x, y = slopes(make_micro_skin(site, seed=seed, size_mm=3.0))
    assert 11.0 <= np.degrees(np.arctan(np.hypot(x, y))).mean() <= 20.0


@pytest.mark.long
def test_sites_differ_in_depth_and_direction() -> None:
    deep, across = {}, {}
    for site in SITE_NAMES:
        skins = [make_micro_skin(site, seed=seed, size_mm=3.0) for seed in range(3)]
        deep[site] = np.mean([skin.height_um.std() for skin in skins])
        across[site] = np.mean([slopes(s)[1].var() / slopes(s)[0].var() for s in skins])
    assert deep["cheek"] < 0.8 * deep["forehead"] < 0.8 * deep["chin"]
    # Furrows of the forehead run along x, so its slopes are along y.
    assert across["forehead"] > 1.5 > 1.2 > across["cheek"]


def test_larger_patch_contains_smaller_one_at_center() -> None:
    small = make_micro_skin("chin", seed=2, size_mm=0.8)
    large = make_micro_skin("chin", seed=2, size_mm=1.6)
    inner = slice(40, 120)
    for name in ("height_um", "albedo", "alpha", "layer_um"):
        np.testing.assert_allclose(
            getattr(large, name)[inner, inner], getattr(small, name), rtol=1e-4, atol=2e-3
        )


def test_same_seed_gives_same_patch_another_seed_another() -> None:
    one, same, other = (make_micro_skin("cheek", seed=s, size_mm=0.5) for s in (4, 4, 5))
    np.testing.assert_array_equal(one.height_um, same.height_um)
    assert np.corrcoef(one.height_um.ravel(), other.height_um.ravel())[0, 1] < 0.5


def test_position_has_same_height_at_any_texel_size() -> None:
    fine = make_micro_skin("forehead", seed=1, size_mm=1.0, texel_um=5.0)
    coarse = make_micro_skin("forehead", seed=1, size_mm=1.0, texel_um=20.0)
    block = fine.height_um.reshape(50, 4, 50, 4).mean(axis=(1, 3))
    assert np.corrcoef(block.ravel(), coarse.height_um.ravel())[0, 1] > 0.97


def test_darker_presets_reflect_less_and_all_have_texture() -> None:
    maps = [
        make_micro_skin("cheek", seed=1, size_mm=1.0, preset=preset).albedo
        for preset in ("I", "III", "V", "darkest")
    ]
    means = [float(m.mean()) for m in maps]
    assert means == sorted(means, reverse=True)
    for m in maps[:3]:
        assert 0.02 < m.std() / m.mean() < 0.4
        assert 0.0 < m.min()
        assert m.max() < 1.0


def test_layer_is_thinner_in_grooves() -> None:
    skin = make_micro_skin("chin", seed=3, size_mm=1.5)
    deep = skin.height_um < np.quantile(skin.height_um, 0.05)
    high = skin.height_um > np.quantile(skin.height_um, 0.5)
    assert skin.layer_um[deep].mean() < 0.85 * skin.layer_um[high].mean()


def test_net_distance_is_distance_to_second_polygon_bisector() -> None:
    rng = np.random.default_rng(1)
    # Without jitter polygons are unit squares about half-integers.
    x, y = rng.uniform(-3.0, 3.0, (2, 100))
    distance, _ = polygon_edge_distance(x, y, jitter=0.0, seed=0)
    expected = np.minimum(np.abs(x - np.round(x)), np.abs(y - np.round(y)))
    np.testing.assert_allclose(distance, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"site": "elbow"}, "site"),
        ({"preset": "VII"}, "preset"),
        ({"seed": -1}, "seed"),
        ({"texel_um": 0.5}, "texel_um"),
        ({"size_mm": 0.0}, "size_mm"),
        ({"size_mm": 30.0, "texel_um": 2.0}, "texels"),
    ],
)
def test_a_patch_that_cannot_be_made_is_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(MicroSkinError, match=message):
        make_micro_skin(**({"site": "chin", "size_mm": 0.5} | change))  # type: ignore[arg-type]


def test_contradictory_patch_is_refused() -> None:
    skin = make_micro_skin("chin", size_mm=0.3)
    with pytest.raises(MicroSkinError, match="albedo"):
        dataclasses.replace(skin, albedo=skin.albedo[:-2])
    with pytest.raises(MicroSkinError, match="layer_um"):
        dataclasses.replace(skin, layer_um=0.0 * skin.layer_um)
    with pytest.raises(MicroSkinError, match="poisson"):
        dataclasses.replace(skin, poisson=0.6)
