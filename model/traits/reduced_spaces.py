"""Reduce long samples to few coordinates: principal components or non-negative mixtures.

References
----------
Weyrich et al. 2005, "Measuring and modeling human skin reflectance", sections 10 and 11.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike

from model.arrays import Float64Array
from model.checks import Checks
from model.traits import nonnegative_kernels
from model.traits.vectors import Trait, TraitError, scale_exponent

SpaceKind = Literal["pca", "nmf"]

N_HALVINGS = 20
"""Random halvings of the people for choosing the number of components."""
MIN_SCORE_RATIO = 1.05
"""A reduced number of components is chosen if its score exceeds this times that of all."""
MIN_SCORE = 0.5
"""Smallest score at which components are dropped."""


@dataclass(frozen=True, slots=True, eq=False)
class Reduction:
    """A reduced space and the samples' coordinates in it.

    Attributes
    ----------
    kind : {"pca", "nmf"}
    center : ndarray, shape (d,)
        Mean of the samples.
    basis : ndarray, shape (K, d)
        Directions of the space: orthonormal under the metric and in decreasing order (PCA), or
        non-negative mixtures (NMF).
    whole, scores : ndarray, shape (n, r)
        The samples, and their projections to the space, in one frame that is orthonormal under the
        metric, for computing lengths.
    coordinates : ndarray, shape (n, K)
        The samples in the basis; from the center (PCA) or from 0 (NMF).
    lost : float
        Root of the squared fraction of the samples' differences outside the space.
    """

    kind: SpaceKind
    center: Float64Array
    basis: Float64Array
    whole: Float64Array
    scores: Float64Array
    coordinates: Float64Array
    lost: float


def check_metric(metric: ArrayLike | None, length: int) -> Float64Array | None:
    """Return a metric as float64; raise unless it fits samples of this length."""
    if metric is None:
        return None
    g = Checks(TraitError).numbers("metric", metric, (length,), (length, length))
    if g.ndim == 1:
        Checks(TraitError).within("metric", g, "(0, inf)")
        return g
    size = np.diag(g)
    if not np.allclose(g, g.T, rtol=1e-9, atol=1e-12 * float(np.abs(g).max())):
        raise TraitError("metric: got a matrix that is not symmetric, expected a symmetric one")
    if not (size > 0.0).all() or float(np.linalg.eigvalsh(g)[0]) < -1e-6 * float(size.max()):
        raise TraitError("metric: got a matrix of products that is not positive semidefinite")
    return np.asarray(0.5 * (g + g.T))


def times_metric(samples: Float64Array, metric: Float64Array | None) -> Float64Array:
    """Return samples (..., d) times the metric."""
    if metric is None:
        return samples
    return np.asarray(samples * metric if metric.ndim == 1 else samples @ metric)


def metric_lengths(samples: Float64Array, metric: Float64Array | None) -> Float64Array:
    """Return the lengths of samples (..., d) under the metric, (...)."""
    squared = np.sum(samples * times_metric(samples, metric), axis=-1)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def to_euclidean_frame(samples: Float64Array, metric: Float64Array | None) -> Float64Array:
    """Return samples (n, d) in a frame where the metric is the plain sum of squares."""
    if metric is None:
        return samples
    if metric.ndim == 1:
        return np.asarray(samples * np.sqrt(metric))
    values, vectors = np.linalg.eigh(metric)
    return np.asarray(samples @ (vectors * np.sqrt(np.maximum(values, 0.0))))


def principal_components(
    samples: Float64Array,
    traits: Sequence[Trait],
    *,
    components: int | None,
    metric: Float64Array | None,
    rng: np.random.Generator,
) -> Reduction:
    """Return the principal components of samples.

    Parameters
    ----------
    samples : ndarray, shape (n, d)
        Finite, in any unit; d may be far larger than n: time is proportional to n^2 d.
    traits
        Traits for which the number of components is chosen.
    components : int or None
        At most the rank of the samples' differences; None: see `choose_component_count`.
    metric
        See `check_metric`.
    rng
        Halves the people.

    Raises
    ------
    TraitError
        When all samples are the same, have fewer independent differences than requested, or are
        not finite.
    """
    exponent = scale_exponent(samples)
    samples = np.ldexp(samples, -exponent)
    n, d = samples.shape
    center = samples.mean(axis=0)
    off = samples - center
    y = to_euclidean_frame(off, metric)
    # X^T = Q R: the small triangle R has the singular values of X.
    small = np.asarray(np.linalg.qr(y.T, mode="r")).T if d > n else y
    u, s, _ = scipy.linalg.svd(small, full_matrices=False)
    eps = float(np.finfo(np.float64).eps)
    # rounding level of null directions, and of the subtracted mean
    floor = max(max(n, d) * s[0], 8.0 * np.sqrt(n) * float(metric_lengths(center, metric))) * eps
    rank = int(np.count_nonzero(s > floor))
    if rank == 0:
        raise TraitError(f"samples: all {n} are the same; add people who differ")
    if components is not None:
        what = f"components (the {n} samples differ in {rank})"
        Checks(TraitError).within(what, components, f"[1, {rank}]")
    scores = u[:, :rank] * s[:rank]
    kept = choose_component_count(scores, traits, rng=rng) if components is None else components
    # A basis of sums of samples avoids an inverse of the metric.
    basis = (u[:, :kept] / s[:kept]).T @ off
    held = np.where(np.arange(rank) < kept, scores, 0.0)
    lost = float(np.sqrt(np.sum(s[kept:] ** 2) / np.sum(s**2)))
    center, scores, held = (np.ldexp(values, exponent) for values in (center, scores, held))
    return Reduction("pca", center, basis, scores, held, scores[:, :kept].copy(), lost)


def choose_component_count(
    scores: Float64Array, traits: Sequence[Trait], *, rng: np.random.Generator
) -> int:
    """Return the number of components whose trait vectors generalize best to other people.

    Parameters
    ----------
    scores : ndarray, shape (n, r)
        The samples in all their components; finite.
    traits
        Binary ones with at least 2 faces on both sides are used; without any, all components are
        kept.
    rng
        Halves the people.

    Notes
    -----
    Both groups of a trait are halved at random. One half gives a vector in its own first k
    components, the other a plain difference of means. As the errors of both are independent, their
    cosine is the cosine to the true vector, up to a factor that does not depend on k. The k of the
    largest mean over traits and 20 halvings is chosen if it exceeds that of all components by more
    than a twentieth. Dropping components helps where noise is distributed over many components and
    the trait is not; it loses a trait that is smaller than other differences between people.
    """
    n, rank = scores.shape
    used = [t for t in traits if t.kind == "binary" and 2 <= t.members <= n - 2]
    most = min(n // 2 - 2, rank)
    if not used or most < 2 or not scores.any():
        return rank
    scores = np.ldexp(scores, -scale_exponent(scores))
    total = np.zeros(most)
    products = scores @ scores.T
    for trait in used:
        groups = [np.flatnonzero(trait.values == side) for side in (1.0, 0.0)]
        for _ in range(N_HALVINGS):
            contrast = np.zeros((2, n))  # of the two halves
            for group, sign in zip(groups, (1.0, -1.0), strict=True):
                mixed = rng.permutation(group)
                for half, chosen in enumerate((mixed[: len(group) // 2], mixed[len(group) // 2 :])):
                    contrast[half, chosen] = sign / len(chosen)
            mine = np.flatnonzero(contrast[0])
            inner = products[np.ix_(mine, mine)]
            inner = inner - inner.mean(axis=0) - inner.mean(axis=1)[:, None] + inner.mean()
            squares, axes = np.linalg.eigh(inner)
            kept = slice(max(len(mine) - most, int(np.sum(squares < 1e-10 * squares[-1]))), None)
            axes = axes[:, kept][:, ::-1] / np.sqrt(squares[kept][::-1])
            reach = products[mine] @ contrast.T
            along, truth = (reach - reach.mean(axis=0)).T @ axes
            length = np.sqrt(np.maximum(np.cumsum(along**2), 1e-300))
            other = float(np.sqrt(max(contrast[1] @ products @ contrast[1], 1e-300)))
            score = np.cumsum(along * truth) / length / other
            total[: len(score)] += score
            total[len(score) :] += score[-1]
    total /= len(used) * N_HALVINGS
    better = total.max() > max(MIN_SCORE_RATIO * total[-1], MIN_SCORE)
    return int(np.argmax(total)) + 1 if better else rank


def fit_mixtures(
    samples: Float64Array, basis: ArrayLike | None, *, metric: Float64Array | None
) -> Reduction:
    """Return samples as non-negative mixtures of a basis.

    Parameters
    ----------
    samples : ndarray, shape (n, d)
        Finite, in any unit.
    basis : array_like, shape (K, d)
        Finite values of at least 0, from `reconstruction.brdf_basis.reduce`.
    metric
        See `check_metric`.

    Raises
    ------
    TraitError
        Without a basis, for one that does not fit the samples, and for samples that are all the
        same or not finite.
    """
    if basis is None:
        raise TraitError(
            "basis: got none, expected (K, d) non-negative mixtures for space='nmf', such as "
            "reconstruction.brdf_basis.reduce(weights, K)[1]"
        )
    d = samples.shape[1]
    b = Checks(TraitError).numbers("basis", basis, ("K", d), interval="[0, inf)")
    if not (b.max(axis=1) > 0.0).all():
        raise TraitError("basis: got a mixture of weight 0, expected weights above 0")
    exponent = scale_exponent(samples)
    samples = np.ldexp(samples, -exponent)
    coordinates = mixture_coordinates(samples, b, metric)
    mixed = coordinates @ b
    off = samples - mixed
    center = samples.mean(axis=0)
    spread = float(np.linalg.norm(metric_lengths(samples - center, metric)))
    rounding = 8.0 * len(samples) * float(metric_lengths(center, metric)) * np.finfo(np.float64).eps
    if spread <= rounding:
        raise TraitError(f"samples: all {len(samples)} are the same; add people who differ")
    gone = off - off.mean(axis=0)
    lost = float(np.linalg.norm(metric_lengths(gone, metric))) / spread
    whole, held = to_euclidean_frame(samples, metric), to_euclidean_frame(mixed, metric)
    center, whole, held, coordinates = (
        np.ldexp(values, exponent) for values in (center, whole, held, coordinates)
    )
    return Reduction("nmf", center, b, whole, held, coordinates, lost)


def mixture_coordinates(
    samples: Float64Array, basis: Float64Array, metric: Float64Array | None
) -> Float64Array:
    """Return the non-negative weights (n, K) of a basis (K, d) nearest to samples.

    Both finite, each in any unit; computed in double precision.

    Raises
    ------
    TraitError
        For values that are not finite, and a metric that does not fit samples of this length.
    """
    samples, basis = np.asarray(samples, np.float64), np.asarray(basis, np.float64)
    unit, own = scale_exponent(samples), scale_exponent(basis)
    d = basis.shape[1]
    if metric is not None:
        Checks(TraitError).numbers("metric", metric, (d,), (d, d))
    materials = np.ldexp(basis, -own)
    products = times_metric(materials, metric)
    gram = products @ materials.T
    plain = np.linalg.lstsq(gram, products @ np.ldexp(samples, -unit).T, rcond=1e-12)[0].T
    shares = nonnegative_kernels.nearest_mixtures(gram, np.ascontiguousarray(plain))
    return np.asarray(np.ldexp(shares, unit - own))
