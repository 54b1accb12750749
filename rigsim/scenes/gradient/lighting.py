"""Light a patch of skin by the gradient rig's LEDs: twelve images per strain step.

Per state one full image is computed, as Stokes vectors for each of the four moments of the light
(see `rigsim.light.lobe_moments`); patterns and analyzer angles are sums of these. The LEDs' light
on the relief comes from a Mitsuba scene (`rigsim.scenes.gradient.rendering`), or for large
images from tables and horizons.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy.fft

from rigsim import shading
from rigsim.arrays import BoolArray, Float32Array, Float64Array
from rigsim.as_built.sphere import ActualSphere
from rigsim.light.lobe_moments import (
    MicrofacetSurface,
    MomentTable,
    sum_led_moments,
    tabulate_moments,
)
from rigsim.light.relief_shadow import hidden_sky_fraction, horizon_tangent
from rigsim.light.shadowed_lights import subtract_hidden_led
from rigsim.scenes.gradient.patch import PatchSurface
from rigsim.scenes.gradient.rendering import TracedLight
from rigsim.skin_patch.microrelief import MicroSkin
from rigsim.tissue.skin_layers import ETA

BLOCK_ROWS: Final = 128
"""Rows per lookup, which bounds memory."""

SMOOTH_ALPHA: Final = 0.15
"""Roughness from which on the error of the smaller default table is below 0.2 %."""


@dataclass(frozen=True, slots=True, eq=False)
class TabulatedLight:
    """Light of the LEDs from a table over normals, less that of LEDs below the horizon."""

    sphere: ActualSphere
    surface: MicrofacetSurface
    table: MomentTable
    leds: tuple[int, ...]
    """LEDs in the table; with shadows only those above the patch's plane."""
    sectors: int
    """Number of directions with horizons, interpolated in between. 0: no shadows."""

    def packed(self, wide: PatchSurface, *, margin: int, pitch_um: float) -> Float32Array:
        """Return Stokes vectors and entering light; see `TracedLight`."""
        patch = wide.crop(margin)
        rows, columns = patch.skin.shape
        packed = np.empty((16, rows, columns), np.float32)
        for first in range(0, rows, BLOCK_ROWS):
            part = slice(first, first + BLOCK_ROWS)
            found = self._unshadowed_moments(patch, part)
            packed[:, part] = found.T.reshape(16, -1, columns)
        if self.sectors:
            height_um = wide.relief_um + wide.bulge_um
            self._remove_hidden(patch, height_um, margin, pitch_um, packed)
        return packed

    def _unshadowed_moments(self, patch: PatchSurface, part: slice) -> Float32Array:
        n = patch.normals[part].reshape(-1, 3)
        x, y = patch.x_mm[part].ravel(), patch.y_mm[part].ravel()
        alpha = patch.alpha[part].ravel()
        found = self.table.lookup(n, x, y, alpha)
        steep = np.flatnonzero(~self.table.covers(n))
        if steep.size:
            places = np.column_stack([x[steep], y[steep], np.zeros(steep.size)])
            found[steep] = sum_led_moments(
                n[steep], places, self.sphere, self.surface, leds=self.leds, alpha=alpha[steep]
            ).packed()
        return found

    def _remove_hidden(
        self,
        patch: PatchSurface,
        height_um: Float32Array,
        margin: int,
        pitch_um: float,
        packed: Float32Array,
    ) -> None:
        """Subtract, per LED, the light that the relief hides."""
        place = self.sphere.position_mm
        azimuth = np.arctan2(place[:, 1], place[:, 0]) % (2.0 * np.pi)
        where = azimuth / (2.0 * np.pi) * self.sectors
        inner = slice(margin, -margin or None)
        tangents: dict[int, Float32Array] = {}
        for led in sorted(self.leds, key=lambda k: float(where[k])):
            sector = int(where[led]) % self.sectors
            pair = (sector, (sector + 1) % self.sectors)
            tangents = {k: t for k, t in tangents.items() if k in pair}
            for k in pair:
                if k not in tangents:
                    angle = 2.0 * math.pi * k / self.sectors
                    full = horizon_tangent(height_um, pixel_um=pitch_um, azimuth_rad=angle)
                    tangents[k] = np.ascontiguousarray(full[inner, inner])
            horizon = (tangents[pair[0]], tangents[pair[1]], float(where[led]) - int(where[led]))
            subtract_hidden_led(packed, patch, horizon, self.sphere, led, self.surface)


@dataclass(frozen=True, slots=True, eq=False)
class PatchLighting:
    """Lighting data that do not change with the state."""

    direct: TracedLight | TabulatedLight
    """Light of the LEDs on the relief."""
    sigmas_mm: Float64Array
    """Widths of the lateral kernel of the skin; empty: light leaves where it entered."""
    weights: Float64Array
    """Their weights, sum 1."""
    groove_sectors: int = 0
    """Number of sky directions for interreflection in grooves; 0: none."""

    def stokes(self, wide: PatchSurface, *, margin: int, pitch_um: float) -> Float32Array:
        """Return the image of a patch before the lens, as Stokes vectors of the moments.

        Parameters
        ----------
        wide
            The surface, with ``margin`` more samples on all sides, which cast shadows.
        margin
            Number of those samples.
        pitch_um
            Sample pitch, um.

        Returns
        -------
        ndarray of float32
            Shape (12, H, W): Stokes vector of each moment, radiance.
        """
        patch = wide.crop(margin)
        rows, columns = patch.skin.shape
        packed = self.direct.packed(wide, margin=margin, pitch_um=pitch_um)
        packed[:12, ~patch.skin] = 0.0
        entering = self._scatter_laterally(packed[12:], patch.skin, 1e-3 * pitch_um)
        if self.groove_sectors:
            grid = {"margin": margin, "sectors": self.groove_sectors}
            hidden = hidden_sky_fraction(
                wide.relief_um + wide.bulge_um,
                patch.normals,
                pixel_um=pitch_um,
                boundaries=True,
                **grid,
            )
            entering += self._groove_interreflection(hidden, entering, patch, 1e-3 * pitch_um)
        surface = self.direct.surface
        right = surface.image_right
        eye = np.asarray(surface.eye_mm, np.float32)
        scale = np.float32(shading.interior_scale(ETA) / math.pi)
        out = packed[:12]
        for first in range(0, rows, BLOCK_ROWS):
            part = slice(first, first + BLOCK_ROWS)
            n = patch.normals[part].reshape(-1, 3)
            to_camera = eye - np.stack(
                [patch.x_mm[part], patch.y_mm[part], np.zeros_like(patch.x_mm[part])], axis=-1
            ).reshape(-1, 3)
            to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
            leaves = shading.exit_stokes(n, to_camera, eta=ETA, image_right=right)
            leaves = leaves.T.reshape(3, -1, columns) * (scale * patch.albedo[part])
            for m in range(4):
                out[3 * m : 3 * m + 3, part] += leaves * entering[m, part]
        return out

    def _groove_interreflection(
        self, hidden: Float32Array, entering: Float32Array, patch: PatchSurface, pitch_mm: float
    ) -> Float32Array:
        """Return the light that enters after interreflection in the relief, shape (4, H, W)."""
        if not patch.skin.any():
            return np.zeros_like(entering)
        once = (
            shading.interior_scale(ETA)
            * float(patch.albedo[patch.skin].mean())
            * hidden
            * patch.skin
        )
        further = 1.0 / (1.0 - float(once[patch.skin].mean()))
        return self._scatter_laterally(
            np.float32(further) * once.astype(np.float32) * entering, patch.skin, pitch_mm
        )

    def _scatter_laterally(
        self, entering: Float32Array, skin: BoolArray, pitch_mm: float
    ) -> Float32Array:
        """Scatter light laterally in the skin; the image is mirrored at its border."""
        if not self.sigmas_mm.size:
            return entering
        rows, columns = skin.shape
        fy = np.arange(rows) / (2.0 * rows * pitch_mm)
        fx = np.arange(columns) / (2.0 * columns * pitch_mm)
        square = (2.0 * np.pi**2 * (fy[:, None] ** 2 + fx[None, :] ** 2)).astype(np.float32)
        kernel = np.zeros_like(square)
        for sigma, weight in zip(self.sigmas_mm, self.weights, strict=True):
            kernel += np.float32(weight) * np.exp(-np.float32(sigma**2) * square)
        out = np.empty_like(entering)
        for m in range(4):
            # no light enters under the jaws, and light scattered there is lost
            field = np.where(skin, entering[m], 0.0)
            spectrum = scipy.fft.dctn(field, type=2, workers=2)
            spectrum *= kernel
            out[m] = scipy.fft.idctn(spectrum, type=2, workers=2)
            out[m][~skin] = entering[m][~skin]
        return out


def tabulate_light(
    skin: MicroSkin,
    sphere: ActualSphere,
    surface: MicrofacetSurface,
    *,
    half_field_mm: float,
    sectors: int,
    table_size: int | None,
) -> TabulatedLight:
    """Tabulate the LEDs' light on a patch of skin.

    Parameters
    ----------
    skin
        The patch, for its roughness.
    sphere
        The LEDs.
    surface
        The camera and the polarizers; the roughness is the patch's.
    half_field_mm
        Half the side of the field, mm.
    sectors
        Number of directions of horizons; 0 omits shadows, and light then comes also from below the
        patch's plane where the relief tilts that way.
    table_size
        Nodes along each axis of the normals; None chooses by roughness.
    """
    leds = lit_leds(sphere, shadows=sectors > 0)
    alphas = (float(skin.alpha.min()), float(skin.alpha.max()))
    table = tabulate_moments(
        sphere,
        surface,
        half_field_mm=half_field_mm,
        alpha_range=alphas,
        size=table_size or (65 if alphas[0] >= SMOOTH_ALPHA else 129),
        fields=2 if half_field_mm < 1.6 else 3,
        leds=leds,
    )
    return TabulatedLight(sphere, surface, table, leds, sectors)


def lit_leds(sphere: ActualSphere, *, shadows: bool) -> tuple[int, ...]:
    """Return the LEDs that light a patch: with shadows those above its plane, otherwise all."""
    return tuple(k for k, (_, _, z) in enumerate(sphere.position_mm) if not shadows or z > 0.0)
