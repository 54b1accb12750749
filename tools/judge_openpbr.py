"""Judge the media of exported OpenPBR materials against the Monte Carlo simulation of tissue.

A half space of sigma_a, sigma_s' and g under index 1.4 is traced; its reflectance and sigma_tr are
exported as color and radius in float32. The albedo deficit, 1/sigma_tr, sigma_a and sigma_s' are
recovered from these two numbers and the index alone. The medium that OpenPBR specifies for them is
traced, too: isotropic, without a boundary. Prints errors of the parameters, and the ratios of decay
and of light at distances in units of 1/sigma_tr, each profile over its own total.

Usage: python tools/judge_openpbr.py [--photons N]
"""

from __future__ import annotations

import argparse
from math import inf, sqrt

import numpy as np

from model import dipole, fresnel
from rigsim.tissue.tissue_mc import Layer, LayerStack, TransportResult, trace_photons
from skinrig.exporting.materials import subsurface_radius
from skinrig.exporting.materials.material import similarity_albedo_deficit

ETA, G = 1.4, 0.8
MEDIA = {"red": (0.03, 1.4), "green": (0.15, 1.7), "blue": (0.35, 2.0), "dark": (0.9, 2.2)}
"""sigma_a and sigma_s', 1/mm."""
EDGES = np.array([0.0, 0.5, 1.0, 1.5, 2.5, 3.5, 5.0])
"""Rings, in units of 1/sigma_tr."""


def trace(layer: Layer, edges_mm: np.ndarray, photons: int, seed: int) -> TransportResult:
    """Return the reflection of a half space around a point of incidence."""
    rng = np.random.default_rng(seed)
    return trace_photons(LayerStack((layer,)), photons=photons, rng=rng, ring_edges_mm=edges_mm)


def decay_per_mm(result: TransportResult, edges_mm: np.ndarray) -> float:
    """Return the slope of log(r^2 R) between the middles of the rings beyond 1.5/sigma_tr."""
    area = np.pi * np.diff(edges_mm**2)
    middle = 0.5 * (edges_mm[1:] + edges_mm[:-1])
    far = slice(3, None)
    log = np.log(result.ring_reflectance[far] / area[far] * middle[far] ** 2)
    return -float(np.polyfit(middle[far], log, 1)[0])


def main() -> None:
    """Judge the media of the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photons", type=int, default=400_000)
    photons = parser.parse_args().photons
    print(
        "| medium | 1/sigma_tr read back | sigma_a, sigma_s' read back | decay "
        "| light within 1, 1 to 2.5, 2.5 to 5 |"
    )
    print("| --- | --- | --- | --- | --- |")
    for seed, (name, (sigma_a, sigma_s)) in enumerate(MEDIA.items()):
        sigma_t = sigma_a + sigma_s
        depth_mm = 1.0 / sqrt(3.0 * sigma_a * sigma_t)
        edges_mm = EDGES * depth_mm
        truth = trace(Layer(inf, sigma_a, sigma_s / (1.0 - G), G, ETA), edges_mm, photons, seed)
        inside = 1.0 - fresnel.diffuse_external(ETA)
        exported = float(similarity_albedo_deficit(np.array(truth.reflectance), ETA))
        color = float(np.float32(inside * truth.reflectance))
        radius_mm = float(np.float32(subsurface_radius.radius_mm(depth_mm, color, exported)))
        # back from color and radius, without the deficit of the export
        deficit = float(dipole.invert_to_deficit(np.array(color / inside), ETA))
        again_mm = float(subsurface_radius.translucency_mm(radius_mm, color, deficit))
        back_t = 1.0 / (again_mm * sqrt(3.0 * deficit))
        errors = (deficit * back_t / sigma_a - 1.0, (1.0 - deficit) * back_t / sigma_s - 1.0)
        lost = float(subsurface_radius.deficit_root(color)) ** 2
        medium = Layer(inf, lost / radius_mm, (1.0 - lost) / radius_mm, 0.0, 1.0)
        shown = trace(medium, edges_mm, photons, seed + 100)
        parts = [
            (one.ring_reflectance / one.reflectance).reshape(3, 2).sum(axis=1)
            for one in (shown, truth)
        ]
        slopes = [decay_per_mm(one, edges_mm) for one in (shown, truth)]
        light = ", ".join(f"{ratio:.2f}" for ratio in parts[0] / parts[1])
        print(
            f"| {name} | {again_mm / depth_mm - 1.0:+.1e} | {errors[0]:+.1%}, {errors[1]:+.1%} "
            f"| {slopes[0] / slopes[1]:.3f} | {light} |",
            flush=True,
        )
        print(
            f"color {color:.3f}, radius {radius_mm:.3f} mm; reflectance of the medium "
            f"{shown.reflectance:.3f}; dipole over simulation "
            f"{float(dipole.total_reflectance(sigma_s / sigma_t, ETA)) / truth.reflectance:.3f}"
        )


if __name__ == "__main__":
    main()
