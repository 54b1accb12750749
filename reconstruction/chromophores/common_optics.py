"""Estimate the difference of one face's colors from the model's, by optics common to its skin.

Thickness, scattering and oxygenation vary little within one face and much between people. They add
one vector of log color to all pixels of a face, of known covariance (`ColorTable.log_covariance`).
The light on the face is known up to its position. These covariances weight the color and the
brightness of the face's median pixel in the estimate of its melanin and blood. The most probable
common error follows; pixels without it are estimated as if the optics were exact.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from model.checks import Checks
from model.color_table import ColorTable
from reconstruction.arrays import Float64Array
from reconstruction.chromophores.pixel_checks import ChromophoreError, check_colors, is_usable_color
from reconstruction.chromophores.shading_prior import ShadingPrior
from reconstruction.chromophores.start import MIN_AXIS_FRACTION
from reconstruction.chromophores.table_fit.fitting import (
    POPULATION_BLOOD,
    POPULATION_LOG_SD,
    POPULATION_MELANIN,
)

FACE_BLOOD_LOG_SD: Final = 0.9
"""Standard deviation over people of the log of a face's median blood. Published blood volume
fractions of skin, 0.002 to 0.07, are read as +-2 of them, as the ranges of
`model.tissue_optics.uncertainty` are. `POPULATION_LOG_SD` is of single pixels, lips included."""
LOG_FRACTION_STEP: Final = 0.05
"""Step of the grid in log melanin and in log blood, at most a third of their standard errors."""
ONE_SIGMA_LEVEL: Final = 0.6827
HALF_WIDTHS: Final = np.geomspace(1e-3, 1e3, 2001)
"""Relative half-widths among which that of 68 % is interpolated."""


@dataclass(frozen=True, slots=True, eq=False)
class CommonOptics:
    """Common error of a face's colors, and the errors of its mean that remain."""

    log_color: Float64Array
    """(3,): most probable log color of the face over that of the model."""
    melanin_half_width: float
    """68 % credible half-width of the whole face's melanin, over its estimate."""
    blood_half_width: float
    """68 % credible half-width of the whole face's blood, over its estimate."""
    log_light_sd: float
    """Standard error of log light of the whole face."""


def estimate_common_optics(
    rgb: ArrayLike,
    table: ColorTable,
    *,
    prior: ShadingPrior,
    common_light: float,
    common_color: ArrayLike | None = None,
) -> CommonOptics | None:
    """Estimate the common error of a face's colors.

    Parameters
    ----------
    rgb
        Shape (..., 3): light of the pixels over that of a white reference, linear camera RGB; all
        skin of one person.
    table
        Color table of the camera and the illumination, with its covariance by unknown optics.
    prior
        Distribution of the pixels' shading.
    common_light
        Standard error of log light common to all pixels, above 0.
    common_color
        (3, 3): covariance of further relative color errors common to all pixels. None: 0.

    Returns
    -------
    CommonOptics or None
        None without a usable pixel, or with a table of exact optics.

    Raises
    ------
    ChromophoreError
        When shapes or numbers do not fit.

    Examples
    --------
    >>> from model import color_table
    >>> from reconstruction.chromophores.shading_prior import lognormal_prior
    >>> table = color_table.build("Nikon 5100 (NPL)", "D65")
    >>> skin = 0.7 * table.lookup(np.full(100, 0.03), 0.011) * [1.06, 1.0, 1.0]
    >>> prior = lognormal_prior(0.7, 0.5)
    >>> found = estimate_common_optics(skin, table, prior=prior, common_light=0.1)
    >>> bool(found.log_color[0] > found.log_color[1]), bool(0.05 < found.melanin_half_width < 0.5)
    (True, True)
    """
    check = Checks(ChromophoreError)
    check.within("common_light", common_light, "(0, inf)")
    colors = check_colors(rgb)
    good = is_usable_color(colors)
    if table.optics_covariance is None or not good.any():
        return None
    seen = np.median(np.log(colors[good], dtype=np.float64), axis=0) - prior.median

    melanin, blood = (
        np.exp(np.arange(np.log(end * MIN_AXIS_FRACTION**3), np.log(end), LOG_FRACTION_STEP))
        for end in (table.c_m_max, table.c_hd_max)
    )
    c_m, c_hd = np.meshgrid(melanin, blood, indexing="ij")
    rest = seen - np.log(table.lookup(c_m, c_hd))
    optics = table.log_covariance(c_m, c_hd)
    others = np.full((3, 3), common_light**2)
    if common_color is not None:
        others += check.numbers("common_color", common_color, (3, 3))
    whole = optics + others
    weighted = np.linalg.solve(whole, rest[..., None])
    cost = (rest * weighted[..., 0]).sum(axis=-1) + np.linalg.slogdet(whole)[1]
    for fraction, usual, sd in (
        (c_m, POPULATION_MELANIN, POPULATION_LOG_SD[0]),
        (c_hd, POPULATION_BLOOD, FACE_BLOOD_LOG_SD),
    ):
        cost = cost + np.square(np.log(fraction / usual) / sd)
    weight = np.exp(-0.5 * (cost - cost.min()))
    weight /= weight.sum()

    error = (optics @ weighted)[..., 0]
    # conditional mean and variance of the common light, given the chromophores
    moved = common_light**2 * weighted[..., 0].sum(axis=-1)
    left = common_light**2 - common_light**4 * np.linalg.inv(whole).sum(axis=(-1, -2))
    variance = float((weight * (left + np.square(moved - (weight * moved).sum()))).sum())
    return CommonOptics(
        np.asarray((weight[..., None] * error).sum(axis=(0, 1))),
        _half_width(melanin, weight.sum(axis=1)),
        _half_width(blood, weight.sum(axis=0)),
        float(np.sqrt(max(variance, 0.0))),
    )


def _half_width(fractions: Float64Array, probability: Float64Array) -> float:
    """Return the 68 % credible half-width over the estimate, of a grid even in the logarithm.

    The posterior of blood has a long tail towards 0. A tail widens the standard deviation of the
    logarithm more than an interval of the fraction itself, which is what maps state.
    """
    log = np.log(fractions)
    edges = np.append(log - 0.5 * LOG_FRACTION_STEP, log[-1] + 0.5 * LOG_FRACTION_STEP)
    below = np.append(0.0, np.cumsum(probability))
    mean = float(probability @ log)
    ends = 1.0 + HALF_WIDTHS, np.maximum(1.0 - HALF_WIDTHS, 1e-300)
    high, low = (np.interp(mean + np.log(end), edges, below) for end in ends)
    return float(np.interp(ONE_SIGMA_LEVEL, high - low, HALF_WIDTHS))
