import numpy as np
import pytest

from model.traits import reduced_spaces
from model.traits.lobe_edits import edit_weights
from model.traits.space import TraitSpace
from model.traits.vectors import TraitError

COUNT = 12


@pytest.fixture
def rng():
    return np.random.default_rng(12345)


def bumps():
    """Return overlapping lobes over directions, (200, 12): wide ones first, then sharp ones."""
    at = np.linspace(0.0, 1.0, 200)
    width = np.linspace(0.5, 0.05, COUNT)
    return np.exp(-((at[:, None] / width) ** 2)) * (0.3 / width)


def skin(rng, people=30, with_trait=12):
    """Return mean mixtures of faces; those with lotion have a film and less of wide lobes."""
    label = np.arange(people) < with_trait
    samples = np.zeros((people, COUNT))
    samples[:, 2] = rng.uniform(0.8, 1.2, people)
    samples[:, 4] = rng.uniform(0.4, 0.6, people)
    samples[label, 8] += 0.3
    samples[label, 2] -= 0.2
    m = bumps()
    return TraitSpace.fit(samples, {"lotion": label}, metric=m.T @ m)


def face(rng, texels=200):
    mix = np.zeros((2, COUNT))
    mix[0, 2:4] = 0.7, 0.3
    mix[1, 4:6] = 0.6, 0.4
    return rng.uniform(0.5, 1.5, (texels, 2)), mix


def test_edit_adds_trait_to_brdf_of_every_texel(rng):
    space, m = skin(rng), bumps()
    weights, mix = face(rng)
    edit = edit_weights(weights, mix, space, {"lotion": 0.7})
    change = 0.7 * m @ space.trait("lotion").vector
    wanted = weights @ mix @ m.T + change
    got = edit.weights @ edit.mix @ m.T
    error = np.linalg.norm(got - wanted, axis=1) / np.linalg.norm(change)
    assert edit.clipped.max() < 1e-9
    assert error.max() == pytest.approx(edit.misfit["lotion"], rel=1e-6)
    assert edit.misfit["lotion"] < 0.05
    assert len(edit.mix) == 3
    np.testing.assert_array_equal(edit.mix[:2], mix)


def test_edit_of_amount_0_is_bit_exact(rng):
    weights, mix = face(rng)
    weights = weights.astype(np.float32)
    for amounts in ({}, {"lotion": 0.0}, {"lotion": np.zeros(200)}):
        edit = edit_weights(weights, mix, skin(rng), amounts)
        assert edit.weights.dtype == np.float32
        np.testing.assert_array_equal(edit.weights, weights)
        np.testing.assert_array_equal(edit.mix, mix)
        assert edit.clipped_fraction == 0.0


@pytest.mark.parametrize("amount", [0.7, -0.5, 30.0])
def test_edit_and_opposite_return_within_clipped_amount(rng, amount):
    space, m = skin(rng), bumps()
    weights, mix = face(rng)
    there = edit_weights(weights, mix, space, {"lotion": amount})
    back = edit_weights(there.weights, there.mix, space, {"lotion": -amount})
    away = (back.weights @ back.mix - weights @ mix) @ m.T
    lengths = np.linalg.norm(away, axis=1)
    assert (lengths <= there.return_bound + 1e-7 * there.moved.max()).all()
    if amount == 0.7:
        assert len(back.mix) == len(there.mix)  # the lobes hold the trait already
        assert lengths.max() < 1e-9
    else:  # lobes were used up: something is lost, and said so
        assert lengths.max() > 0.001 * there.moved.max()
        assert 0.0 < there.clipped_fraction < 1.0


def test_weights_stay_non_negative_whatever_is_asked(rng):
    weights, mix = face(rng)
    weights[:5] = 0.0  # hair, or nothing measured
    for amount in (-20.0, -1.0, 20.0):
        edit = edit_weights(weights, mix, skin(rng), {"lotion": amount})
        assert edit.weights.min() >= 0.0
        assert np.isfinite(edit.weights).all()


def test_amounts_may_differ_by_texel(rng):
    space = skin(rng)
    weights, mix = face(rng)
    mask = np.where(np.arange(200) < 80, 0.6, 0.0)
    part = edit_weights(weights, mix, space, {"lotion": mask})
    alone = edit_weights(weights[:80], mix, space, {"lotion": 0.6})
    np.testing.assert_array_equal(part.weights[:80], alone.weights)
    np.testing.assert_array_equal(part.weights[80:, :2], weights[80:])
    assert part.weights[80:, 2:].max() == 0.0


def test_trait_representable_by_lobes_adds_no_lobes(rng):
    space = skin(rng)
    mix = np.vstack([np.eye(COUNT)[2], np.eye(COUNT)[8]])
    edit = edit_weights(np.ones((3, 2)), mix, space, {"lotion": 0.5})
    np.testing.assert_array_equal(edit.mix, mix)
    assert edit.misfit["lotion"] < 0.05


def test_unremovable_amount_is_reported_per_texel(rng):
    space, m = skin(rng), bumps()
    weights, mix = face(rng)
    weights[0] = 0.01
    edit = edit_weights(weights, mix, space, {"lotion": 1.0})
    assert edit.clipped[0] > 0.0
    assert edit.clipped[50] == 0.0
    extra = np.zeros((200, len(edit.mix)))
    extra[:, :2] = weights
    size = np.linalg.norm((edit.weights - extra) @ edit.mix @ m.T, axis=1)
    assert (np.abs(size - edit.moved) <= edit.clipped + 1e-9).all()


def test_mixtures_are_nearest_in_reflected_light(rng):
    space, m = skin(rng), bumps()
    weights, mix = face(rng, texels=20)
    edit = edit_weights(weights, mix, space, {"lotion": 30.0})
    lobes = edit.mix @ m.T
    trait = np.linalg.lstsq(lobes.T, m @ space.trait("lotion").vector, rcond=None)[0]
    wanted = np.pad(weights, ((0, 0), (0, 1))) + 30.0 * trait
    gap = np.linalg.norm((edit.weights - wanted) @ lobes, axis=1)
    np.testing.assert_allclose(gap, edit.clipped, rtol=1e-6, atol=1e-9)
    plain = np.linalg.norm((np.maximum(wanted, 0.0) - wanted) @ lobes, axis=1)
    assert (gap <= plain + 1e-12).all()
    assert gap.sum() < 0.9 * plain.sum()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"weights": -np.ones((4, 2))}, "weights: got -1"),
        ({"weights": np.ones((4, 3))}, r"weights: got"),
        ({"mix": np.ones((2, 5))}, r"expected \(K, 12\)"),
        ({"amounts": {"tan": 1.0}}, "got 'tan', expected one of lotion"),
        ({"amounts": {"lotion": np.nan}}, "amount of lotion"),
        ({"amounts": {"lotion": np.ones(3)}}, "amount of lotion"),
    ],
)
def test_mismatched_lobe_edit_input_is_refused_by_name(rng, change, message):
    given = {"weights": np.ones((4, 2)), "mix": np.ones((2, COUNT)), "amounts": {"lotion": 1.0}}
    given |= change
    with pytest.raises(TraitError, match=message):
        edit_weights(given["weights"], given["mix"], skin(rng), given["amounts"])


def test_other_materials_are_refused(rng):
    samples = rng.random((6, 3))
    space = TraitSpace.fit(samples, {"oil": np.arange(6) < 3}, names=("a", "b", "c"))
    with pytest.raises(TraitError, match="materials"):
        edit_weights(
            np.ones((2, 1)), np.ones((1, 3)), space, {"oil": 1.0}, materials=("a", "c", "b")
        )


def test_lengths_are_those_of_reflected_light(rng):
    m = bumps()
    v = rng.normal(size=(7, COUNT))
    np.testing.assert_allclose(
        reduced_spaces.metric_lengths(v, m.T @ m), np.linalg.norm(v @ m.T, axis=1), rtol=1e-9
    )
