import numpy as np
import pytest
from scipy.optimize import nnls

from model.traits import feasible_sets, nonnegative_kernels, reduced_spaces
from model.traits.feasible_sets import HistogramSet, NonNegativeSet, UnconstrainedSet
from model.traits.space import TraitSpace, cosine
from model.traits.vectors import TraitError


@pytest.fixture
def rng():
    return np.random.default_rng(12345)


def population(rng, people=40, length=60, with_trait=15, noise=0.3, shift=1.0):
    """Return samples that differ in 5 directions and by a known trait, labels, and the trait."""
    ways = rng.normal(size=(5, length))
    trait = rng.normal(size=length)
    label = np.arange(people) < with_trait
    samples = rng.normal(size=(people, 5)) * 0.5 @ ways + noise * rng.normal(size=(people, length))
    return samples + shift * label[:, None] * trait, label, trait


def histograms(rng, people=30, blocks=3, with_trait=10):
    base = rng.random((blocks, 256)) ** 6
    rows = []
    for k in range(people):
        h = base * np.exp(0.3 * rng.normal(size=base.shape))
        if k < with_trait:
            h = h + 0.5 * np.roll(h, 8, axis=1)
        rows.append((h / h.sum(axis=1, keepdims=True)).ravel())
    return np.array(rows), np.arange(people) < with_trait


def products(rng, count=12):
    """Return products of overlapping bumps, as of a row of lobes."""
    at = np.linspace(0.0, 1.0, 200)
    bumps = np.exp(-(((at[:, None] - np.linspace(0.1, 0.9, count)) / 0.1) ** 2))
    return bumps.T @ bumps


def test_trait_vector_is_difference_of_complement_means(rng):
    samples, label, _ = population(rng)
    space = TraitSpace.fit(samples, {"tan": label}, components=39)
    expected = samples[label].mean(axis=0) - samples[~label].mean(axis=0)
    np.testing.assert_allclose(space.trait("tan").vector, expected, atol=1e-10)
    with_it = space.mean_with("tan")
    np.testing.assert_allclose(with_it, samples[label].mean(axis=0), atol=1e-10)


def test_continuous_trait_vector_is_regression_slope(rng):
    samples, _, trait = population(rng, shift=0.0)
    age = rng.uniform(20.0, 60.0, len(samples))
    samples = samples + 0.05 * age[:, None] * trait
    space = TraitSpace.fit(samples, {}, continuous={"age": age}, components=39)
    slope = np.polyfit(age, samples, 1)[0]
    np.testing.assert_allclose(space.trait("age").vector, slope, atol=1e-10)
    assert space.trait("age").others == 0


def test_two_group_standard_errors_match_welch(rng):
    samples, label, _ = population(rng)
    found = TraitSpace.fit(samples, {"tan": label}).trait("tan").stderr
    squared = sum(samples[g].var(axis=0, ddof=1) / g.sum() for g in (label, ~label))
    np.testing.assert_allclose(found, np.sqrt(squared), rtol=1e-10)


def test_standard_errors_cover_the_truth(rng):
    inside = []
    for _ in range(20):
        samples, label, trait = population(rng)
        found = TraitSpace.fit(samples, {"tan": label}, components=39).trait("tan")
        inside.append(np.abs(found.vector - trait) < found.stderr)
    # 20 draws of 5 shared directions: the share has a deviation of about 0.683 / sqrt(2 * 20 * 5)
    assert abs(np.mean(inside) - 0.683) < 4 * 0.034


def test_regression_separates_correlated_traits(rng):
    samples, tan, _ = population(rng, people=200, with_trait=100)
    beard = (rng.random(200) < np.where(tan, 0.9, 0.1)).astype(bool)
    truth = rng.normal(size=samples.shape[1])
    samples = samples + beard[:, None] * truth
    labels = {"tan": tan, "beard": beard}
    means = TraitSpace.fit(samples, labels)
    beside = TraitSpace.fit(samples, labels, contrast="regression")
    assert beside.cosine("beard", truth) > 0.95 > means.cosine("beard", truth)
    assert means.trait("tan").confounded[0][0] == "beard"
    assert "goes along with beard" in means.trait("tan").warning


def test_duplicate_traits_are_reported_and_refused_by_regression(rng):
    samples, tan, _ = population(rng)
    space = TraitSpace.fit(samples, {"tan": tan, "brown": tan, "pale": ~tan})
    assert "cannot be separated" in space.trait("tan").warning
    assert space.trait("tan").confounded[1][1] == pytest.approx(-1.0)
    with pytest.raises(TraitError, match="cannot be separated by regression"):
        TraitSpace.fit(samples, {"tan": tan, "brown": tan}, contrast="regression")


@pytest.mark.parametrize("space", ["pca", "nmf"])
def test_edit_of_amount_0_returns_sample_bit_exact(rng, space):
    samples = rng.random((20, 12))
    label = np.arange(20) < 8
    made = TraitSpace.fit(
        samples,
        {"lotion": label},
        space=space,
        metric=products(rng),
        basis=rng.random((4, 12)) if space == "nmf" else None,
    )
    strange = rng.random(12).astype(np.float32)
    for mode in ("linear", "convex"):
        same = made.edit(strange, {"lotion": 0.0}, mode=mode)
        assert same.dtype == np.float32
        np.testing.assert_array_equal(same, strange)
        np.testing.assert_array_equal(made.edit(strange, {}, mode=mode), strange)


def test_unclipped_edit_and_opposite_return_source(rng):
    samples, label, _ = population(rng)
    space = TraitSpace.fit(samples, {"tan": label})
    there = space.edit_with_outcome(samples[20], {"tan": 0.7})
    assert there.clipped == 0.0
    np.testing.assert_allclose(space.edit(there.sample, {"tan": -0.7}), samples[20], atol=1e-12)


@pytest.mark.parametrize("amount", [0.3, 1.0, -1.0, 4.0])
def test_edit_and_opposite_return_source_within_stated_bound(rng, amount):
    samples, label = histograms(rng)
    space = TraitSpace.fit(samples, {"tan": label})
    there = space.edit_with_outcome(samples, {"tan": amount})
    back = space.edit(there.sample, {"tan": -amount})
    away = np.linalg.norm(back - samples, axis=1)
    assert (away <= there.return_bound + 1e-12).all()
    # the bound is no idle one: something was clipped, and the way back misses by some of it
    assert away.max() > 0.05 * there.return_bound.max() > 0.0
    assert (there.clipped_fraction <= 1.0).all()


def test_edited_mixtures_stay_nonnegative_and_return_within_bound(rng):
    g = products(rng)
    samples = np.where(rng.random((30, 12)) < 0.4, rng.random((30, 12)), 0.0)
    label = np.arange(30) < 12
    samples[label] += np.linspace(0.0, 0.8, 12)
    space = TraitSpace.fit(samples, {"lotion": label}, metric=g)
    there = space.edit_with_outcome(samples, {"lotion": -1.5})
    assert there.sample.min() >= 0.0
    assert there.clipped.max() > 0.0
    back = space.edit(there.sample, {"lotion": 1.5})
    away = reduced_spaces.metric_lengths(back - samples, g)
    assert (away <= there.return_bound * (1 + 1e-6) + 1e-9).all()


def test_mixture_shortfall_is_taken_from_similar_components(rng):
    g = products(rng)
    wanted = np.zeros(12)
    wanted[5], wanted[6] = 1.0, -0.5
    by_kin = NonNegativeSet().project(wanted, g)
    plain = NonNegativeSet().project(wanted)
    off = [float(reduced_spaces.metric_lengths(p - wanted, g)) for p in (by_kin, plain)]
    assert off[0] < 0.9 * off[1]


@pytest.mark.parametrize("amount", [0.5, -3.0, 8.0])
def test_edited_histograms_are_histograms(rng, amount):
    samples, label = histograms(rng)
    space = TraitSpace.fit(samples, {"tan": label})
    assert space.feasible == HistogramSet(256)
    edited = space.edit(samples[25], {"tan": amount}).reshape(-1, 256)
    assert edited.min() >= 0.0
    np.testing.assert_allclose(edited.sum(axis=1), 1.0, atol=1e-12)


def test_convex_edit_of_unit_amount_is_trait_mean(rng):
    samples, label = histograms(rng)
    space = TraitSpace.fit(samples, {"tan": label}, components=29)
    edited = space.edit(samples[25], {"tan": 1.0}, mode="convex")
    np.testing.assert_allclose(edited, samples[label].mean(axis=0), atol=1e-12)
    half = space.edit(samples[25], {"tan": 0.5}, mode="convex")
    np.testing.assert_allclose(half, 0.5 * (edited + samples[25]), atol=1e-12)


@pytest.mark.parametrize("amounts", [{"tan": -0.1}, {"tan": 0.7, "old": 0.4}])
def test_amounts_that_make_no_convex_combination_are_refused(rng, amounts):
    samples, label, _ = population(rng)
    space = TraitSpace.fit(samples, {"tan": label, "old": np.arange(40) % 2 == 0})
    with pytest.raises(TraitError, match="at least 0, together at most 1"):
        space.edit(samples[0], amounts, mode="convex")


def test_continuous_trait_has_no_group_to_mix(rng):
    samples, _, _ = population(rng)
    space = TraitSpace.fit(samples, {}, continuous={"age": rng.random(40)})
    with pytest.raises(TraitError, match="continuous"):
        space.edit(samples[0], {"age": 0.5}, mode="convex")


@pytest.mark.parametrize(("label", "who"), [(False, "nobody"), (True, "everybody")])
def test_trait_of_nobody_or_everybody_is_refused(rng, label, who):
    samples, _, _ = population(rng)
    with pytest.raises(TraitError, match=f"label 'sweat': {who} of 40 has it"):
        TraitSpace.fit(samples, {"sweat": np.full(40, label)})


def test_groups_of_fewer_than_five_get_a_warning(rng):
    samples, _, _ = population(rng)
    space = TraitSpace.fit(
        samples,
        {"rare": np.arange(40) < 4, "common": np.arange(40) >= 4, "fine": np.arange(40) < 5},
    )
    assert "only 4 faces with it" in space.trait("rare").warning
    assert "only 4 faces without it" in space.trait("common").warning
    assert "only" not in space.trait("fine").warning


def test_two_faces_make_trait_of_unknown_error(rng):
    space = TraitSpace.fit(rng.random((2, 300)), {"old": [True, False]})
    found = space.trait("old")
    assert found.confidence.p_value == 1.0
    assert found.confidence.expected_cosine == 0.0
    assert "error is unknown" in found.warning
    assert len(space.basis) == 1


def test_single_face_with_trait_borrows_deviation_of_others(rng):
    samples, _, _ = population(rng)
    found = TraitSpace.fit(samples, {"mole": np.arange(40) == 3}).trait("mole")
    spread = samples[np.arange(40) != 3].std(axis=0, ddof=1)
    np.testing.assert_allclose(found.stderr, spread * np.sqrt(1 + 1 / 39), rtol=1e-10)


@pytest.mark.parametrize("asked", [0, 6, 100])
def test_components_exceeding_sample_rank_are_refused(rng, asked):
    samples, label, _ = population(rng, people=6, with_trait=3)
    with pytest.raises(TraitError, match=r"components .*: got"):
        TraitSpace.fit(samples, {"tan": label}, components=asked)


def test_doubled_samples_and_constant_columns_add_no_component(rng):
    samples, label, _ = population(rng, people=8, with_trait=3, length=500)
    samples[:, 100:] = 7.0
    twice = np.vstack([samples, samples])
    space = TraitSpace.fit(twice, {"tan": np.tile(label, 2)}, components=7)
    np.testing.assert_allclose(
        space.trait("tan").vector,
        samples[label].mean(axis=0) - samples[~label].mean(axis=0),
        atol=1e-10,
    )
    with pytest.raises(TraitError, match=r"components \(the 16 samples differ in 7\): got"):
        TraitSpace.fit(twice, {"tan": np.tile(label, 2)}, components=8)


@pytest.mark.parametrize("value", [0.0, 0.1, 1e9])
def test_samples_that_are_all_the_same_are_refused(value):
    with pytest.raises(TraitError, match="all 3 are the same"):
        TraitSpace.fit(np.full((3, 50), value), {"tan": [True, False, False]})


@pytest.mark.parametrize("scale", [1e-12, 1e12])
def test_vectors_scale_with_the_samples(rng, scale):
    samples, label, _ = population(rng)
    one = TraitSpace.fit(samples, {"tan": label}).trait("tan")
    other = TraitSpace.fit(samples * scale, {"tan": label}).trait("tan")
    np.testing.assert_allclose(other.vector, one.vector * scale, rtol=1e-9, atol=1e-9 * scale)
    assert other.confidence.expected_cosine == pytest.approx(one.confidence.expected_cosine)


def test_components_of_long_samples_match_plain_svd(rng):
    samples, label, _ = population(rng, people=12, length=3000, with_trait=5)
    space = TraitSpace.fit(samples, {"tan": label}, components=4)
    off = samples - samples.mean(axis=0)
    _, _, vt = np.linalg.svd(off, full_matrices=False)
    signs = np.sign(np.sum(space.basis * vt[:4], axis=1))
    np.testing.assert_allclose(space.basis, vt[:4] * signs[:, None], atol=1e-10)
    np.testing.assert_allclose(space.coordinates(samples), off @ space.basis.T, atol=1e-10)


def test_a_basis_is_orthonormal_under_the_metric(rng):
    g = products(rng)
    space = TraitSpace.fit(rng.random((30, 12)), {"tan": np.arange(30) < 9}, metric=g, components=5)
    np.testing.assert_allclose(space.basis @ g @ space.basis.T, np.eye(5), atol=1e-8)


def test_few_components_are_chosen_where_sufficient_for_trait(rng):
    ways = np.linalg.qr(rng.normal(size=(400, 3)))[0].T
    label = np.arange(60) < 25
    shares = rng.normal(size=(60, 3)) * [8.0, 6.0, 5.0] + 8.0 * label[:, None]
    samples = shares @ ways + 2.0 * rng.normal(size=(60, 400))
    space = TraitSpace.fit(samples, {"tan": label})
    assert len(space.basis) <= 6
    whole = TraitSpace.fit(samples, {"tan": label}, components=59)
    truth = np.full(3, 8.0) @ ways
    assert space.cosine("tan", truth) > whole.cosine("tan", truth) + 0.05


def test_the_expected_cosine_is_the_cosine_on_average(rng):
    told, got = [], []
    for _ in range(40):
        samples, label, trait = population(rng, noise=1.5)
        space = TraitSpace.fit(samples, {"tan": label}, components=39)
        told.append(space.trait("tan").confidence.expected_cosine)
        got.append(space.cosine("tan", trait))
    gap = np.array(told) - got
    assert np.mean(got) < 0.97
    assert abs(gap.mean()) < 3 * gap.std() / np.sqrt(40) + 0.01


@pytest.mark.long
def test_shuffled_labels_give_p_values_that_are_even(rng):
    samples, _, _ = population(rng, people=24, shift=0.0)
    ps = []
    for _ in range(120):
        label = rng.permutation(np.arange(24) < 9)
        ps.append(TraitSpace.fit(samples, {"none": label}).trait("none").confidence.p_value)
    # Kolmogorov-Smirnov at 1 in 1000 false alarms: 1.95 / sqrt(120)
    ranks = np.sort(ps)
    assert np.abs(ranks - (np.arange(120) + 0.5) / 120).max() < 1.95 / np.sqrt(120)
    samples, label, _ = population(rng, people=24, with_trait=9)
    assert TraitSpace.fit(samples, {"tan": label}).trait("tan").confidence.p_value == 0.001


def test_non_negative_nearest_mixtures_are_those_of_scipy(rng):
    a = rng.random((20, 9)) + 0.2
    a[:, 3] = a[:, 2] + 1e-3 * a[:, 3]
    wanted = rng.normal(size=(50, 9))
    found = nonnegative_kernels.nearest_mixtures(a.T @ a, wanted)
    misfit = np.linalg.norm((found - wanted) @ a.T, axis=1)
    least = [nnls(a, a @ t)[1] for t in wanted]
    np.testing.assert_allclose(misfit, least, rtol=1e-6)
    assert found.min() >= 0.0


def test_unfinished_active_sets_are_counted(monkeypatch, caplog):
    nonnegative_kernels.nearest_mixtures(np.eye(2), [[1.0, -1.0]])
    assert caplog.records == []
    monkeypatch.setattr(nonnegative_kernels, "_solve_rows", lambda gram, rows: 1)
    nonnegative_kernels.nearest_mixtures(np.eye(2), [[1.0, -1.0], [-1.0, 1.0]])
    assert ["1 of 2 reached" in r.getMessage() for r in caplog.records] == [True]


def test_nonnegative_mixtures_are_their_own_nearest(rng):
    wanted = rng.random((5, 6))
    np.testing.assert_array_equal(
        nonnegative_kernels.nearest_mixtures(np.ones((6, 6)), wanted), wanted
    )


def test_histogram_projection_is_nearest_histogram(rng):
    given = rng.normal(size=7)
    found = HistogramSet(7).project(given)
    near = np.linalg.norm(found - given)
    others = rng.dirichlet(np.ones(7), 2000)
    steps = found + 0.05 * (others - found)
    assert near <= np.linalg.norm(steps - given, axis=1).min()
    assert near <= np.linalg.norm(others - given, axis=1).min()
    np.testing.assert_allclose(HistogramSet(7).project(found), found, atol=1e-15)


def test_samples_outside_their_set_are_refused(rng):
    samples, label = histograms(rng)
    space = TraitSpace.fit(samples, {"tan": label})
    with pytest.raises(TraitError, match="not in the feasible set"):
        space.edit(samples[0] * 1.01, {"tan": 0.5})
    bad = np.vstack([samples[:-1], samples[-1:] * 1.01])
    with pytest.raises(TraitError, match="1 of 30 are not in the set"):
        TraitSpace.fit(bad, {"tan": label}, feasible=HistogramSet())


def test_smallest_set_containing_samples_is_found(rng):
    assert feasible_sets.smallest_feasible_set(histograms(rng)[0]) == HistogramSet(256)
    assert feasible_sets.smallest_feasible_set(rng.random((3, 256))) == NonNegativeSet()
    assert feasible_sets.smallest_feasible_set(rng.normal(size=(3, 256))) == UnconstrainedSet()


def test_nmf_coordinates_are_nonnegative_vectors_within_basis(rng):
    basis = rng.random((3, 12))
    label = np.arange(20) < 8
    shares = rng.random((20, 3)) + label[:, None] * [0.0, 1.0, 0.5]
    samples = shares @ basis
    space = TraitSpace.fit(samples, {"oil": label}, space="nmf", basis=basis, metric=products(rng))
    np.testing.assert_allclose(space.coordinates(samples), shares, atol=1e-6)
    found = space.trait("oil")
    expected = shares[label].mean(axis=0) - shares[~label].mean(axis=0)
    np.testing.assert_allclose(found.coordinates, expected, atol=1e-6)
    np.testing.assert_allclose(found.vector, expected @ basis, atol=1e-6)
    assert space.lost < 1e-6


def test_missing_basis_error_names_its_source(rng):
    with pytest.raises(TraitError, match=r"brdf_basis\.reduce"):
        TraitSpace.fit(rng.random((4, 5)), {"oil": [1, 0, 0, 1]}, space="nmf")


def test_unknown_trait_error_lists_available_traits(rng):
    samples, label, _ = population(rng)
    space = TraitSpace.fit(samples, {"tan": label})
    with pytest.raises(TraitError, match="got 'lotion', expected one of tan"):
        space.edit(samples[0], {"lotion": 1.0})


def test_batch_edit_equals_individual_edits(rng):
    samples, label = histograms(rng)
    space = TraitSpace.fit(samples, {"tan": label})
    many = space.edit(samples.reshape(5, 6, -1), {"tan": 2.0})
    one = np.array([space.edit(s, {"tan": 2.0}) for s in samples])
    np.testing.assert_allclose(many.reshape(30, -1), one, atol=1e-15)


def test_cosine_uses_the_given_metric(rng):
    g = np.array([[1.0, 1.0], [1.0, 1.0]])
    assert cosine([1.0, 0.0], [0.0, 1.0]) == 0.0
    assert cosine([1.0, 0.0], [0.0, 1.0], g) == pytest.approx(1.0)
    assert cosine([1.0, 0.0], [0.0, 0.0]) == 0.0


def test_opposite_trait_removes_trait(rng):
    samples, label, _ = population(rng)
    both = TraitSpace.fit(samples, {"female": label, "male": ~label})
    made = both.trait("female").opposite("male")
    direct = both.trait("male")
    np.testing.assert_allclose(made.vector, direct.vector, atol=1e-12)
    np.testing.assert_allclose(made.stderr, direct.stderr, rtol=1e-12)
    assert (made.members, made.others, made.name) == (direct.members, direct.others, "male")
    aged = TraitSpace.fit(samples, {}, continuous={"age": rng.random(40)}).trait("age")
    with pytest.raises(TraitError, match="no opposite"):
        aged.opposite("young")


def test_components_remain_where_trait_is_below_population_variation(rng):
    samples, label, trait = population(rng, people=60, with_trait=30, shift=0.3)
    space = TraitSpace.fit(samples, {"tan": label})
    assert len(space.basis) == 59
    few = TraitSpace.fit(samples, {"tan": label}, components=5)
    assert space.cosine("tan", trait) > few.cosine("tan", trait)


def test_regression_noise_excludes_effects_of_other_traits(rng):
    samples, tan, _ = population(rng, people=60, with_trait=30, shift=0.4)
    strong = rng.permutation(np.arange(60) < 20)
    samples = samples + 15.0 * strong[:, None] * rng.normal(size=samples.shape[1])
    labels = {"tan": tan, "strong": strong}
    means = TraitSpace.fit(samples, labels).trait("tan").confidence
    beside = TraitSpace.fit(samples, labels, contrast="regression").trait("tan").confidence
    assert beside.p_value == 0.001
    assert means.p_value > 0.01
