"""Relief grown from a patch."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage
from twins.relief_growth import window

from skinrig.viewer.microstructure import relief_growth
from skinrig.viewer.microstructure.relief_growth import GROWN_LEVELS, GrownRelief
from skinrig.viewer.scene import SceneError


def gaussian_patch(side: int = 192, sigma: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(11)
    patch = ndimage.gaussian_filter(rng.standard_normal((side, side)), sigma, mode="wrap")
    return (10.0 * (patch - patch.mean()) / patch.std()).astype(np.float32)


@pytest.fixture(scope="module")
def growth() -> GrownRelief:
    return GrownRelief(gaussian_patch(), 15.0, 40, 7)


def test_window_is_part_of_every_larger_window(growth):
    large = window(growth, -100, 50, (300, 280))
    np.testing.assert_array_equal(window(growth, -30, 90, (64, 48)), large[70:134, 40:88])


def test_grown_relief_has_mean_and_variance_of_patch(growth):
    grown = window(growth, 0, 0, (1200, 1200))
    # some 1200^2 / (2 pi (2 * 3)^2) independent places, drawn from a patch that has 160 itself:
    # 20 % is four standard errors of its variance
    assert abs(grown.std() / growth.patch.std() - 1.0) < 0.2
    assert abs(grown.mean()) < 4.0 * growth.patch.std() / np.sqrt(160)


def test_grown_relief_has_no_seams(growth):
    def largest_step(height):
        return max(np.abs(np.diff(height, axis=axis)).max() for axis in (0, 1))

    # blending adds slopes of its own, but nothing like two unrelated heights side by side
    grown = window(growth, 0, 0, (800, 800))
    assert largest_step(grown) < 2.0 * largest_step(growth.patch)
    tiled = np.tile(growth.patch[:40, :40], (4, 4))
    assert largest_step(tiled) > 3.0 * largest_step(growth.patch)


def test_coarser_level_is_finer_mean_except_changing_weights(growth):
    fine = window(growth, 160, 320, (512, 512)).astype(np.float64)
    for level in range(1, GROWN_LEVELS):
        side = 512 >> level
        mean = fine.reshape(side, 1 << level, side, 1 << level).mean(axis=(1, 3))
        coarse = window(growth, 160 >> level, 320 >> level, (side, side), level=level)
        # weights change by a pixel's share of a cell over it
        assert np.std(coarse - mean) < 0.02 * 2.0**level * np.std(mean)
        # one pixel beside: no level agrees by its smoothness alone
        assert np.std(coarse[:, 1:] - mean[:, :-1]) > 2.0 * np.std(coarse - mean)


def test_every_shown_position_is_inside_patch():
    # a patch of which each pixel is its own address, so that a wrap would show as a jump
    patch = np.arange(96.0 * 96.0).reshape(96, 96).astype(np.float32)
    largest = relief_growth.compute_max_cell_px(96)
    growth = GrownRelief(patch, 10.0, largest, 1)
    for level in range(GROWN_LEVELS):
        assert np.isfinite(window(growth, -37, -11, (200, 200), level=level)).all()
    with pytest.raises(SceneError, match="cell_px: got"):
        GrownRelief(patch, 10.0, largest + 1, 1)


def test_another_seed_shows_other_positions(growth):
    other = GrownRelief(growth.patch, growth.pixel_um, growth.cell_px, growth.seed + 1)
    a, b = (window(one, 0, 0, (400, 400)) for one in (growth, other))
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"patch": np.zeros((100, 96), np.float32)}, "patch: got shape"),
        ({"patch": np.full((96, 96), np.nan, np.float32)}, "patch: got NaN"),
        ({"pixel_um": 0.0}, "pixel_um: got 0"),
        ({"seed": -1}, "seed: got -1"),
    ],
)
def test_unusable_patch_is_refused(change, message):
    settings = {"patch": np.zeros((96, 96), np.float32), "pixel_um": 1.0, "cell_px": 17, "seed": 0}
    with pytest.raises(SceneError, match=message):
        GrownRelief(**(settings | change))


def test_positions_beyond_32_bits_are_refused(growth):
    with pytest.raises(ValueError, match="window: got"):
        window(growth, relief_growth.MAX_LATTICE_PX, 0, (8, 8))
