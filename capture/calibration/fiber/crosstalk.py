"""Cross-talk of fibers: fraction of every other fiber's light in each spot, and stray light."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from capture.arrays import Float64Array
from capture.calibration.fiber.readings import FiberReadings
from capture.calibration.record import CalibrationError, freeze_arrays

_log = logging.getLogger(__name__)

DISTANCE_EDGES: Final = (1, 2, 3, 4, 6, 9, 14, 21)
"""First distance, in fibers, of each group of pairs with similar cross-talk."""
GROUP_MEAN_DISTANCE: Final = 4
"""Distance, one of `DISTANCE_EDGES`, from which pairs take the mean of their group."""
MIN_PAIR_SCATTER: Final = 0.3
"""Smallest relative scatter of a group's pairs: a few of them may agree by chance."""
MAX_SPOT_OVERLAP: Final = 0.05
"""Cross-talk above which a pair's spots overlap, so that other pairs cannot follow from it."""
COVER_TRANSMITTANCE_SCATTER: Final = 0.3
"""Relative scatter of the covers' transmittance."""
MAX_CROSSTALK_ITERATIONS: Final = 30


class CrossTalkError(CalibrationError):
    """Raised for spots whose light cannot be separated."""


@dataclass(frozen=True, slots=True, eq=False)
class CrossTalk:
    """Mixing of the fibers' light in the spots' readings: ``s = X u + o``.

    Attributes
    ----------
    matrix, stderr : ndarray of float64, shape (F, F)
        X: ``matrix[j, i]`` is the reading of spot j from fiber i's light over that of spot i; 1 on
        the diagonal, with error 0.
    offset, offset_stderr : ndarray of float64, shape (F, C)
        o: stray light in each spot from outside the fibers, full scales per second; the error is
        the independent part.
    offset_common : ndarray of float64, shape (F, C)
        Change of the offsets for one standard error of the part that the spots of a color share.
    measured : bool
        False: not measured; the matrix is the identity, with unknown errors.
    cover_leak, cover_leak_stderr : float
        Transmittance of a covered fiber during the measurement, relative to its own light.
    """

    matrix: Float64Array
    stderr: Float64Array
    offset: Float64Array
    offset_stderr: Float64Array
    offset_common: Float64Array
    measured: bool = True
    cover_leak: float = 0.0
    cover_leak_stderr: float = 0.0

    def __post_init__(self) -> None:
        count = len(np.asarray(self.matrix))
        colors = np.shape(self.offset)[-1]
        freeze_arrays(self, (count, count), "matrix", "stderr")
        freeze_arrays(self, (count, colors), "offset", "offset_stderr", "offset_common")
        if not (np.diagonal(self.matrix) == 1.0).all():
            raise ValueError("CrossTalk.matrix: got a diagonal other than 1")
        away = np.abs(self.matrix).sum(axis=0) - 1.0
        if count and not float(away.max()) < 0.9:
            raise CrossTalkError(
                f"cross-talk: got {float(away.max()):.2f} of a fiber's light in the others' "
                "spots, expected less than 0.9: their light cannot be separated; check focus "
                "and cover"
            )

    def unmix(
        self, signal: Float64Array, variance: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        """Return the light of each fiber without cross-talk, and its variance.

        Parameters
        ----------
        signal, variance : ndarray of float64, shape (F, C)
            Readings and variances; the readings' errors are independent.

        Returns
        -------
        light, variance : ndarray of float64, shape (F, C)
            The variance includes the errors of readings and offset, not the matrix's: see
            `matrix_variance`.
        """
        back = np.linalg.inv(self.matrix)
        light = back @ (signal - self.offset)
        return light, back**2 @ (variance + self.offset_stderr**2)

    def matrix_variance(
        self, light: Float64Array, reference: Float64Array, ratio: Float64Array
    ) -> Float64Array:
        """Return the variance that the matrix's errors add to light relative to a reference.

        Parameters
        ----------
        light : ndarray of float64, shape (F, C)
            Light of the fibers, unmixed.
        reference : ndarray of float64, shape (F, C)
            Light of a target unmixed by the same matrix, by which `light` is divided; its errors
            are the same ones, so that the common part cancels.
        ratio : ndarray of float64, shape (F, C)
            ``light / reference``, or 0 for the variance of `light` alone.

        Returns
        -------
        ndarray of float64, shape (F, C)
            In the unit of ``light`` squared.
        """
        # -d(u_j) = sum_i dX_ji u_i to first order, and the same of the reference times the ratio
        moved = light[None] - ratio[:, None] * reference[None]  # (F j, F i, C)
        return np.asarray(np.einsum("ji,jic->jc", self.stderr**2, moved**2))

    def shared_changes(
        self, light: Float64Array, reference: Float64Array, ratio: Float64Array
    ) -> Float64Array:
        """Return the change of `light` for one standard error of each far group, shape (G, F, C).

        Cross-talk of pairs that are `GROUP_MEAN_DISTANCE` fibers apart or more is below its noise:
        only the mean of their group is known, and its error is common to all of them.

        Parameters
        ----------
        light, reference, ratio : ndarray of float64, shape (F, C)
            As in `matrix_variance`.
        """
        place = np.arange(len(light))
        group = np.searchsorted(DISTANCE_EDGES, np.abs(place[:, None] - place), side="right") - 1
        moved = light[None] - ratio[:, None] * reference[None]
        each = range(DISTANCE_EDGES.index(GROUP_MEAN_DISTANCE), len(DISTANCE_EDGES))
        return np.stack(
            [-np.einsum("ji,jic->jc", np.where(group == g, self.stderr, 0.0), moved) for g in each]
        )


def no_crosstalk(count: int, colors: int) -> CrossTalk:
    """Return an identity matrix, for a probe whose cross-talk was not measured."""
    nothing = np.zeros((count, colors))
    return CrossTalk(np.eye(count), np.zeros((count, count)), nothing, nothing, nothing, False)


def measure_crosstalk(masks: Mapping[int, FiberReadings], phantom: FiberReadings) -> CrossTalk:
    """Measure cross-talk and stray light with one fiber uncovered at a time.

    Parameters
    ----------
    masks : mapping of int to FiberReadings
        Readings by the number of the uncovered fiber, on one bright target with one light; not all
        fibers are required.
    phantom : FiberReadings
        Readings with no fiber covered, which separate the covers' leak from stray light.

    Returns
    -------
    CrossTalk

    Notes
    -----
    The reading of spot j is ``X_ji`` times the light of the uncovered fiber i, plus light that does
    not depend on i: stray light ``o_j``, and the leak of fiber j's own cover, a fraction of its
    light that is common to all covers within 30 %.

    Most of the 756 pairs of 28 fibers are below their noise. Each is shrunk to the mean of the
    pairs at its distance, with weights from their scatter (random-effects estimate, DerSimonian and
    Laird 1986, doi 10.1016/0197-2456(86)90046-2). The three colors share one matrix.
    """
    first = next(iter(masks.values()))
    count, colors = first.signal.shape
    used = [i for i in sorted(masks) if masks[i].valid[i].any()]
    # source: light of the uncovered fiber in its own spot; column i, color c
    source = np.zeros((count, colors))
    value = np.zeros((count, count, colors))  # reading of j with i uncovered
    weight = np.zeros((count, count, colors))
    for i in used:
        readings = masks[i]
        # a fiber without light only contributes to the estimate of stray light
        source[i] = np.where(readings.detected[i], readings.signal[i], 0.0)
        good = readings.valid & readings.valid[i]
        value[:, i] = readings.signal
        weight[:, i] = np.where(good, 1.0 / np.maximum(readings.variance, 1e-300), 0.0)
    rows = np.arange(count)
    weight[rows, rows] = 0.0
    distance = np.abs(rows[:, None] - rows[None])
    group = np.searchsorted(DISTANCE_EDGES, distance, side="right") - 1  # -1 on the diagonal
    offset, offset_variance = np.zeros((count, colors)), np.zeros((count, colors))
    matrix, variance = np.zeros((count, count)), np.zeros((count, count))
    # Model: value[j, i] = X[j, i] source[i] + offset[j]. It is linear in X for a given offset and
    # in the offset for a given X, so that the two are solved in turn.
    information = np.einsum("jic,ic->ji", weight, source**2)
    for _ in range(MAX_CROSSTALK_ITERATIONS):
        # each pair on its own, for the present estimate of the stray light
        seen = np.einsum("jic,ic->ji", weight * (value - offset[:, None]), source)
        matrix, variance = _shrink_to_group_mean(seen, information, group)
        # stray light, for the present pairs; a pair's uncertainty counts as noise
        doubt = weight / (1.0 + weight * source[None] ** 2 * variance[..., None])
        total = doubt.sum(axis=1)
        rest = value - matrix[..., None] * source[None]
        known = total > 0
        before = offset
        offset = np.where(known, (doubt * rest).sum(axis=1) / np.where(known, total, 1.0), 0.0)
        offset_variance = np.where(known, 1.0 / np.where(known, total, 1.0), 0.0)
        if (np.abs(offset - before) <= 1e-3 * np.sqrt(offset_variance)).all():
            break
    else:
        _log.warning("cross-talk: not converged after %d iterations", MAX_CROSSTALK_ITERATIONS)
    np.fill_diagonal(matrix, 1.0)
    np.fill_diagonal(variance, 0.0)
    leak, leak_stderr, offset, offset_stderr, common = _separate_stray_light(
        offset, offset_variance, phantom
    )
    return CrossTalk(
        matrix, np.sqrt(variance), offset, offset_stderr, common, True, leak, leak_stderr
    )


def _separate_stray_light(
    steady: Float64Array, variance: Float64Array, phantom: FiberReadings
) -> tuple[float, float, Float64Array, Float64Array, Float64Array]:
    """Split the light common to all masks into the covers' leak and stray light.

    Returns the leak, its standard error, and stray light shrunk to the mean of each color's spots,
    with its independent and common errors, shape (F, C).
    """
    count, colors = steady.shape
    good = phantom.valid & (variance > 0)
    source = np.where(good, np.maximum(phantom.signal, 0.0), 0.0)
    leak, leak_variance = 0.0, 0.0
    level = np.zeros(colors)
    for _ in range(MAX_CROSSTALK_ITERATIONS):
        # one leak and a stray light in each color; covers differ, so that bright fibers must not
        # dominate
        spread = np.where(
            good, variance + (COVER_TRANSMITTANCE_SCATTER * leak * source) ** 2, np.inf
        )
        design = np.zeros((count, colors, 1 + colors))
        design[..., 0] = source
        design[:, np.arange(colors), 1 + np.arange(colors)] = 1.0
        weighed = design / spread[..., None]
        normal = np.einsum("fcp,fcq->pq", weighed, design)
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        inverse = np.linalg.pinv(normal / np.outer(scale, scale)) / np.outer(scale, scale)
        found = inverse @ np.einsum("fcp,fc->p", weighed, np.where(good, steady, 0.0))
        before = leak
        leak, leak_variance = max(float(found[0]), 0.0), float(inverse[0, 0])
        level = found[1:]
        if abs(leak - before) <= 1e-3 * leak:
            break
    else:
        _log.warning("leak of covers: not converged after %d iterations", MAX_CROSSTALK_ITERATIONS)
    rest = steady - leak * source
    doubt = variance + source**2 * (leak_variance + (COVER_TRANSMITTANCE_SCATTER * leak) ** 2)
    stray = np.tile(level, (count, 1))
    own, common = np.zeros((count, colors)), np.zeros((count, colors))
    for c in range(colors):
        if good[:, c].any():
            stray[:, c], own[:, c], common[:, c] = shrink_to_mean(
                rest[:, c], np.where(good[:, c], 1.0 / np.maximum(doubt[:, c], 1e-300), 0.0), 0.0
            )
    return leak, float(np.sqrt(leak_variance)), stray, own, common


def _shrink_to_group_mean(
    observed: Float64Array, information: Float64Array, group: NDArray[np.intp]
) -> tuple[Float64Array, Float64Array]:
    """Return each pair shrunk to its group's mean, and its variance."""
    matrix, variance = np.zeros_like(observed), np.zeros_like(observed)
    own = np.divide(observed, information, out=np.zeros_like(observed), where=information > 0)
    last = 0.0
    overlap = own > MAX_SPOT_OVERLAP
    matrix[overlap] = own[overlap]
    variance[overlap] = 1.0 / information[overlap]
    for number in range(int(group.max(initial=-1)) + 1):
        here = (group == number) & ~overlap
        if (information[here] > 0).any():
            matrix[here], alone, common = shrink_to_mean(
                own[here], information[here], MIN_PAIR_SCATTER
            )
            variance[here] = alone**2 + common**2
            last = float(np.median(np.abs(matrix[here])))
        else:
            # no data for this distance: its cross-talk is at most that of the distance before
            variance[here] = last**2
    return matrix, variance


def shrink_to_mean(
    value: Float64Array, information: Float64Array, min_scatter: float
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Shrink values to their mean by their own scatter; return them with their standard errors.

    The first errors are independent, the second is the common error of the mean.

    Parameters
    ----------
    value : ndarray of float64, shape (n,)
    information : ndarray of float64, shape (n,)
        Inverse variances; 0 for missing values, at least one above 0.
    min_scatter : float
        Smallest standard deviation of the true values over their mean: a few may agree by chance.

    Examples
    --------
    >>> value, _, _ = shrink_to_mean(np.array([1.0, 3.0, 9.0]), np.array([1e4, 1e4, 0.0]), 0.0)
    >>> value.round(2).tolist()
    [1.0, 3.0, 2.0]
    """
    has_data = information > 0
    w, x = information[has_data], value[has_data]
    mean = float((w * x).sum() / w.sum())
    # DerSimonian and Laird: Q = sum w (x - mean)^2 has the expectation (n - 1) + between (sum w -
    # sum w^2 / sum w), which is solved for the variance between the true values.
    spread = float((w * (x - mean) ** 2).sum()) - (len(x) - 1)
    scale = float(w.sum() - (w**2).sum() / w.sum())
    between = max(spread / scale, 0.0) if scale > 0 else mean**2
    between = max(between, (min_scatter * mean) ** 2)
    both = 1.0 / (1.0 / w + between)
    mean, error = float((both * x).sum() / both.sum()), 1.0 / float(both.sum())
    share = between * information / (1.0 + between * information)
    known = np.where(has_data, value, mean)
    return (
        share * known + (1.0 - share) * mean,
        np.sqrt((1.0 - share) * between),
        (1.0 - share) * np.sqrt(error),
    )
