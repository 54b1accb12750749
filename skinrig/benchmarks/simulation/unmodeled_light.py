"""Benchmark of light that the simulator does not model: its size by other renders.

Highlights of skin on skin: Mitsuba's path tracer on the skin with and without its highlights, each
with seven more surfaces than direct light has. One lateral profile per face: the face's light with
the profile of its 5th and its 95th percentile of melanin and blood instead of its median.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from capture.rig import Rig, load_rig
from rigsim.light.lateral_scattering import LateralScattering
from rigsim.light.observed_skin import ObservedSkin
from rigsim.light.olat import Lamp
from rigsim.light.skin_material import describe_skin
from rigsim.mitsuba.led_array import led_table
from rigsim.mitsuba.rig_camera import describe_camera
from rigsim.mitsuba.scene_radiance import point_light_rig, radiance
from rigsim.needs.effects import PixelNoise
from rigsim.render import Caster
from rigsim.scenes.dome.reference import DirectScene, MattScene
from rigsim.sensor import make_sensor
from rigsim.subject import SimulatedSubject, make_subject
from rigsim.tissue.lateral_kernels import SIGMAS_MM, GaussianSum
from skinrig.arrays import BoolArray, Float64Array
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.results import ErrorEstimate, Timing
from skinrig.benchmarks.stage import BenchmarkStage

NO_MEMORY_REASON = "scenes of one face share its texture"
VIEW_NAME = "C02"
LIGHT_NUMBERS: Final = (45, 120)
MAX_SURFACES: Final = 8
"""Surfaces and light of the longest path; 2 is direct light."""
PROFILE_PERCENTILES: Final = (5.0, 95.0)


@dataclass(frozen=True, slots=True, eq=False)
class PercentileSkin(ObservedSkin):
    """Skin whose lateral profile is that of a percentile of melanin and of blood."""

    percentile: float

    def lateral_kernels(self) -> GaussianSum:
        """Return the lateral profile at the percentile, per channel."""
        melanin, blood = (
            float(np.percentile(part, self.percentile)) for part in self.covered_chromophores()
        )
        return self.table.lateral_kernels(melanin, blood, self.band_weights()).gaussians(SIGMAS_MM)


def measure_unmodeled_light(stage: BenchmarkStage) -> None:
    """Measure light that scenes of the dome omit, over the noise of a pixel at full exposure."""
    width, texels, runs = (32, 128, 3) if stage.toy else (64, 512, 8)
    rig = point_light_rig(load_rig("dome").resized(width).subset(views=[VIEW_NAME]))
    for preset in ("III",) if stage.toy else ("palest", "III", "darkest"):
        face = make_subject(preset, seed=0, size=texels)
        for light in LIGHT_NUMBERS:
            _add_highlights(stage, rig, preset, face, light, runs)
            for percentile in PROFILE_PERCENTILES:
                _add_profile(stage, rig, preset, face, light, percentile)


def _add_highlights(
    stage: BenchmarkStage, rig: Rig, preset: str, face: SimulatedSubject, light: int, runs: int
) -> None:
    """Add light that reaches skin by way of a highlight, or leaves it by one."""

    def bounced(scene: DirectScene) -> tuple[Float64Array, Float64Array]:
        deep, direct = (
            _path_images(scene, light, surfaces, runs) for surfaces in (MAX_SURFACES, 2)
        )
        return deep - direct, direct.mean(axis=0)

    def both() -> tuple[Float64Array, Float64Array]:
        shiny, direct = bounced(DirectScene(rig, face))
        return shiny - bounced(MattScene(rig, face))[0], direct

    seconds, (added, direct) = measure_processor_time(both)
    sigma = _noise(rig).sigma(direct / direct.max()) * direct.max()
    lit = direct.max(axis=-1) > 0.0
    by_run = added.sum(axis=(1, 2, 3)) / direct.sum()
    mean, variance = (added / sigma).mean(axis=0)[lit], (added / sigma).var(axis=0, ddof=1)[lit]
    variance /= runs
    square = float(np.square(mean).mean() - variance.mean())
    half = float(np.sqrt(4.0 * (np.square(mean) * variance).mean() / mean.size))
    rms = math.sqrt(max(square, 0.0))
    stage.add(
        {"effect": "highlights of skin on skin", "subject": preset, "light": light},
        Timing.single(seconds, no_memory_reason=NO_MEMORY_REASON),
        ErrorEstimate.nonnegative(rms, half / max(2.0 * rms, 1e-12)),
        {
            "of the direct light, %": round(100.0 * float(by_run.mean()), 3),
            "standard error, %": round(100.0 * float(by_run.std(ddof=1) / math.sqrt(runs)), 3),
        },
    )


def _path_images(scene: DirectScene, light: int, surfaces: int, runs: int) -> Float64Array:
    """Return Mitsuba's images of paths with a number of surfaces, shape (runs, H, W, 3)."""
    view = scene.rig.views[0]
    place = np.array(scene.rig.lights[light].position_mm)
    description: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": surfaces, "rr_depth": surfaces + 1},
        "sensor": describe_camera(view),
        "skin": {
            "type": "mesh",
            "mesh": scene.subject.mesh,
            "bsdf": describe_skin(scene.texture(view)),
        },
        "led": {"type": "ledarray", "table": led_table(place, -place / np.linalg.norm(place))},
    }
    images = [radiance(description, kind="rgb", samples=256, seed=k)[..., :3] for k in range(runs)]
    return np.stack(images).astype(np.float64)


def _add_profile(
    stage: BenchmarkStage,
    rig: Rig,
    preset: str,
    face: SimulatedSubject,
    light: int,
    percentile: float,
) -> None:
    """Add the change of subsurface light on the texture by another lateral profile."""
    scene, view = DirectScene(rig, face), rig.views[0]
    place = np.array(rig.lights[light].position_mm)
    lamp = Lamp(place, -place / np.linalg.norm(place), 0.0, 0.0)
    names = "neutral", view.spectral_sensitivity, rig.lights[light].illuminant
    seconds, usual = measure_processor_time(partial(_glow, scene, ObservedSkin(face, *names), lamp))
    changed = _glow(scene, PercentileSkin(face, *names, percentile), lamp)
    covered: BoolArray = face.atlas.covered & (usual.max(axis=-1) > 0.0)
    level = usual[covered] / usual[covered].max()
    over_noise = (changed - usual)[covered] / usual[covered].max() / _noise(rig).sigma(level)
    rms = float(np.sqrt(np.square(over_noise).mean()))
    stage.add(
        {"effect": f"profile of percentile {percentile:g}", "subject": preset, "light": light},
        Timing.single(seconds, no_memory_reason=NO_MEMORY_REASON),
        ErrorEstimate.symmetric(rms, 0.0),
        {"largest change over noise": round(float(np.abs(over_noise).max()), 2)},
    )


def _glow(scene: DirectScene, skin: ObservedSkin, lamp: Lamp) -> Float64Array:
    surface = scene.surface(scene.rig.views[0])
    scattering = LateralScattering(skin, surface, Caster(skin.subject.mesh), True, None, None)
    return scattering.glow(lamp).astype(np.float64)


def _noise(rig: Rig) -> PixelNoise:
    return PixelNoise.of(make_sensor(rig.views[0]))
