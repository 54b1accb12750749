"""Benchmark of texture matching against pyrtools and scikit-image in the same run."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from model.texture_statistics import describe, match, steerable_pyramid
from model.texture_statistics.histograms import histogram_distance
from model.texture_statistics.space import TextureSpace
from skinrig.arrays import Float32Array, Float64Array
from skinrig.benchmarks.resampling import mean_error
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage

MIN_SPEEDUP_OVER_PYRTOOLS = 10.0
FULL_SIDE_PX, FULL_ITERATIONS = 1024, 4
PEER_NAME = "pyrtools and scikit-image"
N_SOURCES = 3
_SKIN_COLOR = np.array([0.55, 0.38, 0.28])
_DENSITY_COLORS = np.array([[0.5, 1.0, 1.4], [0.2, 1.0, 0.6], [1.0, 1.0, 1.0]])


def synthesize_skin_texture(side: int, *, spots: float, rng: np.random.Generator) -> Float32Array:
    """Synthesize a periodic texture of blotches, fine streaks and dark spots.

    Parameters
    ----------
    side
        Side of the image, px.
    spots
        Spots per 128 x 128 px.
    rng
        Generator of all random values.

    Returns
    -------
    ndarray of float32, shape (side, side, 3)
        Reflectance.
    """
    fy, fx = np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side)[None, :]

    def smooth(field: Float64Array, up_px: float, across_px: float) -> Float64Array:
        falloff = np.exp(-2.0 * np.pi**2 * ((up_px * fy) ** 2 + (across_px * fx) ** 2))
        return np.asarray(np.fft.ifft2(np.fft.fft2(field) * falloff).real)

    blotches = smooth(rng.standard_normal((side, side)), 12.0, 12.0)
    streaks = smooth(rng.standard_normal((side, side)), 4.0, 1.2)
    marks = np.zeros((side, side))
    count = round(spots * side * side / 128**2)
    marks[tuple(rng.integers(0, side, (2, count)))] = 1.0
    dark = np.minimum(smooth(marks, 2.5, 2.5) * 40.0, 1.5)
    density = 0.08 * (blotches / blotches.std())[..., None] * _DENSITY_COLORS[0]
    density = density + 0.04 * (streaks / streaks.std())[..., None] * _DENSITY_COLORS[2]
    density = density + 0.3 * dark[..., None] * _DENSITY_COLORS[1]
    return (_SKIN_COLOR * np.exp(-density)).astype(np.float32)


def _error(images: list[Any], target: Float64Array, space: TextureSpace) -> ErrorEstimate:
    """Return the mean histogram distance of images from a target, with its interval."""
    target_histograms = space.histograms(target)
    off = [
        float(
            histogram_distance(
                space.histograms(describe(i, space=space)), target_histograms, space.edges
            ).mean()
        )
        for i in images
    ]
    return mean_error(off)


def _add(
    stage: BenchmarkStage,
    knobs: Knobs,
    levels: int = steerable_pyramid.LEVELS,
    dtype: type = np.float32,
    **options: Any,
) -> None:
    """Match plain skin to spotted skin; errors are evaluated at full pyramid depth."""
    side, rng = int(knobs["side"]), np.random.default_rng(0)
    target: Any = synthesize_skin_texture(side, spots=10.0, rng=rng).astype(dtype)
    sources = [
        0.9 * synthesize_skin_texture(side, spots=0.0, rng=rng).astype(dtype)
        for _ in range(N_SOURCES)
    ]
    full = TextureSpace.fit([target, *sources])
    used = full if levels == full.levels else TextureSpace.fit([target, *sources], levels=levels)
    vector = describe(target, space=used)

    def run(source: Any) -> Any:
        rng = np.random.default_rng(1)
        settings = {"iterations": 5, "noise": 0.05} | options
        return match(source, vector, space=used, rng=rng, **settings).image

    timing, _ = stage.time(lambda: run(sources[0]))
    outcome = _error([run(s) for s in sources], describe(target, space=full), full)
    stage.add(knobs, timing, outcome)


def measure_efforts(stage: BenchmarkStage, knobs: Knobs) -> None:
    """Measure matching over pyramid depth and iterations."""
    at = knobs | {"side": _side(stage)}
    depths, counts = ((1, 7), (0, 2)) if stage.toy else ((1, 3, 5, 7), (0, 1, 2, 10, 20))
    for n in depths:
        _add(stage, at | {"levels": n, "iterations": 5}, levels=n)
    for n in counts:
        _add(stage, at | {"levels": 7, "iterations": n}, iterations=n)


def _side(stage: BenchmarkStage) -> int:
    return 48 if stage.toy else 256


def measure_texture_matching(stage: BenchmarkStage) -> None:
    """Measure matching over depth, iterations, precision, size and start, then at full size."""
    measure_efforts(stage, {})
    usual: Knobs = {"side": _side(stage), "levels": 7, "iterations": 5}
    _add(stage, usual | {"precision": "float64"}, dtype=np.float64)
    _add(stage, usual | {"start": "noise"}, start="noise")
    for other in (32,) if stage.toy else (128, 512):
        _add(stage, usual | {"side": other})
    stage.reference_error = _same_process_distance(_side(stage))
    if not stage.toy:
        compare_with_peer(stage)


def _same_process_distance(side: int) -> float:
    """Return the distance between two textures of one random process, the error's lower limit."""
    rng = np.random.default_rng(2)
    textures = [synthesize_skin_texture(side, spots=10.0, rng=rng) for _ in range(1 + N_SOURCES)]
    plain = 0.9 * synthesize_skin_texture(side, spots=0.0, rng=rng)
    space = TextureSpace.fit([*textures, plain])
    return _error(textures[1:], describe(textures[0], space=space), space).error


def iterate_with_peer(
    image: ArrayLike, target: ArrayLike, iterations: int
) -> Callable[[], Float64Array]:
    """Return a function that runs Heeger and Bergen's matching with pyrtools and scikit-image.

    The target's pyramid is built here and is not timed, as ours is given the target's vector.

    Raises
    ------
    ImportError
        When pyrtools is not installed.
    """
    from pyrtools.pyramids import SteerablePyramidFreq
    from skimage.exposure import match_histograms

    start, goal = np.asarray(image, np.float64), np.asarray(target, np.float64)
    pyramid = partial(
        SteerablePyramidFreq,
        height=steerable_pyramid.LEVELS,
        order=steerable_pyramid.ORIENTATIONS - 1,
    )
    goals = pyramid(goal).pyr_coeffs

    def run() -> Float64Array:
        current = start
        for _ in range(iterations):
            built = pyramid(current)
            for key, response in built.pyr_coeffs.items():
                built.pyr_coeffs[key] = match_histograms(response, goals[key])
            current = match_histograms(built.recon_pyr(), goal)
        return np.asarray(current)

    return run


def filter_with_peer(image: ArrayLike) -> list[Float64Array]:
    """Return pyrtools' responses in our order and unit; pyrtools scales each level by 4."""
    from pyrtools.pyramids import SteerablePyramidFreq

    levels, orientations = steerable_pyramid.LEVELS, steerable_pyramid.ORIENTATIONS
    found = SteerablePyramidFreq(
        np.asarray(image, np.float64), height=levels, order=orientations - 1
    ).pyr_coeffs
    bands = [found[(level, k)] / 4.0**level for level in range(levels) for k in range(orientations)]
    return [found["residual_highpass"], *bands, found["residual_lowpass"] / 4.0**levels]


def compare_with_peer(stage: BenchmarkStage, side: int = FULL_SIDE_PX) -> None:
    """Match one channel in turn with the peer; add limits, or the omission and its reason."""
    try:
        filter_with_peer(np.zeros((512, 512)))
    except ImportError as error:
        why = f"a package is missing ({error}); run pip install 'skinrig[peers]'"
        stage.omitted.append((f"{MIN_SPEEDUP_OVER_PYRTOOLS:g} x {PEER_NAME}", why))
        return
    rng = np.random.default_rng(0)
    target = synthesize_skin_texture(side, spots=10.0, rng=rng)[..., 1].copy()
    source = 0.9 * synthesize_skin_texture(side, spots=0.0, rng=rng)[..., 1]
    space = TextureSpace.fit([target, source])
    vector = describe(target, space=space)
    theirs = iterate_with_peer(source, target, 1)

    def ours(iterations: int) -> Any:
        return match(source, vector, space=space, iterations=iterations).image

    own, peer = ours(1), theirs()
    ratios = []
    for _ in range(3):
        # ours also evaluates the result's distance; the difference of two runs removes this time
        spent = [_measure_seconds(partial(ours, n)) for n in (0, FULL_ITERATIONS)]
        ratios.append(FULL_ITERATIONS * _measure_seconds(theirs) / (spent[1] - spent[0]))
    wall, processor = np.median(ratios, axis=0)
    off = [_error([one.astype(np.float32)], vector, space).error for one in (own, peer)]
    differences = [
        float(np.abs(a - b).max() / source.max())
        for a, b in zip(steerable_pyramid.analyze(source), filter_with_peer(source), strict=True)
    ]
    stage.limits = {
        ("speed_up", side): float(wall),
        ("processor", side): float(processor),
        "distance": off[0] / off[1],
        "responses": max(differences),
    }


def _measure_seconds(call: Callable[[], Any]) -> Float64Array:
    """Return elapsed time and processor time, s."""
    begin = time.perf_counter(), time.process_time()
    call()
    return np.array([time.perf_counter() - begin[0], time.process_time() - begin[1]])
