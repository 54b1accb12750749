"""Traits that a simulated population truly has, learned from what is measured of it."""

import dataclasses

import numpy as np
import pytest

from model.brdf import tables as brdf_tables
from model.traits import TraitSpace
from reconstruction import brdf_basis
from rigsim.population.population import draw_population, shift_trait
from skinrig.traits import truth as trait_truth

PEOPLE = [person for person in draw_population() if not person.applied]


def population(samples, *, shift, noise, per_group, rng):
    """Return samples of people who differ along 8 ways, a label, and the trait's true vector."""
    length = samples
    ways = rng.normal(size=(8, length)) / np.sqrt(length)
    trait = rng.normal(size=length)
    trait *= shift / np.linalg.norm(trait)
    label = np.arange(2 * per_group) < per_group
    own = rng.normal(size=(2 * per_group, 8)) @ ways
    found = own + noise * rng.normal(size=(2 * per_group, length)) / np.sqrt(length)
    return found + label[:, None] * trait, label, trait


def mean_cosine(*, shift, noise, per_group, seed):
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(12):
        samples, label, trait = population(
            300, shift=shift, noise=noise, per_group=per_group, rng=rng
        )
        found.append(TraitSpace.fit(samples, {"tan": label}).cosine("tan", trait))
    return float(np.mean(found))


def test_cosine_with_truth_falls_with_fewer_noisier_faces():
    # Errors of a difference of means: its length squared is (8 + noise^2) 2 / per_group.
    for noise in (1.0, 6.0):
        row = [mean_cosine(shift=4.0, noise=noise, per_group=n, seed=1) for n in (4, 12, 40)]
        expected = [4.0 / np.sqrt(16.0 + (8.0 + noise**2) * 2.0 / n) for n in (4, 12, 40)]
        assert row == sorted(row)
        np.testing.assert_allclose(row, expected, atol=0.06)
    assert row[-1] < mean_cosine(shift=4.0, noise=1.0, per_group=40, seed=1)


@pytest.mark.long
def test_lotion_is_learned_from_fitted_lobes():
    basis = brdf_tables.default_basis()
    people = PEOPLE[:48:4]
    dressed = shift_trait(people, "lotion", products={"lotion": 0.9}, rng=np.random.default_rng(1))
    label = np.array(["lotion" in person.marks for person in dressed])
    rng = np.random.default_rng(3)
    means = np.array(
        [
            trait_truth.mean_mixture(
                trait_truth.surface_points(p, 8, rng=rng), basis, pairs=160, rng=rng
            )
            for p in dressed
        ]
    )
    worn = [dataclasses.replace(p, applied=(("lotion", 0.9),)) for p in people[:3]]
    draws = np.random.default_rng(2)
    found = trait_truth.lobe_changes(people[:3], {"lotion": worn}, points=8, pairs=1000, rng=draws)
    truth = found["lotion"]
    strength = basis.strength()
    metric = basis.cosine_similarity() * np.outer(strength, strength)
    mix = brdf_basis.reduce(means, 6, basis=basis)[1]
    for space in ("pca", "nmf"):
        learned = TraitSpace.fit(means, {"lotion": label}, space=space, basis=mix, metric=metric)
        assert truth.cosine(learned.trait("lotion").vector, basis) > 0.95
        assert learned.trait("lotion").confidence.p_value < 0.05
    # other labels of the same faces give no trait
    shuffled = np.roll(np.sort(label), 3)[np.random.default_rng(4).permutation(len(label))]
    other = TraitSpace.fit(means, {"lotion": shuffled}, metric=metric)
    assert other.trait("lotion").confidence.p_value > 0.01
