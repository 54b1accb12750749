"""What a camera of the flash rig sees of a face or a target, with its truth maps."""

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
from rigsim.light.olat import pixel_order
from rigsim.light.seen_skin import SeenSkin
from rigsim.light.subsurface_radiance import SubsurfaceRadiance, spread_through_pigment, toward
from rigsim.render import Caster, GBuffer, RenderError, g_buffer
from rigsim.render.depth_of_field import LensPicture, LensSpread, before_focus
from rigsim.subject import SimulatedSubject
from rigsim.targets import Target
from rigsim.tissue.skin_layers import ETA

RAYS_PER_BAND: Final = 1 << 21
"""Camera rays worked on at a time; bounds memory at full resolution."""

WHITE_UNIT: Final = np.float32(4.0)
"""Stokes S0 of the white reference is 1 behind an ideal analyser when filtered light is counted in
units of unfiltered irradiance over pi: the film takes half, the analyser another half."""

_LIGHT_NAMES: Final = ("diffuse", "specular", "shading")

Parts = dict[str, Float32Array]


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """What a camera gets, averaged over each pixel; light in units of the white reference."""

    diffuse: Float32Array
    """Light from inside, shape (H, W, 3 Stokes, 3 RGB), white-balanced, through the lens."""
    specular: Float32Array
    """Light from the surface, shape (H, W, 3 Stokes), through the lens."""
    shading: Float32Array
    """Light from inside of a skin of reflectance 1, shape (H, W, 3 Stokes), without the lens."""
    maps: Parts
    """Truth maps, averaged over each pixel's covered part."""
    coverage: Float32Array
    """Part of each pixel that is covered, shape (H, W), without the lens."""
    reached: Float32Array
    """Part of each pixel's light that comes from where there is a surface, shape (H, W)."""


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """One camera of the rig, looking."""

    rig: Rig
    """The rig."""
    view: View
    """The camera."""
    films: Polarizers
    """The polarizing films."""
    weights: Float64Array
    """Energy of each light over the sum that a plate at the origin gets, mm^2."""
    subpixels: int
    """Rays along each side of a pixel."""
    spread: LensSpread | None = None
    """How the lens spreads light; None: it is sharp everywhere."""

    def at_skin(
        self, caster: Caster, subject: SimulatedSubject, state: str, glow: SubsurfaceRadiance
    ) -> Picture:
        """Look at a face.

        Parameters
        ----------
        caster
            The face's mesh.
        subject, state
            Whose face, in which state.
        glow
            Light on and out of the face.

        Returns
        -------
        Picture
            With all truth maps but those of `blurred_maps`.
        """
        textures = _textures(subject, state, glow)
        return self._in_bands(caster, lambda buffers: self._see_skin(buffers, textures))

    def at_target(self, caster: Caster, target: Target) -> Picture:
        """Look at a target that reflects.

        Parameters
        ----------
        caster
            The target's mesh.
        target
            A diffuse or a metal one.

        Returns
        -------
        Picture
            Without truth maps.
        """
        return self._in_bands(caster, lambda buffers: self._see_target(buffers, target))

    def _in_bands(self, caster: Caster, see: Callable[[GBuffer], Parts]) -> Picture:
        k, view = self.subpixels, self.view
        rows_per_band = max(1, RAYS_PER_BAND // (view.width_px * k * k))
        around = 0 if self.spread is None else self.spread.radius
        bands = []
        for top in range(0, view.height_px, rows_per_band):
            bottom = min(top + rows_per_band, view.height_px)
            first = max(top - around, 0)
            rows = (first, min(bottom + around, view.height_px))
            buffers = g_buffer(caster, view, subpixels=k, rows=rows)
            parts = see(buffers)
            small, coverage = _shrink(parts, buffers.mask, k)
            small["reached"] = coverage
            if self.spread is not None:
                small |= _through_lens(parts, buffers, view, self.spread)
            inner = slice(top - first, bottom - first)
            bands.append(({name: part[inner] for name, part in small.items()}, coverage[inner]))
        maps: Parts = {
            name: np.concatenate([band[0][name] for band in bands]) for name in bands[0][0]
        }
        coverage = np.concatenate([band[1] for band in bands])
        for name, values in maps.items():
            if not np.isfinite(values).all():
                raise RenderError(f"{name}: rendering gave values that are not finite")
        diffuse, specular, white = (maps.pop(name) for name in _LIGHT_NAMES)
        reached = maps.pop("reached")
        return Picture(
            diffuse.reshape(*coverage.shape, 3, 3), specular, white, maps, coverage, reached
        )

    def blurred_maps(
        self, subject: SimulatedSubject, state: str, glow: SubsurfaceRadiance
    ) -> dict[str, Float32Array]:
        """Return the fractions and the reflectance of even skin that would look as the skin looks.

        Parameters
        ----------
        subject, state
            Whose face, in which state.
        glow
            Light on and out of the face, with lateral transport.

        Returns
        -------
        dict
            Textures of shape (N, N[, 3]).
        """
        camera, light = self.view.spectral_sensitivity, self.rig.lights[0].illuminant
        skin = SeenSkin(subject, state, camera, light)
        even = subject.atlas.covered.astype(np.float32)
        blurred = spread_through_pigment(skin, glow.reflectance, even, glow.kernels)
        melanin, blood = skin.color.nearest(blurred, subject.melanin, skin.blood)
        return {
            "reflectance_blurred": blurred,
            "melanin_blurred": melanin,
            "hemoglobin_blurred": blood,
        }

    def at_maps(
        self, caster: Caster, subject: SimulatedSubject, maps: Mapping[str, Float32Array]
    ) -> Picture:
        """Look at maps of a face without light.

        Parameters
        ----------
        caster
            The face's mesh.
        subject
            Whose face.
        maps
            Textures of shape (N, N[, C]).

        Returns
        -------
        Picture
            With these truth maps only; no light.
        """
        textures = _fillings(maps, subject)
        return self._in_bands(caster, lambda buffers: self._see_maps(buffers, textures))

    def _see_maps(self, buffers: GBuffer, textures: dict[str, Float32Array]) -> Parts:
        inside, uv, *_ = buffers.inside()
        everywhere = np.ones(len(inside), np.bool_)
        parts = {"diffuse": np.zeros((len(inside), 3, 3), np.float32)}
        parts |= {name: np.zeros((len(inside), 3), np.float32) for name in _LIGHT_NAMES[1:]}
        for name, layer in textures.items():
            values = sample(layer, uv, everywhere)
            parts[name] = values[:, 0] if values.shape[1] == 1 else values
        return {name: _scatter(values, inside, buffers.mask) for name, values in parts.items()}

    def _see_skin(self, buffers: GBuffer, textures: dict[str, Float32Array]) -> Parts:
        inside, uv, position, _, to_camera = buffers.inside()
        everywhere = np.ones(len(inside), np.bool_)
        seen = {name: sample(layer, uv, everywhere) for name, layer in textures.items()}
        normal = seen["normals"]
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
        right = self.view.axes[0]
        leaving = shading.exit_stokes(normal, to_camera, eta=ETA, image_right=right)
        alpha = np.clip(seen["roughness"][:, 0], *shading.ALPHA_RANGE)
        bare = 1.0 - seen["hair"]  # hair hides the skin and its shine
        specular = np.zeros_like(leaving)
        for k, light in enumerate(self.rig.lights):
            to_light, falloff = toward(light, position)
            lobe = shading.specular_stokes(
                normal,
                to_light,
                to_camera,
                alpha,
                eta=ETA,
                light_absorbs=absorbing_axis(light),
                image_right=right,
                extinction=self.films.light_extinction,
            )
            strength = np.float32(self.weights[k] * math.pi) * falloff * seen["visible"][:, k]
            specular += strength[:, None] * lobe
        scale = np.float32(shading.interior_scale(ETA))
        parts = {
            "diffuse": WHITE_UNIT * leaving[:, :, None] * seen.pop("glow")[:, None, :],
            "specular": WHITE_UNIT * bare * specular,
            "shading": WHITE_UNIT * scale * seen.pop("entered") * leaving,
            "position_mm": position,
            "uv": uv,
        }
        del seen["visible"]
        parts |= {
            name: values[:, 0] if values.shape[1] == 1 else values for name, values in seen.items()
        }
        return {name: _scatter(values, inside, buffers.mask) for name, values in parts.items()}

    def _see_target(self, buffers: GBuffer, target: Target) -> Parts:
        inside, uv, position, normal, to_camera = buffers.inside()
        camera, spectrum = self.view.spectral_sensitivity, self.rig.lights[0].illuminant
        rgb = _nearest(target.rgb(camera, spectrum), uv)
        leak = 1.0 / self.films.light_extinction
        diffuse = np.zeros((len(inside), 3, 3), np.float32)
        specular = np.zeros((len(inside), 3), np.float32)
        for k, light in enumerate(self.rig.lights):
            to_light, falloff = toward(light, position)
            strength = WHITE_UNIT * np.float32(self.weights[k]) * falloff
            if target.kind == "metal":
                lobe = shading.specular_stokes(
                    normal,
                    to_light,
                    to_camera,
                    target.alpha,
                    eta=ETA,
                    light_absorbs=absorbing_axis(light),
                    image_right=self.view.axes[0],
                    extinction=self.films.light_extinction,
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
    """Return what the camera samples from the face's texture, shape (N, N, C) each."""
    layers = {
        "glow": glow.spread,
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
    return _fillings(layers, subject)


def _fillings(
    layers: Mapping[str, Float32Array], subject: SimulatedSubject
) -> dict[str, Float32Array]:
    """Return textures whose borders are filled, so that sampling may blend, (N, N, C) each."""
    covered = subject.atlas.covered
    return {name: dilate_texture(np.atleast_3d(layer), covered) for name, layer in layers.items()}


def _scatter(values: Float32Array, inside: NDArray[np.int_], mask: BoolArray) -> Float32Array:
    out = np.zeros((mask.size, *values.shape[1:]), np.float32)
    out[inside] = values
    return out.reshape(*mask.shape, *values.shape[1:])


def _through_lens(parts: Parts, buffers: GBuffer, view: View, spread: LensSpread) -> Parts:
    """Return what of a picture the lens blurs, at the sensor's resolution."""
    k = spread.subpixels
    order, pixel, first, slot = pixel_order(buffers.mask, k)
    shape = (buffers.mask.shape[0] // k, buffers.mask.shape[1] // k)
    toward = before_focus(view, buffers.position_mm.reshape(-1, 3)[order])
    lens = LensPicture(spread, shape, pixel, first, slot, toward)
    light = [parts[name].reshape(buffers.mask.size, -1)[order] for name in ("diffuse", "specular")]
    seen = lens.see(np.concatenate([*light, np.ones((len(order), 1), np.float32)], axis=1))
    wide = light[0].shape[1]
    return {
        "diffuse": seen[..., :wide].reshape(*shape, *parts["diffuse"].shape[2:]),
        "specular": seen[..., wide:-1],
        "reached": seen[..., -1],
    }


def _shrink(parts: Parts, mask: BoolArray, k: int) -> tuple[Parts, Float32Array]:
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
