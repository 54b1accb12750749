import numpy as np
import pytest

from model.texture_statistics import histogram_kernels
from model.texture_statistics.histograms import (
    HISTOGRAM_BINS,
    Bins,
    TextureHistogramError,
    cumulate_fractions,
    histogram_distance,
    project_to_histograms,
    rgb_histograms,
)


def uneven(rng, low=-3.0, high=5.0):
    return np.sort(np.concatenate([[low, high], rng.uniform(low, high, HISTOGRAM_BINS - 1)]))


def test_counts_are_those_of_a_plain_histogram(rng):
    edges = uneven(rng)
    values = np.concatenate([rng.standard_normal(3000), edges[5:9], edges[[0, -1]]])
    found = Bins.from_edges(edges).count(values)
    place = np.clip(np.searchsorted(edges, values, "right") - 1, 0, HISTOGRAM_BINS - 1)
    np.testing.assert_array_equal(
        found.fractions, np.bincount(place, minlength=HISTOGRAM_BINS) / values.size
    )
    assert (found.min_value, found.max_value) == (values.min(), values.max())
    assert found.n_effective == pytest.approx(values.size)


def test_weights_count_like_repeats(rng):
    bins = Bins.from_edges(uneven(rng))
    values, weights = rng.standard_normal(500), rng.integers(0, 4, 500)
    found, repeated = bins.count(values, weights), bins.count(np.repeat(values, weights))
    np.testing.assert_allclose(found.fractions, repeated.fractions, atol=1e-15)
    assert (found.min_value, found.max_value) == (repeated.min_value, repeated.max_value)
    assert found.n_effective == pytest.approx(weights.sum() ** 2 / (weights**2).sum())


@pytest.mark.parametrize("gap", [1e-12, 1e-3, 1.0])
def test_arbitrarily_narrow_bins_are_distinguished(gap, rng):
    """Half of the edges within a gap far narrower than a cell of the table."""
    edges = np.concatenate([np.linspace(-1.0, 0.0, 128), gap * np.linspace(1.0, 2.0, 128), [9.0]])
    values = np.concatenate([rng.uniform(-1, 9, 2000), gap * rng.uniform(1.0, 2.0, 2000)])
    place = np.searchsorted(edges, values, "right") - 1
    np.testing.assert_allclose(
        Bins.from_edges(edges).count(values).fractions,
        np.bincount(place, minlength=HISTOGRAM_BINS) / 4000,
    )


def test_values_beyond_edges_count_in_end_bins_reported(rng):
    values = np.array([-9.0, -8.0, 0.3, 7.0])
    found = Bins.from_edges(np.linspace(0.0, 1.0, 257)).count(values)
    assert (found.below, found.above) == (0.5, 0.25)
    assert (found.fractions[0], found.fractions[-1], found.fractions.sum()) == (0.5, 0.25, 1.0)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_rank_map_is_target_quantile_of_source_rank(dtype, rng):
    """Twin: two interpolations of the cumulated shares."""
    edges = np.linspace(-6.0, 6.0, 257)
    bins = Bins.from_edges(edges)
    values = rng.standard_normal((40, 50)).astype(dtype)
    source = bins.count(values)
    wanted = bins.count(rng.laplace(1.0, 0.5, 100_000)).fractions
    wanted = 0.999 * wanted + 0.001 / HISTOGRAM_BINS  # no empty bin: the inverse is a function
    got = bins.match(values, source, wanted)
    expected = np.interp(
        np.interp(values, edges, cumulate_fractions(source.fractions)),
        cumulate_fractions(wanted),
        edges,
    )
    assert got.dtype == dtype
    np.testing.assert_allclose(got, expected, atol=1e-9 if dtype == np.float64 else 1e-5)


def test_matched_values_have_target_histogram_within_bin_fraction(rng):
    bins = Bins.from_edges(np.linspace(-6.0, 8.0, 257))
    values = rng.standard_normal(200_000)
    wanted = bins.count(rng.gamma(2.0, 1.0, 200_000)).fractions
    got = bins.match(values, bins.count(values), wanted)
    again = bins.count(got)
    assert np.abs(cumulate_fractions(again.fractions) - cumulate_fractions(wanted)).max() < 1e-3
    assert (
        np.abs(cumulate_fractions(bins.count(values).fractions) - cumulate_fractions(wanted)).max()
        > 0.5
    )


def test_a_match_has_no_steps():
    """Sub-bin interpolation: a ramp stays a ramp of as many distinct values."""
    bins = Bins.from_edges(np.linspace(0.0, 1.0, 257))
    ramp = np.linspace(0.001, 0.999, 5000)
    wanted = bins.count(np.linspace(0.2, 0.6, 90_000)).fractions
    got = bins.match(ramp, bins.count(ramp), wanted)
    assert np.unique(got).size == 5000
    assert np.diff(got).max() < 3.0 * 0.4 / 5000


@pytest.mark.parametrize("noise", [0.0, 1e-16])
def test_values_with_target_histogram_are_unchanged(noise, rng):
    """Also with bins that both leave empty, and shares that differ by rounding."""
    bins = Bins.from_edges(uneven(rng))
    values = np.concatenate([rng.normal(-2, 0.1, 300), rng.normal(3, 0.2, 300), bins.edges[40:50]])
    source = bins.count(values)
    wanted = np.maximum(source.fractions + noise * rng.standard_normal(HISTOGRAM_BINS), 0.0)
    np.testing.assert_allclose(bins.match(values, source, wanted), values, atol=1e-12)


def test_values_beyond_edges_stay_when_change_is_null():
    bins = Bins.from_edges(np.linspace(0.0, 1.0, 257))
    values = np.array([-4.0, -1.0, 0.2, 0.5, 3.0])
    source = bins.count(values)
    np.testing.assert_allclose(bins.match(values, source, source.fractions), values, atol=1e-12)


def test_values_all_beyond_edges_move_to_target(rng):
    bins = Bins.from_edges(np.linspace(0.0, 1.0, 257))
    values = rng.uniform(50.0, 60.0, 4000)
    wanted = bins.count(rng.uniform(0.25, 0.5, 4000)).fractions
    got = bins.match(values, bins.count(values), wanted)
    assert got.min() > 0.24
    assert got.max() < 0.51


def test_empty_target_bins_receive_no_values(rng):
    bins = Bins.from_edges(np.linspace(0.0, 1.0, 257))
    values = rng.uniform(0.0, 1.0, 20_000)
    wanted = np.zeros(HISTOGRAM_BINS)
    wanted[[3, 100, 250]] = 0.2, 0.5, 0.3
    again = bins.count(bins.match(values, bins.count(values), wanted)).fractions
    np.testing.assert_allclose(again, wanted, atol=1e-3)
    assert again[wanted == 0.0].sum() < 1e-3


def test_single_value_enters_target_and_stays_single():
    bins = Bins.from_edges(np.linspace(0.0, 1.0, 257))
    values = np.full(9, 0.7)
    wanted = np.zeros(HISTOGRAM_BINS)
    wanted[10] = 1.0
    got = bins.match(values, bins.count(values), wanted)
    assert np.unique(got).size == 1
    assert bins.edges[10] <= got[0] <= bins.edges[11]


def test_a_table_of_cells_never_excludes_a_bin(rng):
    edges = uneven(rng)
    scale = histogram_kernels.TABLE_CELLS / (edges[-1] - edges[0])
    least = np.empty(histogram_kernels.TABLE_CELLS, np.int16)
    most = np.empty_like(least)
    histogram_kernels.bound_bins(edges, HISTOGRAM_BINS, scale, least, most)
    for x in (*edges[:-1], *np.nextafter(edges[1:], -9.0), *rng.uniform(-3, 5, 300)):
        expected = np.searchsorted(edges, x, "right") - 1
        assert histogram_kernels.find_edge(x, edges, scale, least, most) == expected


def test_histogram_moved_half_the_bins_has_unit_distance():
    edges = np.linspace(0.0, 1.0, 257)
    a = np.eye(HISTOGRAM_BINS)[10]
    b = np.eye(HISTOGRAM_BINS)[10 + 128]
    assert histogram_distance(a, b, edges) == pytest.approx(1.0)
    assert histogram_distance(a, a, edges) == 0.0
    assert histogram_distance(np.stack([a, b]), b, edges).shape == (2,)


def test_the_nearest_histogram_is_nearer_than_any_other(rng):
    edited = rng.normal(1 / HISTOGRAM_BINS, 0.02, (3, 2 * HISTOGRAM_BINS))
    found = project_to_histograms(edited)
    assert found.min() >= 0.0
    np.testing.assert_allclose(found.reshape(-1, HISTOGRAM_BINS).sum(axis=1), 1.0, atol=1e-12)
    own = np.linalg.norm((found - edited).reshape(-1, HISTOGRAM_BINS), axis=1)
    # optimality: no direction towards another valid histogram comes nearer
    for _ in range(50):
        other = rng.dirichlet(np.full(HISTOGRAM_BINS, 0.1), 6)
        step = found.reshape(-1, HISTOGRAM_BINS) + 1e-3 * (
            other - found.reshape(-1, HISTOGRAM_BINS)
        )
        assert (np.linalg.norm(step - edited.reshape(-1, HISTOGRAM_BINS), axis=1) >= own).all()


def test_a_valid_vector_is_its_own_nearest(rng):
    valid = rng.dirichlet(np.full(HISTOGRAM_BINS, 0.05), 4).reshape(-1)
    np.testing.assert_allclose(project_to_histograms(valid), valid, atol=1e-15)


@pytest.mark.parametrize("wrong", [np.zeros(255), np.zeros(0), np.full(256, np.nan), 1.0])
def test_invalid_histogram_vector_is_refused(wrong):
    with pytest.raises(TextureHistogramError, match="vectors"):
        project_to_histograms(wrong)


def test_group_histograms_average_images_not_texels(rng):
    small, large = np.full((2, 2, 3), 0.1), np.full((50, 50, 3), 0.9)
    mask = np.zeros((50, 50), bool)
    mask[0, 0] = True
    large[~mask] = np.nan
    found = rgb_histograms(
        [small, large, large],
        {"both": np.array([True, True, False]), "one": [False, True, False]},
        [None, mask, mask],
    )
    assert found.names == ("both", "one")
    assert found.mean.shape == (2, 3, 256)
    np.testing.assert_allclose(found.mean[0, :, [25, 230]], 0.5)
    np.testing.assert_allclose(found.stderr[0, :, 25], 0.5)
    assert np.isnan(found.stderr[1]).all()
    assert found.members.tolist() == [2, 1]


def test_colors_beyond_the_reach_are_counted_and_reported():
    found = rgb_histograms([np.full((2, 2, 3), 1.5)], {"all": [True]})
    assert found.mean[0, 0, -1] == 1.0
    np.testing.assert_array_equal(found.clipped, 1.0)


def test_an_empty_group_is_named():
    with pytest.raises(TextureHistogramError, match="beard"):
        rgb_histograms([np.zeros((2, 2, 3))], {"beard": [False]})


def test_edges_that_do_not_rise_are_refused():
    with pytest.raises(TextureHistogramError, match="steps of edges: got"):
        Bins.from_edges(np.zeros(257))
    with pytest.raises(TextureHistogramError, match="none above 0"):
        Bins.from_edges(np.arange(257.0)).count(np.zeros(3), np.zeros(3))
