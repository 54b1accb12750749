"""Benchmarks of the rigs' renderers against Mitsuba's own integrators and polarizers."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import numpy as np
from scipy.ndimage import binary_erosion

from capture.rig import load_rig
from rigsim.as_built.sphere import PATTERN_WEIGHTS, build_sphere
from rigsim.mitsuba.scene_radiance import point_light_rig
from rigsim.mitsuba.variant import Renderer, choose_renderer, choose_variant
from rigsim.needs.effects import SceneEffects
from rigsim.scenes.dome import reference as dome_scenes
from rigsim.scenes.flash import polarizer_reference as flash_scenes
from rigsim.scenes.flash.scene import FlashScene
from rigsim.scenes.gradient import reference as gradient_scenes
from rigsim.scenes.gradient.reference import NEUTRAL_GRIP
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.skin_patch.microrelief import MicroSkin, make_micro_skin
from rigsim.subject import make_subject
from skinrig.arrays import Float32Array, Float64Array, Int64Array
from skinrig.benchmarks import resident_memory
from skinrig.benchmarks.measurement import measure_processor_seconds, measure_processor_time
from skinrig.benchmarks.resampling import bootstrap_interval, bootstrap_tiled_rms
from skinrig.benchmarks.results import ErrorEstimate, Knobs, Timing
from skinrig.benchmarks.stage import BenchmarkStage

TEXELS, TOY_TEXELS = 512, 128
"""Texels along each side of a face's maps."""
NO_MEMORY_REASON = "the methods run in turn in one process, which keeps all their scenes"


def measure_dome(stage: BenchmarkStage) -> None:
    """Measure one view of the dome, one light at a time (OLAT), by several methods.

    The full size is that of the rig's cameras. Mitsuba uses stratified samples, which are as
    uniform as our regular rays; with its default, independent samples it is twice as noisy.
    Seconds are processor time.
    """
    width, lights = (64, 2) if stage.toy else (1300, 4)
    efforts = (1, 2) if stage.toy else (1, 3, 2)
    fine = 4 if stage.toy else 6
    texels = TOY_TEXELS if stage.toy else TEXELS
    found: dict[dome_scenes.Method, dome_scenes.RenderTiming] = {}
    for subpixels in efforts:
        found = dome_scenes.compare_integrators(
            width_px=width,
            lights=1 if subpixels != efforts[-1] else lights,
            subpixels=subpixels,
            reference_subpixels=fine,
            rounds=2 if subpixels == efforts[-1] and not stage.toy else 1,
            texels=texels,
        )
        for name, way in found.items():
            timing = Timing.single(way.seconds, no_memory_reason=NO_MEMORY_REASON)
            stage.add({"way": name, "rays": subpixels**2}, timing, _method_error(way))
    stage.measure_bands(lambda band: _on_skin(band.preset, 64 if stage.toy else 650, fine))
    ours = found["olat"]
    stage.limits["over_fast"] = ours.cost_over(found["fast"])
    stage.limits["over_path"] = found["path"].cost_over(ours)
    stage.limits["over_direct"] = found["direct"].cost_over(ours)
    effort = {"runs": 4, "samples": 64, "subpixels": 8} if stage.toy else {}
    agreement = dome_scenes.measure_agreement_with_path(texels=texels, **effort)
    stage.limits["agreement"] = 100.0 * agreement
    finest = stage.find_point(way="olat", rays=max(efforts) ** 2)
    stage.reference_error = finest.error * max(efforts) / fine
    stage.description_values["rays"] = fine**2


def _method_error(method: dome_scenes.RenderTiming) -> ErrorEstimate:
    """Return the error of a method in percent, with its interval over tiles."""
    error, tiles = 100.0 * method.error, method.squared_by_tile
    low, high = error * np.array(
        bootstrap_interval(tiles, lambda again, axis: np.sqrt(again.mean(axis=axis) / tiles.mean()))
    )
    return ErrorEstimate(error, (min(float(low), error), max(float(high), error)))


def _on_skin(preset: str, width: int, fine: int) -> ErrorEstimate:
    """Return our error with 4 rays per pixel on a face of a preset's melanin, one light, %."""
    rig = point_light_rig(load_rig("dome").resized(width).subset(views=["C02"]))
    face = dome_scenes.plain_face(preset, size=TOY_TEXELS if width < 128 else TEXELS)
    light = len(rig.lights) // 2
    found, true = (
        dome_scenes.PlainScene(rig, face, subpixels=n).radiance("C02", [light])[0]
        for n in (2, fine)
    )
    shown = true.mean(axis=-1) > 0.0
    return bootstrap_tiled_rms((found - true) * (100.0 / float(true[shown].mean())), shown)


REFERENCE_RAYS = 144
DIRECT_LIGHT = SceneEffects(lateral=False, interreflections=False)
"""Light between points of the skin is left out: both renderers take it from the same textures."""
WAY_NAMES: Mapping[Renderer, str] = {"mitsuba": "olat", "fast": "fast"}
"""Name of a point's way for each renderer of faces."""


def measure_flash(stage: BenchmarkStage) -> None:
    """Measure both polarization images by `olat` and by `volpath` through Mitsuba's polarizers.

    The images of a face are also rendered by the fast way of machines without LLVM.
    """
    efforts = ((1, 2), (2, 4)) if stage.toy else ((1, 4), (2, 16), (3, 64))
    width = 48 if stage.toy else 256
    rig, view = flash_scenes.reference_rig(width)
    sphere = flash_scenes.plastic_sphere(rig)
    truth = flash_scenes.render_by_olat(sphere, view, subpixels=round(REFERENCE_RAYS**0.5))
    worse = partial(_larger_error, truth=truth)
    for subpixels, _ in efforts:
        stage.measure(
            {"scene": "sphere", "way": "olat", "subpixels": subpixels},
            lambda: flash_scenes.render_by_olat(sphere, view, subpixels=subpixels),
            worse,
            repeats=3,
            memory=None,
        )
    stage.reference_error = stage.points[-1].error * efforts[-1][0] / REFERENCE_RAYS**0.5
    for _, samples in efforts:
        image = partial(flash_scenes.render_polarized_with_mitsuba, rig, view, samples=samples)
        stage.measure(
            {"scene": "sphere", "way": "volpath", "samples": samples},
            lambda: {
                name: image(name, seed=k) for k, name in enumerate(flash_scenes.ANALYZER_AXIS_DEG)
            },
            worse,
            repeats=3,
            memory=None,
        )
    _add_face_curves(stage)
    over_fast, difference = _olat_over_fast(stage)
    stage.limits = {"difference": difference}
    if not stage.toy:
        final = flash_scenes.compare_polarizer_models(
            width_px=width, samples=efforts[-1][1], subpixels=1
        )
        stage.limits |= {"speed_up": final.speed_up, "noise": final.noise_ratio}
        stage.limits["over_fast"] = over_fast


def _add_face_curves(stage: BenchmarkStage) -> None:
    """Add both images of a face by `olat` and by the renderer without LLVM, green channel.

    The reference is `olat` with more rays, so that errors of the fast way include its shadows,
    which have the resolution of the face's texture.
    """
    rig = load_rig("flash").resized(64 if stage.toy else 256)
    face = make_subject("III", size=TOY_TEXELS if stage.toy else TEXELS)
    kept = []  # scenes of a way share the light on the surface, as long as one lives

    def render(way: Renderer, subpixels: int) -> tuple[float, dict[str, Float32Array]]:
        scene = FlashScene(
            rig, face, effects=DIRECT_LIGHT, choice=choose_renderer(way), subpixels=subpixels
        )
        kept.append(scene)
        seconds, images = measure_processor_time(
            lambda: {name: scene.radiance(name)[..., 1] for name in flash_scenes.ANALYZER_AXIS_DEG}
        )
        return seconds, images

    _, truth = render("mitsuba", 4 if stage.toy else 8)
    for way, name in WAY_NAMES.items():
        render(way, 1)  # compiles the kernels
        for subpixels in (1, 2) if stage.toy else (1, 2, 3, 4):
            runs = [render(way, subpixels) for _ in range(1 if stage.toy else 3)]
            timing = Timing.single(
                min(seconds for seconds, _ in runs), no_memory_reason=NO_MEMORY_REASON
            )
            knobs: Knobs = {"scene": "face", "way": name, "subpixels": subpixels}
            stage.add(knobs, timing, _larger_error(runs[0][1], truth))


def _olat_over_fast(stage: BenchmarkStage) -> tuple[float, float]:
    """Compare both renderers of the flash rig: processor time, and relative difference of means."""
    rig = load_rig("flash").resized(64 if stage.toy else 384)
    face = make_subject("III", size=TOY_TEXELS if stage.toy else TEXELS)
    scalar = choose_variant("rgb", environment={"SKINRIG_MITSUBA": "scalar"})
    ways = {"olat": choose_variant("rgb"), "fast": scalar}
    spent: dict[str, list[float]] = {way: [] for way in ways}
    mean: dict[str, float] = {}
    scenes = []  # those of a way share the light on the surface, as long as one lives
    for _ in range(2 if stage.toy else 6):  # the first compiles
        for way, choice in ways.items():
            scene = FlashScene(rig, face, effects=DIRECT_LIGHT, choice=choice)
            scenes.append(scene)
            seconds, images = measure_processor_time(
                lambda: [scene.radiance(name) for name in flash_scenes.ANALYZER_AXIS_DEG]
            )
            spent[way].append(seconds)
            mean[way] = float(np.mean(images))
    ratio = float(np.median(spent["olat"][1:]) / np.median(spent["fast"][1:]))
    return ratio, abs(mean["olat"] / mean["fast"] - 1.0)


def _larger_error(found: dict[str, Float32Array], truth: dict[str, Float32Array]) -> ErrorEstimate:
    """Return the larger of both images' relative errors, %, in pixels inside the sphere."""
    errors = []
    for name, true in truth.items():
        whole = binary_erosion(true > 0.0, iterations=2)
        difference = (found[name].astype(np.float64) - true) * 100.0 / true[whole].mean()
        errors.append(bootstrap_tiled_rms(difference, whole, tile_px=8))
    return max(errors, key=lambda one: one.error)


N_LIT_CONDITIONS = 14
"""Conditions that Mitsuba's path tracer renders; two of the 16 are dark."""

BEST_KNOBS: Knobs = {"way": "fast", "subpixels": 2, "sectors": 32, "table": 65}


def measure_gradient(stage: BenchmarkStage) -> None:
    """Measure renderings of one state of skin under all conditions, by three methods.

    The reference of all is the sum over all LEDs with a shadow ray to each. Seconds are processor
    time. Ours include one state, and the fast renderer's table, which serves all of a session.
    """
    width = 48 if stage.toy else 256
    skin = gradient_scenes.plain_skin(width * 0.006 + 0.9)
    rng = np.random.default_rng(0)
    pixels = np.sort(rng.choice(width * width, 200 if stage.toy else 1500, replace=False))
    plain = gradient_scenes.plain_scene(skin, width_px=width)
    reference, _ = gradient_scenes.trace_pixels(plain, pixels, subpixels=2 if stage.toy else 4)
    best, without = _by_moments(stage, skin, width, pixels, reference)
    traced = _by_olat(stage, skin, width, pixels, reference)
    for samples in (4,) if stage.toy else (16, 64):
        ways = []
        for number, pattern in enumerate(("full", "x")):
            with resident_memory.track_peak() as rise:
                image, seconds = gradient_scenes.render_pattern(
                    plain, pattern, samples=samples, seed=number
                )
            expected = reference @ np.array(PATTERN_WEIGHTS[pattern])
            ways.append(
                gradient_scenes.compare_with_reference(
                    image.reshape(-1)[pixels].astype(np.float64), expected, seconds
                )
            )
        error = math.sqrt(sum(way.error**2 for way in ways) / 2.0)
        seconds = N_LIT_CONDITIONS * sum(way.seconds for way in ways) / 2.0
        knobs: Knobs = {"way": "path", "samples": samples}
        _add(stage, knobs, seconds, error, rise.mb, len(pixels))
    # the error of independent samples falls with 1 / sqrt(seconds)
    at_equal_error = seconds * (error / best.error) ** 2
    off = max(abs(way.mean_ratio - 1.0) / way.mean_ratio_stderr for way in ways)
    stage.limits = {
        ("speed_up", samples): at_equal_error / best.seconds,
        "error": 100.0 * best.error,
        "traced_error": 100.0 * traced.error,
        "mean": off,
        "shadows": without.error / best.error,
        "traced_seconds": _condition_seconds("mitsuba", width),
        "fast_seconds": _condition_seconds("fast", width),
    }


def _by_olat(
    stage: BenchmarkStage, skin: MicroSkin, width: int, pixels: Int64Array, reference: Float64Array
) -> gradient_scenes.ReferenceComparison:
    """Add the integrator's settings with a shadow ray per sample and LED; return 2 x 2 samples."""
    plain = partial(gradient_scenes.plain_scene, skin, width_px=width, renderer="mitsuba")
    gradient_scenes.scene_pixels(plain(subpixels=1), pixels)  # compiles the kernels
    for subpixels in (1, 2) if stage.toy else (1, 3, 2):
        scene = plain(subpixels=subpixels)
        with resident_memory.track_peak() as rise:
            spent_s, found = measure_processor_time(
                partial(gradient_scenes.scene_pixels, scene, pixels)
            )
        way = gradient_scenes.compare_with_reference(found, reference, spent_s)
        knobs: Knobs = {"way": scene.variant.renderer, "subpixels": subpixels}
        _add(stage, knobs, spent_s, way.error, rise.mb, len(pixels))
    return way


def _condition_seconds(renderer: Renderer, width: int) -> float:
    """Return the least processor seconds of a session's 16 conditions of one state."""
    rig = load_rig("gradient").cropped(width)
    skin = make_micro_skin("forehead", size_mm=width * 0.006 + 0.9)

    def render() -> None:
        scene = GradientScene(
            rig, skin, sphere=build_sphere(rig, seed=0), choice=choose_renderer(renderer)
        )
        for pattern in PATTERN_WEIGHTS:
            for analyzer_deg in (0.0, 90.0):
                scene.radiance(pattern, grip=NEUTRAL_GRIP, analyzer_deg=analyzer_deg)

    return measure_processor_seconds(render, 2)


def _by_moments(
    stage: BenchmarkStage, skin: MicroSkin, width: int, pixels: Int64Array, reference: Float64Array
) -> tuple[gradient_scenes.ReferenceComparison, gradient_scenes.ReferenceComparison]:
    """Add our settings; return the best one, and the default one without shadows."""
    gradient_scenes.scene_pixels(
        gradient_scenes.plain_scene(skin, width_px=width, table_size=17), pixels
    )  # compiles the kernels
    settings = [(1, 16, 33), (1, 32, 65), (2, 32, 65)]
    if not stage.toy:
        settings += [(1, 32, 129), (2, 16, 65), (2, 64, 65), (3, 32, 65)]
    for subpixels, sectors, table in settings:
        scene = gradient_scenes.plain_scene(
            skin, width_px=width, subpixels=subpixels, sectors=sectors, table_size=table
        )
        with resident_memory.track_peak() as rise:
            spent_s, (_, found) = measure_processor_time(
                lambda: (scene.lighting(), gradient_scenes.scene_pixels(scene, pixels))
            )
        knobs: Knobs = {"way": "fast", "subpixels": subpixels}
        knobs |= {"sectors": sectors, "table": table}
        way = gradient_scenes.compare_with_reference(found, reference, spent_s)
        _add(stage, knobs, spent_s, way.error, rise.mb, len(pixels))
        if knobs == BEST_KNOBS:
            best = way
    bare = gradient_scenes.scene_pixels(
        gradient_scenes.plain_scene(skin, width_px=width, shadows=False), pixels
    )
    return best, gradient_scenes.compare_with_reference(bare, reference, 0)


def _add(
    stage: BenchmarkStage, knobs: Knobs, seconds: float, error: float, mb: float | None, pixels: int
) -> None:
    timing = Timing.single(seconds, mb, memory_kind="resident")
    outcome = ErrorEstimate.symmetric(100.0 * error, 100.0 * error / math.sqrt(2.0 * pixels))
    stage.add(knobs, timing, outcome)
