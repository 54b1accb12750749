import numpy as np
import pytest
from scipy import stats

from reconstruction.anisotropy import direction_harmonics
from reconstruction.anisotropy.estimation import AnisotropyError, estimate

SIXTEEN = np.deg2rad(np.arange(16) * 22.5)
STDERR = 0.02
NULL_CASES = 2000
FALSE_ALARM_OF_A_TEST = 1e-6


def most_of(cases, rate):
    """The count that so many trials of this rate exceed once in a million."""
    return stats.binom.isf(FALSE_ALARM_OF_A_TEST, cases, rate)


def ellipse(angle, ratio, axis_rad, mean=0.6):
    """sigma_tr of a medium that diffuses `ratio` squared times as much along the axis."""
    along, across = np.cos(angle - axis_rad), np.sin(angle - axis_rad)
    value = np.sqrt((along / ratio) ** 2 + across**2)
    turn = np.linspace(0, np.pi, 3601)[:-1]
    return mean * value / np.hypot(np.cos(turn) / ratio, np.sin(turn)).mean()


def null(rng, angle, cases=NULL_CASES, spread=None):
    stderr = np.full((angle.size, cases), STDERR)
    if spread is not None:
        stderr = stderr * np.exp(spread * rng.standard_normal(stderr.shape))
    return 0.6 * (1 + stderr * rng.standard_normal(stderr.shape)), 0.6 * stderr


@pytest.mark.parametrize("ratio", [1.05, 1.5, 4.0])
@pytest.mark.parametrize("axis_rad", [0.0, 0.4, 1.6, 3.1])
def test_error_free_ellipse_is_recovered_exactly(ratio, axis_rad):
    found = estimate(SIXTEEN, ellipse(SIXTEEN, ratio, axis_rad))
    assert found.ratio == pytest.approx(ratio, rel=1e-9)
    assert abs(np.exp(2j * (found.axis_rad - axis_rad)) - 1) < 1e-7
    assert 0 <= found.axis_rad < np.pi
    assert found.mean_per_mm == pytest.approx(0.6, rel=1e-6)
    assert found.tilt < 1e-9


def test_a_channel_does_not_know_of_the_others():
    values = np.stack([ellipse(SIXTEEN, r, 0.7) for r in (1.1, 1.4, 2.0, 3.0)], axis=-1)
    values *= 1 + 0.01 * np.cos(5 * SIXTEEN)[:, None]
    both = estimate(SIXTEEN, values.reshape(16, 2, 2))
    assert both.ratio.shape == (2, 2)
    assert both.used.shape == (16, 2, 2)
    for k in range(4):
        alone = estimate(SIXTEEN, values[:, k])
        assert both.ratio.reshape(-1)[k] == pytest.approx(alone.ratio, rel=1e-12)
        assert both.log10_p.reshape(-1)[k] == pytest.approx(alone.log10_p, rel=1e-9)


@pytest.mark.parametrize(
    ("angle", "spread", "errors"),
    [
        (SIXTEEN, None, "relative"),
        (SIXTEEN, None, "absolute"),
        (SIXTEEN, 0.7, "relative"),
        (SIXTEEN, 0.7, "absolute"),
        (np.arange(5) * 2 * np.pi / 5, None, "relative"),
        (np.arange(8) * np.pi / 8, None, "relative"),
        (SIXTEEN[[0, 1, 2, 3, 5, 6, 9, 10, 11, 14]], 0.7, "relative"),
    ],
)
def test_isotropic_tissue_is_flagged_at_the_stated_rate(rng, angle, spread, errors):
    values, stderr = null(rng, angle, spread=spread)
    found = estimate(angle, values, stderr, errors=errors)
    assert found.valid.all()
    for rate in (0.05, 0.01, 0.001):
        # an outlier left out by mistake may add its own rate
        alarms = (found.p_value < rate).sum()
        assert alarms <= most_of(NULL_CASES, rate + direction_harmonics.OUTLIER_FALSE_ALARM_RATE)
    assert (found.p_value < 0.05).sum() >= stats.binom.ppf(1e-6, NULL_CASES, 0.05)


def test_understated_errors_raise_false_alarms_only_as_absolute(rng):
    values, stderr = null(rng, SIXTEEN)
    limit = most_of(NULL_CASES, 0.01 + direction_harmonics.OUTLIER_FALSE_ALARM_RATE)
    assert (estimate(SIXTEEN, values, stderr / 3).p_value < 0.01).sum() <= limit
    trusting = estimate(SIXTEEN, values, stderr / 3, errors="absolute")
    assert (trusting.p_value < 0.01).sum() > 5 * limit
    # which the misfit tells
    assert (stats.chi2.sf(trusting.chi2, trusting.dof) < 0.01).mean() > 0.9


@pytest.mark.parametrize("size", [2.0, 5.0, 8.0, 30.0])
def test_single_bad_direction_is_not_anisotropy(rng, size):
    values, stderr = null(rng, SIXTEEN)
    values[3] += size * stderr[3]
    found = estimate(SIXTEEN, values, stderr)
    limit = most_of(NULL_CASES, 0.01 + direction_harmonics.OUTLIER_FALSE_ALARM_RATE)
    assert (found.p_value < 0.01).sum() <= limit
    kept = estimate(SIXTEEN, values, stderr, outliers=False, errors="absolute")
    if size >= 5:
        assert (kept.p_value < 0.01).sum() > limit
    if size == 30:
        assert found.outlier[3].all()
        others = np.delete(found.outlier, 3, axis=0).sum()
        assert others <= most_of(NULL_CASES, direction_harmonics.OUTLIER_FALSE_ALARM_RATE)


def test_good_directions_are_omitted_at_stated_rate(rng):
    values, stderr = null(rng, SIXTEEN, cases=4000)
    found = estimate(SIXTEEN, values, stderr)
    assert found.outlier.any(axis=0).sum() <= most_of(
        4000, direction_harmonics.OUTLIER_FALSE_ALARM_RATE
    )


def test_ratio_and_axis_are_within_their_standard_errors(rng):
    truth = ellipse(SIXTEEN, 1.3, 0.8)[:, None]
    stderr = np.full((16, 3000), STDERR * 0.6)
    for errors in ("relative", "absolute"):
        found = estimate(
            SIXTEEN, truth + stderr * rng.standard_normal(stderr.shape), stderr, errors=errors
        )
        within = np.abs(found.ratio - 1.3) < found.ratio_stderr
        off = np.abs(np.angle(np.exp(2j * (found.axis_rad - 0.8)))) / 2
        for inside in (
            within,
            off < found.axis_stderr_rad,
            np.abs(found.mean_per_mm - 0.6) < found.mean_stderr_per_mm,
        ):
            assert 0.65 < inside.mean() < 0.72
        # without the factor for few degrees of freedom, or with errors off by 1.5, it would fail
        assert (np.abs(found.ratio - 1.3) < found.ratio_stderr / 1.5).mean() < 0.6


def test_ratio_errors_reach_cramer_rao_bound(rng):
    truth = ellipse(SIXTEEN, 1.2, 2.0)[:, None]
    found = estimate(SIXTEEN, truth * (1 + STDERR * rng.standard_normal((16, 4000))))
    # sigma_tr is mean (1 - h/2 cos) to first order: sd of h is 2 sd sqrt(2 / 16)
    bound = 2 * STDERR * np.sqrt(2 / 16)
    assert np.log(found.ratio).std() == pytest.approx(bound, rel=0.06)


def test_tilted_head_is_separated_from_anisotropic_tissue(rng):
    values = ellipse(SIXTEEN, 1.0, 0.0) * (1 + 0.1 * np.cos(SIXTEEN - 2.0))
    values = values[:, None] * (1 + STDERR * rng.standard_normal((16, 2000)))
    found = estimate(SIXTEEN, values)
    assert (found.p_value < 0.01).sum() <= most_of(2000, 0.011)
    assert (found.tilt_p_value < 1e-3).mean() > 0.99
    assert np.median(found.tilt) == pytest.approx(0.1, abs=0.002)
    assert np.median(found.tilt_rad) == pytest.approx(2.0, abs=0.02)
    # directions over half a turn cannot tell it
    half = estimate(SIXTEEN[:8], values[:8])
    assert (half.tilt_p_value == 1).all()
    assert np.isinf(half.tilt_stderr).all()


def test_angles_of_further_rotations_give_same_axes():
    values = ellipse(SIXTEEN, 1.7, 0.9)
    found = estimate(SIXTEEN + 2 * np.pi * (np.arange(16) - 8), values)
    assert found.ratio == pytest.approx(1.7, rel=1e-9)
    assert found.axis_rad == pytest.approx(0.9, abs=1e-7)


def test_inputs_are_not_modified():
    angle, values = SIXTEEN.copy(), ellipse(SIXTEEN, 1.7, 0.9)
    stderr = np.full(16, 0.01)
    before = values.copy()
    estimate(angle, values, stderr, valid=np.arange(16) > 3)
    np.testing.assert_array_equal(values, before)
    np.testing.assert_array_equal(angle, SIXTEEN)


def test_sixteen_equal_directions_are_isotropic_whatever_their_errors():
    for stderr in (None, np.zeros(16), np.full(16, 1e-9)):
        found = estimate(SIXTEEN, np.full(16, 0.7), stderr)
        assert found.ratio == pytest.approx(1.0, abs=1e-12)
        assert found.p_value > 0.9
        assert found.axis_stderr_rad > 0.8
        assert found.mean_per_mm == pytest.approx(0.7, rel=1e-12)
    with pytest.raises(AnisotropyError, match="absolute"):
        estimate(SIXTEEN, np.full(16, 0.7), np.zeros(16), errors="absolute")
    with pytest.raises(AnisotropyError, match="got 0 for some values"):
        estimate(SIXTEEN, np.full(16, 0.7), np.arange(16.0))


def test_p_values_are_reported_below_floating_point_range():
    values, stderr = ellipse(SIXTEEN, 1.5, 0.3), np.full(16, 1e-3)
    found = estimate(SIXTEEN, values, stderr, errors="absolute")
    power = direction_harmonics.fit_harmonics(
        SIXTEEN, values[:, None], np.full((16, 1), 1e6)
    ).axial_power[0]
    assert found.log10_p == pytest.approx(-0.5 * power / np.log(10), rel=1e-9)
    assert found.log10_p < -300
    tiny = estimate(SIXTEEN, values, 1e-200 * stderr, errors="absolute")
    assert tiny.p_value == 0
    assert tiny.log10_p < -1e300 or np.isneginf(tiny.log10_p)
    many = np.arange(3600) * np.pi / 1800
    relative = estimate(many, ellipse(many, 1.5, 0.3) * (1 + 0.01 * np.cos(7 * many)))
    assert np.isfinite(relative.log10_p)
    assert relative.log10_p < -1000


def test_a_masked_direction_may_hold_anything():
    values = np.stack([ellipse(SIXTEEN, 1.4, 0.3)] * 2, axis=-1)
    values[3, 0], values[5, 0], values[6, 1] = np.nan, -1.0, np.inf
    good = np.ones((16, 2), bool)
    good[3, 0] = False
    found = estimate(SIXTEEN, values, valid=good)
    np.testing.assert_allclose(found.ratio, 1.4, rtol=1e-9)
    assert found.used.sum(axis=0).tolist() == [14, 15]


def test_too_few_directions_are_refused_with_their_number():
    with pytest.raises(AnisotropyError, match="different directions of angle_rad: got"):
        estimate(SIXTEEN[:4], np.ones(4))
    with pytest.raises(AnisotropyError, match="different directions of angle_rad: got"):
        estimate(np.zeros(16), np.ones(16))
    good = np.zeros((16, 2), bool)
    good[:3, 0] = good[:, 1] = True
    found = estimate(SIXTEEN, np.ones((16, 2)), valid=good)
    assert found.valid.tolist() == [False, True]
    assert found.reason[0] == "3 usable directions, expected 5 or more"
    assert found.p_value[0] == 1
    assert np.isinf(found.ratio_stderr[0])
    narrow = estimate(np.linspace(0, 0.05, 8), np.ones(8))
    assert not narrow.valid
    assert "close together" in str(narrow.reason)


def test_values_that_do_not_fit_are_refused():
    with pytest.raises(AnisotropyError, match="sigma_tr_per_mm: got shape"):
        estimate(SIXTEEN, np.ones(15))
    with pytest.raises(AnisotropyError, match="stderr_per_mm: got shape"):
        estimate(SIXTEEN, np.ones(16), np.ones(15))
    with pytest.raises(AnisotropyError, match="stderr_per_mm: got"):
        estimate(SIXTEEN, np.ones(16), -np.ones(16))
    with pytest.raises(AnisotropyError, match="errors"):
        estimate(SIXTEEN, np.ones(16), errors="known")
    with pytest.raises(AnisotropyError, match="finite"):
        estimate(np.full(16, np.nan), np.ones(16))


@pytest.mark.parametrize("scale", [1e-150, 1.0, 1e150])
def test_the_unit_of_length_does_not_matter(scale):
    values = ellipse(SIXTEEN, 1.4, 0.3) * (1 + 0.01 * np.cos(5 * SIXTEEN))
    found = estimate(SIXTEEN, scale * values, scale * np.full(16, 0.01))
    plain = estimate(SIXTEEN, values, np.full(16, 0.01))
    assert found.ratio == pytest.approx(plain.ratio, rel=1e-12)
    assert found.chi2 == pytest.approx(plain.chi2, rel=1e-9)


def test_direction_of_tiny_error_is_weighted_not_dominant(rng):
    truth = ellipse(SIXTEEN, 1.4, 0.3)
    stderr = np.full(16, 0.01)
    stderr[4] = 1e-9
    found = estimate(SIXTEEN, truth + stderr * rng.standard_normal(16), stderr, errors="absolute")
    assert abs(found.ratio - 1.4) < 5 * found.ratio_stderr
    assert found.ratio_stderr > 1e-3


@pytest.mark.parametrize("unit", [1e-300, 1e-150, 1e150, 1.7e308])
@pytest.mark.parametrize("told", [None, 0.01])
def test_ratio_and_axis_are_scale_invariant(unit, told):
    shape = ellipse(SIXTEEN, 1.5, 0.3, mean=0.8)
    shape = shape / shape.max()
    errors = "relative" if told is None else "absolute"
    stderr = None if told is None else np.full(16, told)
    usual = estimate(SIXTEEN, shape, stderr, errors=errors)
    found = estimate(SIXTEEN, unit * shape, None if told is None else unit * stderr, errors=errors)
    assert found.valid
    for name in ("ratio", "axis_rad", "ratio_stderr", "chi2"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(usual, name), rtol=1e-6, atol=1e-12
        )
    np.testing.assert_allclose(found.mean_per_mm / unit, usual.mean_per_mm, rtol=1e-12)


@pytest.mark.parametrize("height", [1e20, 1e150, 1e300])
def test_far_outlier_direction_is_omitted_and_hides_none(height):
    values = ellipse(SIXTEEN, 1.5, 0.3)
    valid = np.arange(16) != 3
    values[3] = height
    found, without = estimate(SIXTEEN, values), estimate(SIXTEEN, values, valid=valid)
    np.testing.assert_array_equal(found.outlier, ~valid)
    for name in ("ratio", "axis_rad", "mean_per_mm"):
        np.testing.assert_allclose(getattr(found, name), getattr(without, name), rtol=1e-9)


def test_directions_of_hopeless_errors_are_none():
    """Beside errors 1e12 times smaller their weights are rounding, and matrices singular."""
    values = ellipse(SIXTEEN, 1.5, 0.3)
    stderr = np.where(np.arange(16) < 3, 1e-3, 1e13)
    found = estimate(SIXTEEN, values, stderr, errors="absolute")
    assert found.used.sum() == 3
    assert not found.valid
    assert "3 usable directions" in str(found.reason)
