"""A patch of a person's skin as voxels before the flash rig's camera, as a scene of sessions.

`rigsim.scenes.reference.patch` renders the light from below the surface. Mitsuba's own facets
reflect the flashes' polarized light. Films, sensor and noise are those of every session.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from capture.rig import Light, Rig, View
from rigsim import shading
from rigsim.arrays import Float32Array, Float64Array
from rigsim.as_built.polarizers import Polarizers
from rigsim.light.subsurface_radiance import direction_and_falloff
from rigsim.mitsuba.variant import Renderer, choose_renderer
from rigsim.needs import face
from rigsim.needs.effects import Effect, EffectSelection, omitted_effects
from rigsim.render import camera_rays
from rigsim.scenes.exposing import SceneError
from rigsim.scenes.flash.image import WHITE_SCALE, FlashImage
from rigsim.scenes.flash.scene import FlashScene
from rigsim.scenes.reference.facets import FACET_OIL_FRACTION, FACET_ROUGHNESS, SkinFacets
from rigsim.scenes.reference.patch import (
    PatchImage,
    SkinPatch,
    draw_patch,
    pixel_truth,
    render_patch,
)
from rigsim.sensor import Sensor, make_sensor
from rigsim.subject.person_skin import PersonSkin
from rigsim.targets import make_target

PIXEL_MM: Final = 1.0
"""Size of a pixel on the skin, mm, up to rounding of the camera's width."""
VOXELS_PER_PIXEL: Final = 4


def crop_to_patch(rig: Rig, width_px: int) -> Rig:
    """Return the flash rig with the middle of the image of a camera of about `PIXEL_MM`.

    Parameters
    ----------
    rig
        The flash rig.
    width_px
        Pixels along each side.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> view = crop_to_patch(load_rig("flash"), 16).views[0]
    >>> view.width_px, view.height_px, round(view.field_mm[0], 1)
    (16, 16, 16.0)
    """
    width_mm = rig.views[0].field_mm[0]
    return rig.resized(2 * round(0.5 * width_mm / PIXEL_MM)).cropped(width_px)


def make_patch_sensor(rig: Rig) -> Sensor:
    """Return the sensor of a cropped camera; the middle of a lens's image has no vignetting."""
    return make_sensor(rig.views[0], vignetting=0.0)


@dataclass(frozen=True, slots=True, eq=False)
class RenderedSkin:
    """Skin of a person as voxels, and its light before the flash rig."""

    patch: SkinPatch
    """The voxels."""
    image: PatchImage
    """Light from below the surface."""


def render_skin(
    rig: Rig,
    person: PersonSkin,
    site: str,
    *,
    samples: int,
    seed: int,
    progress: Callable[[str], None] | None = None,
) -> RenderedSkin:
    """Render the skin around a site before the flash rig.

    Parameters
    ----------
    rig
        Result of `crop_to_patch`.
    person, site
        As for `rigsim.subject.person_skin.skin_maps`.
    samples
        Samples per pixel at the wavelength to which the camera is most sensitive.
    seed
        Seed of the sampler, >= 0.
    progress
        Called with a line per wavelength.
    """
    view = rig.views[0]
    pixel_mm = view.field_mm[0] / view.width_px
    patch = draw_patch(
        person, site, field_mm=view.field_mm[0], voxel_mm=pixel_mm / VOXELS_PER_PIXEL
    )
    image = render_patch(
        patch, rig, width_px=view.width_px, samples=samples, seed=seed, progress=progress
    )
    return RenderedSkin(patch, image)


class VoxelFlashScene(FlashScene):
    """Plane skin of voxels in the position of the white reference.

    Parameters
    ----------
    rig
        Result of `crop_to_patch`.
    skin
        The skin, rendered before this rig.
    seed
        Seeds the variation between pops.
    """

    renderer: Renderer = "reference"
    """Renderer of the images."""

    def __init__(self, rig: Rig, skin: RenderedSkin, *, seed: int = 0) -> None:
        choice = choose_renderer("reference")
        white, sensor = make_target("white"), make_patch_sensor(rig)
        super().__init__(rig, white, seed=seed, sensor=sensor, choice=choice)
        self.variant = replace(self.variant, why=_describe_noise(skin.image))
        self.skin = skin
        self.state = "neutral"
        self.needs = EffectSelection((*_list_effects(rig), *omitted_effects("flash", "voxels")))

    def truth(self, view_name: str | None = None) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth: means of the voxels over pixels, shape (H, W) each.

        Parameters
        ----------
        view_name
            Name of the camera; ``None`` takes the first.

        Returns
        -------
        dict
            ``melanin``, ``hemoglobin``: volume fractions; ``mask``: True.
        """
        view = self._camera(view_name)
        melanin, blood = pixel_truth(self.skin.patch, view.width_px)
        return {"melanin": melanin, "hemoglobin": blood, "mask": np.ones(melanin.shape, bool)}

    def under(self, led: str) -> FlashScene:
        """Return the scene itself; voxels are rendered before the tubes alone.

        Raises
        ------
        SceneError
            For an LED.
        """
        if led:
            raise SceneError(
                f"light: got {led}, expected the tube, because voxels are rendered before it "
                "alone; capture without --bands, or use renderer mitsuba"
            )
        return self

    def landmarks_px(self, view_name: str | None = None) -> dict[str, tuple[float, float]]:
        """Return the positions of named skin points; plane skin has none."""
        self._camera(view_name)
        return {}

    def describe_voxels(self) -> tuple[Mapping[str, Any], Mapping[str, NDArray[Any]]]:
        """Return the parameters of the voxels, and their maps by name."""
        patch, image = self.skin.patch, self.skin.image
        tissue = {name: getattr(patch.tissue, name) for name in patch.tissue.__dataclass_fields__}
        about = {
            "voxel_mm": patch.voxel_mm,
            "boundary_roughness": patch.alpha,
            "facet_roughness": FACET_ROUGHNESS,
            "facet_oil_fraction": FACET_OIL_FRACTION,
            "renderer_noise": _relative_noise(image).tolist(),
            "tissue": tissue,
        }
        maps: dict[str, NDArray[Any]] = {
            "x_mm": patch.x_mm,
            "melanin": patch.melanin,
            "blood": patch.blood,
            "rgb": image.rgb,
            "variance": image.variance,
        }
        return about, maps

    def _flash_image(self, view: View) -> FlashImage:
        shape = view.height_px, view.width_px
        origin, way = (part.astype(np.float64) for part in camera_rays(view))
        points = origin - (origin[..., 2:] / way[..., 2:]) * way
        surface = np.zeros((*shape, 3))
        lit = np.zeros(shape)
        for light, weight in zip(self.rig.lights, self._flashes.weights, strict=True):
            to_light, falloff = direction_and_falloff(light, points.astype(np.float32))
            irradiance = weight * falloff * to_light[..., 2]
            reflected = irradiance * math.pi * _reflect(to_light, -way)
            lit += irradiance
            surface += reflected[..., None] * _polarize(light, view, self.films)
        passed = 0.5 * (1.0 + 1.0 / self.films.light_extinction) * float(WHITE_SCALE)
        diffuse = np.zeros((*shape, 3, 3), np.float32)
        # light from below the surface is unpolarized
        diffuse[:, :, 0] = passed * lit[..., None] * self.skin.image.rgb
        unlit = np.zeros((*shape, 3), np.float32)
        specular = np.asarray(passed * surface, np.float32)
        whole = np.ones(shape, np.float32)
        return FlashImage(diffuse, specular, unlit, {}, whole, whole)


def _reflect(to_light: Float32Array, to_camera: Float64Array) -> Float64Array:
    """Return f_r of the facets of a plane across +z in 1/sr, shape (H, W)."""
    found = SkinFacets(FACET_ROUGHNESS, FACET_OIL_FRACTION).evaluate(
        (0.0, 0.0, 1.0), to_light.reshape(-1, 3), to_camera.reshape(-1, 3)
    )
    return found.reshape(to_light.shape[:-1])


def _polarize(light: Light, view: View, films: Polarizers) -> Float64Array:
    """Return the Stokes vector, (3,), of a flash's light that a mirror reflects to the camera."""
    axis = shading.axis_in_plane(
        float(light.polarizer_axis_deg or 0.0), light.position_mm, (0.0, 1.0, 0.0)
    )
    way = np.asarray(light.position_mm) / np.linalg.norm(light.position_mm)
    half = way + np.asarray(view.axes[2])
    half /= np.linalg.norm(half)
    axis = axis - 2.0 * (axis @ half) * half
    right, up, _ = view.axes
    angle = math.atan2(float(axis @ np.asarray(up)), float(axis @ np.asarray(right)))
    leak = 1.0 / films.light_extinction
    degree = (1.0 - leak) / (1.0 + leak)
    return np.array([1.0, degree * math.cos(2.0 * angle), degree * math.sin(2.0 * angle)])


def _relative_noise(image: PatchImage) -> Float64Array:
    """Return the relative noise of a pixel in each channel, shape (3,)."""
    mean = image.rgb.mean(axis=(0, 1))
    return np.asarray(np.sqrt(image.variance.mean(axis=(0, 1))) / mean)


def _describe_noise(image: PatchImage) -> str:
    shown = ", ".join(f"{100.0 * one:.1f}" for one in _relative_noise(image))
    return f"voxels by the integrator tissue; its noise is {shown} % per pixel in R, G, B"


def _list_effects(rig: Rig) -> list[Effect]:
    """Return the effects of plane voxel skin."""
    view = rig.views[0]
    return [
        face.polarization_effect(rig, view),
        face.band_effect(view),
        Effect(face.LATERAL_EFFECT, "built", "light walks through the voxels"),
        Effect(face.INTERREFLECTION_EFFECT, "absent", "the skin is plane"),
        Effect(face.SHADOW_EFFECT, "absent", "the skin is plane"),
        Effect(face.RELIEF_EFFECT, "absent", "the boundary is smooth"),
    ]
