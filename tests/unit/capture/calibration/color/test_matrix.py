import csv
import os
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from capture.calibration import store
from capture.calibration.color import colorimetry
from capture.calibration.color import matrix as color
from capture.calibration.color.chart import ChartError, find_chart, measure_patches
from capture.calibration.color.matrix import fit_matrix

DATA = Path(os.environ.get("SKINRIG_TEST_DATA", Path(__file__).parents[6] / "shared" / "data"))
needs_data = pytest.mark.skipif(
    not (DATA / "colorchecker").is_dir(), reason="needs the shared test data (SKINRIG_TEST_DATA)"
)

CAMERA = np.array([[0.9, 0.15, 0.02], [-0.25, 1.1, 0.1], [0.05, -0.1, 0.8]])  # XYZ -> camera


def draw_chart(patch_px, *, rng, angle_rad=0.0, noise=0.003, size=None, camera=CAMERA):
    """A ColorChecker on a gray table, seen by a linear camera; returns image and true centers."""
    width, height = size or (int(9.5 * patch_px), int(7.5 * patch_px))
    y, x = np.mgrid[:height, :width].astype(float)
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    u = (c * (x - width / 2) + s * (y - height / 2)) / patch_px + 2.5
    v = (-s * (x - width / 2) + c * (y - height / 2)) / patch_px + 1.5
    image = np.full((height, width, 3), 0.25) * (1 + 0.1 * np.sin(x / 37 + y / 23))[..., None]
    image[(np.abs(u - 2.5) < 3.2) & (np.abs(v - 1.5) < 2.3)] = 0.02
    rgb = colorimetry.chart_reference("D50") @ camera.T
    column, row = np.rint(u), np.rint(v)
    patch = (np.abs(u - column) < 0.435) & (np.abs(v - row) < 0.435)
    patch &= (column >= 0) & (column < 6) & (row >= 0) & (row < 4)
    image[patch] = rgb[(6 * row + column)[patch].astype(int)]
    image += noise * rng.normal(size=image.shape)
    du, dv = (g.ravel() for g in np.meshgrid(np.arange(6) - 2.5, np.arange(4) - 1.5))
    centers = np.stack(
        [width / 2 + patch_px * (c * du - s * dv), height / 2 + patch_px * (s * du + c * dv)], 1
    )
    return image, centers


@pytest.mark.parametrize("angle_deg", [0, 7, 90, 180, 270, 200])
@pytest.mark.parametrize("patch_px", [14, 40])
def test_the_chart_is_found_at_any_orientation(angle_deg, patch_px):
    rng = np.random.default_rng(1)
    image, truth = draw_chart(
        patch_px, rng=rng, angle_rad=np.deg2rad(angle_deg), size=(10 * patch_px, 10 * patch_px)
    )
    centers = find_chart(image)
    assert np.abs(centers - truth).max() < 0.12 * patch_px


def test_refined_centers_are_exact_to_fiftieth_of_patch():
    image, truth = draw_chart(50, rng=np.random.default_rng(2), angle_rad=0.03)
    assert np.abs(find_chart(image) - truth).max() < 1.0


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_the_chart_is_found_whatever_the_number_type(dtype):
    image, truth = draw_chart(40, rng=np.random.default_rng(3))
    top = {np.uint8: 255, np.uint16: 16383, np.float32: 1.0}[dtype]
    shown = np.clip(image, 0, 1) * top
    before = shown.astype(dtype)
    centers = find_chart(before)
    assert np.abs(centers - truth).max() < 4
    np.testing.assert_array_equal(before, shown.astype(dtype))


def test_a_mirrored_chart_is_refused():
    image, _ = draw_chart(40, rng=np.random.default_rng(3))
    with pytest.raises(ChartError, match="mirrored"):
        find_chart(image[:, ::-1])


def test_given_corner_patches_replace_detection():
    image, truth = draw_chart(40, rng=np.random.default_rng(3))
    centers = find_chart(image, corners=truth[[0, 5, 23, 18]] + 3.0)
    assert np.abs(centers - truth).max() < 1.0


def test_wrong_corner_patches_are_refused():
    image, truth = draw_chart(40, rng=np.random.default_rng(3))
    with pytest.raises(ChartError, match="colors"):
        find_chart(image, corners=truth[[0, 5, 23, 18]] * 0.3)
    with pytest.raises(ChartError, match="edge"):
        find_chart(image, corners=truth[[0, 5, 23, 18]] * 2)


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (np.zeros((80, 80, 3)), "black"),
        (np.ones((80, 80)), "shape"),
        (np.ones((8, 80, 3)), "too small"),
        (np.random.default_rng(0).random((90, 120, 3)), "no ColorChecker"),
    ],
)
def test_image_without_chart_gives_single_clear_error(image, says):
    with pytest.raises(ChartError, match=says):
        find_chart(image)


def test_saturated_patch_is_omitted_and_others_are_exact():
    rng = np.random.default_rng(4)
    image, truth = draw_chart(40, rng=rng)
    valid = np.ones(image.shape[:2], bool)
    x, y = truth[18].astype(int)
    valid[y, x] = False
    patches = measure_patches(image, truth, valid=valid)
    assert patches.valid.sum() == 23
    assert np.isnan(patches.rgb[18]).all()
    expected = colorimetry.chart_reference("D50") @ CAMERA.T
    z = ((patches.rgb - expected) / patches.stderr)[patches.valid]
    assert np.abs(z).max() < 5  # 69 normal numbers: false-alarm rate 4e-5
    assert 0.7 < z.std() < 1.3


@pytest.mark.parametrize("method", ["linear", "root_polynomial"])
def test_camera_linear_in_eye_response_is_recovered_exactly(method):
    xyz = colorimetry.chart_reference("D55")
    fit = fit_matrix(7.0 * xyz @ CAMERA.T, xyz, method=method, illuminant="D55")
    assert fit.max_delta_e < 1e-6
    np.testing.assert_allclose(fit.matrix[:, :3], np.linalg.inv(CAMERA) / 7.0, atol=1e-8)


@pytest.mark.parametrize("method", ["linear", "root_polynomial"])
def test_the_color_map_does_not_change_with_exposure(method):
    rng = np.random.default_rng(5)
    xyz = colorimetry.chart_reference()
    rgb = np.abs(xyz @ CAMERA.T + 0.01 * rng.normal(size=(24, 3)))
    fit = fit_matrix(rgb, xyz, method=method)
    np.testing.assert_allclose(fit.apply(3.0 * rgb), 3.0 * fit.apply(rgb), rtol=1e-12)


@pytest.mark.parametrize("method", ["linear", "root_polynomial"])
def test_a_given_white_is_kept_exactly(method):
    rng = np.random.default_rng(6)
    xyz = colorimetry.chart_reference()
    rgb = np.abs(xyz @ CAMERA.T * (1 + 0.02 * rng.normal(size=(24, 3))))
    white = CAMERA @ colorimetry.white_point("D50")
    fit = fit_matrix(rgb, xyz, method=method, white=white)
    np.testing.assert_allclose(fit.apply(white), colorimetry.white_point("D50"), atol=1e-12)
    np.testing.assert_allclose(fit.to_linear_srgb(white), 1.0, atol=1e-9)
    assert not np.allclose(fit_matrix(rgb, xyz, method=method).apply(white), [0.9642, 1, 0.8252])


def test_held_out_errors_exceed_fit_errors():
    rng = np.random.default_rng(7)
    xyz = colorimetry.chart_reference()
    rgb = np.abs(xyz @ CAMERA.T * (1 + 0.05 * rng.normal(size=(24, 3))))
    for method in ("linear", "root_polynomial"):
        fit = fit_matrix(rgb, xyz, method=method)
        assert fit.mean_delta_e > np.mean(fit.fitted_delta_e)


def test_stated_matrix_errors_cover_the_truth():
    """Rationale: jackknife errors of a matrix from 24 patches with 1 % scatter.

    Expected: coverage of one standard error between 55 % and 85 % (the jackknife is approximate,
    and its nine numbers are correlated: 60 seeds give a standard deviation of 3.3 %).
    """
    truth = np.linalg.inv(CAMERA)
    xyz = colorimetry.chart_reference()
    inside = []
    for seed in range(60):
        rng = np.random.default_rng([11, seed])
        fit = fit_matrix(xyz @ CAMERA.T * (1 + 0.01 * rng.normal(size=(24, 3))), xyz)
        inside.append(np.abs(fit.matrix - truth) < fit.stderr)
    assert 0.55 < np.mean(inside) < 0.85


def test_the_neutral_patches_give_the_camera_white():
    white = color.neutral_white(colorimetry.chart_reference() @ CAMERA.T * 0.5)
    expected = 0.5 * CAMERA @ colorimetry.white_point("D50")
    np.testing.assert_allclose(white.value, expected, rtol=0.03)  # the patches are not quite gray
    assert (white.stderr < 0.02 * expected).all()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda rgb, xyz: (rgb[:5], xyz[:5]), "patches"),
        (lambda rgb, xyz: (rgb, xyz * 100), "Y = 1"),
        (lambda rgb, xyz: (rgb, xyz[:20]), "shapes"),
        (lambda rgb, xyz: (np.repeat(rgb[:, :1], 3, axis=1), xyz), "span"),
        (lambda rgb, xyz: (rgb * [1, 0, 1], xyz), "zero"),
        (lambda rgb, xyz: (np.full_like(rgb, np.nan), xyz), "0 usable"),
    ],
)
def test_unusable_patches_give_a_clear_error(change, says):
    xyz = colorimetry.chart_reference()
    with pytest.raises(ValueError, match=says):
        fit_matrix(*change(xyz @ CAMERA.T, xyz))


def test_lab_and_xyz_invert_each_other():
    rng = np.random.default_rng(8)
    lab = rng.uniform([0, -60, -60], [100, 60, 60], (50, 3))
    white = colorimetry.white_point("D50")
    xyz = colorimetry.xyz_from_lab(lab, white)
    np.testing.assert_allclose(colorimetry.lab_from_xyz(xyz, white), lab, atol=1e-9)


def test_the_lab_jacobian_is_the_derivative():
    white = colorimetry.white_point("D65")
    xyz = np.array([[0.3, 0.4, 0.2], [0.002, 0.003, 0.001]])
    for k in range(3):
        step = 1e-7 * np.eye(3)[k]
        numeric = (
            colorimetry.lab_from_xyz(xyz + step, white)
            - colorimetry.lab_from_xyz(xyz - step, white)
        ) / 2e-7
        np.testing.assert_allclose(
            colorimetry.lab_jacobian(xyz, white)[..., k], numeric, rtol=1e-5, atol=1e-5
        )


def test_srgb_primaries_come_back_from_xyz():
    """IEC 61966-2-1: red is (0.4124, 0.2126, 0.0193)."""
    xyz = [[0.4124, 0.2126, 0.0193], [0.3576, 0.7152, 0.1192], [0.1805, 0.0722, 0.9505]]
    np.testing.assert_allclose(colorimetry.xyz_to_linear_srgb(xyz), np.eye(3), atol=5e-4)


# pairs of Sharma, Wu, Dalal 2005, table 1 (doi 10.1002/col.20070): near blue, the turn of the
# mean hue, near gray, large differences
@pytest.mark.parametrize(
    ("first", "second", "difference"),
    [
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, -1.3802, -84.2814), (50.0, 0.0, -82.7485), 1.0000),
        ((50.0, 0.0, 0.0), (50.0, -1.0, 2.0), 2.3669),
        ((50.0, 2.4900, -0.0010), (50.0, -2.4900, 0.0009), 7.1792),
        ((50.0, 2.4900, -0.0010), (50.0, -2.4900, 0.0011), 7.2195),
        ((50.0, 2.5, 0.0), (50.0, 0.0, -2.5), 4.3065),
        ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
        ((50.0, 2.5, 0.0), (58.0, 24.0, 15.0), 19.4535),
        ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_ciede2000_equals_the_published_pairs_in_both_directions(first, second, difference):
    assert colorimetry.delta_e_2000(first, second) == pytest.approx(difference, abs=5e-5)
    assert colorimetry.delta_e_2000(second, first) == pytest.approx(difference, abs=5e-5)


def test_a_color_does_not_differ_from_itself():
    lab = np.array([[0.0, 0, 0], [50, 30, -20], [100, 0, 0]])
    np.testing.assert_array_equal(colorimetry.delta_e_2000(lab, lab), 0.0)


def test_a_color_calibration_survives_the_disk(tmp_path):
    xyz = colorimetry.chart_reference()
    rgb = xyz @ CAMERA.T * (1 + 0.01 * np.random.default_rng(1).normal(size=(24, 3)))
    fit = fit_matrix(rgb, xyz)
    store.save(
        color.to_calibration(
            fit,
            color.neutral_white(rgb),
            serial="N1",
            rig="flash",
            source="simulated",
            created=date(2026, 11, 21),
        ),
        tmp_path,
    )
    again = color.from_calibration(store.load(tmp_path, "color"), "N1")
    np.testing.assert_array_equal(again.matrix, fit.matrix)
    assert again.mean_delta_e == pytest.approx(fit.mean_delta_e)


@needs_data
@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_chart_in_real_photograph_is_found_and_measured(turns):
    """Expected: the published medians of the patches' middles, to 2 of 255 levels."""
    cv2 = pytest.importorskip("cv2")
    photo = cv2.imread(str(DATA / "colorchecker" / "colorchecker_classic_photo.png"))[..., ::-1]
    with (DATA / "colorchecker" / "classic_patch_centres_and_srgb8.csv").open() as stream:
        rows = np.array([[float(v) for v in row[:5]] for row in list(csv.reader(stream))[1:]])
    image = np.rot90(photo, turns)
    centers = find_chart(image)
    patches = measure_patches(image.astype(float), centers)
    np.testing.assert_allclose(patches.rgb, rows[:, 2:], atol=2.5)
    if turns == 0:
        assert np.abs(centers - rows[:, :2]).max() < 5  # of 82 pixels from patch to patch


@needs_data
def test_real_photograph_fits_chart_within_three_delta_e():
    cv2 = pytest.importorskip("cv2")
    photo = cv2.imread(str(DATA / "colorchecker" / "colorchecker_classic_photo.png"))[..., ::-1]
    s = photo / 255.0
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    patches = measure_patches(linear, find_chart(linear))
    fit = fit_matrix(patches.rgb, colorimetry.chart_reference(), valid=patches.valid)
    assert fit.mean_delta_e < 3.0
    assert fit.max_delta_e < 6.0


@needs_data
def test_retyped_chart_equals_published_chart():
    path = DATA / "colorchecker" / "colorchecker24_lab_d50_xrite_after2014.csv"
    published = np.loadtxt(path, delimiter=",", skiprows=1)
    lab = colorimetry.lab_from_xyz(
        colorimetry.chart_reference("D50"), colorimetry.white_point("D50")
    )
    np.testing.assert_allclose(lab, published, atol=1e-9)


def test_chart_spectra_have_the_chart_reference_colors():
    from model import skin_tone

    wavelength_nm = np.arange(400.0, 701.0, 10.0)
    by_spectra = skin_tone.lab_of_spectra(colorimetry.chart_spectra(wavelength_nm), wavelength_nm)
    white = colorimetry.white_point("D65")
    published = colorimetry.lab_from_xyz(colorimetry.chart_reference("D65"), white)
    assert np.median(colorimetry.delta_e_2000(by_spectra, published)) < 2.0


def test_single_clipped_patch_is_left_out():
    """14-bit codes in 16 bits, and values clipped at 1: neither is the largest of its type."""
    image, centers = draw_chart(30, rng=np.random.default_rng(4))
    whole = measure_patches(image, centers)
    brightest = np.sort(whole.rgb.max(axis=1))
    share = image / brightest[-2:].mean()
    scaled = np.minimum(share, 1.0)
    for clipped in (scaled, np.rint(16383 * scaled).astype(np.uint16)):
        valid = measure_patches(clipped, centers).valid
        assert not valid[whole.rgb.max(axis=1).argmax()]
        assert valid.sum() == 23
    assert measure_patches(np.rint(12000 * share).astype(np.uint16), centers).valid.all()


def test_clipped_patches_are_left_out_without_mask():
    """A white card at the end of the range is not a clipped patch; the table around it may be."""
    image, centers = draw_chart(30, rng=np.random.default_rng(4))
    whole = measure_patches(image, centers)
    assert whole.valid.all()
    clipped = measure_patches(np.minimum(image, 0.45), centers)
    lost = ~clipped.valid
    assert lost.any()
    np.testing.assert_array_equal(lost, (whole.rgb > 0.45).any(axis=1))
    codes = np.rint(np.clip(255 / 0.7 * image, 0, 255)).astype(np.uint8)
    at_end = measure_patches(codes, centers)
    np.testing.assert_array_equal(~at_end.valid, (whole.rgb > 0.7).any(axis=1))
    white = np.rint(np.clip(250 * image / whole.rgb.max(), 0, 255)).astype(np.uint8)
    assert measure_patches(white, centers).valid.all()
