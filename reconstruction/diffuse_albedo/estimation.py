"""Estimate diffuse reflectance R_d from BRDF samples (eq. 6).

The paper takes the least of pi f / (F_t F_t) over a point's samples. The least of noisy samples is
biased low, increasingly with their number. Here the diffuse part is fitted together with a few
white lobes of weights of at least 0: samples far from the mirror direction, where the lobes vanish,
determine it; those below what noise allows are omitted.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 6.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checks import Checks
from model.threads import run_in_blocks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from reconstruction.diffuse_albedo.kernels import MIN_FACTOR_COSINE, fit_envelope
from reconstruction.lumitexels import boundary_kernels

Method = Literal["envelope", "stable_minimum", "minimum"]

NORMAL_STDERR_RAD = np.deg2rad(1.0)
GRAZING_COSINE = 0.3
"""Cosine to the horizon below which the stable minimum penalizes samples (73 degrees)."""
_BLOCK_POINTS = 64
"""Points that a thread fits at least."""
DISCARD_FRACTION = 0.01
"""Fraction that the stable minimum discards if `discard` is None and noise is unknown."""


@dataclass(frozen=True, slots=True)
class DiffuseAlbedo:
    """Diffuse reflectance of surface points.

    Attributes
    ----------
    r_d : ndarray of float64, shape (..., C), or (...) of samples without channels
        R_d of each channel, absolute. Not clamped: a black surface gives small values of either
        sign, an overexposed calibration values above 1. NaN where not `valid`.
    stderr : ndarray of float64, shape of `r_d`
        Standard error of `r_d`; NaN where not `valid`, and where it is unknown (a minimum; up
        to 3 samples of unknown variance).
    valid : ndarray of bool, shape (...)
        False where a channel has no usable sample.
    discarded : ndarray of int64, shape (...)
        Channel values with weight 0 in the end: outliers on either side.
    """

    r_d: Float64Array
    stderr: Float64Array
    valid: BoolArray
    discarded: Int64Array


def estimate(
    brdf_samples: ArrayLike,
    light_dirs: ArrayLike,
    view_dirs: ArrayLike,
    normals: ArrayLike,
    *,
    eta: float,
    variance: ArrayLike | None = None,
    discard: int | None = None,
    valid: ArrayLike | None = None,
    method: Method = "envelope",
    normal_stderr_rad: float = float(NORMAL_STDERR_RAD),
) -> DiffuseAlbedo:
    """Estimate R_d of each point and channel.

    Parameters
    ----------
    brdf_samples
        f_r = L / (E cos), 1/sr, (..., M, C), of a white-balanced camera: a white surface has 1/pi
        in all channels, and highlights the same value in all. Or (..., M), of one channel; the
        normals' shape decides which.
    light_dirs, view_dirs
        Unit vectors (..., M, 3) or broadcast, away from the surface.
    normals
        Unit normals (..., 3), outward; those of samples with channels may be broadcast.
    eta
        Relative refractive index (the paper: about 1.3).
    variance
        Of `brdf_samples`, same shape, > 0. None: one unknown variance for all of a channel.
    discard
        Number of smallest values to discard in each channel. None: those that noise does not
        explain.
    valid
        Samples to use, (..., M) or (..., M, C); None: all that are finite.
    method
        "envelope", or the paper's "stable_minimum" and plain "minimum", for comparison.
    normal_stderr_rad
        Standard error of the normals, rad; it lowers the weight of grazing light.

    Returns
    -------
    DiffuseAlbedo
        Without the channels' axis if the samples have none.

    Raises
    ------
    ValueError
        For shapes that do not fit, a negative `discard` or an unknown method.

    Notes
    -----
    Samples with light or view below 0.05 (cosine) are not used.

    Examples
    --------
    >>> up, f = np.array([0.0, 0.0, 1.0]), np.full(8, 0.2)
    >>> found = estimate(f, up, up, up, eta=1.0)
    >>> found.r_d.shape, round(float(found.r_d), 4)
    ((), 0.6283)
    """
    if discard is not None:
        Checks().within("discard", discard, "[0, inf)")
    Checks().choice("method", method, ("envelope", "stable_minimum", "minimum"))
    samples, lead, gray = _checked(brdf_samples, light_dirs, view_dirs, normals, variance, valid)
    shape = lead if gray else (*lead, samples.f.shape[2])
    if not samples.f.shape[1]:
        nothing = np.full(shape, np.nan)
        count = np.zeros(lead, np.int64)
        return DiffuseAlbedo(nothing, nothing.copy(), np.zeros(lead, np.bool_), count)
    ratio, cos_l, cos_v = _ratios(samples, eta)
    usable = samples.usable & np.isfinite(ratio)
    if method == "envelope":
        if discard:
            usable &= _ranks(ratio) >= discard
        start = _lower_quartile(ratio, usable)
        r_d, stderr = np.empty(start.shape), np.empty(start.shape)
        counts = np.zeros((len(start), 2), dtype=np.int64)
        run_in_blocks(
            fit_envelope,
            len(start),
            _BLOCK_POINTS,
            np.where(usable, samples.f, np.float32(0.0)),
            np.where(usable, samples.variance, np.float32(1.0)),
            samples.light,
            samples.view,
            samples.normals,
            usable,
            start,
            float(eta),
            float(normal_stderr_rad),
            variance is not None,
            r_d,
            stderr,
            counts,
        )
        dropped = counts[:, 1]
    else:
        r_d, dropped = _minimum(ratio, cos_l, cos_v, usable, method, discard)
        stderr = np.full(r_d.shape, np.nan)
    found: BoolArray = np.asarray(np.isfinite(r_d).all(axis=-1))
    r_d = np.where(found[:, None], r_d, np.nan)
    return DiffuseAlbedo(
        r_d.reshape(shape),
        np.where(found[:, None], stderr, np.nan).reshape(shape),
        found.reshape(lead),
        np.asarray(dropped, dtype=np.int64).reshape(lead),
    )


class _Samples(NamedTuple):
    """P points, contiguous."""

    f: Float32Array
    """(P, M, C)."""
    variance: Float32Array
    """(P, M, C); 1 where none is known."""
    light: Float32Array
    """(P, M, 3)."""
    view: Float32Array
    """(P, M, 3)."""
    normals: Float32Array
    """(P, 3)."""
    usable: BoolArray
    """(P, M, C)."""


def _checked(
    brdf_samples: ArrayLike,
    light_dirs: ArrayLike,
    view_dirs: ArrayLike,
    normals: ArrayLike,
    variance: ArrayLike | None,
    valid: ArrayLike | None,
) -> tuple[_Samples, tuple[int, ...], bool]:
    """Return the samples, the points' shape, and whether they have no axis of channels."""
    f = np.asarray(brdf_samples, dtype=np.float32)
    n = np.asarray(normals, dtype=np.float32)
    gray = f.ndim > 0 and n.shape == (*f.shape[:-1], 3)
    f = f[..., None] if gray else f
    what = "brdf_samples ((..., M) with normals (..., 3), or with channels)"
    Checks().shape(what, f, ("...", None, "C"))
    lead, (samples, channels) = f.shape[:-2], f.shape[-2:]
    points = math.prod(lead)

    def whole(name: str, array: NDArray[Any], *axes: int) -> NDArray[Any]:
        spread = np.ascontiguousarray(Checks().broadcast(name, array, (*lead, *axes)))
        return spread.reshape(points, *axes)

    f = np.ascontiguousarray(f).reshape(points, samples, channels)
    n = whole("normals", n, 3)
    light = whole("light_dirs", np.asarray(light_dirs, np.float32), samples, 3)
    view = whole("view_dirs", np.asarray(view_dirs, np.float32), samples, 3)
    usable: BoolArray = np.asarray(np.isfinite(f))
    if valid is not None:
        given = np.asarray(valid, dtype=bool)
        given = given[..., None] if given.ndim == len(lead) + 1 else given
        usable &= whole("valid", given, samples, channels)
    usable &= np.asarray(np.isfinite(n).all(axis=-1))[:, None, None]
    var = np.ones_like(f)
    if variance is not None:
        given_variance = np.asarray(variance, np.float32)
        if gray and given_variance.ndim:
            given_variance = given_variance[..., None]
        var = whole("variance", given_variance, samples, channels)
        usable &= (var > 0.0) & np.isfinite(var)
    return _Samples(f, var, light, view, n, usable), lead, gray


def _ratios(samples: _Samples, eta: float) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return pi f / (F_t F_t), infinite where unusable, and the cosines of light and view."""
    cosines = [
        np.einsum("pmc,pc->pm", way, samples.normals, dtype=np.float64) for way in samples[2:4]
    ]
    above = (cosines[0] >= MIN_FACTOR_COSINE) & (cosines[1] >= MIN_FACTOR_COSINE)
    above &= np.isfinite(cosines[0]) & np.isfinite(cosines[1])
    cos_light, cos_view = (np.where(above, cosine, 1.0) for cosine in cosines)
    through = boundary_kernels.boundary_transmittance(cos_light, cos_view, eta)
    good = samples.usable & above[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):  # transmittance may be 0 below eta = 1
        ratio = np.pi * np.where(good, samples.f, 0.0) / through[..., None]
    return np.where(good, ratio, np.inf), cosines[0], cosines[1]


def _ranks(ratio: Float64Array) -> NDArray[np.intp]:
    """Return each value's rank from the smallest, along the samples."""
    return np.argsort(np.argsort(ratio, axis=1, kind="stable"), axis=1, kind="stable")


def _lower_quartile(ratio: Float64Array, usable: BoolArray) -> Float64Array:
    """Return the lower quartile of the ratios, a start hardly affected by lobes or outliers."""
    count = usable.sum(axis=1)
    ordered = np.sort(ratio, axis=1)
    at = np.clip(count // 4, 0, np.maximum(count - 1, 0))
    start = np.take_along_axis(ordered, at[:, None], axis=1)[:, 0]
    return np.where(np.isfinite(start), start, 0.0)


def _minimum(
    ratio: Float64Array,
    cos_l: Float64Array,
    cos_v: Float64Array,
    usable: BoolArray,
    method: Method,
    discard: int | None,
) -> tuple[Float64Array, NDArray[np.intp]]:
    """Return eq. (6) unchanged, or with grazing samples raised and the smallest omitted."""
    drop = np.zeros(len(ratio), dtype=np.intp)
    if method == "stable_minimum":
        grazing = np.clip(np.minimum(cos_l, cos_v) / GRAZING_COSINE, MIN_FACTOR_COSINE, 1.0)
        with np.errstate(invalid="ignore"):  # unusable ratios are infinite; NaN sorts last too
            ratio = ratio + np.abs(ratio) * (1.0 / grazing - 1.0)[..., None]
        count = usable.sum(axis=1).min(axis=-1)
        drop = (
            np.ceil(DISCARD_FRACTION * count).astype(np.intp) if discard is None else drop + discard
        )
        drop = np.minimum(drop, np.maximum(count - 1, 0))
    ordered = np.sort(ratio, axis=1)
    least = np.take_along_axis(ordered, drop[:, None, None], axis=1)[:, 0]
    return np.where(np.isfinite(least), least, np.nan), drop
