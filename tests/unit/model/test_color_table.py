"""The color table against direct spectral integration, and its derivatives against differences."""

import numpy as np
import pytest

from model import color_table, spectra
from model.color_table import ColorTable, ColorTableError
from model.tissue_optics import SKIN_CONSTANTS, two_layer_reflectance
from model.tissue_optics.layers import C_HD_MAX, C_M_MAX


@pytest.fixture(scope="module")
def table():
    return color_table.build("Nikon 5100 (NPL)", "xenon flash")


def fractions(rng, count, lowest=0.0):
    """Draw uniformly in the cube roots, over Table 1's ranges."""
    u = rng.uniform(np.cbrt(lowest), np.cbrt(C_M_MAX), count)
    v = rng.uniform(np.cbrt(lowest), np.cbrt(C_HD_MAX), count)
    return np.minimum(u**3, C_M_MAX), np.minimum(v**3, C_HD_MAX)


@pytest.mark.long
@pytest.mark.parametrize("anisotropy", color_table.STORED_ANISOTROPIES)
def test_lookup_is_band_average_of_accurate_tier(anisotropy, rng):
    c_m, c_hd = fractions(rng, 60)
    reflectance = two_layer_reflectance(
        spectra.WAVELENGTH_NM,
        c_m,
        c_hd,
        constants=SKIN_CONSTANTS,
        anisotropy=anisotropy,
        directions=24,
    )
    assert spectra.camera_names()
    for camera in spectra.camera_names():
        table = color_table.build(camera, "D65", anisotropy=anisotropy)
        direct = spectra.band_average(reflectance, camera, "D65")
        np.testing.assert_allclose(table.lookup(c_m, c_hd), direct, rtol=1e-4, err_msg=camera)


def test_nodes_are_on_cube_root_axes(table):
    i, j = 40, 90
    c_m, c_hd = C_M_MAX * (i / 127) ** 3, C_HD_MAX * (j / 127) ** 3
    np.testing.assert_allclose(table.lookup(c_m, c_hd), table.rgb[i, j], rtol=1e-10)
    np.testing.assert_allclose(table.lookup(0.0, 0.0), table.rgb[0, 0], rtol=1e-12)
    np.testing.assert_allclose(table.lookup(C_M_MAX, C_HD_MAX), table.rgb[-1, -1], rtol=1e-10)


def test_channels_darken_with_melanin_green_most_with_blood(table):
    rgb = table.rgb
    assert np.all(np.diff(rgb, axis=0) < 0.0)
    # At the very first nodes blood changes less than the stored digits.
    assert np.all(np.diff(rgb[:, 10:, 1], axis=1) < 0.0)
    lost = 1.0 - rgb[20, 60] / rgb[20, 0]
    assert lost[1] > lost[0]
    assert 0.0 < rgb.min() < rgb.max() < 1.0


def test_the_jacobian_is_the_derivative_of_the_lookup(table, rng):
    c_m, c_hd = fractions(rng, 200, lowest=1e-4)
    c_m, c_hd = 0.99 * c_m, 0.99 * c_hd
    jacobian = table.jacobian(c_m, c_hd)
    assert jacobian.shape == (200, 3, 2)
    step = 1e-5
    by_m = table.lookup(c_m * (1 + step), c_hd) - table.lookup(c_m * (1 - step), c_hd)
    by_hd = table.lookup(c_m, c_hd * (1 + step)) - table.lookup(c_m, c_hd * (1 - step))
    numeric = np.stack([by_m / c_m[:, None], by_hd / c_hd[:, None]], axis=-1) / (2 * step)
    np.testing.assert_allclose(jacobian, numeric, rtol=1e-5, atol=1e-7)


def test_size_changes_the_sampling_and_hardly_the_color(table, rng):
    c_m, c_hd = fractions(rng, 100)
    small = color_table.build("Nikon 5100 (NPL)", "xenon flash", size=48)
    assert small.rgb.shape == (48, 48, 3)
    np.testing.assert_allclose(small.lookup(c_m, c_hd), table.lookup(c_m, c_hd), rtol=2e-4)


def test_fractions_broadcast_like_a_loop(table):
    c_m, c_hd = np.array([[0.01], [0.1]]), np.array([0.02, 0.05, 0.2])
    both = table.lookup(c_m, c_hd)
    assert both.shape == (2, 3, 3)
    loop = [[table.lookup(float(m), float(h)) for h in c_hd] for m in c_m[:, 0]]
    np.testing.assert_allclose(both, loop, rtol=1e-12)


def test_other_blood_makes_another_table():
    venous = color_table.build("Nikon 5100 (NPL)", "D65", size=16, oxygenation=0.4)
    usual = color_table.build("Nikon 5100 (NPL)", "D65", size=16)
    # Deoxygenated blood is darker in the red.
    assert venous.lookup(0.01, 0.1)[0] < 0.95 * usual.lookup(0.01, 0.1)[0]


def test_the_nodes_cannot_be_modified(table):
    with pytest.raises(ValueError, match="read-only"):
        table.rgb[0, 0] = 1.0


def test_fractions_outside_the_table_are_refused_not_clamped(table):
    with pytest.raises(ColorTableError, match=r"c_m: got"):
        table.lookup(0.6, 0.1)
    with pytest.raises(ColorTableError, match="c_hd"):
        table.lookup(0.1, -1e-6)
    with pytest.raises(ColorTableError, match="nan"):
        table.lookup(np.nan, 0.1)
    with pytest.raises(ColorTableError, match="c_m: got"):
        table.jacobian(0.0, 0.1)


@pytest.mark.parametrize(
    ("rgb", "message"),
    [
        (np.ones((4, 4, 3)), ">= 8"),
        (np.ones((9, 8, 3)), "size, size"),
        (np.zeros((9, 9, 3)), "rgb: got"),
    ],
)
def test_invalid_table_array_is_refused(rgb, message):
    with pytest.raises(ColorTableError, match=message):
        ColorTable("camera", "light", rgb)


def test_size_too_small_for_spline_is_refused():
    for size in (4, 7, 8.5, "16"):
        with pytest.raises(ColorTableError, match=f"at least 8, got {size}"):
            color_table.build("Nikon 5100 (NPL)", "D65", size=size)


def test_fractions_whose_shapes_do_not_fit_are_named():
    table = color_table.build("Nikon 5100 (NPL)", "D65", size=8)
    for asked in (table.lookup, table.jacobian, color_table.spectral_reflectance):
        with pytest.raises(ColorTableError, match=r"c_m, c_hd: got"):
            asked(np.full(3, 0.1), np.full(4, 0.1))


@pytest.mark.parametrize(("size", "told"), [(8, 0.04), (16, 3e-3), (32, 4e-5)])
def test_color_between_nodes_is_within_reported_error(size, told, rng):
    melanin, blood = 0.5 * rng.random(5000) ** 3, 0.32 * rng.random(5000) ** 3
    fine, coarse = (
        color_table.build("Nikon 5100 (NPL)", "D65", size=n).lookup(melanin, blood)
        for n in (256, size)
    )
    off = np.abs(coarse / fine - 1.0).max()
    assert 0.05 * told < off < told
