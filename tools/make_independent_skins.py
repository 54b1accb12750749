"""Make skinrig/data/independent_skins.npz: spectra of skins whose optics no estimator assumes.

    python tools/make_independent_skins.py

Monte Carlo light transport (`rigsim.tissue.skin_transport`) in skin of one scattering law in both
layers, drawn from the table of Jacques 2013, doi:10.1088/0031-9155/58/11/R37 (power laws, and the
sum of Rayleigh and Mie scattering), with melanosomes of 6.6e11 w^-3.33 /cm, an epidermis of 0.06
to 0.3 mm without blood, oxygenation of 0.4 to 0.95 and blood volume fractions of 0.002 to 0.07
(log-uniform). Melanin times thickness is log-normal around the medians of types I to VI. The
individual typology angle of the result, specular reflection included, gives the type.

Nothing here sets a constant of `model.tissue_optics.uncertainty` or an interval. Takes 2 minutes.
"""

import math
import sys
from pathlib import Path

import numpy as np

from model.spectra import hemoglobin_extinction
from model.tissue_optics.uncertainty import typology_angle
from rigsim.tissue.skin_layers import BASAL_THICKNESS_FRACTION, ETA, baseline_per_mm
from rigsim.tissue.skin_transport import SkinCoordinates, SkinTransport

SEED = 71
PER_TYPE = 600
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
EVEN_BASAL_FRACTION = BASAL_THICKNESS_FRACTION  # melanin at every depth of the epidermis alike
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


def draw_skin(number: int, rng: np.random.Generator) -> dict[str, float]:
    """Draw the properties of a skin; types follow each other by number."""
    depth_mm = 1e-3 * DEPTH_UM[number % len(DEPTH_UM)]
    depth_mm *= float(np.exp(DEPTH_LOG_SD * rng.standard_normal()))
    thickness = float(rng.uniform(0.06, 0.3))
    return {
        "c_m": min(depth_mm / thickness, 0.9),
        "c_hd": float(np.exp(rng.uniform(math.log(0.002), math.log(0.07)))),
        "epidermis_mm": thickness,
        "oxygenation": float(rng.uniform(0.4, 0.95)),
        "law": float(rng.integers(len(POWER_LAWS) + 1)),
    }


def coefficients(skin: dict[str, float], wavelength_nm: float) -> tuple[float, float, float]:
    """Return the absorption of epidermis and dermis and their reduced scattering, 1/mm."""
    clear = baseline_per_mm(wavelength_nm)
    melanin = 6.6e10 * wavelength_nm**-3.33
    blood = hemoglobin_per_mm(skin["oxygenation"], wavelength_nm)
    epidermis = skin["c_m"] * melanin + (1.0 - skin["c_m"]) * clear
    dermis = skin["c_hd"] * blood + (1.0 - skin["c_hd"]) * clear
    return epidermis, dermis, scattering_per_mm(int(skin["law"]), wavelength_nm)


def typology_angles(reflectance: np.ndarray) -> np.ndarray:
    """Return the angles of diffuse spectra (n, w), degrees, with the specular reflection added."""
    fine = np.arange(400.0, 701.0, 10.0)
    whole = np.stack([np.interp(fine, WAVELENGTH_NM, row) for row in reflectance])
    return typology_angle(whole + ((ETA - 1.0) / (ETA + 1.0)) ** 2)


def spectrum(skin: dict[str, float]) -> np.ndarray:
    """Return diffuse reflectance at `WAVELENGTH_NM`."""
    transport, thickness = SkinTransport.load(), skin["epidermis_mm"]
    found = []
    for wavelength in WAVELENGTH_NM.tolist():
        epidermis, dermis, reduced = coefficients(skin, wavelength)
        at = SkinCoordinates(
            reduced * thickness,
            np.array([EVEN_BASAL_FRACTION]),
            np.array([epidermis * thickness]),
            np.array([dermis / reduced]),
        )
        found.append(math.exp(transport.log_reflectance(at)[0]))
    return np.array(found)


def main() -> None:
    rng = np.random.default_rng(SEED)
    names = ("c_m", "c_hd", "epidermis_mm", "oxygenation", "law")
    truth: dict[str, list[float]] = {name: [] for name in names}
    spectra = []
    for number in range(PER_TYPE * len(DEPTH_UM)):
        skin = draw_skin(number, rng)
        spectra.append(spectrum(skin))
        for name in names:
            truth[name].append(skin[name])
        if number % 300 == 299:
            print(f"{number + 1} skins", file=sys.stderr)
    reflectance = np.array(spectra)
    np.savez_compressed(
        TARGET,
        wavelength_nm=WAVELENGTH_NM,
        reflectance=reflectance.astype(np.float16),
        typology_angle_deg=typology_angles(reflectance).astype(np.float32),
        seed=SEED,
        **{name: np.array(values, np.float32) for name, values in truth.items()},
    )
    print(f"{TARGET}: {TARGET.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
