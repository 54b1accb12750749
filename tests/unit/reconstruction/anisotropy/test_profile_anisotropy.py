import numpy as np
import pytest
from scipy import stats

from model import photon_table
from reconstruction.anisotropy import profile_anisotropy
from reconstruction.anisotropy.estimation import AnisotropyError
from reconstruction.anisotropy.profile_anisotropy import estimate_from_profiles

SIXTEEN = np.deg2rad(np.arange(16) * 22.5)
FALSE_ALARM_OF_A_TEST = 1e-6
RADIUS_MM = 0.3 + 0.25 * np.arange(28)
SIGMA_A, SIGMA_S_PRIME = 0.06, 1.5
MEDIUM = {"sigma_a_per_mm": SIGMA_A, "sigma_s_prime_per_mm": SIGMA_S_PRIME}


def most_of(cases, rate):
    """The count that so many trials of this rate exceed once in a million."""
    return stats.binom.isf(FALSE_ALARM_OF_A_TEST, cases, rate)


def ellipse(angle, ratio, axis_rad, mean=0.6):
    """sigma_tr of a medium that diffuses `ratio` squared times as much along the axis."""
    along, across = np.cos(angle - axis_rad), np.sin(angle - axis_rad)
    value = np.sqrt((along / ratio) ** 2 + across**2)
    turn = np.linspace(0, np.pi, 3601)[:-1]
    return mean * value / np.hypot(np.cos(turn) / ratio, np.sin(turn)).mean()


def turned_profiles(ratio, axis_rad, angle=SIXTEEN):
    """Profiles of tissue whose scattering by direction makes sigma_tr an ellipse, and sigma_tr."""
    mean = np.sqrt(3 * SIGMA_A * (SIGMA_A + SIGMA_S_PRIME))
    sigma_tr = ellipse(angle, ratio, axis_rad, mean)
    scattering = sigma_tr**2 / (3 * SIGMA_A) - SIGMA_A
    return photon_table.reflectance(RADIUS_MM, SIGMA_A, scattering[:, None]), sigma_tr


def read(rng, truth, cases, *, coupling=0.03, fiber=0.01, gain=0.0):
    """Readings (N, cases, F) of a head set down anew for each turn, and their variances."""
    shape = (len(truth), cases, truth.shape[-1])
    variance = np.broadcast_to(truth[:, None] ** 2 * 0.004**2 + (2e-6) ** 2, shape)
    seen = truth[:, None] * np.exp(coupling * rng.standard_normal((*shape[:2], 1)))
    seen = seen * np.exp(gain * rng.standard_normal((1, cases, shape[2])))
    seen = seen * (1 + fiber * rng.standard_normal(shape))
    return seen + np.sqrt(variance) * rng.standard_normal(shape), variance


@pytest.mark.parametrize("ratio", [1.05, 1.3, 1.8])
def test_directed_scattering_ratio_survives_coupling_and_lost_fibers(ratio):
    truth, _ = turned_profiles(ratio, 0.7)
    found = estimate_from_profiles(SIXTEEN, RADIUS_MM, truth, **MEDIUM)
    assert np.log(found.ratio) == pytest.approx(np.log(ratio), rel=0.02)
    assert found.axis_rad == pytest.approx(0.7, abs=0.01)
    # scattering is given as a mean over logarithms, which is not that of an ellipse
    assert found.mean_per_mm == pytest.approx(0.53, rel=0.03)
    coupled = truth * np.exp(0.4 * np.cos(SIXTEEN - 2.0))[:, None]
    off = estimate_from_profiles(SIXTEEN, RADIUS_MM, coupled, **MEDIUM)
    assert off.ratio == pytest.approx(found.ratio, rel=1e-6)
    uneven = truth * np.exp(0.3 * np.cos(np.arange(28)))
    off = estimate_from_profiles(SIXTEEN, RADIUS_MM, uneven, **MEDIUM)
    assert off.ratio == pytest.approx(found.ratio, rel=1e-6)


def test_ten_percent_coefficient_errors_barely_change_ratio():
    truth, _ = turned_profiles(1.3, 0.7)
    for factor_a, factor_s in ((1.1, 1.0), (0.9, 1.0), (1.0, 1.1), (1.0, 0.9)):
        found = estimate_from_profiles(
            SIXTEEN,
            RADIUS_MM,
            truth,
            sigma_a_per_mm=factor_a * SIGMA_A,
            sigma_s_prime_per_mm=factor_s * SIGMA_S_PRIME,
        )
        assert np.log(found.ratio) == pytest.approx(
            np.log(1.3), rel=profile_anisotropy.LOG_RATIO_MODEL_ERROR
        )


def test_isotropic_tissue_profiles_are_flagged_at_stated_rate(rng):
    truth, _ = turned_profiles(1.0, 0.0)
    seen, variance = read(rng, truth, 800, coupling=0.1, fiber=0.03)
    found = estimate_from_profiles(SIXTEEN, RADIUS_MM, seen, variance, **MEDIUM)
    assert found.valid.all()
    for rate in (0.05, 0.01):
        assert (found.p_value < rate).sum() <= most_of(800, rate + 1e-3)
        assert (found.tilt_p_value < rate).sum() <= most_of(800, rate + 1e-3)
    assert (found.p_value < 0.05).sum() >= stats.binom.ppf(1e-6, 800, 0.05)


def test_profiles_give_ratio_within_its_standard_error(rng):
    truth, _ = turned_profiles(1.15, 2.5)
    seen, variance = read(rng, truth, 500)
    found = estimate_from_profiles(SIXTEEN, RADIUS_MM, seen, variance, **MEDIUM)
    # the truth is the table's own, so that the model's error has no part in it
    of_model = profile_anisotropy.LOG_RATIO_MODEL_ERROR * found.ratio * np.log(found.ratio)
    stderr = np.sqrt(found.ratio_stderr**2 - of_model**2)
    off = np.abs(np.angle(np.exp(2j * (found.axis_rad - 2.5)))) / 2
    # 68 % of 500, but for a chance of 1e-6
    low, high = stats.binom.ppf([5e-7, 1 - 5e-7], 500, 2 * stats.norm.cdf(1) - 1)
    assert low <= (np.abs(found.ratio - 1.15) < stderr).sum() <= high
    assert low <= (off < found.axis_stderr_rad).sum() <= high
    assert (np.abs(found.ratio - 1.15) < stderr / 2).sum() < low
    assert (found.p_value < 0.01).mean() > 0.99


def test_noisy_far_fibers_do_not_bias_result(rng):
    truth, _ = turned_profiles(1.3, 0.7)
    seen, variance = read(rng, truth, 200)
    noise = 3e-4  # the far half of the fibers, some of them read below 0
    lost = seen + noise * rng.standard_normal(seen.shape)
    assert (lost < 0).any()
    found = estimate_from_profiles(SIXTEEN, RADIUS_MM, lost, variance + noise**2, **MEDIUM)
    mean = np.log(found.ratio).mean()
    error = np.log(found.ratio).std() / np.sqrt(200)
    assert abs(
        mean - np.log(1.3)
    ) < 4.9 * error + profile_anisotropy.LOG_RATIO_MODEL_ERROR * np.log(1.3)


def test_readings_that_do_not_count_may_be_anything(rng):
    truth, _ = turned_profiles(1.3, 0.7)
    seen, variance = (a[:, 0] for a in read(rng, truth, 1))
    good = np.ones(seen.shape, bool)
    good[:, 5] = False  # a dead fiber
    good[3] = False  # a turn without contact
    good[7, ::3] = False
    plain = estimate_from_profiles(SIXTEEN, RADIUS_MM, seen, variance, valid=good, **MEDIUM)
    spoilt = np.where(good, seen, np.nan)
    found = estimate_from_profiles(SIXTEEN, RADIUS_MM, spoilt, variance, valid=good, **MEDIUM)
    assert found.ratio == plain.ratio
    assert not found.used[3]
    assert found.used.sum() == 15
    assert found.ratio == pytest.approx(1.3, abs=5 * found.ratio_stderr)


def test_profiles_are_compared_per_channel_in_any_unit(rng):
    truth = np.stack([turned_profiles(r, 0.3)[0] for r in (1.1, 1.4)], axis=1)
    found = estimate_from_profiles(SIXTEEN, RADIUS_MM, truth, **MEDIUM)
    scaled = estimate_from_profiles(SIXTEEN, RADIUS_MM, 1e-9 * truth, **MEDIUM)
    alone = estimate_from_profiles(SIXTEEN, RADIUS_MM, truth[:, 1], **MEDIUM)
    assert found.ratio.shape == (2,)
    np.testing.assert_allclose(found.ratio, scaled.ratio, rtol=1e-9)
    assert found.ratio[1] == pytest.approx(alone.ratio, rel=1e-9)
    np.testing.assert_allclose(found.mean_per_mm, 0.53, rtol=0.02)


def test_signal_free_or_too_few_fibers_give_nothing(rng):
    noise = rng.standard_normal((16, 28))
    found = estimate_from_profiles(SIXTEEN, RADIUS_MM, noise, np.ones((16, 28)), **MEDIUM)
    assert not found.valid
    assert "0 usable directions" in str(found.reason)
    truth, _ = turned_profiles(1.3, 0.1)
    few = estimate_from_profiles(SIXTEEN, RADIUS_MM[:5], truth[:, :5], **MEDIUM)
    assert not few.valid
    for unknown in ({"sigma_a_per_mm": np.nan}, {"sigma_s_prime_per_mm": 0.0}):
        assert not estimate_from_profiles(SIXTEEN, RADIUS_MM, truth, **(MEDIUM | unknown)).valid


def test_profiles_that_do_not_fit_are_refused():
    truth, _ = turned_profiles(1.3, 0.7)
    for match, wrong in (
        ("radius_mm", {"radius_mm": -RADIUS_MM}),
        ("reflectance_per_mm2: got shape", {"reflectance_per_mm2": truth[:, :5]}),
        ("floor", {"floor": -1.0}),
        ("variance: got none", {"errors": "absolute"}),
        ("variance: got shape", {"variance": np.ones(28)}),
        ("variance: got", {"variance": -truth}),
        ("sigma_a_per_mm", {"sigma_a_per_mm": [0.1, 0.2]}),
    ):
        given = {"radius_mm": RADIUS_MM, "reflectance_per_mm2": truth} | MEDIUM | wrong
        with pytest.raises(AnisotropyError, match=match):
            estimate_from_profiles(SIXTEEN, **given)
