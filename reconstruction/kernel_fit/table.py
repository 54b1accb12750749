"""Fit a table of kernels over the stretch ratio to kernels of single strain steps.

alpha: connected lines through the neutral kernel (r = 1, alpha = 0), clipped to [-2, 1] by the
kernel's definition. The Bayesian information criterion selects the number of lines up to a given
one, least squares their breaks. sigma: one line for compression and one for stretching, which do
not meet (Nagano2015, section 5, "Kernel Table Construction", done there by hand).

References
----------
Nagano et al. 2015, ACM Trans. Graph. 34(4), 109. doi:10.1145/2766894
Schwarz 1978, Estimating the Dimension of a Model, Ann. Statist. 6(2), 461.
doi:10.1214/aos/1176344136
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import lsq_linear
from scipy.special import fdtrc

from model.checks import Checks
from model.microstructure import ALPHA_LIMITS, KernelTable, kernel_parameters
from reconstruction.arrays import BoolArray, Float64Array

MIN_POINTS = 2
"""Fewest points that inform a line of alpha; its ends and the neutral kernel count."""
BREAK_GRID = 24
"""Positions tried for a break, besides the points', before it is moved in finer steps."""
NEUTRAL_STRETCH_TOL = 1e-6
"""Distance from 1 up to which a stretch ratio is neutral and informs neither branch."""
MIN_SIGMA_UM = 1.0
"""The smallest sigma that Nagano2015 searches, section 5."""


class KernelTableFitError(ValueError):
    """Points that no table can be fitted to."""


@dataclass(frozen=True, slots=True)
class TableFit:
    """A fitted table with residuals and errors.

    Attributes
    ----------
    table : KernelTable
    segments : int
        Lines of alpha, without the parts clipped at the limits.
    criterion : dict of int to float
        Bayesian information criterion of each number of lines that was tried; the least is taken.
    alpha_rms : float
        Root mean square of alpha's weighted residuals.
    sigma_rms_um : tuple of float
        The same of sigma, um, in compression and in stretching; NaN without that branch.
    alpha_stderr : tuple of float
        Standard errors of the slopes of alpha's lines at these breaks; infinite without degrees of
        freedom.
    break_stderr : tuple of float
        Half the range of each break within which the sum of squares grows by at most one
        residual's (a break's likelihood has corners at the points).
    sigma_compression_stderr_um, sigma_stretch_stderr_um : (slope, intercept)
        Standard errors of sigma's lines, um.
    sigma_compression_covariance_um2, sigma_stretch_covariance_um2 : float
        Covariance of slope and intercept, um^2.
    alpha_covariance : ndarray, shape (segments, segments)
        Covariance of the slopes at these breaks.
    """

    table: KernelTable
    segments: int
    criterion: Mapping[int, float]
    alpha_rms: float
    sigma_rms_um: tuple[float, float]
    alpha_stderr: tuple[float, ...]
    break_stderr: tuple[float, ...]
    sigma_compression_stderr_um: tuple[float, float]
    sigma_stretch_stderr_um: tuple[float, float]
    sigma_compression_covariance_um2: float
    sigma_stretch_covariance_um2: float
    alpha_covariance: Float64Array


def fit_table(
    stretch: ArrayLike,
    alpha: ArrayLike,
    sigma_um: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    max_segments: int = 2,
    min_points: int = MIN_POINTS,
    source: str = "fitted",
) -> TableFit:
    """Fit a table of kernels to kernels fitted at single stretch ratios.

    Parameters
    ----------
    stretch, alpha, sigma_um : array_like, shape (N,)
        Ratios r > 0, strengths in [-2, 1], standard deviations > 0 in um.
    weights : array_like, shape (N,) or (N, 2), optional
        Inverse variances of the points, up to a common factor found from the residuals: of both
        parameters, or of alpha and of sigma. Equal by default; 0 omits a point.
    max_segments : int
        Largest number of lines of alpha, 1...4; eq. (8) has two within its limits.
    min_points : int
        Fewest points that inform each line of alpha: on it or its ends, the neutral kernel among
        them, and not clipped at a limit.
    source : str
        Source recorded in the table.

    Returns
    -------
    TableFit
        Its table covers the stretch ratios of the points, and 1.

    Raises
    ------
    KernelTableFitError
        For fewer than two points on a side with any, or values beyond their ranges.
    """
    check = Checks(KernelTableFitError)
    r, a, s = (np.asarray(v, np.float64).reshape(-1) for v in (stretch, alpha, sigma_um))
    for name, values in (("alpha", a), ("sigma_um", s)):
        check.shape(name, values, r.shape)
    w = np.ones((r.size, 2)) if weights is None else np.asarray(weights, np.float64)
    w = np.broadcast_to(w[:, None] if w.ndim == 1 else w, (w.shape[0], 2))
    w = check.numbers("weights", w, (r.size, 2), interval="[0, inf)")
    check.within("max_segments", max_segments, "[1, 4]")
    check.within("min_points", min_points, "[1, inf)")
    for point, (stretched, strength, width) in enumerate(zip(r, a, s, strict=True)):
        check.within(f"point {point}, stretch", stretched, "(0, inf)")
        check.within(f"point {point}, alpha", strength, str(list(ALPHA_LIMITS)))
        check.within(f"point {point}, sigma_um", width, "(0, inf)")
    informing = (np.abs(r - 1.0) > NEUTRAL_STRETCH_TOL) & (w > 0).all(axis=1)
    r, a, s, w = r[informing], a[informing], s[informing], w[informing]
    low, high = r < 1.0, r > 1.0
    for name, side in (("compression", low), ("stretching", high)):
        ratios = np.unique(r[side]).size
        check.require(ratios != 1, name, "one stretch ratio", "at least two")
    check.require(r.size, "stretch", "neutral points only", "others with positive weights")
    order = np.argsort(r)
    r, a, s, w, low, high = r[order], a[order], s[order], w[order], low[order], high[order]
    points = _Points(r, a, w[:, 0])
    fits: dict[int, _AlphaFit] = {}
    criterion = {}
    n = r.size
    for segments in range(1, max_segments + 1):
        fit = points.fit_lines(segments, min_points)
        if fit is None or n <= 2 * segments - 1:
            continue
        fits[segments] = fit
        # BIC = n log(mean square) + parameters log n: k slopes and k - 1 breaks; the floor is for
        # points exactly on lines
        mean = max(fit.rss / points.w.sum(), 1e-12)
        criterion[segments] = n * math.log(mean) + (2 * segments - 1) * math.log(n)
    check.require(fits, "alpha", f"{n} points", "more than a line's one slope")
    segments = min(criterion, key=lambda k: criterion[k])
    lines = fits[segments]
    covariance = lines.covariance()
    branches = [_fit_sigma(r[side], s[side], w[side, 1]) for side in (low, high)]
    table = KernelTable(
        alpha_breaks=tuple(lines.breaks.tolist()),
        alpha_lines=_lines(lines.slopes, lines.breaks),
        sigma_compression_um=branches[0][0],
        sigma_stretch_um=branches[1][0],
        stretch_range=(min(float(r[0]), 1.0), max(float(r[-1]), 1.0)),
        source=source,
    )
    return TableFit(
        table=table,
        segments=segments,
        criterion=criterion,
        alpha_rms=math.sqrt(lines.rss / points.w.sum()),
        sigma_rms_um=(branches[0][3], branches[1][3]),
        alpha_stderr=tuple(np.sqrt(np.diag(covariance)).tolist()),
        break_stderr=lines.break_stderr(),
        sigma_compression_stderr_um=branches[0][1],
        sigma_stretch_stderr_um=branches[1][1],
        sigma_compression_covariance_um2=branches[0][2],
        sigma_stretch_covariance_um2=branches[1][2],
        alpha_covariance=covariance,
    )


def _design(r: Float64Array, breaks: Float64Array) -> Float64Array:
    """Return the signed length between 1 and r on each line, so that alpha = design @ slopes."""
    edges = np.concatenate([[-np.inf], breaks, [np.inf]])
    low, high = np.minimum(r, 1.0)[:, None], np.maximum(r, 1.0)[:, None]
    overlap = np.minimum(high, edges[1:]) - np.maximum(low, edges[:-1])
    return np.maximum(overlap, 0.0) * np.sign(r - 1.0)[:, None]


def _lines(slopes: Float64Array, breaks: Float64Array) -> tuple[tuple[float, float], ...]:
    """Return (slope, intercept) of each line."""
    values = _design(breaks, breaks) @ slopes if breaks.size else np.zeros(0)
    edges = np.concatenate([[-np.inf], breaks, [np.inf]])
    lines = []
    for k, m in enumerate(slopes):
        # the line through the neutral kernel goes through it without rounding
        r0, v0 = 1.0, 0.0
        if not edges[k] < 1.0 <= edges[k + 1]:
            r0, v0 = breaks[max(k - 1, 0)], values[max(k - 1, 0)]
        lines.append((float(m), float(v0 - m * r0)))
    return tuple(lines)


@dataclass(frozen=True, slots=True)
class _Points:
    """Stretches, strengths and weights that lines are fitted to."""

    r: Float64Array
    a: Float64Array
    w: Float64Array

    def slopes(self, breaks: Float64Array) -> tuple[Float64Array, BoolArray, float]:
        """Return slopes by least squares, the points that inform them, and the sum of squares.

        A point on a limit is met exactly where the lines go beyond it; it does not inform a slope.
        """
        a, X, root = self.a, _design(self.r, breaks), np.sqrt(self.w)
        used = np.ones(a.size, bool)
        best: tuple[Float64Array, BoolArray, float] | None = None
        for _ in range(8):
            solved = np.linalg.lstsq(root[used, None] * X[used], root[used] * a[used])[0]
            slopes = np.asarray(solved, np.float64)
            line = X @ slopes
            beyond = ((a <= ALPHA_LIMITS[0]) & (line < a)) | ((a >= ALPHA_LIMITS[1]) & (line > a))
            rss = float(np.sum(self.w * (np.clip(line, *ALPHA_LIMITS) - a) ** 2))
            if best is None or rss < best[2]:
                best = slopes, ~beyond, rss
            if (used == ~beyond).all() or beyond.all():
                break
            used = ~beyond
        assert best is not None  # noqa: S101
        return best

    def fit_lines(self, segments: int, min_points: int) -> _AlphaFit | None:
        """Fit lines and breaks by least squares; None without enough points."""

        def tried(breaks: Float64Array) -> _AlphaFit:
            none = _AlphaFit(self, breaks, breaks, math.inf)
            if (np.diff(breaks) <= 0).any():
                return none
            slopes, informing, rss = self.slopes(breaks)
            edges = np.concatenate([[-np.inf], breaks, [np.inf]])
            points = np.append(self.r[informing], 1.0)
            for first, last in pairwise(edges):
                if np.count_nonzero((points >= first) & (points <= last)) < min_points:
                    return none
            return _AlphaFit(self, slopes, breaks, rss)

        low, high = min(self.r[0], 1.0), max(self.r[-1], 1.0)
        places = np.union1d(np.linspace(low, high, BREAK_GRID), self.r)
        found = [tried(np.array(chosen)) for chosen in combinations(places, segments - 1)]
        best = min(found, key=lambda fit: fit.rss)
        if not math.isfinite(best.rss):
            return None
        step = (high - low) / BREAK_GRID
        for _ in range(3):  # finer around the best, one break at a time
            for k in range(segments - 1):
                for place in np.linspace(best.breaks[k] - step, best.breaks[k] + step, 41):
                    other = tried(best.move_break(k, place))
                    if other.rss < best.rss - 1e-15:
                        best = other
            step /= 10.0
        return best


@dataclass(frozen=True, slots=True)
class _AlphaFit:
    """Lines fitted by least squares, with their residual sum of squares."""

    points: _Points
    slopes: Float64Array
    breaks: Float64Array
    rss: float

    @property
    def dof(self) -> int:
        """Degrees of freedom."""
        return self.points.r.size - self.slopes.size - self.breaks.size

    def move_break(self, k: int, position: float) -> Float64Array:
        """Return the breaks with one of them moved."""
        breaks = self.breaks.copy()
        breaks[k] = position
        return breaks

    def covariance(self) -> Float64Array:
        """Return the slopes' covariance at these breaks; infinite without degrees of freedom."""
        slopes, informing, _ = self.points.slopes(self.breaks)
        X = _design(self.points.r, self.breaks)[informing]
        if self.dof <= 0 or np.linalg.matrix_rank(X) < slopes.size:
            return np.diag(np.full(slopes.size, np.inf))
        weighted = X * self.points.w[informing, None]
        return np.asarray(np.linalg.inv(weighted.T @ X) * self.rss / self.dof)

    def break_stderr(self) -> tuple[float, ...]:
        """Return half the range of each break until the misfit grows by one residual's."""
        if self.dof <= 0:
            return (math.inf,) * self.breaks.size
        most = self.rss * (1.0 + 1.0 / self.dof)
        widths = []
        for k in range(self.breaks.size):
            near = [float(self.breaks[k])]
            for place in np.linspace(self.points.r[0], self.points.r[-1], 400):
                breaks = self.move_break(k, place)
                if (np.diff(breaks) > 0).all() and self.points.slopes(breaks)[2] <= most:
                    near.append(float(place))
            widths.append(0.5 * (max(near) - min(near)))
        return tuple(widths)


def _fit_sigma(
    r: Float64Array, s: Float64Array, w: Float64Array
) -> tuple[tuple[float, float] | None, tuple[float, float], float, float]:
    """Return line, standard errors, covariance and weighted RMS residual of one branch, um.

    The line is not below `MIN_SIGMA_UM` between r = 1 and the outermost point. Where that binds,
    the standard errors are those of the line without the bound.
    """
    if r.size == 0:
        return None, (math.inf, math.inf), math.inf, math.nan
    X = np.stack([r, np.ones(r.size)], axis=1)
    N = (X * w[:, None]).T @ X
    C = np.linalg.inv(N)
    line = C @ (X.T @ (w * s))
    far = float(r[np.argmax(np.abs(r - 1.0))])
    ends = np.array([[1.0, 1.0], [far, 1.0]])
    if (ends @ line < MIN_SIGMA_UM).any():
        root, to_line = np.sqrt(w), np.linalg.inv(ends)
        held = lsq_linear(root[:, None] * X @ to_line, root * s, (MIN_SIGMA_UM, np.inf))
        line = to_line @ held.x
    rss = float(np.sum(w * (X @ line - s) ** 2))
    rms = math.sqrt(rss / w.sum())
    pair = (float(line[0]), float(line[1]))
    if r.size < 3:
        return pair, (math.inf, math.inf), math.inf, rms
    C = C * rss / (r.size - 2)
    return pair, (math.sqrt(C[0, 0]), math.sqrt(C[1, 1])), float(C[0, 1]), rms


@dataclass(frozen=True, slots=True)
class DirectionDependence:
    """Deviations of kernels under single directions of stretch from one table of all directions.

    Attributes
    ----------
    angle_rad : tuple of float
        Directions of the jaws.
    alpha_offset, sigma_offset_um : tuple of float
        Mean residual of each direction against the table.
    alpha_stderr, sigma_stderr_um : tuple of float
        Standard errors of the offsets, from the scatter within directions.
    p_alpha, p_sigma : float
        Probability of offsets that differ as much if the direction has no effect (one-way analysis
        of variance; the table's own fit is not counted). The paper observed such a dependence on
        the chin, and omits it from its model.
    """

    angle_rad: tuple[float, ...]
    alpha_offset: tuple[float, ...]
    sigma_offset_um: tuple[float, ...]
    alpha_stderr: tuple[float, ...]
    sigma_stderr_um: tuple[float, ...]
    p_alpha: float
    p_sigma: float


def estimate_direction_dependence(
    table: KernelTable,
    stretch: ArrayLike,
    alpha: ArrayLike,
    sigma_um: ArrayLike,
    angle_rad: ArrayLike,
) -> DirectionDependence:
    """Compare kernels fitted under several directions of stretch with one table.

    Parameters
    ----------
    table : KernelTable
        Table of all directions together; covers the stretch ratios.
    stretch, alpha, sigma_um, angle_rad : array_like, shape (N,)
        One entry per strain step: ratio, kernel, direction of the jaws; finite.

    Raises
    ------
    KernelTableFitError
        For fewer than two directions, not more steps than directions, or values not finite.
    """
    check = Checks(KernelTableFitError)
    given = {"stretch": stretch, "alpha": alpha, "sigma_um": sigma_um, "angle_rad": angle_rad}
    r, a, s, angle = (
        check.numbers(name, np.ravel(values), (np.size(stretch),)) for name, values in given.items()
    )
    directions, group = np.unique(angle, return_inverse=True)
    k = directions.size
    got = f"{k} directions of {r.size} strain steps"
    check.require(2 <= k < r.size, "angle_rad", got, "2 or more directions, and more steps")
    count = np.bincount(group, minlength=k)
    offsets, errors, chances = [], [], []
    tables = kernel_parameters(r, table, extrapolate="refuse")
    for value, tabled in zip((a, s), tables, strict=True):
        # in a unit of their own, whose squares neither vanish nor overflow
        unit = float(np.abs(value - tabled).max()) or 1.0
        residual = (value - tabled) / unit
        mean = np.bincount(group, residual, k) / count
        within = float(np.sum((residual - mean[group]) ** 2)) / (r.size - k)
        between = float(np.sum(count * (mean - residual.mean()) ** 2)) / (k - 1)
        offsets.append(tuple((unit * mean).tolist()))
        errors.append(tuple((unit * np.sqrt(within / count)).tolist()))
        ratio = between / within if within > 0 else (math.inf if between > 0 else 0.0)
        chances.append(float(fdtrc(k - 1, r.size - k, ratio)) if math.isfinite(ratio) else 0.0)
    return DirectionDependence(
        tuple(directions.tolist()), offsets[0], offsets[1], errors[0], errors[1], *chances
    )


def alpha_rms(table: KernelTable, stretch: ArrayLike, alpha: ArrayLike) -> float:
    """Return the root mean square residual of a table's alpha at points in its range.

    Examples
    --------
    >>> from model.microstructure import FOREHEAD, forehead_points
    >>> points = forehead_points()
    >>> round(alpha_rms(FOREHEAD, points.stretch, points.alpha), 3)  # eq. (8) on fig. 11
    0.199
    """
    found, _ = kernel_parameters(stretch, table, extrapolate="refuse")
    return float(np.sqrt(np.mean((found - np.asarray(alpha, np.float64)) ** 2)))
