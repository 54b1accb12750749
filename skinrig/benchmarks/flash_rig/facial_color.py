"""Benchmark of the hemoglobin rig: disc statistics against libraries, and predicted states."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from scipy import fft, ndimage

from model.facial_color import HemoglobinRig, disc_statistics, histogram_matching, prediction_errors
from rigsim import subject
from skinrig.arrays import BoolArray, Float32Array, FloatArray
from skinrig.benchmarks.measurement import measure_processor_seconds
from skinrig.benchmarks.resampling import median_error
from skinrig.benchmarks.results import Knobs
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues

PREDICTED_STATES = ("smile", "anger", "fear", "disgust", "exercise", "alcohol")
"""Expressions and conditions that are predicted."""
DISC_RADII_PX = (16, 32, 64)
FULL_SIDE_PX = 2048
RIG_RADIUS_PX = 16.0
"""Disc radius of the rig where another setting is varied; a texel of the face is 0.5 mm."""
PARALLEL_CORES = 2
"""Cores of multithreaded methods."""
N_TIMING_ROUNDS = 5
"""Rounds in which all methods are timed in turn; the fastest counts."""
CROP_SIDES_PX = {16: 256, 32: 160, 64: 96}
"""Crop side by disc radius for timing scipy.ndimage.convolve, whose time is proportional to the
pixels."""


def measure_rig(stage: BenchmarkStage) -> None:
    """Measure predicted states with dilated vessels, then time disc statistics at full size."""
    rng = np.random.default_rng(0)
    face = subject.make_subject("III", seed=3, size=96 if stage.toy else 512)
    neutral, covered = face.hemoglobin(), face.atlas.covered
    names = PREDICTED_STATES[:2] if stage.toy else PREDICTED_STATES
    truths = {name: face.hemoglobin(name) for name in names}

    def add(knobs: Knobs, predict: Callable[[str], FloatArray]) -> None:
        timing, _ = stage.time(lambda: predict(names[0]), memory=False)
        errors = []
        for name in names:
            found = prediction_errors.compare_prediction(
                predict(name), truths[name], neutral, valid=covered
            )
            errors.append(100.0 * found.predicted / found.neutral_kept)
        stage.add({"misaligned_px": 0} | knobs, timing, median_error(errors, rng=rng))

    def fitted(radius_px: float, stored: int | None, moved_px: int = 0) -> HemoglobinRig:
        return HemoglobinRig.from_maps(
            neutral,
            {n: np.roll(t, moved_px, axis=1) for n, t in truths.items()},
            radius_px=radius_px,
            valid={"neutral": covered} | {n: np.roll(covered, moved_px, axis=1) for n in names},
            stored_size=stored,
        )

    def scale_by_gain(name: str) -> FloatArray:
        return (
            prediction_errors.compare_prediction(neutral, truths[name], neutral, valid=covered).gain
            * neutral
        )

    add({"method": "neutral map kept"}, lambda name: neutral)
    add({"method": "one gain"}, scale_by_gain)
    sweep: list[tuple[float, int | None, int]] = [(RIG_RADIUS_PX, 256, 0)]
    if not stage.toy:
        sweep += [(r, 256, 0) for r in (4.0, 8.0, 32.0, 64.0)]
        sweep += [(RIG_RADIUS_PX, stored, 0) for stored in (None, 128, 64, 32)]
        sweep += [(RIG_RADIUS_PX, 256, moved) for moved in (1, 2, 4, 8)]
    for radius_px, stored, moved_px in sweep:
        made = fitted(radius_px, stored, moved_px)
        knobs: Knobs = {"method": "scale and bias", "radius_px": radius_px}
        knobs |= {"stored": stored or neutral.shape[0], "misaligned_px": moved_px}
        add(knobs, lambda name: made.blend({name: 1.0}))
    add(
        {"method": "scale and bias, refitted", "radius_px": RIG_RADIUS_PX},
        lambda name: HemoglobinRig.from_maps(
            neutral, {name: truths[name]}, radius_px=RIG_RADIUS_PX, valid=covered
        ).blend({name: 1.0}),
    )
    matched = partial(histogram_matching.match, valid=covered, valid_target=covered)
    for spacing in [8] if stage.toy else [11, 8, 4]:
        knobs = {"method": "exact histograms, windows", "radius_px": RIG_RADIUS_PX}
        add(
            knobs | {"spacing_px": spacing},
            lambda name: (
                matched(neutral, truths[name], RIG_RADIUS_PX, spacing_px=spacing).hemoglobin
            ),
        )
    if not stage.toy:
        stage.limits = (
            _round_trip(neutral, covered) | _compare_precision(rng) | _time_statistics(rng)
        )


def _round_trip(neutral: Float32Array, covered: BoolArray) -> LimitValues:
    """Return the error of maps that eq. (6) generated, fitted and evaluated again."""
    exact = neutral.astype(np.float64)
    states = {"first": 1.3 * exact + 0.004, "second": 0.7 * exact - 0.001}
    made = HemoglobinRig.from_maps(exact, states, radius_px=RIG_RADIUS_PX, valid=covered)
    weights = {"first": 0.8, "second": 0.5, "neutral": -0.3}
    expected = 0.8 * states["first"] + 0.5 * states["second"] - 0.3 * exact
    found = made.evaluate(weights, limits=(-1.0, 1.0))
    error = np.abs(found.hemoglobin - expected)[found.valid]
    return {"round_trip": float(error.max())}


def _compare_precision(rng: np.random.Generator) -> LimitValues:
    """Compare standard deviations of a nearly constant map with extended precision.

    The standard deviation is 3e-5 of the mean: the one-pass form E[h^2] - E[h]^2 would lose about
    nine decimal digits.
    """
    side, radius = 256, 32
    exact = 0.3 + 1e-5 * rng.standard_normal((side, side))
    y, x = np.mgrid[:side, :side]
    points = rng.integers(0, side, (200, 2))
    truth = []
    for row, column in points:
        inside = (y - row) ** 2 + (x - column) ** 2 <= radius**2
        values = exact[inside].astype(np.longdouble)
        truth.append(float(np.sqrt(np.mean((values - values.mean()) ** 2))))
    limits: LimitValues = {}
    for kind, bound in (("float64", 1e-5), ("float32", 1e-3)):
        found = disc_statistics.measure(exact.astype(kind), radius).deviation[tuple(points.T)]
        worst = float(np.abs(found / truth - 1.0).max())
        limits["digits", kind] = worst, bound
    return limits


def _time_statistics(rng: np.random.Generator) -> LimitValues:
    """Time local means and standard deviations of 2048 x 2048 in discs against three libraries.

    The libraries omit the correction at the border, division by the disc's fraction inside the map,
    which would be a third convolution. Processor time is independent of other programs. Ours and
    the transforms use two cores; cv2.filter2D and scipy.ndimage use one.
    """
    white = rng.standard_normal((FULL_SIDE_PX, FULL_SIDE_PX), np.float32)
    h = np.asarray(0.03 + 0.02 * ndimage.gaussian_filter(white, 2.0), np.float32)
    limits: LimitValues = {}
    for radius in DISC_RADII_PX:
        kernel = disc_mask(radius)
        crop = np.ascontiguousarray(h[: CROP_SIDES_PX[radius], : CROP_SIDES_PX[radius]])
        methods: list[tuple[int, Callable[[], object]]] = [
            (PARALLEL_CORES, lambda: disc_statistics.measure(h, radius)),
            (1, lambda: disc_statistics_opencv(h, kernel)),
            (PARALLEL_CORES, lambda: disc_statistics_fft(h, kernel)),
        ]
        for _, method in methods:
            method()
        least = [np.inf] * len(methods)
        for _ in range(N_TIMING_ROUNDS):
            for index, (cores, method) in enumerate(methods):
                least[index] = min(least[index], measure_processor_seconds(method) / cores)
        convolve_s = measure_processor_seconds(lambda: disc_statistics_convolve(crop, kernel))
        convolve_s *= h.size / crop.size
        ours_s, opencv_s, fft_s = least
        limits |= {
            ("convolve", radius, ours_s, CROP_SIDES_PX[radius]): convolve_s / ours_s,
            ("opencv", radius, opencv_s): opencv_s / ours_s,
            ("fft", radius, fft_s): fft_s / ours_s,
        }
    return limits


def disc_mask(radius_px: int) -> Float32Array:
    """Return the normalized disc kernel of eq. (1), (2 r + 1, 2 r + 1)."""
    y, x = np.mgrid[-radius_px : radius_px + 1, -radius_px : radius_px + 1]
    inside = (y * y + x * x <= radius_px**2).astype(np.float32)
    return np.asarray(inside / inside.sum(), np.float32)


def disc_statistics_convolve(
    h: Float32Array, kernel: Float32Array
) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation by eq. (1) with scipy.ndimage.convolve."""
    mean = ndimage.convolve(h, kernel)
    return mean, np.sqrt(np.maximum(ndimage.convolve(h * h, kernel) - mean * mean, 0.0))


def disc_statistics_opencv(h: Float32Array, kernel: Float32Array) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation by eq. (1) with cv2.filter2D."""
    mean = cv2.filter2D(h, -1, kernel)
    return mean, np.sqrt(np.maximum(cv2.filter2D(h * h, -1, kernel) - mean * mean, 0.0))


def disc_statistics_fft(h: Float32Array, kernel: Float32Array) -> tuple[FloatArray, FloatArray]:
    """Return mean and standard deviation by eq. (1) with real float32 Fourier transforms."""
    side = kernel.shape[0]
    shape = [fft.next_fast_len(n + side - 1, real=True) for n in h.shape]
    transfer = fft.rfft2(kernel, shape, workers=PARALLEL_CORES)
    low, size = side // 2, h.shape

    def convolved(image: Float32Array) -> Float32Array:
        product = fft.rfft2(image, shape, workers=PARALLEL_CORES) * transfer
        whole = fft.irfft2(product, shape, workers=PARALLEL_CORES)
        return np.asarray(whole[low : low + size[0], low : low + size[1]])

    mean = convolved(h)
    return mean, np.sqrt(np.maximum(convolved(h * h) - mean * mean, 0.0))
