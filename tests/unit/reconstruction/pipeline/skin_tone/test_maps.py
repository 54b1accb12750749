"""Maps of skin tone: color through a calibrated camera, its errors, and what is not computed."""

from functools import partial

import numpy as np
import pytest

from capture.calibration.color import chart_reference, fit_matrix, neutral_white
from capture.calibration.color.colorimetry import delta_e_2000
from model import skin_tone, spectra
from model.skin import SkinMap
from reconstruction.pipeline import graph
from reconstruction.pipeline.skin_tone import maps as tone
from reconstruction.pipeline.skin_tone.maps import SkinReflectance, ToneCamera
from rigsim.subject.pigment import typical_blood
from rigsim.targets.flat import chart_reflectances
from rigsim.tissue.skin_layers import TissueProperties
from rigsim.tissue.skin_table import SkinTable

LIGHT = "D55"
NIKON = "Nikon 5100 (NPL)"
WHITE = np.array([0.4, 0.8, 0.55])


def calibrated(camera, method="linear"):
    """Return matrix and white of a camera that a chart calibrates without noise."""
    patches = chart_reflectances() @ spectra.band_weights(camera, LIGHT) * WHITE
    white = neutral_white(patches).value
    reference = chart_reference(LIGHT)
    return fit_matrix(patches, reference, white=white, illuminant=LIGHT, method=method), white


@pytest.fixture(scope="module")
def skin():
    """Spectra from light to dark of a tissue other than the typical one."""
    tissue = TissueProperties(epidermis_mm=0.065, oxygenation=0.6, scattering_slope=1.1)
    melanin = np.geomspace(0.006, 0.3, 60)
    return SkinTable.load(tissue).spectra(melanin, [typical_blood(value) for value in melanin])


@pytest.mark.parametrize("method", ["linear", "root_polynomial"])
@pytest.mark.parametrize("camera", spectra.camera_names())
def test_typology_angle_is_within_two_degrees(camera, method, skin):
    matrix, white = calibrated(camera, method)
    truth = skin_tone.ita(skin_tone.lab_of_spectra(skin + skin_tone.sphere_specular()))
    rgb = skin @ spectra.band_weights(camera, LIGHT)
    lab, _ = ToneCamera.of(camera, LIGHT, matrix, white).lab(rgb, np.zeros_like(rgb))
    assert np.abs(skin_tone.ita(lab) - truth).max() < 2.0
    if camera != spectra.LINEAR_SRGB:  # the matrix alone fails
        plain = matrix.to_linear_srgb((rgb + skin_tone.sphere_specular()) * white)
        assert np.abs(skin_tone.ita(skin_tone.lab(plain)) - truth).max() > 3.0


def test_omitted_surface_reflection_shifts_typology_angle(skin, monkeypatch):
    matrix, white = calibrated(NIKON)
    rgb = skin @ spectra.band_weights(NIKON, LIGHT)
    camera = ToneCamera.of(NIKON, LIGHT, matrix, white)
    with_it, _ = camera.lab(rgb, np.zeros_like(rgb))
    monkeypatch.setattr(tone, "SURFACE_REFLECTION", 0.0)
    without, _ = camera.lab(rgb, np.zeros_like(rgb))
    assert (with_it[:, 0] > without[:, 0]).all()
    assert np.abs(skin_tone.ita(with_it) - skin_tone.ita(without)).max() > 2.0


@pytest.mark.parametrize("method", ["linear", "root_polynomial"])
def test_noise_covariance_agrees_with_drawn_noise(method):
    rng = np.random.default_rng(4)
    matrix, white = calibrated(NIKON, method)
    camera = ToneCamera.of(NIKON, LIGHT, matrix, white)
    rgb = np.tile([0.45, 0.3, 0.22], (20_000, 1))
    sd = np.array([0.004, 0.003, 0.003])
    noisy, _ = camera.lab(rgb + sd * rng.normal(size=rgb.shape), np.zeros_like(rgb))
    drawn = np.cov(noisy.T)
    _, with_noise = camera.lab(rgb[:1], np.square(sd)[None])
    _, without = camera.lab(rgb[:1], np.zeros((1, 3)))
    np.testing.assert_allclose((with_noise - without)[0], drawn, rtol=0.06, atol=0.01)


def test_matrix_errors_leave_white_exact():
    matrix, white = calibrated(NIKON)
    free = ToneCamera.of(NIKON, LIGHT, matrix, white)
    uncertain = ToneCamera(free.correction, matrix, white)  # all of the jackknife
    exact = ToneCamera(free.correction, free.matrix, white)
    neutral = np.full((1, 3), 0.4)
    skin_color = np.array([[0.45, 0.3, 0.22]])

    def added(rgb):
        return uncertain.lab(rgb, np.zeros((1, 3)))[1] - exact.lab(rgb, np.zeros((1, 3)))[1]

    assert np.abs(added(neutral)).max() < 1e-3
    assert added(skin_color)[0, 1, 1] > 0.05


def test_camera_without_chart_is_less_certain():
    sigma = "Sigma SDMerill (NPL)"
    matrix, white = calibrated(sigma)
    rgb = np.array([[0.45, 0.3, 0.22]])

    def angle_error(color_matrix, neutral):
        camera = ToneCamera.of(sigma, LIGHT, color_matrix, neutral)
        return skin_tone.ita_stderr(*camera.lab(rgb, np.zeros((1, 3))))[0]

    assert angle_error(None, None) > 1.5 * angle_error(matrix, white)


def skin_image(side=24):
    rows = np.linspace(0.1, 0.6, side)[:, None, None]
    values = np.broadcast_to(rows * np.array([1.0, 0.66, 0.48]), (side, side, 3)).astype(np.float32)
    valid = np.ones((side, side), bool)
    valid[:, 0] = False
    return SkinMap(values, "1", 0.01 * values, valid)


def run(want, *, refused="", diffuse=None):
    """Run the stages of tone after a stage that yields reflectance."""
    stage = graph.make_stage_factory({"revision": 1})
    given = SkinReflectance.of_map(diffuse or skin_image())
    source = stage("source", "", tone.REFLECTANCE_PRODUCT, lambda: given)
    made = tone.tone_stages(stage, (None, None), refused=refused, camera=NIKON, illuminant=LIGHT)
    return graph.run_stages([source, *made], want)


def test_unasked_maps_are_left_out():
    outcome = run(["ita"])
    assert outcome.ran == ("source", "lab", "ita")
    assert {name for name, _ in outcome.omitted} == {"monk", "melanin_index"}
    assert outcome.products["ita"].unit == "degree"
    assert not outcome.products["ita"].mask[:, 0].any()


def test_maps_of_unknown_brightness_are_refused():
    with pytest.raises(graph.StageError, match="unknown brightness"):
        run(["monk"], refused="unknown brightness")


def test_monk_interval_contains_tone_and_widens():
    found = run(["monk", "monk_low", "monk_high", "lab"]).products
    tones = [found[name].values[:, 1:] for name in ("monk_low", "monk", "monk_high")]
    assert (tones[0] <= tones[1]).all()
    assert (tones[1] <= tones[2]).all()
    assert len(np.unique(tones[1])) > 2
    image = skin_image()
    noisy = SkinMap(image.values, "1", 0.2 * image.values, image.valid)
    wide = run(["monk_low", "monk_high"], diffuse=noisy).products
    widths = wide["monk_high"].values - wide["monk_low"].values
    assert widths[:, 1:].mean() > (tones[2] - tones[0]).mean() + 0.3


def test_rounded_monk_tone_differs_only_at_ties():
    rng = np.random.default_rng(8)
    colors = np.column_stack(
        [rng.uniform(10, 95, 4000), rng.uniform(0, 20, 4000), rng.uniform(0, 30, 4000)]
    )
    exact = skin_tone.monk(colors, delta_e_2000)
    found = tone.nearest_monk_tone(colors)
    off = np.flatnonzero(found != exact)
    assert off.size < 0.03 * len(colors)
    scale = skin_tone.monk_colors()
    nearest = delta_e_2000(colors[off], scale[exact[off] - 1])
    chosen = delta_e_2000(colors[off], scale[found[off] - 1])
    assert (chosen - nearest).max() < 0.9


def test_erythema_index_ignores_shading_and_masks_black():
    image = skin_image()
    values = image.values.copy()
    values[0, 1] = 0.0
    given = SkinReflectance.of_map(SkinMap(values, "1", image.stderr, image.valid))
    index = tone.erythema_map(given)
    known = index.values[index.mask]
    np.testing.assert_allclose(known, 100 * np.log10(1 / 0.66), atol=1e-3)
    np.testing.assert_allclose(
        index.stderr[index.mask], 100 / np.log(10) * 0.01 * 2**0.5, rtol=1e-4
    )
    assert not index.mask[0, 1]
    melanin = tone.melanin_index_map(SkinReflectance.of_map(image))
    assert np.ptp(melanin.values[melanin.mask]) > 50.0  # shading does not cancel here


def test_division_by_light_undoes_shading():
    image = SkinReflectance.of_map(skin_image())
    rows = np.log(image.rgb[..., 0])
    known = np.ones(image.valid.shape, bool)
    known[-1] = False
    flat = image.in_light(rows, np.full_like(rows, 0.05**2), known)
    assert np.ptp(tone.melanin_index_map(flat).values[flat.valid]) < 1e-3
    assert np.ptp(tone.melanin_index_map(image).values[flat.valid]) > 50.0
    assert not flat.valid[-1].any()
    error = tone.melanin_index_map(flat).stderr[flat.valid]
    np.testing.assert_allclose(error, 100 / np.log(10) * np.hypot(0.01, 0.05), rtol=1e-3)


def test_common_error_moves_all_channels_together():
    rng = np.random.default_rng(9)
    matrix, white = calibrated(NIKON)
    camera = ToneCamera.of(NIKON, LIGHT, matrix, white)
    rgb = np.array([[0.45, 0.3, 0.22]])
    drawn = camera.lab(rgb * np.exp(0.03 * rng.normal(size=(20_000, 1))), np.zeros((1, 3)))[0]
    with_it = camera.lab(rgb, np.zeros((1, 3)), 0.03**2)[1]
    without = camera.lab(rgb, np.zeros((1, 3)))[1]
    np.testing.assert_allclose((with_it - without)[0], np.cov(drawn.T), rtol=0.06, atol=0.02)
    # the same variance in each channel alone moves the hue as well
    alone = camera.lab(rgb, np.square(0.03 * rgb))[1]
    assert alone[0, 1, 1] - without[0, 1, 1] > 5.0 * (with_it - without)[0, 1, 1]


def test_smallest_relative_error_becomes_common():
    image = SkinReflectance.of_map(
        SkinMap(
            np.full((1, 1, 3), 0.5, np.float32),
            "1",
            np.array([[[0.01, 0.02, 0.05]]], np.float32),
            np.ones((1, 1), bool),
        )
    ).with_common_errors()
    assert np.sqrt(image.log_variance[0, 0]) == pytest.approx(0.02)
    total = image.variance + image.log_variance[..., None] * np.square(image.rgb)
    np.testing.assert_allclose(np.sqrt(total[0, 0]), [0.01, 0.02, 0.05], rtol=1e-4)


def test_albedo_becomes_reflectance_at_normal_incidence():
    """Fresnel's equations written out: light enters along the normal and leaves everywhere."""
    cosine = (np.arange(20_000) + 0.5) / 20_000
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / 1.4**2)
    s = (cosine - 1.4 * inside) / (cosine + 1.4 * inside)
    p = (1.4 * cosine - inside) / (1.4 * cosine + inside)
    transmitted = 1.0 - 0.5 * (s**2 + p**2)
    expected = (1.0 - (0.4 / 2.4) ** 2) * np.mean(2.0 * cosine * transmitted)
    image = skin_image()
    found = tone.reflectance_of_albedo(image)
    ratio = found.rgb[found.valid] / image.values[found.valid]
    np.testing.assert_allclose(ratio, expected, rtol=1e-3)
    np.testing.assert_allclose(np.sqrt(found.log_variance[found.valid]), 0.01, rtol=1e-3)
    assert found.variance[found.valid].max() < 1e-9


def test_empty_image_gives_empty_maps():
    image = skin_image()
    blank = SkinMap(image.values, "1", image.stderr, np.zeros(image.mask.shape, bool))
    camera = partial(ToneCamera.of, NIKON, LIGHT, None, None)
    made = tone.lab_map(camera, SkinReflectance.of_map(blank))
    assert not made["lab"].mask.any()
    assert not tone.monk_maps(made["lab"], made["lab_covariance"])["monk"].values.any()
