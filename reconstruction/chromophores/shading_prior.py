"""Prior distribution of the shading of a face's pixels.

Light on a face over that on a white reference in its place is not normally distributed. Skin that
faces the flashes gets about the reference's light, rarely more. Skin turned away gets less, down to
0. The prior is therefore the distribution measured on simulated faces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from reconstruction.arrays import Float64Array
from reconstruction.chromophores import model_error

LOG_SHADING_SOFTNESS = 0.1
"""Standard deviation of log shading added to the measured one: a face off the reference's position
by 5 % of its distance gets 10 % more or less light."""
CONTAMINATION_PROBABILITY = 0.01
"""Probability that a pixel does not follow the distribution ..."""
CONTAMINATION_LOG_SIGMA = 1.5
"""... but a normal one with this standard deviation of log shading and the same mean."""
_LOG_LOW, _LOG_HIGH, _LOG_STEP = -8.0, 5.0, 0.05
MIN_SOFTNESS = _LOG_STEP
"""Minimum softness: the width of the bins and of the nodes' spacing."""


class ShadingPriorError(ValueError):
    """An invalid distribution of shading."""


@dataclass(frozen=True, slots=True, eq=False)
class ShadingPrior:
    """Probability density of the logarithm of a pixel's shading.

    Attributes
    ----------
    low, step
        Log shading at the first node, and the nodes' spacing.
    density
        (n,) at the nodes, positive; its sum times ``step`` is 1.
    """

    low: float
    step: float
    density: Float64Array

    def __post_init__(self) -> None:
        """Refuse an invalid density."""
        check, size = Checks(ShadingPriorError), max(np.size(self.density), 2)
        density = check.numbers("density", self.density, (size,), interval="(0, inf)")
        check.within("low", self.low)
        check.within("step", self.step, "(0, inf)")
        density = density / (density.sum() * self.step)
        density.setflags(write=False)
        object.__setattr__(self, "density", density)

    @property
    def nodes(self) -> Float64Array:
        """Log shading of the nodes, (n,)."""
        return np.asarray(self.low + self.step * np.arange(self.density.size), dtype=np.float64)

    @property
    def mean(self) -> float:
        """Mean of log shading."""
        return float((self.nodes * self.density).sum() * self.step)

    @property
    def median(self) -> float:
        """Median of log shading."""
        share = np.cumsum(self.density) - 0.5 * self.density
        return float(np.interp(0.5 / self.step, share, self.nodes))

    @property
    def sd(self) -> float:
        """Standard deviation of log shading."""
        return float(np.sqrt(((self.nodes - self.mean) ** 2 * self.density).sum() * self.step))

    def broaden(self, log_sd: float) -> ShadingPrior:
        """Convolve the prior with a normal distribution of log shading, for an unknown exposure.

        Examples
        --------
        >>> prior = lognormal_prior(0.7, 0.3).broaden(0.4)
        >>> round(prior.sd, 3)
        0.5
        """
        Checks(ShadingPriorError).within("log_sd", log_sd, "(0, 2)")
        reach = np.arange(-math.ceil(4 * log_sd / self.step), math.ceil(4 * log_sd / self.step) + 1)
        kernel = np.exp(-0.5 * (reach * self.step / log_sd) ** 2)
        wide = np.convolve(self.density, kernel / kernel.sum())
        return ShadingPrior(
            self.low + reach[0] * self.step, self.step, np.maximum(wide, np.finfo(float).tiny)
        )


def lognormal_prior(center: float, log_sd: float) -> ShadingPrior:
    """Return a log-normal prior around ``center``, for rigs without a measured distribution.

    Examples
    --------
    >>> round(lognormal_prior(0.7, 0.6).mean, 3) == round(float(np.log(0.7)), 3)
    True
    """
    Checks(ShadingPriorError).within("center, spread", (center, log_sd), "(0, inf]")
    step = log_sd / 12.0
    reach = np.arange(-96, 97)  # 8 standard deviations
    return ShadingPrior(
        math.log(center) + reach[0] * step, step, np.exp(-0.5 * (reach / 12.0) ** 2)
    )


def prior_from_histogram(
    low: float, step: float, counts: ArrayLike, *, softness: float = LOG_SHADING_SOFTNESS
) -> ShadingPrior:
    """Return the prior of a histogram of log shading, slightly smoothed.

    Parameters
    ----------
    low, step
        Lower edge and width of the bins, in log shading; between -7 and 4.
    counts
        (n,) counts of the bins.
    softness
        Standard deviation of log shading that is added, at least 0.05, the nodes' spacing.
    """
    check = Checks(ShadingPriorError)
    check.within("softness", softness, f"[{_LOG_STEP}, 2)")
    heights = check.numbers("counts", counts, ("n",), interval="[0, inf]")
    check.within("sum of counts", heights.sum(), "(0, inf]")
    places = low + step * (np.arange(heights.size) + 0.5)
    nodes = np.arange(_LOG_LOW, _LOG_HIGH + 0.5 * _LOG_STEP, _LOG_STEP)
    check.within("bins", places, f"[{_LOG_LOW + 1.0}, {_LOG_HIGH - 1.0}]")
    share = heights / heights.sum()
    density = (share * _normal_density(nodes[:, None] - places, softness)).sum(axis=1)
    mean = float((share * places).sum())
    rest = _normal_density(nodes - mean, CONTAMINATION_LOG_SIGMA)
    return ShadingPrior(
        _LOG_LOW,
        _LOG_STEP,
        (1.0 - CONTAMINATION_PROBABILITY) * density + CONTAMINATION_PROBABILITY * rest,
    )


def face_prior(*, softness: float = LOG_SHADING_SOFTNESS) -> ShadingPrior:
    """Return the prior of a face before the flash rig, relative to a white reference in place.

    Distribution over the skin of the simulated subjects of seeds 0 to 19, all skin types, measured
    by ``tools/fit_model_error.py``. Other seeds are free for evaluation. `softness` as in
    `prior_from_histogram`: minimal for light that varies from pixel to pixel.

    Examples
    --------
    >>> prior = face_prior()
    >>> bool(-0.7 < prior.mean < -0.3), bool(0.5 < prior.sd < 0.8)
    (True, True)
    """
    found = model_error.load_shading_histogram()
    return prior_from_histogram(found.low, found.step, found.counts, softness=softness)


def _normal_density(away: Float64Array, spread: float) -> Float64Array:
    return np.exp(-0.5 * (away / spread) ** 2) / (math.sqrt(2.0 * math.pi) * spread)
