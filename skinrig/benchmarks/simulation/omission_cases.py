"""Render small scenes of each rig with and without the effects that their rules evaluate."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from capture.rig import load_rig
from model import spectra
from rigsim.light.interreflection import Interreflection
from rigsim.needs.effect_sizes import is_flat
from rigsim.needs.effects import PixelNoise, SceneEffects
from rigsim.needs.face import BAND_EFFECT, PIGMENT_EFFECT, RELIEF_EFFECT, WAVELENGTH_STEP_EFFECT
from rigsim.render import Caster, visibility
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.flash.scene import FlashScene
from rigsim.scenes.gradient.reference import NEUTRAL_GRIP
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.subject import make_subject
from rigsim.targets import make_target
from skinrig.arrays import Float32Array, Float64Array
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.simulating.dome import small_dome
from skinrig.simulating.gradient import make_scene

FLOAT32_ROUNDING: Final = 4.0 * float(np.finfo(np.float32).eps)
"""Relative error of an image in single precision, after a few sums."""

FACE_TEXELS: Final = 256

N_TIMED_IMAGES: Final = 3
"""Images per timing; the quickest counts."""


@dataclass(frozen=True, slots=True)
class EffectComparison:
    """Comparison of one scene with and without one effect."""

    rig: str
    subject: str
    effect: str
    verdict: str
    """Verdict of the scene's rule, see `rigsim.needs.effects.Verdict`."""
    predicted_change: float | None
    """Largest change over noise as predicted by the rule."""
    found: float
    """Largest change of any pixel over its noise, as rendered."""
    change_stderr: float
    """Standard error of ``found`` by photon noise and rounding, in the same unit."""
    with_s: float
    """Processor seconds with the effect."""
    without_s: float
    """Processor seconds without."""

    @property
    def max_change(self) -> float:
        """Largest change over noise with three standard errors on top."""
        return self.found + 3.0 * self.change_stderr


Images = Float32Array | Float64Array
"""Images of a camera, in fractions of full scale."""
Render = Callable[..., Images]


@dataclass(frozen=True, slots=True)
class ComparedScene:
    """A scene whose images with and without effects are compared."""

    rig: str
    subject: str
    scene: Any
    """Scene with the effects that its rule selects."""

    @property
    def noise(self) -> PixelNoise:
        """Noise of the scene's sensor."""
        return PixelNoise.of(self.scene.sensor())

    def compare(
        self, render: Render, switched: Mapping[str, tuple[Any, Any]]
    ) -> Iterator[EffectComparison]:
        """Render the scene with and without each effect that has a switch.

        Parameters
        ----------
        render
            Called with settings of the scene; returns images.
        switched
            Settings with and without the effect, by switch.
        """
        for effect in self.scene.needs:
            if effect.switch not in switched:
                continue
            # the saved time matters for omitted effects only
            times = N_TIMED_IMAGES if effect.verdict == "negligible" else 1
            (with_s, have), (without_s, lack) = (
                measure_processor_time(lambda: render(**{effect.switch: setting}), times)
                for setting in switched[effect.switch]
            )
            yield self.compare_images(effect, have, lack, (with_s, without_s), full_scale=1.0)

    def compare_images(
        self,
        effect: Any,
        with_effect: Images,
        without_effect: Images,
        seconds: tuple[float, float],
        *,
        full_scale: float = math.inf,
    ) -> EffectComparison:
        """Compare images with and without one effect, relative to the sensor's noise."""
        sigma = self.noise.sigma(with_effect)
        shown, bare = (
            np.minimum(one.astype(np.float64), full_scale) for one in (with_effect, without_effect)
        )
        return EffectComparison(
            self.rig,
            self.subject,
            effect.name,
            effect.verdict,
            effect.over_noise,
            float((np.abs(shown - bare) / sigma).max()),
            FLOAT32_ROUNDING * float(np.max(with_effect / sigma)),
            *seconds,
        )

    def compare_simplified_face(self, render: Render) -> Iterator[EffectComparison]:
        """Compare a face with simplified ones: uniform pigment, no relief, one color band.

        Parameters
        ----------
        render
            Called with a subject; returns images.
        """
        face, needs = self.scene.subject, self.scene.needs
        with_s, have = measure_processor_time(lambda: render(face))
        even = np.full_like(face.melanin, np.median(face.melanin[face.atlas.covered]))
        for name, plain in (
            (RELIEF_EFFECT, dataclasses.replace(face, normal=face.atlas.normal)),
            (PIGMENT_EFFECT, dataclasses.replace(face, melanin=even)),
        ):
            without_s, lack = measure_processor_time(lambda: render(plain))
            yield self.compare_images(needs[name], have, lack, (with_s, without_s))
        rig = self.scene.rig
        white = spectra.camera_white(rig.views[0].spectral_sensitivity, rig.lights[0].illuminant)
        gray = np.asarray(white / white.mean(), np.float32)
        mean_s, one = measure_processor_time(lambda: have.mean(axis=-1, keepdims=True) * gray)
        # one band would take a third of the sums over colors, which are not timed separately
        yield self.compare_images(needs[BAND_EFFECT], have, one, (mean_s, mean_s))


def compare_flash_face(
    preset: str, *, width_px: int, texels: int = FACE_TEXELS, light_deg: float | None = None
) -> Iterator[EffectComparison]:
    """Compare images of a face in the flash rig, parallel and crossed, at full power.

    Parameters
    ----------
    preset
        Melanin preset of the face.
    width_px, texels
        Width of the image, and side of the face's texture.
    light_deg
        Angle of a single light to the right of the camera's axis, degrees; None: all lights at
        their nominal positions.
    """
    rig = load_rig("flash").resized(width_px)
    name = preset
    if light_deg is not None:
        rig, name = (
            _set_light_angle(rig, light_deg),
            f"{preset}, one light at {light_deg:g} degrees",
        )
    face = make_subject(preset, seed=0, size=texels)
    scene = FlashScene(rig, face)

    def render(subject: Any = face, **settings: Any) -> Images:
        made = FlashScene(rig, subject, effects=SceneEffects.from_switches(settings))
        return np.stack([made.radiance(name) for name in ("parallel", "crossed")])

    scene.radiance()  # compiles, and traces rays that are common to all scenes of this face
    coarser = 2 if scene.needs.builds(WAVELENGTH_STEP_EFFECT) else None
    compared = ComparedScene("flash", name, scene)
    yield from compared.compare(
        render,
        {
            **dict.fromkeys(("lateral", "interreflections", "spectral", "optics"), (True, False)),
            "spectral_step": (1, coarser),
            "last_bounce": (1e-7, None),
        },
    )
    if light_deg is None:
        yield from compared.compare_simplified_face(render)


def _set_light_angle(rig: Any, angle_deg: float) -> Any:
    """Return a rig with its first light only, at an angle from +z towards +x."""
    light = rig.lights[0]
    distance, angle = math.hypot(*light.position_mm), math.radians(angle_deg)
    position = (distance * math.sin(angle), 0.0, distance * math.cos(angle))
    return dataclasses.replace(rig, lights=(dataclasses.replace(light, position_mm=position),))


def compare_dome_face(
    preset: str, *, width_px: int, lights: int, state: str = "neutral"
) -> Iterator[EffectComparison]:
    """Compare images of a face in the dome under some lights, each exposed to full scale.

    A face with an expression is compared with and without shadows of its wrinkles.
    """
    rig = small_dome(load_rig("dome"), lights=lights, views=1, width_px=width_px)
    face = make_subject(preset, seed=0, size=FACE_TEXELS)
    rest, view = state == "neutral", rig.views[0].name
    plain = {} if rest else {"interreflections": False, "subsurface": False}

    def made(subject: Any = face, **settings: Any) -> DomeScene:
        # interreflection is traced once for all scenes of the face
        effects = SceneEffects.from_switches(plain | settings)
        return DomeScene(rig, subject, state=state, effects=effects)

    scene = made()
    brightest = scene.radiance(view).max(axis=(1, 2, 3), keepdims=True)

    def render(subject: Any = face, **settings: Any) -> Images:
        return np.asarray(made(subject, **settings).radiance(view) / brightest)

    if not rest:
        compared = ComparedScene("dome", f"{preset}, {state}", scene)
        yield from compared.compare(render, {"relief_shadows": (True, False)})
        return
    compared = ComparedScene("dome", preset, scene)
    names = ("subsurface", "interreflections", "spectral", "optics", "relief_shadows")
    yield from compared.compare(
        render, {**dict.fromkeys(names, (True, False)), "last_bounce": (1e-7, None)}
    )
    yield from compared.compare_simplified_face(render)


def compare_gradient_skin(site: str, *, width_px: int) -> Iterator[EffectComparison]:
    """Compare images of a relaxed patch under all LEDs, parallel and crossed, at full scale."""
    rig = load_rig("gradient").cropped(width_px)
    base = make_scene(rig, site=site)
    brightest = max(float(part[0].max()) for part in base.moments(NEUTRAL_GRIP).values())

    def render(**settings: Any) -> Images:
        effects = SceneEffects.from_switches(settings)
        made = GradientScene(rig, base.subject, sphere=base.sphere, effects=effects)
        light = np.stack([part[0] for part in made.moments(NEUTRAL_GRIP).values()])
        return np.asarray(light / np.float32(brightest), np.float32)

    names = ("shadows", "lateral", "interreflections", "optics")
    compared = ComparedScene("gradient", site, base)
    yield from compared.compare(render, dict.fromkeys(names, (True, False)))


def check_flat_targets() -> Iterator[EffectComparison]:
    """Check with rays that targets have neither self-shadowing nor interreflection."""
    flash = load_rig("flash").resized(64)
    dome = small_dome(load_rig("dome"), lights=4, views=1, width_px=64)
    scenes: list[tuple[str, str, Any]] = [
        ("flash", name, FlashScene(flash, make_target(name))) for name in ("white", "chart")
    ]
    scenes.append(("dome", "white", DomeScene(dome, make_target("white"))))
    for rig, name, scene in scenes:
        noise = PixelNoise.of(scene.sensor())
        caster = Caster(scene.subject.mesh)
        # omission costs only the check for flatness
        check_s, flat = measure_processor_time(lambda: is_flat(caster.mesh))

        def trace_exchange() -> tuple[Interreflection, float]:
            bounce = Interreflection(caster, patches=24)
            return bounce, float(np.asarray(bounce.exchange.sum(axis=1)).max(initial=0.0))

        seconds, (bounce, got) = measure_processor_time(trace_exchange)
        points, normals = (part[0] for part in bounce.surface())
        cast = partial(visibility, caster, points, normals, samples=4)
        shading_s, seen = measure_processor_time(
            lambda: min(
                float(cast(light.position_mm, radius_mm=light.radius_mm).min())
                for light in scene.rig.lights
                if light.position_mm[2] > light.radius_mm
            )
        )
        for effect in scene.needs:
            if effect.verdict != "negligible" or not flat:
                continue
            lost, with_s = (got, seconds) if effect.switch else (1.0 - seen, shading_s)
            yield EffectComparison(
                rig,
                name,
                effect.name,
                effect.verdict,
                effect.over_noise,
                noise.change_over_noise(lost),
                noise.change_over_noise(FLOAT32_ROUNDING),
                with_s,
                max(check_s, 1e-6),
            )
