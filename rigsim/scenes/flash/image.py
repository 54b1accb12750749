"""Render the flash rig's image of a face or a target, with its ground-truth maps."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from capture.rig import Rig, View
from rigsim import shading
from rigsim.arrays import BoolArray, Float32Array, Float64Array
from rigsim.as_built.polarizers import Polarizers, absorbing_axis
from rigsim.geometry.atlas import dilate_texture, sample
from rigsim.light.observed_skin import ObservedSkin
from rigsim.light.olat import pixel_order
from rigsim.light.subsurface_radiance import (
    SubsurfaceRadiance,
    direction_and_falloff,
    scatter_through_pigment,
)
from rigsim.render import Caster, GBuffer, RenderError, g_buffer
from rigsim.render.depth_of_field import DefocusKernels, LensImage, depth_before_focus
from rigsim.subject import SimulatedSubject
from rigsim.targets import Target
from rigsim.tissue.skin_layers import ETA

RAYS_PER_BAND: Final = 1 << 21
"""Camera rays per batch; bounds memory at full resolution."""

WHITE_SCALE: Final = np.float32(4.0)
"""Scale for which Stokes S0 of the white reference is 1 behind an ideal analyzer, when filtered
light is in units of unfiltered irradiance over pi: each polarizer transmits half."""

_LIGHT_NAMES: Final = ("diffuse", "specular", "shading")

ImageLayers = dict[str, Float32Array]


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
    """One camera of the rig with its polarizers, lights and lens."""

    rig: Rig
    """The rig."""
    view: View
    """The camera."""
    polarizers: Polarizers
    """The polarizers."""
    weights: Float64Array
    """Energy of each light over the total of a plate at the origin, mm^2."""
    subpixels: int
    """Rays along each side of a pixel."""
    defocus: DefocusKernels | None = None
    """Blur kernels of the lens; None: sharp everywhere."""

    def observe_face(
        self, caster: Caster, subject: SimulatedSubject, state: str, glow: SubsurfaceRadiance
    ) -> FlashImage:
        """Render a face.

        Parameters
        ----------
        caster
            The face's mesh.
        subject, state
            The face, and its state.
        glow
            Light on and from inside the face.

        Returns
        -------
        FlashImage
            With all ground-truth maps except those of `blurred_maps`.
        """
        textures = _textures(subject, state, glow)
        return self._in_bands(caster, lambda buffers: self._see_skin(buffers, textures))

    def observe_target(self, caster: Caster, target: Target) -> FlashImage:
        """Render a target that reflects.

        Parameters
        ----------
        caster
            The target's mesh.
        target
            A diffuse or a metal target.

        Returns
        -------
        FlashImage
            Without ground-truth maps.
        """
        return self._in_bands(caster, lambda buffers: self._see_target(buffers, target))

    def _in_bands(self, caster: Caster, see: Callable[[GBuffer], ImageLayers]) -> FlashImage:
        k, view = self.subpixels, self.view
        rows_per_band = max(1, RAYS_PER_BAND // (view.width_px * k * k))
        around = 0 if self.defocus is None else self.defocus.radius
        bands = []
        for top in range(0, view.height_px, rows_per_band):
            bottom = min(top + rows_per_band, view.height_px)
            first = max(top - around, 0)
            rows = (first, min(bottom + around, view.height_px))
            buffers = g_buffer(caster, view, subpixels=k, rows=rows)
            parts = see(buffers)
            small, coverage = _shrink(parts, buffers.mask, k)
            small["reached"] = coverage
            if self.defocus is not None:
                small |= _blur_through_lens(parts, buffers, view, self.defocus)
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
        diffuse, specular, white = (maps.pop(name) for name in _LIGHT_NAMES)
        reached = maps.pop("reached")
        return FlashImage(
            diffuse.reshape(*coverage.shape, 3, 3), specular, white, maps, coverage, reached
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
        skin = ObservedSkin(subject, state, camera, light)
        even = subject.atlas.covered.astype(np.float32)
        blurred = scatter_through_pigment(skin, glow.reflectance, even, glow.kernels)
        melanin, blood = skin.color.nearest_fractions(
            blurred, subject.melanin, skin.blood_volume_fraction
        )
        return {
            "reflectance_blurred": blurred,
            "melanin_blurred": melanin,
            "hemoglobin_blurred": blood,
        }

    def observe_maps(
        self, caster: Caster, subject: SimulatedSubject, maps: Mapping[str, Float32Array]
    ) -> FlashImage:
        """Render maps of a face without light.

        Parameters
        ----------
        caster
            The face's mesh.
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
        return self._in_bands(caster, lambda buffers: self._see_maps(buffers, textures))

    def _see_maps(self, buffers: GBuffer, textures: dict[str, Float32Array]) -> ImageLayers:
        inside, uv, *_ = buffers.hit_samples()
        everywhere = np.ones(len(inside), np.bool_)
        parts = {"diffuse": np.zeros((len(inside), 3, 3), np.float32)}
        parts |= {name: np.zeros((len(inside), 3), np.float32) for name in _LIGHT_NAMES[1:]}
        for name, layer in textures.items():
            values = sample(layer, uv, everywhere)
            parts[name] = values[:, 0] if values.shape[1] == 1 else values
        return {name: _scatter(values, inside, buffers.mask) for name, values in parts.items()}

    def _see_skin(self, buffers: GBuffer, textures: dict[str, Float32Array]) -> ImageLayers:
        inside, uv, position, _, to_camera = buffers.hit_samples()
        everywhere = np.ones(len(inside), np.bool_)
        seen = {name: sample(layer, uv, everywhere) for name, layer in textures.items()}
        normal = seen["normals"]
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
        right = self.view.axes[0]
        leaving = shading.exit_stokes(normal, to_camera, eta=ETA, image_right=right)
        alpha = np.clip(seen["roughness"][:, 0], *shading.ALPHA_RANGE)
        bare = 1.0 - seen["hair"]  # hair occludes the skin and its specular reflection
        specular = np.zeros_like(leaving)
        for k, light in enumerate(self.rig.lights):
            to_light, falloff = direction_and_falloff(light, position)
            lobe = shading.specular_stokes(
                normal,
                to_light,
                to_camera,
                alpha,
                eta=ETA,
                light_absorbs=absorbing_axis(light),
                image_right=right,
                extinction=self.polarizers.light_extinction,
            )
            strength = np.float32(self.weights[k] * math.pi) * falloff * seen["visible"][:, k]
            specular += strength[:, None] * lobe
        scale = np.float32(shading.interior_scale(ETA))
        parts = {
            "diffuse": WHITE_SCALE * leaving[:, :, None] * seen.pop("glow")[:, None, :],
            "specular": WHITE_SCALE * bare * specular,
            "shading": WHITE_SCALE * scale * seen.pop("entered") * leaving,
            "position_mm": position,
            "uv": uv,
        }
        del seen["visible"]
        parts |= {
            name: values[:, 0] if values.shape[1] == 1 else values for name, values in seen.items()
        }
        return {name: _scatter(values, inside, buffers.mask) for name, values in parts.items()}

    def _see_target(self, buffers: GBuffer, target: Target) -> ImageLayers:
        inside, uv, position, normal, to_camera = buffers.hit_samples()
        camera, spectrum = self.view.spectral_sensitivity, self.rig.lights[0].illuminant
        rgb = _nearest(target.rgb(camera, spectrum), uv)
        leak = 1.0 / self.polarizers.light_extinction
        diffuse = np.zeros((len(inside), 3, 3), np.float32)
        specular = np.zeros((len(inside), 3), np.float32)
        for k, light in enumerate(self.rig.lights):
            to_light, falloff = direction_and_falloff(light, position)
            strength = WHITE_SCALE * np.float32(self.weights[k]) * falloff
            if target.kind == "metal":
                lobe = shading.specular_stokes(
                    normal,
                    to_light,
                    to_camera,
                    target.alpha,
                    eta=ETA,
                    light_absorbs=absorbing_axis(light),
                    image_right=self.view.axes[0],
                    extinction=self.polarizers.light_extinction,
                    metal=float(target.palette.mean()),
                )
                specular += np.float32(math.pi) * strength[:, None] * lobe
            else:
                cosine = np.maximum(np.einsum("ij,ij->i", normal, to_light), 0.0)
                passed = np.float32(0.5 * (1.0 + leak)) * strength * cosine
                diffuse[:, 0] += passed[:, None] * rgb
        parts = {"diffuse": diffuse, "specular": specular, "shading": np.zeros_like(specular)}
        return {name: _scatter(values, inside, buffers.mask) for name, values in parts.items()}


def _textures(
    subject: SimulatedSubject, state: str, glow: SubsurfaceRadiance
) -> dict[str, Float32Array]:
    """Return the texture maps that the camera samples, shape (N, N, C) each."""
    layers = {
        "glow": glow.scattered,
        "visible": glow.surface.visible,
        "reflectance": glow.reflectance,
        "normals": subject.normal,
        "irradiance": glow.surface.irradiance,
        "entered": glow.surface.entered,
        "roughness": subject.roughness,
        "hair": subject.hair,
        "melanin": subject.melanin,
        "hemoglobin": subject.hemoglobin(state),
    }
    if subject.rest is not None:
        layers["position_at_rest_mm"] = subject.rest.atlas.position_mm
    return _dilate_textures(layers, subject)


def _dilate_textures(
    layers: Mapping[str, Float32Array], subject: SimulatedSubject
) -> dict[str, Float32Array]:
    """Return textures with dilated borders, so that sampling may interpolate, (N, N, C) each."""
    covered = subject.atlas.covered
    return {name: dilate_texture(np.atleast_3d(layer), covered) for name, layer in layers.items()}


def _scatter(values: Float32Array, inside: NDArray[np.int_], mask: BoolArray) -> Float32Array:
    out = np.zeros((mask.size, *values.shape[1:]), np.float32)
    out[inside] = values
    return out.reshape(*mask.shape, *values.shape[1:])


def _blur_through_lens(
    parts: ImageLayers, buffers: GBuffer, view: View, spread: DefocusKernels
) -> ImageLayers:
    """Return the parts of an image after lens blur, at the sensor's resolution."""
    k = spread.subpixels
    order, pixel, first, slot = pixel_order(buffers.mask, k)
    shape = (buffers.mask.shape[0] // k, buffers.mask.shape[1] // k)
    toward = depth_before_focus(view, buffers.position_mm.reshape(-1, 3)[order])
    lens = LensImage(spread, shape, pixel, first, slot, toward)
    light = [parts[name].reshape(buffers.mask.size, -1)[order] for name in ("diffuse", "specular")]
    seen = lens.render(np.concatenate([*light, np.ones((len(order), 1), np.float32)], axis=1))
    wide = light[0].shape[1]
    return {
        "diffuse": seen[..., :wide].reshape(*shape, *parts["diffuse"].shape[2:]),
        "specular": seen[..., wide:-1],
        "reached": seen[..., -1],
    }


def _shrink(parts: ImageLayers, mask: BoolArray, k: int) -> tuple[ImageLayers, Float32Array]:
    """Average over pixels: light over the whole pixel, maps over its covered part."""

    def mean(image: Float32Array) -> Float32Array:
        height, width = image.shape[0] // k, image.shape[1] // k
        flat = image.reshape(height, k, width, k, -1)
        return np.asarray(flat.mean(axis=(1, 3)), np.float32)

    coverage = mean(mask.astype(np.float32))
    share = np.maximum(coverage, 1e-6)
    out = {}
    for name, image in parts.items():
        small = mean(image)
        if name not in _LIGHT_NAMES:
            small /= share
        if name == "normals":
            small /= np.maximum(np.linalg.norm(small, axis=-1, keepdims=True), 1e-6)
        out[name] = small[..., 0] if image.ndim == 2 else small
    return out, coverage[..., 0]


def _nearest(texture: Float32Array, uv: Float32Array) -> Float32Array:
    size = texture.shape[0]
    column = np.clip((uv[:, 0] * size).astype(np.int64), 0, size - 1)
    row = np.clip(((1.0 - uv[:, 1]) * size).astype(np.int64), 0, size - 1)
    return texture[row, column]
