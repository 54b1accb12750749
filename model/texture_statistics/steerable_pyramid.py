"""Steerable pyramid: split an image into responses of oriented band-pass filters, and invert.

Polar-separable filters in the frequency domain: raised cosines over the logarithm of the radius,
powers of a cosine over the angle. Their squares sum to 1, so that applying the same filters again
reconstructs the image. A response keeps the unit of the image (an image of constant 0.4 has a
low-pass of 0.4) and its level's own, smaller grid.

The image is treated as periodic. Every size has every level: level l has ceil(N / 2^l) samples
along an axis of N, which always include the frequencies of its band, and a level below the lowest
frequency of a small image is exactly 0.

References
----------
Simoncelli, Freeman 1995, doi:10.1109/ICIP.1995.537667.
Portilla, Simoncelli 2000, doi:10.1023/A:1026553619983 (the filters).
"""

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from model.arrays import Float64Array, FloatArray, Int64Array
from model.checks import Checks
from model.texture_statistics import pyramid_kernels

LEVELS, ORIENTATIONS = 7, 4
"""Levels, and filters per level (Weyrich et al. 2006, section 10.2)."""
_CHUNK_ROWS = 128


class PyramidError(ValueError):
    """Error for an image, a depth or a set of responses that do not make a pyramid."""


@dataclass(frozen=True, slots=True, eq=False)
class Responses:
    """All responses of one image."""

    shape: tuple[int, int]
    """(H, W) of the image."""
    high: FloatArray
    """(H, W): high-pass above the first level."""
    bands: tuple[FloatArray, ...]
    """(K, h, w) per level, finest first. Orientation k responds to waves that run at the angle
    k pi / K from +x (columns) towards +y (down the rows)."""
    low: FloatArray
    """(h, w): low-pass below the last level, including the mean."""

    def __post_init__(self) -> None:
        """Check that every response has the size of its level."""
        expected = [self.shape]
        expected += [_size(self.shape, level) for level in range(len(self.bands))]
        expected += [_size(self.shape, len(self.bands))]
        got = [self.high.shape, *(band.shape[1:] for band in self.bands), self.low.shape]
        if not self.bands or got != expected or len({len(band) for band in self.bands}) != 1:
            raise PyramidError(f"Responses: got sizes {got}, expected {expected} for {self.shape}")
        kinds = {r.dtype for r in (self.high, *self.bands, self.low)}
        if len(kinds) != 1 or not kinds <= {np.dtype(np.float32), np.dtype(np.float64)}:
            raise PyramidError(f"Responses: got {kinds}, expected all float32 or all float64")

    def __iter__(self) -> Iterator[FloatArray]:
        """Yield the responses: high-pass, bands by level and orientation, low-pass."""
        yield self.high
        for band in self.bands:
            yield from band
        yield self.low


@dataclass(frozen=True, slots=True, eq=False)
class _Level:
    """Position of a level in the spectrum, and its filter."""

    rows: Int64Array
    columns: int
    size: tuple[int, int]
    fy: FloatArray
    fx: FloatArray
    weight: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Filters:
    high: FloatArray
    levels: tuple[_Level, ...]
    low: _Level
    toward: FloatArray
    factor: Any


def analyze(
    image: ArrayLike,
    *,
    levels: int = LEVELS,
    orientations: int = ORIENTATIONS,
    workers: int | None = None,
) -> Responses:
    """Filter an image into its responses.

    Parameters
    ----------
    image : array_like, shape (H, W)
        Finite; float64 is filtered in float64, everything else in float32.
    levels, orientations : int
        At least 1 each; levels x orientations + 2 responses.
    workers : int or None
        Threads; None: one per core, 4 at most.

    Returns
    -------
    Responses
        In the unit and precision of the image.

    Raises
    ------
    PyramidError
        For an image that is not (H, W), empty or not finite, and for counts below 1.

    Examples
    --------
    >>> stripes = np.tile([1.0, 0.0, -1.0, 0.0], (8, 2))
    >>> found = analyze(stripes, levels=2)
    >>> [round(float(np.abs(band).max()), 3) for band in found.bands[0]]
    [0.894, 0.316, 0.0, 0.316]
    >>> bool(np.abs(synthesize(found) - stripes).max() < 1e-15)
    True
    """
    values = np.asarray(image)
    values = np.ascontiguousarray(values, np.float64 if values.dtype == np.float64 else np.float32)
    Checks(PyramidError).shape("image", values, ("H", "W"))
    Checks(PyramidError).within("levels", levels, "[1, inf)")
    Checks(PyramidError).within("orientations", orientations, "[1, inf)")
    Checks(PyramidError).within("image (fill others first)", values)
    shape = (values.shape[0], values.shape[1])
    threads = thread_count(workers)
    filters = _filters(shape, levels, orientations, values.dtype.str)
    spectrum = fft.rfft2(values, norm="forward", workers=threads)

    bands = []
    with ThreadPoolExecutor(threads) as pool:
        for level in filters.levels:
            part = np.empty((orientations, *level.weight.shape), spectrum.dtype)
            _by_rows(pool, pyramid_kernels.split, level, spectrum, part, filters, filters.factor)
            bands.append(_inverse(part, level.size, threads))
    low = filters.low
    return Responses(
        shape,
        _inverse(spectrum * filters.high, shape, threads),
        tuple(bands),
        _inverse(spectrum[low.rows, : low.columns] * low.weight, low.size, threads),
    )


def synthesize(responses: Responses, *, workers: int | None = None) -> FloatArray:
    """Reconstruct an image from responses, edited or not.

    Parameters
    ----------
    responses
        Result of `analyze`.
    workers : int or None
        Threads; None: one per core, 4 at most.

    Returns
    -------
    ndarray, shape (H, W)
        In the precision of the responses. From unedited responses it is the original image, to
        about 1e-6 (float32) or 1e-15 (float64) of its largest value.
    """
    shape, threads = responses.shape, thread_count(workers)
    orientations = len(responses.bands[0])
    filters = _filters(shape, len(responses.bands), orientations, responses.high.dtype.str)

    def forth(response: FloatArray) -> Any:
        return fft.rfft2(response, norm="forward", workers=threads)

    spectrum = forth(responses.high)
    spectrum *= filters.high
    low = filters.low
    spectrum[low.rows, : low.columns] += forth(responses.low) * low.weight
    with ThreadPoolExecutor(threads) as pool:
        for level, band in zip(filters.levels, responses.bands, strict=True):
            part = forth(band)
            phase = np.conj(filters.factor)
            _by_rows(pool, pyramid_kernels.merge, level, part, spectrum, filters, phase)
    return _inverse(spectrum, shape, threads)


def _inverse(spectra: Any, size: tuple[int, int], threads: int) -> FloatArray:
    """Return the images of half spectra, which are overwritten."""
    columns = fft.ifft(spectra, axis=-2, norm="forward", workers=threads, overwrite_x=True)
    return np.asarray(fft.irfft(columns, n=size[1], axis=-1, norm="forward", workers=threads))


def thread_count(workers: int | None) -> int:
    """Return the number of threads: the requested one, or one per core and 4 at most."""
    if workers is None:
        return min(4, os.cpu_count() or 1)
    Checks(PyramidError).within("workers", workers, "[1, inf)")
    return workers


def level_sizes(shape: tuple[int, int], levels: int = LEVELS) -> tuple[tuple[int, int], ...]:
    """Return the sizes of all levels and, last, of the low-pass.

    Examples
    --------
    >>> level_sizes((10, 1), 3)
    ((10, 1), (5, 1), (3, 1), (2, 1))
    """
    return tuple(_size(shape, level) for level in range(levels + 1))


def _size(shape: tuple[int, int], level: int) -> tuple[int, int]:
    return -(-shape[0] // 2**level), -(-shape[1] // 2**level)


def _by_rows(
    pool: ThreadPoolExecutor,
    kernel: Callable[..., None],
    level: _Level,
    source: Any,
    out: Any,
    filters: _Filters,
    factor: Any,
) -> None:
    """Run a kernel over a level's rows in threads, each writing its own rows."""
    common = (level.rows, level.weight, level.fy, level.fx, filters.toward, factor, out)
    height = len(level.rows)
    if height <= _CHUNK_ROWS:
        kernel(source, *common, 0, height)
        return
    jobs = [
        pool.submit(kernel, source, *common, begin, min(begin + _CHUNK_ROWS, height))
        for begin in range(0, height, _CHUNK_ROWS)
    ]
    for job in jobs:
        job.result()


@lru_cache(maxsize=4)
def _filters(shape: tuple[int, int], levels: int, orientations: int, kind: str) -> _Filters:
    """Make the filters of an image size; they are the same for all images."""
    order = orientations - 1
    # the squares of cos^order at K even angles sum to a constant (K > order); divide by it
    level_gain = math.sqrt(
        4.0**order * math.factorial(order) ** 2 / (orientations * math.factorial(2 * order))
    )
    angle = np.pi * np.arange(orientations) / orientations
    toward = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    made = []
    for number in range(levels + 1):
        level = _make_level(shape, number)
        log_radius = _log_radius(level)
        lower = np.cos(0.5 * np.pi * np.clip(log_radius + number + 1.0, 0.0, 1.0))
        if number < levels:
            upper = np.sin(0.5 * np.pi * np.clip(log_radius + number + 2.0, 0.0, 1.0))
            radius = np.exp2(np.maximum(log_radius, -60.0))
            lower = level_gain * lower * upper / radius**order
        fy, fx, weight = (a.astype(kind) for a in (level.fy, level.fx, lower))
        made.append(_Level(level.rows, level.columns, level.size, fy, fx, weight))
    high = np.sin(0.5 * np.pi * np.clip(_log_radius(_make_level(shape, 0)) + 1.0, 0.0, 1.0))
    complex_kind = np.result_type(kind, np.complex64).type
    return _Filters(
        high.astype(kind),
        tuple(made[:-1]),
        made[-1],
        toward.astype(kind),
        complex_kind((-1j) ** order),
    )


def _make_level(shape: tuple[int, int], number: int) -> _Level:
    """Return the positions of a level's low frequencies, with an empty filter."""
    height, width = size = _size(shape, number)
    # signed frequencies of the level's rows, in cycles per image, and their rows in the spectrum
    cycles = np.rint(np.fft.fftfreq(height) * height).astype(np.int64)
    columns = width // 2 + 1
    fy, fx = 2.0 * cycles / shape[0], 2.0 * np.arange(columns) / shape[1]
    return _Level(cycles % shape[0], columns, size, fy, fx, np.empty(0))


def _log_radius(level: _Level) -> Float64Array:
    """Return log2 of the radius, 0 at the Nyquist frequency of the image; -inf at the mean."""
    with np.errstate(divide="ignore"):
        return np.asarray(np.log2(np.hypot(level.fy[:, None], level.fx[None, :])))
