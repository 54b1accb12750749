"""Zones found from amplitudes: what rank one tells, what places must tell, and silent texels."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from model import wrinkles
from model.wrinkles.expressions import JIMENEZ2011_TABLE, WrinkleError
from model.wrinkles.partial_derivatives import WrinkleLayer
from reconstruction.wrinkles import fit as wrinkle_fit
from reconstruction.wrinkles import texels as wrinkle_texels
from reconstruction.wrinkles import zones as wrinkle_zones

SIDE, TEXELS = 128, 16


@pytest.fixture(scope="module")
def face():
    """Return neutral normals, expressions, and the true masks: two columns of four zones."""
    rng = np.random.default_rng(11)
    base = 0.15 * rng.standard_normal((SIDE, SIDE, 2))
    wrinkle = gaussian_filter(rng.standard_normal((32, 32, 2)), (1.2, 1.2, 0))
    hard = np.zeros((8, TEXELS, TEXELS))
    for z in range(8):
        row, column = divmod(z, 2)
        hard[z, 4 * row : 4 * row + 4, 8 * column : 8 * column + 8] = 1.0
    masks = gaussian_filter(hard, (0, 0.7, 0.7), mode="nearest")
    layer = WrinkleLayer(0.5 * wrinkle / np.abs(wrinkle).max(), masks)
    states = {
        name: wrinkles.combine_layers(base, [layer], {name: 1.0}, clamp="signed")
        for name in JIMENEZ2011_TABLE.rows
    }
    return wrinkles.decode(base), states, masks, hard


def test_true_model_has_rank_one_texels_of_table(face):
    neutral, states, masks, _ = face
    found = wrinkle_zones.estimate_amplitudes(neutral, states, size=(TEXELS, TEXELS))
    assert found.valid.mean() > 0.95
    inner = masks.max(axis=0) > 0.97  # hardly any mixing within the texel
    assert inner.any()
    assert found.rank_one_fraction[inner & found.valid].min() > 0.99
    zone = masks.argmax(axis=0)
    rows = np.array([JIMENEZ2011_TABLE.rows[name] for name in found.names])
    expected = rows[:, zone] / np.abs(rows[:, zone]).max(axis=0)
    error = np.abs(found.values - expected)[:, inner & found.valid]
    assert error.mean() < 0.02


def test_rough_regions_become_soft_masks_that_explain_more(face):
    neutral, states, _, hard = face
    shifted = np.roll(hard, 1, axis=1)
    found = wrinkle_zones.estimate_amplitudes(neutral, states, size=(TEXELS, TEXELS))
    got = wrinkle_zones.fit_zones(found, layout=shifted, rng=np.random.default_rng(0))
    np.testing.assert_allclose(got.masks.sum(axis=0), 1.0, atol=1e-5)
    assert got.masks.min() >= 0.0
    explained = [
        wrinkle_fit.fit_wrinkle_map(neutral, states, masks, size=(32, 32), clamp="signed").explained
        for masks in (shifted, got.masks)
    ]
    assert 1 - explained[1] < 0.3 * (1 - explained[0])


def test_zones_without_layout_come_from_amplitudes_and_positions(face):
    neutral, states, masks, _ = face
    found = wrinkle_zones.estimate_amplitudes(neutral, states, size=(TEXELS, TEXELS))
    got = wrinkle_zones.fit_zones(found, zones=8, rng=np.random.default_rng(0))
    assert 5 <= got.distinct <= 6  # pairs of zones share their weights; orange is near cyan
    true, label = masks.argmax(axis=0), got.masks.argmax(axis=0)
    agree = sum(np.bincount(true[label == z]).max() for z in np.unique(label)) / true.size
    assert agree > 0.85
    by_chance = np.random.default_rng(1).permutation(label.ravel()).reshape(label.shape)
    chance = sum(np.bincount(true[by_chance == z]).max() for z in range(8)) / true.size
    assert chance < 0.4
    fit = wrinkle_fit.fit_wrinkle_map(neutral, states, got.masks, size=(32, 32), clamp="signed")
    assert fit.explained > 0.99


def test_the_same_seed_gives_the_same_zones(face):
    neutral, states, _, _ = face
    found = wrinkle_zones.estimate_amplitudes(neutral, states, size=(TEXELS, TEXELS))
    one, two = (
        wrinkle_zones.fit_zones(found, zones=5, rng=np.random.default_rng(3)) for _ in range(2)
    )
    np.testing.assert_array_equal(one.masks, two.masks)


def test_texels_below_their_errors_keep_the_layout(face):
    neutral, states, _, hard = face
    valid = np.ones((SIDE, SIDE), bool)
    valid[:32, :64] = False  # the whole first zone
    measured = {n: wrinkle_texels.measure_derivatives(s, valid=valid) for n, s in states.items()}
    found = wrinkle_zones.estimate_amplitudes(neutral, measured, size=(TEXELS, TEXELS))
    assert not found.valid[:4, :8].any()
    got = wrinkle_zones.fit_zones(found, layout=hard, rng=np.random.default_rng(0))
    np.testing.assert_allclose(got.masks[:, :4, :8], hard[:, :4, :8], atol=1e-6)
    noise = np.random.default_rng(5)
    still = np.zeros((64, 64, 2))
    few = {
        n: wrinkle_texels.measure_derivatives(
            wrinkles.decode(still + 0.01 * noise.standard_normal(still.shape)),
            stderr_rad=np.full((64, 64), 0.01 * np.sqrt(2)),
        )
        for n in ("a", "b")
    }
    silent = wrinkle_zones.estimate_amplitudes(wrinkles.decode(still), few, size=(8, 8))
    assert silent.valid.mean() < 0.1


def test_single_expression_gives_single_distinct_zone(face):
    neutral, states, _, _ = face
    found = wrinkle_zones.estimate_amplitudes(
        neutral, {"joy": states["joy"]}, size=(TEXELS, TEXELS)
    )
    got = wrinkle_zones.fit_zones(found, zones=3, rng=np.random.default_rng(0))
    assert got.distinct == 1


def test_mismatched_zone_inputs_are_refused(face):
    neutral, states, _, hard = face
    with pytest.raises(WrinkleError, match="at least one"):
        wrinkle_zones.estimate_amplitudes(neutral, {})
    with pytest.raises(WrinkleError, match="size"):
        wrinkle_zones.estimate_amplitudes(neutral, states, size=(500, 4))
    still = wrinkle_zones.estimate_amplitudes(neutral, {"rest": neutral}, size=(8, 8))
    with pytest.raises(WrinkleError, match="no texel with a wrinkle"):
        wrinkle_zones.fit_zones(still, rng=np.random.default_rng(0))
    found = wrinkle_zones.estimate_amplitudes(neutral, states, size=(8, 8))
    with pytest.raises(WrinkleError, match="layout"):
        wrinkle_zones.fit_zones(found, layout=hard, rng=np.random.default_rng(0))
    with pytest.raises(WrinkleError, match="zones: got 99"):
        wrinkle_zones.fit_zones(found, zones=99, rng=np.random.default_rng(0))
