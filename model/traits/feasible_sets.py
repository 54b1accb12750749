"""Feasible sets of samples: non-negative mixtures, and histograms.

Both are convex, and a sample outside is projected to the nearest point inside. Such a projection
never increases the distance of two points, which bounds the residual of an edit and its opposite:
see `model.traits`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array
from model.checks import Checks
from model.traits import nonnegative_kernels
from model.vectors import project_to_simplex

FEASIBLE_TOL = 1e-5
"""Tolerances of float32 samples for a sum of one, and for a weight of zero."""
HISTOGRAM_BINS = 256


class FeasibleError(ValueError):
    """Error for a sample outside its feasible set."""


@dataclass(frozen=True, slots=True)
class UnconstrainedSet:
    """Set of all finite samples."""

    def contains(self, samples: ArrayLike) -> BoolArray:
        """Return whether each sample (..., d) lies in the set, (...)."""
        return np.asarray(np.isfinite(np.asarray(samples, np.float64)).all(axis=-1))

    def project(self, samples: ArrayLike, metric: Float64Array | None = None) -> Float64Array:
        """Return the samples (..., d) as they are."""
        return np.array(samples, np.float64)

    def tangent(self, vector: ArrayLike) -> Float64Array:
        """Return the part of a direction (d,) along the set: all of it."""
        return np.array(vector, np.float64)

    def document(self) -> dict[str, Any]:
        """Return the JSON document for `from_document`."""
        return {"set": "free"}


@dataclass(frozen=True, slots=True)
class NonNegativeSet:
    """Set of samples of weights that are at least 0."""

    def contains(self, samples: ArrayLike) -> BoolArray:
        """Return whether each sample (..., d) lies in the set, (...)."""
        s = np.asarray(samples, np.float64)
        scale = np.abs(s).max(axis=-1, initial=0.0, keepdims=True)
        return np.asarray((np.isfinite(s) & (s >= -FEASIBLE_TOL * scale)).all(axis=-1))

    def project(self, samples: ArrayLike, metric: Float64Array | None = None) -> Float64Array:
        """Return the nearest samples of the set.

        Parameters
        ----------
        samples : array_like, shape (..., d)
        metric : ndarray, shape (d,) or (d, d), optional
            Metric of differences, as weights or as a matrix of products. Weights do not change the
            projection. With a matrix, correlated weights compensate a clipped one.

        Returns
        -------
        ndarray of float64, shape (..., d)

        Examples
        --------
        >>> NonNegativeSet().project([1.0, -0.5]).tolist()
        [1.0, 0.0]
        >>> NonNegativeSet().project([1.0, -0.5], np.array([[1.0, 0.8], [0.8,
        ...     1.0]])).round(6).tolist()
        [0.6, 0.0]
        """
        s = np.asarray(samples, np.float64)
        if metric is None or metric.ndim == 1:
            return np.maximum(s, 0.0)
        return nonnegative_kernels.nearest_mixtures(metric, s.reshape(-1, s.shape[-1])).reshape(
            s.shape
        )

    def tangent(self, vector: ArrayLike) -> Float64Array:
        """Return the part of a direction (d,) along the set: all of it."""
        return np.array(vector, np.float64)

    def document(self) -> dict[str, Any]:
        """Return the JSON document for `from_document`."""
        return {"set": "non-negative"}


@dataclass(frozen=True, slots=True)
class HistogramSet:
    """Samples made of histograms, one after another, each at least 0 and of sum one."""

    block: int = HISTOGRAM_BINS
    """Bins of each histogram."""

    def __post_init__(self) -> None:
        """Raise for histograms without bins."""
        Checks(FeasibleError).within("block", self.block, "[1, inf)")

    def contains(self, samples: ArrayLike) -> BoolArray:
        """Return whether each sample (..., d) lies in the set, (...)."""
        s = self._blocks(samples)
        with np.errstate(invalid="ignore"):
            good = (s >= -FEASIBLE_TOL) & (
                np.abs(s.sum(axis=-1, keepdims=True) - 1.0) <= FEASIBLE_TOL
            )
        return np.asarray(good.all(axis=(-1, -2)))

    def project(self, samples: ArrayLike, metric: Float64Array | None = None) -> Float64Array:
        """Return the nearest samples of the set, with equal weights of the bins.

        Parameters
        ----------
        samples : array_like, shape (..., d)
        metric : None
            Weights of bins are not supported.

        Returns
        -------
        ndarray of float64, shape (..., d)

        Notes
        -----
        The same amount is subtracted from all bins that stay above 0: with bins in decreasing order
        u, it is the last of (u_1 + ... + u_j - 1) / j that is below u_j (Held, Wolfe and
        Crowder 1974, doi:10.1007/BF01580223).

        Examples
        --------
        >>> HistogramSet(3).project([0.75, 0.5, -0.25]).tolist()
        [0.625, 0.375, 0.0]
        """
        if metric is not None:
            raise FeasibleError("metric: got weights, expected none for histograms")
        rows = self._blocks(samples).reshape(-1, self.block)
        return project_to_simplex(rows).reshape(np.shape(samples))

    def tangent(self, vector: ArrayLike) -> Float64Array:
        """Return the part of a direction (d,) along the set: each histogram keeps its sum."""
        s = self._blocks(vector)
        return np.asarray((s - s.mean(axis=-1, keepdims=True)).reshape(np.shape(vector)))

    def document(self) -> dict[str, Any]:
        """Return the JSON document for `from_document`."""
        return {"set": "histograms", "block": self.block}

    def _blocks(self, samples: ArrayLike) -> Float64Array:
        s = np.asarray(samples, np.float64)
        if not s.ndim or s.shape[-1] % self.block or not s.shape[-1]:
            raise FeasibleError(
                f"samples: got shape {s.shape}, expected (..., d) with d a multiple of {self.block}"
            )
        return s.reshape(*s.shape[:-1], -1, self.block)


FeasibleSet: TypeAlias = UnconstrainedSet | NonNegativeSet | HistogramSet


def from_document(document: Mapping[str, Any]) -> FeasibleSet:
    """Return the set that a `document` names."""
    name = document.get("set")
    if name == "free":
        return UnconstrainedSet()
    if name == "non-negative":
        return NonNegativeSet()
    if name == "histograms":
        return HistogramSet(int(document["block"]))
    raise FeasibleError(
        f"set: got {name!r}, expected 'free', 'non-negative' or 'histograms'; a newer version "
        "may have written it"
    )


def smallest_feasible_set(samples: Float64Array) -> FeasibleSet:
    """Return the smallest set that contains samples (n, d): histograms, non-negative, or free.

    Examples
    --------
    >>> smallest_feasible_set(np.array([[0.0, 2.0]])), smallest_feasible_set(np.array([[0.0,
    ...     -2.0]]))
    (NonNegativeSet(), UnconstrainedSet())
    """
    if samples.shape[-1] % HISTOGRAM_BINS == 0 and HistogramSet().contains(samples).all():
        return HistogramSet()
    return NonNegativeSet() if bool((samples >= 0.0).all()) else UnconstrainedSet()
