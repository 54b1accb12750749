"""Packaged sessions of people: their estimates follow the people, and make the figures."""

import dataclasses
import json

import numpy as np

from model.brdf import tables as brdf_tables
from rigsim.population.conditions import CONDITION_NAMES
from rigsim.population.population import draw_population, get_member
from skinrig.analysing import brdf as analysing_brdf
from skinrig.analysing.brdf_space_datasets import DATASET_A_MEMBER
from skinrig.analysing.population_sessions import (
    R_D_RANGE,
    decode_r_d,
    encode_r_d,
    load_population_sessions,
)
from skinrig.benchmarks.dome import people as dome
from skinrig.benchmarks.people import PeopleValues
from skinrig.traits.truth import lobe_changes

SESSIONS = load_population_sessions()


def people(order) -> PeopleValues:
    """Return the regions of people; the estimates are those of the people in another order."""
    estimated, stderr, true = SESSIONS.regions.reshape(len(SESSIONS.captured), 3, -1).transpose(
        1, 0, 2
    )
    members = tuple(map(get_member, SESSIONS.captured))
    return PeopleValues(members, estimated[order], stderr[order], true)


def test_estimates_follow_people_and_exchanged_ones_do_not():
    n = len(SESSIONS.captured)
    green = np.arange(len(dome.REGION_LANDMARKS)) * len(dome.QUANTITY_NAMES) + 3
    assert dome.QUANTITY_NAMES[3] == "R_d green"
    assert people(np.arange(n)).exchange_probability(green) < 0.01
    assert people(np.roll(np.arange(n), 1)).exchange_probability(green) > 0.01


def test_weights_are_of_every_person_and_condition():
    assert SESSIONS.conditions.labels == CONDITION_NAMES
    for data in (SESSIONS.people, SESSIONS.conditions):
        assert data.weights.shape == (len(data.label), brdf_tables.default_basis().size)
        assert data.weights.min() >= 0.0
        assert set(data.label.tolist()) == set(range(len(data.labels)))


def test_change_of_surface_is_that_of_its_condition():
    basis, data = brdf_tables.default_basis(), SESSIONS.conditions
    mean = [data.weights[data.label == k].mean(axis=0) for k in range(len(data.labels))]
    bare = dataclasses.replace(draw_population()[DATASET_A_MEMBER], applied=())
    worn = {n: [dataclasses.replace(bare, applied=((n, 1.0),))] for n in data.labels[1:]}
    changes = lobe_changes([bare], worn, points=20, rng=np.random.default_rng(6))
    for k, change in enumerate(changes.values(), 1):
        # 0.964 to 0.998 with 60 points; two draws of 1,000 pairs differ by 0.02
        assert change.cosine(mean[k] - mean[0], basis) > 0.93
    lotion = mean[data.labels.index("lotion")] - mean[0]
    assert changes["cold"].cosine(lotion, basis) < 0.0


def test_albedo_maps_are_those_of_their_people():
    true = np.log(SESSIONS.regions[:, 2, :, 2:]).mean(axis=1)
    found = np.array([np.log(one.r_d[one.valid]).mean(axis=0) for one in SESSIONS.r_d])
    assert np.std(found - true, axis=0).max() < 0.05
    assert np.std(np.roll(found, 1, axis=0) - true, axis=0).min() > 0.1


def test_encoded_albedo_keeps_valid_pixels_within_a_step():
    rng = np.random.default_rng(3)
    r_d = np.repeat(np.repeat(rng.uniform(0.02, 1.0, (8, 8, 3)), 2, axis=0), 2, axis=1)
    valid = rng.random((16, 16)) < 0.4
    found = decode_r_d(encode_r_d(r_d.astype(np.float32), valid))
    np.testing.assert_array_equal(found.valid, valid.reshape(8, 2, 8, 2).any(axis=(1, 3)))
    step = np.log(R_D_RANGE[1] / R_D_RANGE[0]) / 254.0
    error = np.log(found.r_d[found.valid] / r_d[::2, ::2][found.valid])
    assert np.abs(error).max() < 0.501 * step
    assert np.abs(error).max() > 0.3 * step


def test_analysis_without_faces_uses_sessions(tmp_path):
    one, a, b = analysing_brdf.analyze_simulated(tmp_path, points_each=20)
    assert (one.data.labels, a.data.labels) == (("normal",), CONDITION_NAMES)
    assert b.data.labels == SESSIONS.captured
    assert b.held_out == "people"
    assert np.bincount(b.data.label).max() == 20
    document = json.loads((tmp_path / "analysis.json").read_text())
    assert document["data"] == analysing_brdf.SESSIONS_DATA
