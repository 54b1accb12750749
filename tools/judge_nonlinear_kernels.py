"""Compare the linear kernel of eq. (6) with one that treats ridges and grooves apart.

    python tools/judge_nonlinear_kernels.py [SEED ...]

The detail d = h - G(sigma) h is scaled by 1 - alpha; here with one alpha where d > 0 (ridges) and
another where d < 0 (grooves). Both are fitted to the true topography of simulated stretched skin by
the histogram distance of eq. (7), on one grid. The linear kernel is the case of equal alphas, so
the gain of the nonlinear one on the fitted patch bounds its gain on any other.
"""

import sys

import numpy as np
from scipy.ndimage import gaussian_filter1d

from reconstruction.normal_histogram import histogram
from reconstruction.normal_histogram.counting import distance
from reconstruction.normal_integration.height_filters import high_pass
from rigsim.skin_patch.microrelief import make_micro_skin
from rigsim.skin_patch.stretch import stretch_skin

SITES = ("forehead", "cheek", "chin")
PIXEL_UM, SIDE_PX, SIZE_MM = 6.0, 256, 2.2
ALPHAS = np.arange(-2.0, 1.01, 0.2)
SIGMAS_UM = (20.0, 40.0, 60.0, 80.0, 100.0)


def main(seeds: list[int]) -> None:
    """Print a row per patch and stretch."""
    places = (np.arange(SIDE_PX) - 0.5 * (SIDE_PX - 1)) * PIXEL_UM / 1000.0
    x, y = np.meshgrid(places, -places)
    print("site | seed | r | unchanged | linear | ridges and grooves | gain")
    for seed in seeds:
        site = SITES[seed % 3]
        skin = make_micro_skin(site, seed=seed, size_mm=SIZE_MM)
        neutral = stretch_skin(skin, stretch=1.0, angle_deg=0.0).sample(x, y)
        height = high_pass(neutral.height_um, pixel=PIXEL_UM, cutoff=1000.0, valid=neutral.inside)
        for stretch in (0.8, 1.2):
            strained = stretch_skin(skin, stretch=stretch, angle_deg=0.0).sample(x, y)
            relief = high_pass(
                strained.height_um, pixel=PIXEL_UM, cutoff=1000.0, valid=strained.inside
            )
            target = histogram(relief, pixel=PIXEL_UM, valid=strained.inside)
            pixel = (PIXEL_UM, stretch * PIXEL_UM)
            found = {}
            for sigma in SIGMAS_UM:
                detail = height - gaussian_filter1d(height, sigma / PIXEL_UM, axis=1)
                for ridge in ALPHAS:
                    for groove in ALPHAS:
                        moved = height - np.where(detail > 0.0, ridge, groove) * detail
                        got = histogram(moved, pixel=pixel, valid=neutral.inside)
                        found[sigma, ridge, groove] = distance(got, target)
            plain = distance(histogram(height, pixel=pixel, valid=neutral.inside), target)
            linear = min(value for (_, a, b), value in found.items() if a == b)
            apart = min(found.values())
            gain = f"{100.0 * (1.0 - apart / linear):.0f} %"
            numbers = [f"{v:.3f}" for v in (plain, linear, apart)]
            print(" | ".join([site, str(seed), f"{stretch:g}", *numbers, gain]), flush=True)


if __name__ == "__main__":
    main([int(seed) for seed in sys.argv[1:]] or [600, 601, 602])
