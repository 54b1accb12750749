"""Properties of the signals of several rigs and of the skin that they determine."""

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from model.tissue_optics import skin_spectra
from reconstruction.fusion import consistency, patch_normals, person, regions, signals, texels
from skinrig.benchmarks.fusion import people

FEW = settings(derandomize=True, deadline=None, database=None)
RIGS = (
    signals.RigBands("dome", "Nikon 5100 (NPL)", "LED-B3"),
    signals.RigBands("flash", "Nikon 5100 (NPL)", "D55"),
)
SKIN = st.tuples(st.floats(-3.0, 0.0), st.floats(-5.5, -3.0)).map(np.array)
PROPERTIES = st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6).map(np.array)


@settings(FEW, max_examples=10)
@given(SKIN, PROPERTIES)
def test_signals_fall_with_melanin_and_blood(skin, properties):
    _, slopes, _ = signals.evaluate_signals(RIGS, skin[None], properties)
    assert (slopes < 0.0).all()
    assert np.allclose(signals.clip_to_range(skin), skin)


@settings(FEW, max_examples=10)
@given(SKIN, PROPERTIES)
def test_far_light_follows_least_absorbed_wavelengths(skin, properties):
    probe = signals.RigBands("probe", "Nikon 5100 (NPL)", "LED-B3", "sigma_tr")
    seen = np.exp(probe.log_signals(signals.skin_of_person(skin, properties)))
    pressed = skin + np.log([1.0, signals.PRESSED_BLOOD[0]])
    nm = probe.bands.wavelength_nm
    each = np.exp(skin_spectra.log_sigma_tr(nm, signals.skin_of_person(pressed, properties)))
    # the slope of light's logarithm along the distance, of each channel
    r = signals.SIGMA_TR_DISTANCE_MM + np.array([[-1e-4], [1e-4]])
    light = np.log(np.exp(-r * each) @ probe.bands.weights)
    expected = (light[0] - light[1]) / 2e-4 * np.exp(signals.SIGMA_TR_OFFSET)
    assert np.allclose(seen, expected, rtol=1e-5)
    assert (seen < each @ probe.bands.weights).all()


@settings(FEW, max_examples=10)
@given(SKIN, PROPERTIES)
def test_sigma_tr_rises_with_blood(skin, properties):
    less, more = (
        skin_spectra.log_sigma_tr([450.0, 550.0], signals.skin_of_person(skin + step, properties))
        for step in ([0.0, 0.0], [0.0, 0.1])
    )
    assert (more > less).all()


@settings(FEW, max_examples=10)
@given(SKIN)
def test_unexplained_covariance_is_positive(skin):
    found = signals.residual_covariance(RIGS, skin)
    assert np.allclose(found, found.T)
    assert np.linalg.eigvalsh(found)[0] > 0.0
    hidden = regions.hide_signals(found, np.array([True] * 3 + [False] * 3))
    assert (np.diag(hidden)[:3] >= person.UNKNOWN_VARIANCE).all()


@settings(FEW, max_examples=5)
@given(SKIN, PROPERTIES)
def test_exact_colors_have_no_faulty_rig(skin, properties):
    values, _, _ = signals.evaluate_signals(RIGS, np.tile(skin, (30, 1)), properties)
    unexplained = signals.residual_covariance(RIGS, skin)
    errors = texels.OffsetModel(unexplained, 1e-4 * np.eye(6), 0.25 * unexplained)
    every, own = np.ones(30, bool), np.tile(1e-4 * np.eye(3), (30, 1, 1))
    colors = [
        texels.RigColors(k, values[:, 3 * k : 3 * k + 3], own, every) for k in range(len(RIGS))
    ]
    summary, kept = regions.summarize_regions(colors, np.zeros(30, int), errors)
    assert kept.tolist() == [0]
    found = person.estimate_person(RIGS, summary, errors.offset_covariance)
    checks = consistency.check_rigs(RIGS, summary, errors, found)
    assert consistency.name_faulty_rig(checks) is None
    ((_, one),) = texels.estimate_texels(found, colors, errors)
    assert np.ptp(one.log_skin, axis=0).max() < 1e-9


@settings(FEW, max_examples=20)
@given(PROPERTIES)
def test_depth_factor_rises_with_eumelanin(properties):
    more = properties + 0.1 * (np.arange(6) == 5)
    assert texels.melanin_depth_factor(more) >= texels.melanin_depth_factor(properties)
    assert texels.eumelanin_slope() > 0.0


@settings(FEW, max_examples=10)
@given(st.floats(-80.0, 80.0), st.floats(-0.2, 0.2))
def test_rotation_of_patch_adds_to_its_estimate(degrees, tilt):
    drawn = people.draw_patch(np.random.default_rng(3))
    angle = np.radians(degrees)
    cos, sin = np.cos(angle), np.sin(angle)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    turned = replace(drawn, normals=drawn.normals @ turn.T)
    found = [patch_normals.check_patch(one).rotation_rad for one in (drawn, turned)]
    off = (found[1] - found[0] - angle + np.pi / 2) % np.pi - np.pi / 2
    assert abs(off) < 1e-6
    flat = patch_normals.SurfaceFrame(np.zeros(3), np.eye(3), np.zeros((2, 2)), np.eye(2))
    normals = patch_normals.fuse_patch(turned, flat, cutoff_um=4e3).normals
    assert np.allclose(np.linalg.norm(normals, axis=-1), 1.0)
    # the frame's tilt is the only one: a patch seen askew has the same detail about it
    slopes = turned.slopes + np.array([tilt, 0.0])
    askew = np.concatenate([-slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    again = patch_normals.fuse_patch(replace(turned, normals=askew), flat, cutoff_um=4e3).normals
    assert np.allclose(normals, again, atol=1e-6)
