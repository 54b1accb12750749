"""Benchmark of merging exposure brackets, beside OpenCV's Debevec merge in the same run."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from capture import hdr
from skinrig.arrays import BoolArray, Float32Array, Float64Array, UInt16Array
from skinrig.benchmarks.results import BandError, Timing
from skinrig.benchmarks.stage import Stage

GAIN_E_PER_DN, READ_NOISE_E, BLACK_DN, WHITE_DN = 2.0, 8.0, 512.0, 16383.0
N_FRAMES, FULL_SIDE_PX = 23, 1024
EXPOSURE_RANGE_S = (1e-3, 1.0)

Frames = list[UInt16Array]


def merging(stage: Stage) -> None:
    """Merge brackets of 2 to 23 frames over three decades of exposure, four of radiance."""
    side = 64 if stage.toy else FULL_SIDE_PX
    rng = np.random.default_rng(0)
    scene = np.geomspace(20.0, 2e5, side * side * 3)
    scene = rng.permutation(scene).reshape(side, side, 3)  # DN per second
    worst = 0.0
    frames: Frames = []
    times = np.ones(1)
    for count in (2, 3, 5, 9, N_FRAMES):
        times = np.geomspace(*EXPOSURE_RANGE_S, count)
        frames = [_expose(scene, t, rng) for t in times]
        timing, (radiance, _, valid) = stage.time(lambda: _merge(frames, times))
        bound = _bound(scene, times)
        # near a frame's saturation noise decides whether the frame counts
        settled = valid & ~np.any(
            [np.abs(scene * t / (WHITE_DN - BLACK_DN) - 1) < 0.05 for t in times], axis=0
        )
        squares = ((radiance - scene) / scene)[settled] ** 2
        error = 100 * float(np.sqrt(squares.mean()))
        spread = 50 * float(squares.std() / np.sqrt(squares.size) / np.sqrt(squares.mean()))
        least = 100 * float(np.sqrt(((bound / scene**2)[settled]).mean()))
        worst = max(worst, error / least)
        outcome = BandError.around(error, spread, least)
        stage.add({"frames": count}, timing, outcome)
    ours, theirs, ratio = _beside_opencv(frames, times, rounds=1 if stage.toy else 15)
    ours = replace(ours, peak_memory_mb=timing.peak_memory_mb)
    stage.add({"frames": N_FRAMES, "way": "beside"}, ours, outcome)
    stage.limits = {("speed_up", side, theirs): ratio, "over_bound": worst}


def _merge(frames: Frames, times: Float64Array) -> tuple[Float32Array, Float32Array, BoolArray]:
    return hdr.merge(
        frames, times, gain=GAIN_E_PER_DN, read_noise=READ_NOISE_E, black=BLACK_DN, white=WHITE_DN
    )


def _expose(scene: Float64Array, time_s: float, rng: np.random.Generator) -> UInt16Array:
    electrons = rng.poisson(np.minimum(scene * time_s * GAIN_E_PER_DN, 1e6)).astype(np.float32)
    electrons += READ_NOISE_E * rng.standard_normal(scene.shape, np.float32)
    return np.clip(np.rint(electrons / GAIN_E_PER_DN + BLACK_DN), 0, WHITE_DN).astype(np.uint16)


def _bound(scene: Float64Array, times: Sequence[float] | Float64Array) -> Float64Array:
    """Return the least variance of an unbiased estimate, from the frames that are not saturated."""
    information = np.zeros_like(scene)
    for t in times:
        variance = scene * t / GAIN_E_PER_DN + (READ_NOISE_E / GAIN_E_PER_DN) ** 2 + 1 / 12
        information += np.where(scene * t < WHITE_DN - BLACK_DN, t**2 / variance, 0.0)
    return 1.0 / np.where(information > 0, information, np.nan)


def _beside_opencv(
    frames: Frames, times: Float64Array, *, rounds: int
) -> tuple[Timing, float, float]:
    """Time both in turn, so that both meet the same machine; return the ratio of the fastest."""
    import cv2

    eight_bits = [(frame >> 6).astype(np.uint8) for frame in frames]
    peer = cv2.createMergeDebevec()
    seconds = times.astype(np.float32)
    _merge(frames, times)
    peer.process(eight_bits, seconds)
    ours, theirs = [], []
    for _ in range(rounds):
        start = time.perf_counter()
        _merge(frames, times)
        middle = time.perf_counter()
        peer.process(eight_bits, seconds)
        ours.append(middle - start)
        theirs.append(time.perf_counter() - middle)
    # the fastest of each: what neither the other nor the machine's other work slowed down
    ratio = min(theirs) / min(ours)
    timing = Timing(float(np.median(ours)), (min(ours), max(ours)), ours[0], None)
    return timing, min(theirs), ratio
