"""Apply traits of surface BRDFs, such as lotion, to weight maps of basis BRDFs.

A face's maps are weights of a few lobes (basis BRDFs), each a mixture of many materials; a trait is
a signed mixture of the same materials. It may add a lobe that the face lacks, but can only subtract
from existing lobes. So an edit adds at most one lobe per trait: the candidate with the smallest
error over all texels, if it reduces the error enough. Candidates are the positive part of the
trait's mixture, and its remainder after a texel of mean weights has given off what it can.

On the lobes, the trait is the nearest vector of signed weights z, with the norm of BRDFs over
directions. The weights t of a texel become the non-negative ones nearest to t + a z: t + a z
itself, or, where a lobe is used up, a compensation by similar lobes. The opposite edit, on lobes
that include the trait's, restores the source wherever no lobe was used up.

Two other ways were measured on simulated faces (`skinrig bench --stage traits` measures this one):
the best lobe under unlimited subtraction from the others is so similar to them that they are used
up at once, and the population's common mixtures, eight more lobes, are not better.

References
----------
Weyrich et al. 2005, "Measuring and modeling human skin reflectance", section 11.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls
from threadpoolctl import threadpool_limits

from model.arrays import Float64Array, FloatArray
from model.checks import Checks
from model.traits import nonnegative_kernels, reduced_spaces
from model.traits.space import TraitSpace
from model.traits.vectors import TraitError

MIN_ERROR_GAIN = 0.05
"""A trait adds a lobe if that reduces the error of its edit by more than this fraction."""
CANDIDATE_WEIGHTS = (0.3, 1.0, 3.0)
"""Multiples of the mean weights that a candidate assumes can be subtracted."""
TRIAL_TEXELS = 1000
"""Texels on which candidates are tried."""
MAX_LOBES = 15
"""Largest number of lobes, including those of traits."""


@dataclass(frozen=True, slots=True, eq=False)
class LobeEdit:
    """Edited lobe weights, and the part of the edit that was not possible.

    Attributes
    ----------
    weights : ndarray, shape (T, K')
        Weights of the lobes, at least 0; those of the source first.
    mix : ndarray of float64, shape (K', d)
        The lobes as mixtures of the materials.
    moved : ndarray of float64, shape (T,)
        Length of the requested change.
    clipped : ndarray of float64, shape (T,)
        Length of the part that could not be subtracted.
    return_bound : ndarray of float64, shape (T,)
        Bound of the distance to the source's BRDF after the opposite edit: the clipped part, and
        the part of the traits that the lobes cannot represent.
    misfit : mapping of str to float
        Fraction of each trait's vector that the lobes cannot represent.
    """

    weights: FloatArray
    mix: Float64Array
    moved: Float64Array
    clipped: Float64Array
    return_bound: Float64Array
    misfit: Mapping[str, float]

    @property
    def clipped_fraction(self) -> float:
        """Return the fraction of the change that could not be subtracted, RMS over texels."""
        asked = float(np.sqrt(np.mean(self.moved**2))) if len(self.moved) else 0.0
        return float(np.sqrt(np.mean(self.clipped**2))) / asked if asked > 0.0 else 0.0


def edit_weights(
    weights: ArrayLike,
    mix: ArrayLike,
    space: TraitSpace,
    amounts: Mapping[str, ArrayLike],
    *,
    materials: tuple[str, ...] = (),
) -> LobeEdit:
    """Add traits of surface BRDFs to weights of lobes.

    Parameters
    ----------
    weights : array_like, shape (T, K)
        Weights of the lobes, at least 0 and finite.
    mix : array_like, shape (K, d)
        Each lobe as a mixture of the space's materials, at least 0.
    space : TraitSpace
        Space of mixtures of the same d materials.
    amounts : mapping of str to float or array_like, shape (T,)
        Factors of each trait's vector, the same for all texels or one per texel.
    materials : tuple of str
        Names of the d columns of `mix`; checked against the space's names where both are given.

    Returns
    -------
    LobeEdit
        Weights of the floating type given. All amounts 0: weights and lobes exactly as given.

    Raises
    ------
    TraitError
        For shapes or materials that do not fit, weights below 0, unknown traits, amounts that are
        not finite, and more than 15 lobes.

    Examples
    --------
    >>> wide, sharp = [1.0, 0.0], [0.0, 1.0]
    >>> space = TraitSpace.fit([wide, [0.5, 0.5]], {"lotion": [False, True]})
    >>> oiled = edit_weights([[1.0], [0.25]], [wide], space, {"lotion": 1.0})
    >>> oiled.weights.round(6).tolist(), oiled.clipped.round(6).tolist()
    ([[0.5, 0.5], [0.0, 0.5]], [0.0, 0.25])
    """
    given = np.asarray(weights)
    dtype = given.dtype if np.issubdtype(given.dtype, np.floating) else np.dtype(np.float64)
    t, lobes = _checked(given, mix, space, materials)
    by = {name: _amount(name, amount, len(t)) for name, amount in amounts.items()}
    for name in by:
        space.trait(name)
    zero = np.zeros(len(t))
    asked = {name: amount for name, amount in by.items() if amount.any()}
    if not asked:
        return LobeEdit(given.astype(dtype), lobes, zero, zero, zero, {})
    vectors = {name: space.trait(name).vector for name in asked}
    with threadpool_limits(
        limits=1, user_api="blas"
    ):  # many small matrices: BLAS threads would only add overhead
        for name, vector in vectors.items():
            some = np.flatnonzero(asked[name])
            tried = some[:: -(-len(some) // TRIAL_TEXELS)]
            lobes = _Trial(t[tried], vector, asked[name][tried], space.metric).with_lobe(lobes)
    if len(lobes) > max(MAX_LOBES, t.shape[1]):
        raise TraitError(
            f"lobes: got {len(lobes)} with those of traits, expected at most {MAX_LOBES}"
        )
    gram = reduced_spaces.times_metric(lobes, space.metric) @ lobes.T
    change = np.zeros((len(t), len(lobes)))
    misfit, unseen = {}, zero.copy()
    for name, vector in vectors.items():
        z = _project_on_lobes(lobes, vector, space.metric)
        change += asked[name][:, None] * z
        size = float(reduced_spaces.metric_lengths(vector, space.metric))
        off = float(reduced_spaces.metric_lengths(z @ lobes - vector, space.metric))
        misfit[name] = off / size if size > 0.0 else 0.0
        unseen += np.abs(asked[name]) * off
    wanted = _padded(t, len(lobes)) + change
    found = nonnegative_kernels.nearest_mixtures(gram, wanted)
    clipped = reduced_spaces.metric_lengths(found - wanted, gram)
    moved = reduced_spaces.metric_lengths(change, gram)
    return LobeEdit(found.astype(dtype), lobes, moved, clipped, clipped + unseen, misfit)


def _checked(
    given: NDArray[np.generic], mix: ArrayLike, space: TraitSpace, materials: tuple[str, ...]
) -> tuple[Float64Array, Float64Array]:
    check = Checks(TraitError)
    lobes = check.numbers("mix", np.array(mix), ("K", len(space.center)), interval="[0, inf)")
    t = np.asarray(given, np.float64)
    check.numbers("weights", t, (None, len(lobes)), interval="[0, inf)")
    if materials and space.names and tuple(materials) != space.names:
        raise TraitError(
            f"materials: got {', '.join(materials[:3])}, ... ({len(materials)}), expected those of "
            f"the traits, {', '.join(space.names[:3])}, ... ({len(space.names)})"
        )
    return t, lobes


def _amount(name: str, amount: ArrayLike, count: int) -> Float64Array:
    a = Checks(TraitError).numbers(f"amount of {name}", amount, (), (count,))
    return np.array(np.broadcast_to(a, (count,)))


def _padded(t: Float64Array, count: int) -> Float64Array:
    return np.pad(t, ((0, 0), (0, count - t.shape[1])))


def _project_on_lobes(
    lobes: Float64Array, vector: Float64Array, metric: Float64Array | None
) -> Float64Array:
    """Return the signed weights of lobes nearest to a vector."""
    products = reduced_spaces.times_metric(lobes, metric)
    gram = products @ lobes.T
    size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    scaled = products @ vector / size
    return np.asarray(np.linalg.lstsq(gram / np.outer(size, size), scaled, rcond=1e-10)[0] / size)


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """A trait to add by given amounts to the weights of some texels."""

    shares: Float64Array
    vector: Float64Array
    amount: Float64Array
    metric: Float64Array | None

    def with_lobe(self, lobes: Float64Array) -> Float64Array:
        """Return the lobes, with one more for the trait where it reduces the error enough."""
        vector, metric = self.vector, self.metric
        strength = float(np.sqrt(np.mean(self.amount**2)))
        size = strength * float(reduced_spaces.metric_lengths(vector, metric))
        if size == 0.0:
            return lobes
        way = vector if float(self.amount.mean()) >= 0.0 else -vector
        found = [np.maximum(way, 0.0)]
        frame = reduced_spaces.to_euclidean_frame(np.eye(len(vector)), metric)
        columns = np.vstack([lobes, np.eye(len(vector))]) @ frame
        usual = _padded(self.shares, len(lobes)).mean(axis=0)
        for given in CANDIDATE_WEIGHTS:
            wanted = given * usual @ lobes + strength * way
            most = 50 * len(columns)
            found.append(nnls(columns.T, wanted @ frame, maxiter=most)[0][len(lobes) :])
        sets = [lobes] + [np.vstack([lobes, one / one.sum()]) for one in found if one.sum() > 0.0]
        errors = [self._error(some) / size for some in sets]
        best = int(np.argmin(errors))
        return sets[best] if errors[0] - errors[best] > MIN_ERROR_GAIN else lobes

    def _error(self, lobes: Float64Array) -> float:
        """Return the RMS length of the error of edits on some lobes."""
        z = _project_on_lobes(lobes, self.vector, self.metric)
        source, amount = _padded(self.shares, len(lobes)), self.amount[:, None]
        gram = reduced_spaces.times_metric(lobes, self.metric) @ lobes.T
        done = nonnegative_kernels.nearest_mixtures(gram, source + amount * z) - source
        off = reduced_spaces.metric_lengths(done @ lobes - amount * self.vector, self.metric)
        return float(np.sqrt(np.mean(off**2)))
