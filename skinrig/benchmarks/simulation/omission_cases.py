"""Small scenes of each rig, rendered with and without what their needs speak of."""

import dataclasses
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from capture.rig import load_rig
from model import spectra
from rigsim.light.interreflection import Interreflection
from rigsim.needs.effect_sizes import is_flat
from rigsim.needs.effects import Noise, SceneEffects
from rigsim.needs.face import BAND_EFFECT, PIGMENT_EFFECT, RELIEF_EFFECT, WAVELENGTH_STEP_EFFECT
from rigsim.render import Caster, visibility
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.flash.scene import FlashScene
from rigsim.scenes.gradient.reference import NEUTRAL
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.subject import make_subject
from rigsim.targets import make_target
from skinrig.arrays import Float32Array, Float64Array
from skinrig.simulating.dome import small_dome
from skinrig.simulating.gradient import make_scene

FLOAT32_ROUNDING: Final = 4.0 * float(np.finfo(np.float32).eps)
"""Relative error of a picture in single precision, after a few sums."""

FACE_TEXELS: Final = 256

N_TIMED_PICTURES: Final = 3
"""Pictures of which the quickest is timed."""


@dataclass(frozen=True, slots=True)
class Omission:
    """One effect of one scene, compared with and without."""

    rig: str
    subject: str
    effect: str
    verdict: str
    """As the scene's rule has it, see `rigsim.needs.effects.Verdict`."""
    told: float | None
    """Largest change over noise as the rule told it."""
    found: float
    """Largest change of any pixel over its noise, as rendered."""
    uncertain: float
    """Standard error of ``found`` by photons, and its rounding, in the same unit."""
    with_s: float
    """Processor seconds with the effect."""
    without_s: float
    """Processor seconds without."""

    @property
    def at_most(self) -> float:
        """Largest change over noise with three standard errors on top."""
        return self.found + 3.0 * self.uncertain


Images = Float32Array | Float64Array
"""What a camera gets, in full scales."""
Render = Callable[..., Images]


@dataclass(frozen=True, slots=True)
class ComparedScene:
    """A scene whose images with and without effects are compared."""

    rig: str
    subject: str
    scene: Any
    """As its needs decide."""

    @property
    def noise(self) -> Noise:
        """The sensor's."""
        return Noise.of(self.scene.sensor())

    def compare(
        self, render: Render, switched: Mapping[str, tuple[Any, Any]]
    ) -> Iterator[Omission]:
        """Render the scene with and without each effect that has a switch.

        Parameters
        ----------
        render
            Called with settings of the scene; returns images.
        switched
            For each switch its settings with and without the effect.
        """
        for effect in self.scene.needs:
            if effect.switch not in switched:
                continue
            # only of what is left out the seconds are a claim
            times = N_TIMED_PICTURES if effect.verdict == "negligible" else 1
            (have, with_s), (lack, without_s) = (
                _timed(lambda: render(**{effect.switch: how}), times)
                for how in switched[effect.switch]
            )
            yield self.changed(effect, have, lack, (with_s, without_s), full_scale=1.0)

    def changed(
        self,
        effect: Any,
        have: Images,
        lack: Images,
        seconds: tuple[float, float],
        *,
        full_scale: float = math.inf,
    ) -> Omission:
        """Compare two images that one effect tells apart, as a sensor shows them."""
        sigma = self.noise.sigma(have)
        shown, bare = (np.minimum(one.astype(np.float64), full_scale) for one in (have, lack))
        return Omission(
            self.rig,
            self.subject,
            effect.name,
            effect.verdict,
            effect.over_noise,
            float((np.abs(shown - bare) / sigma).max()),
            FLOAT32_ROUNDING * float(np.max(have / sigma)),
            *seconds,
        )

    def plainer(self, render: Render) -> Iterator[Omission]:
        """Compare a face with one of even pigment, one without relief, and three bands with one.

        Parameters
        ----------
        render
            Called with a subject; returns images.
        """
        face, needs = self.scene.subject, self.scene.needs
        have, with_s = _timed(lambda: render(face))
        even = np.full_like(face.melanin, np.median(face.melanin[face.atlas.covered]))
        for name, plain in (
            (RELIEF_EFFECT, dataclasses.replace(face, normal=face.atlas.normal)),
            (PIGMENT_EFFECT, dataclasses.replace(face, melanin=even)),
        ):
            lack, spent = _timed(lambda: render(plain))
            yield self.changed(needs[name], have, lack, (with_s, spent))
        rig = self.scene.rig
        white = spectra.camera_white(rig.views[0].spectral_sensitivity, rig.lights[0].illuminant)
        gray = np.asarray(white / white.mean(), np.float32)
        one, spent = _timed(lambda: have.mean(axis=-1, keepdims=True) * gray)
        # a band alone would be a third of the sums over colors, which are not timed apart
        yield self.changed(needs[BAND_EFFECT], have, one, (spent, spent))


def _timed(call: Callable[[], Images], times: int = 1) -> tuple[Images, float]:
    """Return images, and the least processor time of making them, s."""
    least = math.inf
    for _ in range(times):
        begin = time.process_time()
        made = call()
        least = min(least, time.process_time() - begin)
    return made, least


def flash_face(
    preset: str, *, width_px: int, texels: int = FACE_TEXELS, light_deg: float | None = None
) -> Iterator[Omission]:
    """Compare pictures of a face before the flash rig, parallel and crossed, at full power.

    Parameters
    ----------
    preset
        Of the face.
    width_px, texels
        Columns of the camera, and texels along one side of the face's texture.
    light_deg
        One of the lights alone, so far off the camera's axis to the right, degrees; None: all
        lights where they stand.
    """
    rig = load_rig("flash").resized(width_px)
    name = preset
    if light_deg is not None:
        rig, name = _lit_from(rig, light_deg), f"{preset}, one light at {light_deg:g} degrees"
    face = make_subject(preset, seed=0, size=texels)
    scene = FlashScene(rig, face)

    def render(subject: Any = face, **settings: Any) -> Images:
        made = FlashScene(rig, subject, effects=SceneEffects.from_switches(settings))
        return np.stack([made.radiance(name) for name in ("parallel", "crossed")])

    scene.radiance()  # compiles, and traces what all scenes of this face share
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
        yield from compared.plainer(render)


def _lit_from(rig: Any, angle_deg: float) -> Any:
    """Return a rig with the first of its lights alone, at an angle off +z towards +x."""
    light = rig.lights[0]
    far, angle = math.hypot(*light.position_mm), math.radians(angle_deg)
    place = (far * math.sin(angle), 0.0, far * math.cos(angle))
    return dataclasses.replace(rig, lights=(dataclasses.replace(light, position_mm=place),))


def dome_face(preset: str, *, width_px: int, lights: int) -> Iterator[Omission]:
    """Compare pictures of a face in the dome under some lights, each exposed to full scale."""
    rig = small_dome(load_rig("dome"), lights=lights, views=1, width_px=width_px)
    face = make_subject(preset, seed=0, size=FACE_TEXELS)
    scene = DomeScene(rig, face)
    view = rig.views[0].name
    brightest = scene.radiance(view).max(axis=(1, 2, 3), keepdims=True)

    def render(subject: Any = face, **settings: Any) -> Images:
        # what light goes from skin to skin is traced once for all scenes of the face
        made = DomeScene(rig, subject, effects=SceneEffects.from_switches(settings))
        return np.asarray(made.radiance(view) / brightest)

    names = ("subsurface", "interreflections", "spectral", "optics")
    compared = ComparedScene("dome", preset, scene)
    yield from compared.compare(
        render, {**dict.fromkeys(names, (True, False)), "last_bounce": (1e-7, None)}
    )
    yield from compared.plainer(render)


def moved_face(preset: str, *, width_px: int, lights: int) -> Iterator[Omission]:
    """Compare a face that has moved in the dome with and without shadows of its wrinkles."""
    rig = small_dome(load_rig("dome"), lights=lights, views=1, width_px=width_px)
    face = make_subject(preset, seed=0, size=FACE_TEXELS)
    plain = {"interreflections": False, "subsurface": False}
    scene = DomeScene(rig, face, state="surprise", effects=SceneEffects.from_switches(plain))
    view = rig.views[0].name
    brightest = scene.radiance(view).max(axis=(1, 2, 3), keepdims=True)

    def render(**settings: Any) -> Images:
        effects = SceneEffects.from_switches(plain | settings)
        made = DomeScene(rig, face, state="surprise", effects=effects)
        return np.asarray(made.radiance(view) / brightest)

    compared = ComparedScene("dome", f"{preset}, surprise", scene)
    yield from compared.compare(render, {"relief_shadows": (True, False)})


def gradient_skin(site: str, *, width_px: int) -> Iterator[Omission]:
    """Compare pictures of a relaxed patch under all LEDs, parallel and crossed, at full scale."""
    rig = load_rig("gradient").cropped(width_px)
    base = make_scene(rig, site=site)
    brightest = max(float(part[0].max()) for part in base.moments(NEUTRAL).values())

    def render(**settings: Any) -> Images:
        effects = SceneEffects.from_switches(settings)
        made = GradientScene(rig, base.subject, sphere=base.sphere, effects=effects)
        light = np.stack([part[0] for part in made.moments(NEUTRAL).values()])
        return np.asarray(light / np.float32(brightest), np.float32)

    names = ("shadows", "lateral", "interreflections", "optics")
    compared = ComparedScene("gradient", site, base)
    yield from compared.compare(render, dict.fromkeys(names, (True, False)))


def flat_targets() -> Iterator[Omission]:
    """Show that targets neither shade nor light themselves: rays between their own points."""
    flash = load_rig("flash").resized(64)
    dome = small_dome(load_rig("dome"), lights=4, views=1, width_px=64)
    scenes: list[tuple[str, str, Any]] = [
        ("flash", name, FlashScene(flash, make_target(name))) for name in ("white", "chart")
    ]
    scenes.append(("dome", "white", DomeScene(dome, make_target("white"))))
    for rig, name, scene in scenes:
        noise = Noise.of(scene.sensor())
        caster = Caster(scene.subject.mesh)
        begin = time.process_time()
        flat = is_flat(caster.mesh)  # all that leaving it out costs
        told_s = max(time.process_time() - begin, 1e-6)
        begin = time.process_time()
        bounce = Interreflection(caster, patches=24)
        got = float(np.asarray(bounce.exchange.sum(axis=1)).max(initial=0.0))
        seconds = time.process_time() - begin
        points, normals = (part[0] for part in bounce.surface())
        begin = time.process_time()
        seen = min(
            float(
                visibility(
                    caster, points, normals, light.position_mm, radius_mm=light.radius_mm, samples=4
                ).min()
            )
            for light in scene.rig.lights
            if light.position_mm[2] > light.radius_mm
        )
        shading_s = time.process_time() - begin
        for effect in scene.needs:
            if effect.verdict != "negligible" or not flat:
                continue
            lost, spent = (got, seconds) if effect.switch else (1.0 - seen, shading_s)
            yield Omission(
                rig,
                name,
                effect.name,
                effect.verdict,
                effect.over_noise,
                noise.share(lost),
                noise.share(FLOAT32_ROUNDING),
                spent,
                told_s,
            )
