"""Patch, kernels and variances of slopes for the page."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from model.microstructure.convolution import convolve
from model.microstructure.kernel_table import FOREHEAD, KernelTable, kernel_parameters
from rigsim.geometry.mesh import Mesh
from skinrig.viewer.microstructure import assets, relief_growth
from skinrig.viewer.microstructure.assets import MicroRelief
from skinrig.viewer.scene import SceneError


@pytest.fixture(scope="module")
def relief() -> MicroRelief:
    return assets.simulate_relief(3)


def plate(side_mm: float = 250.0) -> Mesh:
    uv = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], np.float32)
    positions = np.concatenate([side_mm * uv, np.zeros((4, 1))], axis=1).astype(np.float32)
    normals = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    faces = np.array([[0, 1, 3], [0, 3, 2]], np.int32)
    return Mesh(positions, faces, uv, normals)


def slope_variance(height, pixel, stretch=(1.0, 1.0)):
    dx = (height[1:-1, 2:] - height[1:-1, :-2]) / (2.0 * pixel * stretch[0])
    dy = (height[2:, 1:-1] - height[:-2, 1:-1]) / (2.0 * pixel * stretch[1])
    return np.array([np.mean(dx**2), np.mean(dy**2)])


@pytest.mark.parametrize(("r_s", "r_t"), [(1.25, 0.8125), (1.125, 1.0), (1.0, 0.75)])
def test_slope_variance_under_strain_matches_convolved_relief(relief, r_s, r_t):
    growth = assets.grow_relief(relief)
    table = relief_growth.compute_strained_variance(growth, relief.table)
    ratios = np.linspace(*relief_growth.STRETCH_RANGE, relief_growth.STRETCH_NODES)
    found = table[np.searchsorted(ratios, r_s), np.searchsorted(ratios, r_t)]
    alpha, sigma_um = kernel_parameters([r_s, r_t], relief.table)
    sigma = sigma_um / growth.pixel_um
    both = []
    for height in (growth.patch, growth.patch.T):
        changed = convolve(height, (1, 0), (0, 1), alpha[0], sigma[0], alpha[1], sigma[1])
        inner = slice(16, -16)
        both.append(
            (
                slope_variance(changed[inner, inner].astype(float), growth.pixel_um, (r_s, r_t)),
                slope_variance(height[inner, inner].astype(float), growth.pixel_um),
            )
        )
    ratio = sum(b[0] for b in both) / sum(b[1] for b in both)
    # the spectrum is windowed: it weighs the middle of the patch more
    np.testing.assert_allclose(found, ratio, rtol=0.1)
    assert abs(ratio - 1.0).max() > 0.15


def test_neutral_skin_keeps_its_variance(relief):
    table = relief_growth.compute_strained_variance(assets.grow_relief(relief), relief.table)
    middle = relief_growth.STRETCH_NODES // 2
    np.testing.assert_allclose(table[middle, middle], 1.0, rtol=1e-9)


def test_compressed_skin_is_rougher_and_stretched_skin_smoother(relief):
    table = relief_growth.compute_strained_variance(assets.grow_relief(relief), relief.table)
    middle = relief_growth.STRETCH_NODES // 2
    along = table[:, middle, 0]
    assert along[middle - 6] > 1.5
    assert along[middle + 6] < 0.75


def test_larger_pixels_show_less_of_the_slopes(relief):
    rms = relief_growth.compute_slope_rms(assets.grow_relief(relief))
    assert len(rms) >= 5
    assert all(b < a for a, b in pairwise(rms))
    assert rms[5] < 0.1 * rms[0]


def test_displacement_pixel_count_is_skin_length_over_pixel(relief):
    facts = assets.build_relief_assets(relief, plate(250.0))["facts"]["microstructure"]
    assert facts["virtual_px"] == pytest.approx(250e3 / relief.pixel_um, abs=8)
    # 4 sigmas of the widest kernel, 22.4 um at r = 1.28, and two pixels for samples
    assert facts["reach_px"] == int(np.ceil(4.0 * 22.396 / relief.pixel_um + 0.5)) + 2


def test_kernels_that_reach_over_the_window_are_refused(relief):
    wide = KernelTable((), ((1.0, -1.0),), (0.0, 900.0), (0.0, 900.0), (0.7, 1.3), "wide")
    with pytest.raises(SceneError, match="mesh: got kernels of 243 px"):
        assets.build_relief_assets(MicroRelief(relief.height_um, 15.0, wide), plate())


def test_a_relief_of_few_pixels_is_refused():
    small = MicroRelief(np.zeros((40, 40), np.float32), 15.0, FOREHEAD)
    with pytest.raises(SceneError, match="at least 96 pixels"):
        assets.grow_relief(small)


def test_a_relief_without_a_valid_pixel_is_refused():
    with pytest.raises(SceneError, match="no valid pixel"):
        assets.find_largest_square(np.zeros((4, 4), np.float32), np.zeros((4, 4), bool))


def test_the_patch_has_no_tilt_of_its_own(relief):
    tilted = relief.height_um + np.arange(relief.height_um.shape[1], dtype=np.float32)
    a = assets.grow_relief(MicroRelief(tilted, 15.0))
    b = assets.grow_relief(MicroRelief(relief.height_um, 15.0))
    np.testing.assert_allclose(a.patch, b.patch, atol=1e-3)
