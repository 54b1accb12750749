"""Compute the error of surface BRDFs against the number of common mixtures.

Mixtures of tabulated materials (`reconstruction.brdf_basis.fit_weights`) are factored into fewer
mixtures common to all points. The error is the distance of the points' BRDFs from the best
combinations of these with weights of at least 0. Held-out points give the error out of sample.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 10.1 and figure 15.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.brdf.tables import BrdfBasis
from model.checks import Checks
from model.solver_outcome import UNKNOWN_CONDITION, SolverOutcome, StopReason
from model.traits.reduced_spaces import mixture_coordinates
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.brdf_basis import fit as brdf_basis

_log = logging.getLogger(__name__)

Method = Literal["shares", "brdf"]

CURVE_RANKS: Final = (1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16)
MAX_SWEEPS: Final = 60
SWEEP_TOL: Final = 1e-7
"""Relative change of the objective at which a refinement ends."""
MAX_STRENGTH_RATIO: Final = 8.0
"""Strength over the median from which samples do not constrain a point's mixture."""
PLATEAU_FRACTIONS: Final = (0.02, 0.05, 0.1)
"""Fractions of the plateau's rule that are reported."""


class SpaceError(ValueError):
    """Points that do not form a space of BRDFs."""


@dataclass(frozen=True, slots=True, eq=False)
class SpaceCurve:
    """Error against the number of common mixtures.

    Attributes
    ----------
    ranks : tuple of int
        Numbers of mixtures, increasing.
    error : ndarray, shape (R,)
        Relative error on the points that the mixtures were made of.
    held_out : ndarray, shape (R,)
        The same on held-out points; NaN without any.
    held_out_stderr : ndarray, shape (R,)
        Its standard error over these points; a group counts as one.
    mixes : tuple of ndarray, shape (rank, K)
        The mixtures of each rank, each of sum 1.
    points, held_out_points : int
        Numbers of points of both kinds.
    omitted : tuple of (int, str)
        Requested ranks that were not made, with the reason.
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
        """Return the number of mixtures beyond which the error hardly falls.

        The first rank whose error exceeds the least one by no more than `fraction` of the fall from
        the first rank to the least error (`reconstruction.brdf_basis.find_plateau_rank`). The
        result depends on the fraction, and on the largest rank.

        Parameters
        ----------
        fraction
            See above.
        max_rank
            Largest rank to use; None: all.
        """
        among = [k for k, rank in enumerate(self.ranks) if max_rank is None or rank <= max_rank]
        if not among:
            raise SpaceError(f"max_rank: got {max_rank}, expected at least {self.ranks[0]}")
        return self.ranks[brdf_basis.find_plateau_rank(self.error[among], fraction=fraction) - 1]

    def normalized(self) -> Float64Array:
        """Return the errors over that of the first rank, (R,), to compare several curves."""
        return self.error / self.error[0] if self.error[0] > 0.0 else np.zeros_like(self.error)


def is_constrained(weights: ArrayLike, basis: BrdfBasis) -> BoolArray:
    """Return which points' mixtures are constrained by their samples, (P,).

    A lobe so narrow that no pair of light and view met it can have any weight: mixtures of more
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
    """Factor mixtures into increasing numbers of common ones; return the errors.

    Parameters
    ----------
    weights
        Weights (P, K) of the materials, at least 0, of the points that the mixtures are made of.
    basis
        The K materials.
    ranks
        Numbers of common mixtures, increasing; those above the number of points are omitted.
    held_out
        Weights (Q, K) of other points.
    groups
        Person of each of these, (Q,); errors of one person's points are correlated.
    method
        "shares": weights of the materials, scaled by their strength, are factored, as in the paper
        (scikit-learn's NMF). "brdf": the same as a start, then mixtures and weights in turn take
        their best values for the BRDFs themselves, and no rank is worse than a smaller one.
    seed
        Seed of the factorization.

    Returns
    -------
    SpaceCurve

    Raises
    ------
    SpaceError
        If all weights are 0, or no rank can be made.
    ValueError
        If the weights do not fit the basis, or are negative.

    Notes
    -----
    The error is the root of the squared difference between the BRDFs of all points and their best
    approximation by the mixtures, over the square of the BRDFs. Nodes of the tables count by solid
    angle, as in `brdf_basis.reduce` (whose own error is that of the factorization's weights, which
    are not the best for the BRDFs, and is larger). Materials are nearly dependent: different
    weights may be one BRDF, and a factorization of weights spends mixtures on that.
    """
    shares = _checked(weights, basis)
    if list(ranks) != sorted(set(ranks)) or not len(ranks) or ranks[0] < 1:
        raise SpaceError(f"ranks: got {list(ranks)}, expected increasing numbers from 1; sort them")
    Checks().choice("method", method, ("shares", "brdf"))
    gram = brdf_inner_products(basis)
    if not np.any(shares):
        raise SpaceError(
            f"weights: got {len(shares)} points of 0, expected some above; check the samples"
        )
    most = min(shares.shape)
    made = [rank for rank in ranks if rank <= most]
    if not made:
        raise SpaceError(
            f"ranks: got {list(ranks)}, expected some up to {most} for {len(shares)} points; "
            "add a smaller rank"
        )
    left_out = tuple(
        (rank, f"{len(shares)} points of {shares.shape[1]} materials allow {most} at most")
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
    """Refine common mixtures for the BRDFs' error, weights and mixtures in turn.

    Parameters
    ----------
    weights
        Weights (P, K), at least 0.
    mix
        Mixtures to start from, (R, K), at least 0.
    basis
        The K materials.
    sweeps
        Largest number of passes over all weights and mixtures; a warning states the relative
        change of the last one if it is not below `SWEEP_TOL`.

    Returns
    -------
    ndarray, shape (R, K)
        Mixtures of sum 1; their error is no greater than that of `mix`.

    Notes
    -----
    Coordinate descent in the metric of the materials' products: every weight of all points, and
    every entry of the mixtures, in turn takes its best value of at least 0 with all others fixed,
    so that the error never grows (hierarchical alternating least squares: Cichocki and Phan 2009,
    doi:10.1587/transfun.E92.A.708, there without a metric).
    """
    shares, gram = _checked(weights, basis), brdf_inner_products(basis)
    rows = np.array(_checked(mix, basis))
    found = mixture_coordinates(shares, rows, gram)
    last = change = np.inf
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
        last, change = left, (last - left) / max(abs(left), 1e-300)
    else:
        stop: StopReason = "tolerance" if change < SWEEP_TOL else "limit"
        outcome = SolverOutcome(sweeps, change, UNKNOWN_CONDITION, stop)
        outcome.warn_unless_converged("refinement of common mixtures", _log)
    size = rows.sum(axis=1, keepdims=True)
    even = np.full(basis.size, 1.0 / basis.size)
    return np.where(size > 0.0, rows / np.where(size > 0.0, size, 1.0), even)


def _descend(values: Float64Array, target: Float64Array, square: Float64Array) -> None:
    """Lower x A x' - 2 b x' of each row x in place, column by column, with x >= 0.

    The minimum along x_k is x_k + (b_k - (x A)_k) / A_kk, clipped to 0.
    """
    for k in np.flatnonzero(np.diag(square) > 0.0):
        step = (target[:, k] - values @ square[:, k]) / square[k, k]
        values[:, k] = np.maximum(values[:, k] + step, 0.0)


def repeat_distance(first: ArrayLike, second: ArrayLike, basis: BrdfBasis) -> float:
    """Return the relative distance of two fits of the same points.

    The root of half the squared difference of the BRDFs over their mean square: the part of noise,
    which no number of mixtures should explain.
    """
    a, b = _checked(first, basis), _checked(second, basis)
    Checks(SpaceError).shape("second", b, a.shape)
    gram = brdf_inner_products(basis)
    size = 0.5 * (_squares(a, gram).sum() + _squares(b, gram).sum())
    if size == 0.0:
        return float("nan")
    return float(np.sqrt(0.5 * _squares(a - b, gram).sum() / size))


def brdf_inner_products(basis: BrdfBasis) -> Float64Array:
    """Return the inner products of the materials' BRDFs, (K, K), nodes weighted by solid angle."""
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
    """Add the points with the largest error to the mixtures, one by one, up to a rank."""
    while len(mix) < rank:
        gap = shares - mixture_coordinates(shares, mix, gram) @ mix
        worst = shares[int(np.argmax(_squares(gap, gram)))]
        mix = np.concatenate([mix, worst[None] / worst.sum()])
    return mix


def _jackknife_error(
    shares: Float64Array, groups: NDArray[np.generic], mix: Float64Array, gram: Float64Array
) -> tuple[float, float]:
    """Return the error of points and its jackknife standard error over groups."""
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
