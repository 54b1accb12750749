"""Grown relief has its patch's spectrum above the split, and keeps the mesoscale's below."""

import numpy as np
import pytest

from model.displacement_synthesis.growth import grow
from model.displacement_synthesis.sources import level_patch
from model.displacement_synthesis.split import add_mesoscale, match_spectrum
from rigsim.skin_patch.microrelief import make_micro_skin
from skinrig.analysing.relief import mean_octaves

PIXEL_UM = 20.0
SIDE_PX = 1200
WINDOW_UM = 4000.0
PERIODS_UM = (2000.0, 1000.0, 500.0, 250.0)
LIMIT = 0.05


def octaves(height, pixel_um):
    """Variance of octaves, mean over windows of 4 mm, out of step with the cells of 2 mm."""
    side = round(WINDOW_UM / pixel_um)
    last = len(height) - side
    starts = np.linspace(0, last, 1 + round(last / (0.41 * side))).astype(int)
    windows = [
        (height[y : y + side, x : x + side].astype(float), (pixel_um, pixel_um))
        for y in starts
        for x in starts
    ]
    return mean_octaves(windows, PERIODS_UM)[0]


@pytest.fixture(scope="module")
def patch():
    skin = make_micro_skin("forehead", seed=40, size_mm=8.0, texel_um=16.0)
    return level_patch(skin.height_um, pixel_um=16.0)


@pytest.fixture(scope="module")
def grown(patch):
    """Grown maps of held-out seeds, without a matched spectrum and with one."""
    how = {"pixel_um": PIXEL_UM, "patch_pixel_um": 16.0}
    plain = [grow([patch], SIDE_PX, rng=np.random.default_rng(s), **how) for s in (41, 42, 43)]
    matched = [one.copy() for one in plain]
    for one in matched:
        match_spectrum(one, [(patch, 16.0)], [1.0], PIXEL_UM)
    return plain, matched


@pytest.mark.long
def test_octaves_at_split_are_those_of_patch(patch, grown):
    """Three maps of 24 mm: a standard error of about 2 % for the octave of 2 to 1 mm."""
    target = octaves(patch, 16.0)
    plain, matched = (
        np.sqrt(np.mean([octaves(one, PIXEL_UM) for one in maps], axis=0) / target)
        for maps in grown
    )
    np.testing.assert_allclose(matched, 1.0, atol=LIMIT)
    assert plain[0] > 1.2


@pytest.mark.long
def test_relief_and_mesoscale_sum_to_skin(patch, grown):
    """The mesoscale is other skin of the same site; powers of both parts sum to the skin's."""
    side = SIDE_PX * PIXEL_UM / 1e3
    skin = make_micro_skin("forehead", seed=44, size_mm=side, texel_um=40.0)
    known = np.ones(skin.height_um.shape, bool)
    low = np.zeros((SIDE_PX, SIDE_PX), np.float32)
    add_mesoscale(low, skin.height_um, known, 40.0)
    ratio = {}
    for name, factor in (("power", 1.0), ("amplitude", None)):
        part = low if factor else _amplitude_complement(skin.height_um)
        sums = np.mean([octaves(one + part, PIXEL_UM) for one in grown[1]], axis=0)
        ratio[name] = np.sqrt(sums / octaves(skin.height_um, 40.0))
    assert abs(ratio["power"][0] - 1.0) < LIMIT
    assert ratio["amplitude"][0] < 1.0 - LIMIT


def _amplitude_complement(height_um):
    """Return the mesoscale by the Gaussian filter whose gain sums to 1 with the relief's."""
    leveled = level_patch(height_um, pixel_um=40.0)
    return np.kron(height_um - leveled, np.ones((2, 2))).astype(np.float32)
