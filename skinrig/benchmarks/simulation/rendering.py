"""Benchmarks of the rigs' renderers against Mitsuba's own integrators and polarizers."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from scipy.ndimage import binary_erosion

from capture.rig import load_rig
from rigsim.as_built.sphere import PATTERN_WEIGHTS
from rigsim.render import Caster
from rigsim.render.scene_radiance import point_light_rig
from rigsim.render.variant import choose_variant
from rigsim.scenes.dome import reference as dome_scenes
from rigsim.scenes.flash import polarizer_reference as flash_scenes
from rigsim.scenes.gradient import reference as gradient_scenes
from rigsim.skin_patch.microrelief import MicroSkin
from skinrig.arrays import Float32Array, Float64Array, Int64Array
from skinrig.benchmarks import resident_memory
from skinrig.benchmarks.measurement import measure_processor_time
from skinrig.benchmarks.resampling import bootstrap_interval, bootstrap_tiled_rms
from skinrig.benchmarks.results import ErrorEstimate, Knobs, Timing
from skinrig.benchmarks.stage import BenchmarkStage

NO_MEMORY_REASON = "three methods run in turn in one process, which keeps all their scenes"


def measure_dome(stage: BenchmarkStage) -> None:
    """Measure one view of the dome, one light at a time (OLAT), by three methods.

    The full size is that of the rig's cameras. Mitsuba uses stratified samples, which are as
    uniform as our regular rays; with its default, independent samples it is twice as noisy.
    """
    width, lights = (64, 2) if stage.toy else (1300, 4)
    efforts = (1, 2) if stage.toy else (1, 3, 2)
    fine = 4 if stage.toy else 6
    for subpixels in efforts:
        found = dome_scenes.compare_integrators(
            width_px=width,
            lights=1 if subpixels != efforts[-1] else lights,
            subpixels=subpixels,
            reference_subpixels=fine,
            rounds=2 if subpixels == efforts[-1] else 1,
        )
        for name in ("ours", "path", "direct"):
            way = getattr(found, name)
            timing = Timing.single(way.seconds, no_memory_reason=NO_MEMORY_REASON)
            stage.add({"way": name, "rays": subpixels**2}, timing, _method_error(way))
    stage.measure_bands(lambda band: _on_skin(band.preset, 64 if stage.toy else 650, fine))
    stage.limits["over_path"] = found.speed_up(found.path)
    stage.limits["over_direct"] = found.speed_up(found.direct)
    finest = stage.find_point(way="ours", rays=max(efforts) ** 2)
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
    face = dome_scenes.plain_face(preset, size=128 if width < 128 else 512)
    light = len(rig.lights) // 2
    found, true = (
        dome_scenes.PlainScene(rig, face, subpixels=n).radiance("C02", [light])[0]
        for n in (2, fine)
    )
    shown = true.mean(axis=-1) > 0.0
    return bootstrap_tiled_rms((found - true) * (100.0 / float(true[shown].mean())), shown)


REFERENCE_RAYS = 144


def measure_flash(stage: BenchmarkStage) -> None:
    """Measure both polarization images by closed forms and by Mitsuba's own polarizers."""
    efforts = ((1, 2), (2, 4)) if stage.toy else ((1, 4), (2, 16), (3, 64))
    width = 48 if stage.toy else 256
    rig, view = flash_scenes.reference_rig(width)
    caster = Caster(flash_scenes.sphere_mesh(), choice=choose_variant("mono_polarized"))
    truth = flash_scenes.render_closed_forms(
        rig, view, caster, subpixels=round(REFERENCE_RAYS**0.5)
    )
    worse = partial(_larger_error, truth=truth)
    for subpixels, _ in efforts:
        stage.measure(
            {"way": "closed form", "subpixels": subpixels},
            lambda: flash_scenes.render_closed_forms(rig, view, caster, subpixels=subpixels),
            worse,
            repeats=3,
            memory=None,
        )
    stage.reference_error = stage.points[-1].error * efforts[-1][0] / REFERENCE_RAYS**0.5
    for _, samples in efforts:
        image = partial(flash_scenes.render_polarized_with_mitsuba, rig, view, samples=samples)
        stage.measure(
            {"way": "mitsuba", "samples": samples},
            lambda: {
                name: image(name, seed=k) for k, name in enumerate(flash_scenes.ANALYZER_AXIS_DEG)
            },
            worse,
            repeats=3,
            memory=None,
        )
    if not stage.toy:
        final = flash_scenes.compare_polarizer_models(
            width_px=width, samples=efforts[-1][1], subpixels=1
        )
        stage.limits = {"speed_up": final.speed_up, "noise": final.noise_ratio}


def _larger_error(found: dict[str, Float32Array], truth: dict[str, Float32Array]) -> ErrorEstimate:
    """Return the larger of both images' relative errors, %, in pixels inside the sphere."""
    errors = []
    for name, true in truth.items():
        whole = binary_erosion(true > 0.0, iterations=2)
        difference = (found[name].astype(np.float64) - true) * 100.0 / true[whole].mean()
        errors.append(bootstrap_tiled_rms(difference, whole, tile_px=8))
    return max(errors, key=lambda one: one.error)


N_LIT_CONDITIONS = 14
"""Conditions that Mitsuba renders; two of the 16 are dark."""

BEST_KNOBS: Knobs = {"way": "moments", "subpixels": 2, "sectors": 32, "table": 65}


def measure_gradient(stage: BenchmarkStage) -> None:
    """Measure renderings of one state of skin under all conditions, by moments and by Mitsuba.

    The reference of both is the sum over all LEDs with a shadow ray to each. Seconds are processor
    time. Ours include the table, which is common to all states of a session, and one state.
    """
    width = 48 if stage.toy else 192
    skin = gradient_scenes.plain_skin(width * 0.006 + 0.9)
    rng = np.random.default_rng(0)
    pixels = np.sort(rng.choice(width * width, 200 if stage.toy else 1500, replace=False))
    plain = gradient_scenes.plain_scene(skin, width_px=width)
    reference, _ = gradient_scenes.trace_pixels(plain, pixels, subpixels=2 if stage.toy else 4)
    best, without = _by_moments(stage, skin, width, pixels, reference)
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
        knobs: Knobs = {"way": "Mitsuba", "samples": samples}
        _add(stage, knobs, seconds, error, rise.mb, len(pixels))
    # the error of independent samples falls with 1 / sqrt(seconds)
    at_equal_error = seconds * (error / best.error) ** 2
    off = max(abs(way.mean_ratio - 1.0) / way.mean_ratio_stderr for way in ways)
    stage.limits = {
        ("speed_up", samples): at_equal_error / best.seconds,
        "error": 100.0 * best.error,
        "mean": off,
        "shadows": without.error / best.error,
    }


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
        knobs: Knobs = {"way": "moments", "subpixels": subpixels}
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
