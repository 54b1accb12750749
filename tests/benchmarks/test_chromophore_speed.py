"""Speed of the chromophore fit against SciPy's least squares, pixel by pixel, in the same run."""

import time

import numpy as np
import pytest
from scipy.optimize import least_squares

from model import color_table
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction.chromophores import invert


def scipy_peer(rgb, table, *, shading="known", noise=0.01):
    """Fit each pixel with scipy.optimize.least_squares, in the cube roots, from one start.

    Parameters
    ----------
    rgb
        (n, 3), white-balanced camera RGB.
    table
        Color table.
    shading
        "known" (1) or None (a third unknown, its logarithm).
    noise
        Relative standard deviation of each channel, for the weights.

    Returns
    -------
    ndarray
        (n, 2): C_m, C_hd.
    """
    ends = np.array([table.c_m_max, table.c_hd_max])
    free = shading is None
    found = np.empty((len(rgb), 2))
    for pixel, color in enumerate(np.asarray(rgb, dtype=np.float64)):

        def residual(x, color=color):
            fractions = ends * x[:2] ** 3
            factor = np.exp(x[2]) if free else 1.0
            return (factor * table.lookup(*fractions) - color) / (noise * color)

        fit = least_squares(
            residual,
            [0.35, 0.45, 0.0] if free else [0.35, 0.45],
            bounds=([0.04, 0.04, -5.0], [1.0, 1.0, 5.0]) if free else (0.04, 1.0),
        )
        found[pixel] = ends * fit.x[:2] ** 3
    return found


def picture(table, side, rng):
    """Return a side x side picture of skin with 1 percent of noise, and its chromophores."""
    y, x = np.mgrid[0:side, 0:side] / side
    c_m = 0.02 + 0.01 * np.sin(9.0 * x) * np.cos(7.0 * y)
    c_hd = 0.05 + 0.03 * np.cos(8.0 * x + 3.0 * y)
    color = np.concatenate([table.lookup(m, h) for m, h in zip(c_m, c_hd, strict=True)])
    noisy = color * (1.0 + 0.01 * rng.standard_normal(color.shape))
    return noisy.reshape(side, side, 3).astype(np.float32), c_m, c_hd


@pytest.mark.long
@pytest.mark.parametrize("shading", [None, "known"])
def test_chromophore_fit_thousandfold_faster_than_scipy_and_agrees(shading, rng):
    # Processor seconds, so that a busy machine does not change the ratio.
    table = color_table.build(
        "Nikon 5100 (NPL)", "xenon flash", anisotropy=ANISOTROPY_SKIN, exact_optics=True
    )
    rgb, _, _ = picture(table, 1024, rng)
    invert(rgb[:8], table, shading=shading)  # compiles, turns the table round
    begin = time.process_time()
    maps = invert(rgb, table, shading=shading, variance=(0.01 * rgb) ** 2)
    ours = (time.process_time() - begin) / rgb[..., 0].size
    some = rgb.reshape(-1, 3)[:: rgb[..., 0].size // 60][:60]
    begin = time.process_time()
    peer = scipy_peer(some, table, shading=shading)
    theirs = (time.process_time() - begin) / len(some)
    print(f"{1e9 * ours:.0f} ns and {1e3 * theirs:.1f} ms a pixel: {theirs / ours:.0f} times")
    assert theirs > 1000.0 * ours
    ours_m = maps.melanin.reshape(-1)[:: rgb[..., 0].size // 60][:60]
    scale = maps.stderr_melanin.reshape(-1)[:: rgb[..., 0].size // 60][:60]
    assert np.median(np.abs(ours_m - peer[:, 0]) / scale) < 0.1
