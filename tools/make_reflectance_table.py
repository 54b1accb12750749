"""Make model/data/two_layer_reflectance.npz: skin's spectral reflectance on a grid, about 1 MB.

Run from the repository root; takes about a minute. The grid is uniform in the cube roots of
melanin and dermal blood (Jimenez 2010, eq. 7) over Table 1's ranges, at 400 to 700 nm in steps of
10; stored is the logarithm of the accurate tier's reflectance, for the paper's scattering (g = 0)
and for skin's (g = 0.8), each with the constants of skin and of the papers. Cubic interpolation
between the nodes is within 5e-5 of the tier itself; tests/unit/model/test_color_table.py checks
that on random points.
"""

from pathlib import Path

import numpy as np

from model import spectra
from model.color_table import SPECTRAL_NODES, STORED_ANISOTROPIES, STORED_CONSTANTS, spectral_axes
from model.tissue_optics import two_layer_reflectance

DIRECTIONS = {0.0: 16, 0.8: 24}


def main() -> None:
    axis_m, axis_hd = spectral_axes(SPECTRAL_NODES)
    arrays = {}
    for constants, name in STORED_CONSTANTS.items():
        for anisotropy in STORED_ANISOTROPIES:
            reflectance = two_layer_reflectance(
                spectra.WAVELENGTH_NM,
                axis_m[:, None] ** 3,
                axis_hd[None, :] ** 3,
                constants=constants,
                anisotropy=anisotropy,
                directions=DIRECTIONS[anisotropy],
            )
            arrays[f"{name}_g{anisotropy:g}"] = np.log(reflectance).astype(np.float32)
    target = Path("model/data/two_layer_reflectance.npz")
    np.savez_compressed(target, wavelength_nm=spectra.WAVELENGTH_NM, **arrays)
    print(f"{target}: {target.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
