"""Monte Carlo of two-layer skin whose pigments vary across its surface: the full reference.

Photons walk through a flat, periodic patch of skin in which melanin and blood are given per pixel.
It answers what a point-by-point table plus a blur must approximate, at low resolution and cost of
minutes; nothing in the simulated rig calls it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from rigsim.arrays import Float64Array
from rigsim.tissue import skin_layers


@dataclass(frozen=True, slots=True, eq=False)
class PatternedReflectance:
    """Diffuse reflectance of an evenly lit patch."""

    reflectance: Float64Array
    """Light that leaves each pixel over light that falls on each, shape (P, P)."""
    standard_error: Float64Array
    """Standard error from independent batches, shape (P, P)."""


def patterned_reflectance(
    c_m: ArrayLike,
    c_hd: ArrayLike,
    *,
    pixel_mm: float,
    wavelength_nm: float,
    photons: int,
    rng: np.random.Generator,
    batches: int = 32,
) -> PatternedReflectance:
    """Trace photons through skin with a pattern.

    Parameters
    ----------
    c_m, c_hd
        Volume fractions per pixel, shape (P, P); the patch repeats in both directions.
    pixel_mm
        Side of a pixel, mm, > 0.
    wavelength_nm
        Wavelength in nm, 400 to 700.
    photons
        Photons in all; they fall evenly and at normal incidence.
    rng
        Source of the batches' seeds.
    batches
        Independent batches, at least 8.

    Returns
    -------
    PatternedReflectance
        Without the specular part, as `rigsim.tissue.skin_table.SkinTable.spectra`.

    Notes
    -----
    Layers, scattering and absorption are those of `rigsim.tissue.skin_layers`; anisotropic
    scattering (Henyey-Greenstein), Fresnel reflection at the surface. Absorption attenuates along
    each flight, sampled at steps of at most half a pixel.
    """
    melanin, blood = np.asarray(c_m, np.float64), np.asarray(c_hd, np.float64)
    if melanin.ndim != 2 or melanin.shape != blood.shape or melanin.shape[0] != melanin.shape[1]:
        raise ValueError(f"c_m, c_hd: got {melanin.shape}, {blood.shape}, expected (P, P) twice")
    if not pixel_mm > 0.0 or photons < batches or batches < 8:
        raise ValueError(
            f"pixel_mm, photons, batches: got {pixel_mm}, {photons}, {batches}, "
            "expected > 0, at least one photon a batch, at least 8"
        )
    coats = [
        skin_layers.skin_layer_stack(wavelength_nm, float(m), float(h)).layers
        for m, h in zip(melanin.ravel(), blood.ravel(), strict=True)
    ]
    absorption = np.array([[layer.sigma_a_per_mm for layer in layers] for layers in coats])
    upper, lower = coats[0]
    counts = _walk(
        absorption.reshape(*melanin.shape, 2),
        np.array([upper.sigma_s_per_mm, lower.sigma_s_per_mm]),
        upper.thickness_mm,
        upper.g,
        upper.eta,
        float(pixel_mm),
        photons // batches,
        rng.integers(0, 2**31 - 1, batches),
    )
    per_pixel = photons // batches / melanin.size
    reflectance = counts / per_pixel
    return PatternedReflectance(
        reflectance.mean(axis=0), reflectance.std(axis=0, ddof=1) / math.sqrt(batches)
    )


@njit(cache=True, inline="always")
def _uniform():  # type: ignore[no-untyped-def]
    return np.random.random()  # noqa: NPY002


@njit(parallel=True, cache=True)
def _walk(absorption, scattering, thickness, g, eta, pixel, photons, seeds):  # type: ignore[no-untyped-def]
    """Return the weight that leaves each pixel, shape (batches, P, P)."""
    side = absorption.shape[0]
    counts = np.zeros((seeds.shape[0], side, side))
    width = side * pixel
    entered = 1.0 - ((eta - 1.0) / (eta + 1.0)) ** 2
    for batch in prange(seeds.shape[0]):
        # Compiled code has this generator only; a batch runs on one thread, so its seed decides.
        np.random.seed(seeds[batch])  # noqa: NPY002
        for _ in range(photons):
            x, y, z = _uniform() * width, _uniform() * width, 0.0
            ux, uy, uz = 0.0, 0.0, 1.0
            weight = entered
            optical = -math.log(1.0 - _uniform())
            while True:
                layer = 0 if z < thickness or (z == thickness and uz < 0.0) else 1
                flight = optical / scattering[layer]
                border = 0
                if uz < 0.0:
                    edge = (z if layer == 0 else z - thickness) / -uz
                    border = -1
                elif uz > 0.0 and layer == 0:
                    edge = (thickness - z) / uz
                    border = 1
                else:
                    edge = 1e30
                if flight < edge:
                    border = 0
                else:
                    flight = edge
                # Attenuation along the flight, sampled in the middle of short parts.
                parts = 1 + int(2.0 * flight / pixel)
                piece, depth = flight / parts, 0.0
                for k in range(parts):
                    column = int(((x + (k + 0.5) * piece * ux) / pixel) // 1.0) % side
                    row = int(((y + (k + 0.5) * piece * uy) / pixel) // 1.0) % side
                    depth += absorption[row, column, layer] * piece
                weight *= math.exp(-depth)
                x, y, z = x + flight * ux, y + flight * uy, z + flight * uz
                if border != 0:
                    optical -= flight * scattering[layer]
                    if layer == 0 and border < 0:
                        z = 0.0
                        inside = -uz
                        sine2 = eta * eta * (1.0 - inside * inside)
                        if sine2 >= 1.0:
                            uz = -uz
                            continue
                        outside = math.sqrt(1.0 - sine2)
                        rs = (eta * inside - outside) / (eta * inside + outside)
                        rp = (eta * outside - inside) / (eta * outside + inside)
                        reflected = 0.5 * (rs * rs + rp * rp)
                        row = int((y / pixel) // 1.0) % side
                        column = int((x / pixel) // 1.0) % side
                        counts[batch, row, column] += weight * (1.0 - reflected)
                        weight *= reflected
                        uz = -uz
                    else:
                        z = thickness
                else:
                    optical = -math.log(1.0 - _uniform())
                    part = (1.0 - g * g) / (1.0 - g + 2.0 * g * _uniform())
                    cosine = (1.0 + g * g - part * part) / (2.0 * g)
                    sine = math.sqrt(max(0.0, 1.0 - cosine * cosine))
                    phi = 2.0 * math.pi * _uniform()
                    a, b = sine * math.cos(phi), sine * math.sin(phi)
                    flat = math.sqrt(max(0.0, 1.0 - uz * uz))
                    if flat > 1e-5:
                        vx = (ux * uz * a - uy * b) / flat + ux * cosine
                        vy = (uy * uz * a + ux * b) / flat + uy * cosine
                        ux, uy, uz = vx, vy, -flat * a + uz * cosine
                    else:
                        ux, uy, uz = a, b, cosine if uz > 0.0 else -cosine
                    norm = math.sqrt(ux * ux + uy * uy + uz * uz)
                    ux, uy, uz = ux / norm, uy / norm, uz / norm
                if weight < 1e-3:
                    # Roulette: one in ten goes on with ten times the weight.
                    if _uniform() > 0.1:
                        break
                    weight *= 10.0
    return counts
