"""Estimate the relief of a patch of skin in one state, and its normals, from specular normals.

The lens averages light, so its blur is undone in the light. The relief that follows shows which
lights it hides from its own grooves, and the normals are corrected for them. Normals are then those
of one continuous surface, which halves the variance of their noise.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import fft, ndimage

from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float32Array, FloatArray
from reconstruction.gradient_normals.occlusion import correct_occlusion
from reconstruction.gradient_normals.sphere_lights import SphereLights
from reconstruction.normal_histogram.relief_slopes import slopes
from reconstruction.normal_integration import HeightMap, integrate_map
from reconstruction.normal_integration.height_filters import high_pass
from reconstruction.normal_integration.lens_restoration import (
    PAD_PX,
    Aperture,
    RestoredNormals,
    filter_by_transfer,
    restore_normals,
)
from reconstruction.normal_integration.slope_fields import Perspective
from reconstruction.normal_maps import NormalMaps

_log = logging.getLogger(__name__)

CUTOFF_UM = 1000.0
"""Longest wavelength of the surface topography (Nagano et al. 2015, section 4)."""
OCCLUSION_STEPS: Final = 1
"""Corrections for occlusion; a second one changes heights by 0.03 to 0.4 % of their RMS."""
STDERR_SAMPLES = 6
STDERR_SIGMA_PX = 8.0


@dataclass(frozen=True, slots=True)
class PatchOptics:
    """Camera, lens and lights of a patch.

    Attributes
    ----------
    pixel_um : float
        Size of a pixel on the skin, um.
    camera : Perspective
    lens : Aperture
    lights : SphereLights
    alpha : float
        GGX roughness of the facets within a pixel.
    """

    pixel_um: float
    camera: Perspective
    lens: Aperture
    lights: SphereLights
    alpha: float


@dataclass(frozen=True, slots=True)
class PatchRelief:
    """Relief of one state.

    Attributes
    ----------
    surface : HeightMap
        With all wavelengths, um.
    noise : RestoredNormals
        Noise of the slopes, and the filter of their errors.
    stderr_rad : ndarray, shape (H, W)
        Weights of the normals.
    optics : PatchOptics
    """

    surface: HeightMap
    noise: RestoredNormals
    stderr_rad: FloatArray
    optics: PatchOptics

    def seen_normals(self) -> Float32Array:
        """Return the surface's normals as the lens resolves them, (H, W, 3), unit vectors."""
        x, y, known = slopes(
            self.surface.height, pixel=self.optics.pixel_um, valid=self.surface.valid
        )
        rows, columns = (side + 2 * PAD_PX for side in known.shape)
        waves = (fft.fftfreq(columns)[None], fft.fftfreq(rows)[:, None])
        per_um = [wave / self.optics.pixel_um for wave in waves]
        through = self.optics.lens.transfer(*per_um)
        x, y = (filter_by_transfer(np.where(known, slope, 0.0), through) for slope in (x, y))
        return unit_vectors(np.stack([-x, -y, np.ones_like(x)], axis=-1)).astype(np.float32)

    def height(self) -> FloatArray:
        """Return the heights without wavelengths above `CUTOFF_UM`, (H, W), um."""
        return _leveled(self.surface, self.optics)

    def sample_errors(self) -> tuple[Float32Array, Float32Array]:
        """Return the heights' standard error, and the error's variance of one slope, each (H, W).

        Errors are of noise and of relief below the noise. Random fields of slopes are integrated in
        the same way. A pixel without slopes has variance 0.
        """
        rng = np.random.default_rng(0)
        valid, pixel_um = self.surface.valid, self.optics.pixel_um
        total, of_slopes = np.zeros(valid.shape), np.zeros(valid.shape)
        if not valid.any():
            return np.full(valid.shape, np.inf, np.float32), of_slopes.astype(np.float32)
        for _ in range(STDERR_SAMPLES):
            x, y = self.noise.sample_errors(rng)
            field = np.stack([-x, -y, np.ones_like(x)], axis=-1)
            found = _integrate(field, valid, self.stderr_rad, self.optics)
            height = _leveled(found, self.optics).astype(np.float64)
            total += height**2
            slope_x, slope_y, _ = slopes(height, pixel=pixel_um, valid=valid)
            of_slopes += 0.5 * (slope_x**2 + slope_y**2)
        # noise is nearly stationary, so its variance is smooth except at borders
        weight = ndimage.gaussian_filter(valid.astype(float), STDERR_SIGMA_PX)
        even = ndimage.gaussian_filter(total, STDERR_SIGMA_PX) / np.maximum(weight, 1e-3)
        stderr = np.where(valid, np.sqrt(even / STDERR_SAMPLES), np.inf).astype(np.float32)
        return stderr, (of_slopes / STDERR_SAMPLES).astype(np.float32)


def estimate_relief(
    clear: NormalMaps,
    plain: NormalMaps,
    blurred: NormalMaps,
    skin: BoolArray,
    optics: PatchOptics,
    *,
    name: str,
) -> PatchRelief:
    """Estimate the relief of one state.

    Parameters
    ----------
    clear
        Normals of the light with the lens's blur undone.
    plain
        Normals of the images as they are, whose noise is white.
    blurred
        Normals of the light without noise beyond its detail, which fill the holes of the others.
    skin
        (H, W): pixels on skin.
    optics
        Camera, lens and lights.
    name
        Name of the state, for a warning if the integration does not converge.
    """
    known = (clear.valid | blurred.valid) & skin
    # noise moves single pixels of steep grooves outside the range of a lobe; a hole there would cut
    # the height map, so these pixels take the filtered normal
    first, second = (
        np.where(one.valid[..., None], one.normals, blurred.normals) for one in (clear, plain)
    )
    noise = restore_normals(second, lens=optics.lens, valid=known)
    # steep walls of grooves are dim and partly hidden, so they have less weight
    found = _integrate(first, known, blurred.stderr_rad, optics)
    for _ in range(OCCLUSION_STEPS):
        normals = correct_occlusion(
            first,
            _leveled(found, optics),
            found.valid,
            pixel_um=optics.pixel_um,
            lights=optics.lights,
            alpha=optics.alpha,
        )
        found = _integrate(normals, known, blurred.stderr_rad, optics)
    found.convergence.warn_unless_converged(f"height of {name}", _log)
    return PatchRelief(found, noise, blurred.stderr_rad, optics)


def _integrate(
    normals: FloatArray, known: BoolArray, stderr_rad: FloatArray, optics: PatchOptics
) -> HeightMap:
    return integrate_map(
        normals, valid=known, pixel=optics.pixel_um, camera=optics.camera, stderr_rad=stderr_rad
    )


def _leveled(surface: HeightMap, optics: PatchOptics) -> FloatArray:
    return high_pass(surface.height, pixel=optics.pixel_um, cutoff=CUTOFF_UM, valid=surface.valid)
