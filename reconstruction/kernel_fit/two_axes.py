"""Kernels along and across the jaws, each the best beside the other.

The paper fits one axis at a time (Nagano2015, eq. 7). Here the relief is convolved with the kernel
of one axis while that of the other is fitted, in turn until neither changes.

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from reconstruction.arrays import FloatArray
from reconstruction.kernel_fit.fit import fit_kernel
from reconstruction.kernel_fit.neutral_relief import Axis, KernelFitError, convolved
from reconstruction.kernel_fit.outcome import KernelFit

START_KERNELS = ((0.0, 1.0), (0.6, 15.0), (-0.6, 15.0), (1.0, 30.0), (-1.5, 8.0))
"""alpha and sigma_um across the jaws that fits begin with."""


@dataclass(frozen=True, slots=True)
class TwoAxisFit:
    """Kernels along and across the jaws, which the paper fits one at a time.

    Attributes
    ----------
    along, across : KernelFit
        Each is the best with the other as it is; their `distance` is that of both together,
        `distance_before` that of the other alone.
    distance : float
        Eq. (7)'s sum with both kernels.
    rounds : int
        Pairs of fits that were made.
    settled : bool
        Neither kernel changed in the last round: each is the best beside the other. A pair far
        away that no start leads to may be better.
    """

    along: KernelFit
    across: KernelFit
    distance: float
    rounds: int
    settled: bool


def fit_two_axes(
    neutral_height_um: ArrayLike,
    target_histogram: FloatArray,
    *,
    stretch: float,
    stretch_across: float,
    axis: Axis,
    pixel_um: float | tuple[float, float],
    valid: ArrayLike | None = None,
    most_rounds: int = 6,
    starts: Sequence[tuple[float, float]] = START_KERNELS,
    **settings: Any,
) -> TwoAxisFit:
    """Fit (alpha, sigma) along the jaws and across them, in turn until neither changes.

    Parameters
    ----------
    neutral_height_um, target_histogram, stretch, stretch_across, axis, pixel_um, valid
        As of `kernel_fit.fit_kernel`; the axis is that of the jaws.
    most_rounds : int
        Rounds of one fit along and one across, at least 1, from each start.
    starts : sequence of (float, float)
        alpha and sigma_um across the jaws to begin with; the least distance is taken.
    settings
        Others of `kernel_fit.fit_kernel`.

    Returns
    -------
    TwoAxisFit
        Of starts that come to equal distances, the first.

    Raises
    ------
    KernelFitError
        Without a round or a start, and as of `kernel_fit.fit_kernel`.
    """
    if most_rounds < 1:
        raise KernelFitError(f"most_rounds: got {most_rounds}, expected at least 1")
    if not starts:
        raise KernelFitError("starts: got none, expected one pair of alpha and sigma_um or more")
    other: Axis = "x" if axis in ("y", 0) else "y"
    found = []
    for start in starts:
        pair = [(0.0, 1.0), (float(start[0]), float(start[1]))]
        before: list[tuple[float, float]] = []
        fits: list[KernelFit] = []
        rounds = 0
        while rounds < most_rounds and pair != before:
            before, fits = list(pair), []
            rounds += 1
            for turn, (own, across) in enumerate(((axis, other), (other, axis))):
                ratios = (stretch, stretch_across) if turn == 0 else (stretch_across, stretch)
                relief = convolved(
                    neutral_height_um, *pair[1 - turn], axis=across, pixel_um=pixel_um, valid=valid
                )
                fit = fit_kernel(
                    relief,
                    target_histogram,
                    stretch=ratios[0],
                    stretch_across=ratios[1],
                    axis=own,
                    pixel_um=pixel_um,
                    valid=valid,
                    **settings,
                )
                pair[turn] = fit.alpha, fit.sigma_um
                fits.append(fit)
        found.append(TwoAxisFit(fits[0], fits[1], fits[1].distance, rounds, pair == before))
    return min(found, key=lambda fit: fit.distance)
