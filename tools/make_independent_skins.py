"""Make skinrig/data/independent_skins.npz: spectra of skins whose optics no estimator assumes.

    python tools/make_independent_skins.py

Monte Carlo light transport (`rigsim.tissue.tissue_mc`) in skin of one scattering law in both
layers, drawn from the table of Jacques 2013, doi:10.1088/0031-9155/58/11/R37 (power laws, and the
sum of Rayleigh and Mie scattering), with melanosomes of 6.6e11 w^-3.33 /cm, an epidermis of 0.06
to 0.3 mm without blood, oxygenation of 0.4 to 0.95 and blood volume fractions of 0.002 to 0.07
(log-uniform). Melanin times thickness is log-normal around the medians of types I to VI. The
individual typology angle of the result, specular reflection included, gives the type.

Nothing here sets a constant of `model.tissue_optics.uncertainty`. Takes some ten minutes.
"""

import math
import sys
from pathlib import Path

import numpy as np

from model.spectra import hemoglobin_extinction
from model.tissue_optics.uncertainty import typology_angle
from rigsim.tissue.skin_layers import ETA, SKIN_ANISOTROPY, baseline_per_mm
from rigsim.tissue.tissue_mc import Layer, LayerStack, trace_photons

SEED = 71
PER_TYPE = 50
PHOTONS = 10_000
WAVELENGTH_NM = np.arange(400.0, 701.0, 20.0)
DEPTH_UM = (0.9, 1.6, 2.5, 4.0, 7.0, 14.0)
"""Median melanin volume fraction times thickness by type, micrometers."""
DEPTH_LOG_SD = 0.35
# a at 500 nm, 1/mm, and b of skin: Jacques 2013, table 1
POWER_LAWS = (
    (4.89, 1.548),
    (4.78, 2.453),
    (3.72, 1.390),
    (6.01, 1.722),
    (2.97, 0.705),
    (4.53, 1.292),
    (4.36, 1.169),
    (6.67, 0.689),
    (6.87, 1.161),
)
# a, the Rayleigh fraction and Mie's exponent of skin's mean: Jacques 2013, table 2
RAYLEIGH_MIE = (4.6, 0.409, 0.702)
TARGET = Path(__file__).resolve().parents[1] / "skinrig/data/independent_skins.npz"


def scattering_per_mm(law: int, wavelength_nm: float) -> float:
    """Return the reduced scattering of a law; the last one is Rayleigh and Mie."""
    ratio = wavelength_nm / 500.0
    if law < len(POWER_LAWS):
        a, b = POWER_LAWS[law]
        return a * ratio**-b
    a, rayleigh, exponent = RAYLEIGH_MIE
    return a * (rayleigh * ratio**-4.0 + (1.0 - rayleigh) * ratio**-exponent)


def hemoglobin_per_mm(oxygenation: float, wavelength_nm: float) -> float:
    """Return the absorption of whole blood from the tabulated extinctions (Prahl 1998)."""
    oxygenated, deoxygenated = hemoglobin_extinction(wavelength_nm)
    mean = oxygenation * oxygenated + (1.0 - oxygenation) * deoxygenated
    return float(math.log(10.0) * 150.0 / 64_500.0 * mean / 10.0)


def spectrum(skin: dict[str, float], rng: np.random.Generator) -> np.ndarray:
    """Return diffuse reflectance at `WAVELENGTH_NM`."""
    found = []
    for wavelength in WAVELENGTH_NM.tolist():
        clear = baseline_per_mm(wavelength)
        melanin = 6.6e10 * wavelength**-3.33
        sigma_s = scattering_per_mm(int(skin["law"]), wavelength) / (1.0 - SKIN_ANISOTROPY)
        epidermis = skin["c_m"] * melanin + (1.0 - skin["c_m"]) * clear
        blood = hemoglobin_per_mm(skin["oxygenation"], wavelength)
        dermis = skin["c_hd"] * blood + (1.0 - skin["c_hd"]) * clear
        stack = LayerStack(
            (
                Layer(skin["epidermis_mm"], epidermis, sigma_s, SKIN_ANISOTROPY, ETA),
                Layer(math.inf, dermis, sigma_s, SKIN_ANISOTROPY, ETA),
            )
        )
        found.append(trace_photons(stack, photons=PHOTONS, rng=rng).reflectance)
    return np.array(found)


def main() -> None:
    rng = np.random.default_rng(SEED)
    names = ("c_m", "c_hd", "epidermis_mm", "oxygenation", "law")
    truth: dict[str, list[float]] = {name: [] for name in names}
    spectra = []
    for number in range(PER_TYPE * len(DEPTH_UM)):
        depth_mm = 1e-3 * DEPTH_UM[number % len(DEPTH_UM)]
        depth_mm *= float(np.exp(DEPTH_LOG_SD * rng.standard_normal()))
        thickness = float(rng.uniform(0.06, 0.3))
        skin = {
            "c_m": min(depth_mm / thickness, 0.9),
            "c_hd": float(np.exp(rng.uniform(math.log(0.002), math.log(0.07)))),
            "epidermis_mm": thickness,
            "oxygenation": float(rng.uniform(0.4, 0.95)),
            "law": float(rng.integers(len(POWER_LAWS) + 1)),
        }
        spectra.append(spectrum(skin, rng))
        for name in names:
            truth[name].append(skin[name])
        if number % 30 == 29:
            print(f"{number + 1} skins", file=sys.stderr)
    reflectance = np.array(spectra)
    fine = np.arange(400.0, 701.0, 10.0)
    whole = np.stack([np.interp(fine, WAVELENGTH_NM, row) for row in reflectance])
    surface = ((ETA - 1.0) / (ETA + 1.0)) ** 2
    np.savez_compressed(
        TARGET,
        wavelength_nm=WAVELENGTH_NM,
        reflectance=reflectance.astype(np.float32),
        typology_angle_deg=typology_angle(whole + surface).astype(np.float32),
        seed=SEED,
        **{name: np.array(values, np.float32) for name, values in truth.items()},
    )
    print(f"{TARGET}: {TARGET.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
