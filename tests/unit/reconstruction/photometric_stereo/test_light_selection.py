"""Fisher information of lights: closed forms, what noise does, and choices by it."""

import itertools

import numpy as np
import pytest
from scipy import stats

from reconstruction.photometric_stereo import light_selection as selection

UP = np.array([0.0, 0.0, 1.0])


def ring(count, tilt_rad):
    turn = np.arange(count) * 2 * np.pi / count
    across = np.sin(tilt_rad)
    up = np.full(count, np.cos(tilt_rad))
    return np.stack([across * np.cos(turn), across * np.sin(turn), up], axis=-1)


def dome(count, seed=0):
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(count, 3))
    way[:, 2] = np.abs(way[:, 2]) + 0.2
    return way / np.linalg.norm(way, axis=-1, keepdims=True)


def face(points=40, seed=1):
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(points, 3)) * [0.5, 0.5, 0.2] + UP
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def told(normals, lights, noise=0.01, **more):
    lit = normals @ lights.T
    return selection.fisher_information(
        normals, lights, np.where(lit > 0.15, noise**2, np.inf), **more
    )


@pytest.mark.parametrize("count", [4, 8, 20])
@pytest.mark.parametrize("tilt_rad", [0.3, 0.8])
def test_a_ring_of_lights_leaves_its_closed_form(count, tilt_rad):
    found = selection.predict_errors(
        told(UP[None], ring(count, tilt_rad)), range(count), min_lights=3
    )
    # sum of tan^2 cos^2(turn) over the ring is tan^2 N / 2
    expected = 0.01 / np.sqrt(count / 2) / np.tan(tilt_rad)
    assert found.tilt_rad[0] == pytest.approx(expected, rel=1e-6)
    assert found.log_albedo[0] == pytest.approx(0.01 / np.sqrt(count), rel=1e-6)


def test_least_squares_scatters_as_predicted():
    lights, noise, trials = dome(12), 0.005, 4000
    normal = face(1, seed=4)[0]
    found = selection.predict_errors(told(normal[None], lights, noise), range(12), min_lights=3)
    rng = np.random.default_rng(2)
    lit = lights @ normal
    used = lit > 0.15
    samples = lit[used] * (1 + noise * rng.standard_normal((trials, used.sum())))
    weighted = lights[used] / lit[used, None]
    solved = np.linalg.lstsq(weighted, (samples / lit[used]).T, rcond=None)[0].T
    solved /= np.linalg.norm(solved, axis=-1, keepdims=True)
    squared = np.sum(np.cross(solved, normal) ** 2, axis=-1)
    # two tilts of these variances: their mean square, with the spread of its own mean
    z = (squared.mean() / 2 - found.tilt_rad[0] ** 2) / (squared.std() / 2 / np.sqrt(trials))
    assert abs(z) < 4.0  # 6e-5 false alarms


def test_added_light_never_hurts_with_gain_as_difference():
    found = told(face(), dome(10))
    few = selection.predict_errors(found, range(5), min_lights=3)
    gain = selection._gains(found, list(range(5)), min_lights=3)
    for light in range(5, 10):
        more = selection.predict_errors(found, [*range(5), light], min_lights=3)
        assert np.all(more.tilt_rad <= few.tilt_rad + 1e-12)
        assert gain[light] >= 0
        if few.valid.all():
            lost = np.sum(few.tilt_rad**2 - more.tilt_rad**2)
            assert gain[light] == pytest.approx(lost, rel=1e-6)


def test_greedy_choice_is_nearly_optimal():
    found, least = told(face(), dome(11), systematic_rad=0.0), 3
    greedy = selection.select_lights(
        found, median_rad=0.0, valid_fraction=2.0, min_lights=least, max_lights=6
    )

    def loss(lights):
        now = selection.predict_errors(found, lights, min_lights=least)
        return float(np.mean(np.where(now.valid, now.tilt_rad, selection.UNKNOWN_ERROR_RAD) ** 2))

    every = sorted(loss(lights) for lights in itertools.combinations(range(11), 6))
    assert loss(greedy.lights) <= 1.25 * every[0]
    assert loss(greedy.lights) < every[len(every) // 4]  # far better than at random


def test_selection_stops_at_target_and_keeps_nothing_superfluous():
    found = told(face(), dome(60), 0.02)
    chosen = selection.select_lights(
        found, median_rad=np.radians(0.6), valid_fraction=0.95, min_lights=6
    )
    assert chosen.reached
    assert chosen.prediction.median_rad <= np.radians(0.6)
    for light in chosen.lights:
        rest = [other for other in chosen.lights if other != light]
        without = selection.predict_errors(found, rest, min_lights=6)
        assert without.median_rad > np.radians(0.6) or without.valid_fraction < 0.95
    tighter = selection.select_lights(
        found, median_rad=np.radians(0.4), valid_fraction=0.95, min_lights=6
    )
    assert len(tighter.lights) > len(chosen.lights)


def test_irreducible_error_is_reported_out_of_reach():
    found = told(face(), dome(30), systematic_rad=np.radians(1.0))
    chosen = selection.select_lights(
        found, median_rad=np.radians(0.9), valid_fraction=0.5, min_lights=6
    )
    assert not chosen.reached
    assert len(chosen.lights) == 30


@pytest.mark.parametrize(("informative", "valid"), [(3, False), (4, True)])
def test_point_needs_four_informative_lights(informative, valid):
    """Lights that reach a point in its highlight alone leave it without an estimate."""
    variance = np.full((1, 12), np.inf)
    variance[0, :informative] = 1e-4
    found = selection.fisher_information(
        UP[None], ring(12, 0.5), variance, reaches=np.ones((1, 12), bool)
    )
    assert selection.predict_errors(found, range(12), min_lights=10).valid[0] == valid


def test_rayleigh_angle_median_matches_samples():
    rng = np.random.default_rng(3)
    scale = np.array([0.1, 0.3, 1.0])
    drawn = rng.rayleigh(np.repeat(scale, 40_000))
    below = int(np.sum(drawn < selection.rayleigh_mixture_median(scale)))
    assert stats.binomtest(below, drawn.size, 0.5).pvalue > 1e-4
    assert selection.rayleigh_mixture_median([]) == pytest.approx(np.pi / 2)


@pytest.mark.parametrize("broken", ["weight", "tilt", "negative", "shape"])
def test_bad_information_is_refused_by_name(broken):
    good = told(face(3), dome(4))
    fields = {
        name: getattr(good, name).copy()
        for name in ("tilt", "weight", "reaches", "importance", "systematic_rad")
    }
    if broken == "negative":
        fields["importance"][0] = -1.0
    elif broken == "shape":
        fields["importance"] = np.ones(2)
    else:
        fields[broken].flat[0] = np.nan
    with pytest.raises(selection.SelectionError, match="got"):
        selection.FisherInformation(**fields)
    with pytest.raises(selection.SelectionError, match="min_lights"):
        selection.select_lights(good, median_rad=1.0, valid_fraction=0.5, min_lights=2)
