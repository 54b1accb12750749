"""Render the cross-polarized flash rig: two flashes and a camera in front of a face or a target.

Light that enters the skin is accumulated in the face's texture, scattered laterally there, and
transmitted through the surface to the camera; the surface's own reflection is added per pixel. Both
are Stokes vectors, so that every analyzer angle is one weighted sum.

The unit of light is fixed by the rig alone: a perfect white diffuser at the rig's origin that faces
the camera gives `METERING_LEVEL` of full scale in the strongest channel at power 1, behind
parallel as behind crossed polarizers, for every subject.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from capture.rig import Rig, View
from model import spectra
from rigsim import shading
from rigsim.arrays import Float32Array, Float64Array, UInt16Array
from rigsim.as_built.polarizers import Polarizers, draw_polarizers
from rigsim.boxes.flash import FlashPop
from rigsim.caching import cached_method
from rigsim.geometry.mesh import Mesh
from rigsim.light.interreflection import InterreflectionSettings, interreflection_for
from rigsim.light.lateral import edge_width_mm
from rigsim.light.observed_skin import ObservedSkin, observe_skin
from rigsim.light.subsurface_radiance import (
    SubsurfaceRadiance,
    SurfaceIllumination,
    illuminate_surface,
    render_subsurface_radiance,
)
from rigsim.mitsuba.variant import VariantChoice
from rigsim.needs import face as face_needs
from rigsim.needs.effects import (
    AUTOMATIC_EFFECTS,
    EffectSelection,
    PixelNoise,
    SceneEffects,
    merge_selections,
)
from rigsim.needs.flash import select_flash_effects
from rigsim.needs.tissue import select_face_tissue
from rigsim.render import camera_rays
from rigsim.render.depth_of_field import depth_range, tabulate_defocus
from rigsim.scenes.exposing import FaceScene, SceneError
from rigsim.scenes.flash import truth as flash_truth
from rigsim.scenes.flash.image import FlashCamera, FlashImage
from rigsim.scenes.flash.stage import shared_flash_geometry
from rigsim.scenes.flash.surfaces import (
    FastSurface,
    FlashSurface,
    MitsubaSurface,
    describe_face,
    describe_flash_target,
    flash_lights,
    unlit_surface,
)
from rigsim.sensor import Sensor
from rigsim.subject import SimulatedSubject, landmarks
from rigsim.targets import Target

METERING_LEVEL: Final = 0.8
"""Fraction of full scale of the white reference in its strongest channel at power 1."""

FLAT_FIELD_LEVEL: Final = 0.9
"""Fraction of full scale of the integrating sphere in its strongest channel at power 1."""

POP_ENERGY_DEVIATION: Final = 0.002
"""Relative standard deviation of a flash's energy between pops."""


FlashTruth: TypeAlias = dict[str, NDArray[np.generic]]


class FlashScene(FaceScene):
    """One subject or target in the flash rig, in one state.

    Scenes that differ in the blood only share traced rays, as long as one of them lives.

    Parameters
    ----------
    rig
        The flash rig; its lights must share one spectrum.
    subject
        A face or a target.
    state
        Condition of the face, see `rigsim.subject.perfusion.STATE_NAMES`: its blood, and its
        expression where the state is one; targets have none.
    movement
        Whether the face moves and wrinkles with the state; otherwise it stays as given. An already
        posed subject (`SimulatedSubject.posed`) keeps its pose.
    sensor
        Sensor of every view; ``None`` takes that of each view.
    films
        The polarizers; ``None`` takes the rig's own, which its serial numbers determine.
    seed
        Seeds the variation between pops.
    effects
        Requested effects of light; the others are decided by their changes of pixels, see `needs`.
    power
        Highest power of a flash in the plan, above 0 to 1, for the sizes of effects.
    subpixels
        Rays along each side of a pixel.
    choice
        Mitsuba variant; ``None`` chooses.
    """

    def __init__(
        self,
        rig: Rig,
        subject: SimulatedSubject | Target,
        *,
        state: str = "neutral",
        movement: bool = True,
        sensor: Sensor | None = None,
        films: Polarizers | None = None,
        seed: int = 0,
        effects: SceneEffects = AUTOMATIC_EFFECTS,
        power: float = 1.0,
        subpixels: int = 2,
        choice: VariantChoice | None = None,
    ) -> None:
        if not 0.0 < power <= 1.0:
            raise SceneError(f"power: got {power}, expected above 0 to 1")
        super().__init__(rig, subject, state, movement, sensor, seed, subpixels)
        self.films = draw_polarizers(rig) if films is None else films
        self._flashes = flash_lights(rig, self.films)
        self._choice = choice
        self._stage = shared_flash_geometry(self.subject, choice)
        self._caster = self._stage.caster
        self.variant = self._caster.choice
        """Variant that renders the images, with the reason."""
        self._effects, self._power = effects, power
        self._skins = self._observe()  # what the rules compute of the skin is reused
        self.needs = merge_selections([self._needs_of(view, power) for view in rig.views])
        self.subject = select_face_tissue(self.subject, self.needs)
        self._skins = self._observe()
        self.lateral = self.needs.builds(face_needs.LATERAL_EFFECT)
        self.interreflections = self.needs.builds(face_needs.INTERREFLECTION_EFFECT)
        self.optics = self.needs.builds(face_needs.LENS_EFFECT)

    def _needs_of(self, view: View, power: float) -> EffectSelection:
        noise = PixelNoise.of(self._sensors[view.name])
        scenery = self._scenery(view, self._stage, noise, self._effects)
        white = np.asarray(self.white_rgb(view.name), np.float64) * power
        seen = (
            scenery,
            white,
            self._stage.sample_light(self.subject, self._flashes, view),
            self.movement,
        )
        return select_flash_effects(self.rig, self.subject, self.state, *seen)

    def white_rgb(self, view_name: str | None = None) -> Float32Array:
        """Return the camera RGB of the white reference at power 1, fraction of full scale, (3,)."""
        view = self._camera(view_name)
        white = spectra.camera_white(view.spectral_sensitivity, self._illuminant)
        return np.asarray(METERING_LEVEL * white / white.max(), np.float32)

    def radiance(
        self,
        polarizer: str = "crossed",
        analyzer_deg: float | None = None,
        *,
        view_name: str | None = None,
    ) -> Float32Array:
        """Return the light on the sensor at power 1, without noise and vignetting.

        Parameters
        ----------
        polarizer
            "parallel" or "crossed".
        analyzer_deg
            Reading of the analyzer's rotator in degrees; ``None`` takes that of the stop.
        view_name
            Name of the camera; ``None`` takes the first.

        Returns
        -------
        ndarray of float32
            Camera RGB without white balance, shape (H, W, 3), fraction of full scale.
        """
        view = self._camera(view_name)
        passes_deg = self.films.analyzer_axis_deg(view, polarizer, analyzer_deg)
        white = self.white_rgb(view.name)
        shape = (view.height_px, view.width_px, 3)
        if isinstance(self.subject, Target) and self.subject.kind == "cap":
            return np.zeros(shape, np.float32)
        if isinstance(self.subject, Target) and self.subject.kind == "source":
            level = np.float32(FLAT_FIELD_LEVEL / METERING_LEVEL) * white
            return np.broadcast_to(level, shape).copy()
        picture = self._flash_image(view)
        diffuse = self._apply_analyzer(np.moveaxis(picture.diffuse, 2, 3), view, passes_deg)
        specular = self._apply_analyzer(picture.specular, view, passes_deg)
        return np.maximum((diffuse + specular[..., None]) * white, 0.0)

    @cached_method
    def under(self, led: str) -> "FlashScene":
        """Return the scene with an LED in place of each tube, by its name; empty: itself."""
        if not led:
            return self
        lights = tuple(replace(light, illuminant=led) for light in self.rig.lights)
        return FlashScene(
            replace(self.rig, lights=lights),
            self.subject,
            state=self.state,
            movement=self.movement,
            sensor=self.sensor(),
            films=self.films,
            seed=self.seed,
            effects=self._effects,
            power=self._power,
            subpixels=self.subpixels,
            choice=self._choice,
        )

    def exposure(
        self, view_name: str, *, pops: Sequence[FlashPop], exposure_s: float, seed: int
    ) -> UInt16Array:
        """Simulate one exposure of a camera.

        Parameters
        ----------
        view_name
            Name of the camera.
        pops
            The flashes that fired while the shutter was open; none yields a dark frame.
        exposure_s
            Exposure time, s.
        seed
            Seed of this exposure's noise.

        Returns
        -------
        ndarray of uint16
            Raw DN, shape (H, W).
        """
        return self._expose(
            self._camera(view_name),
            pops,
            pop_energy,
            lambda pop: self.under(pop.led).radiance(
                pop.polarizer, pop.analyzer_deg, view_name=view_name
            ),
            deviation=POP_ENERGY_DEVIATION,
            exposure_s=exposure_s,
            seed=seed,
        )

    def truth(self, view_name: str | None = None) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth for estimators, at the sensor's resolution.

        Parameters
        ----------
        view_name
            Name of the camera; ``None`` takes the first.

        Returns
        -------
        dict
            Maps of shape (H, W[, 3]), float32, averaged over each pixel's covered part:

            ``melanin``, ``hemoglobin``: volume fractions, sharp;
            ``melanin_blurred``, ``hemoglobin_blurred``: the fractions of uniform skin with the
            appearance of the skin after lateral scattering, all else known;
            ``reflectance``, ``reflectance_blurred``: white-balanced diffuse reflectance, (H, W, 3);
            ``shading``: factor of reflectance times `white_rgb` in the crossed image at power 1,
            without specular leak, lateral scattering and interreflection;
            ``irradiance``: light of the flashes on the surface over that on the white reference;
            ``diffuse``, ``specular``: camera RGB without analyzer at power 1 in fraction of full
            scale, subsurface and surface light, (H, W, 3), after the lens, which blurs
            no other map; crossed is about half the first, parallel half the first and the second;
            ``normals``: unit, rig frame, with relief; ``position_mm``: rig frame;
            ``roughness``: GGX alpha; ``uv``: texture coordinates, (H, W, 2);
            ``hair``: fraction covered by hair (brows, lashes);
            ``mask``: bool, pixels wholly on skin, whose light comes from skin within
            `rigsim.scenes.flash.truth.MAX_FOREIGN_LIGHT_FRACTION`.

            All maps are those of the moved face. For a state other than "neutral" there are also
            ``melanin_at_rest``, ``hemoglobin_at_rest``: the fractions of this state mapped onto the
            face at rest, sharp; ``melanin_blurred_at_rest``, ``hemoglobin_blurred_at_rest``: those
            of uniform skin, blurred on the moved face; ``mask_at_rest``: bool, for all four. Where
            the face has moved also ``position_at_rest_mm``: position at rest of the skin in a
            pixel, rig frame.

        Raises
        ------
        SceneError
            For a target; only faces have these maps.
        """
        self._face()
        view = self._camera(view_name)
        picture = self._flash_image(view)
        passes_deg = self.films.analyzer_axis_deg(view, "crossed", None)
        truth = flash_truth.truth_maps(
            picture,
            self._blurred_maps(view),
            shading=self._apply_analyzer(picture.shading, view, passes_deg),
            white_rgb=self.white_rgb(view.name),
        )
        if self.state != "neutral":
            truth |= self._fractions_at_rest(view, truth)
        return truth

    def landmarks_px(self, view_name: str | None = None) -> dict[str, tuple[float, float]]:
        """Return the positions of named skin points in the image.

        Parameters
        ----------
        view_name
            Name of the camera; ``None`` takes the first.

        Returns
        -------
        dict
            Name to (x, y) on the sensor, px: x to the right, y down, the center of pixel (0, 0) is
            (0, 0); see `rigsim.subject.landmarks.POINTS_MM`. Points that are not visible to the
            camera are missing. The points move with the skin between states.

        Raises
        ------
        SceneError
            For a target.
        """
        face, view = self._face("landmarks"), self._camera(view_name)
        points = face.surface_landmarks()
        places = points.positions_on(face.mesh)
        pixels = landmarks.project_points(places, view)
        visible = landmarks.is_visible(places, view, self._caster)
        return {
            name: (float(x), float(y))
            for name, (x, y), shown in zip(points.names, pixels, visible, strict=True)
            if shown
        }

    def resolution_mm(self, view_name: str | None = None) -> Float64Array:
        """Return the widths from 10 to 90 % of an edge that lateral transport blurs, mm, (3,)."""
        camera = self._camera(view_name).spectral_sensitivity
        skin = observe_skin(self._face("skin"), self.state, camera, self._illuminant)
        return edge_width_mm((kernels := skin.lateral_kernels()).sigmas_mm, kernels.weights)

    def _apply_analyzer(self, stokes: Float32Array, view: View, passes_deg: float) -> Float32Array:
        """Apply the analyzer to Stokes vectors of shape (H, W, 3) or (H, W, 3 RGB, 3)."""
        to_camera = -camera_rays(view)[1]
        right, up, _ = view.axes
        if stokes.ndim == 4:
            to_camera = to_camera[:, :, None]
        return shading.apply_analyzer(
            stokes,
            to_camera,
            passes_deg=passes_deg,
            image_right=right,
            image_up=up,
            extinction=self.films.analyzer_extinction,
        )

    @cached_method
    def _skin_glow(self, camera: str) -> SubsurfaceRadiance:
        face = self._face("skin")
        skin = observe_skin(face, self.state, camera, self._illuminant)
        surface, bounces = self._surface_light(face), self._bounces(skin)
        return render_subsurface_radiance(
            skin, surface, lateral_transport=self.lateral, interreflection=bounces
        )

    def _bounces(self, skin: ObservedSkin) -> InterreflectionSettings | None:
        if not self.interreflections:
            return None
        spectral = self.needs.builds(face_needs.SPECTRAL_EFFECT)
        chosen = int(self.needs[face_needs.WAVELENGTH_STEP_EFFECT].choice or 1)
        step = self._effects.spectral_step or chosen
        exchange, last = interreflection_for(self._caster), self._last_bounce(self._effects)
        return InterreflectionSettings(exchange, spectral, step, last)

    def _surface_light(self, subject: SimulatedSubject) -> SurfaceIllumination:
        shaded = self.needs.builds(face_needs.RELIEF_SHADOW_EFFECT)
        key, known = (*self._flashes.key, shaded), self._stage.light
        if key not in known:
            known[key] = illuminate_surface(
                subject,
                self.rig.lights,
                self._flashes.weights,
                self.films,
                caster=self._caster,
                relief=self._stage.relief(subject) if shaded else None,
            )
        return known[key]

    @cached_method
    def _blurred_maps(self, view: View) -> Mapping[str, Float32Array]:
        """Return the maps that are blurred like the light; only the ground truth requires them."""
        if not self.lateral:
            return flash_truth.unblurred_maps(self._flash_image(view))
        look = FlashCamera(self.rig, view, self.subpixels)
        surface = unlit_surface(self._caster, self._flashes)
        return look.observe_maps(surface, self._face(), self._blurred_textures(view)).maps

    @cached_method
    def _blurred_textures(self, view: View) -> Mapping[str, Float32Array]:
        """Return the textures of those maps, of the moved face."""
        look = FlashCamera(self.rig, view, self.subpixels)
        glow = self._skin_glow(view.spectral_sensitivity)
        return look.blurred_maps(self._face(), self.state, glow)

    def _fractions_at_rest(self, view: View, moved: FlashTruth) -> FlashTruth:
        """Return the fractions of this state mapped onto the face at rest."""
        if (rest := (face := self._face()).rest) is None:
            return flash_truth.rest_maps_of_unmoved_face(moved)
        spread = self._blurred_textures(view) if self.lateral else None
        look = self._flash_camera(view, rest.mesh)
        caster = shared_flash_geometry(rest, self._choice).caster
        surface = unlit_surface(caster, self._flashes)
        return flash_truth.truth_maps_at_rest(look, surface, face, self.state, spread)

    def _flash_camera(self, view: View, mesh: Mesh) -> FlashCamera:
        spread = None
        if self.optics:
            depths, fine = depth_range(view, mesh), self.subpixels
            spread = tabulate_defocus(view, self._illuminant, subpixels=fine, depths_mm=depths)
        return FlashCamera(self.rig, view, self.subpixels, spread)

    @cached_method
    def _flash_image(self, view: View) -> FlashImage:
        look, subject = self._flash_camera(view, self.subject.mesh), self.subject
        if isinstance(subject, Target):
            return look.observe_target(self._surface(view))
        glow = self._skin_glow(view.spectral_sensitivity)
        return look.observe_face(self._surface(view), subject, self.state, glow)

    def _surface(self, view: View) -> FlashSurface:
        subject, camera = self.subject, view.spectral_sensitivity
        if not self._caster.choice.is_vectorized:
            target = subject if isinstance(subject, Target) else None
            return FastSurface(self._caster, self._flashes, target)
        if isinstance(subject, Target):
            material = describe_flash_target(subject, camera, self._illuminant)
        else:
            material = describe_face(subject, self._skin_glow(camera).reflectance)
        return MitsubaSurface(subject.mesh, material, self._flashes, self._caster.choice)


def pop_energy(pop: FlashPop) -> float:
    """Return the energy of a pop, 0 to 1 of a full one."""
    if not 0.0 <= pop.power <= 1.0:
        raise SceneError(f"power of pop {pop.token!r}: got {pop.power}, expected 0 to 1")
    return pop.power
