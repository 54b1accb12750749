"""The scene's lateral transport against photons that walk through patterned skin.

These take minutes, because a pattern shows only when single columns of pixels are known to a few
percent; the even patch, which checks the walk itself, is quick.
"""

import numpy as np
import pytest
from scipy import stats
from twins.patterned_tissue import patterned_reflectance

from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import build_mesh
from rigsim.light.subsurface_radiance import scatter_patterned_light
from rigsim.tissue.lateral_kernels import SIGMAS_MM
from rigsim.tissue.skin_table import SkinTable

FALSE_ALARM = 1e-4  # per test


@pytest.mark.long
@pytest.mark.parametrize(
    ("wavelength_nm", "c_m", "c_hd"), [(560.0, 0.02, 0.02), (630.0, 0.01, 0.04), (450.0, 0.1, 0.05)]
)
def test_uniform_patch_reflectance_matches_table(wavelength_nm, c_m, c_hd):
    """Rationale: walk and table are separate codes of the same optics (analog weights at collisions
    there, attenuation along flights here). Expected: equal within both standard errors."""
    side = 8
    result = patterned_reflectance(
        np.full((side, side), c_m),
        np.full((side, side), c_hd),
        pixel_mm=0.2,
        wavelength_nm=wavelength_nm,
        photons=24_000,
        rng=np.random.default_rng(12345),
    )
    table = SkinTable.load()
    band = int(np.argmin(np.abs(table.wavelength_nm - wavelength_nm)))
    expected = float(table.spectra(c_m, c_hd)[band])
    # Pixels of a batch share photons; their covariance is small, the sum of variances is taken.
    stderr = float(np.sqrt(np.sum(result.standard_error**2))) / side**2
    z = (result.reflectance.mean() - expected) / np.hypot(stderr, 0.003 * expected)
    assert abs(z) < stats.norm.isf(FALSE_ALARM / 2)


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("wavelength_nm", [560.0, 620.0])
def test_stripe_reflectance_matches_full_walk_within_5_percent(wavelength_nm):
    """Rationale: the scene replaces a walk through patterned skin by two blurs.

    Expected: the profile across stripes of melanin and, shifted, of blood, that took no part in
    fitting the blur, within 5 % rms after the walk's noise is taken off; without transport the
    error is more than twice as large. The pattern is even at its borders, so the scene's closed
    borders equal the walk's periodic ones.
    """
    side, pixel_mm = 32, 0.15
    x = np.abs(np.arange(side) - 0.5 * (side - 1))
    c_m = np.where((x > 3.0) & (x < 8.0), 0.05, 0.012).astype(np.float64)
    c_hd = np.where((x > 6.0) & (x < 12.0), 0.05, 0.015).astype(np.float64)
    walk = patterned_reflectance(
        np.tile(c_m, (side, 1)),
        np.tile(c_hd, (side, 1)),
        pixel_mm=pixel_mm,
        wavelength_nm=wavelength_nm,
        photons=300_000,
        rng=np.random.default_rng(12345),
    )
    profile = walk.reflectance.mean(axis=0)
    noise = np.sqrt((walk.standard_error**2).sum(axis=0)) / side

    table = SkinTable.load()
    band = int(np.argmin(np.abs(table.wavelength_nm - wavelength_nm)))
    one_band = np.eye(table.wavelength_nm.size)[:, band : band + 1]
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    plate = build_mesh(
        np.column_stack([corners * side * pixel_mm, np.zeros(4)]), [[0, 1, 2], [0, 2, 3]], corners
    )
    kernels = table.lateral_kernels(float(np.median(c_m)), float(np.median(c_hd)), one_band)

    def image(melanin: np.ndarray) -> np.ndarray:
        row = table.spectra(melanin, c_hd)[:, band : band + 1]
        return np.tile(row, (side, 1, 1)).astype(np.float32)

    sharp = image(c_m)
    even = np.ones((side, side), np.float32)
    seen = scatter_patterned_light(
        sharp, image(np.zeros(side)), even, unwrap(plate, side), kernels.gaussians(SIGMAS_MM)
    )

    def error(model: np.ndarray) -> float:
        relative = (model.mean(axis=0)[:, 0] - profile) / profile
        return float(np.sqrt(max(0.0, np.mean(relative**2) - np.mean((noise / profile) ** 2))))

    assert error(seen) < 0.05
    assert error(sharp) > 2.0 * error(seen)
