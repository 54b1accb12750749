"""Render the flash rig's image of a face or a target, with its ground-truth maps."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from capture.rig import Rig, View
from rigsim import shading
from rigsim.arrays import Float32Array
from rigsim.geometry.atlas import dilate_texture, sample
from rigsim.light.observed_skin import observe_skin
from rigsim.light.subsurface_radiance import SubsurfaceRadiance, scatter_through_pigment
from rigsim.mitsuba.render_error import RenderError
from rigsim.render.depth_of_field import DefocusKernels, LensImage, depth_before_focus
from rigsim.scenes.flash.surfaces import CameraHits, FlashSurface
from rigsim.subject import SimulatedSubject
from rigsim.tissue.skin_layers import ETA

RAYS_PER_BAND: Final = 1 << 21
"""Camera rays per batch; bounds memory at full resolution."""

WHITE_SCALE: Final = np.float32(4.0)
"""Scale for which Stokes S0 of the white reference is 1 behind an ideal analyzer, when filtered
light is in units of unfiltered irradiance over pi: each polarizer transmits half."""

_LIGHT_NAMES: Final = ("diffuse", "specular", "shading")

ImageLayers = dict[str, Float32Array]
TraceRows = Callable[[View, int, tuple[int, int]], CameraHits]


@dataclass(frozen=True, slots=True, eq=False)
class FlashImage:
    """Image of a camera, averaged over each pixel; light in units of the white reference."""

    diffuse: Float32Array
    """Subsurface light, shape (H, W, 3 Stokes, 3 RGB), white-balanced, after the lens."""
    specular: Float32Array
    """Surface light, shape (H, W, 3 Stokes), after the lens."""
    shading: Float32Array
    """Subsurface light of a skin of reflectance 1, shape (H, W, 3 Stokes), without the lens."""
    maps: ImageLayers
    """Ground-truth maps, averaged over each pixel's covered part."""
    coverage: Float32Array
    """Covered fraction of each pixel, shape (H, W), without the lens."""
    surface_fraction: Float32Array
    """Fraction of each pixel's light that comes from a surface, shape (H, W)."""


@dataclass(frozen=True, slots=True, eq=False)
class FlashCamera:
    """One camera of the rig with its lens."""

    rig: Rig
    """The rig."""
    view: View
    """The camera."""
    subpixels: int
    """Rays along each side of a pixel."""
    defocus: DefocusKernels | None = None
    """Blur kernels of the lens; None: sharp everywhere."""

    def observe_face(
        self, surface: FlashSurface, subject: SimulatedSubject, state: str, glow: SubsurfaceRadiance
    ) -> FlashImage:
        """Render a face.

        Parameters
        ----------
        surface
            The face's surface.
        subject, state
            The face, and its state.
        glow
            Light on and from inside the face.

        Returns
        -------
        FlashImage
            With all ground-truth maps except those of `blurred_maps`.
        """
        textures = _textures(subject, state, glow, surface.shadows(glow.surface))
        return self._in_bands(surface.trace, lambda hits: self._see_skin(surface, hits, textures))

    def observe_target(self, surface: FlashSurface) -> FlashImage:
        """Render a target that reflects.

        Parameters
        ----------
        surface
            The target's surface.

        Returns
        -------
        FlashImage
            Without ground-truth maps.
        """
        return self._in_bands(surface.trace, lambda hits: self._see_target(surface, hits))

    def _in_bands(self, trace: TraceRows, see: Callable[[CameraHits], ImageLayers]) -> FlashImage:
        k, view = self.subpixels, self.view
        rows_per_band = max(1, RAYS_PER_BAND // (view.width_px * k * k))
        around = 0 if self.defocus is None else self.defocus.radius
        bands = []
        for top in range(0, view.height_px, rows_per_band):
            bottom = min(top + rows_per_band, view.height_px)
            first = max(top - around, 0)
            rows = (first, min(bottom + around, view.height_px))
            hits = trace(view, k, rows)
            parts = see(hits)
            small, coverage = _average(parts, hits)
            small["reached"] = coverage
            if self.defocus is not None:
                small |= _blur_through_lens(parts, hits, view, self.defocus)
            inner = slice(top - first, bottom - first)
            bands.append(({name: part[inner] for name, part in small.items()}, coverage[inner]))
        maps: ImageLayers = {
            name: np.concatenate([band[0][name] for band in bands]) for name in bands[0][0]
        }
        coverage = np.concatenate([band[1] for band in bands])
        for name, values in maps.items():
            if not np.isfinite(values).all():
                raise RenderError(
                    f"{name}: rendering gave values that are not finite; report this scene"
                )
        reached = maps.pop("reached")
        dark = np.broadcast_to(np.float32(0.0), (*coverage.shape, 3, 3))
        return FlashImage(
            maps.pop("diffuse", dark),
            maps.pop("specular", dark[..., 0]),
            maps.pop("shading", dark[..., 0]),
            maps,
            coverage,
            reached,
        )

    def blurred_maps(
        self, subject: SimulatedSubject, state: str, glow: SubsurfaceRadiance
    ) -> dict[str, Float32Array]:
        """Return fractions and reflectance of uniform skin with the appearance of the blurred skin.

        Parameters
        ----------
        subject, state
            The face, and its state.
        glow
            Light on and from inside the face, with lateral scattering.

        Returns
        -------
        dict
            Textures of shape (N, N[, 3]).
        """
        camera, light = self.view.spectral_sensitivity, self.rig.lights[0].illuminant
        skin = observe_skin(subject, state, camera, light)
        even = subject.atlas.covered.astype(np.float32)
        if glow.pigment is None:
            raise ValueError("glow: got one without lateral scattering, expected one with it")
        blurred = scatter_through_pigment(skin, glow.pigment, even, glow.kernels)
        melanin, blood = skin.fractions_of(blurred)
        return {
            "reflectance_blurred": blurred,
            "melanin_blurred": melanin,
            "hemoglobin_blurred": blood,
        }

    def observe_maps(
        self, surface: FlashSurface, subject: SimulatedSubject, maps: Mapping[str, Float32Array]
    ) -> FlashImage:
        """Render maps of a face without light.

        Parameters
        ----------
        surface
            The face's surface.
        subject
            The face.
        maps
            Textures of shape (N, N[, C]).

        Returns
        -------
        FlashImage
            With these ground-truth maps only; no light.
        """
        textures = _dilate_textures(maps, subject)
        return self._in_bands(surface.trace, lambda hits: _look_up(textures, hits))

    def _see_skin(
        self, surface: FlashSurface, hits: CameraHits, textures: ImageLayers
    ) -> ImageLayers:
        seen = _look_up(textures, hits)
        leaving, specular = surface.skin_stokes(hits, self.view, seen)
        scale = np.float32(shading.interior_scale(ETA))
        seen.pop("shadows", None)
        return {
            "diffuse": WHITE_SCALE * leaving[:, :, None] * seen.pop("glow")[:, None, :],
            "specular": WHITE_SCALE * specular,
            "shading": WHITE_SCALE * scale * seen.pop("entered")[:, None] * leaving,
            "position_mm": hits.position_mm,
            "uv": hits.uv,
            **seen,
        }

    def _see_target(self, surface: FlashSurface, hits: CameraHits) -> ImageLayers:
        parts = _dark(hits)
        diffuse, specular = surface.target_light(hits, self.view)
        parts["diffuse"][:, 0] = WHITE_SCALE * diffuse
        return parts | {"specular": WHITE_SCALE * specular}


def _dark(hits: CameraHits) -> ImageLayers:
    """Return light of zero at hits."""
    parts = {name: np.zeros((hits.count, 3), np.float32) for name in _LIGHT_NAMES}
    return parts | {"diffuse": np.zeros((hits.count, 3, 3), np.float32)}


def _look_up(textures: ImageLayers, hits: CameraHits) -> ImageLayers:
    """Return textures at hits, shape (n[, C])."""
    everywhere = np.ones(hits.count, np.bool_)
    return {name: sample(layer, hits.uv, everywhere) for name, layer in textures.items()}


def _textures(
    subject: SimulatedSubject, state: str, glow: SubsurfaceRadiance, shadows: Float32Array | None
) -> ImageLayers:
    """Return the textures that the camera samples, shape (N, N[, C]) each."""
    layers = {
        "glow": glow.scattered,
        "reflectance": glow.reflectance,
        "normals": subject.normal,
        "irradiance": glow.surface.irradiance,
        "entered": glow.surface.entered,
        "roughness": subject.roughness,
        "hair": subject.hair,
        "melanin": subject.melanin,
        "hemoglobin": subject.hemoglobin(state),
    }
    if shadows is not None:
        layers["shadows"] = shadows
    if subject.rest is not None:
        layers["position_at_rest_mm"] = subject.rest.atlas.position_mm
    return _dilate_textures(layers, subject)


def _dilate_textures(layers: Mapping[str, Float32Array], subject: SimulatedSubject) -> ImageLayers:
    """Return textures with dilated borders, so that sampling may interpolate."""
    return {name: dilate_texture(layer, subject.atlas.covered) for name, layer in layers.items()}


def _blur_through_lens(
    parts: ImageLayers, hits: CameraHits, view: View, spread: DefocusKernels
) -> ImageLayers:
    """Return the light and the coverage after lens blur, at the sensor's resolution."""
    toward = depth_before_focus(view, hits.position_mm)
    lens = LensImage(spread, hits.shape, hits.pixel, hits.first, hits.slot, toward)
    blurred: ImageLayers = {}
    for name, part in parts.items():
        if name in ("diffuse", "specular"):
            blurred[name] = part
    blurred["reached"] = np.ones(hits.count, np.float32)
    return _split(lens.render(_joined(blurred)), blurred)


def _average(parts: ImageLayers, hits: CameraHits) -> tuple[ImageLayers, Float32Array]:
    """Average over pixels: light over the whole pixel, maps over its covered part."""
    coverage = hits.coverage()
    # layer by layer: all layers together would be a copy of 200 bytes for each ray
    out = {name: hits.average(part) for name, part in parts.items()}
    for name in out.keys() & set(_LIGHT_NAMES):
        out[name] *= coverage.reshape(*hits.shape, *[1] * (out[name].ndim - 2))
    if "normals" in out:
        normal = out["normals"]
        out["normals"] = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    return out, coverage


def _joined(parts: ImageLayers) -> Float32Array:
    """Return layers as columns, shape (n, C)."""
    return np.concatenate([part.reshape(len(part), -1) for part in parts.values()], axis=1)


def _split(image: Float32Array, parts: ImageLayers) -> ImageLayers:
    """Invert `_joined` for an image, shape (H, W, C)."""
    out, end = {}, 0
    for name, part in parts.items():
        start, end = end, end + math.prod(part.shape[1:])
        out[name] = image[..., start:end].reshape(*image.shape[:2], *part.shape[1:])
    return out
