"""Benchmark of light that skin reflects onto skin: error of renderings against time and samples.

The reference is Mitsuba's path tracer on the same face. Only light beyond the first reflection
differs, so that the error without it is that of direct light. A second reference is the simulator's
interreflection, which omits specular reflections of skin on skin.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from skimage.color import deltaE_ciede2000, rgb2lab

from capture.calibration.geometry import CameraPose
from capture.rig import load_rig
from rigsim.mitsuba.scene_radiance import point_light_rig
from rigsim.needs.effects import SceneEffects
from rigsim.render import Caster
from rigsim.scenes.dome.scene import DomeScene
from rigsim.scenes.dome.transport_reference import DIRECT_DEPTH, GLOBAL_DEPTH, render_transport
from rigsim.subject import make_subject
from skinrig.arrays import BoolArray, Float64Array
from skinrig.benchmarks.resampling import mean_error
from skinrig.benchmarks.results import Timing
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.rendering.geometry import FittedSurface
from skinrig.rendering.lights import Light
from skinrig.rendering.render import render_surface
from skinrig.rendering.transport import SkinExchange
from skinrig.rendering.truth import build_true_light, build_true_model

VIEW_NAME: Final = "C07"
SEED_BY_PRESET: Final[Mapping[str, int]] = {"I": 11, "II": 12, "III": 13, "VI": 14}
"""Seed by preset."""
LIGHT_WAYS: Final[Mapping[str, tuple[float, float, float]]] = {
    "front": (0.0, 0.0, 1.0),
    "side": (0.93, 0.0, 0.36),
    "below": (0.1, -0.9, 0.42),
}
"""Directions of the lights: from the front, and two at which concave parts light each other."""
PATH_SAMPLES: Final = (4, 16, 64, 256)
EXPOSURE_PERCENTILE: Final = 95.0
"""Percentile of the luminance that is shown at `EXPOSED_LUMINANCE` for color differences."""
EXPOSED_LUMINANCE: Final = 0.6
REFERENCE_RUNS: Final = 4


@dataclass(frozen=True, slots=True, eq=False)
class TransportCase:
    """One person under one light.

    Attributes
    ----------
    name
        Preset and light.
    surface, caster
        True model and its rays.
    light
        The lamp.
    reference, reference_stderr
        Image with all reflections, and its standard error, (H, W, 3).
    simulated
        Simulated image with the simulator's interreflection, (H, W, 3).
    skin
        Evaluated pixels, (H, W).
    """

    name: str
    surface: FittedSurface
    caster: Caster
    camera: CameraPose
    light: Light
    reference: Float64Array
    reference_stderr: Float64Array
    simulated: Float64Array
    skin: BoolArray

    def render(self, exchange: SkinExchange | None) -> Float64Array:
        """Render without or with light that skin reflects onto skin."""
        made = render_surface(
            self.surface,
            self.camera,
            self.light,
            subsurface="local",
            caster=self.caster,
            exchange=exchange,
        )
        return made.radiance.astype(np.float64)

    def relative_rms(self, image: Float64Array, reference: Float64Array) -> float:
        """Return the root mean square error over the mean, %."""
        true = reference[self.skin]
        return float(100.0 * np.sqrt(np.mean((image[self.skin] - true) ** 2)) / true.mean())

    def delta_e(self, image: Float64Array, reference: Float64Array) -> float:
        """Return the mean CIEDE2000 of camera RGB taken as linear sRGB, at one exposure."""
        level = np.percentile(reference[self.skin].mean(axis=-1), EXPOSURE_PERCENTILE)
        labs = [
            rgb2lab(_encode(EXPOSED_LUMINANCE / level * one[self.skin]))
            for one in (image, reference)
        ]
        return float(np.mean(deltaE_ciede2000(*labs)))


def _encode(linear: Float64Array) -> Float64Array:
    """Return sRGB codes, 0 to 1, of linear values."""
    light = np.clip(linear, 0.0, 1.0)
    low = 12.92 * light
    return np.where(light <= 0.0031308, low, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)


def build_cases(
    people: Sequence[str], lights: Sequence[str], *, width_px: int, texels: int, samples: int
) -> list[TransportCase]:
    """Render the references of people under lights.

    Parameters
    ----------
    people, lights
        Keys of `SEED_BY_PRESET` and of `LIGHT_WAYS`.
    width_px, texels
        Width of the images, and side of the maps.
    samples
        Samples per pixel of each of the reference's runs.
    """
    rig = point_light_rig(load_rig("dome").resized(width_px).subset(views=[VIEW_NAME]))
    place = np.array([light.position_mm for light in rig.lights])
    unit = place / np.linalg.norm(place, axis=1, keepdims=True)
    cases = []
    for preset in people:
        face = make_subject(preset, seed=SEED_BY_PRESET[preset], size=texels)
        direct, full = (
            DomeScene(
                rig, face, effects=SceneEffects(lateral=False, interreflections=with_exchange)
            )
            for with_exchange in (False, True)
        )
        surface = FittedSurface.of(build_true_model(direct, VIEW_NAME), face.mesh)
        caster = Caster(face.mesh)
        for name in lights:
            index = int(np.argmax(unit @ np.array(LIGHT_WAYS[name])))
            light = dataclasses.replace(build_true_light(direct, index, VIEW_NAME), exponent=0.0)
            shot = {"samples": samples, "runs": REFERENCE_RUNS}
            direct_runs = render_transport(direct, rig.views[0], index, depth=DIRECT_DEPTH, **shot)
            beyond = render_transport(direct, rig.views[0], index, depth=GLOBAL_DEPTH, **shot)
            beyond -= direct_runs
            once = direct_runs.mean(axis=0)
            error = beyond.std(axis=0, ddof=1) / np.sqrt(REFERENCE_RUNS)
            camera = CameraPose.nominal(rig.views[0])
            made = render_surface(surface, camera, light, subsurface="local", caster=caster)
            skin = made.covered & (once.mean(axis=-1) > 0.0)
            # both are of one light: the factor between their units is that of direct light
            factor = made.radiance[skin].sum(dtype=np.float64) / once[skin].sum()
            exchange = full.radiance(VIEW_NAME, [index])[0].astype(np.float64)
            exchange -= direct.radiance(VIEW_NAME, [index])[0]
            cases.append(
                TransportCase(
                    f"{preset}, {name}",
                    surface,
                    caster,
                    camera,
                    light,
                    made.radiance + factor * beyond.mean(axis=0),
                    factor * error,
                    made.radiance + exchange,
                    skin,
                )
            )
    return cases


def measure_transport(stage: BenchmarkStage) -> None:
    """Measure errors of direct light and of paths, over people, lights and samples."""
    people = ("I",) if stage.toy else tuple(SEED_BY_PRESET)
    lights = tuple(LIGHT_WAYS)[:2] if stage.toy else tuple(LIGHT_WAYS)
    size = {"width_px": 40, "texels": 64, "samples": 64}
    if not stage.toy:
        size = {"width_px": 64, "texels": 128, "samples": 64}
    cases = build_cases(people, lights, **size)

    def errors(images: Sequence[Float64Array]) -> tuple[list[float], list[float]]:
        pairs = list(zip(cases, images, strict=True))
        return [c.relative_rms(i, c.reference) for c, i in pairs], [
            c.delta_e(i, c.reference) for c, i in pairs
        ]

    def report(transport: str, samples: int, timing: Timing, images: list[Float64Array]) -> None:
        rms, delta = errors(images)
        simulated = [c.relative_rms(i, c.simulated) for c, i in zip(cases, images, strict=True)]
        extra = {
            "Delta E": float(np.mean(delta)),
            "Delta E, standard error": float(np.std(delta) / np.sqrt(len(delta))),
            "rms against the simulator, %": float(np.mean(simulated)),
        }
        stage.add({"transport": transport, "samples": samples}, timing, mean_error(rms), extra)

    timing, images = stage.time(lambda: [c.render(None) for c in cases], repeats=1, memory=None)
    report("direct", 0, timing, images)
    direct_rms, direct_delta = errors(images)
    for samples in PATH_SAMPLES[:3] if stage.toy else PATH_SAMPLES:

        def render_paths(samples: int = samples) -> list[Float64Array]:
            return [c.render(SkinExchange.of(c.surface, c.caster, samples=samples)) for c in cases]

        timing, images = stage.time(render_paths, repeats=1, memory=None)
        report("path", samples, timing, images)
        if samples == PATH_SAMPLES[2] or stage.toy:
            rms, delta = errors(images)
            stage.limits["rms"] = float(np.mean(rms) / np.mean(direct_rms))
            stage.limits["delta"] = float(np.mean(delta) / np.mean(direct_delta))
    noise = [
        100.0
        * float(np.sqrt(np.mean(c.reference_stderr[c.skin] ** 2)))
        / c.reference[c.skin].mean()
        for c in cases
    ]
    stage.reference_error = float(np.mean(noise))
    stage.description_values |= {"people": len(people), "lights": len(lights)}
