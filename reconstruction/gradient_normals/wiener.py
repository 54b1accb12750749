"""Filter moments by the fraction of signal at each spatial frequency.

A lens passes no detail beyond its diffraction limit, and a relief has little at most frequencies;
white noise has equal power at all. With the noise known, the spectrum of a moment's image gives the
fraction of signal at each frequency, which is the Wiener filter (Wiener 1949).
"""

from collections.abc import Callable

import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter, uniform_filter

from reconstruction.arrays import BoolArray, FloatArray

PAD_PX = 24
"""Mirrored border, so that opposite sides of an image do not mix."""
SPECTRUM_BANDS = 64
"""Number of bands over the spectrum's width, within which it is averaged."""

Gain = Callable[[FloatArray, FloatArray], FloatArray]
"""Factor of each wave, by its cycles per pixel along x and y, which broadcast; 1 at zero."""


def filter_image(
    image: FloatArray, variance: float, valid: BoolArray, gain: Gain | None = None
) -> tuple[FloatArray, float]:
    """Filter an image to its most probable signal; return it with its remaining error.

    Parameters
    ----------
    image : ndarray, shape (H, W)
        Signal and white noise; not read where not valid.
    variance : float
        Mean variance of the noise over the image.
    valid : ndarray of bool, shape (H, W)
    gain : Gain, optional
        Inverse of what weakened the signal before the noise was added, to be undone; 0 where a wave
        is lost. None: 1 everywhere.

    Returns
    -------
    picture : ndarray, shape (H, W)
        Mirrored or smoothed from its neighbors where not valid.
    share : float
        Mean square error of `picture` over `variance`, of remaining noise and lost signal
        together, >= 0; without `gain` at most 1. Waves that the gain omits do not count.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> found, share = filter_image(rng.standard_normal((64, 64)), 1.0, np.ones((64, 64), bool))
    >>> bool(found.std() < 0.2 and share < 0.1)
    True
    """
    if not valid.any():
        return image, 1.0
    kind = image.dtype
    mean = float(image[valid].mean(dtype=np.float64))
    flat = np.where(valid, image - kind.type(mean), kind.type(0.0))
    if not valid.all():
        near = gaussian_filter(valid.astype(np.float64), 2.0)
        around = gaussian_filter(flat.astype(np.float64), 2.0) / np.maximum(near, 1e-3)
        flat = np.where(valid, flat, around).astype(kind)
    height, width = flat.shape
    pads = [_pads(side) for side in (height, width)]
    wide = np.pad(flat, pads, mode="symmetric")
    window = np.outer(*(np.hanning(side).astype(kind) for side in wide.shape))
    power = np.abs(fft.rfft2(wide * window)) ** 2 / float(np.sum(window.astype(np.float64) ** 2))
    power = _averaged(power.astype(np.float64), wide.shape)
    keep = np.maximum(power - variance, 0.0) / np.maximum(power, 1e-300)
    most, error = 1.0, keep
    if gain is not None:
        factor = gain(fft.rfftfreq(wide.shape[1])[None], fft.fftfreq(wide.shape[0])[:, None])
        most, error = float(np.max(factor)) ** 2, keep * factor**2
        keep = keep * factor
    # the mean is kept whole, with its own noise
    share = min(_full_mean(error, wide.shape[1]) + 1.0 / float(valid.sum()), most)
    out = fft.irfft2(fft.rfft2(wide) * keep.astype(kind), s=wide.shape)
    (top, _), (left, _) = pads
    inner = out[top : top + height, left : left + width]
    return np.asarray(inner + mean, kind), share


def _pads(side: int) -> tuple[int, int]:
    total = fft.next_fast_len(side + 2 * min(PAD_PX, side), real=True) - side
    return total // 2, total - total // 2


def _averaged(power: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Average the half spectrum of a real image over bands of frequencies, periodically."""
    rows, columns = (max(3, side // SPECTRUM_BANDS) | 1 for side in shape)
    half = columns
    # the missing half is the other one's mirror image, with its rows reversed
    turned = np.roll(power[::-1], 1, axis=0)
    last = power.shape[1] - 1 if shape[1] % 2 == 0 else power.shape[1]
    left = turned[:, half:0:-1]
    right = turned[:, last - 1 : last - 1 - half : -1]
    whole = np.concatenate([left, power, right], axis=1)
    for _ in range(2):
        whole = uniform_filter(whole, (2 * rows + 1, 2 * columns + 1), mode=("wrap", "nearest"))
    return np.asarray(whole[:, half : half + power.shape[1]])


def _full_mean(half: FloatArray, width: int) -> float:
    """Return the mean over the whole spectrum from its stored half."""
    weight = np.full(half.shape[1], 2.0)
    weight[0] = 1.0
    if width % 2 == 0:
        weight[-1] = 1.0
    return float((half.mean(axis=0) @ weight) / weight.sum())
