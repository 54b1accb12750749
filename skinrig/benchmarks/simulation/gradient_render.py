"""Benchmark of the gradient rig's pictures: all conditions from four moments, and Mitsuba's."""

import math

import numpy as np

from rigsim.as_built.sphere import PATTERN_WEIGHTS
from rigsim.scenes.gradient.reference import (
    Way,
    judge,
    picture,
    plain_scene,
    plain_skin,
    rendered,
    traced,
)
from rigsim.skin_patch.microrelief import MicroSkin
from skinrig.arrays import Float64Array, Int64Array
from skinrig.benchmarks import resident_memory
from skinrig.benchmarks.measurement import spent
from skinrig.benchmarks.results import BandError, Knobs, Timing
from skinrig.benchmarks.stage import Stage

N_LIT_CONDITIONS = 14
"""Of the 16 conditions two are dark; Mitsuba is not asked to render those."""

BEST_KNOBS: Knobs = {"way": "moments", "subpixels": 2, "sectors": 32, "table": 65}


def render(stage: Stage) -> None:
    """Picture one state of skin under all conditions, and render its conditions one by one.

    Both sides are judged against sums over the LEDs with a shadow ray to each. Seconds are
    processor time; ours are those of the table, which serves all states of a session, and of one
    state.
    """
    width = 48 if stage.toy else 192
    skin = plain_skin(width * 0.006 + 0.9)
    rng = np.random.default_rng(0)
    pixels = np.sort(rng.choice(width * width, 200 if stage.toy else 1500, replace=False))
    plain = plain_scene(skin, width_px=width)
    reference, _ = traced(plain, pixels, subpixels=2 if stage.toy else 4)
    best, without = _by_moments(stage, skin, width, pixels, reference)
    for samples in (4,) if stage.toy else (16, 64):
        ways = []
        for number, pattern in enumerate(("full", "x")):
            with resident_memory.watched() as rise:
                image, seconds = rendered(plain, pattern, samples=samples, seed=number)
            wanted = reference @ np.array(PATTERN_WEIGHTS[pattern])
            ways.append(judge(image.reshape(-1)[pixels].astype(np.float64), wanted, seconds))
        error = math.sqrt(sum(way.error**2 for way in ways) / 2.0)
        seconds = N_LIT_CONDITIONS * sum(way.seconds for way in ways) / 2.0
        knobs: Knobs = {"way": "Mitsuba", "samples": samples}
        _add(stage, knobs, seconds, error, rise.mb, len(pixels))
    at_equal_error = seconds * (error / best.error) ** 2
    off = max(abs(way.mean_ratio - 1.0) / way.mean_ratio_stderr for way in ways)
    stage.limits = {
        ("speed_up", samples): at_equal_error / best.seconds,
        "error": 100.0 * best.error,
        "mean": off,
        "shadows": without.error / best.error,
    }


def _by_moments(
    stage: Stage, skin: MicroSkin, width: int, pixels: Int64Array, reference: Float64Array
) -> tuple[Way, Way]:
    """Add our ways; return the best, and the usual one without shadows."""
    picture(plain_scene(skin, width_px=width, table_size=17), pixels)  # compiles
    settings = [(1, 16, 33), (1, 32, 65), (2, 32, 65)]
    if not stage.toy:
        settings += [(1, 32, 129), (2, 16, 65), (2, 64, 65), (3, 32, 65)]
    for subpixels, sectors, table in settings:
        scene = plain_scene(
            skin, width_px=width, subpixels=subpixels, sectors=sectors, table_size=table
        )
        with resident_memory.watched() as rise:
            spent_s, (_, found) = spent(lambda: (scene.lighting(), picture(scene, pixels)))
        knobs: Knobs = {"way": "moments", "subpixels": subpixels}
        knobs |= {"sectors": sectors, "table": table}
        way = judge(found, reference, spent_s)
        _add(stage, knobs, spent_s, way.error, rise.mb, len(pixels))
        if knobs == BEST_KNOBS:
            best = way
    bare = picture(plain_scene(skin, width_px=width, shadows=False), pixels)
    return best, judge(bare, reference, 0)


def _add(
    stage: Stage, knobs: Knobs, seconds: float, error: float, mb: float | None, pixels: int
) -> None:
    timing = Timing.single(seconds, mb, memory_of="resident")
    outcome = BandError.around(100.0 * error, 100.0 * error / math.sqrt(2.0 * pixels))
    stage.add(knobs, timing, outcome)
