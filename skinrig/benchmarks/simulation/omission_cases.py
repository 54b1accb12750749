"""Small scenes of each rig, rendered with and without what their needs speak of."""

from __future__ import annotations

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


@dataclass(frozen=True, slots=True)
class Pictures:
    """What a camera gets, in full scales."""

    light: Float32Array
    stderr: Float32Array | None = None
    """Of the Monte Carlo where there is one."""


Render = Callable[..., Pictures]


def compare(
    rig: str,
    subject: str,
    scene: Any,
    noise: Any,
    render: Render,
    switched: Mapping[str, tuple[Any, Any]],
) -> Iterator[Omission]:
    """Render a scene with and without each effect that has a switch.

    Parameters
    ----------
    rig, subject
        Names.
    scene
        As its needs decide.
    noise
        Of the sensor, see `rigsim.needs.effects.Noise`.
    render
        Called with settings of the scene; returns pictures.
    switched
        For each switch its settings with and without the effect.
    """
    for effect in scene.needs:
        if effect.switch not in switched:
            continue
        on, off = switched[effect.switch]
        # only of what is left out the seconds are a claim
        times = N_TIMED_PICTURES if effect.verdict == "negligible" else 1
        have, with_s = _timed(render, {effect.switch: on}, times)
        lack, without_s = _timed(render, {effect.switch: off}, times)
        sigma = noise.sigma(have.light)
        change = np.abs(_shown(have) - _shown(lack)) / sigma
        place = np.unravel_index(int(np.argmax(change)), change.shape)
        rounded = FLOAT32_ROUNDING * float(np.max(have.light / sigma))
        error = rounded
        if have.stderr is not None and lack.stderr is not None:
            both = np.hypot(have.stderr, lack.stderr) / sigma
            error = math.hypot(rounded, float(both[place]))
        yield Omission(
            rig,
            subject,
            effect.name,
            effect.verdict,
            effect.over_noise,
            float(change[place]),
            error,
            with_s,
            without_s,
        )


def _shown(pictures: Pictures) -> Float64Array:
    """Return what a sensor tells of light, which ends at full scale."""
    return np.minimum(pictures.light.astype(np.float64), 1.0)


def _timed(render: Render, settings: Mapping[str, Any], times: int) -> tuple[Pictures, float]:
    least = math.inf
    for _ in range(times):
        begin = time.process_time()
        made = render(**settings)
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

    def render(**settings: Any) -> Pictures:
        made = FlashScene(rig, face, effects=SceneEffects.from_switches(settings))
        return Pictures(np.stack([made.radiance(name) for name in ("parallel", "crossed")]))

    scene.radiance()  # compiles, and traces what all scenes of this face share
    coarser = 2 if scene.needs.builds(WAVELENGTH_STEP_EFFECT) else None
    yield from compare(
        "flash",
        name,
        scene,
        Noise.of(scene.sensor()),
        render,
        {
            "lateral": (True, False),
            "interreflections": (True, False),
            "spectral": (True, False),
            "spectral_step": (1, coarser),
            "last_bounce": (1e-7, None),
            "optics": (True, False),
        },
    )
    if light_deg is not None:
        return

    def look(subject: Any) -> Pictures:
        made = FlashScene(rig, subject)
        return Pictures(np.stack([made.radiance(name) for name in ("parallel", "crossed")]))

    yield from _plainer("flash", preset, scene, look)


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

    def render(**settings: Any) -> Pictures:
        # what light goes from skin to skin is traced once for all scenes of the face
        return Pictures(
            DomeScene(rig, face, effects=SceneEffects.from_switches(settings)).radiance(view)
            / brightest
        )

    yield from compare(
        "dome",
        preset,
        scene,
        Noise.of(scene.sensor()),
        render,
        {
            "subsurface": (True, False),
            "interreflections": (True, False),
            "spectral": (True, False),
            "last_bounce": (1e-7, None),
            "optics": (True, False),
        },
    )

    def look(subject: Any) -> Pictures:
        return Pictures(DomeScene(rig, subject).radiance(view) / brightest)

    yield from _plainer("dome", preset, scene, look)


def moved_face(preset: str, *, width_px: int, lights: int) -> Iterator[Omission]:
    """Compare a face that has moved in the dome with and without shadows of its wrinkles."""
    rig = small_dome(load_rig("dome"), lights=lights, views=1, width_px=width_px)
    face = make_subject(preset, seed=0, size=FACE_TEXELS)
    plain = {"interreflections": False, "subsurface": False}
    scene = DomeScene(rig, face, state="surprise", effects=SceneEffects.from_switches(plain))
    view = rig.views[0].name
    brightest = scene.radiance(view).max(axis=(1, 2, 3), keepdims=True)

    def render(**settings: Any) -> Pictures:
        effects = SceneEffects.from_switches(plain | settings)
        made = DomeScene(rig, face, state="surprise", effects=effects)
        return Pictures(made.radiance(view) / brightest)

    yield from compare(
        "dome",
        f"{preset}, surprise",
        scene,
        Noise.of(scene.sensor()),
        render,
        {"relief_shadows": (True, False)},
    )


def _plainer(
    rig: str, preset: str, scene: Any, look: Callable[[Any], Pictures]
) -> Iterator[Omission]:
    """Compare a face with one of even pigment, with one without relief, and three bands with one.

    Parameters
    ----------
    rig, preset
        Names.
    scene
        The face's own.
    look
        Returns the pictures of a subject, in full scales.
    """
    face, noise = scene.subject, Noise.of(scene.sensor())
    begin = time.process_time()
    have = look(face)
    with_s = time.process_time() - begin
    covered = face.atlas.covered
    even = np.full_like(face.melanin, np.median(face.melanin[covered]))
    for name, plain in (
        (RELIEF_EFFECT, dataclasses.replace(face, normal=face.atlas.normal)),
        (PIGMENT_EFFECT, dataclasses.replace(face, melanin=even)),
    ):
        begin = time.process_time()
        lack = look(plain)
        spent = time.process_time() - begin
        yield changed(rig, preset, scene.needs[name], have, lack, noise, (with_s, spent))
    view = scene.rig.views[0]
    white = spectra.camera_white(view.spectral_sensitivity, scene.rig.lights[0].illuminant)
    gray = np.asarray(white / white.mean(), np.float32)
    begin = time.process_time()
    one = Pictures(have.light.mean(axis=-1, keepdims=True) * gray)
    spent = time.process_time() - begin
    # a band alone would be a third of the sums over colors, which are not timed apart
    yield changed(rig, preset, scene.needs[BAND_EFFECT], have, one, noise, (spent, spent))


def changed(
    rig: str,
    subject: str,
    effect: Any,
    have: Pictures,
    lack: Pictures,
    noise: Any,
    seconds: tuple[float, float],
) -> Omission:
    """Compare two pictures that one effect tells apart."""
    sigma = noise.sigma(have.light)
    change = float((np.abs(have.light.astype(np.float64) - lack.light) / sigma).max())
    rounded = FLOAT32_ROUNDING * float(np.max(have.light / sigma))
    return Omission(
        rig, subject, effect.name, effect.verdict, effect.over_noise, change, rounded, *seconds
    )


def gradient_skin(site: str, *, width_px: int) -> Iterator[Omission]:
    """Compare pictures of a relaxed patch under all LEDs, parallel and crossed, at full scale."""
    rig = load_rig("gradient").cropped(width_px)
    base = make_scene(rig, site=site)
    brightest = max(float(part[0].max()) for part in base.moments(NEUTRAL).values())

    def render(**settings: Any) -> Pictures:
        made = GradientScene(
            rig, base.subject, sphere=base.sphere, effects=SceneEffects.from_switches(settings)
        )
        found = made.moments(NEUTRAL)
        light = np.stack([part[0] for part in found.values()]) / np.float32(brightest)
        return Pictures(np.asarray(light, np.float32))

    names = ("shadows", "lateral", "interreflections", "optics")
    yield from compare(
        "gradient", site, base, Noise.of(base.sensor()), render, dict.fromkeys(names, (True, False))
    )


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
