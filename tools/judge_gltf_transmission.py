"""Judge the diffuse transmission of exported glTF materials against Monte Carlo slabs of tissue.

A half space of sigma_a, sigma_s' and g under index 1.4 is traced; its reflectance and sigma_tr are
exported as glTF's transmission. Slabs of the same medium, in units of 1/sigma_tr thick, are traced
and compared with what the exported numbers transmit, over the light that enters. Prints 1/sigma_tr
as read back, and ratios of exported over traced transmittance with the standard error of the last.

Usage: python tools/judge_gltf_transmission.py [--photons N]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from math import inf, sqrt

import numpy as np

from model import fresnel
from rigsim.tissue.tissue_mc import Layer, LayerStack, TransportResult, trace_photons
from skinrig.exporting.materials.diffuse_transmission import DiffuseTransmission
from skinrig.exporting.materials.material import similarity_albedo_deficit

ETA, G = 1.4, 0.8
MEDIA = {"red": (0.03, 1.4), "green": (0.15, 1.7), "blue": (0.35, 2.0), "dark": (0.9, 2.2)}
"""sigma_a and sigma_s', 1/mm."""
THICKNESSES = (0.5, 1.0, 2.0, 4.0)
"""In units of 1/sigma_tr."""


def trace(layer: Layer, photons: int, seed: list[int]) -> TransportResult:
    """Return the light that one layer reflects and transmits."""
    return trace_photons(LayerStack((layer,)), photons=photons, rng=np.random.default_rng(seed))


def main() -> None:
    """Judge the media of the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photons", type=int, default=200_000)
    photons = parser.parse_args().photons
    heads = ", ".join(f"{one:g}" for one in THICKNESSES)
    print(f"| medium | 1/sigma_tr read back | exported over traced at {heads} / sigma_tr |")
    print("| --- | --- | --- |")
    entering = 1.0 - fresnel.normal_reflectance(ETA)
    for seed, (name, (sigma_a, sigma_s)) in enumerate(MEDIA.items()):
        depth_mm = 1.0 / sqrt(3.0 * sigma_a * (sigma_a + sigma_s))

        medium = Layer(inf, sigma_a, sigma_s / (1.0 - G), G, ETA)
        r_d = trace(medium, photons, [seed, 0]).reflectance
        deficit = similarity_albedo_deficit(np.array([r_d] * 3), ETA)
        made = DiffuseTransmission.of(
            [depth_mm] * 3, deficit, eta=ETA, max_factor=1.0, thickness_m=0.1
        )
        ratios = []
        error = 0.0
        for number, thickness in enumerate(THICKNESSES, 1):
            layer = replace(medium, thickness_mm=thickness * depth_mm)
            slab = trace(layer, photons, [seed, number])
            ratios.append(made.transmit(thickness * depth_mm)[0] * entering / slab.transmittance)
            error = ratios[-1] * slab.transmittance_stderr / slab.transmittance
        shown = ", ".join(f"{one:.2f}" for one in ratios)
        back = made.translucency_mm[0] / depth_mm - 1.0
        print(f"| {name} ({sigma_a:g}, {sigma_s:g}) | {back:+.0e} | {shown} (±{error:.2f}) |")


if __name__ == "__main__":
    main()
