"""Make reconstruction/data/interval_skins.npz: spectra of skins that set the factors of intervals.

    python tools/make_interval_skins.py

The skins follow the laws of ``tools/make_independent_skins.py``, with a seed of their own.
Adding-doubling replaces Monte Carlo light transport. Takes some minutes.
"""

from pathlib import Path

import numpy as np
from make_independent_skins import WAVELENGTH_NM, coefficients, draw_skin, typology_angles

from model.tissue_optics import adding_doubling
from reconstruction.chromophores.table_fit.interval_factors import SKINS_FILE
from rigsim.tissue.skin_layers import ETA, SKIN_ANISOTROPY
from skinrig.benchmarks.flash_rig.independent_skin import MELANOSOME_550_PER_MM

SEED = 1001
SKINS = 6000
TARGET = Path(__file__).resolve().parents[1] / "reconstruction" / SKINS_FILE


def main() -> None:
    rng = np.random.default_rng(SEED)
    skins = [draw_skin(number, rng) for number in range(SKINS)]
    thickness = np.array([skin["epidermis_mm"] for skin in skins])
    layers_mm = np.stack([thickness, np.full(SKINS, np.inf)], axis=-1)
    reflectance = np.empty((SKINS, WAVELENGTH_NM.size))
    for column, wavelength in enumerate(WAVELENGTH_NM.tolist()):
        optics = np.array([coefficients(skin, wavelength) for skin in skins])
        reflectance[:, column] = adding_doubling.reflectance(
            optics[:, :2], optics[:, [2, 2]], layers_mm, anisotropy=SKIN_ANISOTROPY, eta=ETA
        )
    depth = np.array([skin["c_m"] for skin in skins]) * thickness * MELANOSOME_550_PER_MM
    np.savez_compressed(
        TARGET,
        wavelength_nm=WAVELENGTH_NM,
        reflectance=reflectance.astype(np.float16),
        typology_angle_deg=typology_angles(reflectance).astype(np.float32),
        melanin_optical_depth=depth.astype(np.float32),
        hemoglobin=np.array([skin["c_hd"] for skin in skins], np.float32),
        seed=SEED,
    )
    print(f"{TARGET}: {TARGET.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
