"""Benchmark of the gradient rig's pictures: all conditions from four moments, and Mitsuba's."""

import math
import time

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
from skinrig.benchmarks.description import Findings, described
from skinrig.benchmarks.results import BandError, Knobs, Point, StageBenchmark, Timing

N_LIT_CONDITIONS = 14
"""Of the 16 conditions two are dark; Mitsuba is not asked to render those."""

BEST_KNOBS: Knobs = {"way": "moments", "subpixels": 2, "sectors": 32, "table": 65}


def render(*, toy: bool) -> StageBenchmark:
    """Picture one state of skin under all conditions, and render its conditions one by one.

    Both sides are judged against sums over the LEDs with a shadow ray to each. Seconds are
    processor time; ours are those of the table, which serves all states of a session, and of one
    state.
    """
    width = 48 if toy else 192
    skin = plain_skin(width * 0.006 + 0.9)
    rng = np.random.default_rng(0)
    pixels = np.sort(rng.choice(width * width, 200 if toy else 1500, replace=False))
    plain = plain_scene(skin, width_px=width)
    reference, _ = traced(plain, pixels, subpixels=2 if toy else 4)
    ours, without = _by_moments(skin, width, pixels, reference, toy=toy)
    points = [_point(knobs, way.seconds, way.error, mb, len(pixels)) for knobs, way, mb in ours]
    theirs = {}
    for samples in (4,) if toy else (16, 64):
        ways = []
        for number, pattern in enumerate(("full", "x")):
            with resident_memory.watched() as rise:
                image, seconds = rendered(plain, pattern, samples=samples, seed=number)
            wanted = reference @ np.array(PATTERN_WEIGHTS[pattern])
            ways.append(judge(image.reshape(-1)[pixels].astype(np.float64), wanted, seconds))
        error = math.sqrt(sum(way.error**2 for way in ways) / 2.0)
        seconds = N_LIT_CONDITIONS * sum(way.seconds for way in ways) / 2.0
        theirs[samples] = (seconds, error, ways)
        knobs: Knobs = {"way": "Mitsuba", "samples": samples}
        points.append(_point(knobs, seconds, error, rise.mb, len(pixels)))
    best = next(way for knobs, way, _ in ours if knobs == BEST_KNOBS)
    samples = max(theirs)
    peer_s, peer_error, ways = theirs[samples]
    at_equal_error = peer_s * (peer_error / best.error) ** 2
    off = max(abs(way.mean_ratio - 1.0) / way.mean_ratio_stderr for way in ways)
    limits: Findings = {
        ("speed_up", samples): at_equal_error / best.seconds,
        "error": 100.0 * best.error,
        "mean": off,
        "shadows": without.error / best.error,
    }
    return described("render-gradient", points, {} if toy else limits)


def _by_moments(
    skin: MicroSkin, width: int, pixels: Int64Array, reference: Float64Array, *, toy: bool
) -> tuple[list[tuple[Knobs, Way, float | None]], Way]:
    """Return our ways with their knobs and MB, and the usual one without shadows."""
    picture(plain_scene(skin, width_px=width, table_size=17), pixels)  # compiles
    settings = [(1, 16, 33), (1, 32, 65), (2, 32, 65)]
    if not toy:
        settings += [(1, 32, 129), (2, 16, 65), (2, 64, 65), (3, 32, 65)]
    ours = []
    for subpixels, sectors, table in settings:
        scene = plain_scene(
            skin, width_px=width, subpixels=subpixels, sectors=sectors, table_size=table
        )
        with resident_memory.watched() as rise:
            begin = time.process_time()
            scene.lighting()
            found = picture(scene, pixels)
            spent = time.process_time() - begin
        knobs: Knobs = {"way": "moments", "subpixels": subpixels}
        knobs |= {"sectors": sectors, "table": table}
        ours.append((knobs, judge(found, reference, spent), rise.mb))
    bare = picture(plain_scene(skin, width_px=width, shadows=False), pixels)
    return ours, judge(bare, reference, 0)


def _point(
    knobs: Knobs, seconds: float, error: float, memory_mb: float | None, pixels: int
) -> Point:
    timing = Timing.single(seconds, memory_mb, memory_of="resident")
    outcome = BandError.around(100.0 * error, 100.0 * error / math.sqrt(2.0 * pixels))
    return Point.of(knobs, timing, outcome)
