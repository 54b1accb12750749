"""Intervals of normals' variances hold what more of the same simulated skin shows."""

import numpy as np
import pytest

from reconstruction.normal_histogram.statistics import measure_normals
from reconstruction.normal_integration.height_filters import high_pass
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.skin_patch.stretch import stretch_skin

SITES = ("forehead", "cheek", "chin")
PIXEL_UM, SIDE, PART = 6.0, 448, 128


@pytest.mark.long
@pytest.mark.timeout(600)
def test_small_patch_variance_errors_have_nominal_coverage():
    """Pieces of 0.8 mm against 2.7 mm, at rest, compressed and stretched.

    Rationale: standard errors say what another patch of the same skin and size would show.
    Expected: 60 to 76 % within one, 92 to 98 % within 1.96, as all intervals promise.
    Tolerance: two deviations of 60 independent pieces; the states of one piece are alike.
    """
    pull = []
    places = (np.arange(SIDE) - 0.5 * (SIDE - 1)) * PIXEL_UM / 1000.0
    x, y = np.meshgrid(places, -places)
    for seed in range(500, 515):
        skin = make_micro_skin(SITES[seed % 3], seed=seed, size_mm=3.4)
        for stretch in (1.0, 0.81, 1.19):
            seen = stretch_skin(skin, stretch=stretch, angle_deg=0.0).sample(x, y)
            height = high_pass(seen.height_um, pixel=PIXEL_UM, cutoff=1000.0, valid=seen.inside)
            whole = measure_normals(height, pixel=PIXEL_UM, valid=seen.inside)
            for top in (0, SIDE - PART):
                for left in (0, SIDE - PART):
                    part = slice(top, top + PART), slice(left, left + PART)
                    one = measure_normals(height[part], pixel=PIXEL_UM, valid=seen.inside[part])
                    pull.append(
                        [
                            (one.variance_x - whole.variance_x) / one.stderr_x,
                            (one.variance_y - whole.variance_y) / one.stderr_y,
                        ]
                    )
    within, within_2 = np.mean(np.abs(pull) < 1.0, axis=0), np.mean(np.abs(pull) < 1.96, axis=0)
    chance, chance_2 = 2.0 * np.sqrt(0.68 * 0.32 / 60), 2.0 * np.sqrt(0.95 * 0.05 / 60)
    assert (within >= 0.60 - chance).all(), within
    assert (within <= 0.76 + chance).all(), within
    assert (within_2 >= 0.92 - chance_2).all(), within_2
