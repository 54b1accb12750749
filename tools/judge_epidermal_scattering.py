"""Judge estimates of melanin on skins of given thickness and scattering of the epidermis.

    python tools/judge_epidermal_scattering.py [--skins 900]

The skins follow the laws of ``tools/make_independent_skins.py`` by adding-doubling, with seeds of
their own; light is known, noise is 0.5 %. The first rows have the laws of Jacques
2013 for the dermis and 1 or 2 times their scattering in the epidermis. The last rows have one law:
the 5th or 95th percentile of the laws' amplitudes at 500 nm, with their mean exponent, in both
layers. Printed per type I to VI: median bias, coverage of 68 and 95 % intervals, valid fraction.
Takes 3 minutes of processor time.
"""

import argparse

import numpy as np
from make_independent_skins import (
    DEPTH_LOG_SD,
    DEPTH_UM,
    POWER_LAWS,
    RAYLEIGH_MIE,
    WAVELENGTH_NM,
    hemoglobin_per_mm,
    scattering_per_mm,
    typology_angles,
)

from model import color_table, spectra
from model.tissue_optics import adding_doubling
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction import chromophores
from rigsim.tissue.skin_layers import ETA, SKIN_ANISOTROPY, baseline_per_mm
from skinrig.benchmarks.flash_rig import independent_skin as independent

PRODUCTS = (
    (0.05, 1.0),
    (0.085, 1.0),
    (0.05, 2.0),
    (0.12, 1.0),
    (0.17, 1.0),
    (0.085, 2.0),
    (0.12, 2.0),
)
"""Thickness of the epidermis, mm, and its scattering over that of the dermis."""
CORNERS = tuple((mm, z) for mm in (0.05, 0.085, 0.12) for z in (-1.645, 1.645))
"""Thickness, mm, and standard deviations from the mean of the laws' log amplitudes."""
SEED = 9101
MIN_SKINS = 15


def draw(count: int, seed: int, thickness_mm: float, ratio: float, deviations: float | None):
    """Return reflectance (n, w), melanin optical depth and type of skins."""
    rng = np.random.default_rng(seed)
    depth_mm = 1e-3 * np.array(DEPTH_UM)[np.arange(count) % len(DEPTH_UM)]
    depth_mm = depth_mm * np.exp(DEPTH_LOG_SD * rng.standard_normal(count))
    melanin = np.minimum(depth_mm / thickness_mm, 0.9)
    blood = np.exp(rng.uniform(np.log(0.002), np.log(0.07), count))
    oxygenation = rng.uniform(0.4, 0.95, count)
    laws = rng.integers(len(POWER_LAWS) + 1, size=count).tolist()
    amplitude = np.log([law[0] for law in POWER_LAWS] + [RAYLEIGH_MIE[0]])
    exponent = np.mean([law[1] for law in POWER_LAWS])
    layers_mm = np.tile([thickness_mm, np.inf], (count, 1))
    reflectance = np.empty((count, WAVELENGTH_NM.size))
    for column, wavelength in enumerate(WAVELENGTH_NM.tolist()):
        clear = baseline_per_mm(wavelength)
        whole = np.array([hemoglobin_per_mm(value, wavelength) for value in oxygenation.tolist()])
        epidermis = melanin * 6.6e10 * wavelength**-3.33 + (1.0 - melanin) * clear
        dermis = blood * whole + (1.0 - blood) * clear
        if deviations is None:
            reduced = np.array([scattering_per_mm(law, wavelength) for law in laws])
        else:
            at_500 = np.exp(amplitude.mean() + deviations * amplitude.std(ddof=1))
            reduced = np.full(count, at_500 * (wavelength / 500.0) ** -exponent)
        reflectance[:, column] = adding_doubling.reflectance(
            np.stack([epidermis, dermis], axis=-1),
            np.stack([ratio * reduced, reduced], axis=-1),
            layers_mm,
            anisotropy=SKIN_ANISOTROPY,
            eta=ETA,
        )
    depth = melanin * thickness_mm * independent.MELANOSOME_550_PER_MM
    return reflectance, depth, independent.type_index(typology_angles(reflectance))


def judge(label: str, seed: int, reflectance, depth, types) -> None:
    for camera, light in independent.JUDGED_CAMERAS:
        table = color_table.build(camera, light, anisotropy=ANISOTROPY_SKIN)
        rgb = spectra.band_average(reflectance, camera, light, wavelength_nm=WAVELENGTH_NM)
        noise = independent.CHANNEL_NOISE * np.random.default_rng(seed).standard_normal(rgb.shape)
        rgb = rgb * (1.0 + noise)
        variance = np.square(independent.CHANNEL_NOISE * rgb)
        found = chromophores.invert(rgb, table, shading="known", variance=variance)
        true = depth / table.constants.melanin_depth_factor
        print(f"{label}, {camera}")
        for index, name in enumerate(independent.SKIN_TYPES):
            good = (types == index) & found.valid
            if good.sum() < MIN_SKINS:
                continue
            covered = []
            for probability in (0.683, 0.95):
                low, high = found.interval("melanin", probability)
                covered.append(float(((low <= true) & (true <= high))[good].mean()))
            bias = 100.0 * (float(np.median(found.melanin[good] / true[good])) - 1.0)
            valid = float(found.valid[types == index].mean())
            print(
                f"  {name:3s} {good.sum():4d}  bias {bias:+4.0f} %  "
                f"{covered[0]:.2f} {covered[1]:.2f}  valid {valid:.2f}",
                flush=True,
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--skins", type=int, default=900, help="skins of each row")
    given = parser.parse_args()
    rows = [(mm, ratio, None) for mm, ratio in PRODUCTS]
    rows += [(mm, 1.0, deviations) for mm, deviations in CORNERS]
    for seed, (mm, ratio, deviations) in enumerate(rows, SEED):
        law = "laws of Jacques" if deviations is None else f"one law at {deviations:+.3f} sd"
        skins = draw(given.skins, seed, mm, ratio, deviations)
        judge(f"{mm} mm, {ratio:g} times the dermis, {law}", seed, *skins)


if __name__ == "__main__":
    main()
