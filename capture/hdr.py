"""Brackets of exposures merged to linear radiance with its variance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.documents import Checks, InputError

__all__ = ["BracketError", "merge"]

_STEPS = 4  # the weights change by less than 1e-3 after two


class BracketError(InputError):
    """Frames that cannot be merged."""


def merge(
    frames: Sequence[NDArray[np.integer]] | NDArray[np.integer],
    exposures_s: ArrayLike,
    *,
    gain: float,
    read_noise: float,
    black: float,
    white: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Merge raw frames of one scene at several exposure times with noise-optimal weights.

    Parameters
    ----------
    frames : sequence of N arrays of integers, shape (H, W) or (H, W, C)
        Raw DN of one camera, nothing subtracted; the scene and the light do not change.
    exposures_s : array_like, shape (N,)
        Exposure times, s.
    gain : float
        Electrons per DN.
    read_noise : float
        Electrons rms, of one frame.
    black, white : float
        Levels in DN; values from `white` on are saturated and left out.

    Returns
    -------
    radiance : ndarray of float32, shape (H, W[, C])
        DN above black per second; negative values are kept; NaN where not valid.
    variance : ndarray of float32, shape (H, W[, C])
        Of `radiance`; NaN where not valid.
    valid : ndarray of bool, shape (H, W[, C])
        False where every frame is saturated.

    Raises
    ------
    BracketError
        Where shapes, times or levels do not fit.

    Notes
    -----
    The estimate of largest likelihood for shot and read noise: each frame weighs by
    ``t^2 / (radiance t / gain + (read_noise / gain)^2 + 1/12)``, the radiance in it being the
    estimate itself, not the noisy value of the frame, which would favor low readings
    (Granados et al. 2010, doi 10.1109/CVPR.2010.5540208).

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
    floor = (read_noise / gain) ** 2 + 1.0 / 12.0  # DN^2, with the rounding to whole DN
    signal = np.zeros(stack[0].shape)
    time = np.zeros(stack[0].shape)
    for frame, t in zip(stack, times, strict=True):
        usable = frame < white
        signal += np.where(usable, frame.astype(np.float64) - black, 0.0)
        time += np.where(usable, t, 0.0)
    valid = time > 0
    radiance = signal / np.where(valid, time, 1.0)
    total = np.ones(stack[0].shape)
    for _ in range(_STEPS if len(stack) > 1 else 1):
        weighted = np.zeros(stack[0].shape)
        total = np.zeros(stack[0].shape)
        for frame, t in zip(stack, times, strict=True):
            # one frame's weight for its own DN / t is t^2 / variance
            weight = np.where(
                frame < white, t / (np.maximum(radiance, 0.0) * t / gain + floor), 0.0
            )
            weighted += weight * (frame.astype(np.float64) - black)
            total += weight * t
        radiance = weighted / np.where(valid, total, 1.0)
    nothing = np.float32(np.nan)
    return (
        np.where(valid, radiance, nothing).astype(np.float32),
        np.where(valid, 1.0 / np.where(valid, total, 1.0), nothing).astype(np.float32),
        valid,
    )


def _check(
    stack: Sequence[NDArray[np.integer]],
    times: NDArray[np.float64],
    *,
    gain: float,
    read_noise: float,
    black: float,
    white: float,
) -> None:
    checks = Checks("Bracket", BracketError)
    checks.that("frames", len(stack), len(stack) > 0, "at least one frame")
    shapes = sorted({frame.shape for frame in stack})
    checks.that("frames", shapes, len(shapes) <= 1, "frames of one shape")
    whole = all(np.issubdtype(frame.dtype, np.integer) for frame in stack)
    checks.that("frames", [str(f.dtype) for f in stack][:3], whole, "raw DN, whole numbers")
    one_each = times.shape == (len(stack),)
    checks.that("exposures_s", times.shape, one_each, f"{len(stack)} times")
    positive = bool(np.isfinite(times).all() and (times > 0).all())
    checks.that("exposures_s", times.tolist(), positive, "finite seconds > 0")
    checks.positive(gain=gain)
    checks.that("read_noise", read_noise, 0 <= read_noise < np.inf, ">= 0")
    checks.that("white", white, white > black, f"> black {black}")
    checks.close()
