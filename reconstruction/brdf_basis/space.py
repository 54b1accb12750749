"""How many common mixtures a set of surface BRDFs needs: error against their number.

Mixtures of tabulated materials (`reconstruction.brdf_basis.fit_weights`) are factored into fewer
mixtures common to all points; the error says how far the BRDFs of the points lie from what the
common mixtures can make with shares of at least 0. Points that the mixtures were not made of give
the error out of sample.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 10.1 and figure 15.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.brdf.tables import BrdfBasis
from model.checks import Checks
from model.traits.reduced_spaces import mixture_coordinates
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.brdf_basis import fit as brdf_basis

Method = Literal["shares", "brdf"]

CURVE_RANKS: Final = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16)
MAX_SWEEPS: Final = 60
SWEEP_TOL: Final = 1e-7
"""Relative change of what is lowered below which a refinement ends."""
MAX_STRENGTH_RATIO: Final = 8.0
"""Times the median strength from which on a point's mixture counts as not held down by samples."""
PLATEAU_FRACTIONS: Final = (0.02, 0.05, 0.1)
"""Shares of the plateau's rule at which it is told."""


class SpaceError(ValueError):
    """Points that make no space of BRDFs."""


@dataclass(frozen=True, slots=True, eq=False)
class SpaceCurve:
    """Error against the number of common mixtures.

    Attributes
    ----------
    ranks : tuple of int
        Numbers of mixtures, growing.
    error : ndarray, shape (R,)
        Relative error on the points that the mixtures were made of.
    held_out : ndarray, shape (R,)
        The same on points they were not made of; NaN where none was kept.
    held_out_stderr : ndarray, shape (R,)
        Its standard error over these points; groups, where there are any, count as one each.
    mixes : tuple of ndarray, shape (rank, K)
        The mixtures of each rank, each of sum 1.
    points, held_out_points : int
        How many there were of either.
    omitted : tuple of (int, str)
        Ranks that were asked for and not made, with the reason.
    """

    ranks: tuple[int, ...]
    error: Float64Array
    held_out: Float64Array
    held_out_stderr: Float64Array
    mixes: tuple[Float64Array, ...]
    points: int
    held_out_points: int
    omitted: tuple[tuple[int, str], ...]

    def plateau_rank(
        self, *, fraction: float = brdf_basis.PLATEAU_FRACTION, max_rank: int | None = None
    ) -> int:
        """Return the number of mixtures from which on more do not help.

        The first rank whose error exceeds the least one by no more than `fraction` of the fall from
        the first rank to the least error (`reconstruction.brdf_basis.find_plateau_rank`). The
        answer depends on the share, and on how many ranks are looked at.

        Parameters
        ----------
        share
            See above.
        most
            Look at ranks up to this one only; None: all.
        """
        among = [k for k, rank in enumerate(self.ranks) if max_rank is None or rank <= max_rank]
        if not among:
            raise SpaceError(f"max_rank: got {max_rank}, expected at least {self.ranks[0]}")
        return self.ranks[brdf_basis.find_plateau_rank(self.error[among], fraction=fraction) - 1]

    def normalized(self) -> Float64Array:
        """Return the errors over that of the first rank, (R,): several curves on one scale."""
        return self.error / self.error[0] if self.error[0] > 0.0 else np.zeros_like(self.error)


def is_constrained(weights: ArrayLike, basis: BrdfBasis) -> BoolArray:
    """Return which points' mixtures are held down by their samples, (P,).

    A lobe so narrow that no pair of light and view met it can have any share: mixtures of more
    than `MAX_STRENGTH_RATIO` times the median strength, and empty ones, are not used.
    """
    strength = _checked(weights, basis) @ basis.strength()
    some = strength[strength > 0.0]
    return (strength > 0.0) & (
        strength < MAX_STRENGTH_RATIO * (np.median(some) if len(some) else 0.0)
    )


def compute_error_curve(
    weights: ArrayLike,
    basis: BrdfBasis,
    *,
    ranks: Sequence[int] = CURVE_RANKS,
    held_out: ArrayLike | None = None,
    groups: ArrayLike | None = None,
    method: Method = "brdf",
    seed: int = 0,
) -> SpaceCurve:
    """Factor mixtures into ever more common ones.

    Parameters
    ----------
    weights
        Shares (P, K) of the materials, at least 0, of the points that the mixtures are made of.
    basis
        The K materials.
    ranks
        Numbers of common mixtures, growing; those that the points cannot hold are left out.
    held_out
        Shares (Q, K) of other points.
    groups
        Whom each of these belongs to, (Q,): points of one person err alike.
    method
        "shares": factored as shares of the materials weighted by their strength, as the paper does
        (scikit-learn's NMF). "brdf": the same as a start, then mixtures and shares in turn take
        their best values for the BRDFs themselves, and no rank is worse than a smaller one.
    seed
        Of the factorization.

    Returns
    -------
    SpaceCurve

    Raises
    ------
    SpaceError
        Nothing reflects, or no rank can be made.
    ValueError
        The shares do not fit the basis, or are negative.

    Notes
    -----
    The error is the root of the squared gap between the BRDFs of all points and of what the
    mixtures make of them with their best shares, over the square of the BRDFs; nodes of the tables
    count by solid angle, as in `brdf_basis.reduce` (whose own error is that of the factorization's
    shares, which are not the best for the BRDFs, and is larger). Materials are nearly dependent:
    shares that look different may be one BRDF, and factoring shares spends mixtures on that.
    """
    shares = _checked(weights, basis)
    if list(ranks) != sorted(set(ranks)) or not len(ranks) or ranks[0] < 1:
        raise SpaceError(f"ranks: got {list(ranks)}, expected growing numbers from 1")
    Checks().choice("method", method, ("shares", "brdf"))
    gram = brdf_inner_products(basis)
    if not np.any(shares):
        raise SpaceError(f"weights: all {len(shares)} points are 0, none shows how it reflects")
    most = min(shares.shape)
    made = [rank for rank in ranks if rank <= most]
    if not made:
        raise SpaceError(f"ranks: got {list(ranks)}, but {len(shares)} points hold {most} at most")
    left_out = tuple(
        (rank, f"{len(shares)} points of {shares.shape[1]} materials hold {most} at most")
        for rank in ranks
        if rank > most
    )
    others = np.zeros((0, basis.size)) if held_out is None else _checked(held_out, basis)
    whose = np.arange(len(others)) if groups is None else np.asarray(groups)
    Checks(SpaceError).shape("groups", whose, (len(others),))
    errors: list[float] = []
    outside, spread = [], []
    mixes: list[Float64Array] = []
    for rank in made:
        mix = brdf_basis.reduce(shares, rank, basis=basis, seed=seed)[1]
        if method == "brdf":
            mix = refine_mixtures(shares, mix, basis)
            if mixes and _error(shares, mix, gram) >= errors[-1]:
                mix = refine_mixtures(
                    shares, _add_worst_points(shares, mixes[-1], rank, gram), basis
                )
        mixes.append(mix)
        errors.append(_error(shares, mix, gram))
        found, deviation = _jackknife_error(others, whose, mix, gram)
        outside.append(found)
        spread.append(deviation)
    return SpaceCurve(
        tuple(made),
        np.array(errors),
        np.array(outside),
        np.array(spread),
        tuple(mixes),
        len(shares),
        len(others),
        left_out,
    )


def refine_mixtures(
    weights: ArrayLike, mix: ArrayLike, basis: BrdfBasis, *, sweeps: int = MAX_SWEEPS
) -> Float64Array:
    """Lower the BRDFs' error of common mixtures, shares and mixtures in turn.

    Parameters
    ----------
    weights
        Shares (P, K), at least 0.
    mix
        Mixtures to start from, (R, K), at least 0.
    basis
        The K materials.
    sweeps
        How often all are renewed.

    Returns
    -------
    ndarray, shape (R, K)
        Mixtures of sum 1; their error is no greater than that of `mix`.

    Notes
    -----
    Coordinate descent in the metric of the materials' products: every share of all points, and
    every entry of the mixtures, in turn takes its best value of at least 0 while all others stand,
    so that the error never grows (hierarchical alternating least squares: Cichocki and Phan 2009,
    doi:10.1587/transfun.E92.A.708, there without a metric).
    """
    shares, gram = _checked(weights, basis), brdf_inner_products(basis)
    rows = np.array(_checked(mix, basis))
    found = mixture_coordinates(shares, rows, gram)
    last = np.inf
    for _ in range(sweeps):
        products = rows @ gram
        _descend(found, shares @ products.T, products @ rows.T)
        inner, outer = found.T @ found, found.T @ shares
        for k in np.flatnonzero(np.diag(inner) > 0.0):
            target = rows[k] + (outer[k] - inner[k] @ rows) / inner[k, k]
            _descend(rows[k : k + 1], (target @ gram)[None], gram)
        left = float(np.sum(((inner @ rows - 2.0 * outer) @ gram) * rows))
        if last - left < SWEEP_TOL * abs(left):
            break
        last = left
    size = rows.sum(axis=1, keepdims=True)
    even = np.full(basis.size, 1.0 / basis.size)
    return np.where(size > 0.0, rows / np.where(size > 0.0, size, 1.0), even)


def _descend(values: Float64Array, target: Float64Array, square: Float64Array) -> None:
    """Lower x A x' - 2 b x' of each row x, one column after the other, in place; x >= 0."""
    for k in np.flatnonzero(np.diag(square) > 0.0):
        step = (target[:, k] - values @ square[:, k]) / square[k, k]
        values[:, k] = np.maximum(values[:, k] + step, 0.0)


def repeat_distance(first: ArrayLike, second: ArrayLike, basis: BrdfBasis) -> float:
    """Return how far two fits of the same points lie apart, as a part of their BRDFs.

    The root of half the squared difference, over the mean square: what noise alone leaves, and
    what no number of mixtures should explain.
    """
    a, b = _checked(first, basis), _checked(second, basis)
    Checks(SpaceError).shape("second", b, a.shape)
    gram = brdf_inner_products(basis)
    size = 0.5 * (_squares(a, gram).sum() + _squares(b, gram).sum())
    if size == 0.0:
        return float("nan")
    return float(np.sqrt(0.5 * _squares(a - b, gram).sum() / size))


def brdf_inner_products(basis: BrdfBasis) -> Float64Array:
    """Return the products of the materials' BRDFs, (K, K), nodes counting by solid angle."""
    strength = basis.strength()
    return basis.cosine_similarity() * np.outer(strength, strength)


def _checked(weights: ArrayLike, basis: BrdfBasis) -> Float64Array:
    values = np.asarray(weights, dtype=np.float64)
    return Checks().numbers("weights", values, (None, basis.size), interval="[0, inf)")


def _squares(rows: Float64Array, gram: Float64Array) -> Float64Array:
    return np.maximum(np.einsum("pk,pk->p", rows @ gram, rows), 0.0)


def _error(shares: Float64Array, mix: Float64Array, gram: Float64Array) -> float:
    gap = shares - mixture_coordinates(shares, mix, gram) @ mix
    return float(np.sqrt(_squares(gap, gram).sum() / _squares(shares, gram).sum()))


def _add_worst_points(
    shares: Float64Array, mix: Float64Array, rank: int, gram: Float64Array
) -> Float64Array:
    """Add the points that mixtures make worst, one after the other, until there are enough."""
    while len(mix) < rank:
        gap = shares - mixture_coordinates(shares, mix, gram) @ mix
        worst = shares[int(np.argmax(_squares(gap, gram)))]
        mix = np.concatenate([mix, worst[None] / worst.sum()])
    return mix


def _jackknife_error(
    shares: Float64Array, groups: NDArray[np.generic], mix: Float64Array, gram: Float64Array
) -> tuple[float, float]:
    """Return the error of points and its standard error by leaving out one group after another."""
    if not np.any(shares):
        return float("nan"), float("nan")
    gap = shares - mixture_coordinates(shares, mix, gram) @ mix
    _, group = np.unique(groups, return_inverse=True)
    lost = np.bincount(group, _squares(gap, gram))
    all_of = np.bincount(group, _squares(shares, gram))
    count = len(lost)
    error = float(np.sqrt(lost.sum() / all_of.sum()))
    rest = all_of.sum() - all_of
    if count < 2 or not np.all(rest > 0.0):
        return error, float("nan")
    without = np.sqrt((lost.sum() - lost) / rest)
    return error, float(np.sqrt((count - 1) / count * np.sum((without - without.mean()) ** 2)))
