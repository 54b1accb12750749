import numpy as np
import pytest
from scipy import stats

from model.translucency_population import (
    CHANNEL_CORRELATION,
    SiteMeasurement,
    TranslucencyPopulation,
    TranslucencyPopulationError,
    summarize,
    table,
    weyrich_2005,
)

SIDAK_5_SIGMA = 5.5
"""Of 36 normal deviates one lies beyond with a chance below 2e-6."""


@pytest.mark.parametrize("reading", ["deviation", "variance"])
def test_moments_of_the_lognormal_are_those_printed_exactly(reading):
    population = weyrich_2005(reading=reading)
    s = population.log_deviation
    mean = stats.lognorm.mean(s, scale=np.exp(population.log_mean))
    deviation = stats.lognorm.std(s, scale=np.exp(population.log_mean))
    np.testing.assert_allclose(mean, population.mean_per_mm, rtol=1e-12)
    np.testing.assert_allclose(deviation, population.deviation_per_mm, rtol=1e-12)


def test_printed_column_is_read_as_deviations_or_variances():
    read, literal = weyrich_2005(), weyrich_2005(reading="variance")
    np.testing.assert_allclose(literal.deviation_per_mm**2, read.deviation_per_mm, rtol=1e-15)
    assert read.deviation_per_mm[0, 0] == 0.1727
    assert read.mean_per_mm[2, 2] == 1.9159
    with pytest.raises(TranslucencyPopulationError, match="reading"):
        weyrich_2005(reading="sd")


def test_extremes_of_figure_17_contradict_the_printed_variances():
    # Popoviciu: no distribution between a and b has a variance above (b - a)^2 / 4
    red = (0.9171 - 0.3558) ** 2 / 4
    assert round(red, 4) == 0.0788
    literal = weyrich_2005(reading="variance").deviation_per_mm[:, 0] ** 2
    assert (literal > red).tolist() == [True, False, True]
    assert (weyrich_2005().deviation_per_mm[:, 0] ** 2 < red).all()
    green = (1.5682 - 0.7932) ** 2 / 4
    assert (weyrich_2005(reading="variance").deviation_per_mm[:, 1] ** 2 > green).all()


def test_faces_span_figure_17_only_if_column_deviations(rng):
    faces = {
        reading: weyrich_2005(reading=reading).sample(87 * 400, rng=rng).mean(axis=1)
        for reading in ("deviation", "variance")
    }
    least = {k: np.median(v.reshape(400, 87, 3).min(axis=1), axis=0) for k, v in faces.items()}
    most = {k: np.median(v.reshape(400, 87, 3).max(axis=1), axis=0) for k, v in faces.items()}
    for channel, (low, high) in enumerate(((0.3558, 0.9171), (0.7932, 1.5682))):
        assert least["deviation"][channel] == pytest.approx(low, rel=0.15)
        assert most["deviation"][channel] == pytest.approx(high, rel=0.15)
        assert least["variance"][channel] < 0.65 * low
        assert most["variance"][channel] > 1.35 * high
        # of 34,800 faces, how many lie within: to the power of 87, a chance that all do
        inside = {
            k: ((v[:, channel] > low) & (v[:, channel] < high)).mean() for k, v in faces.items()
        }
        assert inside["deviation"] ** 87 > 1e-3
        assert inside["variance"] ** 87 < 1e-11


def test_sampled_population_has_table_moments(rng):
    population = weyrich_2005()
    people = population.sample(40_000, rng=rng)
    found = table(people)
    off = (found.mean_per_mm - population.mean_per_mm) / found.mean_stderr_per_mm
    off_deviation = found.deviation_per_mm - population.deviation_per_mm
    off_deviation /= found.deviation_stderr_per_mm
    assert (people > 0).all()
    assert np.abs(off).max() < SIDAK_5_SIGMA
    assert np.abs(off_deviation).max() < SIDAK_5_SIGMA
    # the same errors reject the literal reading
    literal = weyrich_2005(reading="variance")
    off_literal = found.deviation_per_mm - literal.deviation_per_mm
    assert (np.abs(off_literal / found.deviation_stderr_per_mm) > SIDAK_5_SIGMA).all()


def test_sampled_population_logarithms_are_normal_and_correlated(rng):
    n = 40_000
    population = weyrich_2005()
    logs = np.log(population.sample(n, rng=rng)).reshape(n, -1)
    skew = stats.skew(logs) / np.sqrt(6 / n)
    assert np.abs(skew).max() < SIDAK_5_SIGMA
    between = np.full((3, 3), population.site_correlation)
    np.fill_diagonal(between, 1.0)
    expected = np.kron(between, CHANNEL_CORRELATION)
    upper = np.triu_indices(9, 1)
    fisher = np.arctanh(np.corrcoef(logs.T)[upper]) - np.arctanh(expected[upper])
    assert np.abs(fisher * np.sqrt(n - 3)).max() < SIDAK_5_SIGMA


def test_table_standard_errors_match_repeated_populations(rng):
    population = weyrich_2005(reading="variance")  # skewed: a normal formula would be wrong
    people = population.sample(500 * 400, rng=rng).reshape(400, 500, 3, 3)
    tables = [table(sample) for sample in people]
    means = np.array([t.mean_per_mm for t in tables])
    deviations = np.array([t.deviation_per_mm for t in tables])
    claimed_mean = np.mean([t.mean_stderr_per_mm for t in tables], axis=0)
    claimed = np.sqrt(np.mean([t.deviation_stderr_per_mm**2 for t in tables], axis=0))
    # 400 repeats: a standard deviation is known to 3.5 %, of a skewed one to perhaps 10
    np.testing.assert_allclose(claimed_mean / means.std(axis=0), 1.0, atol=0.15)
    np.testing.assert_allclose(claimed / deviations.std(axis=0), 1.0, atol=0.35)
    normal = deviations.mean(axis=0) / np.sqrt(2 * 500)
    assert (normal / deviations.std(axis=0) < 0.75)[0, 0]


def test_measurement_noise_is_separated_from_population_differences(rng):
    population = weyrich_2005()
    people = population.sample(5_000, rng=rng)
    noise = 0.05
    measured = people + noise * rng.standard_normal(people.shape)
    found = table(measured, stderr_per_mm=np.full(people.shape, noise))
    kept = table(people)
    assert (found.deviation_per_mm > found.deviation_without_noise_per_mm).all()
    off = found.deviation_without_noise_per_mm - kept.deviation_per_mm
    # error of the corrected deviation: that of the variance, over twice the deviation
    limit = (
        SIDAK_5_SIGMA
        * found.deviation_per_mm
        * found.deviation_stderr_per_mm
        / kept.deviation_per_mm
    )
    assert (np.abs(off) < limit).all()


def test_rows_have_the_papers_layout():
    rows = table(np.broadcast_to(weyrich_2005().mean_per_mm, (2, 3, 3))).rows()
    assert [channel for channel, _ in rows] == ["red", "green", "blue"]
    assert rows[1][1] == ((0.9751, 0.0), (0.9831, 0.0), (1.2488, 0.0))


def test_person_counts_once_for_any_number_of_repeats():
    made = [
        SiteMeasurement("a", "cheek", (0.5, 1.0, 1.5), (0.01, 0.01, 0.01)),
        *[SiteMeasurement("b", "cheek", (0.7, 1.2, 1.7), (0.01, 0.01, 0.01))] * 3,
        SiteMeasurement("b", "chin", (0.6, 9.0, 1.9), (0.01, 0.01, 0.01), (True, False, True)),
    ]
    found = summarize(made)
    assert found.sites == ("cheek", "neck")
    np.testing.assert_allclose(found.mean_per_mm[0], [0.6, 1.1, 1.6])
    assert found.count.tolist() == [[2, 2, 2], [1, 0, 1]]
    assert found.mean_per_mm[1].tolist() == [0.6, 0.0, 1.9]
    assert "-" in found.text().splitlines()[3]


def test_repeats_are_averaged_by_their_errors():
    made = [
        SiteMeasurement("a", "cheek", (0.5,), (0.1,)),
        SiteMeasurement("a", "cheek", (0.8,), (0.2,)),
        SiteMeasurement("a", "cheek", (np.nan,), (np.nan,)),
    ]
    found = summarize(made, channels=("red",))
    np.testing.assert_allclose(found.mean_per_mm, [[0.56]])
    np.testing.assert_allclose(found.noise_per_mm, [[0.1 * 0.8**0.5]])


def test_measurements_that_make_no_table_are_refused():
    one = SiteMeasurement("a", "cheek", (0.5,), (0.1,))
    with pytest.raises(TranslucencyPopulationError, match="got none"):
        summarize([])
    with pytest.raises(TranslucencyPopulationError, match="got none at neck"):
        summarize([one], sites=("neck",), channels=("red",))
    with pytest.raises(TranslucencyPopulationError, match="channels"):
        summarize([one])
    with pytest.raises(TranslucencyPopulationError, match="stderr_per_mm"):
        summarize([SiteMeasurement("a", "cheek", (0.5,), (0.0,))], channels=("red",))
    with pytest.raises(TranslucencyPopulationError, match="expected 2"):
        SiteMeasurement("a", "cheek", (0.5, 0.6), (0.1,))
    with pytest.raises(TranslucencyPopulationError, match="sigma_tr_per_mm, counted: got"):
        table(np.full((2, 3, 3), -1.0))
    with pytest.raises(TranslucencyPopulationError, match="shape"):
        table(np.ones((2, 3)))


def test_impossible_moments_and_correlations_are_refused():
    ones = np.ones((1, 2))
    with pytest.raises(TranslucencyPopulationError, match="mean_per_mm: got 0"):
        TranslucencyPopulation(0 * ones, ones, ("a",), ("x", "y"))
    with pytest.raises(TranslucencyPopulationError, match="shape"):
        TranslucencyPopulation(ones, ones)
    with pytest.raises(TranslucencyPopulationError, match="eigenvalues"):
        TranslucencyPopulation(
            ones, ones, ("a",), ("x", "y"), channel_correlation=((1.0, 1.5), (1.5, 1.0))
        )
    with pytest.raises(TranslucencyPopulationError, match="site_correlation"):
        TranslucencyPopulation(
            ones, ones, ("a",), ("x", "y"), 1.0, channel_correlation=((1.0, 0.5), (0.5, 1.0))
        )
    with pytest.raises(TranslucencyPopulationError, match="n:"):
        weyrich_2005().sample(0, rng=np.random.default_rng(0))
