"""Render the light dome: a face or a target, one light at a time, in many cameras.

A camera's rays are traced once and serve all lights (see `rigsim.light.olat`). The unit of light
is fixed by the rig alone, see `rigsim.light.led_light`.

Notes
-----
For a camera c and a light l, before noise and vignetting, in fractions of full scale per second of
on-time at level 1::

    signal = gain_c I_l lobe_l(off axis) cos(theta) pi f_r / d^2,    I_l = `DomeScene.intensity(l)`

averaged over the pixel, and over the LED's disc where it casts shadows. A dome is nominal, or as it
was built (`rigsim.as_built.dome`): with other positions and powers, distorted images, different
responses, dead LEDs and crossed wires.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.rig import Light, Rig, View
from model import spectra
from model.skin import SkinAppearance
from rigsim.arrays import Float32Array, Float64Array, UInt16Array
from rigsim.as_built.dome import ActualDome
from rigsim.boxes.led_table import LedPulse
from rigsim.caching import cached_method
from rigsim.geometry.atlas import dilate_texture, sample
from rigsim.light import olat, surface_brdf
from rigsim.light.interreflection import InterreflectionSettings, interreflection_for
from rigsim.light.lateral_scattering import LateralScattering
from rigsim.light.led_light import white_intensity
from rigsim.light.observed_skin import observe_skin
from rigsim.light.olat import CameraSettings, Hits
from rigsim.light.relief_shadow import ReliefShadow
from rigsim.light.surface_brdf import SkinSurface, skin_surface
from rigsim.mitsuba.variant import VariantChoice
from rigsim.needs import face as face_needs
from rigsim.needs.dome import min_noise, sample_led_light, select_dome_effects
from rigsim.needs.effects import AUTOMATIC_EFFECTS, PixelNoise, SceneEffects
from rigsim.needs.tissue import select_face_tissue
from rigsim.population import conditions as skin_conditions
from rigsim.render import Caster
from rigsim.scenes.dome import truth as dome_truth
from rigsim.scenes.dome.images import LightImages
from rigsim.scenes.dome.rendering import LitScene
from rigsim.scenes.dome.rows import AddedSkinLight, DomeRows, DomeSubsurfaceRadiance, normalize
from rigsim.scenes.exposing import FaceGeometry, FaceScene, SceneError, full_power_duration_s
from rigsim.sensor import apply_cfa
from rigsim.subject import SimulatedSubject
from rigsim.subject.head_motion import HeadMotion
from rigsim.targets import Target

LED_POWER_DEVIATION: Final = 0.001
"""Relative standard deviation of an LED's energy between pulses."""


class DomeScene(FaceScene):
    """One subject or target inside the dome.

    Parameters
    ----------
    rig
        The nominal dome; its lights must share one spectrum and be LEDs.
    subject
        A face or a target (for the dome's own targets see `rigsim.scenes.dome.targets`).
    dome
        The actual dome; ``None``: nominal.
    motion
        Movement of the head; ``None``: fixed. Targets are fixed.
    state
        Condition of the face, see `rigsim.subject.perfusion.STATE_NAMES`: its blood, and its
        expression where the state is one; targets have none.
    movement
        Whether the face moves and wrinkles with the state. An already posed subject
        (`SimulatedSubject.posed`) keeps its pose.
    conditions
        Conditions of the skin with their amounts, see `rigsim.population.conditions`; targets have
        none.
    seed
        Seeds the variation between pulses.
    effects
        Requested effects of light; the others are decided by their changes of pixels, see `needs`.
    on_s
        Longest on-time at full level of one light in the plan's exposures, s, for the sizes of
        effects; ``None``: such that the brightest skin is at full scale.
    subpixels
        Rays along each side of a pixel.
    choice
        Mitsuba variant; ``None`` chooses. A vectorized one renders Mitsuba's scene by the
        integrator `olat`; otherwise compiled loops shade.
    """

    channels = ()

    def __init__(
        self,
        rig: Rig,
        subject: SimulatedSubject | Target,
        *,
        dome: ActualDome | None = None,
        motion: HeadMotion | None = None,
        state: str = "neutral",
        movement: bool = True,
        conditions: Mapping[str, float] | None = None,
        seed: int = 0,
        effects: SceneEffects = AUTOMATIC_EFFECTS,
        on_s: float | None = None,
        subpixels: int = 2,
        choice: VariantChoice | None = None,
    ) -> None:
        for light in rig.lights:
            if light.power_w is None:
                raise SceneError(
                    f"light {light.name!r}: got no power_w, expected an LED; add power_w"
                )
        if dome is None:
            dome = ActualDome(rig, rig, np.array([_toward_origin(light) for light in rig.lights]))
        self.dome = dome
        self.conditions = skin_conditions.validate_conditions(conditions or {})
        if isinstance(subject, SimulatedSubject):
            subject = skin_conditions.condition_subject(subject, self.conditions)
        elif self.conditions:
            raise SceneError(f"conditions: got {', '.join(self.conditions)}, but a target has none")
        super().__init__(dome.rig, subject, state, movement, None, seed, subpixels)
        self.motion = motion
        self._effects = effects
        self._caster = Caster(self.subject.mesh, choice=choice)
        noise = min_noise([PixelNoise.of(sensor) for sensor in self._sensors.values()])
        self._geometry = FaceGeometry(self._caster)
        scenery = self._scenery(rig.views[0], self._geometry, noise, effects)
        white = None if on_s is None else on_s * self._white_level_at_origin()
        sampled = sample_led_light(rig, self.subject, self._caster)
        self._skins = self._observe()  # what the rules compute of the skin is reused
        seen = (scenery, white, sampled, movement, motion)
        self.needs = select_dome_effects(rig, self.subject, state, *seen)
        self.subject = select_face_tissue(self.subject, self.needs)
        self._skins = self._observe()
        self.interreflections = self.needs.builds(face_needs.INTERREFLECTION_EFFECT)
        self.subsurface = self.needs.builds(face_needs.LATERAL_EFFECT)
        self.optics = self.needs.builds(face_needs.LENS_EFFECT)
        self._relief: ReliefShadow | None = None
        glow: DomeSubsurfaceRadiance | None = None
        if isinstance(self.subject, SimulatedSubject):
            if self.needs.builds(face_needs.RELIEF_SHADOW_EFFECT):
                self._relief = self._geometry.relief(self.subject)
            if self.subsurface or self.interreflections:
                glow = DomeSubsurfaceRadiance(self._scattering)
        self._added = AddedSkinLight(glow, self._relief, self.subsurface)
        how = CameraSettings(subpixels, self._illuminant, self.optics)
        self._rows = DomeRows(dome, self.subject, self._caster, motion, how)
        self.images = LightImages(self._mosaics)

    @property
    def variant(self) -> VariantChoice:
        """Return the variant that renders the images, with the reason."""
        return self._caster.choice

    @cached_method
    def _scattering(self, camera: str) -> LateralScattering:
        """Return the lateral scattering of the face for a camera's colors."""
        skin = observe_skin(self._face(), "neutral", camera, self._illuminant)
        bounces = None
        if self.interreflections:
            spectral = self.needs.builds(face_needs.SPECTRAL_EFFECT)
            enough = self._last_bounce(self._effects)
            bounces = InterreflectionSettings(
                interreflection_for(self._caster), spectral, min_bounce_fraction=enough
            )
        surface, spread = self._surface(camera), self.subsurface
        return LateralScattering(skin, surface, self._caster, spread, bounces, self._relief)

    def white_rgb(self, view_name: str | None = None) -> Float32Array:
        """Return the camera RGB of white under the LEDs, shape (3,), the strongest channel 1."""
        view = self._camera(view_name)
        white = spectra.camera_white(view.spectral_sensitivity, self._illuminant)
        return np.asarray(white / white.max(), np.float32)

    def intensity(self, light: int, *, view_name: str | None = None) -> Float32Array:
        """Return I_l of the module's equation, full scales per second times mm^2, shape (3,).

        See Also
        --------
        rigsim.light.led_light.white_intensity : the unit; a dead light emits nothing.
        """
        led = self.rig.lights[light]
        if led.name in self.dome.dead:
            return np.zeros(3, np.float32)
        return white_intensity(led, self._camera(view_name)).astype(np.float32)

    def _white_level_at_origin(self) -> Float64Array:
        """Return the full scales per second of a white plate that faces the brightest light."""
        each = [
            white_intensity(light, self.rig.views[0]) / float(np.square(light.position_mm).sum())
            for light in self.rig.lights
        ]
        return np.asarray(np.max(each, axis=0), np.float64)

    def radiance(
        self, view_name: str, lights: Sequence[int] | None = None, *, t_s: float = 0.0
    ) -> Float32Array:
        """Return the light on a sensor per LED, one light at a time, without noise and vignetting.

        Parameters
        ----------
        view_name
            Name of the camera.
        lights
            Indices into the rig's lights; ``None`` takes all.
        t_s
            World time, s; it matters for moving heads only.

        Returns
        -------
        ndarray of float32
            Camera RGB without white balance, shape (n, H, W, 3), fraction of full scale per second
            of on-time at level 1.
        """
        view = self._camera(view_name)
        chosen = range(len(self.rig.lights)) if lights is None else lights
        if len(chosen) == 1:  # the usual stream, one light after the other, is not copied
            return self._render(view, chosen[0], self._rows.pose_time_s(t_s))[None]
        out = np.empty((len(chosen), view.height_px, view.width_px, 3), np.float32)
        for k, light in enumerate(chosen):
            out[k] = self._render(view, light, self._rows.pose_time_s(t_s))
        return out

    def exposure(
        self, view_name: str, *, pops: Sequence[LedPulse], exposure_s: float, seed: int
    ) -> UInt16Array:
        """Simulate one exposure of a camera.

        Parameters
        ----------
        view_name
            Name of the camera.
        pops
            The pulses of the LEDs, clipped to the exposure; none yields a dark frame.
        exposure_s
            Exposure time, s.
        seed
            Seed of this exposure's noise.

        Returns
        -------
        ndarray of uint16
            Raw DN, shape (H, W).
        """
        if self.stripes is not None and view_name in self.stripes.view_names:
            with self.images.undisturbed():
                return self.stripes.exposure(view_name, pops=pops, exposure_s=exposure_s, seed=seed)
        view = self._camera(view_name)

        def frame(pulse: LedPulse) -> Float32Array:
            middle = self._rows.pose_time_s(0.5 * (pulse.t_on_s + pulse.t_off_s))
            led = self.dome.light_of_channel(pulse.led)
            return self.images.get((view.name, led, middle))

        return self._expose(
            view,
            pops,
            lambda pulse: full_power_duration_s(pulse, f"LED {pulse.led}"),
            frame,
            deviation=LED_POWER_DEVIATION,
            exposure_s=exposure_s,
            seed=seed,
        )

    # ground truth ------------------------------------------------------------------------------

    def truth(self, view_name: str | None = None) -> dict[str, NDArray[np.generic]]:
        """Return the ground truth for estimators, at the sensor's resolution, at time 0.

        Parameters
        ----------
        view_name
            Name of the camera; ``None`` takes the first.

        Returns
        -------
        dict
            Maps of shape (H, W[, 3]), float32, averaged over each pixel's covered part:

            ``r_d``: factor of the diffuse term, white-balanced, see `rigsim.light.surface_brdf`;
            ``normals``: unit, rig frame, with relief; ``position_mm``: rig frame; ``roughness``,
            ``oil``, ``fuzz``: of the surface terms, under a condition also ``film``,
            ``film_alpha``, ``film_eta``, ``powder`` (`rigsim.light.surface_brdf.Coating`); ``uv``:
            (H, W, 2); ``hair``: fraction covered by hair (brows, lashes); ``mask``: bool, pixels
            wholly on skin.

        Raises
        ------
        SceneError
            For a target; only faces have these maps.
        """
        self._face()
        view = self._camera(view_name)
        if self._caster.choice.renderer == "mitsuba":
            seen = self._rows.rendered_view(view, 0.0, self._texture)
            return dome_truth.image_truth_maps(seen.surface_hits())
        hits, _ = self._visible_rows(view, 0.0)
        return dome_truth.image_truth_maps(hits)

    def truth_appearance(self, view_name: str | None = None) -> SkinAppearance:
        """Return the ground truth on the face's own texture, at time 0.

        Parameters
        ----------
        view_name
            A camera, for its spectral sensitivity; ``None`` takes the first.

        Returns
        -------
        SkinAppearance
            ``position`` in mm and ``normals`` with relief (rig frame), ``r_d``, ``r_d_floor``
            (`rigsim.light.surface_brdf.min_surface_reflection`: excess of the minimum of eq. (6)
            over r_d even without noise), ``reflectance`` (at normal incidence), ``roughness``,
            ``oil``, ``fuzz``, ``normals_tangent`` (`SimulatedSubject.tangent_normal`: texture
            frame, relief and wrinkles only; comparable between states per texel); for a moved face
            also
            ``position_at_rest``, under conditions its coating (`Coating`); valid on bare skin. All
            maps describe the skin under its conditions.
        """
        surface = self.surface(self._camera(view_name))
        left_out = tuple(self.omitted)
        return dome_truth.texture_truth(
            self._face(), surface, self.conditions, omitted=left_out, seed=self.seed
        )

    def brdf(
        self,
        uv: ArrayLike,
        to_light: ArrayLike,
        to_camera: ArrayLike,
        *,
        view_name: str | None = None,
    ) -> tuple[Float32Array, Float32Array]:
        """Evaluate the ground truth of the reflection at points of the face.

        Parameters
        ----------
        uv
            Texture coordinates, shape (n, 2), (0, 0) is bottom left.
        to_light, to_camera
            Unit vectors in the rig frame away from the surface, shape (n, 3) or (3,); the face's
            own normals with relief are used.
        view_name
            A camera, for its spectral sensitivity; ``None`` takes the first.

        Returns
        -------
        total : ndarray of float32
            f_r in 1/sr, white-balanced camera RGB, shape (n, 3).
        specular : ndarray of float32
            Its surface terms, shape (n,).
        """
        self._face()
        texture = self._texture(self._camera(view_name).spectral_sensitivity)
        points = np.atleast_2d(np.asarray(uv, np.float32))
        values = sample(texture, points, np.ones(len(points), np.bool_))
        return surface_brdf.evaluate_brdf(
            values[:, :-3], normalize(values[:, -3:]), to_light, to_camera
        )

    # inside -----------------------------------------------------------------------------------

    def surface(self, view: View) -> SkinSurface:
        """Return the face's reflection for a camera, under its conditions."""
        return self._surface(view.spectral_sensitivity)

    def texture(self, view: View) -> Float32Array:
        """Return the face's surface and normals for a camera, (N, N, 10) or (N, N, 14)."""
        return self._texture(view.spectral_sensitivity)

    @cached_method
    def _surface(self, camera: str) -> SkinSurface:
        face = self._face()
        bare = skin_surface(face, camera, self._illuminant, state=self.state)
        return skin_conditions.apply_conditions(face, bare, self.conditions)

    @cached_method
    def _texture(self, camera: str) -> Float32Array:
        """Return the surface and its normals with relief, shape (N, N, 10) or (N, N, 14)."""
        surface = self._surface(camera)
        layers = np.concatenate([surface.packed(), surface.normal], axis=-1)
        return dilate_texture(layers, self._face().atlas.covered)

    def expect_requests(self, requests: Iterable[tuple[str, int]]) -> None:
        """Render requests in groups, by camera and channel, in order; not of a head that moves."""
        if self._rows.is_still:
            light = self.dome.light_of_channel
            self.images.expect((camera, light(channel)) for camera, channel in requests)

    def _mosaics(self, view_name: str, lights: Sequence[int], t_s: float) -> list[Float32Array]:
        """Return the light behind each pixel's filter, (H, W), of up to `MOSAIC_LIGHTS` lights."""
        view = self._camera(view_name)
        if view.cfa == "MONO" or self._caster.choice.renderer != "mitsuba" or self._is_cap:
            return [apply_cfa(self._render(view, light, t_s), view.cfa) for light in lights]
        lit, _ = self._light_scene(view, lights, t_s)
        seen = self._rows.rendered_view(view, t_s, self._texture)
        return seen.scene.render_mosaics(seen, lit, view.cfa)

    @property
    def _is_cap(self) -> bool:
        return isinstance(self.subject, Target) and self.subject.kind == "cap"

    def _render(self, view: View, light: int, t_s: float) -> Float32Array:
        if self._is_cap:
            return np.zeros((view.height_px, view.width_px, 3), np.float32)
        (lit,), hits = self._light_scene(view, [light], t_s)
        if self._caster.choice.renderer == "mitsuba":
            seen = self._rows.rendered_view(view, t_s, self._texture)
            return seen.scene.render(seen, light, lit.color, lit.added())
        lamp, added = self._rows.lamp(light, t_s), lit.added()
        visible = olat.is_lamp_visible(hits, self._visible_rows(view, t_s)[1], lamp)
        args = (hits, lamp, visible, lit.color, added.interior)
        return olat.shade_rows(*args, diffuse=not added.replaces_diffuse, relief=added.visible)

    def _light_scene(
        self, view: View, lights: Sequence[int], t_s: float
    ) -> tuple[list[LitScene], Hits]:
        """Return a camera's rows and what lights them, with these lights."""
        for light in lights:
            if not 0 <= light < len(self.rig.lights):
                raise SceneError(f"light: got {light}, expected 0 to {len(self.rig.lights) - 1}")
        hits, _ = self._visible_rows(view, t_s)
        lamps = [self._rows.lamp(light, t_s) for light in lights]
        added = self._added.of_lights(hits, view, lights, lamps, t_s)
        gain = np.float32(self.dome.gain.get(view.name, 1.0))
        return [
            LitScene(light, gain * self.intensity(light, view_name=view.name), add)
            for light, add in zip(lights, added, strict=True)
        ], hits

    def _visible_rows(self, view: View, t_s: float) -> tuple[Hits, Caster]:
        if self._caster.choice.renderer == "mitsuba":
            return self._rows.rendered_view(view, t_s, self._texture).hits, self._caster
        return self._rows.visible_rows(view, t_s, self._texture)


def _toward_origin(light: Light) -> Float64Array:
    place = np.asarray(light.position_mm, np.float64)
    return np.asarray(-place / np.linalg.norm(place))
