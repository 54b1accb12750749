"""Fit surface BRDFs as non-negative mixtures of tabulated materials, and reduce the mixtures.

One convention, in fit and evaluation alike. With L the radiance, E the irradiance a surface facing
the light would get, theta the light's angle to the normal and F_t = 1 - F_r::

    surface sample  R_s = L / E - cos(theta) F_t(light) F_t(view) R_d / pi      [1/sr]
    model           R_s = cos(theta) sum_j x_j M_j(light, view)

The materials M_j include their Fresnel reflection as measured ones do, so F_r is counted once:
nothing multiplies it again (the paper's eqs. (2), (3), (7) could be read as twice). Highlights have
the light's color, so samples are one number for all channels.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 7.
"""

import logging
import warnings
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from model.brdf.tables import BrdfBasis
from model.checks import Checks
from model.threads import run_in_blocks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from reconstruction.brdf_basis.nnls_kernels import fit_points
from reconstruction.lumitexels import sample_kernels

_log = logging.getLogger(__name__)

MIN_SAMPLE_COSINE = 0.1
"""Least cosine of light and view of a used sample."""
N_REWEIGHTINGS = 3
POINTS_PER_BLOCK = 64  # points with a common working memory
PLATEAU_FRACTION = 0.05


class SampleError(ValueError):
    """Samples of inconsistent shapes."""


@dataclass(frozen=True, slots=True)
class SurfaceSamples:
    """Surface reflection of P points in M pairs of light and view.

    Attributes
    ----------
    value : ndarray of float32, shape (P, M)
        R_s of this module's convention, 1/sr; negative by noise.
    variance : ndarray of float32, shape (P, M)
        Of `value`; 0: unknown (then all samples of a point have equal weights).
    light_dir, view_dir : ndarray of float32, shape (P, M, 3)
        Unit vectors away from the surface, rig frame.
    normals : ndarray of float32, shape (P, 3)
        Unit normals, rig frame.
    valid : ndarray of bool, shape (P, M)
        Samples to use: finite, light and view at least 0.1 (cosine) above the horizon.
    """

    value: Float32Array
    variance: Float32Array
    light_dir: Float32Array
    view_dir: Float32Array
    normals: Float32Array
    valid: BoolArray

    def __post_init__(self) -> None:
        """Check the shapes."""
        check = Checks(SampleError).shape
        check("value", self.value, (None, None))
        shape = self.value.shape
        check("variance", self.variance, shape)
        check("light_dir", self.light_dir, (*shape, 3))
        check("view_dir", self.view_dir, (*shape, 3))
        check("normals", self.normals, (shape[0], 3))
        check("valid", self.valid, shape)


@dataclass(frozen=True, slots=True)
class BasisWeights:
    """Mixtures of a basis, one per point.

    Attributes
    ----------
    weights : ndarray of float64, shape (P, K)
        Weights of the materials, at least 0. The materials are nearly dependent: compare mixtures
        by their BRDFs, never by these numbers. 0 where not `valid`.
    residual : ndarray of float64, shape (P,)
        Weighted RMS of samples - model, 1/sr; NaN where not `valid`.
    stderr : ndarray of float64, shape (P,)
        Relative standard error of the BRDF's overall scale; NaN where not `valid`, or where the
        mixture is empty.
    valid : ndarray of bool, shape (P,)
        False without a usable sample.
    """

    weights: Float64Array
    residual: Float64Array
    stderr: Float64Array
    valid: BoolArray


def surface_samples(
    brdf_samples: ArrayLike,
    light_dirs: ArrayLike,
    view_dirs: ArrayLike,
    normals: ArrayLike,
    r_d: ArrayLike,
    *,
    eta: float,
    variance: ArrayLike | None = None,
    valid: ArrayLike | None = None,
) -> SurfaceSamples:
    """Subtract the diffuse part from BRDF samples, and average the channels.

    Parameters
    ----------
    brdf_samples
        f_r = L / (E cos) in 1/sr, (P, M, C), of a white-balanced camera (1 for a white surface
        over pi in all channels).
    light_dirs, view_dirs
        Unit vectors (P, M, 3) or broadcast, away from the surface.
    normals
        Unit normals (P, 3).
    r_d
        Diffuse reflectance (P, C); a point where it is not finite has no valid sample.
    eta
        Relative refractive index, as in the estimate of `r_d`.
    variance
        Of `brdf_samples`, same shape. Channels are averaged by its inverse, or evenly without it.
    valid
        Samples to use, (P, M); None: all that are finite.

    Returns
    -------
    SurfaceSamples
    """
    f = np.asarray(brdf_samples, dtype=np.float32)
    Checks(SampleError).shape("brdf_samples", f, (None, None, None))
    points, samples, channels = f.shape
    light, view = (
        np.broadcast_to(np.asarray(v, dtype=np.float32), (points, samples, 3))
        for v in (light_dirs, view_dirs)
    )
    n = np.asarray(normals, dtype=np.float32)
    albedo = np.asarray(r_d, dtype=np.float64)
    Checks(SampleError).shape("normals", n, (points, 3))
    Checks(SampleError).shape("r_d", albedo, (points, channels))
    usable = np.ones(f.shape[:2], bool) if valid is None else np.asarray(valid, dtype=bool)
    unknown = np.empty((points, samples, 0), np.float32)
    made = (
        np.empty((points, samples), np.float32),
        np.empty((points, samples), np.float32),
        np.empty((points, samples), bool),
    )
    sample_kernels.subtract_diffuse(
        np.ascontiguousarray(f),
        unknown if variance is None else _broadcast_variance(variance, f.shape),
        (np.ascontiguousarray(light), np.ascontiguousarray(view)),
        np.ascontiguousarray(n, np.float64),
        np.ascontiguousarray(albedo),
        np.ascontiguousarray(np.broadcast_to(usable, (points, samples))),
        float(eta),
        MIN_SAMPLE_COSINE,
        made,
    )
    value, spread, used = made
    return SurfaceSamples(value, spread, light, view, n, used)


def _broadcast_variance(variance: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return variances of one dtype and layout, as the kernel needs them."""
    given = np.asarray(variance)
    wide = given if given.dtype == np.float32 else given.astype(np.float64, copy=False)
    return np.ascontiguousarray(np.broadcast_to(wide, shape))


def fit_weights(
    samples: SurfaceSamples, basis: BrdfBasis, *, compress: Literal["cbrt", "none"] = "cbrt"
) -> BasisWeights:
    """Fit a non-negative mixture of the basis to each point.

    Parameters
    ----------
    samples
        See :func:`surface_samples`; give large sets in chunks of some thousand points.
    basis
        Materials; see :mod:`model.brdf.tables`.
    compress
        "cbrt": misfits are differences of cube roots, as far as they exceed the noise.
        "none": plain least squares, weighted by the variances where these are known.

    Returns
    -------
    BasisWeights

    Notes
    -----
    The cube root of a mixture is not the mixture of cube roots (taking roots of the matrix'
    elements, as the paper's words can be read, is another model). To first order a difference of
    cube roots is 1 / (3 u^(2/3)) of the difference, so the fit is a plain one whose weights,
    1 / (variance + 9 tau^2 u^(4/3)), follow its own model u: three reweighted passes. tau, the
    misfit of cube roots that the basis leaves, is estimated with them. Samples, which can be
    negative by noise, are never rooted themselves: that would bias dark ones. Residuals beyond
    3 standard deviations pull with constant force.
    """
    Checks().choice("compress", compress, ("cbrt", "none"))
    points = len(samples.value)
    weights = np.zeros((points, basis.size))
    given = (samples.value, samples.variance, samples.light_dir, samples.view_dir, samples.normals)
    residual, stderr = np.empty((2, points))
    ended = np.empty(points, bool)
    run_in_blocks(
        fit_points,
        points,
        POINTS_PER_BLOCK,
        basis.table,
        basis.size,
        basis.cosine_similarity(),
        *(np.ascontiguousarray(array, dtype=np.float32) for array in given),
        np.ascontiguousarray(samples.valid),
        N_REWEIGHTINGS if compress == "cbrt" else 0,
        POINTS_PER_BLOCK,
        weights,
        residual,
        stderr,
        ended,
    )
    if not ended.all():
        _log.warning(
            "weights of BRDFs: %d of %d points reached the largest number of steps or of materials;"
            " compare their residuals",
            points - np.count_nonzero(ended),
            points,
        )
    return BasisWeights(weights, residual, stderr, np.isfinite(residual))


def evaluate(
    weights: ArrayLike,
    basis: BrdfBasis,
    light_dir: ArrayLike,
    view_dir: ArrayLike,
    normal: ArrayLike,
) -> Float64Array:
    """Evaluate the mixtures' BRDF, 1/sr, without the cosine and without another factor F_r.

    Parameters
    ----------
    weights
        Weights (..., K), broadcast with the directions.
    light_dir, view_dir, normal
        Unit vectors (..., 3) away from the surface, in one frame.

    Returns
    -------
    ndarray
        Shape (...); 0 where light or view are below the horizon.
    """
    material = basis.evaluate(light_dir, view_dir, normal)
    return np.asarray(np.sum(np.asarray(weights, dtype=np.float64) * material, axis=-1))


def reduce(
    weights: BasisWeights | ArrayLike, rank: int, *, basis: BrdfBasis | None = None, seed: int = 0
) -> tuple[Float64Array, Float64Array, float]:
    """Factor mixtures into fewer, non-negative ones common to all points.

    Parameters
    ----------
    weights
        Weights (P, K) or a fit; points that are not valid keep 0.
    rank
        Number of common mixtures, at least 1 and at most the smaller of P and K.
    basis
        If given, materials are scaled by their reflection, and the error is that of the BRDFs;
        otherwise both are of the weights themselves.
    seed
        Seed of the factorization.

    Returns
    -------
    weights : ndarray, shape (P, rank)
        Weights of the common mixtures. A fit to the samples on ``basis.mixed(basis_mix)`` is
        better.
    basis_mix : ndarray, shape (rank, K)
        The common mixtures, each of sum 1.
    relative_error : float
        Root of the squared misfit over the square of the factored matrix.
    """
    found = weights.weights if isinstance(weights, BasisWeights) else weights
    shares = Checks().numbers("weights", found, ("P", "K"), interval="[0, inf)")
    Checks().within("rank", rank, f"[1, {min(shares.shape)}]")
    top = float(shares.max())
    if top > 0.0 and not 1e-100 < top < 1e100:  # squares would under- or overflow
        found, mix, error = reduce(shares / top, rank, basis=basis, seed=seed)
        return found * top, mix, error
    scale = np.ones(shares.shape[1]) if basis is None else basis.strength()
    scaled = shares * scale
    total = scaled.sum()
    if total == 0.0:
        return np.zeros((len(shares), rank)), np.full((rank, shares.shape[1]), 1 / len(scale)), 0.0
    found, mix = _factor(scaled / scaled.max(), rank, seed)
    mix = mix * scaled.max() / scale
    size = mix.sum(axis=1, keepdims=True)
    mix = np.where(size > 0.0, mix / np.where(size > 0.0, size, 1.0), 1.0 / len(scale))
    found = found * size.T
    gap = shares - found @ mix
    gram = (
        np.eye(len(scale)) if basis is None else basis.cosine_similarity() * np.outer(scale, scale)
    )
    squared = [float(np.einsum("pk,kl,pl->", a, gram, a, optimize=True)) for a in (gap, shares)]
    return found, mix, float(np.sqrt(max(squared[0], 0.0) / squared[1]))


def _factor(
    data: Float64Array, rank: int, seed: int, rounds: int = 400
) -> tuple[Float64Array, Float64Array]:
    # imported here: most commands that load this module factor nothing, and it takes 0.4 s
    from sklearn.decomposition import NMF
    from sklearn.exceptions import ConvergenceWarning

    model = NMF(rank, init="nndsvda", solver="cd", max_iter=rounds, tol=1e-3, random_state=seed)
    with warnings.catch_warnings():
        # A factorization stopped early is valid but slightly worse; its error includes that
        warnings.simplefilter("ignore", ConvergenceWarning)
        found = model.fit_transform(data)
    return found, np.asarray(model.components_)


def find_plateau_rank(errors: ArrayLike, *, fraction: float = PLATEAU_FRACTION) -> int:
    """Return the first rank whose error is within `fraction` of the whole gain of the least error.

    Parameters
    ----------
    errors
        Errors of ranks 1, 2, ...
    fraction
        Allowed excess over the least error, as a fraction of the fall from rank 1 to it.

    Examples
    --------
    >>> find_plateau_rank([1.0, 0.4, 0.15, 0.11, 0.1, 0.1])
    4
    """
    error = np.asarray(errors, dtype=np.float64)
    least = float(error.min())
    return int(np.argmax(error <= least + fraction * (float(error[0]) - least))) + 1


def render_lit_sphere(
    weights: ArrayLike,
    basis: BrdfBasis,
    *,
    light_dir: ArrayLike = (0.5, 0.5, 0.70710678),
    size_px: int = 128,
) -> Float64Array:
    """Render one mixture on a sphere viewed from +z at a distance, without the diffuse part.

    Parameters
    ----------
    weights
        Weights (K,).
    light_dir
        Unit vector to the light; +x right, +y up.
    size_px
        Height and width of the image.

    Returns
    -------
    ndarray, shape (size_px, size_px)
        BRDF times cosine of the light, 1/sr; row 0 is the top; 0 outside the sphere.
    """
    at = (np.arange(size_px) + 0.5) / size_px * 2.0 - 1.0
    x, y = np.meshgrid(at, -at)
    inside = x**2 + y**2 < 1.0
    normal = np.stack([x, y, np.sqrt(np.where(inside, 1.0 - x**2 - y**2, 0.0))], axis=-1)
    light = np.asarray(light_dir, dtype=np.float64)
    light = light / np.linalg.norm(light)
    lobe = evaluate(weights, basis, light, np.array([0.0, 0.0, 1.0]), normal)
    return np.asarray(np.where(inside, lobe * np.maximum(normal @ light, 0.0), 0.0))
