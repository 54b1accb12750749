import dataclasses

import numpy as np
import pytest

from model.brdf import tables as brdf_tables
from rigsim.population.population import draw_population
from skinrig.traits import truth as trait_truth
from skinrig.traits.truth import CommonFaces

PEOPLE = draw_population()


def test_conditions_are_assigned_equally_replacing_earlier_ones():
    names = ("normal", "lotion", "powder")
    given = trait_truth.assign_conditions(PEOPLE[:60], names, rng=np.random.default_rng(0))
    labels = trait_truth.label_members(given, names[1:])
    assert labels["lotion"].sum() == labels["powder"].sum() == 20
    assert not (labels["lotion"] & labels["powder"]).any()
    for one, other in zip(given, PEOPLE, strict=False):
        assert dataclasses.replace(one, applied=other.applied) == other


def test_directions_are_uniform_over_cap_above_horizon():
    found = trait_truth.sample_directions((20_000,), rng=np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-12)
    assert found[:, 2].min() >= trait_truth.MIN_SAMPLED_COSINE
    # even in z: the mean of 20,000 has a deviation of 0.88 / sqrt(12 * 20,000)
    assert found[:, 2].mean() == pytest.approx(0.56, abs=4 * 0.0018)


def test_zero_trait_changes_no_light():
    people = [dataclasses.replace(PEOPLE[0], applied=())]
    rng = np.random.default_rng(0)
    same = trait_truth.lobe_changes(people, {"worn": people}, points=3, pairs=50, rng=rng)["worn"]
    assert np.abs(same.radiance).max() < 1e-12


def test_lotion_sharpens_surface_reflection():
    people = [dataclasses.replace(PEOPLE[0], applied=())]
    worn = [dataclasses.replace(PEOPLE[0], applied=(("lotion", 1.0),))]
    change = trait_truth.lobe_changes(
        people, {"worn": worn}, points=5, pairs=2000, rng=np.random.default_rng(0)
    )["worn"]
    half = change.light + change.view
    cos_h = half[:, 2] / np.linalg.norm(half, axis=1)
    assert change.radiance[cos_h > 0.99].mean() > 0.0
    assert change.radiance[(cos_h > 0.8) & (cos_h < 0.93)].mean() < 0.0
    # and a basis' sharp lobe points along this change, a wide one against it
    basis = brdf_tables.default_basis()
    sharp, wide = (
        np.array([name == which for name in basis.names], float)
        for which in ("ggx 0.14 eta 1.4", "beckmann 0.4")
    )
    assert change.cosine(sharp - wide, basis) > 0.5 > 0.0 > change.cosine(wide - sharp, basis)


def test_faces_of_different_heads_align_in_common_map():
    people = [next(p for p in PEOPLE if p.head == head) for head in (0, 1, 2)]
    faces = CommonFaces.of(people, size=64, common=48)
    seen = [faces.albedo(p, noise=0.0, rng=np.random.default_rng(0)) for p in people]
    both = np.logical_and.reduce([one.valid for one in seen])
    assert both.mean() > 0.6
    # lips are redder than the face on every head, at the same place
    frame = faces.frame
    column, row = np.rint(frame.to_pixel(frame.landmark("lower lip"))).astype(int)
    for one in seen:
        ratio = one.r_d[..., 1] / one.r_d[..., 0]
        assert ratio[row, column] < np.median(ratio[one.valid])


def test_noise_of_the_albedo_is_relative():
    faces = CommonFaces.of(PEOPLE[:1], size=64, common=48)
    clean = faces.albedo(PEOPLE[0], noise=0.0, rng=np.random.default_rng(0))
    noisy = faces.albedo(PEOPLE[0], noise=0.05, rng=np.random.default_rng(0))
    ratio = (noisy.r_d / np.maximum(clean.r_d, 1e-6))[clean.valid]
    # 3 x about 2,000 values: the deviation of a deviation is 1 / sqrt(2 n)
    assert ratio.std() == pytest.approx(0.05, rel=4 / np.sqrt(2 * ratio.size))
