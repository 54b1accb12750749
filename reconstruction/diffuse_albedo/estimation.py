"""Diffuse reflectance R_d from BRDF samples (eq. 6), and the reduced albedo from it (eq. 5).

The paper takes the least of pi f / (F_t F_t) over a point's samples. Of noisy samples the least is
too low, and the more samples the lower. Here the diffuse part is fitted together with a few white
lobes whose shares are at least 0: samples far from the mirror direction, where the lobes have died
away, hold it; those below what noise allows are dropped.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 6.
"""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reconstruction.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from reconstruction.diffuse_albedo.kernels import MIN_FACTOR_COSINE, fit_envelope
from reconstruction.lumitexels import boundary_kernels

Method = Literal["envelope", "stable_minimum", "minimum"]

NORMAL_STDERR_RAD = np.deg2rad(1.0)
GRAZING_COSINE = 0.3
"""The stable minimum penalizes samples nearer to the horizon than this (73 degrees)."""
DISCARD_FRACTION = 0.01
"""What the stable minimum drops where `discard` is None and nothing is known of the noise."""


@dataclass(frozen=True, slots=True)
class DiffuseAlbedo:
    """Diffuse reflectance of surface points.

    Attributes
    ----------
    r_d : ndarray of float64, shape (..., C), or (...) of samples without channels
        R_d of each channel, absolute. Not clamped: a black surface gives small values of either
        sign, an overexposed calibration values above 1. NaN where not `valid`.
    stderr : ndarray of float64, shape of `r_d`
        Standard error of `r_d`; NaN where not `valid`, and where it cannot be known (a minimum; up
        to 3 samples of unknown variance).
    valid : ndarray of bool, shape (...)
        False where a channel has no usable sample.
    discarded : ndarray of int64, shape (...)
        Channel values without a say in the end: outliers on either side.
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
        normals' shape tells which.
    light_dirs, view_dirs
        Unit vectors (..., M, 3) or broadcast, away from the surface.
    normals
        Unit normals (..., 3), outward; those of samples with channels may be broadcast.
    eta
        Relative refractive index (the paper: about 1.3).
    variance
        Of `brdf_samples`, same shape, > 0. None: one unknown variance for all of a channel.
    discard
        Smallest values to drop in each channel. None: those that noise does not explain.
    valid
        Samples to use, (..., M) or (..., M, C); None: all that are finite.
    method
        "envelope", or the paper's "stable_minimum" and plain "minimum", for comparison.
    normal_stderr_rad
        Standard error of the normals, rad: it makes grazing light count less.

    Returns
    -------
    DiffuseAlbedo
        Without the channels' axis where the samples have none.

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
    f = np.asarray(brdf_samples, dtype=np.float32)
    n = np.asarray(normals, dtype=np.float32)
    gray = f.ndim > 0 and n.shape == (*f.shape[:-1], 3)
    f = f[..., None] if gray else f
    if f.ndim < 2:
        raise ValueError(
            f"brdf_samples: got shape {f.shape}, expected (..., M, C), or (..., M) with "
            f"normals (..., 3)"
        )
    lead, (samples, channels) = f.shape[:-2], f.shape[-2:]
    if not channels:
        raise ValueError(f"brdf_samples: got shape {f.shape}, expected at least one channel")
    points = math.prod(lead)
    n = np.ascontiguousarray(_spread("normals", n, (*lead, 3)))
    f = np.ascontiguousarray(f)
    if discard is not None and discard < 0:
        raise ValueError(f"discard: got {discard}, expected at least 0 or None")
    if method not in ("envelope", "stable_minimum", "minimum"):
        raise ValueError(f"method: got {method!r}, expected envelope, stable_minimum or minimum")
    f = f.reshape(points, samples, channels)
    n = n.reshape(-1, 3)
    light, view = (
        np.ascontiguousarray(_spread(name, np.asarray(v, np.float32), (*lead, samples, 3))).reshape(
            points, samples, 3
        )
        for name, v in (("light_dirs", light_dirs), ("view_dirs", view_dirs))
    )
    usable: BoolArray = np.asarray(np.isfinite(f))
    if valid is not None:
        given = np.asarray(valid, dtype=bool)
        given = given[..., None] if given.ndim == len(lead) + 1 else given
        usable &= _spread("valid", given, (*lead, samples, channels)).reshape(f.shape)
    usable &= np.asarray(np.isfinite(n).all(axis=-1))[:, None, None]
    if variance is None:
        var = np.ones_like(f)
    else:
        told = np.asarray(variance, np.float32)
        told = told[..., None] if gray and told.ndim else told
        var = _spread("variance", told, (*lead, samples, channels))
        var = np.ascontiguousarray(var).reshape(f.shape)
        usable &= (var > 0.0) & np.isfinite(var)
    shape = lead if gray else (*lead, channels)
    if not samples:
        nothing = np.full(shape, np.nan)
        count = np.zeros(lead, np.int64)
        return DiffuseAlbedo(nothing, nothing.copy(), np.zeros(lead, np.bool_), count)
    ratio, cos_l, cos_v = _ratios(f, light, view, n, usable, eta)
    usable &= np.isfinite(ratio)
    if method == "envelope":
        if discard:
            usable &= _ranks(ratio) >= discard
        start = _lower(ratio, usable)
        r_d, stderr = np.empty(start.shape), np.empty(start.shape)
        counts = np.zeros((len(f), 2), dtype=np.int64)
        fit_envelope(
            np.where(usable, f, np.float32(0.0)),
            np.where(usable, var, np.float32(1.0)),
            light,
            view,
            n,
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


def _spread(name: str, values: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an array broadcast to a shape, or refuse it by its name."""
    try:
        return np.broadcast_to(values, shape)
    except ValueError:
        raise ValueError(f"{name}: got shape {values.shape}, expected {shape}") from None


def _ratios(
    f: Float32Array,
    light: Float32Array,
    view: Float32Array,
    n: Float32Array,
    usable: BoolArray,
    eta: float,
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return pi f / (F_t F_t), infinite where unusable, and the cosines of light and view."""
    cosines = [np.einsum("pmc,pc->pm", v, n, dtype=np.float64) for v in (light, view)]
    above = (cosines[0] >= MIN_FACTOR_COSINE) & (cosines[1] >= MIN_FACTOR_COSINE)
    above &= np.isfinite(cosines[0]) & np.isfinite(cosines[1])
    cos_light, cos_view = (np.where(above, cosine, 1.0) for cosine in cosines)
    through = boundary_kernels.transmitted(cos_light, cos_view, eta)
    good = usable & above[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):  # nothing is let through below eta = 1
        ratio = np.pi * np.where(good, f, 0.0) / through[..., None]
    return np.where(good, ratio, np.inf), cosines[0], cosines[1]


def _ranks(ratio: Float64Array) -> NDArray[np.intp]:
    """Return each value's place from the smallest, along the samples."""
    return np.argsort(np.argsort(ratio, axis=1, kind="stable"), axis=1, kind="stable")


def _lower(ratio: Float64Array, usable: BoolArray) -> Float64Array:
    """Return the lower quartile of the ratios: a start that neither lobes nor outliers move far."""
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
    """Return eq. (6) as it stands, or with grazing samples raised and the smallest dropped."""
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
