"""Trace the flash rig's camera and shade by its polarized lights, by Mitsuba or without.

`MitsubaSurface` renders a Mitsuba scene of mesh, skin and flashes. `FastSurface` serves machines
without LLVM: the same optics in compiled loops, with the shadows of the face's texture. Both return
light in units of the flashes' `FlashLights.weights`.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy as np
from numba import njit, prange

from capture.rig import Light, Rig, View
from rigsim import shading
from rigsim.arrays import Float32Array, Float64Array, Int32Array, UInt8Array
from rigsim.as_built.polarizers import Polarizers, absorbing_axis
from rigsim.geometry.atlas import dilate_texture
from rigsim.geometry.mesh import Mesh
from rigsim.light.olat import pixel_order
from rigsim.light.skin_material import describe_skin, describe_target
from rigsim.light.subsurface_radiance import (
    SurfaceIllumination,
    direction_and_falloff,
    inner_albedo,
)
from rigsim.mitsuba.image_hits import AddedLight
from rigsim.mitsuba.led_array import led_table
from rigsim.mitsuba.rig_camera import describe_camera
from rigsim.mitsuba.scene_radiance import load_description
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import VariantChoice
from rigsim.render import Caster, g_buffer
from rigsim.scenes.exposing import SceneError
from rigsim.subject import SimulatedSubject
from rigsim.targets import Target
from rigsim.tissue.skin_layers import ETA

MIRROR_IOR: Final = 1e6
"""Index at which a dielectric reflects as an ideal metal, with all light and no phase."""


@dataclass(frozen=True, slots=True, eq=False)
class FlashLights:
    """The flashes with their polarizers."""

    lights: tuple[Light, ...]
    """The flashes."""
    polarizers: Polarizers
    """Their polarizers."""
    weights: Float64Array
    """Energy of each light over the total of a plate at the origin, mm^2."""

    @property
    def key(self) -> tuple[object, ...]:
        """Return what distinguishes these lights from others."""
        return self.lights, self.polarizers, tuple(self.weights.tolist())


def flash_lights(rig: Rig, polarizers: Polarizers) -> FlashLights:
    """Return a rig's flashes, in units of a plate at the origin that faces the camera.

    Parameters
    ----------
    rig
        The rig.
    polarizers
        Their polarizers.

    Raises
    ------
    SceneError
        A light has no energy, or none reaches the plate.
    """
    energy, share = [], []
    view_axis = np.asarray(rig.views[0].axes[2])
    for light in rig.lights:
        if light.energy_ws is None:
            raise SceneError(
                f"light {light.name!r}: got no energy_ws, expected a flash; add energy_ws"
            )
        place = np.asarray(light.position_mm)
        squared = float(place @ place)
        energy.append(light.energy_ws)
        share.append(light.energy_ws * float(place @ view_axis) / squared**1.5)
    total = float(np.sum(share))
    if not total > 0.0:
        raise SceneError(
            "lights: got none that reaches a plate at the origin facing the camera, expected one"
        )
    return FlashLights(rig.lights, polarizers, np.asarray(energy) / total)


@dataclass(frozen=True, slots=True, eq=False)
class CameraHits:
    """Hits of a camera's rays in some rows of an image, sorted by pixel."""

    shape: tuple[int, int]
    """Rows and columns of pixels."""
    subpixels: int
    """Rays along each side of a pixel."""
    pixel: Int32Array
    """Pixels with hits, index into the flat rows, shape (P,)."""
    first: Int32Array
    """First hit of each of these, shape (P + 1,)."""
    slot: UInt8Array
    """Position in the pixel, row by row, shape (n,)."""
    position_mm: Float32Array
    """Points, shape (n, 3)."""
    uv: Float32Array
    """Texture coordinates, shape (n, 2)."""
    traced: Any
    """What the surface needs to shade them."""

    @property
    def count(self) -> int:
        """Return the number of hits."""
        return len(self.slot)

    def coverage(self) -> Float32Array:
        """Return the covered fraction of each pixel, shape (H, W)."""
        out = np.zeros(self.shape[0] * self.shape[1], np.float32)
        out[self.pixel] = np.diff(self.first) / np.float32(self.subpixels**2)
        return out.reshape(self.shape)

    def average(self, rows: Float32Array) -> Float32Array:
        """Average hits over each pixel's covered part: (n, ...) to (H, W, ...); zero elsewhere."""
        inner = rows.shape[1:]
        flat = np.ascontiguousarray(rows, np.float32).reshape(len(rows), math.prod(inner))
        out = np.zeros((self.shape[0] * self.shape[1], flat.shape[1]), np.float32)
        _average_hits(flat, self.pixel, self.first, out)
        return out.reshape(*self.shape, *inner)


@njit(parallel=True, cache=True, error_model="numpy")
def _average_hits(rows, pixel, first, out):  # type: ignore[no-untyped-def]
    for p in prange(pixel.shape[0]):
        mean = out[pixel[p]]
        # up to 8 hits in the order of NumPy's `add.reduceat`, so that images keep their digits;
        # NumPy sums more of them in pairs, and the last digits differ
        for i in range(first[p] + 1, first[p + 1]):
            _add_row(rows[i], mean)
        _add_row(rows[first[p]], mean)
        count = np.float32(first[p + 1] - first[p])
        for c in range(mean.size):
            mean[c] /= count


@njit(error_model="numpy", forceinline=True)
def _add_row(row, total):  # type: ignore[no-untyped-def]
    for c in range(total.size):
        total[c] += row[c]


class FastSurface:
    """A face or a target, shaded by closed forms in compiled loops.

    Parameters
    ----------
    caster
        The mesh.
    flashes
        The lights.
    target
        The target; None for a face.
    """

    def __init__(self, caster: Caster, flashes: FlashLights, target: Target | None = None) -> None:
        self._caster, self._flashes, self._target = caster, flashes, target

    def trace(self, view: View, subpixels: int, rows: tuple[int, int]) -> CameraHits:
        """Trace a camera's rays in some rows of pixels, the first and the one after the last."""
        buffers = g_buffer(self._caster, view, subpixels=subpixels, rows=rows)
        order, pixel, first, slot = pixel_order(buffers.mask, subpixels)
        position, uv, normal, to_camera = (
            part.reshape(buffers.mask.size, -1)[order]
            for part in (buffers.position_mm, buffers.uv, buffers.normal, buffers.to_camera)
        )
        shape, traced = (rows[1] - rows[0], view.width_px), (normal, to_camera)
        return CameraHits(shape, subpixels, pixel, first, slot, position, uv, traced)

    def shadows(self, light: SurfaceIllumination) -> Float32Array | None:
        """Return the texture of shadows that `skin_stokes` needs, shape (N, N, L)."""
        return light.visible

    def skin_stokes(
        self, hits: CameraHits, view: View, seen: Mapping[str, Float32Array]
    ) -> tuple[Float32Array, Float32Array]:
        """Return Stokes vectors of light from inside of radiance 1, and of the surface.

        Parameters
        ----------
        hits
            Hits on skin.
        view
            The camera.
        seen
            The face's textures at the hits, shape (n, C) each.

        Returns
        -------
        leaving, surface
            Shape (n, 3); the second in radiance times pi.
        """
        normal = seen["normals"]
        normal = normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
        _, to_camera = hits.traced
        leaving = shading.exit_stokes(normal, to_camera, eta=ETA, image_right=view.axes[0])
        alpha = np.clip(seen["roughness"], *shading.ALPHA_RANGE)
        facets = self._facets(hits, view, normal, alpha, seen["shadows"])
        return leaving, (1.0 - seen["hair"])[:, None] * facets  # hair occludes the skin's surface

    def target_light(self, hits: CameraHits, view: View) -> tuple[Float32Array, Float32Array]:
        """Return depolarized light (RGB) and Stokes vectors of a target, in radiance times pi.

        Shapes (n, 3).
        """
        target, flashes = self._target, self._flashes
        normal, _ = hits.traced
        dark = np.zeros((hits.count, 3), np.float32)
        if target is None:
            return dark, dark
        if target.kind == "metal":
            lit = np.ones((hits.count, len(flashes.lights)), np.float32)
            reflectance = float(target.palette.mean())
            return dark, self._facets(hits, view, normal, target.alpha, lit, metal=reflectance)
        rgb = target.rgb(view.spectral_sensitivity, flashes.lights[0].illuminant)
        passed = 0.5 * (1.0 + 1.0 / flashes.polarizers.light_extinction)
        total = np.zeros(hits.count, np.float32)
        for light, weight in zip(flashes.lights, flashes.weights, strict=True):
            to_light, falloff = direction_and_falloff(light, hits.position_mm)
            cosine = np.maximum(np.einsum("ij,ij->i", normal, to_light), 0.0)
            total += np.float32(passed * weight) * falloff * cosine
        return total[:, None] * _nearest(rgb, hits.uv), dark

    def _facets(
        self,
        hits: CameraHits,
        view: View,
        normal: Float32Array,
        alpha: Float32Array | float,
        lit: Float32Array,
        *,
        metal: float = 0.0,
    ) -> Float32Array:
        """Return the Stokes vectors of the facets' reflection in radiance times pi."""
        _, to_camera = hits.traced
        total = np.zeros((hits.count, 3), np.float32)
        for k, light in enumerate(self._flashes.lights):
            to_light, falloff = direction_and_falloff(light, hits.position_mm)
            lobe = shading.specular_stokes(
                normal,
                to_light,
                to_camera,
                alpha,
                eta=ETA,
                light_absorbs=absorbing_axis(light),
                image_right=view.axes[0],
                extinction=self._flashes.polarizers.light_extinction,
                metal=metal,
            )
            strength = np.float32(self._flashes.weights[k] * math.pi) * falloff * lit[:, k]
            total += strength[:, None] * lobe
        return total


class MitsubaSurface:
    """A face or a target in front of the flashes, as a Mitsuba scene.

    Parameters
    ----------
    mesh
        The mesh.
    material
        Description of its BSDF, see `describe_face` and `describe_flash_target`.
    flashes
        The lights.
    choice
        A vectorized variant.
    """

    def __init__(
        self, mesh: Mesh, material: dict[str, Any], flashes: FlashLights, choice: VariantChoice
    ) -> None:
        self._choice, self._flashes = choice, flashes
        lights = flashes.lights
        places = np.array([light.position_mm for light in lights])
        table = led_table(
            places,
            -places / np.linalg.norm(places, axis=1, keepdims=True),
            intensity=np.repeat(np.asarray(flashes.weights)[:, None], 3, axis=1),
            radius_mm=[light.radius_mm for light in lights],
            absorbs=[absorbing_axis(light) for light in lights],
            leak=1.0 / flashes.polarizers.light_extinction,
        )
        self.description = {
            "type": "scene",
            "embree_use_robust_intersections": True,
            "surface": {"type": "mesh", "mesh": mesh, "bsdf": material},
            "flashes": {"type": "ledarray", "table": table},
        }
        mi = load_mitsuba(choice)
        self._scene = load_description(mi, self.description)

    def trace(self, view: View, subpixels: int, rows: tuple[int, int]) -> CameraHits:
        """Trace rays as `FastSurface.trace`."""
        mi = load_mitsuba(self._choice)
        camera = load_description(mi, describe_camera(view))
        self._integrator = mi.load_dict({"type": "olat", "subpixels": subpixels})
        found = self._integrator.trace(self._scene, camera, rows)
        pixel, first, slot, position, uv = found.rows()
        shape = (rows[1] - rows[0], view.width_px)
        pixel -= np.int32(rows[0] * view.width_px)
        return CameraHits(shape, subpixels, pixel, first, slot, position, uv, found)

    def shadows(self, light: SurfaceIllumination) -> Float32Array | None:
        """Return the relief's shadows, shape (N, N, L); the scene casts the others."""
        return light.relief

    def skin_stokes(
        self, hits: CameraHits, view: View, seen: Mapping[str, Float32Array]
    ) -> tuple[Float32Array, Float32Array]:
        """Return Stokes vectors as `FastSurface.skin_stokes`."""
        _, surface = self.reflected(hits, view, seen.get("shadows"), diffuse=False)
        return self.leaving(hits, view), surface

    def target_light(self, hits: CameraHits, view: View) -> tuple[Float32Array, Float32Array]:
        """Return light as `FastSurface.target_light`."""
        return self.reflected(hits, view)

    def leaving(self, hits: CameraHits, view: View) -> Float32Array:
        """Return Stokes vectors at the camera of light inside of radiance 1, shape (n, 3)."""
        load_mitsuba(self._choice)  # the variant is a state of the process
        return _columns(self._integrator.leaving_stokes(hits.traced, view.axes[0]))

    def reflected(
        self,
        hits: CameraHits,
        view: View,
        shadows: Float32Array | None = None,
        *,
        diffuse: bool = True,
    ) -> tuple[Float32Array, Float32Array]:
        """Return light inside (RGB) and Stokes vectors of the surface, in radiance times pi.

        Parameters
        ----------
        hits
            Hits of this scene.
        view
            The camera.
        shadows
            Fraction of each light that the relief leaves, shape (n, L); None: all.
        diffuse
            False leaves the light inside zero.
        """
        load_mitsuba(self._choice)  # the variant is a state of the process
        leds = self._scene.emitters()[0]
        surface, inside = (np.zeros((hits.count, 3), np.float32) for _ in range(2))
        for k in range(len(self._flashes.lights)):
            lit = None if shadows is None else shadows[:, k]
            added = AddedLight(visible=lit, replaces_diffuse=not diffuse)
            parts = self._integrator.shade_polarized(
                self._scene, hits.traced, leds, k, view.axes[0], added
            )
            strength = np.float32(math.pi) * leds.strength(k)
            surface += strength * _columns([part[0] for part in parts])
            if diffuse:
                inside += strength * _columns([part[1] for part in parts])
        return inside, surface


FlashSurface: TypeAlias = FastSurface | MitsubaSurface


def unlit_surface(caster: Caster, flashes: FlashLights) -> FlashSurface:
    """Return the surface of a mesh for maps without light.

    Parameters
    ----------
    caster
        The mesh; its variant is that which renders.
    flashes
        Any lights.
    """
    if not caster.choice.is_vectorized:
        return FastSurface(caster, flashes)
    return MitsubaSurface(caster.mesh, {"type": "diffuse"}, flashes, caster.choice)


def describe_face(subject: SimulatedSubject, reflectance: Float32Array) -> dict[str, Any]:
    """Return the description of a face as a `skincoat` of GGX facets.

    Parameters
    ----------
    subject
        The face.
    reflectance
        Diffuse reflectance of its skin without lateral scattering, shape (N, N, 3).
    """
    hair = subject.hair[..., None]
    alpha = np.clip(subject.roughness, *shading.ALPHA_RANGE)[..., None]
    nothing = np.zeros_like(hair)
    layers = [inner_albedo(subject, reflectance), alpha, nothing, nothing, 1.0 - hair]
    texture = np.concatenate([*layers, subject.normal], axis=-1).astype(np.float32)
    skin = describe_skin(dilate_texture(texture, subject.atlas.covered))
    return skin | {"distribution": "ggx", "oil": 0.0, "vellus": 0.0}


def describe_flash_target(target: Target, camera: str, illuminant: str) -> dict[str, Any]:
    """Return the description of a reflecting target; metal keeps polarization.

    Parameters
    ----------
    target
        A diffuse or a metal target.
    camera, illuminant
        Names in `model.spectra`.
    """
    if target.kind != "metal":
        return describe_target(target, camera, illuminant)
    return {
        "type": "skincoat",
        "distribution": "ggx",
        "int_ior": MIRROR_IOR,
        "r_d": 0.0,
        "alpha": target.alpha,
        "bare": float(target.palette.mean()),
    }


def _columns(parts: Sequence[Sequence[Any]]) -> Float32Array:
    """Return the rows of bands, shape (n, 3)."""
    if not parts:
        return np.zeros((0, 3), np.float32)
    bands = [np.stack([np.array(column) for column in part], axis=1) for part in parts]
    return np.concatenate(bands).astype(np.float32, copy=False)


def _nearest(texture: Float32Array, uv: Float32Array) -> Float32Array:
    size = texture.shape[0]
    column = np.clip((uv[:, 0] * size).astype(np.int64), 0, size - 1)
    row = np.clip(((1.0 - uv[:, 1]) * size).astype(np.int64), 0, size - 1)
    return texture[row, column]
