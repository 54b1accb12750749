"""From profiles of a fiber probe to documents: errors that are shared, sites, directions."""

import json
import math

import numpy as np
import pytest

from capture.calibration.fiber.probe_calibration import FiberReflectance
from capture.plan.suction import HeadPlacement
from capture.rig import load_rig
from model import photon_table
from reconstruction.pipeline.probe import profile_fits
from reconstruction.pipeline.probe import stages as probe_stages
from reconstruction.pipeline.probe.images import Measurement, measurement_name

PROBE = load_rig("probe").probe
RADIUS = np.array(PROBE.radius_mm)
MEDIUM = (0.08, 1.2)
SIGMA_TR = math.sqrt(3 * MEDIUM[0] * sum(MEDIUM))


def profile(
    site="cheek",
    *,
    angle=0.0,
    repeat=0,
    scale=1.0,
    common=0.0,
    noise=0.01,
    rng=None,
    g=0.825,
    medium=MEDIUM,
):
    value = photon_table.reflectance(
        RADIUS,
        *medium,
        g=g,
        collection="fiber",
        core_mm=PROBE.fibers[0].core_mm,
        source_core_mm=PROBE.source_core_mm,
    )
    value = np.repeat(scale * value[:, None], 3, axis=1)
    if rng is not None:
        value = value * (1 + noise * rng.standard_normal(value.shape))
    slope = common * (RADIUS - RADIUS.mean())[:, None] * np.ones(3)
    return profile_fits.MeasuredProfile(
        Measurement(HeadPlacement(site, angle, repeat), 23, 1.0, 60.0, 5.0),
        FiberReflectance(
            tuple(fiber.name for fiber in PROBE.fibers),
            RADIUS,
            value,
            (noise * value) ** 2,
            (value * slope)[None],
            np.ones(value.shape, bool),
            np.zeros(value.shape, bool),
        ),
    )


def documents(profiles):
    made = probe_stages._subsurface(PROBE, profiles)
    return made, json.loads(made[probe_stages.SUBSURFACE_FILE])


def fit_of(document, method, number=0, channel="green"):
    fits = document["measurements"][number]["fits"]
    return next(f for f in fits if (f["method"], f["channel"]) == (method, channel))


def test_methods_reported_per_channel_and_fitting_model_recovered():
    _, document = documents([profile()])
    assert len(document["measurements"][0]["fits"]) == 9
    found = fit_of(document, "photon_table")
    assert found["sigma_tr_per_mm"] == pytest.approx(SIGMA_TR, rel=2e-3)
    assert found["valid"]
    # and the baseline misses it
    dipole = fit_of(document, "dipole")
    assert dipole["sigma_tr_per_mm"] / SIGMA_TR < 0.9


def test_phantom_uncertainty_widens_interval_without_shift():
    _, without = documents([profile()])
    _, document = documents([profile(common=0.02)])
    narrow, wide = (fit_of(d, "photon_table") for d in (without, document))
    assert wide["sigma_tr_per_mm"] == pytest.approx(narrow["sigma_tr_per_mm"], rel=1e-9)
    assert wide["sigma_tr_stderr_readings"] == pytest.approx(narrow["sigma_tr_stderr"], rel=1e-6)
    # a tilt of the log profile by .02 a mm is about that much of sigma_tr
    shared = math.sqrt(wide["sigma_tr_stderr"] ** 2 - narrow["sigma_tr_stderr"] ** 2)
    assert 0.3 < shared / 0.02 < 1.5
    for name in ("sigma_a", "sigma_s_prime"):
        assert wide[f"{name}_stderr"] > 2.0 * narrow[f"{name}_stderr"]
    low, high = wide["interval_per_mm"]
    assert math.log(high / low) == pytest.approx(
        math.log(narrow["interval_per_mm"][1] / narrow["interval_per_mm"][0])
        * wide["sigma_tr_stderr"]
        / narrow["sigma_tr_stderr"],
        rel=1e-6,
    )


def test_repeats_average_own_errors_but_not_phantom_error():
    rng = np.random.default_rng(3)
    noise = 0.1
    alone, told = documents([profile(common=0.02, noise=noise, rng=rng)])
    several, document = documents(
        [profile(repeat=k, common=0.02, noise=noise, rng=rng) for k in range(9)]
    )
    one, nine = alone["_sites"][0], several["_sites"][0]
    assert (nine.measurements >= 7).all()
    fit = fit_of(told, "photon_table")
    own, whole = fit["sigma_tr_stderr_readings"], fit["sigma_tr_stderr"]
    assert own > 0.3 * whole
    # what is shared stays: a third of the whole would be wrong
    assert nine.stderr_per_mm[1] > 0.9 * math.sqrt(whole**2 - own**2)
    assert nine.stderr_per_mm[1] < 0.95 * one.stderr_per_mm[1]
    assert [entry["site"] for entry in document["sites"]] == ["cheek"] * 3


def test_repeats_scattering_beyond_errors_get_less_weight():
    calm, _ = documents([profile(repeat=k) for k in range(4)])
    torn = [profile(repeat=k) for k in range(4)]
    for k, one in enumerate(torn):
        tilt = 1 + 0.3 * (k - 1.5) * (RADIUS - RADIUS.mean()) / np.ptp(RADIUS)
        one.reflectance.reflectance_per_mm2[:] *= tilt[:, None]
    loose, _ = documents(torn)
    ratio = loose["_sites"][0].stderr_per_mm / calm["_sites"][0].stderr_per_mm
    assert (ratio > 2).all()


def test_site_without_valid_fit_has_infinite_error():
    dark = profile()
    dark.reflectance.valid[:] = False
    made, document = documents([dark])
    site = made["_sites"][0]
    assert np.isnan(site.sigma_tr_per_mm).all()
    assert np.isinf(site.stderr_per_mm).all()
    assert document["sites"][0]["sigma_tr_per_mm"] is None
    assert "fewer than" in fit_of(document, "photon_table")["reason"]


def test_directions_are_judged_only_where_there_are_enough():
    rng = np.random.default_rng(5)
    turned = [profile(angle=22.5 * k, rng=rng) for k in range(16)]
    made, _ = documents([*turned, profile("chin")])
    document = json.loads(probe_stages._anisotropy(made["_fits"]))
    assert [entry["site"] for entry in document["sites"]] == ["cheek"] * 3
    assert all(entry["valid"] and entry["directions"] == 16 for entry in document["sites"])
    assert not any(entry["anisotropic"] for entry in document["sites"])
    assert document["left_out"] == ["chin, repeat 0: 1 directions, expected at least 5"]


def test_a_measurement_is_called_after_its_placement():
    names = {
        measurement_name(HeadPlacement("cheek", 22.5 * k, r)) for k in range(16) for r in (0, 1)
    }
    assert len(names) == 32


def test_profile_dimmed_by_top_layer_fits_to_factor():
    _, document = documents([profile(scale=0.4)])
    fit = fit_of(document, "photon_table")
    assert fit["sigma_tr_per_mm"] == pytest.approx(SIGMA_TR, rel=0.02)
    assert fit["factor"] == pytest.approx(0.4, rel=0.05)
    # one that is not dimmed keeps its scale
    assert fit_of(documents([profile()])[1], "photon_table")["factor"] == 1.0


def test_independently_outlying_fibers_do_not_indicate_layers():
    """Twenty draws of 5 % a fiber, as of dirt since the calibration; none is stated as noise."""
    rng = np.random.default_rng(8)
    torn = [profile(noise=1e-3, repeat=k) for k in range(20)]
    for one in torn:
        one.reflectance.reflectance_per_mm2[:] *= np.exp(0.05 * rng.standard_normal((28, 3)))
    fits = profile_fits.fit_profiles(torn, PROBE)
    layered = np.array([fit.fit.scale != 1.0 for fit in fits])
    off = np.array([np.log(fit.fit.sigma_tr_per_mm / SIGMA_TR) / fit.log_stderr for fit in fits])
    assert (
        np.array([fit.fit.model_error > profile_fits.MAX_HOMOGENEOUS_MISFIT for fit in fits]).mean()
        > 0.9
    )
    assert layered.mean() <= 0.05
    assert 0.5 < np.sqrt(np.mean(off[~layered] ** 2)) < 1.4


def test_stray_light_in_far_fibers_is_not_layers():
    """Thirty draws of 5 % per fiber, and of stray light 1.5 standard uncertainties off.

    The far fibers share it, so that it bends the profile of a homogeneous medium.
    """
    rng = np.random.default_rng(17)
    medium, stray, own = (0.37, 2.1), 8e-8, 4e-8
    far = np.arange(28)[:, None] >= 21
    torn = [profile(medium=medium, repeat=k) for k in range(30)]
    for one in torn:
        value, variance = one.reflectance.reflectance_per_mm2, one.reflectance.variance
        variance[:] = (0.004 * value) ** 2 + (own * far) ** 2
        value *= np.exp(0.05 * rng.standard_normal((28, 1)))
        value += 1.5 * stray * far + np.sqrt(variance) * rng.standard_normal((28, 3))
        one.reflectance.common_per_mm2[:] = stray * far
    fits = profile_fits.fit_profiles(torn, PROBE)
    layered = np.array([fit.fit.scale != 1.0 for fit in fits])
    sigma_tr = math.sqrt(3 * medium[0] * sum(medium))
    off = np.array([fit.fit.sigma_tr_per_mm / sigma_tr - 1.0 for fit in fits])
    assert layered.mean() <= 0.03
    assert np.median(np.abs(off)) < 0.02


def test_isotropic_medium_is_reported_not_valid():
    """A bent misfit, but of a medium: no factor as of layers, and the reason is in the document."""
    _, document = documents([profile(g=0.0)])
    fit = fit_of(document, "photon_table")
    assert not fit["valid"]
    assert "asymmetry g is outside its prior" in fit["reason"]
    assert fit["factor"] == 1.0
    assert fit_of(documents([profile(g=0.8)])[1], "photon_table")["valid"]


def test_head_rotation_is_layered_only_where_all_dimmed():
    """What dims in some directions and brightens in others is no layer: none gets a factor."""

    def factors(scales):
        fits = profile_fits.fit_profiles(
            [profile(angle=45.0 * k, scale=scale) for k, scale in enumerate(scales)], PROBE
        )
        return np.array([fit.fit.scale for fit in fits])

    np.testing.assert_allclose(factors([0.4] * 5), 0.4, rtol=0.05)
    # one direction that is like a medium by chance does not make the tissue one
    np.testing.assert_allclose(factors([0.4, 0.4, 0.4, 0.4, 0.97])[:4], 0.4, rtol=0.05)
    np.testing.assert_array_equal(factors([0.4, 2.5, 0.4, 2.5, 0.4]), 1.0)
    # few directions tell nothing of each other
    np.testing.assert_allclose(factors([0.4, 2.5])[:, 1], [0.4, 2.5], rtol=0.1)
