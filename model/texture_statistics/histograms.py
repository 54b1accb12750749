"""Histograms over fixed non-uniform bins: counts, distances, matching, projection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import BoolArray, Float64Array, FloatArray, Int64Array
from model.checks import Checks
from model.texture_statistics import histogram_kernels
from model.vectors import project_to_simplex

HISTOGRAM_BINS = 256
"""Bins of every histogram (Weyrich et al. 2006, section 10.2)."""


class TextureHistogramError(ValueError):
    """Error for edges, histograms or groups of a wrong shape or range."""


@dataclass(frozen=True, slots=True, eq=False)
class HistogramCount:
    """One histogram and the properties of its samples."""

    fractions: Float64Array
    """(256,), sums to 1."""
    below: float
    """Fraction of values below the edges, counted in the first bin."""
    above: float
    """Fraction of values above the edges, counted in the last bin."""
    min_value: float
    """Least value."""
    max_value: float
    """Largest value."""
    n_effective: float
    """Number of equally weighted samples with the same variance."""


@dataclass(frozen=True, slots=True, eq=False)
class Bins:
    """256 bins with a look-up table from values to bins."""

    edges: Float64Array
    """(257,), increasing; a bin includes its lower edge."""
    scale: float
    min_bin: NDArray[np.int16]
    max_bin: NDArray[np.int16]

    @classmethod
    def from_edges(cls, edges: ArrayLike) -> Bins:
        """Make bins with the given edges."""
        e = np.ascontiguousarray(edges, np.float64)
        _check_edges(e, (HISTOGRAM_BINS + 1,))
        scale = histogram_kernels.TABLE_CELLS / float(e[-1] - e[0])
        least = np.empty(histogram_kernels.TABLE_CELLS, np.int16)
        most = np.empty_like(least)
        histogram_kernels.bound_bins(e, HISTOGRAM_BINS, scale, least, most)
        return cls(e, scale, least, most)

    def count(self, values: FloatArray, weights: FloatArray | None = None) -> HistogramCount:
        """Count values (any shape), weighted or not.

        Examples
        --------
        >>> found = Bins.from_edges(np.arange(257.0)).count(np.array([-1.0, 0.0, 3.5, 256.0]))
        >>> found.fractions[[0, 3, 255]].tolist(), found.below
        ([0.5, 0.25, 0.25], 0.25)
        """
        flat = np.ascontiguousarray(values).reshape(-1)
        sums = np.zeros(HISTOGRAM_BINS)
        table = (self.edges, self.scale, self.min_bin, self.max_bin, sums)
        if weights is None:
            below, above, least, most = histogram_kernels.count(flat, *table)
            squares = float(flat.size)
        else:
            some = np.ascontiguousarray(weights, flat.dtype).reshape(-1)
            below, above, least, most, squares = histogram_kernels.count_weighted(
                flat, some, *table
            )
        total = float(sums.sum())
        if not total > 0.0:
            raise TextureHistogramError("weights: got none above 0, expected at least one")
        return HistogramCount(
            sums / total, below / total, above / total, least, most, total * total / squares
        )

    def match(
        self,
        values: FloatArray,
        source: HistogramCount,
        target: Float64Array,
        *,
        out: FloatArray | None = None,
    ) -> FloatArray:
        """Move values so that their histogram becomes the target's.

        Parameters
        ----------
        values
            Of any shape.
        source
            Result of `count` for them.
        target : ndarray, shape (256,)
            At least 0, sums to 1.
        out : ndarray or None
            Output array, contiguous; may be ``values`` itself.

        Returns
        -------
        ndarray, shape and dtype of values
            For an identical histogram the same values, to rounding.

        Raises
        ------
        TextureHistogramError
            For values that are not finite, and a target of another shape, with a negative fraction
            or without any above 0.

        Notes
        -----
        The density is uniform within a bin, so that the mapping has no steps. Values beyond the
        edges widen the end bins of both histograms up to those values.
        """
        flat = np.ascontiguousarray(values).reshape(-1)
        _check_fractions("target", target, HISTOGRAM_BINS)
        Checks(TextureHistogramError).within("values (leave out what is masked)", flat)
        own, wanted = cumulate_fractions(source.fractions), cumulate_fractions(target)
        edges = self.edges.copy()
        edges[0], edges[-1] = min(edges[0], source.min_value), max(edges[-1], source.max_value)
        moved = np.empty(np.shape(values), flat.dtype) if out is None else out
        histogram_kernels.move_values(flat, own, wanted, edges, moved.reshape(-1))
        return moved


def _check_fractions(name: str, fractions: ArrayLike, bins: int | None = None) -> Float64Array:
    check = Checks(TextureHistogramError)
    h = check.numbers(name, fractions, ("...", bins or "bins"), interval="[0, inf)")
    check.within(f"sum of {name}", h.sum(axis=-1), "(0, inf)")
    return h


def _check_edges(edges: Float64Array, shape: tuple[int | str, ...]) -> None:
    Checks(TextureHistogramError).numbers("edges", edges, shape)
    Checks(TextureHistogramError).within("steps of edges", np.diff(edges, axis=-1), "(0, inf)")


def cumulate_fractions(fractions: ArrayLike) -> Float64Array:
    """Return the cumulative fractions at all edges, (..., 257), from 0 to exactly 1.

    Raises
    ------
    TextureHistogramError
        For fractions that are not finite, negative, or all 0.
    """
    h = _check_fractions("fractions", fractions)
    run = np.concatenate([np.zeros((*h.shape[:-1], 1)), np.cumsum(h, axis=-1)], axis=-1)
    run /= run[..., -1:]
    return np.asarray(np.minimum(run, 1.0))


def histogram_distance(a: ArrayLike, b: ArrayLike, edges: ArrayLike) -> Float64Array:
    """Return the earth mover's distance of two histograms, in widths of the middle bins.

    Parameters
    ----------
    a, b : array_like, shape (..., 256)
        Histograms that sum to 1.
    edges : array_like, shape (..., 257)

    Returns
    -------
    ndarray, shape (...)
        Mean distance by which values must move, over the width of the middle half of the bins; in a
        fitted space that width is about the span of the population.

    Raises
    ------
    TextureHistogramError
        For fractions that are not finite, negative or all 0, and edges that do not increase.

    Examples
    --------
    >>> float(histogram_distance(np.eye(256)[3], np.eye(256)[131], np.arange(257.0)))
    1.0
    """
    e = np.asarray(edges, np.float64)
    first, second = (
        _check_fractions("a", a, HISTOGRAM_BINS),
        _check_fractions("b", b, HISTOGRAM_BINS),
    )
    _check_edges(e, ("...", HISTOGRAM_BINS + 1))
    apart = np.abs(cumulate_fractions(first) - cumulate_fractions(second))
    moved = np.sum(0.5 * (apart[..., 1:] + apart[..., :-1]) * np.diff(e, axis=-1), axis=-1)
    quarter = HISTOGRAM_BINS // 4
    return np.asarray(moved / (e[..., 3 * quarter] - e[..., quarter]))


def project_to_histograms(vectors: ArrayLike) -> Float64Array:
    """Return the nearest vectors (least squares) of valid histograms.

    Parameters
    ----------
    vectors : array_like, shape (..., n)
        n a multiple of 256; finite.

    Returns
    -------
    ndarray of float64, same shape
        At least 0; every run of 256 sums to 1. A valid vector is returned unchanged, to rounding.

    Notes
    -----
    Each histogram is projected on the simplex: a constant is subtracted and negative results are
    set to 0 (Held, Wolfe, Crowder 1974, doi:10.1007/BF01580223).

    Examples
    --------
    >>> edited = np.zeros(256)
    >>> edited[:3] = 0.9, 0.3, -0.2
    >>> project_to_histograms(edited)[:3].round(6).tolist()
    [0.8, 0.2, 0.0]
    """
    v = Checks(TextureHistogramError).numbers("vectors", vectors, ("...", "n"))
    whole = v.size and v.shape[-1] % HISTOGRAM_BINS == 0
    Checks(TextureHistogramError).require(whole, "vectors", v.shape, f"(..., n x {HISTOGRAM_BINS})")
    return project_to_simplex(v.reshape(-1, HISTOGRAM_BINS)).reshape(v.shape)


@dataclass(frozen=True, slots=True, eq=False)
class GroupHistograms:
    """Color histograms averaged over groups of images."""

    edges: Float64Array
    """(B + 1,), unit of the images."""
    names: tuple[str, ...]
    """The G groups."""
    mean: Float64Array
    """(G, channels, B): mean over images of equal weight; each sums to 1."""
    stderr: Float64Array
    """(G, channels, B): standard error of the mean over the group; NaN in groups of one."""
    members: Int64Array
    """(G,)"""
    clipped: Float64Array
    """(G, channels): fraction outside the edges, counted in the end bins."""


def rgb_histograms(
    images: Sequence[ArrayLike],
    groups: Mapping[str, ArrayLike],
    valid: Sequence[BoolArray | None] | None = None,
    *,
    reach: tuple[float, float] = (0.0, 1.0),
    bins: int = HISTOGRAM_BINS,
) -> GroupHistograms:
    """Average the color histograms of images over groups (Weyrich et al. 2006, figure 16).

    Parameters
    ----------
    images : sequence of (H, W, C)
        Sizes may differ; finite where valid.
    groups : mapping of str to bool array, shape (images,)
        Members; an image may be in several.
    valid : sequence of (H, W) bool, or None
        Texels that count.
    reach : tuple of float
        First and last edge; the bins between have equal widths.
    bins : int
        At least 2.

    Examples
    --------
    >>> dark, light = np.full((4, 4, 3), 0.1), np.full((4, 4, 3), 0.9)
    >>> found = rgb_histograms([dark, light], {"all": [True, True]}, bins=2)
    >>> found.mean[0].tolist(), found.members.tolist()
    ([[0.5, 0.5], [0.5, 0.5], [0.5, 0.5]], [2])
    """
    low, high = reach
    check = Checks(TextureHistogramError)
    check.within("bins", bins, "[2, inf)")
    check.within("reach", high, f"({low}, inf)")
    check.require(valid is None or len(valid) == len(images), "valid", valid, "a mask an image")
    edges = np.linspace(low, high, bins + 1)
    found, outside = [], []
    for number, image in enumerate(images):
        pixels = np.asarray(image)
        mask = None if valid is None else valid[number]
        check.shape(f"images[{number}]", pixels, ("H", "W", "C"))
        check.shape(f"valid[{number}]", mask, pixels.shape[:2])
        rows = pixels.reshape(-1, pixels.shape[2]) if mask is None else pixels[mask]
        if not len(rows) or not np.isfinite(rows).all():
            raise TextureHistogramError(
                f"images[{number}]: got no valid texel, or one that is not finite"
            )
        shares = [np.histogram(np.clip(c, low, high), edges)[0] / len(rows) for c in rows.T]
        found.append(shares)
        outside.append(((rows < low) | (rows > high)).mean(axis=0))
    each, beyond = np.array(found), np.array(outside)
    mean, stderr, clipped, members = [], [], [], []
    for name, flags in groups.items():
        chosen = np.asarray(flags)
        check.mask(f"groups[{name!r}]", chosen, (len(images),))
        n = int(chosen.sum())
        check.within(f"members of groups[{name!r}]", n, "[1, inf)")
        mean.append(each[chosen].mean(axis=0))
        spread = each[chosen].std(axis=0, ddof=1) if n > 1 else np.full(each.shape[1:], np.nan)
        stderr.append(spread / np.sqrt(n))
        clipped.append(beyond[chosen].mean(axis=0))
        members.append(n)
    return GroupHistograms(
        edges,
        tuple(groups),
        np.array(mean),
        np.array(stderr),
        np.array(members, np.int64),
        np.array(clipped),
    )
