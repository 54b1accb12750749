"""The nearest homogeneous medium, and what a probe's truth tells."""

from __future__ import annotations

import json
import math
from math import inf

import numpy as np
import pytest

from capture.rig import load_rig
from model import store
from rigsim.fiber.homogeneous_fit import MIN_REFLECTANCE_PER_MM2, FitError, fit_homogeneous_medium
from rigsim.fiber.probe_tissue import PHANTOM_BLOCK, HomogeneousTissue
from rigsim.fiber.profile import FiberGeometry, trace_fiber_profile
from rigsim.fiber.white_fiber import FiberTable, FiberTableError
from rigsim.scenes.probe.scene import ProbePlacement, ProbeScene
from rigsim.scenes.probe.scene import probe_truth as ground_truth
from rigsim.tissue.tissue_mc import Layer, LayerStack

RIG = load_rig("probe")
FIBERS = FiberGeometry(RIG.probe.radius_mm)
FALSE_ALARM = 4.5  # standard deviations; of some 100 normal values one in 1500 runs exceeds it


@pytest.mark.parametrize(("sigma_a", "scattering"), [(0.04, 1.5), (0.3, 2.0)])
def test_stored_profile_matches_traced_photons(sigma_a, scattering):
    """28 z values; photons of their own with fibers of their own size against scaled points."""
    layer = Layer(inf, sigma_a, scattering / 0.2, 0.8, 1.4)
    traced = trace_fiber_profile(
        LayerStack((layer,)),
        radii_mm=FIBERS.radii_mm,
        photons=15_000,
        rng=np.random.default_rng(7),
        batches=40,
    )
    value, error = FiberTable.load().profile(sigma_a, scattering, FIBERS)
    z = (traced.reflectance_per_mm2 - value) / np.hypot(traced.stderr, error)
    assert np.abs(z).max() < FALSE_ALARM
    wrong, _ = FiberTable.load().profile(1.3 * sigma_a, scattering, FIBERS)
    assert np.abs((traced.reflectance_per_mm2 - wrong) / traced.stderr).max() > FALSE_ALARM


@pytest.mark.parametrize(
    ("sigma_a", "scattering"), [(0.02, 1.0), (0.1, 2.5), (0.5, 3.0), (0.9, 2.4)]
)
def test_nearest_medium_of_homogeneous_medium_is_itself(sigma_a, scattering):
    """Photons' noise on every fiber; the fit's error is a fraction of one fiber's."""
    value, _ = FiberTable.load().profile(sigma_a, scattering, FIBERS)
    noise = 0.01
    noisy = value * (1.0 + noise * np.random.default_rng(3).standard_normal(28))
    fit = fit_homogeneous_medium(noisy, FIBERS)
    true = math.sqrt(3.0 * sigma_a * (sigma_a + scattering))
    # 1 % noise in 10 or more fibers over at least 2 mm: sigma_tr to well under a per cent
    assert fit.sigma_tr_per_mm == pytest.approx(true, rel=0.02)
    assert abs(math.log(fit.sigma_a_per_mm / sigma_a)) < 0.1
    assert fit.residual == pytest.approx(noise, rel=0.6)
    assert fit.fibers == int((value >= MIN_REFLECTANCE_PER_MM2).sum())


def test_the_fit_finds_out_a_wrong_medium():
    value, _ = FiberTable.load().profile(0.1, 2.0, FIBERS)
    other, _ = FiberTable.load().profile(0.11, 2.0, FIBERS)
    told = fit_homogeneous_medium(other, FIBERS)
    assert abs(told.sigma_a_per_mm / 0.1 - 1.0) > 0.08
    bent = fit_homogeneous_medium(value * (1.0 + 0.3 * np.cos(np.arange(28.0))), FIBERS)
    assert bent.residual > 0.15


def test_factor_is_free_only_where_layer_may_dim():
    value, _ = FiberTable.load().profile(0.1, 2.0, FIBERS)
    free, fixed = (
        fit_homogeneous_medium(0.5 * value, FIBERS, dimmed=dimmed) for dimmed in (True, False)
    )
    assert free.factor == pytest.approx(0.5, rel=1e-3)
    assert free.residual < 1e-3
    # half the light at all distances is not what any medium gives
    assert fixed.factor == 1.0
    assert fixed.residual > 0.05


def test_unfittable_profile_is_refused():
    with pytest.raises(FitError, match="bright"):
        fit_homogeneous_medium(np.full(28, 1e-9), FIBERS)
    with pytest.raises(FiberTableError, match="inside the table"):
        FiberTable.load().profile(0.1, 9.0, FIBERS)


def test_truth_of_gray_medium_is_its_own(tmp_path):
    scene = ProbeScene(RIG, HomogeneousTissue(0.1, 2.0), photons=1)
    truth = ground_truth(scene, [ProbePlacement("cheek", 1, 22.5, 59.0)])
    (entry,) = truth.parameters["profiles"]
    assert (entry["site"], entry["repeat"], entry["angle_deg"]) == ("cheek", 1, 22.5)
    assert entry["sigma_a_per_mm"] == [0.1] * 3
    assert entry["sigma_tr_per_mm"] == pytest.approx([math.sqrt(0.3 * 2.1)] * 3)
    reflectance, error = (np.array(entry[n]) for n in ("reflectance_per_mm2", "stderr"))
    assert reflectance.shape == error.shape == (28, 3)
    assert (error < 0.01 * reflectance).all()
    # nothing but JSON values, and a folder without maps
    assert store.read(store.write(tmp_path / "TRUTH", truth)).parameters == json.loads(
        json.dumps(truth.parameters)
    )
    np.testing.assert_allclose(truth.parameters["spots_px"], scene.build.spot_px)
    assert np.array(truth.parameters["crosstalk"]).shape == (28, 28)


def test_truth_of_spectral_medium_is_between_its_wavelengths():
    scene = ProbeScene(RIG, PHANTOM_BLOCK, photons=1)
    (entry,) = ground_truth(scene, [ProbePlacement("phantom", 0, 0.0, 60.0)]).parameters["profiles"]
    sigma_a = np.array(PHANTOM_BLOCK.sigma_a_per_mm)
    for value in entry["sigma_a_per_mm"]:
        assert 0.98 * sigma_a.min() < value < 1.02 * sigma_a.max()
    assert max(entry["fit_residual"]) < 0.02
    assert entry["sigma_s_prime_per_mm"] == sorted(entry["sigma_s_prime_per_mm"])
