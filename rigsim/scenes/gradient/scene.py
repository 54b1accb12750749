"""Render the gradient rig: a skin patch in a caliper, or a target, under polarized LED patterns.

Each state of the skin is rendered once, as Stokes vectors of the light's four moments after the
lens; patterns and readings of the analyzer are sums of these twelve images.

The unit of light is fixed by the rig alone: a perfect white diffuser in place of the patch that
faces the camera gives `GRADIENT_METER_RATE_PER_S` full scales per second under all LEDs at level 1,
behind the parallel analyzer as behind the crossed one.
"""

import math
from collections.abc import Sequence
from typing import Final, Literal, TypeAlias

import numpy as np

from capture.rig import Rig
from rigsim.arrays import Float32Array, UInt16Array
from rigsim.as_built.polarizers import Polarizers, draw_polarizers
from rigsim.as_built.sphere import PATTERN_WEIGHTS, ActualSphere, diffuser_radiance, nominal_sphere
from rigsim.boxes.gradient_sphere import PatternLight
from rigsim.caching import LruCache
from rigsim.light.lobe_moments import MicrofacetSurface
from rigsim.mitsuba.variant import VariantChoice
from rigsim.needs.effects import AUTOMATIC_EFFECTS, PixelNoise, SceneEffects
from rigsim.needs.face import INTERREFLECTION_EFFECT, LATERAL_EFFECT, SHADOW_EFFECT
from rigsim.needs.gradient import OPTICS_EFFECT, select_gradient_effects
from rigsim.needs.tissue import select_patch_tissue
from rigsim.render.lens_blur import Lens, blur_images, focused_lens
from rigsim.scenes.exposing import RigScene, SceneError, full_power_duration_s
from rigsim.scenes.gradient.analyzer import GridAnalyzer
from rigsim.scenes.gradient.lighting import PatchLighting
from rigsim.scenes.gradient.patch import (
    SHADOW_MARGIN_PX,
    PatchSurface,
    Relief,
    sample_grid,
    sample_patch,
)
from rigsim.scenes.gradient.renderer_choice import (
    LightSettings,
    choose_patch_renderer,
    light_patch,
    scale_leds,
)
from rigsim.scenes.gradient.target import target_moments
from rigsim.sensor import Sensor, make_sensor
from rigsim.skin_patch.microrelief import MicroSkin
from rigsim.skin_patch.motion import PatchMotion, PatchPose, shift_image
from rigsim.skin_patch.stretch import StretchedSkin, stretch_skin
from rigsim.tissue.skin_layers import ETA
from rigsim.world.taped_skin import GripState

TargetName: TypeAlias = Literal["ball", "flat", "dark"]

GRADIENT_METER_RATE_PER_S: Final = 100.0
"""Full scales per second of white under all LEDs at level 1: in 18 ms pale skin reaches 0.4 to 0.8
of full scale."""

PATTERN_POWER_DEVIATION: Final = 0.001
"""Relative standard deviation of the LEDs' common energy between patterns."""

DRIFT_MARGIN_PX: Final = 8
"""Pixels around the image that may drift into it."""

IMAGE_CACHE_BYTES: Final = 2**29
"""Size of the cache of states' images; at least one is kept."""


MAX_CACHED_LIGHTINGS: Final = 2
"""Number of cached lightings: LEDs may change by gains and failures."""

MIN_CACHED_RELIEFS: Final = 4
RELIEF_CACHE_BYTES: Final = 2**28
RELIEF_LAYERS: Final = 10
"""Cached stretched patches: at least so many, up to a size; layers of four bytes in each."""


class GradientScene(RigScene):
    """One patch of skin or one target in the gradient rig.

    Parameters
    ----------
    rig
        The nominal rig.
    subject
        A patch of skin, or "ball" (12 mm of black glass), "flat" (a gray diffuser in place of the
        patch) or "dark" (a cap on the lens).
    films
        The polarizers; None takes the rig's own, which its serial numbers determine.
    sphere
        The actual LEDs; None: nominal.
    motion
        Movement of the patch; None: fixed.
    seed
        Seeds the variation between exposures.
    effects
        Requested effects of light; the others are decided by their changes of pixels, see `needs`.
        Without optics every pixel is the mean of its samples.
    on_s
        Longest exposure of the plan, s, for the sizes of effects; None: such that the brightest
        skin is at full scale.
    subpixels
        Samples along each side of a pixel.
    sectors, table_size
        Request the fast renderer with these settings, see `LightSettings`.
    choice
        Mitsuba variant, for images of any size; None chooses: the fast renderer for large ones. A
        vectorized one renders a Mitsuba scene, unless `variant` names a reason.
    """

    channels = ()

    def __init__(
        self,
        rig: Rig,
        subject: MicroSkin | TargetName,
        *,
        films: Polarizers | None = None,
        sphere: ActualSphere | None = None,
        motion: PatchMotion | None = None,
        seed: int = 0,
        effects: SceneEffects = AUTOMATIC_EFFECTS,
        on_s: float | None = None,
        sectors: int | None = None,
        subpixels: int = 1,
        table_size: int | None = None,
        choice: VariantChoice | None = None,
    ) -> None:
        if len(rig.views) != 1:
            raise SceneError(f"views: got {len(rig.views)}, expected 1")
        if isinstance(subject, str) and subject not in ("ball", "flat", "dark"):
            raise SceneError(f"subject: got {subject!r}, expected ball, flat, dark or skin")
        if subpixels < 1:
            raise SceneError(f"subpixels: got {subpixels}, expected at least 1")
        self.rig = rig
        self.films = draw_polarizers(rig) if films is None else films
        self.sphere = nominal_sphere(rig) if sphere is None else sphere
        self.motion, self.seed = motion, seed
        self.subpixels = subpixels
        self._view = rig.views[0]
        self._sensor = make_sensor(self._view)
        self._lighting: LruCache[tuple[float, ...], PatchLighting] = LruCache(
            lambda _: MAX_CACHED_LIGHTINGS
        )
        # behind two ideal polarizers, one of which the unit of radiance includes already
        white = float(diffuser_radiance(nominal_sphere(rig), np.zeros(1), np.zeros(1))[0, 0])
        # full scales per second per unit of radiance of `rigsim.light.lobe_moments`
        self.unit = GRADIENT_METER_RATE_PER_S / (0.5 * white)
        self._pictures: LruCache[tuple[object, ...], Float32Array] = LruCache(
            lambda picture: IMAGE_CACHE_BYTES // picture.nbytes
        )
        self._reliefs: LruCache[tuple[float, float], StretchedSkin] = LruCache(
            lambda relief: max(
                MIN_CACHED_RELIEFS, RELIEF_CACHE_BYTES // (RELIEF_LAYERS * relief.height_um.nbytes)
            )
        )
        self._analyzer = GridAnalyzer(self.films, self._view)
        level = math.inf if on_s is None else GRADIENT_METER_RATE_PER_S * on_s
        seen = (self.sphere, self.lens, PixelNoise.of(self._sensor), level)
        self.needs = select_gradient_effects(rig, subject, *seen, motion is not None, effects)
        """Effects with their verdicts and reasons."""
        self.subject = select_patch_tissue(subject, self.needs)
        self.shadows = self.needs.builds(SHADOW_EFFECT)
        self.optics = self.needs.builds(OPTICS_EFFECT)
        self.lateral = self.needs.builds(LATERAL_EFFECT)
        self.interreflections = self.needs.builds(INTERREFLECTION_EFFECT)
        self._settings = LightSettings(
            self.shadows, self.lateral, self.interreflections, sectors, table_size
        )
        samples = self.subpixels**2 * self._view.width_px * self._view.height_px
        self.variant = choose_patch_renderer(
            choice, self.subject, self.sphere, samples, self._settings
        )
        """Variant that renders the patch, with the reason."""

    @property
    def lens(self) -> Lens:
        """Return the camera's lens."""
        return focused_lens(self._view, self.rig.lights[0].illuminant)

    def sensor(self, view_name: str | None = None) -> Sensor:
        """Return the camera's sensor."""
        self._camera(view_name)
        return self._sensor

    # images ---------------------------------------------------------------------------------

    def stokes(self, grip: GripState | None = None) -> Float32Array:
        """Return the light on the sensor per moment, before the analyzer.

        Parameters
        ----------
        grip
            State of the caliper's grip; targets need none.

        Returns
        -------
        ndarray of float32
            Shape (4, 3, H, W): moments 1, x, y, z; Stokes parameters in full scales per second at
            level 1 (an analyzer transmits half of it, see `moments`); without drift.
        """
        h, w = self._view.height_px, self._view.width_px
        wide = self._bordered_image(grip)
        border = (wide.shape[1] - h) // 2
        return wide[:, border : border + h, border : border + w].reshape(4, 3, h, w)

    def moments(self, grip: GripState | None = None) -> dict[str, Float32Array]:
        """Return the four moments behind the parallel and the crossed analyzer.

        Parameters
        ----------
        grip
            State of the caliper's grip; targets need none.

        Returns
        -------
        dict
            "parallel" and "crossed": shape (4, H, W), float32, moments 1, x, y, z in full scales
            per second at level 1, without noise, vignetting and drift.
        """
        stokes = self.stokes(grip)
        return {
            name: np.stack([self._analyzer.analyze(s, reading) for s in stokes])
            for name, reading in (("parallel", 0.0), ("crossed", 90.0))
        }

    def radiance(
        self,
        pattern: str,
        *,
        grip: GripState | None = None,
        analyzer_deg: float = 0.0,
        t_s: float | None = None,
        led_shares: tuple[float, ...] = (),
    ) -> Float32Array:
        """Return the light on the sensor under a pattern, without noise and vignetting.

        Parameters
        ----------
        pattern
            One of `rigsim.as_built.sphere.PATTERN_WEIGHTS`.
        grip
            State of the caliper's grip; targets need none.
        analyzer_deg
            Reading of the analyzer's rotator, degrees.
        t_s
            World time, s, which determines drift and jumps; None: neither.
        led_shares
            Actual output of each LED relative to its nominal one; empty: 1 for all.

        Returns
        -------
        ndarray of float32
            Shape (H, W), full scales per second at level 1, >= 0.
        """
        shape = (self._view.height_px, self._view.width_px)
        weights = np.array(_weights(pattern), np.float32)
        if not weights.any():
            return np.zeros(shape, np.float32)
        jump, drift = (0.0, 0.0), (0.0, 0.0)
        if self.motion is not None and t_s is not None and isinstance(self.subject, MicroSkin):
            jump, drift = self.motion.jump_mm(t_s), self.motion.drift_mm(t_s)
        wide = self._bordered_image(grip, jump_mm=jump, shares=led_shares)
        border = (wide.shape[1] - shape[0]) // 2
        reach = border if any(drift) else 0
        part = slice(border - reach, wide.shape[1] - border + reach)
        column = slice(border - reach, wide.shape[2] - border + reach)
        stokes = np.zeros(
            (3, wide.shape[1] - 2 * (border - reach), wide.shape[2] - 2 * (border - reach)),
            np.float32,
        )
        for m in np.flatnonzero(weights):
            stokes += weights[m] * wide[3 * m : 3 * m + 3, part, column]
        image = self._analyzer.analyze(stokes, analyzer_deg, border_px=reach)
        if reach:
            pixel_um = self.lens.pixel_on_subject_um
            image = shift_image(image, drift, pixel_um=pixel_um, border_px=reach)
        # subtraction per LED leaves rounding errors where no light remains
        return np.maximum(image, np.float32(0.0))

    def exposure(
        self,
        view_name: str,
        *,
        pops: Sequence[PatternLight],
        exposure_s: float,
        seed: int,
        grip: GripState | None = None,
    ) -> UInt16Array:
        """Simulate one exposure of the camera.

        Parameters
        ----------
        view_name
            Name of the camera.
        pops
            The lit patterns, clipped to the exposure; none yields a dark frame.
        exposure_s
            Exposure time, s.
        seed
            Seed of this exposure's noise.
        grip
            State of the caliper's grip at its beginning; skin needs one.

        Returns
        -------
        ndarray of uint16
            Raw DN, shape (H, W).
        """
        return self._expose(
            self._camera(view_name),
            pops,
            lambda pop: full_power_duration_s(pop, f"pattern {pop.pattern!r}"),
            lambda pop: self.radiance(
                pop.pattern,
                grip=grip,
                analyzer_deg=pop.analyzer_deg,
                t_s=0.5 * (pop.t_on_s + pop.t_off_s),
                led_shares=pop.led_shares,
            ),
            deviation=PATTERN_POWER_DEVIATION,
            exposure_s=exposure_s,
            seed=seed,
        )

    def clear_caches(self) -> None:
        """Drop the cached images of the subject's states, which are then rendered again."""
        self._pictures.clear()

    # ground truth --------------------------------------------------------------------------------

    def surface(
        self,
        grip: GripState,
        *,
        subpixels: int = 1,
        border_px: int = 0,
        jump_mm: tuple[float, float] = (0.0, 0.0),
    ) -> PatchSurface:
        """Return the surface at the camera's samples in a state, without drift."""
        grid = sample_grid(self._view, subpixels=subpixels, border_px=border_px)
        pose, alpha = self.pose(grip), float(np.median(self.skin.alpha))
        moved = PatchPose(pose.x_mm + jump_mm[0], pose.y_mm + jump_mm[1], pose.rotation_rad)
        eye_mm = self._view.distance_mm
        return sample_patch(self._relief_at(grip), grip, moved, grid, eye_mm=eye_mm, alpha=alpha)

    def relief(self, grip: GripState) -> StretchedSkin:
        """Return the skin in a state, in its own frame."""
        skin = self.skin
        key = (grip.stretch, grip.angle_deg if grip.stretch != 1.0 else 0.0)
        return self._reliefs.get(key, lambda: stretch_skin(skin, stretch=key[0], angle_deg=key[1]))

    def _relief_at(self, grip: GripState) -> Relief:
        return self.relief(grip)

    def pose(self, grip: GripState) -> PatchPose:
        """Return the skin's pose in a state, without drift and jumps."""
        if self.motion is None:
            return PatchPose(0.0, 0.0, 0.0)
        return self.motion.pose(grip.angle_deg, grip.step)

    # inside -------------------------------------------------------------------------------------

    @property
    def skin(self) -> MicroSkin:
        """Return the patch of skin."""
        if not isinstance(self.subject, MicroSkin):
            raise SceneError(f"skin: got the target {self.subject!r}, expected a patch of skin")
        return self.subject

    def _bordered_image(
        self,
        grip: GripState | None,
        *,
        jump_mm: tuple[float, float] = (0.0, 0.0),
        shares: tuple[float, ...] = (),
    ) -> Float32Array:
        """Return the twelve images with a border, shape (12, H + 2 b, W + 2 b)."""
        if all(share == 1.0 for share in shares):
            shares = ()
        if isinstance(self.subject, MicroSkin):
            if grip is None:
                raise SceneError("grip: got none, expected the state of the caliper's grip")
            key: tuple[object, ...] = (grip, *jump_mm, shares)
        else:
            key = (self.subject, shares)

        def make() -> Float32Array:
            if isinstance(self.subject, MicroSkin) and grip is not None:
                picture = self._render(grip, jump_mm, shares)
            else:
                sphere, extinction = scale_leds(self.sphere, shares), self.films.light_extinction
                picture = target_moments(
                    str(self.subject), self._view, sphere, extinction, seed=self.seed
                )
                if self.subject == "ball" and self.optics:
                    picture = blur_images(picture, self.lens, averaged=True)
            picture *= np.float32(self.unit)
            return picture

        return self._pictures.get(key, make)

    def _render(
        self, grip: GripState, jump_mm: tuple[float, float], shares: tuple[float, ...]
    ) -> Float32Array:
        s = self.subpixels
        margin = SHADOW_MARGIN_PX if self.shadows or self.interreflections else 0
        wide = self.surface(grip, subpixels=s, border_px=DRIFT_MARGIN_PX + margin, jump_mm=jump_mm)
        raw = self.lighting(shares).stokes(
            wide, margin=s * margin, pitch_um=self.lens.pixel_on_subject_um / s
        )
        if self.optics:
            depth_mm = wide.crop(s * margin).height_mm
            return blur_images(raw, self.lens, depth_mm=depth_mm, subpixels=s)
        k, h, w = raw.shape
        return np.asarray(raw.reshape(k, h // s, s, w // s, s).mean(axis=(2, 4)), np.float32)

    def lighting(self, led_fractions: tuple[float, ...] = ()) -> PatchLighting:
        """Return the lighting of this skin, which serves all states.

        Parameters
        ----------
        led_fractions
            Actual output of each LED relative to its nominal one; empty: 1 for all.
        """

        def make() -> PatchLighting:
            return light_patch(
                self.skin,
                scale_leds(self.sphere, led_fractions),
                self.optical_surface(float(np.median(self.skin.alpha))),
                self._view,
                self.variant,
                self._settings,
            )

        return self._lighting.get(led_fractions, make)

    def optical_surface(self, alpha: float) -> MicrofacetSurface:
        """Return the reflection of a surface of a roughness, with the camera."""
        return MicrofacetSurface(
            alpha, ETA, self._view.position_mm, self._view.axes[0], self.films.light_extinction
        )


def _weights(pattern: str) -> tuple[float, float, float, float]:
    if pattern not in PATTERN_WEIGHTS:
        raise SceneError(f"pattern: got {pattern!r}, expected one of {', '.join(PATTERN_WEIGHTS)}")
    return PATTERN_WEIGHTS[pattern]
