"""Benchmark of light that the simulator does not model: its size by other renders.

Highlights of skin on skin: Mitsuba's path tracer on the skin with and without its highlights, each
with seven more surfaces than direct light has. One lateral profile per face: the face's light with
the profile of its 5th and its 95th percentile of melanin and blood instead of its median. Polarized
single scattering: light of one collision in voxels of flat layers, which may stay polarized.
Boundary roughness: light through a rough boundary over that through a smooth one. Lens blur on
boards and balls: the dome's targets before and after a perfect lens.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from scipy.ndimage import center_of_mass

from capture.calibration.geometry.board import Board, find_board
from capture.rig import Rig, load_rig
from rigsim.as_built.dome import build_dome
from rigsim.light.lateral_scattering import LateralScattering
from rigsim.light.observed_skin import ObservedSkin
from rigsim.light.olat import Lamp
from rigsim.light.skin_material import describe_skin
from rigsim.mitsuba.led_array import led_table
from rigsim.mitsuba.rig_camera import describe_camera
from rigsim.mitsuba.scene_radiance import look_at, point_light_rig, radiance
from rigsim.needs.effects import PixelNoise
from rigsim.render import Caster
from rigsim.render.lens_blur import blur_images, focused_lens
from rigsim.scenes.dome.reference import DirectScene, MattScene
from rigsim.scenes.dome.targets import TargetScene
from rigsim.scenes.reference.flat_layers import (
    describe_boundary,
    describe_flat_layers,
    render_voxels,
)
from rigsim.sensor import make_sensor
from rigsim.subject import SimulatedSubject, make_subject
from rigsim.subject.person_skin import PersonSkin
from rigsim.tissue.lateral_kernels import SIGMAS_MM, GaussianSum
from rigsim.tissue.skin_layers import ETA, skin_layer_stack
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
SCATTERING_NM: Final = (450.0, 540.0, 630.0)
SCATTERING_LIGHT_DEG: Final = 45.0
"""Zenith angle of the light on flat layers."""
ONE_COLLISION: Final = 2
"""Events of the integrator `tissue` on a path with one collision: it enters, and scatters."""
BOUNDARY_DEG: Final = (45.0, 60.0, 70.0)
BOUNDARY_ALPHA: Final = 0.3
"""Beckmann roughness of skin."""
FAR_MM: Final = 1e3
TARGET_VIEW: Final = "C00"
FRONT_LIGHT: Final = 24
"""An LED that the ball in front of `TARGET_VIEW` mirrors."""
MIN_LIT_LEVEL: Final = 0.02
"""Least light of a pixel that counts, of the brightest."""
WHITE_DN: Final = 50_000.0
DOME_BOARD: Final = Board.of(("charuco", 7, 5, "4X4_50"), square_mm=36.0)
"""The dome's board."""


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
    for preset in ("III",) if stage.toy else ("I", "III", "VI"):
        for wavelength_nm in SCATTERING_NM[1:2] if stage.toy else SCATTERING_NM:
            _add_single_scattering(stage, preset, wavelength_nm, 64 if stage.toy else 1024)
    for light_deg in BOUNDARY_DEG:
        _add_roughness(stage, light_deg, 256 if stage.toy else 4096)
    for kind in ("charuco", "mirror"):
        _add_lens_blur(stage, kind, 324 if stage.toy else None)


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


def _add_single_scattering(
    stage: BenchmarkStage, preset: str, wavelength_nm: float, samples: int
) -> None:
    """Add the light below the surface that had one collision: the crossed image may lack it."""
    skin = PersonSkin.of_preset(preset).at("cheek")
    layers = skin_layer_stack(wavelength_nm, skin.c_m, skin.c_hd, skin.tissue)

    def light(max_depth: int) -> Float64Array:
        scene = describe_flat_layers(layers, light_deg=SCATTERING_LIGHT_DEG)
        scene["integrator"]["max_depth"] = max_depth
        return render_voxels(scene, samples=samples, seed=1)[..., 1].ravel()

    seconds, (once, all_light) = measure_processor_time(lambda: (light(ONE_COLLISION), light(-1)))
    part = float(once.mean() / all_light.mean())
    spread = part * float(all_light.std(ddof=1) / all_light.mean() / math.sqrt(all_light.size))
    noise = PixelNoise.of(make_sensor(load_rig("flash").views[0]))
    stage.add(
        {"effect": "polarized single scattering", "subject": preset, "nm": wavelength_nm},
        Timing.single(seconds, no_memory_reason=NO_MEMORY_REASON),
        ErrorEstimate.symmetric(noise.change_over_noise(part), noise.change_over_noise(spread)),
        {"of the light from below the surface, %": round(100.0 * part, 2)},
    )


def _add_roughness(stage: BenchmarkStage, light_deg: float, samples: int) -> None:
    """Add the change of light that enters by the boundary's roughness, without lost light."""
    seconds, found = measure_processor_time(
        lambda: [_pass_boundary(alpha, light_deg, samples) for alpha in (0.0, BOUNDARY_ALPHA)]
    )
    (smooth, reflected), (rough, scattered) = found
    entered = float(1.0 - reflected)
    ratio = entered * rough / smooth
    # facets lose light that meets several of them: shared by both parts
    change = ratio / (ratio + scattered) / entered - 1.0
    noise = PixelNoise.of(make_sensor(load_rig("dome").views[0]))
    cosine = math.cos(math.radians(light_deg))
    stage.add(
        {"effect": "boundary roughness", "light, degrees": light_deg},
        Timing.single(seconds, no_memory_reason=NO_MEMORY_REASON),
        ErrorEstimate.symmetric(abs(noise.change_over_noise(change, cosine)), 0.0),
        {
            "of the light that enters, %": round(100.0 * change, 2),
            "lost by facets, %": round(100.0 * (1.0 - ratio - scattered), 2),
        },
    )


def _pass_boundary(alpha: float, deg: float, samples: int) -> tuple[float, float]:
    """Return light from below and from above that a camera receives by way of a boundary."""
    angle = math.radians(deg)
    eye = (FAR_MM * math.sin(angle) * 0.1, 0.0, FAR_MM * math.cos(angle) * 0.1)
    floor = np.diag([FAR_MM, FAR_MM, 1.0, 1.0])
    floor[2, 3] = -1.0
    lights: dict[str, Any] = {
        "below": {
            "type": "rectangle",
            "to_world": floor,
            "emitter": {"type": "area", "radiance": 1.0},
        },
        "above": {"type": "constant"},
    }
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "skin": {
            "type": "rectangle",
            "to_world": np.diag([FAR_MM, FAR_MM, 1.0, 1.0]),
            "bsdf": describe_boundary(ETA, alpha),
        },
        "sensor": {
            "type": "orthographic",
            "to_world": look_at(eye, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
            "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        },
    }
    below, above = (
        float(radiance(scene | {name: lamp}, kind="rgb", samples=samples, seed=1)[..., :3].mean())
        for name, lamp in lights.items()
    )
    return below, above


def _add_lens_blur(
    stage: BenchmarkStage, kind: Literal["charuco", "mirror"], width_px: int | None
) -> None:
    """Add the change of a target's image by the dome's lens, in focus."""
    nominal = load_rig("dome")
    rig = nominal if width_px is None else nominal.resized(width_px)
    dome = build_dome(rig.subset(views=[TARGET_VIEW]), seed=1)
    scene, view = TargetScene(kind, dome, seed=1), dome.rig.views[0]
    on_s = np.full(len(dome.rig.lights), 1e-3 if kind == "charuco" else 0.0)
    on_s[FRONT_LIGHT] = 1e-3

    def both() -> tuple[Float64Array, Float64Array]:
        sharp = np.moveaxis(scene.light(TARGET_VIEW, on_s), -1, 0).copy()
        lens = focused_lens(view, dome.rig.lights[0].illuminant)
        blurred = blur_images(sharp, lens, averaged=True)
        return sharp.astype(np.float64) / sharp.max(), blurred.astype(np.float64) / sharp.max()

    seconds, (sharp, blurred) = measure_processor_time(both)
    lit = sharp > MIN_LIT_LEVEL
    over_noise = ((blurred - sharp) / _noise(rig).sigma(sharp))[lit]
    stage.add(
        {"effect": "lens blur on a target", "subject": kind},
        Timing.single(seconds, no_memory_reason=NO_MEMORY_REASON),
        ErrorEstimate.symmetric(float(np.sqrt(np.square(over_noise).mean())), 0.0),
        {"shift of corners or highlights, pixels": round(_shift(kind, sharp, blurred), 4)},
    )


def _shift(kind: str, sharp: Float64Array, blurred: Float64Array) -> float:
    """Return the RMS shift of a board's corners, or that of the one highlight, pixels."""
    if kind == "mirror":
        before, after = (
            np.array(center_of_mass(np.where(part > MIN_LIT_LEVEL * part.max(), part, 0.0)))
            for part in (sharp.sum(axis=0), blurred.sum(axis=0))
        )
        return float(np.sqrt(np.square(after - before).mean()))
    levels = (WHITE_DN * np.clip(np.stack([sharp, blurred]), 0.0, 1.0)).astype(np.uint16)
    found = [find_board(np.moveaxis(part, 0, -1), DOME_BOARD) for part in levels]
    if found[0] is None or found[1] is None:
        return math.nan
    pixels = [dict(zip(one.ids.tolist(), one.pixels, strict=True)) for one in found if one]
    moved = [pixels[1][k] - pixels[0][k] for k in pixels[0].keys() & pixels[1].keys()]
    return float(np.sqrt(np.square(moved).mean()))
