"""The hemoglobin rig: what its equations say, its bounds, its transfer and its storage."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from model import store
from model.facial_color.document import from_maps_and_document, to_maps
from model.facial_color.rig import GLOBAL_GAINS, HemoglobinRig, local_statistics
from model.facial_color.state_maps import FacialColorError
from model.skin import SkinAppearance

RADIUS_PX = 8.0


def texture(rng, shape=(96, 90), mean=0.05, deviation=0.004):
    field = gaussian_filter(rng.standard_normal(shape), 1.5)
    return mean + deviation * field / field.std()


@pytest.fixture
def neutral(rng):
    return texture(rng)


@pytest.fixture
def rig(neutral, rng):
    x = np.linspace(0.0, 1.0, neutral.shape[1])
    smile = neutral * (1.0 + 0.4 * x) + 0.1 * (texture(rng) - 0.05)
    return HemoglobinRig.from_maps(
        neutral,
        {"smile": smile, "anger": 1.2 * neutral, "exercise": 1.3 * neutral + 0.005},
        radius_px=RADIUS_PX,
    )


@pytest.mark.parametrize("stored_size", [256, 16, None])
@pytest.mark.parametrize(("scale", "bias"), [(1.4, -0.003), (0.6, 0.02), (1.0, 0.0), (0.0, 0.07)])
def test_affine_map_of_the_neutral_comes_back_exactly(scale, bias, stored_size, neutral):
    rig = HemoglobinRig.from_maps(
        neutral, {"state": scale * neutral + bias}, radius_px=RADIUS_PX, stored_size=stored_size
    )
    np.testing.assert_allclose(rig.blend({"state": 1.0}), scale * neutral + bias, atol=1e-12)
    found = rig.evaluate({"state": 0.5, "neutral": 0.5})
    np.testing.assert_allclose(
        found.hemoglobin, 0.5 * (scale + 1) * neutral + 0.5 * bias, atol=1e-12
    )
    assert found.clipped_fraction == 0.0


def test_single_precision_maps_come_back_to_their_rounding(neutral):
    single = neutral.astype(np.float32)
    rig = HemoglobinRig.from_maps(single, {"state": np.float32(1.3) * single}, radius_px=RADIUS_PX)
    found = rig.blend({"state": 1.0})
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, 1.3 * single, rtol=3e-7)


def test_unit_weight_on_neutral_gives_neutral_map(rig, neutral):
    np.testing.assert_allclose(rig.blend({"neutral": 1.0}), neutral, rtol=1e-14)


def test_unit_state_weight_gives_local_mean_and_deviation(neutral, rng):
    state = texture(rng, mean=0.08, deviation=0.008)  # another texture altogether
    rig = HemoglobinRig.from_maps(neutral, {"state": state}, radius_px=RADIUS_PX, stored_size=None)
    mu, sigma = local_statistics(state, RADIUS_PX)
    inside = (slice(20, -20),) * 2
    found_mu, found_sigma = local_statistics(rig.blend({"state": 1.0}), RADIUS_PX)
    # the statistics themselves change within a disc; over the map they must agree
    assert abs((found_mu - mu)[inside].mean()) < 0.02 * 0.008
    assert abs((found_sigma / sigma)[inside].mean() - 1) < 0.1
    np.testing.assert_allclose(rig.bias["state"], mu, rtol=1e-12)


def test_blend_is_the_affine_combination_of_the_states(rig):
    weights = {"smile": 0.7, "exercise": 1.0, "anger": -0.2, "neutral": -0.5}
    expected = sum(w * rig.blend({name: 1.0}) for name, w in weights.items())
    np.testing.assert_allclose(rig.blend(weights), expected, atol=1e-15)


def test_scale_and_bias_match_eqs_4_to_6(neutral, rng):
    state = neutral + 0.5 * (texture(rng) - 0.05)
    rig = HemoglobinRig.from_maps(neutral, {"state": state}, radius_px=RADIUS_PX, stored_size=None)
    (mu_n, sigma_n), (mu, sigma) = (local_statistics(h, RADIUS_PX) for h in (neutral, state))
    np.testing.assert_allclose(rig.base, neutral - mu_n, atol=1e-15)
    np.testing.assert_allclose(rig.bias["state"], mu, rtol=1e-12)
    # the prior weighs as one of the 9 or more independent pieces of texture in a whole disc
    pull = rig.scale["state"] / (sigma / sigma_n) - 1
    assert np.abs(pull[8:-8, 8:-8]).max() < 0.03
    assert np.abs(pull).mean() < 0.005
    assert (rig.scale["neutral"] == 1.0).all()


def test_weights_not_summing_to_unity_are_refused_constructively(rig):
    with pytest.raises(
        FacialColorError, match=r"sum of 0\.9, expected 1; neutral=0\.1 .*normalize"
    ):
        rig.blend({"smile": 0.9})
    with pytest.raises(FacialColorError, match="did you mean 'smile'"):
        rig.blend({"smle": 1.0})
    with pytest.raises(FacialColorError, match="finite"):
        rig.blend({"smile": np.nan, "neutral": 1.0})
    with pytest.raises(FacialColorError, match="normalize cannot divide"):
        rig.blend({"smile": 1.0, "neutral": -1.0}, normalize=True)
    np.testing.assert_allclose(
        rig.blend({"smile": 0.5, "neutral": 1.5}, normalize=True),
        rig.blend({"smile": 0.25, "neutral": 0.75}),
        atol=1e-16,
    )


def test_constant_neutral_region_has_finite_scale_near_surroundings(neutral, rng):
    flat = neutral.copy()
    flat[30:70, 30:70] = 0.05
    flat[30:50, 30:70] += 1e-9 * rng.standard_normal((20, 40))
    state = 1.5 * flat
    state[30:70, 30:70] += 0.002 * rng.standard_normal((40, 40))
    rig = HemoglobinRig.from_maps(flat, {"state": state}, radius_px=RADIUS_PX, stored_size=None)
    found = rig.states["state"]
    assert np.isfinite(found.scale).all()
    assert abs(found.prior - 1.5) < 0.1
    # in the middle of the patch nothing is known but the prior
    np.testing.assert_allclose(found.scale[42:58, 42:58], found.prior, rtol=1e-3)
    assert found.scale.max() < 10 * found.prior
    # without a prior it would be millions
    (_, sigma_n), (_, sigma) = (local_statistics(h, RADIUS_PX) for h in (flat, state))
    with np.errstate(divide="ignore"):
        assert (sigma / sigma_n)[42:48, 42:58].min() > 1e5


def test_wholly_constant_neutral_map_keeps_unit_scale():
    rig = HemoglobinRig.from_maps(
        np.full((40, 40), 0.05), {"state": np.full((40, 40), 0.08)}, radius_px=5.0
    )
    np.testing.assert_allclose(rig.scale["state"], 1.0)
    np.testing.assert_allclose(rig.blend({"state": 1.0}), 0.08, rtol=1e-14)


def test_masked_pixels_never_leak(neutral):
    hole = np.zeros(neutral.shape, bool)
    hole[20:60, 30:50] = True
    state = 1.4 * neutral
    clean = HemoglobinRig.from_maps(neutral, {"state": state}, radius_px=RADIUS_PX, valid=~hole)
    for filler in (np.nan, np.inf, 1e9):
        dirty = HemoglobinRig.from_maps(
            np.where(hole, filler, neutral),
            {"state": np.where(hole, filler, state)},
            radius_px=RADIUS_PX,
            valid=~hole,
        )
        found = dirty.evaluate({"state": 1.0})
        np.testing.assert_array_equal(found.valid, ~hole)
        np.testing.assert_array_equal(found.hemoglobin, clean.blend({"state": 1.0}))
        assert np.isnan(found.hemoglobin[hole]).all()
        assert np.isfinite(found.stderr[~hole]).all()
    np.testing.assert_allclose(found.hemoglobin[~hole], 1.4 * neutral[~hole], atol=1e-12)


def test_state_with_own_mask_uses_common_valid_pixels(neutral):
    mask = np.ones(neutral.shape, bool)
    mask[:, 50:] = False
    rig = HemoglobinRig.from_maps(
        neutral,
        {"half": 1.4 * neutral + 0.01, "whole": 1.2 * neutral},
        radius_px=RADIUS_PX,
        valid={"half": mask},
        stored_size=None,
    )
    found = rig.evaluate({"half": 1.0})
    np.testing.assert_allclose(
        found.hemoglobin[found.valid], (1.4 * neutral + 0.01)[found.valid], atol=1e-12
    )
    assert found.valid[:, :55].all()
    assert not found.valid[:, 60:].any()
    assert rig.evaluate({"whole": 1.0}).valid.all()


def test_concentrations_stay_in_range_and_clipping_is_reported(neutral):
    rig = HemoglobinRig.from_maps(neutral, {"flush": neutral + 0.27}, radius_px=RADIUS_PX)
    found = rig.evaluate({"flush": 1.0})
    above = neutral + 0.27 > 0.32
    assert 0.1 < above.mean() < 0.9
    assert found.clipped_fraction == pytest.approx(above.mean(), abs=2 / neutral.size)
    assert found.hemoglobin.max() == 0.32
    pale = rig.evaluate({"neutral": 1.3, "flush": -0.3})
    assert pale.hemoglobin.min() == 0.0
    assert pale.clipped_fraction == pytest.approx((neutral - 0.081 < 0).mean(), abs=1e-9)


def test_global_gain_goes_with_its_states_weight(rig):
    anger = rig.blend({"anger": 1.0})
    for weight, factor in ((1.0, 1.27), (0.5, 1.135)):
        found = rig.evaluate({"anger": weight, "neutral": 1 - weight}, gains=GLOBAL_GAINS)
        plain = rig.blend({"anger": weight, "neutral": 1 - weight})
        np.testing.assert_allclose(found.hemoglobin, factor * plain, rtol=1e-14)
    assert GLOBAL_GAINS["fear"] == 0.81
    np.testing.assert_allclose(
        rig.evaluate({"anger": 1.0}, gain=0.5).hemoglobin, 0.5 * anger, rtol=1e-14
    )
    with pytest.raises(FacialColorError, match="factor"):
        rig.evaluate({"anger": 1.0}, gain=-1.0)


def test_exercise_and_alcohol_are_whole_body_states(rig):
    assert rig.global_states == ("exercise",)


def test_reduced_storage_error_matches_report(neutral, rng):
    x = np.linspace(0.0, 1.0, neutral.shape[1])
    state = neutral * (1.0 + 0.5 * np.sin(9 * x)) + 0.2 * (texture(rng) - 0.05)
    full, *stored = (
        HemoglobinRig.from_maps(neutral, {"state": state}, radius_px=RADIUS_PX, stored_size=n)
        for n in (None, 8, 32)
    )
    exact = full.blend({"state": 1.0})
    errors = []
    for rig in stored:
        lost = rig.blend({"state": 1.0}) - exact
        rms, largest = rig.storage_error()["state"]
        assert rms == pytest.approx(np.sqrt(np.mean(lost**2)), rel=1e-6)
        assert largest == pytest.approx(np.abs(lost).max(), rel=1e-6)
        errors.append(rms)
    assert errors[1] < 0.3 * errors[0]
    assert full.storage_error()["state"][1] < 1e-15


def test_standard_error_covers_detail_omitted_by_eq_6(neutral, rng):
    own = 0.3 * (texture(rng) - 0.05)  # the state's own pattern
    truth = 1.3 * neutral + own
    noise = 0.0004
    measured = {
        name: h + noise * rng.standard_normal(h.shape)
        for name, h in (("neutral", neutral), ("state", truth))
    }
    error = np.full(neutral.shape, noise)
    rig = HemoglobinRig.from_maps(
        measured["neutral"],
        {"state": measured["state"]},
        radius_px=16.0,
        stderr={"neutral": error, "state": error},
    )
    found = rig.evaluate({"state": 1.0})
    z = (found.hemoglobin - truth) / found.stderr
    # Variance: own^2 + (1.3 noise)^2 = 1.71; stated: with the state's noise once as seen in the
    # misfit and once as shared, 2.03; and a disc's mean fits 2 of its 32 pieces of texture: 0.79.
    # With 96 * 90 / 25 independent values the mean square is within 3 * 0.06 of it.
    assert 0.61 < np.mean(z**2) < 0.97


def test_transfer_to_the_same_neutral_map_changes_nothing(rig, neutral):
    for transfer in ("ratio", "difference", "absolute"):
        again = rig.transfer_to(neutral, transfer=transfer)
        np.testing.assert_allclose(
            again.blend({"smile": 1.0}), rig.blend({"smile": 1.0}), rtol=1e-3
        )
        assert again.radius_px == rig.radius_px


def test_dilation_transfers_to_face_with_different_blood(neutral, rng):
    # vessels whose volume grows by a factor, on one face with twice the blood of the other
    factor = 1.0 + 0.4 * np.linspace(0.0, 1.0, neutral.shape[1])
    rig = HemoglobinRig.from_maps(neutral, {"state": factor * neutral}, radius_px=RADIUS_PX)
    other = texture(rng, mean=0.025, deviation=0.002)
    truth = factor * other
    errors = {
        transfer: np.sqrt(
            np.mean((rig.transfer_to(other, transfer=transfer).blend({"state": 1.0}) - truth) ** 2)
        )
        for transfer in ("ratio", "difference", "absolute")
    }
    assert errors["ratio"] < 0.3 * errors["difference"] < 0.3 * errors["absolute"]


def test_transfer_to_another_size_and_mask(rig, neutral, rng):
    painted = np.kron(neutral[::2, ::2], np.ones((4, 4)))
    mask = np.ones(painted.shape, bool)
    mask[:30] = False
    other = rig.transfer_to(painted, valid=mask)
    assert other.radius_px == pytest.approx(2 * rig.radius_px, rel=0.01)
    found = other.evaluate({"smile": 1.0})
    np.testing.assert_array_equal(found.valid, mask)
    assert np.isfinite(found.hemoglobin[mask]).all()
    np.testing.assert_allclose(
        found.hemoglobin[mask].mean() / painted[mask].mean(),
        rig.blend({"smile": 1.0})[15:].mean() / neutral[15:].mean(),
        rtol=0.01,
    )
    with pytest.raises(FacialColorError, match="transfer: got 'x'"):
        rig.transfer_to(neutral, transfer="x")


def test_rig_survives_its_folder(rig, tmp_path):
    maps, document = to_maps(rig)
    assert json.loads(document)["schema"] == "skinrig.facial-color/1"
    store.write(
        tmp_path / "a", SkinAppearance(maps, "simulated", files={"facial_color.json": document})
    )
    read = store.read(tmp_path / "a")
    again = from_maps_and_document(read.maps, read.files["facial_color.json"])
    assert again.radius_px == rig.radius_px
    assert again.global_states == rig.global_states
    assert again.storage_error() == rig.storage_error()
    weights = {"smile": 0.7, "exercise": 0.6, "neutral": -0.3}
    before, after = rig.evaluate(weights), again.evaluate(weights)
    np.testing.assert_allclose(after.hemoglobin, before.hemoglobin, rtol=1e-6)
    np.testing.assert_allclose(after.stderr, before.stderr, rtol=1e-5)


def test_damaged_documents_are_named(rig):
    maps, document = to_maps(rig)

    def changed(**parts):
        return json.dumps(json.loads(document) | parts).encode()

    def refused(maps, document, message):
        with pytest.raises(FacialColorError, match=message):
            from_maps_and_document(maps, document)

    refused(maps, b"no", "is not JSON")
    refused(maps, changed(schema="skinrig.facial-color/2"), "got schema 'skinrig.facial-color/2'")
    refused(maps, changed(radius=3), "radius is unknown")
    refused(maps, changed(radius_px="8"), "radius_px: got '8'")
    refused(maps, changed(shape=[3, True]), "shape: got")
    refused(maps, changed(states={"smile": {}}), "states.smile.prior is missing")
    refused({n: m for n, m in maps.items() if n != "scale_smile"}, document, "'scale_smile' is mis")
    wrong = dict(maps, bias_smile=replace(maps["bias_smile"], unit="1"))
    refused(wrong, document, "unit of bias_smile: got")
    refused(maps, changed(shape=[5, 5]), "hemoglobin: got shape")


def test_maps_that_fit_nothing_are_named(neutral):
    def refused(message, *arguments, **options):
        with pytest.raises(FacialColorError, match=message):
            HemoglobinRig.from_maps(*arguments, radius_px=4.0, **options)

    refused("states: got none", neutral, {})
    refused("got name 'Smile'", neutral, {"Smile": neutral})
    refused("neutral map's own name", neutral, {"neutral": neutral})
    refused(r"smile: got shape \(3, 3\)", neutral, {"smile": np.zeros((3, 3))})
    refused("valid: got", neutral, {"smile": neutral}, valid={"x": neutral > 0})
    refused("valid of smile", neutral, {"smile": neutral}, valid={"smile": neutral})
    refused("stderr of smile: got -", neutral, {"smile": neutral}, stderr={"smile": -neutral})
    refused("global_states", neutral, {"smile": neutral}, global_states=["exercise"])
    refused("no valid pixel", neutral, {"smile": neutral}, valid=neutral < 0)
