"""Merge brackets of exposures to linear radiance with its variance."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numba import carray, get_num_threads, njit, parallel_chunksize, prange, set_num_threads, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import ArrayLike, NDArray

from capture.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from capture.documents import FaultCollector, InputError

N_WEIGHTING_STEPS: Final = 1
"""Iterations of the weights; a second changes the estimate by less than 1 % of its standard error.
"""
_TILE_PIXELS: Final = 512
_CHUNK_PIXELS: Final = 128
_MAX_SERIAL_PIXELS: Final = 1 << 17  # pixels
"""Tiles per task of a thread, so that a busy core does not delay the others."""
_FAST_MATH: Final = {"nsz", "arcp", "contract", "reassoc"}

_MAX_EXACT_INTEGER: Final = 2.0**53
"""Whole numbers below it are exact in float64."""

_N_LEVELS: Final = 256
_N_GROUPS: Final = 8

_Merged = tuple[Float32Array, Float32Array, BoolArray]


class BracketError(InputError):
    """Raised for frames that cannot be merged."""


@dataclass(frozen=True, slots=True, eq=False)
class ResponseCurve:
    """Response of an encoded image: exposure of each value, up to one factor per channel."""

    exposure: Float64Array
    """Relative exposure (radiance times seconds) of each value, shape (256, C), 1 at value 128."""
    stderr: Float64Array
    """Standard error of `exposure`, shape (256, C), from groups of pixels fitted separately."""
    valid: BoolArray
    """Values with enough samples and a rising response, shape (256, C)."""

    def linearize(self, image: UInt8Array) -> tuple[Float32Array, Float32Array, BoolArray]:
        """Return relative exposure, its variance and a mask of valid pixels, in image shape.

        The variance includes that of the response and of the rounding to whole values.
        """
        picture = np.asarray(image)
        if picture.dtype != np.uint8 or picture.shape[-1:] != self.exposure.shape[1:]:
            checks = FaultCollector("Picture", BracketError)
            expected = f"uint8, (..., {self.exposure.shape[1]})"
            checks.check("image", (str(picture.dtype), picture.shape), False, expected)
            checks.close()
        step = np.gradient(self.exposure, axis=0)
        variance = self.stderr**2 + step**2 / 12.0
        channel = np.arange(self.exposure.shape[1])
        return (
            self.exposure[picture, channel].astype(np.float32),
            variance[picture, channel].astype(np.float32),
            self.valid[picture, channel],
        )


def recover_response(
    images: Sequence[UInt8Array],
    exposures_s: ArrayLike,
    *,
    rng: np.random.Generator,
    pixels: int = 150,
    smoothness: float = 10.0,
) -> ResponseCurve:
    """Recover the response of a camera from a bracket of JPEG images (OpenCV's Debevec).

    Raw frames do not need this: they are linear, see `merge`.

    Parameters
    ----------
    images : sequence of N arrays of uint8, shape (H, W, 3)
        One scene from one position, N >= 2.
    exposures_s : array_like, shape (N,)
        Exposure times, s, not all the same.
    rng : numpy.random.Generator
        Draws the pixels.
    pixels : int
        Pixels in each of 8 groups that are fitted separately, at least 50.
    smoothness : float
        Weight of smoothness against the data, > 0.

    Returns
    -------
    Response

    Raises
    ------
    BracketError
        When shapes, types or times do not match.

    References
    ----------
    Debevec and Malik 1997, Recovering high dynamic range radiance maps from photographs, doi
    10.1145/258734.258884.
    """
    import cv2

    stack = [np.asarray(image) for image in images]
    times = np.asarray(exposures_s, np.float64)
    checks = FaultCollector("Bracket", BracketError)
    checks.check("images", len(stack), len(stack) >= 2, "at least two")
    kinds = sorted({(str(image.dtype), image.shape) for image in stack})
    fits = len(kinds) == 1 and stack[0].dtype == np.uint8 and stack[0].shape[2:] == (3,)
    checks.check("images", kinds, fits, "uint8 of one shape (H, W, 3)")
    positive = bool(np.isfinite(times).all() and (times > 0).all())
    checks.check("exposures_s", times.tolist(), positive, "finite seconds > 0")
    one_each = times.shape == (len(stack),) and len(np.unique(times)) >= 2
    checks.check("exposures_s", times.tolist(), one_each, f"{len(stack)} times, two that differ")
    checks.check("pixels", pixels, pixels >= 50, ">= 50")
    checks.check_positive(smoothness=smoothness)
    checks.close()
    values = np.stack([image.reshape(-1, 3) for image in stack])  # (N, H W, 3)
    # pixels distributed over the values of the middle exposure, each group with its own
    middle = values[len(stack) // 2].mean(axis=-1)
    order = np.argsort(middle + rng.uniform(0, 1e-3, len(middle)), kind="stable")
    strata = np.array_split(order, pixels)
    curves = []
    for _ in range(_N_GROUPS):
        chosen = np.array([rng.choice(part) for part in strata if len(part)])
        # each pixel is a patch of its own, of which the library samples the middle
        side = int(np.ceil(np.sqrt(len(chosen))))
        padded = np.concatenate([chosen, rng.choice(order, side * side - len(chosen))])
        patches = [np.ascontiguousarray(v[padded].reshape(side, side, 3)) for v in values]
        solver = cv2.createCalibrateDebevec(side * side, float(smoothness), False)
        curve = solver.process(patches, times.astype(np.float32)).reshape(_N_LEVELS, 3)
        curves.append(curve / curve[_N_LEVELS // 2])
    exposure = np.array(curves, np.float64)
    seen = np.stack(
        [np.bincount(values[..., c].ravel(), minlength=_N_LEVELS) for c in range(3)], axis=-1
    )
    mean = exposure.mean(axis=0)
    rising = np.gradient(mean, axis=0) > 0
    inner = np.zeros((_N_LEVELS, 1), np.bool_)
    inner[3:-3] = True  # the ends are clipped
    valid = (seen >= 20) & rising & inner
    stderr = exposure.std(axis=0, ddof=1) / np.sqrt(_N_GROUPS)
    return ResponseCurve(mean, stderr, np.asarray(valid, np.bool_))


def merge(
    frames: Sequence[NDArray[np.integer | np.floating]] | NDArray[np.integer | np.floating],
    exposures_s: ArrayLike,
    *,
    gain: float,
    read_noise: float,
    black: float,
    white: float,
) -> _Merged:
    """Merge raw frames of one scene at several exposure times with noise-optimal weights.

    Parameters
    ----------
    frames : sequence of N arrays of whole numbers, shape (..., H, W) or (..., H, W, C)
        Raw DN of one camera, nothing subtracted; the scene and the light do not change. Of any
        type, floating ones included, as long as every value is whole.
    exposures_s : array_like, shape (N,)
        Exposure times, s; a time is repeated for each of its frames.
    gain : float
        Electrons per DN.
    read_noise : float
        Electrons rms, of one frame.
    black, white : float
        Levels in DN; values from `white` on are saturated and omitted.

    Returns
    -------
    radiance : ndarray of float32, shape (H, W[, C])
        DN above black per second, of the frames' shape; negative values are kept; NaN
        where not valid.
    variance : ndarray of float32, shape (H, W[, C])
        Variance of `radiance`; NaN where not valid.
    valid : ndarray of bool, shape (H, W[, C])
        False where every frame is saturated.

    Raises
    ------
    BracketError
        When shapes, times or levels do not match, or a value is not whole.

    Notes
    -----
    Averaged frames have less noise than one frame, and may hide pixels that were saturated in some
    of them; frames with a subtracted dark frame have an unknown saturation and noise. Both are
    rejected, since their variance would be wrong: give the single frames, each with its time (the
    merge averages them), and the dark level as `black`.

    Maximum likelihood estimate for shot and read noise: the weight of a frame is ``t^2 / (radiance
    t / gain + (read_noise / gain)^2 + 1/12)``. The radiance in it is the estimate itself, not the
    noisy value of the frame, which would favor low readings (Granados et al. 2010, doi
    10.1109/CVPR.2010.5540208). Frames of uint16 are read once, tile by tile, on all cores; others
    go through `merge_reference`.

    Examples
    --------
    >>> short, long = np.full((1, 1), 612), np.full((1, 1), 1512)
    >>> radiance, variance, valid = merge(
    ...     [short, long], [0.1, 1.0], gain=2.0, read_noise=4.0, black=512, white=16383)
    >>> round(float(radiance[0, 0])), bool(valid[0, 0])
    (1000, True)
    """
    stack = [np.asarray(frame) for frame in frames]
    times = np.asarray(exposures_s, np.float64)
    _check(stack, times, gain=gain, read_noise=read_noise, black=black, white=white)
    stack = [
        frame if np.issubdtype(frame.dtype, np.integer) else _as_integer(frame) for frame in stack
    ]
    if any(frame.dtype != np.uint16 for frame in stack):
        return merge_reference(
            stack, times, gain=gain, read_noise=read_noise, black=black, white=white
        )
    rows = [np.ascontiguousarray(frame) for frame in stack]
    shape = rows[0].shape
    radiance, variance = np.empty(shape, np.float32), np.empty(shape, np.float32)
    valid = np.empty(shape, np.bool_)
    # times are scaled to 1 so that float32 can represent any of them
    longest = float(times.max())
    # starting a second thread takes longer than a small frame; the choice applies to this thread
    # only
    threads = get_num_threads()
    set_num_threads(1 if radiance.size < _MAX_SERIAL_PIXELS else threads)
    try:
        with parallel_chunksize(_CHUNK_PIXELS):
            _merge_tiles(
                np.array([row.ctypes.data for row in rows], np.int64),
                (times / longest).astype(np.float32),
                _choose_first_frames(times),
                np.float32(1.0 / gain),
                np.float32((read_noise / gain) ** 2 + 1.0 / 12.0),
                np.float32(black),
                np.float32(white),
                np.float32(1.0 / longest),
                radiance.reshape(-1),
                variance.reshape(-1),
                valid.reshape(-1),
            )
    finally:
        set_num_threads(threads)
    return radiance, variance, valid


def merge_reference(
    frames: Sequence[NDArray[np.integer]],
    exposures_s: ArrayLike,
    *,
    gain: float,
    read_noise: float,
    black: float,
    white: float,
) -> _Merged:
    """Return the result of `merge`, in plain float64 for whole numbers of any type."""
    times = np.asarray(exposures_s, np.float64)
    floor = (read_noise / gain) ** 2 + 1.0 / 12.0  # DN^2, with the rounding to whole DN
    shape = frames[0].shape
    signal, time = np.zeros(shape), np.zeros(shape)
    for k in _choose_first_frames(times):
        frame, t = frames[k], times[k]
        usable = frame < white
        # first with read noise alone, when the longest exposure has the largest weight
        signal += np.where(usable, (frame.astype(np.float64) - black) * t, 0.0)
        time += np.where(usable, t * t, 0.0)
    valid = time > 0
    radiance = signal / np.where(valid, time, 1.0)
    total = np.ones(shape)
    for _ in range(N_WEIGHTING_STEPS):
        weighted, total = np.zeros(shape), np.zeros(shape)
        for frame, t in zip(frames, times, strict=True):
            # one frame's weight for its own DN / t is t^2 / variance
            # Poisson noise of N electrons is N; in DN^2 it is the mean signal in DN over the gain.
            spread = np.maximum(radiance, 0.0) * t / gain + floor
            weight = np.where(frame < white, t / spread, 0.0)
            weighted += weight * (frame.astype(np.float64) - black)
            total += weight * t
        radiance = weighted / np.where(valid, total, 1.0)
    nothing = np.float32(np.nan)
    return (
        np.where(valid, radiance, nothing).astype(np.float32),
        np.where(valid, 1.0 / np.where(valid, total, 1.0), nothing).astype(np.float32),
        valid,
    )


def _choose_first_frames(times: Float64Array) -> Int64Array:
    """Return the frames for the first estimate: all, or of dense brackets those a factor 3 apart.

    The weights need the radiance to a few percent only. The shortest and the longest are included.
    """
    order = [int(k) for k in np.argsort(times, kind="stable")]
    chosen = order[:1]
    for here, following in pairwise(order[1:]):
        if times[following] > 3.0 * times[chosen[-1]]:
            chosen.append(here)
    chosen += order[1:][-1:]
    return np.array(chosen, np.int64)


def _as_float(frame: NDArray[Any]) -> bool:
    return bool(np.issubdtype(frame.dtype, np.floating))


def _as_integer(frame: NDArray[Any]) -> NDArray[np.integer]:
    """Return whole numbers of a floating type as uint16 when they fit, else as int64."""
    held = not frame.size or (float(frame.min()) >= 0 and float(frame.max()) <= 65535)
    return frame.astype(np.uint16 if held else np.int64)


def _check(
    stack: Sequence[NDArray[np.integer]],
    times: Float64Array,
    *,
    gain: float,
    read_noise: float,
    black: float,
    white: float,
) -> None:
    checks = FaultCollector("Bracket", BracketError)
    checks.check("frames", len(stack), len(stack) > 0, "at least one frame")
    shapes = sorted({frame.shape for frame in stack})
    checks.check("frames", shapes, len(shapes) <= 1, "frames of one shape")
    numbers = all(np.issubdtype(f.dtype, np.integer) or _as_float(f) for f in stack)
    checks.check("frames", [str(f.dtype) for f in stack][:3], numbers, "raw DN, whole numbers")
    for k, frame in enumerate(stack):
        if not _as_float(frame):
            continue
        values = frame.astype(np.float64, copy=False)
        part = (values == np.rint(values)) & (
            np.abs(values) < _MAX_EXACT_INTEGER
        )  # NaN is not whole
        if not part.all():
            checks.check(
                f"frames[{k}]",
                float(values[~part].flat[0]),
                False,
                "raw DN, whole numbers; in place of averaged frames give the single ones, each "
                "with its time, and in place of subtracting a dark frame its level as black",
            )
            break
    one_each = times.shape == (len(stack),)
    checks.check("exposures_s", times.shape, one_each, f"{len(stack)} times")
    positive = bool(np.isfinite(times).all() and (times > 0).all())
    checks.check("exposures_s", times.tolist(), positive, "finite seconds > 0")
    checks.check_positive(gain=gain)
    checks.check("read_noise", read_noise, 0 <= read_noise < np.inf, ">= 0")
    checks.check("white", white, white > black, f"> black {black}")
    checks.close()


@intrinsic
def _as_pointer(typing_context: Any, address: Any) -> Any:
    """Return the frame at an address: the kernel takes any number of separate frames."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], cgutils.voidptr_t)

    return types.voidptr(address), build


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_FAST_MATH)
def _merge_tiles(  # type: ignore[no-untyped-def]
    addresses, times, starters, per_gain, floor, black, white, per_time, radiance, variance, valid
):
    """Merge tile by tile: the frames' tiles stay in cache over the iterations of the weights."""
    size = radiance.shape[0]
    for tile in prange((size + _TILE_PIXELS - 1) // _TILE_PIXELS):
        start = tile * _TILE_PIXELS
        count = min(_TILE_PIXELS, size - start)
        first = np.empty(count, np.float32)  # electrons per DN's worth: radiance over gain
        s = np.zeros(count, np.float32)  # weighted sum of DN
        w = np.zeros(count, np.float32)  # sum of weights times time
        for k in starters:
            frame = carray(_as_pointer(addresses[k]), size, np.uint16)[start : start + count]
            _add(frame, times[k], black, white, s, w)
        for _ in range(N_WEIGHTING_STEPS):
            for i in range(count):
                r = s[i] / w[i] if w[i] > 0.0 else np.float32(0.0)
                first[i] = max(r, np.float32(0.0)) * per_gain
                s[i] = 0.0
                w[i] = 0.0
            for k in range(0, len(addresses) - 1, 2):
                one = carray(_as_pointer(addresses[k]), size, np.uint16)[start : start + count]
                two = carray(_as_pointer(addresses[k + 1]), size, np.uint16)[start : start + count]
                _add_pair(one, two, times[k], times[k + 1], first, floor, black, white, s, w)
            if len(addresses) % 2:
                k = len(addresses) - 1
                frame = carray(_as_pointer(addresses[k]), size, np.uint16)[start : start + count]
                _add_weighted(frame, times[k], first, floor, black, white, s, w)
        for i in range(count):
            good = w[i] > 0.0
            valid[start + i] = good
            radiance[start + i] = s[i] / w[i] * per_time if good else np.float32(np.nan)
            variance[start + i] = per_time * per_time / w[i] if good else np.float32(np.nan)


@njit(error_model="numpy", fastmath=_FAST_MATH, forceinline=True)
def _add(frame, t, black, white, s, w):  # type: ignore[no-untyped-def]
    """Add the tile of one frame with the weight of read noise alone."""
    for i in range(len(s)):
        v = np.float32(frame[i])
        usable = np.float32(v < white) * t
        s[i] += usable * (v - black)
        w[i] += usable * t


@njit(error_model="numpy", fastmath=_FAST_MATH, forceinline=True)
def _add_weighted(frame, t, first, floor, black, white, s, w):  # type: ignore[no-untyped-def]
    """Add the tile of one frame with its time over its variance as weight."""
    for i in range(len(s)):
        v = np.float32(frame[i])
        weight = np.float32(v < white) * t / (first[i] * t + floor)
        s[i] += weight * (v - black)
        w[i] += weight * t


@njit(error_model="numpy", fastmath=_FAST_MATH, forceinline=True)
def _add_pair(one, two, t, u, first, floor, black, white, s, w):  # type: ignore[no-untyped-def]
    """Add the tiles of two frames with one division for both: a / x + b / y = (a y + b x) / x y."""
    for i in range(len(s)):
        v, z = np.float32(one[i]), np.float32(two[i])
        x, y = first[i] * t + floor, first[i] * u + floor
        shared = np.float32(1.0) / (x * y)
        a = np.float32(v < white) * t * y * shared
        b = np.float32(z < white) * u * x * shared
        s[i] += a * (v - black) + b * (z - black)
        w[i] += a * t + b * u
