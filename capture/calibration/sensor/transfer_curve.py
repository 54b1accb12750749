"""Photon transfer curve: temporal variance against mean signal, in blocks of one CFA color.

The difference of two frames of the same scene contains no fixed pattern, so its variance grows
linearly with the mean signal even where the flat field is not flat: ``variance = V0 + K signal``
[DN^2, DN], with ``1/K`` the gain in electrons per DN.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from capture.arrays import BoolArray, Float64Array, UInt16Array
from capture.calibration.record import CalibrationError

LOW_SIGNAL_LEVEL = 0.4  # of the white level: below it nothing saturates in a usable sensor
# variance over its prediction below which a block counts as saturated
SATURATED_VARIANCE_RATIO = 0.5
# smallest distance of a usable block to saturation, in standard deviations
SATURATION_CLIP_SIGMAS = 6.0
PIXEL_RESPONSE_STD = 0.02  # pixel-to-pixel variation of sensitivity allowed for in that distance


class PhotonTransferError(CalibrationError):
    """Raised for frames without a photon transfer fit; the message states what to take."""


@dataclass(frozen=True, slots=True)
class FlatPair:
    """Two frames of the same evenly lit target under the same light.

    Attributes
    ----------
    first, second : ndarray of uint16, shape (H, W)
        Raw CFA frames in DN.
    light : float
        Relative amount of light (flash power times exposure time, when it varies), > 0.
    """

    first: UInt16Array
    second: UInt16Array
    light: float

    def __post_init__(self) -> None:
        """Check shapes and the amount of light."""
        if self.first.ndim != 2 or self.first.shape != self.second.shape:
            raise ValueError(
                f"FlatPair: got frames of shapes {self.first.shape} and {self.second.shape},"
                " expected two of one shape (H, W)"
            )
        if not (np.isfinite(self.light) and self.light > 0):
            raise ValueError(f"FlatPair.light: got {self.light}, expected > 0")


@dataclass(frozen=True, slots=True)
class BlockStatistics:
    """Statistics of one pair in blocks of one CFA position.

    Attributes
    ----------
    signal : ndarray of float64, shape (B,)
        Abscissa of the photon transfer curve, DN above black.
    variance : ndarray of float64, shape (B,)
        Temporal variance of one frame, DN^2.
    dof : ndarray of float64, shape (B,)
        Degrees of freedom of each variance.
    clipped : ndarray of bool, shape (B,)
        Blocks with pixels at the white level.
    ratio : float
        Light of the first frame over that of the second.
    """

    signal: Float64Array
    variance: Float64Array
    dof: Float64Array
    clipped: BoolArray
    ratio: float


@dataclass(frozen=True, slots=True)
class TransferCurveFit:
    """Straight photon transfer curve ``variance = offset + slope * signal``.

    Attributes
    ----------
    offset_dn2, slope_dn : float
        Variance without light and its slope.
    covariance : ndarray of float64, shape (2, 2)
        Covariance of (offset, slope), scaled by the scatter when that exceeds the expectation.
    chi2_per_dof : float
        Scatter around the line over its expectation.
    saturation_dn : float
        Signal above black at which pixels saturate.
    saturated_by : {"full well", "white level", "not reached"}
        Cause of the limit; "not reached": ``saturation_dn`` is the white level above black.
    points : int
        Number of blocks used.
    """

    offset_dn2: float
    slope_dn: float
    covariance: Float64Array
    chi2_per_dof: float
    saturation_dn: float
    saturated_by: str
    points: int


def cfa_offsets(pattern: str) -> dict[str, tuple[tuple[int, int], ...]]:
    """Return the (row, column) offsets of each color in a 2 x 2 pattern.

    Parameters
    ----------
    pattern : str
        ``"RGGB"`` and its shifts, row-major, or ``"MONO"``.

    Examples
    --------
    >>> cfa_offsets("RGGB")
    {'R': ((0, 0),), 'G': ((0, 1), (1, 0)), 'B': ((1, 1),)}
    >>> cfa_offsets("MONO")
    {'MONO': ((0, 0),)}
    """
    if pattern == "MONO":
        return {"MONO": ((0, 0),)}
    if sorted(pattern) != ["B", "G", "G", "R"]:
        raise ValueError(f"pattern: got {pattern!r}, expected RGGB, BGGR, GRBG, GBRG or MONO")
    return {
        color: tuple(divmod(i, 2) for i, c in enumerate(pattern) if c == color) for color in "RGB"
    }


def extract_cfa_plane(frame: NDArray, position: tuple[int, int], pattern: str) -> Float64Array:
    """Return the pixels of one CFA position as float64, shape (H/2, W/2) (or all, for MONO)."""
    step = 1 if pattern == "MONO" else 2
    return np.asarray(frame[position[0] :: step, position[1] :: step], dtype=np.float64)


def block_sums(image: Float64Array, size: int) -> Float64Array:
    """Sum an image over whole blocks of `size` x `size`, shape (H // size, W // size)."""
    rows, columns = image.shape[0] // size, image.shape[1] // size
    return (
        image[: rows * size, : columns * size].reshape(rows, size, columns, size).sum(axis=(1, 3))
    )


def block_statistics(
    first: Float64Array,
    second: Float64Array,
    *,
    black_dn: float,
    white_dn: float,
    good: BoolArray,
    block: int,
) -> BlockStatistics:
    """Reduce a pair of planes to signal and temporal variance in blocks.

    The second frame is scaled to the light of the first (flashes repeat to about a percent), which
    changes the abscissa: with ``r`` the ratio, ``var(A - r B) / (1 + r^2) = V0 + K s_A (1 + r) / (1
    + r^2)``.

    Parameters
    ----------
    first, second : ndarray of float64, shape (h, w)
        One CFA position of each frame, DN.
    black_dn, white_dn : float
        Levels in DN.
    good : ndarray of bool, shape (h, w)
        Pixels to use.
    block : int
        Block side in pixels of the plane.

    Returns
    -------
    Blocks
    """
    a, b = first - black_dn, second - black_dn
    at_white = (first >= white_dn) | (second >= white_dn)
    usable = good & ~at_white
    ratio = float(a[usable].sum() / b[usable].sum()) if usable.any() else 1.0
    if not (np.isfinite(ratio) and 0.5 < ratio < 2.0):
        raise PhotonTransferError(
            f"flat pair: the frames differ by a factor {ratio:.3g} in light, expected the same"
            " light twice; take the pair again"
        )
    weight = good.astype(np.float64)
    n = block_sums(weight, block)
    n = np.maximum(n, 1.0)
    # Shot noise gives var A = V0 + K s_A and var B = V0 + K s_A / r; hence var(A - r B) = (1 + r^2)
    # V0 + (1 + r) K s_A, and the mean of (A + r B) / 2 estimates s_A.
    mean = block_sums(weight * (a + ratio * b) / 2.0, block) / n
    d = (a - ratio * b) * weight
    d_sum = block_sums(d, block)
    d_variance = (block_sums(d * d, block) - d_sum**2 / n) / np.maximum(n - 1.0, 1.0)
    scale = 1.0 + ratio**2
    enough = n >= block * block / 2
    return BlockStatistics(
        signal=(mean * (1.0 + ratio) / scale)[enough],
        variance=(d_variance / scale)[enough],
        dof=(n - 1.0)[enough],
        clipped=(block_sums((at_white & good).astype(np.float64), block) > 0)[enough],
        ratio=ratio,
    )


def _weighted_line(
    x: Float64Array, y: Float64Array, dof: Float64Array
) -> tuple[Float64Array, Float64Array, float]:
    """Fit y = c0 + c1 x with relative errors sqrt(2/dof) of y; return fit, covariance, chi2/dof.

    The weights are those of the fitted line, not of the scattered values, which would bias it low.
    """
    design = np.stack([np.ones_like(x), x], axis=1)
    # A sample variance with dof degrees of freedom has the variance 2 y^2 / dof.
    predicted = np.full_like(y, y.mean())
    for _ in range(6):
        weight = dof / (2.0 * predicted**2)
        normal = design.T @ (design * weight[:, None])
        coefficients = np.linalg.solve(normal, design.T @ (weight * y))
        predicted = np.maximum(design @ coefficients, 0.05 * y.max() / max(x.size, 20))
    chi2 = float((weight * (y - design @ coefficients) ** 2).sum() / max(x.size - 2, 1))
    return (
        np.asarray(coefficients, dtype=np.float64),
        np.linalg.inv(normal).astype(np.float64),
        chi2,
    )


def fit_transfer_curve(
    levels: Sequence[BlockStatistics], *, dark_variance_dn2: float, dark_dof: float, range_dn: float
) -> TransferCurveFit:
    """Fit the photon transfer line to blocks below saturation and the dark frames.

    Saturation is the signal at which the variance collapses (full well of the pixels) or at which
    pixels reach the white level, whichever is lower.

    Parameters
    ----------
    levels : sequence of Blocks
        Blocks of one color, any number of pairs and CFA positions.
    dark_variance_dn2, dark_dof : float
        Temporal variance of the dark frames and its degrees of freedom.
    range_dn : float
        White level minus black level.

    Returns
    -------
    CurveFit

    Raises
    ------
    PhotonTransferError
        If too few blocks are below saturation or the variance does not grow with the signal.
    """
    x = np.concatenate([b.signal for b in levels])
    y = np.concatenate([b.variance for b in levels])
    dof = np.concatenate([b.dof for b in levels])
    clipped = np.concatenate([b.clipped for b in levels])

    def fit(chosen: BoolArray) -> tuple[Float64Array, Float64Array, float]:
        if chosen.sum() < 4 or np.ptp(x[chosen]) < 0.05 * range_dn:
            raise PhotonTransferError(
                f"photon transfer: {int(chosen.sum())} blocks below saturation, spanning"
                f" {np.ptp(x[chosen]) if chosen.any() else 0.0:.0f} DN of {range_dn:.0f};"
                " take flats at 8 or more levels from 5 % to 90 % of the range"
            )
        if not dark_variance_dn2 > 0 and not y[chosen].any():
            raise PhotonTransferError(
                "photon transfer: the frames of the pairs are identical and contain no noise; "
                "give two separate raw frames per level"
            )
        return _weighted_line(
            np.append(x[chosen], 0.0),
            np.append(y[chosen], dark_variance_dn2),
            np.append(dof[chosen], dark_dof),
        )

    line, covariance, chi2 = fit((x < LOW_SIGNAL_LEVEL * range_dn) & ~clipped)
    if line[1] <= 0 or line[1] < 3.0 * np.sqrt(covariance[1, 1]):
        raise PhotonTransferError(
            f"photon transfer: the variance does not grow with the signal (slope {line[1]:.3g} DN);"
            " the frames were processed, or the darks and flats are not of this camera"
        )
    predicted = line[0] + line[1] * x
    collapsed = (
        (y < SATURATED_VARIANCE_RATIO * predicted) & (x > LOW_SIGNAL_LEVEL * range_dn) & ~clipped
    )
    saturation, by = range_dn, "white level" if clipped.any() else "not reached"
    if collapsed.sum() >= 3:
        saturation, by = float(np.median(x[collapsed])), "full well"
    room = SATURATION_CLIP_SIGMAS * np.sqrt(
        np.maximum(predicted, 0.0) + (PIXEL_RESPONSE_STD * x) ** 2
    )
    line, covariance, chi2 = fit((x + room < saturation) & ~clipped)
    return TransferCurveFit(
        offset_dn2=float(line[0]),
        slope_dn=float(line[1]),
        covariance=covariance * max(chi2, 1.0),
        chi2_per_dof=chi2,
        saturation_dn=saturation,
        saturated_by=by,
        points=int(((x + room < saturation) & ~clipped).sum()) + 1,
    )
