"""Reduced spaces, sure traits and tables of people at any size of numbers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from model import translucency_population
from model.traits import reduced_spaces
from model.traits import vectors as trait_vectors

CHEAP = settings(derandomize=True, deadline=None, max_examples=30, database=None)
FEW = settings(CHEAP, max_examples=10)

SEED = st.integers(0, 9999)
UNIT = st.sampled_from([1e-300, 1e-160, 1e-20, 1.0, 1e20, 1e140, 1e250])
"""What a sample's unit may make of its numbers."""


def people(seed, count=9, numbers=5):
    rng = np.random.default_rng(seed)
    samples = rng.standard_normal((count, numbers))
    samples[: count // 2] += 2.0
    (trait,) = trait_vectors.parse_traits({"beard": np.arange(count) < count // 2}, {}, count)
    return rng, samples, trait


@CHEAP
@given(seed=SEED, unit=UNIT, n=st.integers(2, 9), d=st.integers(1, 12), metric=st.booleans())
def test_principal_components_hold_the_samples_in_any_unit(seed, unit, n, d, metric):
    rng = np.random.default_rng(seed)
    samples = unit * rng.standard_normal((n, d))
    weights = rng.uniform(0.5, 2.0, d) if metric else None
    found = reduced_spaces.principal_components(
        samples, (), components=None, metric=weights, rng=np.random.default_rng(1)
    )
    again = found.center + found.coordinates @ found.basis
    np.testing.assert_allclose(again, samples, atol=1e-9 * unit)
    assert found.lost < 1e-12
    gram = (found.basis * (1.0 if weights is None else weights)) @ found.basis.T
    np.testing.assert_allclose(gram, np.eye(len(gram)), atol=1e-9)
    rank = len(found.basis)
    assert rank == min(n - 1, d)
    one = reduced_spaces.principal_components(
        samples, (), components=1, metric=weights, rng=np.random.default_rng(1)
    )
    assert 0.0 <= one.lost <= math.sqrt(1.0 - 1.0 / rank) + 1e-9
    with pytest.raises(trait_vectors.TraitError, match="components"):
        reduced_spaces.principal_components(
            samples, (), components=rank + 1, metric=weights, rng=rng
        )
    with pytest.raises(trait_vectors.TraitError, match="same"):
        reduced_spaces.principal_components(
            np.broadcast_to(samples[0], (n, d)), (), components=None, metric=weights, rng=rng
        )


@CHEAP
@given(seed=SEED, unit=st.floats(5e-324, 1e308))
def test_power_of_two_scales_numbers_to_unity_exactly(seed, unit):
    values = unit * np.random.default_rng(seed).uniform(-1.0, 1.0, 5)
    exponent = trait_vectors.scale_exponent(values, np.zeros(2))
    scaled = np.ldexp(values, -exponent)
    assert 0.5 <= np.abs(scaled).max() < 1.0 or not values.any()
    np.testing.assert_array_equal(np.ldexp(scaled, exponent), values)
    with pytest.raises(trait_vectors.TraitError, match="got nan"):
        trait_vectors.scale_exponent(values, np.array([np.nan]))


@FEW
@given(seed=SEED, unit=UNIT)
def test_useful_component_count_is_unit_invariant(seed, unit):
    _, samples, trait = people(seed, count=14, numbers=8)
    off = samples - samples.mean(axis=0)
    u, s, _ = np.linalg.svd(off, full_matrices=False)
    scores = u * s
    told = reduced_spaces.choose_component_count(scores, [trait], rng=np.random.default_rng(3))
    assert 1 <= told <= scores.shape[1]
    assert (
        reduced_spaces.choose_component_count(unit * scores, [trait], rng=np.random.default_rng(3))
        == told
    )
    # without a binary trait of two people on each side nothing can be chosen
    assert (
        reduced_spaces.choose_component_count(scores, (), rng=np.random.default_rng(3))
        == scores.shape[1]
    )
    none = reduced_spaces.choose_component_count(
        np.zeros_like(scores), [trait], rng=np.random.default_rng(3)
    )
    assert none == scores.shape[1]


@CHEAP
@given(seed=SEED, unit=UNIT, n=st.integers(2, 8), size=st.integers(1, 4))
def test_basis_mixtures_recover_their_weights(seed, unit, n, size):
    rng = np.random.default_rng(seed)
    basis = unit * rng.uniform(size=(size, 6))
    shares = rng.uniform(size=(n, size)) * (rng.uniform(size=(n, size)) < 0.7)
    samples = shares @ basis
    found = reduced_spaces.mixture_coordinates(samples, basis, None)
    assert (found >= 0.0).all()
    np.testing.assert_allclose(found @ basis, samples, atol=1e-6 * unit)
    below = reduced_spaces.mixture_coordinates(-samples, basis, None)
    np.testing.assert_allclose(below, 0.0, atol=1e-9)
    if np.ptp(samples, axis=0).max() > 0.01 * unit:
        whole = reduced_spaces.fit_mixtures(samples, basis, metric=None)
        np.testing.assert_array_equal(whole.coordinates, found)
        assert 0.0 <= whole.lost < 1e-4
        # a mixture cannot be negative: then all that differs is lost
        assert reduced_spaces.fit_mixtures(
            -samples - unit, basis, metric=None
        ).lost == pytest.approx(1)
    with pytest.raises(trait_vectors.TraitError, match="same"):
        reduced_spaces.fit_mixtures(np.full((n, 6), unit), basis, metric=None)


@CHEAP
@given(seed=SEED, kind=st.sampled_from([np.float16, np.float32, np.int64]))
def test_mixtures_of_narrow_numbers_equal_wide_ones(seed, kind):
    rng = np.random.default_rng(seed)
    samples, basis = (rng.integers(0, 9, (n, 6)).astype(kind) for n in (4, 2))
    found = reduced_spaces.mixture_coordinates(samples, basis, None)
    wide = reduced_spaces.mixture_coordinates(
        samples.astype(np.float64), basis.astype(np.float64), None
    )
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, wide, atol=1e-12)


@CHEAP
@given(bad=st.sampled_from([np.nan, np.inf, -np.inf]), where=st.sampled_from(["s", "b", "m"]))
def test_mixtures_of_nonfinite_values_are_refused(bad, where):
    samples, basis, metric = np.ones((3, 4)), np.eye(2, 4), np.eye(4)
    {"s": samples, "b": basis, "m": metric}[where][1, 1] = bad
    with pytest.raises(trait_vectors.TraitError):
        reduced_spaces.mixture_coordinates(samples, basis, metric)
    with pytest.raises(trait_vectors.TraitError, match="shape"):
        reduced_spaces.mixture_coordinates(np.ones((3, 4)), np.eye(2, 4), np.eye(3))


@CHEAP
@given(bad=st.sampled_from([np.nan, np.inf, -1.0]))
def test_invalid_basis_and_sample_are_refused(bad):
    basis, samples = np.eye(2, 3), np.arange(6.0).reshape(2, 3)
    wrong = basis.copy()
    wrong[0, 1] = bad
    with pytest.raises(trait_vectors.TraitError, match="basis"):
        reduced_spaces.fit_mixtures(samples, wrong, metric=None)
    with pytest.raises(trait_vectors.TraitError, match="basis"):
        reduced_spaces.fit_mixtures(samples, np.zeros((1, 3)), metric=None)
    if not np.isfinite(bad):
        wrong = samples.copy()
        wrong[0, 1] = bad
        rng = np.random.default_rng(0)
        with pytest.raises(trait_vectors.TraitError, match="samples"):
            reduced_spaces.fit_mixtures(wrong, basis, metric=None)
        with pytest.raises(trait_vectors.TraitError, match="samples"):
            reduced_spaces.principal_components(wrong, (), components=None, metric=None, rng=rng)


@FEW
@given(seed=SEED, unit=UNIT)
def test_trait_certainty_is_unit_invariant(seed, unit):
    _, samples, trait = people(seed)
    told = {"permutations": 39, "resamples": 20}
    plain = trait_vectors.direction_confidence(trait, samples, rng=np.random.default_rng(5), **told)
    assert 1.0 / 40.0 <= plain.p_value <= 1.0
    assert 0.0 <= plain.expected_cosine <= 1.0
    low, middle, high = plain.bootstrap_cosine
    assert -1.0 - 1e-9 <= low <= middle <= high <= 1.0 + 1e-9
    scaled = trait_vectors.direction_confidence(
        trait, unit * samples, rng=np.random.default_rng(5), **told
    )
    assert scaled.p_value == plain.p_value
    assert scaled.relative_noise == pytest.approx(plain.relative_noise, rel=1e-6)
    assert scaled.bootstrap_cosine == pytest.approx(plain.bootstrap_cosine, abs=1e-6)
    nothing = trait_vectors.direction_confidence(
        trait, np.zeros_like(samples), rng=np.random.default_rng(5), **told
    )
    assert nothing.p_value == 1.0
    assert nothing.relative_noise == math.inf


@CHEAP
@given(
    seed=SEED,
    unit=st.sampled_from([1e-300, 1e-20, 1.0, 1e20, 1e70]),
    lost=st.booleans(),
    people=st.integers(1, 6),
)
def test_people_table_counts_each_once_in_any_unit(seed, unit, lost, people):
    rng = np.random.default_rng(seed)
    value = rng.uniform(0.5, 2.0, (people, 3))
    made = []
    for k in range(people):
        # an exact repeat of a person tells nothing new
        for _ in range(1 + k % 3):
            row = unit * value[k]
            if lost:
                row[1] = (np.nan, 0.0, -unit, np.inf)[k % 4]
            made.append(
                translucency_population.SiteMeasurement(
                    f"p{k}", "cheek", tuple(row), tuple(0.01 * unit * value[k])
                )
            )
    found = translucency_population.summarize(made)
    assert found.count.tolist() == [[people, 0 if lost else people, people]]
    for name in (
        "mean_per_mm",
        "deviation_per_mm",
        "mean_stderr_per_mm",
        "deviation_stderr_per_mm",
        "noise_per_mm",
    ):
        assert np.isfinite(getattr(found, name)).all(), name
    told = [0, 2] if lost else [0, 1, 2]
    np.testing.assert_allclose(found.mean_per_mm[0, told], unit * value.mean(axis=0)[told])
    if people > 1:
        spread = unit * value.std(axis=0, ddof=1)
        np.testing.assert_allclose(found.deviation_per_mm[0, told], spread[told], rtol=1e-9)
    assert found.text()


@CHEAP
@given(bad=st.sampled_from([0.0, -0.1, np.nan, np.inf]))
def test_measurement_without_error_is_refused_by_person(bad):
    one = translucency_population.SiteMeasurement("Ada", "chin", (1.0, 1.0, 1.0), (0.1, bad, 0.1))
    with pytest.raises(translucency_population.TranslucencyPopulationError, match="Ada"):
        translucency_population.summarize([one])
    with pytest.raises(translucency_population.TranslucencyPopulationError, match="none"):
        translucency_population.summarize([])
