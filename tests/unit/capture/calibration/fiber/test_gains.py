"""Gains, cross-talk and stray light from a phantom turn readings into reflectance."""

import json
from datetime import date

import numpy as np
import pytest
from scipy.stats import chi2

from capture.calibration import store
from capture.calibration.fiber.crosstalk import CrossTalk, measure_crosstalk
from capture.calibration.fiber.gains import calibrate_fibers
from capture.calibration.fiber.phantom import (
    CertificateError,
    ExpectedReflectance,
    read_certificate,
)
from capture.calibration.fiber.probe_calibration import FiberCalibration, FiberError
from capture.calibration.fiber.readings import FiberReadings
from capture.calibration.fiber.spots import FiberSpots
from capture.calibration.record import CalibrationMismatch
from capture.rig import load_rig

FALSE_ALARM = 1e-5
RIG = load_rig("probe")
RADIUS = np.array(RIG.probe.radius_mm)
NAMES = tuple(fiber.name for fiber in RIG.probe.fibers)
DISTANCE = np.abs(np.subtract.outer(np.arange(28), np.arange(28)))
PER_S = 3000.0  # signal of 1/mm^2


def profile(sigma_tr):
    return 0.03 * np.exp(-np.asarray(sigma_tr) * RADIUS[:, None]) / RADIUS[:, None] ** 2


PHANTOM = profile([0.5, 0.7, 0.9])
SKIN = profile([0.9, 1.3, 1.6])


def spots(found=None):
    place = np.array([fiber.spot_px for fiber in RIG.probe.fibers])
    row = np.full(28, 13.0)
    found = np.ones(28, bool) if found is None else found
    return FiberSpots(NAMES, place, np.full((28, 2), 0.02), row, 0.01 * row, 0.1 * row, found, 17.0)


def mixing(rng, neighbor=1e-3, far=2e-5):
    matrix = far * np.exp(-DISTANCE / 6) * rng.lognormal(0, 0.3, (28, 28))
    matrix[DISTANCE == 1] = neighbor * rng.lognormal(0, 0.3, (DISTANCE == 1).sum())
    np.fill_diagonal(matrix, 1.0)
    return matrix


class Probe:
    """Readings drawn from a mixing matrix, gains, stray light, and noise."""

    def __init__(self, rng, *, matrix=None, stray=2e-5, floor=1e-6, dead=(), leak=0.0):
        self.rng, self.floor, self.leak = rng, floor, leak
        self.matrix = mixing(rng) if matrix is None else matrix
        self.gain = PER_S * rng.normal(1, 0.05, (28, 1)) * np.array([0.6, 1.0, 0.5])
        self.gain[list(dead)] = 0.0
        self.stray = stray * rng.uniform(0.5, 1.5, (28, 3))

    def read(self, reflectance, *, only=None, level=1.0, saturated=()):
        light = self.gain * reflectance
        if only is not None:
            light = np.where(np.arange(28)[:, None] == only, light, self.leak * light)
        mean = level * (self.matrix @ light + self.stray)
        variance = self.floor**2 + 1e-6 * mean * self.floor + (5e-4 * mean) ** 2
        signal = mean + np.sqrt(variance) * self.rng.normal(size=mean.shape)
        full = np.zeros((28, 3), bool)
        full[list(saturated)] = True
        return FiberReadings(
            NAMES,
            np.where(full, 0, signal),
            np.where(full, 0, variance),
            ~full,
            full,
            np.zeros((28, 3)),
            (1.0,),
        )

    def masks(self, **about):
        return {i: self.read(PHANTOM, only=i, **about) for i in range(28)}

    def calibrate(self, *, expected=None, level=1.0, masks=None, **about):
        expected = expected or ExpectedReflectance(PHANTOM, np.zeros((28, 3)))
        return calibrate_fibers(
            self.read(PHANTOM, level=level, **about),
            self.masks() if masks is None else masks,
            spots=spots(),
            radius_mm=RADIUS,
            expected=expected,
            level=level,
        )


def away(found, truth):
    good = found.valid
    return ((found.reflectance_per_mm2 - truth) / np.where(good, found.stderr, 1.0))[good]


def test_reflectance_comes_back_within_its_errors():
    sigmas, blind = [], []
    for seed in range(12):
        probe = Probe(np.random.default_rng(seed))
        result = probe.calibrate().reflectance(probe.read(SKIN))
        sigmas.append(away(result, SKIN))
        nothing = probe.calibrate(masks={}).reflectance(probe.read(SKIN))
        blind.append(np.abs(away(nothing, SKIN)).max())
    sigmas = np.concatenate(sigmas)
    # the fibers of a run share errors of cross-talk, so of 28 x 3 some count as one
    assert 0.75 < np.sqrt((sigmas**2).mean()) < 1.25
    assert np.quantile(np.abs(sigmas), 0.999) < 5
    # without the frames of covered fibers the far ones are off by many standard errors
    assert min(blind) > 10


def test_fiber_pairs_are_measured_within_errors(rng):
    probe = Probe(rng)
    found = measure_crosstalk(probe.masks(), probe.read(PHANTOM))
    first = DISTANCE == 1
    sigmas = ((found.matrix - probe.matrix) / np.where(first, found.stderr, 1))[first]
    assert np.sqrt((sigmas**2).mean()) < 1.6
    bright = np.arange(28) < 14
    assert (found.stderr[first & bright] < 0.05 * found.matrix[first & bright]).all()
    # of what is below the noise of each pair the mean of all as far apart is known
    far = DISTANCE >= 6
    assert found.matrix[far].mean() == pytest.approx(probe.matrix[far].mean(), rel=0.2)


def test_stray_light_is_separated_from_crosstalk(rng):
    probe = Probe(rng, stray=5e-5)
    found = measure_crosstalk(probe.masks(), probe.read(PHANTOM))
    sigmas = (found.offset - probe.stray) / np.hypot(found.offset_stderr, found.offset_common)
    low, high = chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], sigmas.size)
    assert 0.5 * low < float((sigmas**2).sum()) < 1.5 * high
    assert (found.offset_stderr < 0.2 * 5e-5).all()


def test_cover_leakage_is_not_stray_light(rng):
    probe = Probe(rng, stray=0.0, leak=1e-5)
    found = measure_crosstalk(probe.masks(), probe.read(PHANTOM))
    assert found.cover_leak == pytest.approx(1e-5, abs=5 * found.cover_leak_stderr)
    assert found.cover_leak_stderr < 0.2e-5
    error = np.hypot(found.offset_stderr, found.offset_common)
    assert np.abs(found.offset / error).max() < 5
    # taken for stray light it would be worth many standard errors in the far fibers of skin
    assert (error < 1e-6).any(axis=0).all()


def test_overlapping_spots_are_unmixed_by_single_uncovered_frames(rng):
    matrix = mixing(rng)
    matrix[8, 9], matrix[9, 8] = 0.5, 0.4
    probe = Probe(rng, matrix=matrix)
    calibration = probe.calibrate()
    result = calibration.reflectance(probe.read(SKIN))
    pair = [8, 9]
    assert result.valid[pair].all()
    np.testing.assert_allclose(result.reflectance_per_mm2[pair], SKIN[pair], rtol=0.02)
    # the others keep their own small cross-talk, also those that were not measured
    few = {i: readings for i, readings in probe.masks().items() if i in (7, 8, 9, 10)}
    found = measure_crosstalk(few, probe.read(PHANTOM))
    others = (DISTANCE == 1) & (matrix < 0.1)
    assert found.matrix[others].max() < 5e-3


def test_a_weaker_source_gives_the_same_reflectance(rng):
    probe = Probe(rng)
    calibration = probe.calibrate(level=0.5, masks=probe.masks(level=0.5))
    result = calibration.reflectance(probe.read(SKIN, level=0.25), level=0.25)
    near = slice(0, 6)
    np.testing.assert_allclose(result.reflectance_per_mm2[near], SKIN[near], rtol=0.01)
    wrong = calibration.reflectance(probe.read(SKIN, level=0.25))
    assert (wrong.reflectance_per_mm2[near] < 0.3 * SKIN[near]).all()


def test_dead_fiber_is_reported_without_affecting_others(rng):
    probe = Probe(rng, dead=[7])
    calibration = probe.calibrate()
    assert np.flatnonzero(calibration.dead).tolist() == [7]
    result = calibration.reflectance(probe.read(SKIN))
    assert not result.valid[7].any()
    assert result.valid[:7].all()
    assert "dead" in result.reasons["F08"]
    np.testing.assert_allclose(result.reflectance_per_mm2[[6, 8]], SKIN[[6, 8]], rtol=0.02)


def test_saturated_fiber_is_flagged_and_its_leak_bounded(rng):
    probe = Probe(rng)
    calibration = probe.calibrate()
    result = calibration.reflectance(probe.read(SKIN, saturated=[0, 1]))
    assert not result.valid[:2].any()
    assert result.valid[2:10].all()
    assert "saturated" in result.reasons["F01"]
    assert (result.reflectance_per_mm2[:2] == 0).all()
    sigmas = ((result.reflectance_per_mm2 - SKIN) / np.where(result.valid, result.stderr, 1))[2:6]
    assert np.abs(sigmas).max() < 5


def test_fully_saturated_series_is_reported_without_result(rng):
    probe = Probe(rng)
    result = probe.calibrate().reflectance(probe.read(SKIN, saturated=range(28)))
    assert not result.valid.any()
    assert set(result.reasons) == set(NAMES)


def test_signal_free_far_fibers_keep_sign_and_error(rng):
    probe = Probe(rng)
    calibration = probe.calibrate()
    dark = np.where(RADIUS[:, None] < 3, SKIN, 0.0)
    far = RADIUS >= 3
    result = calibration.reflectance(probe.read(dark))
    seen = result.valid & far[:, None]
    assert seen.sum() > 30
    assert (result.reflectance_per_mm2[seen] < 0).any()
    assert np.abs(away(result, dark)).max() < 6


def test_certificate_scale_uncertainty_is_common_to_all_fibers(rng):
    probe = Probe(rng)
    scale = np.full((1, 28, 3), 0.03)
    expected = ExpectedReflectance(1.03 * PHANTOM, 0.002 * PHANTOM, scale)
    result = probe.calibrate(expected=expected).reflectance(probe.read(SKIN))
    near = slice(0, 8)
    ratio = result.reflectance_per_mm2[near] / SKIN[near]
    np.testing.assert_allclose(ratio, 1.03, rtol=0.01)
    own = np.sqrt(result.variance[near]) / SKIN[near]
    assert (own < 0.01).all()  # the fibers agree with each other
    np.testing.assert_allclose((result.stderr / SKIN)[near], 0.03, rtol=0.1)
    covariance = result.covariance
    assert covariance.shape == (3, 28, 28)
    correlation = covariance[1, 0, 3] / np.sqrt(covariance[1, 0, 0] * covariance[1, 3, 3])
    assert correlation > 0.95
    np.testing.assert_allclose(
        np.diagonal(covariance, axis1=1, axis2=2).T, result.stderr**2, rtol=1e-12
    )


def test_readings_of_no_light_cannot_calibrate(rng):
    probe = Probe(rng, dead=range(28), stray=0.0)
    with pytest.raises(FiberError, match="no fiber has light"):
        probe.calibrate()
    bright = Probe(rng)
    with pytest.raises(FiberError, match="saturated in every exposure; take shorter"):
        bright.calibrate(saturated=range(28))


def test_readings_of_another_probe_are_refused(rng):
    probe = Probe(rng)
    calibration = probe.calibrate()
    readings = probe.read(SKIN)
    other = FiberReadings(
        tuple(reversed(NAMES)),
        readings.signal,
        readings.variance,
        readings.valid,
        readings.saturated,
        readings.around,
        (1.0,),
    )
    with pytest.raises(FiberError, match="expected those of the calibration"):
        calibration.reflectance(other)
    with pytest.raises(FiberError, match="level: got 0"):
        calibration.reflectance(readings, level=0.0)


def test_a_calibration_survives_its_file(rng, tmp_path):
    probe = Probe(rng, dead=[20])
    expected = ExpectedReflectance(PHANTOM, 0.01 * PHANTOM, np.full((2, 28, 3), 0.02))
    made = probe.calibrate(expected=expected)
    record = made.to_calibration(
        serial="SP-0001", rig="probe", source="simulated", created=date(2026, 11, 21)
    )
    store.save(record, tmp_path)
    back = FiberCalibration.load(tmp_path, RIG, on=date(2026, 11, 22))
    readings = probe.read(SKIN)
    one, two = made.reflectance(readings), back.reflectance(readings)
    for name in ("reflectance_per_mm2", "variance", "common_per_mm2", "valid"):
        np.testing.assert_allclose(getattr(one, name), getattr(two, name), rtol=1e-12)
    assert back.names == made.names
    with pytest.raises(CalibrationMismatch, match="expected 'fiber' of 'flash'"):
        FiberCalibration.from_calibration(record, load_rig("flash"), "SP-0001")


CERTIFICATE = {
    "schema": "skinrig.phantom/1",
    "eta": 1.4,
    "g": 0.7,
    "wavelength_nm": [400.0, 500.0, 700.0],
    "sigma_a_per_mm": [0.02, 0.015, 0.01],
    "sigma_s_prime_per_mm": [2.0, 1.6, 1.1],
    "uncertainty": {"sigma_a": 0.03, "sigma_s_prime": 0.02},
}


def test_certificate_is_read_and_faults_are_listed(tmp_path):
    path = tmp_path / "phantom.json"
    path.write_text(json.dumps(CERTIFICATE))
    certificate = read_certificate(path)
    sigma_a, sigma_s = certificate.at([400.0, 700.0])
    np.testing.assert_allclose(sigma_a, [0.02, 0.01])
    np.testing.assert_allclose(sigma_s, [2.0, 1.1])
    with pytest.raises(CertificateError, match="380"):
        certificate.at([380.0])
    path.write_text(json.dumps({**CERTIFICATE, "sigma_a_per_mm": [0.02, -0.01], "colour": 1}))
    with pytest.raises(CertificateError, match="colour"):
        read_certificate(path)
    path.write_text(json.dumps({**CERTIFICATE, "sigma_a_per_mm": [0.02, -0.01]}))
    with pytest.raises(CertificateError, match=r"3 numbers[\s\S]*numbers > 0, in 1/mm"):
        read_certificate(path)
    path.write_text(json.dumps({**CERTIFICATE, "schema": "skinrig.phantom/9"}))
    with pytest.raises(CertificateError, match="schema"):
        read_certificate(path)
    with pytest.raises(CertificateError, match="cannot be read"):
        read_certificate(tmp_path / "none.json")


def test_far_pair_mean_error_is_common_to_fibers():
    count, rng = 12, np.random.default_rng(0)
    light, reference, ratio = (rng.uniform(1.0, 9.0, (count, 3)) for _ in range(3))
    place = np.arange(count)
    error = 1e-6 * np.abs(place[:, None] - place)
    nothing = np.zeros((count, 3))
    matrix = CrossTalk(np.eye(count), error, nothing, nothing, nothing, True)
    found = matrix.shared_changes(light, reference, ratio)
    for edge, (low, high) in enumerate(((4, 6), (6, 9), (9, 14))):
        for j in place:
            pairs = [i for i in place if low <= abs(i - j) < high]
            told = -sum((error[j, i] * (light[i] - ratio[j] * reference[i]) for i in pairs), 0.0)
            np.testing.assert_allclose(found[edge, j], told, atol=1e-15)
    # what lets through as much as the reference did is not moved: the gain had the same error
    same = matrix.shared_changes(0.5 * reference, reference, np.full((count, 3), 0.5))
    np.testing.assert_allclose(same, 0.0, atol=1e-18)
