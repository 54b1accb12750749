"""Statistics over people: each limit passes on correct estimates and fails on wrong ones."""

import dataclasses

import numpy as np
import pytest

from skinrig.benchmarks import people
from skinrig.benchmarks.people import PeopleValues, choose_members

MEMBERS = choose_members(2)
N_QUANTITIES = 4
STDERR = 0.02
DEVIATION = 0.1


@pytest.fixture
def values(rng):
    """Return estimates of 12 people whose errors are as stated, and common to all people."""
    true = 1.0 + DEVIATION * rng.standard_normal((len(MEMBERS), N_QUANTITIES))
    own = 0.2 * STDERR * rng.standard_normal(true.shape)
    estimated = true + STDERR * rng.standard_normal(N_QUANTITIES) + own
    return PeopleValues(MEMBERS, estimated, np.full(true.shape, STDERR), true)


def test_chosen_members_cover_all_groups():
    assert len({one.name for one in MEMBERS}) == len(MEMBERS)
    for group in people.POPULATION_GROUPS:
        assert sum(one.group == group.name for one in MEMBERS) == 2


def test_pull_alarms_on_understated_errors_only(values):
    got, bound = values.largest_pull()
    assert got < bound
    wrong = dataclasses.replace(values, estimated=values.estimated + 6.0 * STDERR)
    assert wrong.largest_pull()[0] > bound
    # four quantities at 0.1 %: the normal quantile of 0.0125 % on each side
    assert bound == pytest.approx(3.662, abs=0.001)


def test_pull_ignores_quantities_without_stated_errors(values):
    stderr = values.stderr.copy()
    stderr[:, 0] = np.nan
    off = values.estimated.copy()
    off[:, 0] += 1.0
    some = dataclasses.replace(values, estimated=off, stderr=stderr)
    assert some.largest_pull()[0] < some.largest_pull()[1] < values.largest_pull()[1]


def test_exchange_detects_estimates_of_other_people(values):
    every = np.arange(N_QUANTITIES)
    assert values.exchange_probability(every) < 0.001
    others = dataclasses.replace(values, estimated=np.roll(values.estimated, 1, axis=0))
    assert others.exchange_probability(every) > 0.01


def test_exchange_probability_is_uniform_without_information(rng, monkeypatch):
    monkeypatch.setattr(people, "N_EXCHANGES", 199)
    found = []
    for _ in range(400):
        true, noise = rng.standard_normal((2, len(MEMBERS), 2))
        blind = PeopleValues(MEMBERS, noise, np.full(noise.shape, np.nan), true)
        found.append(blind.exchange_probability([0, 1]))
    # binomial standard deviation of 400 trials at 10 %: 1.5 %; four of them
    assert abs(np.mean(np.array(found) <= 0.1) - 0.1) < 0.06


def test_exchange_omits_people_without_estimate(values):
    estimated = values.estimated.copy()
    estimated[0, 1] = np.nan
    some = dataclasses.replace(values, estimated=estimated)
    assert some.exchange_probability([0, 1]) < 0.01
    assert some.describe(1)["people"] == len(MEMBERS) - 1
    assert some.describe(0)["people"] == len(MEMBERS)


def test_trends_are_those_of_people(rng):
    women = people.label_traits(MEMBERS)["women"][:, None]
    true = 1.0 - 0.05 * women
    noise = 0.01 * rng.standard_normal(true.shape)
    values = PeopleValues(MEMBERS, true + noise, np.full(true.shape, np.nan), true)
    found = values.trends(0)
    assert found["women, true"] == pytest.approx(-0.05, abs=1e-4)
    assert found["asian, true"] == pytest.approx(0.0, abs=1e-4)
    # four standard errors of 7 degrees of freedom: false alarm below 1 %
    assert abs(found["women"] + 0.05) < 4 * found["women, standard error"]
    assert abs(found["women"]) > 4 * found["women, standard error"]


def test_trends_need_more_people_than_traits(values):
    few = slice(0, 5)
    parts = (values.estimated[few], values.stderr[few], values.true[few])
    assert PeopleValues(MEMBERS[few], *parts).trends(0) == {}
