"""Grooves of voxel skin in the gradient rig, as a scene of sessions.

Crossed light is that of voxels below the relief. Facets reflect on the same heights as in every
session of the rig, with its polarizers, lens and noise.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import zoom

from capture.rig import Rig
from rigsim.arrays import Float32Array
from rigsim.as_built.sphere import ActualSphere, diffuser_radiance
from rigsim.mitsuba.variant import Renderer, choose_renderer
from rigsim.needs import face
from rigsim.needs.effects import Effect, EffectSelection, SceneEffects, omitted_effects
from rigsim.needs.tissue import TISSUE_RULES
from rigsim.scenes.exposing import SceneError
from rigsim.scenes.gradient.lighting import PatchLighting
from rigsim.scenes.gradient.patch import PatchSurface
from rigsim.scenes.gradient.scene import DRIFT_MARGIN_PX, GradientScene
from rigsim.scenes.reference.gradient_relief import draw_grooves
from rigsim.scenes.reference.gradient_skin import (
    BAND_NODES_NM,
    render_moments,
    turn_skin,
    weigh_bands,
)
from rigsim.scenes.reference.patch import RELIEF_TEXEL_UM
from rigsim.skin_patch.microrelief import MicroSkin, make_micro_skin
from rigsim.subject.person_skin import PersonSkin
from rigsim.tissue.skin_table import interpolate_spectra
from rigsim.world.taped_skin import GripState

COARSE_PX: Final = 8
"""Camera's pixels along each side of a pixel of voxels, 48 um: light from below is smooth."""


@dataclass(frozen=True, slots=True, eq=False)
class RenderedGrooves:
    """Skin with grooves and even pigment, and its crossed light."""

    skin: MicroSkin
    """The skin; its albedo is that of the site's pigment in the camera's band."""
    moments: Float32Array
    """Moments 1, x, y, z over a white diffuser's full light, with a border, shape (4, H, W)."""
    noise: float
    """Relative noise of a pixel of voxels in full light."""


def render_grooves(
    rig: Rig,
    sphere: ActualSphere,
    person: PersonSkin,
    site: str,
    *,
    samples: int,
    seed: int,
    progress: Callable[[str], None] | None = None,
) -> RenderedGrooves:
    """Render the crossed light of a site's grooves as voxels, in the camera's band.

    Parameters
    ----------
    rig, sphere
        The gradient rig with its cropped camera, and its actual LEDs.
    person, site
        As for `rigsim.subject.person_skin.skin_maps`.
    samples
        Samples per pixel of voxels, for each three patterns and each of `BAND_NODES_NM`.
    seed
        Seed of the sampler, >= 0.
    progress
        Called with a line per wavelength.
    """
    view = rig.views[0]
    shown = [count + 2 * DRIFT_MARGIN_PX for count in (view.height_px, view.width_px)]
    width = -(-max(shown) // COARSE_PX)
    field_mm = width * COARSE_PX * view.distance_mm / view.focal_px
    patch = draw_grooves(person, site, field_mm)
    weights = weigh_bands(rig)
    halves = np.zeros((2, 4, width, width))
    for k, (wavelength_nm, weight) in enumerate(zip(BAND_NODES_NM, weights, strict=True)):
        if progress is not None:
            progress(f"voxels: {wavelength_nm:g} nm, {k + 1} of {len(BAND_NODES_NM)} bands")
        for half in range(2):
            image = render_moments(
                patch,
                rig,
                sphere,
                turn_skin(0.0, 0.0),
                wavelength_nm,
                width_px=width,
                samples=max(samples // 2, 1),
                seed=half + 2 * (k + len(BAND_NODES_NM) * seed),
            )
            halves[half] += weight * image.moments
    coarse = halves.mean(axis=0)
    noise = float(np.std(0.5 * (halves[0, 0] - halves[1, 0])) / coarse[0].mean())
    fine = np.stack(
        [zoom(one, COARSE_PX, order=1, mode="nearest", grid_mode=True) for one in coarse]
    )
    top, left = ((fine.shape[1] - count) // 2 for count in shown)
    moments = fine[:, top : top + shown[0], left : left + shown[1]]
    skin = make_micro_skin(
        site,
        seed=person.seed,
        size_mm=len(patch.x_mm) * patch.voxel_mm,
        texel_um=RELIEF_TEXEL_UM,
        person=person,
    )
    flat = person.at(site)
    pigment = np.array([flat.c_m]), np.array([flat.c_hd])
    albedo = interpolate_spectra(*pigment, flat.tissue, np.array(BAND_NODES_NM))[0] @ weights
    even = np.full_like(skin.albedo, float(albedo))
    return RenderedGrooves(
        dataclasses.replace(skin, albedo=even), moments.astype(np.float32), noise
    )


@dataclass(frozen=True, slots=True, eq=False)
class VoxelLighting:
    """Facets under the LEDs, and light of voxels below them."""

    facets: PatchLighting
    """Lighting of the patch, of which its light on the relief is used."""
    inside: Float32Array
    """Crossed light of the voxels by moment, radiance, (4, H, W)."""

    def stokes(self, wide: PatchSurface, *, margin: int, pitch_um: float) -> Float32Array:
        """Return Stokes vectors of the moments, (12, H, W); see `PatchLighting.stokes`."""
        packed = self.facets.direct.packed(wide, margin=margin, pitch_um=pitch_um)[:12]
        skin = wide.crop(margin).skin
        packed[:, ~skin] = 0.0
        packed[::3] += np.where(skin, self.inside, np.float32(0.0))
        return np.asarray(packed, np.float32)


class VoxelGradientScene(GradientScene):
    """Grooves of voxel skin at rest in the gradient rig.

    Parameters
    ----------
    rig, sphere, seed, on_s
        As for `GradientScene`.
    grooves
        The skin, rendered before this rig and sphere.
    """

    renderer: Renderer = "reference"
    """Renderer of the images."""

    def __init__(
        self,
        rig: Rig,
        grooves: RenderedGrooves,
        *,
        sphere: ActualSphere,
        seed: int = 0,
        on_s: float | None = None,
    ) -> None:
        self._grooves = grooves
        choice = choose_renderer("reference")
        off = SceneEffects(lateral=False, interreflections=False)
        super().__init__(
            rig, grooves.skin, sphere=sphere, seed=seed, effects=off, on_s=on_s, choice=choice
        )
        # voxels have the person's tissue, whatever its size
        self.subject = grooves.skin
        self.variant = dataclasses.replace(choice, why=self._describe_noise())
        built = (
            Effect(face.LATERAL_EFFECT, "built", "light walks through the voxels"),
            Effect(face.INTERREFLECTION_EFFECT, "built", "it meets other walls of a groove"),
            *(Effect(rule.name, "built", "voxels have the person's") for rule in TISSUE_RULES),
        )
        made = {effect.name for effect in built} | UNEVEN_EFFECTS
        kept = (effect for effect in self.needs if effect.name not in made)
        self.needs = EffectSelection((*kept, *built, *omitted_effects("gradient_voxels")))

    def lighting(self, led_fractions: tuple[float, ...] = ()) -> VoxelLighting:  # type: ignore[override]
        """Return the lighting of this skin.

        Raises
        ------
        SceneError
            LEDs differ from those before which the voxels were rendered.
        """
        if any(share != 1.0 for share in led_fractions):
            raise SceneError(
                "led_shares: got LEDs off their output, but voxels were rendered before; "
                "simulate without faults, or use renderer mitsuba"
            )
        center, extinction = np.zeros(1), self.films.light_extinction
        white = float(diffuser_radiance(self.sphere, center, center, extinction=extinction)[0, 0])
        return VoxelLighting(super().lighting(), np.float32(white) * self._grooves.moments)

    def _render(
        self, grip: GripState, jump_mm: tuple[float, float], shares: tuple[float, ...]
    ) -> Float32Array:
        if grip.stretch != 1.0:
            raise SceneError(
                f"grip: got a stretch of {grip.stretch:g}, expected skin at rest, which was "
                "rendered as voxels; use renderer mitsuba"
            )
        return super()._render(grip, jump_mm, shares)

    def _describe_noise(self) -> str:
        noise = 100.0 * self._grooves.noise
        return f"voxels by the integrator tissue; its noise is {noise:.1f} % per {COARSE_PX} pixels"


UNEVEN_EFFECTS: Final = frozenset(
    {face.PIGMENT_EFFECT, "a lateral kernel that varies over the patch"}
)
"""Effects of the rig's scenes that voxels of even pigment lack."""
