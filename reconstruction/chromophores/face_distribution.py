"""Fit the distribution of melanin and blood over one face to all of its pixels jointly.

A pixel in the shade has the color of darker skin in more light, and of darker skin with more blood.
Alone it is assigned the most probable skin of any person in the usual light. But the pixels are of
one person: those in good light determine its mean melanin and blood and their standard deviations,
which then are the prior of the others. The distribution maximizes the marginal likelihood of the
colors of many pixels (an empirical Bayes estimate). A fit to their estimates would be wider, by the
errors of those estimates.

Errors common to all pixels do not average out: illumination (the face may be off the white
reference's position) and the layered model. The distribution is fitted again with each of these
errors at plus and minus its standard error. Half of the resulting shift of a mean is its standard
error. A mean at an end of its range can shift to one side only: there the standard error is the
shift to that side. Blood at the lower end is undetermined by color, because all living skin has
some: then any value has the same probability.
"""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import minimize
from scipy.special import ndtr

from model.checks import FINITE_RANGE, Checks
from model.solver_outcome import outcome_from_scipy
from reconstruction.arrays import Float32Array, Float64Array, FloatArray

_log = logging.getLogger(__name__)

MIN_CONTAMINATION: Final = 0.01
"""Minimum fraction of the skin that is outside the distribution, as for the light
(`reconstruction.chromophores.shading_prior.CONTAMINATION_PROBABILITY`): it keeps moles and lips
from being pulled to the face's mean."""
MAX_CONTAMINATION: Final = 0.5
MIN_SIGMAS: Final = (0.02, 0.02)
"""Minimum standard deviations of log melanin, the limit of what colors resolve, and of blood's cube
root. Simulated faces have 0.008 to 0.016 without lips, which count as outliers, and 0.03 to 0.05
with them. That is below the error of a pixel, so colors determine it badly."""
MAX_SIGMAS: Final = (2.0, 0.5)
_START_SIGMAS: Final = (0.3, 0.1)
_SEARCH_SCALE: Final = np.array([0.1, 0.3, 0.5, 0.03, 0.3, 0.5])
"""Search scale of means, and of logs of standard deviations and of fractions."""
_DIFFERENCE_STEP: Final = 1e-5
MIN_LIMIT_DISTANCE: Final = 0.02
"""Distance from an end, in log melanin or on blood's axis, within which a mean counts as limited:
the outermost grid point is up to 0.016 from the end."""
_MAX_ROUNDS: Final = 60


@dataclass(frozen=True, slots=True)
class ContaminatedNormal:
    """Mixture of a normal distribution and a uniform one."""

    mean: float
    sd: float
    """Standard deviation, without the standard error of the mean."""
    contamination: float
    """Fraction of the skin with the uniform distribution, 0 to 1."""
    low: float
    high: float
    """Range of the uniform distribution, ``low`` to ``high``."""
    stderr: float = 0.0
    """Standard error of the mean."""

    def __post_init__(self) -> None:
        """Refuse invalid parameters."""
        check = Checks()
        check.settings(
            self, mean=FINITE_RANGE, sd="(0, inf)", contamination="(0, 1]", low=FINITE_RANGE
        )
        check.settings(self, high=f"({self.low}, inf)", stderr="[0, inf)")

    @property
    def total_sd(self) -> float:
        """Standard deviation of one pixel's value, with the standard error of the mean."""
        return math.hypot(self.sd, self.stderr)

    @property
    def peak_density(self) -> float:
        """Density of the normal part at its mean, over the uniform density."""
        width = self.total_sd
        inside = ndtr((self.high - self.mean) / width) - ndtr((self.low - self.mean) / width)
        whole = math.sqrt(2.0 * math.pi) * width * max(float(inside), 1e-12)
        return (self.high - self.low) / whole

    def relative_density(self, at: Float64Array) -> Float64Array:
        """Return the density of a pixel's value over the uniform density, at values (n,).

        Examples
        --------
        >>> bell = ContaminatedNormal(0.0, 1.0, 0.1, -10.0, 10.0)
        >>> at = np.linspace(-10.0, 10.0, 1001)
        >>> round(float(bell.relative_density(at).mean()), 2), round(bell.peak_density, 3)
        (1.0, 7.979)
        """
        bell = self.peak_density * np.exp(-0.5 * np.square((at - self.mean) / self.total_sd))
        return np.asarray((1.0 - self.contamination) * bell + self.contamination)

    def cell_densities(self, edges: Float64Array) -> Float64Array:
        """Return the means of `relative_density` between ascending edges (n + 1,), shape (n,).

        A cell may be wider than the normal distribution.
        """
        below = ndtr((edges - self.mean) / self.total_sd)
        whole = self.peak_density * math.sqrt(2.0 * math.pi) * self.total_sd
        bell = whole * np.diff(below) / np.diff(edges)
        return np.asarray((1.0 - self.contamination) * bell + self.contamination)


@dataclass(frozen=True, slots=True)
class FaceDistribution:
    """Independent prior distributions of one person's melanin and blood."""

    melanin: ContaminatedNormal
    """Distribution of the logarithm of the volume fraction in the epidermis."""
    blood: ContaminatedNormal
    """Distribution of the cube root of the volume fraction in the dermis, over the table's end."""


AxisPositions = tuple[Float64Array, Float64Array]
AxisLimits = tuple[tuple[float, float], tuple[float, float]]


def fit_distribution(
    probability: FloatArray,
    positions: AxisPositions,
    ends: AxisLimits,
    *,
    initial: FaceDistribution | None = None,
) -> FaceDistribution:
    """Fit the distribution that maximizes the marginal likelihood of many pixels' colors.

    Parameters
    ----------
    probability
        (pixels, m, b): likelihood of each pixel's color over log melanin and blood's cube root, in
        any scale.
    positions
        (m,) of log melanin and (b,) of blood, equally spaced.
    ends
        Full ranges of both; the positions may cover less.
    initial
        A similar distribution to start from, if known.

    Returns
    -------
    FaceDistribution
        The means' standard errors are 0, see `add_systematic_errors`.

    Raises
    ------
    ValueError
        When shapes do not match, or a pixel has zero probability everywhere.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> melanin, blood = np.linspace(-5.0, -1.0, 161), np.linspace(0.1, 0.9, 33)
    >>> seen = rng.normal(-3.0, 0.2, (2000, 1, 1)) + 0.3 * rng.standard_normal((2000, 1, 1))
    >>> of_melanin = np.exp(-0.5 * ((melanin[:, None] - seen) / 0.3) ** 2)
    >>> of_blood = np.exp(-0.5 * ((blood - 0.4) / 0.1) ** 2)
    >>> ends = (-9.0, -0.7), (0.04, 1.0)
    >>> found = fit_distribution(of_melanin * of_blood, (melanin, blood), ends).melanin
    >>> bool(abs(found.mean + 3.0) < 0.03), bool(abs(found.sd - 0.2) < 0.03)
    (True, True)
    """
    Checks().shape("probability", probability, ("pixels", positions[0].size, positions[1].size))
    flat = probability.reshape(len(probability), -1)
    total = flat.sum(axis=1, dtype=np.float64)
    Checks().within("sum of each pixel's probability", total, "(0, inf)")
    search = _Search((flat / total[:, None]).astype(np.float32), positions, ends)
    bells = search.start() if initial is None else (initial.melanin, initial.blood)
    start = [(bell.mean, math.log(bell.sd), math.log(bell.contamination)) for bell in bells]
    parts = math.log(MIN_CONTAMINATION), math.log(MAX_CONTAMINATION)
    bounds = []
    for at, least, most in zip(positions, MIN_SIGMAS, MAX_SIGMAS, strict=True):
        bounds += [(at[0], at[-1]), (math.log(least), math.log(most)), parts]
    low, high = np.array(bounds).T / _SEARCH_SCALE
    found = minimize(
        search.misfit,
        np.clip(np.ravel(start) / _SEARCH_SCALE, low, high),
        jac=True,
        method="L-BFGS-B",
        bounds=np.stack([low, high], axis=1),
        options={"maxiter": _MAX_ROUNDS, "ftol": 1e-7, "gtol": 1e-5},
    )
    outcome_from_scipy(found, float(np.abs(found.jac).max())).warn_unless_converged(
        "distribution of the face's chromophores", _log
    )
    return FaceDistribution(*search.distributions(found.x))


NormalPair = tuple[ContaminatedNormal, ContaminatedNormal]


class _Search:
    """Likelihood of the colors under distributions of melanin and blood.

    The six unknowns, over `_SEARCH_SCALE`: means, logs of standard deviations and of fractions.
    """

    def __init__(self, share: Float32Array, places: AxisPositions, ends: AxisLimits) -> None:
        self.share, self.places, self.ends = share, places, ends
        self.shape = places[0].size, places[1].size
        self.edges = [
            np.concatenate([[1.5 * at[0] - 0.5 * at[1]], at + 0.5 * (at[1] - at[0])])
            for at in places
        ]

    def start(self) -> NormalPair:
        """Return the initial distributions without prior knowledge."""
        usual = self.share.mean(axis=0, dtype=np.float64).reshape(self.shape)
        melanin = float(usual.sum(axis=1) @ self.places[0])
        blood = float(usual.sum(axis=0) @ self.places[1])
        return (
            ContaminatedNormal(melanin, _START_SIGMAS[0], 0.1, *self.ends[0]),
            ContaminatedNormal(blood, _START_SIGMAS[1], 0.1, *self.ends[1]),
        )

    def distributions(self, unknowns: Float64Array) -> NormalPair:
        unknowns = unknowns * _SEARCH_SCALE
        first, second = (
            ContaminatedNormal(float(mean), math.exp(spread), math.exp(part), *ends)
            for (mean, spread, part), ends in zip(unknowns.reshape(2, 3), self.ends, strict=True)
        )
        return first, second

    def densities(self, unknowns: Float64Array) -> tuple[Float64Array, Float64Array]:
        first, second = self.distributions(unknowns)
        return first.cell_densities(self.edges[0]), second.cell_densities(self.edges[1])

    def misfit(self, unknowns: Float64Array) -> tuple[float, Float64Array]:
        """Return the mean -log likelihood per pixel, and its gradient."""
        # L_p = sum_mb P_p(m, b) f(m) g(b); the loss is -mean_p log L_p. With Q = sum_p P_p / L_p
        # its gradient is -(Q g) . df for melanin and -(f Q) . dg for blood, over the pixel count;
        # df and dg are central differences of the cell densities.
        of_melanin, of_blood = self.densities(unknowns)
        both = np.outer(of_melanin, of_blood).astype(np.float32).reshape(-1)
        each = np.maximum((self.share @ both).astype(np.float64), 1e-30)
        pulled = ((1.0 / each).astype(np.float32) @ self.share).astype(np.float64)
        pulled = pulled.reshape(self.shape)
        by_density = pulled @ of_blood, of_melanin @ pulled
        gradient = np.empty(6)
        for k, step in enumerate(_DIFFERENCE_STEP * np.eye(6)):
            more, less = (self.densities(unknowns + off)[k // 3] for off in (step, -step))
            gradient[k] = by_density[k // 3] @ (more - less) / (2.0 * _DIFFERENCE_STEP)
        return -float(np.log(each).mean()), -gradient / len(self.share)


def add_systematic_errors(
    usual: FaceDistribution, moved: Sequence[tuple[FaceDistribution, FaceDistribution]]
) -> FaceDistribution:
    """Add standard errors to the means; make blood uniform where it is undetermined.

    Parameters
    ----------
    usual
        The fitted one.
    moved
        Pairs fitted with each error common to all pixels at minus and plus its standard error;
        the errors are independent of each other.

    Examples
    --------
    >>> def face(mean):
    ...     blood = ContaminatedNormal(0.4, 0.1, 0.01, 0.0, 1.0)
    ...     return FaceDistribution(ContaminatedNormal(mean, 0.3, 0.01, -9.0, -0.7), blood)
    >>> known = add_systematic_errors(face(-3.0), [(face(-3.4), face(-2.6)), (face(-3.3),
    ...     face(-2.7))])
    >>> round(known.melanin.stderr, 6), known.blood.stderr
    (0.5, 0.0)
    """

    def with_error(name: str) -> ContaminatedNormal:
        own = getattr(usual, name)
        means = [(getattr(minus, name).mean, getattr(plus, name).mean) for minus, plus in moved]
        return replace(own, stderr=math.sqrt(sum(_mean_shift(own, *pair) ** 2 for pair in means)))

    blood = with_error("blood")
    if blood.mean - blood.low < MIN_LIMIT_DISTANCE:
        blood = replace(blood, contamination=1.0)
    return FaceDistribution(with_error("melanin"), blood)


def _mean_shift(usual: ContaminatedNormal, minus: float, plus: float) -> float:
    """Return the shift of a mean per standard error of the common error that moved it."""
    held = any(
        min(mean - usual.low, usual.high - mean) < MIN_LIMIT_DISTANCE
        for mean in (minus, usual.mean, plus)
    )
    if held:
        return max(abs(usual.mean - minus), abs(plus - usual.mean))
    return 0.5 * (plus - minus)
