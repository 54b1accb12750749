"""Tissues under the probe by site and suction."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from capture.calibration.fiber.phantom import read_certificate
from capture.rig import load_rig
from rigsim.fiber import probe_profile, probe_tissue
from rigsim.fiber.probe_profile import ProfileCache, probe_fibers, smooth_profile
from rigsim.fiber.probe_tissue import (
    PHANTOM_BLOCK,
    FibrousTissue,
    HomogeneousTissue,
    SkinTissue,
    TissueError,
    make_phantom,
    parse_tissue,
    phantom_certificate,
)
from rigsim.fiber.profile import trace_fiber_paths, trace_fiber_profile
from rigsim.subject import tissue_pressure
from rigsim.subject.person_skin import PersonSkin, layers
from rigsim.tissue import skin_layers

RIG = load_rig("probe")
FALSE_ALARM = 4.5  # standard deviations; of some 100 normal values one in 1500 runs exceeds it


def test_suction_reduces_blood_to_residual_level():
    skin = SkinTissue(PersonSkin.of_preset("III", seed=4))
    blood = [skin.blood("cheek", p) for p in (0.0, 3.0, 30.0, 60.0, 1e4)]
    assert blood[0] == blood[1] > blood[2] > blood[3] > blood[4]
    rest = blood[4] / tissue_pressure.INCOMPRESSIBLE_BLOOD_FRACTION
    assert blood[2] == pytest.approx(rest * (0.25 + 0.75 * math.exp(-1.0)))
    assert skin.blood("chin", 60.0) > 1.5 * skin.blood("abdomen", 60.0)


def test_probed_skin_is_that_of_the_face():
    """Without pressure and at rest: the layers of the same person's cheek."""
    person = PersonSkin.of_preset("IV", seed=4)
    optics = SkinTissue(person).optics("cheek", 0.0, 0.0)
    kept = SkinTissue(person).blood("cheek", 0.0) / person.at("cheek").c_hd
    for index, nm in enumerate(optics.wavelength_nm):
        face = layers(person, "cheek", "neutral", nm).layers
        top, deep = (layer.sigma_a_per_mm for layer in optics.stacks[index].layers)
        assert top == pytest.approx(face[0].sigma_a_per_mm, rel=1e-12)
        bloodless = skin_layers.baseline_per_mm(nm)
        at_rest = (deep + optics.amount * optics.absorber[index, 1] - bloodless) / kept
        assert at_rest == pytest.approx(face[1].sigma_a_per_mm - bloodless, rel=1e-9)


def test_layers_contain_requested_melanin_and_blood():
    skin = SkinTissue(PersonSkin.of_preset("III", seed=4))
    optics = skin.optics("cheek", 0.0, 60.0)
    index = optics.wavelength_nm.index(560.0)
    got = [layer.sigma_a_per_mm for layer in optics.stacks[index].layers]
    got += optics.amount * optics.absorber[index]
    whole = skin_layers.skin_layer_stack(560.0, skin.melanin("cheek"), skin.blood("cheek", 60.0))
    assert got == pytest.approx([layer.sigma_a_per_mm for layer in whole.layers], rel=1e-12)
    assert optics.stacks[index].layers[0].thickness_mm == skin.epidermis_mm("cheek")


@pytest.mark.long
def test_profile_under_suction_uses_reduced_blood():
    """Reweighted paths against photons of the layers themselves."""
    skin = SkinTissue(PersonSkin.of_preset("II", seed=4))
    profiles = ProfileCache(RIG, skin, photons=12_000, seed=2, threads=1)
    optics = skin.optics("cheek", 0.0, 10.0)
    run = profiles._trace(optics)
    weighed = run.profile(optics.amount)
    stacks = [
        skin_layers.skin_layer_stack(nm, skin.melanin("cheek"), skin.blood("cheek", 10.0))
        for nm in optics.wavelength_nm
    ]
    spectral = profiles.spectral_stack(
        probe_tissue.TissueOptics(optics.wavelength_nm, tuple(stacks), None, 0.0)
    )
    own = trace_fiber_profile(
        spectral, radii_mm=RIG.probe.radius_mm, photons=12_000, rng=np.random.default_rng(9)
    )

    def worst(one):
        # within 3 mm: beyond it some errors are themselves told by a few photons
        gap = one.reflectance_per_mm2 - own.reflectance_per_mm2
        return np.abs(gap / np.hypot(one.stderr, own.stderr))[:11].max()

    # 33 values of Student's t of 19 or more degrees of freedom: one in 100 runs exceeds this
    assert worst(weighed) < 5.0
    assert worst(run.profile(10.0 * optics.amount)) > 5.0


def test_profiles_do_not_depend_on_earlier_requests():
    def made(sites):
        profiles = ProfileCache(
            RIG, SkinTissue(PersonSkin.of_preset("II")), photons=200, seed=3, threads=1
        )
        return [profiles.profile(site, 0.0, 60.0).reflectance_per_mm2 for site in sites]

    np.testing.assert_array_equal(made(["cheek"])[0], made(["chin", "cheek"])[1])


def test_reflectance_is_zero_unscattered_and_maximal_unabsorbed():
    none = ProfileCache(RIG, HomogeneousTissue(0.1, 0.0), photons=100, seed=0).profile("cheek")
    assert (none.reflectance_per_mm2 == 0.0).all()
    clear, grey = (
        ProfileCache(RIG, HomogeneousTissue(a, 1.5), photons=100, seed=0).profile("cheek")
        for a in (0.0, 0.01)
    )
    assert (clear.reflectance_per_mm2 > grey.reflectance_per_mm2).all()


def test_rotated_head_on_anisotropic_tissue_rotates_profile():
    photons = 10_000
    tissue = FibrousTissue(0.05, 1.5, -1.0, 45.0)
    profiles = ProfileCache(RIG, tissue, photons=photons, seed=1, threads=1)
    along, across, between, again = (
        profiles.profile("abdomen", angle).reflectance_per_mm2[:, 0]
        for angle in (45.0, 135.0, 67.0, 225.0)
    )
    ratio = np.log(along / across)
    # light comes out across the fibers near the source, and goes farther along them
    assert ratio[:4].mean() < -0.2
    assert ratio[20:].mean() > 0.2
    np.testing.assert_allclose(again, along, rtol=1e-9)
    turned = ProfileCache(RIG, FibrousTissue(0.05, 1.5, -1.0, 0.0), photons=photons, seed=1)
    error = turned.profile("abdomen", 22.0).stderr[:, 0]
    other = turned.profile("abdomen", 22.0).reflectance_per_mm2[:, 0]
    assert np.abs((between - other) / (math.sqrt(2.0) * error)).max() < 6.0
    assert np.abs((along - across) / error).max() > 6.0


def test_phantom_deviates_from_certificate_below_two_uncertainties():
    paper = phantom_certificate()
    exact = make_phantom(paper, deviations=(0.0, 0.0))
    for name, key in (("sigma_a_per_mm", "sigma_a"), ("sigma_s_prime_per_mm", "sigma_s_prime")):
        ratio = np.array(getattr(PHANTOM_BLOCK, name)) / np.array(getattr(exact, name))
        assert 0.0 < abs(ratio - 1.0).max() < 2.0 * paper["uncertainty"][key]


def test_certificate_is_readable_by_calibration(tmp_path):
    path = tmp_path / "phantom.json"
    path.write_text(json.dumps(phantom_certificate()), encoding="utf-8")
    read = read_certificate(path)
    sigma_a, scattering = read.at(PHANTOM_BLOCK.wavelength_nm)
    exact = make_phantom(phantom_certificate(), deviations=(0.0, 0.0))
    np.testing.assert_allclose(exact.sigma_a_per_mm, sigma_a)
    np.testing.assert_allclose(exact.sigma_s_prime_per_mm, scattering)
    assert (read.g, read.eta) == (PHANTOM_BLOCK.g, PHANTOM_BLOCK.eta)


def test_smoothing_lowers_noise_with_residual_within_stated_error():
    rng = np.random.default_rng(5)
    radii = np.array(probe_fibers(RIG.probe).radii_mm)
    true = np.exp(-radii) / (radii * (radii + 0.5))
    noisy = true[:, None] * rng.normal(1.0, 0.05 * math.sqrt(20), (20, 28, 1))
    smooth, error = smooth_profile(radii, np.maximum(noisy, 0.0))
    z = (smooth - true[:, None]) / error
    assert np.sqrt(np.mean(z**2)) < 2.0
    assert np.mean(error / smooth) < 0.04


def test_wrong_subjects_are_refused():
    for text in (
        "",
        "VII",
        "homogeneous",
        "homogeneous:1",
        "homogeneous:a,b",
        "homogeneous:-1,2",
        "anisotropic:0,1",
    ):
        with pytest.raises(TissueError):
            parse_tissue(text)
    assert parse_tissue("homogeneous:0.1,2,0.9").g == 0.9
    with pytest.raises(TissueError, match="site"):
        SkinTissue(PersonSkin.of_preset("III")).optics("elbow", 0.0, 60.0)


def test_scenes_of_one_seed_share_photons(monkeypatch):
    traced = []

    def trace(*args, **settings):
        traced.append(settings["photons"])
        return trace_fiber_paths(*args, **settings)

    monkeypatch.setattr(probe_profile, "trace_fiber_paths", trace)
    skin = parse_tissue("II", seed=87)

    def profile(tissue, seed):
        cache = ProfileCache(RIG, tissue, photons=500, seed=seed, threads=1)
        return cache.profile("chin").reflectance_per_mm2

    first, again = (profile(parse_tissue("II", seed=87), 5) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert len(traced) == 1
    assert (profile(skin, 6) != first).any()
    assert (profile(parse_tissue("II", seed=88), 5) != first).any()
    assert len(traced) == 3
