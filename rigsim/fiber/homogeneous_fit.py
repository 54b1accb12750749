"""Fit the homogeneous medium whose profile is nearest to a given one.

Definition: of all half spaces of g = 0.8 and eta = 1.4 under air, the one whose reflectance in the
fiber, by the stored Monte Carlo of `rigsim.fiber.white_fiber`, is up to a factor nearest to the
given one: the logarithms of the ratios have the smallest variance over the fibers, with equal
weights; fibers below `MIN_REFLECTANCE_PER_MM2` are omitted, as the probe's camera cannot detect
them above noise. The factor accounts for pigment in a thin layer on top, which absorbs light on its
way in and out equally at all distances. Anisotropic tissue without layers has no such factor: with
one, the nearest medium jumps between distant minima from one direction to the next. For dark skin
the scattering of the nearest medium is unbounded: its profile is that of a dipole at the surface,
which determines only sigma_tr; the search ends at `MAX_SCATTERING_PER_MM`.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from rigsim.arrays import Float64Array
from rigsim.fiber.profile import FiberGeometry
from rigsim.fiber.white_fiber import FiberTable

MIN_REFLECTANCE_PER_MM2: Final = 1e-7
"""R_f that gives a tenth of an electron per pixel and exposure of 30 s for each electron of read
noise: about ten standard errors of a spot's sum."""

MIN_BRIGHT_FIBERS: Final = 4
"""Smallest number of fibers that are bright enough."""

SEARCH_STARTS_PER_MM: Final = (
    (0.03, 1.0),
    (0.1, 2.0),
    (0.4, 3.0),
    (1.0, 1.0),
    (0.01, 8.0),
    (0.005, 20.0),
    (0.004, 60.0),
)
"""Starting values of the search, sigma_a and sigma_s' in 1/mm; the best result is used. Layers dim
near fibers less than far ones, which looks like more scattering than tissue has."""
MAX_SCATTERING_PER_MM: Final = 200.0
"""Of the search, 1/mm."""
OFF_TABLE_RESIDUAL: Final = 1e3
"""Residual of media outside the table."""


class FitError(ValueError):
    """Error for a profile that no homogeneous medium can be fitted to."""


@dataclass(frozen=True, slots=True)
class HomogeneousFit:
    """The nearest homogeneous medium, and its misfit."""

    sigma_a_per_mm: float
    """Absorption coefficient, 1/mm."""
    sigma_s_prime_per_mm: float
    """Reduced scattering coefficient, 1/mm."""
    factor: float
    """R_f over that of the medium, geometric mean over the fibers used."""
    residual: float
    """Standard deviation of log(R_f / R_f of the medium) over the fibers used; its root mean
    square where the factor is 1 by definition."""
    fibers: int
    """Number of fibers used."""

    @property
    def sigma_tr_per_mm(self) -> float:
        """Return the effective transport coefficient sqrt(3 sigma_a (sigma_a + sigma_s')), 1/mm."""
        a = self.sigma_a_per_mm
        return math.sqrt(3.0 * a * (a + self.sigma_s_prime_per_mm))


def fit_homogeneous_medium(
    reflectance_per_mm2: ArrayLike, fibers: FiberGeometry, *, dimmed: bool = True
) -> HomogeneousFit:
    """Return the homogeneous medium that is nearest to a profile.

    Parameters
    ----------
    reflectance_per_mm2
        R_f of the fibers, 1/mm^2, shape (F,).
    fibers
        The fibers.
    dimmed
        Whether a layer on top may absorb light: the factor is fitted, else 1.

    Returns
    -------
    HomogeneousFit
        See the module for the definition.

    Raises
    ------
    FitError
        Fewer than `MIN_BRIGHT_FIBERS` fibers are bright enough, or the best medium lies at the
        table's end.

    Examples
    --------
    >>> fibers = FiberGeometry(tuple(0.3 + 0.25 * k for k in range(28)))
    >>> own, _ = FiberTable.load().profile(0.1, 2.0, fibers)
    >>> fit = fit_homogeneous_medium(own, fibers)
    >>> round(fit.sigma_a_per_mm, 3), round(fit.sigma_s_prime_per_mm, 2)
    (0.1, 2.0)
    """
    profile = np.asarray(reflectance_per_mm2, np.float64)
    use = profile >= MIN_REFLECTANCE_PER_MM2
    if profile.shape != (len(fibers.radii_mm),) or int(use.sum()) < MIN_BRIGHT_FIBERS:
        raise FitError(
            f"reflectance_per_mm2: got {int(use.sum())} bright of {profile.shape}, expected "
            f"{len(fibers.radii_mm)} with at least {MIN_BRIGHT_FIBERS} of "
            f"{MIN_REFLECTANCE_PER_MM2} 1/mm^2"
        )
    table = FiberTable.load()
    used = FiberGeometry(
        tuple(np.array(fibers.radii_mm)[use].tolist()),
        fibers.core_mm,
        fibers.source_core_mm,
        fibers.numerical_aperture,
        fibers.source_numerical_aperture,
    )
    target = np.log(profile[use])
    both = 0.5 * (fibers.core_mm + fibers.source_core_mm)
    low = table.distance[0] / (min(used.radii_mm) - both)
    # sigma_a / sigma_s' rather than sigma_a, as the table ends there
    bounds = np.log([[1e-6, low * 1.0001], [table.absorption[-1] * 0.9999, MAX_SCATTERING_PER_MM]])

    def misfit(logs: Float64Array) -> Float64Array:
        scattering = math.exp(logs[1])
        if not table.covers(math.exp(logs[0]) * scattering, scattering, used):
            return OFF_TABLE_RESIDUAL * np.cos(np.arange(target.size))
        value, _ = table.profile(math.exp(logs[0]) * scattering, scattering, used)
        off = np.log(value) - target
        return np.asarray(off - off.mean()) if dimmed else off

    ends = [
        least_squares(
            misfit, np.clip(np.log([a / s, s]), bounds[0] + 0.01, bounds[1] - 0.01), bounds=bounds
        )
        for a, s in SEARCH_STARTS_PER_MM
    ]
    best = min(ends, key=lambda end: float(end.cost))
    # at the limit of scattering only sigma_tr determines the profile: keep it
    if best.x[1] - bounds[0, 1] < 1e-3:
        raise FitError(f"sigma_s': got {math.exp(best.x[1]):.3g} 1/mm, the table's end")
    scattering = math.exp(best.x[1])
    absorption = math.exp(best.x[0]) * scattering
    value, _ = table.profile(absorption, scattering, used)
    return HomogeneousFit(
        absorption,
        scattering,
        math.exp(float(np.mean(target - np.log(value)))) if dimmed else 1.0,
        math.sqrt(2.0 * float(best.cost) / int(use.sum())),
        int(use.sum()),
    )
