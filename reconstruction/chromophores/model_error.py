"""Model error of skin colors, and the distribution of light on faces.

Apart from noise, three errors separate a pixel's color from the model's color of its chromophores:

- the layered model is not full light transport (`ColorErrors.transport`);
- the sites of a color filter array sample different positions, so that structure finer than a pixel
  appears as color. Its amount is estimated per image from differences between neighboring pixels
  after smooth parts are removed, so it follows skin and resolution (`ColorErrors.fine`);
- in hollows, interreflection adds light with the color of skin. It increases with the skin's
  reflectance (`ColorErrors.interreflection`).

All are relative errors of white-balanced camera RGB, fitted on simulated subjects of seeds 0 to 19
at two resolutions by ``tools/fit_model_error.py``; evaluate them on other seeds.
"""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.chromophores.pixel_checks import ChromophoreError

DEFAULT_RELATIVE_NOISE = 0.01
"""Relative noise of each channel that is assumed when no variance is given."""
MODEL_ERROR_FILE = "data/chromophore_model_error.json"


FOURTH_DIFFERENCE: Final = np.array([1.0, -4.0, 6.0, -4.0, 1.0]) / 6.0
"""Fourth differences, 1 at the middle: a cubic over 5 pixels gives 0."""
STRUCTURE_WINDOW_PX: Final = 1.5
"""Standard deviation of the window that averages squared differences, px."""
_WINDOW_REACH_PX: Final = int(4.0 * STRUCTURE_WINDOW_PX + 0.5)
_BAND_PIXELS: Final = 1 << 16


@dataclass(frozen=True, slots=True, eq=False)
class ColorErrors:
    """Terms of the relative error of a pixel's color."""

    transport: Float64Array
    """(3, 3): covariance common to all pixels."""
    fine: Float64Array
    """(3, 3): covariance over the mean square of fine structure."""
    interreflection: float
    """Standard deviation of the interreflected light over a pixel's light and reflectance; light is
    relative to a white reference."""


@dataclass(frozen=True, slots=True)
class ShadingHistogram:
    """Counts in bins of equal width."""

    low: float
    """Lower edge of the first bin."""
    step: float
    """Width of a bin."""
    counts: tuple[int, ...]
    """Number of pixels per bin."""


@lru_cache(maxsize=1)
def load_covariance() -> Float64Array:
    """Return the covariance of log color that the model leaves unexplained, (3, 3), of all pixels.

    Use it without an image; with one, `image_covariance` adds its fine structure. The logarithm is
    of white-balanced camera RGB, the difference between the table's color of the true chromophores
    and a noise-free capture. It is scaled so that, with noise, 68 % of errors are inside the 68 %
    ellipse.
    """
    return np.array(_document()["log_covariance"], np.float64)


@lru_cache(maxsize=1)
def load_error_terms() -> ColorErrors:
    """Load the terms of a pixel's error from the data file."""
    found = _document()["by_picture"]
    return ColorErrors(
        np.array(found["transport"], np.float64),
        np.array(found["fine"], np.float64),
        float(found["bounced"]),
    )


def image_covariance(
    rgb: FloatArray, variance: FloatArray, valid: BoolArray, *, errors: ColorErrors | None = None
) -> Float64Array:
    """Return the covariance of each pixel's relative error without noise, (H, W, 3, 3).

    Parameters
    ----------
    rgb
        (H, W, 3): diffuse reflectance, white-balanced linear camera RGB, a white reference is 1.
    variance
        (H, W, 3): variance of its noise, which is subtracted from the structure.
    valid
        (H, W): pixels of skin; others are ignored and get the transport term alone.
    errors
        Error terms; None: those of the data file.

    Notes
    -----
    The brightness part common to the channels is omitted, because shading leaves it free.

    Examples
    --------
    >>> even = np.full((9, 9, 3), [0.5, 0.3, 0.2])
    >>> found = image_covariance(even, 0.0 * even, np.ones((9, 9), bool))
    >>> found.shape, bool(np.ptp(found[..., 0, 0]) < 1e-12)
    ((9, 9, 3, 3), True)
    """
    terms = load_error_terms() if errors is None else errors
    structure = fine_structure(rgb, variance, usable_pixels(rgb, valid, variance))
    covariance = np.empty((*valid.shape, 3, 3))
    for rows in _bands(valid.shape):
        here = usable_pixels(rgb[rows], valid[rows], variance[rows])
        color = np.where(here[..., None], rgb[rows], 0.0).astype(np.float64)
        color -= color.mean(axis=-1, keepdims=True)
        color *= terms.interreflection
        covariance[rows] = terms.transport + structure[rows][..., None, None] * terms.fine
        covariance[rows] += color[..., :, None] * color[..., None, :]
    return covariance


def _bands(shape: tuple[int, ...]) -> Iterator[slice]:
    """Yield bands of rows: copies of a whole image need gigabytes."""
    count = max(1, _BAND_PIXELS // max(shape[1], 1))
    for start in range(0, shape[0], count):
        yield slice(start, min(start + count, shape[0]))


def _with_rim(rows: slice, rim: int, height: int) -> tuple[slice, slice]:
    """Return a band with `rim` more rows on either side, and the band's position in it."""
    first = max(rows.start - rim, 0)
    return slice(first, min(rows.stop + rim, height)), slice(rows.start - first, rows.stop - first)


def usable_pixels(
    rgb: FloatArray, valid: BoolArray, variance: FloatArray | None = None
) -> BoolArray:
    """Return where the logarithm of the color and the noise are finite, (H, W).

    Parameters
    ----------
    rgb, valid, variance
        See `image_covariance`; without a variance noise is not checked. One pixel with undefined
        relative noise would invalidate the average of its whole neighborhood.
    """
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        good = valid & np.isfinite(rgb).all(axis=-1) & (rgb > 0.0).all(axis=-1)
        if variance is not None:
            good &= np.isfinite(variance / np.square(rgb)).all(axis=-1)
    return np.asarray(good)


def fine_structure(rgb: FloatArray, variance: FloatArray, valid: BoolArray) -> Float64Array:
    """Return the mean square of log color's fourth differences around each pixel, (H, W).

    Parameters
    ----------
    rgb, variance, valid
        As of `image_covariance`; rgb is positive where valid.

    Returns
    -------
    ndarray of float64
        Mean over the channels and over both directions, minus the noise's part, not below 0; the
        image's mean where five valid pixels in a row are not near; 0 where not valid.

    Examples
    --------
    >>> rows = np.arange(12.0)[:, None, None]
    >>> smooth = np.exp(-0.1 * rows + 0.01 * rows**2) * np.ones((12, 12, 3))
    >>> bool(fine_structure(smooth, 0.0 * smooth, np.ones((12, 12), bool)).max() < 1e-24)
    True
    """
    reach = FOURTH_DIFFERENCE.size // 2
    squares, count = np.empty(valid.shape), np.empty(valid.shape, np.uint8)
    for rows in _bands(valid.shape):
        wide, own = _with_rim(rows, reach, valid.shape[0])
        found = _squared_differences(rgb[wide], variance[wide], valid[wide])
        squares[rows], count[rows] = found[0][own], found[1][own]
    total = count.sum()
    usual = squares.sum() / total if total else 0.0
    structure = np.empty(valid.shape)
    for rows in _bands(valid.shape):
        wide, own = _with_rim(rows, _WINDOW_REACH_PX, valid.shape[0])
        around = gaussian_filter(
            count[wide].astype(np.float64), STRUCTURE_WINDOW_PX, mode="constant"
        )[own]
        known = around > 1e-6
        mean = gaussian_filter(squares[wide], STRUCTURE_WINDOW_PX, mode="constant")[own]
        mean = np.where(known, mean / np.where(known, around, 1.0), usual)
        structure[rows] = np.where(valid[rows], np.maximum(mean, 0.0), 0.0)
    return structure


def _squared_differences(
    rgb: FloatArray, variance: FloatArray, valid: BoolArray
) -> tuple[Float64Array, Float64Array]:
    """Return the sum of log color's squared fourth differences over both axes, and their count."""
    # noise of variance v in log color adds sum_k w_k^2 v to a squared difference of weights w_k
    safe = np.where(valid[..., None], rgb, 1.0).astype(np.float64)
    log_rgb = np.log(safe)
    noise = np.where(valid, (variance / safe**2).mean(axis=-1), 0.0)
    squares, count = np.zeros(valid.shape), np.zeros(valid.shape)
    reach = FOURTH_DIFFERENCE.size // 2
    for axis in (0, 1):
        length = valid.shape[axis] - 2 * reach
        if length <= 0:
            continue
        parts = [
            tuple(slice(k, k + length) if a == axis else slice(None) for a in (0, 1))
            for k in range(FOURTH_DIFFERENCE.size)
        ]
        step = sum(
            weight * log_rgb[part] for weight, part in zip(FOURTH_DIFFERENCE, parts, strict=True)
        )
        noise_here = sum(
            w**2 * noise[part] for w, part in zip(FOURTH_DIFFERENCE, parts, strict=True)
        )
        whole = np.logical_and.reduce([valid[part] for part in parts])
        here = parts[reach]
        squares[here] += np.where(whole, np.mean(np.square(step), axis=-1) - noise_here, 0.0)
        count[here] += whole
    return squares, count


def load_shading_histogram() -> ShadingHistogram:
    """Load the histogram of log shading over the skin of the same subjects."""
    found = _document()["log_shading"]
    return ShadingHistogram(
        float(found["low"]), float(found["step"]), tuple(map(int, found["counts"]))
    )


def data_hash() -> dict[str, str]:
    """Return the hash of the data file, for the parameters of a stage."""
    text = json.dumps(_document(), sort_keys=True)
    return {"model_error": hashlib.sha256(text.encode("utf-8")).hexdigest()}


def _document() -> dict[str, Any]:
    text = resources.files("reconstruction").joinpath(MODEL_ERROR_FILE).read_text(encoding="utf-8")
    found: dict[str, Any] = json.loads(text)
    return found


def model_covariance(model_error: ArrayLike | None, default_noise: bool) -> Float64Array:
    """Return the (3, 3) covariance of relative errors that `invert` adds to the noise.

    Parameters
    ----------
    model_error
        None, a relative standard error, one per channel, or a covariance.
    default_noise
        Whether to add the 1 percent that replaces an unknown variance.
    """
    error = np.zeros(3) if model_error is None else np.asarray(model_error, dtype=np.float64)
    check = Checks(ChromophoreError)
    check.numbers("model_error", error, (), (3,), (3, 3))
    covariance = error
    if error.ndim < 2:
        check.within("model_error", error, "[0, inf)")
        covariance = np.diag(np.broadcast_to(error, (3,)) ** 2)
    least = np.linalg.eigvalsh(covariance).min()
    good = np.allclose(covariance, covariance.T) and least >= -1e-12
    check.require(good, "model_error", covariance, "symmetric, eigenvalues >= 0; correct it")
    # The floor, single precision of the colors themselves, keeps the weights finite.
    floor = DEFAULT_RELATIVE_NOISE**2 if default_noise else 1e-12
    return np.asarray(covariance + floor * np.eye(3))


def add_brightness_variance(covariance: Float64Array) -> Float64Array:
    """Add brightness variance to a covariance whose weights have brightness projected out.

    The added variance cancels in those weights. A covariance without it is singular, and its
    inverse would lose all digits.

    Parameters
    ----------
    covariance
        (..., 3, 3), of relative errors.
    """
    common = np.trace(covariance, axis1=-2, axis2=-1) / 3.0 + 1e-6
    return np.asarray(covariance + common[..., None, None])
