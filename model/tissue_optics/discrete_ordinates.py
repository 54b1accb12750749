"""Discretize radiance in plane layers: directions, weights and phase functions between them."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import legendre

from model import fresnel
from model.arrays import Float64Array
from model.checks import Checks

MAX_SAMPLED_ANISOTROPY = 0.8
"""Largest g whose phase function is sampled at the directions; above, it is projected."""
MAX_DEFAULT_ANISOTROPY = 0.99
"""Largest g that `default_directions` covers."""
MAX_ANISOTROPY = 0.999
"""Largest g at all; the Legendre series has 28,000 terms there."""
MIN_DIRECTIONS_FRACTION = 2.0 / 3.0
"""Fewest directions for a projected phase function, as a fraction of the default."""
_SERIES_END = 1e-12  # Legendre moment below which the phase function's series is truncated
_TRAPPED_LOSS = 1e-14  # fraction lost in total reflection, see quadrature
_MIN_CRITICAL_COSINE = 1e-3  # below, the surface counts as index-matched
_POINTS_PER_PANEL, _PERIODS_PER_PANEL = 16, 3.0  # Gauss points of projections: exact to 1e-13
_VALUES_PER_BLOCK = 3_000_000  # polynomial values at a time: 24 MB

_DEFAULT_ANISOTROPIES = (0.0, 0.8, 0.9, 0.95, 0.98, 0.99)  # upper ends of the columns below
_DEFAULT_DIRECTIONS = (  # from this eta up; found by doubling the directions, plus two from g = 0.9
    (1.4, (12, 20, 24, 28, 34, 38)),
    (1.3, (12, 24, 28, 32, 36, 40)),
    (1.2, (12, 26, 30, 38, 44, 44)),
    (1.1, (14, 30, 36, 44, 50, 50)),
    (1.0 + 5e-7, (16, 38, 50, 60, 62, 68)),
    (1.0, (28, 28, 30, 34, 50, 54)),  # index-matched: a single range
)


@dataclass(frozen=True, slots=True)
class Quadrature:
    """Directions inside the medium and the surface's reflectance for them."""

    mu: Float64Array
    """Cosines, shape (n,), increasing; the last is 1, the direction of the collimated beam."""
    weight: Float64Array
    """Weights of the integral over mu from 0 to 1, shape (n,)."""
    surface: Float64Array
    """Fresnel reflectance of the surface from inside, shape (n,)."""


@dataclass(frozen=True, slots=True)
class _Range:
    """Range of directions on one side of the critical angle, mapped from s in (0, 1].

    ``mu = start + length * s**power``. The surface's transmittance has a square-root onset at the
    critical angle: with power 2 it is smooth in s, and the rule converges quickly.
    """

    start: float
    length: float
    power: int
    node: Float64Array
    """Values of s, shape (m,)."""
    weight: Float64Array
    """Weights of the integral over s, shape (m,)."""

    def cosine(self, s: Float64Array) -> Float64Array:
        """Return mu at `s`."""
        return np.asarray(self.start + self.length * s**self.power)

    def slope(self, s: Float64Array) -> Float64Array:
        """Return d mu / d s at `s`."""
        return np.asarray(self.length * self.power * s ** (self.power - 1))


@lru_cache(maxsize=32)
def quadrature(eta: float, directions: int) -> Quadrature:
    """Return the directions for a refractive index: half of them beyond the critical angle.

    Parameters
    ----------
    eta
        Refractive index of the medium over that outside, 1 to `fresnel.MAX_INDEX`.
    directions
        Number of directions in half a sphere, even, at least 4.

    Returns
    -------
    Quadrature

    Raises
    ------
    ValueError
        For values outside these ranges.
    """
    ranges = list(_ranges(eta, directions))
    mu = np.concatenate([part.cosine(part.node) for part in ranges])
    weight = np.concatenate([part.slope(part.node) * part.weight for part in ranges])
    # Total reflection loses 1e-14: otherwise trapped light in a clear slab gives a singular matrix.
    surface = np.minimum(fresnel.reflectance(mu, 1.0 / eta), 1.0 - _TRAPPED_LOSS)
    return Quadrature(mu, weight, surface)


def default_directions(eta: float, anisotropy: float) -> int:
    """Return the fewest directions whose reflectance is within 1e-4 of the limit, relative.

    Parameters
    ----------
    eta
        Refractive index of the medium over that outside, at least 1. Indices between 1 and 1.3
        need more directions, since the critical angle is near the horizon.
    anisotropy
        Mean cosine g of the phase function, in [0, `MAX_DEFAULT_ANISOTROPY`]; the largest of all
        layers.

    Returns
    -------
    int
        Directions in half a sphere.

    Raises
    ------
    ValueError
        For an anisotropy above `MAX_DEFAULT_ANISOTROPY`.

    Examples
    --------
    >>> [default_directions(1.4, g) for g in (0.0, 0.8, 0.9, 0.99)]
    [12, 20, 24, 38]
    """
    if not anisotropy <= MAX_DEFAULT_ANISOTROPY:
        raise ValueError(
            f"anisotropy: got {anisotropy}, expected at most {MAX_DEFAULT_ANISOTROPY} for the "
            "default directions; give directions, and check the result with more of them"
        )
    column = int(np.searchsorted(_DEFAULT_ANISOTROPIES, anisotropy))
    row = next(counts for least, counts in _DEFAULT_DIRECTIONS if eta >= least)
    return row[column]


def choose_directions(eta: float, anisotropy: float, directions: int | None = None) -> int:
    """Return the given directions if they suffice for the phase function, else the default ones.

    Raises
    ------
    ValueError
        For an anisotropy above `MAX_DEFAULT_ANISOTROPY` without directions; for one above
        `MAX_SAMPLED_ANISOTROPY` with fewer than `MIN_DIRECTIONS_FRACTION` of the default.
    """
    Checks().within("eta", eta, f"[1, {fresnel.MAX_INDEX}]")
    if directions is None:
        return default_directions(eta, anisotropy)
    if anisotropy > MAX_SAMPLED_ANISOTROPY:
        default = default_directions(eta, min(anisotropy, MAX_DEFAULT_ANISOTROPY))
        least = 2 * int(np.ceil(MIN_DIRECTIONS_FRACTION * default / 2.0))
        if directions < least:
            raise ValueError(
                f"directions: got {directions}, expected at least {least} for anisotropy "
                f"{anisotropy} and eta {eta:.4g}; omit directions to use {default}"
            )
    return int(directions)


@lru_cache(maxsize=32)
def phase_matrices(
    eta: float, directions: int, anisotropy: float
) -> tuple[Float64Array, Float64Array]:
    """Return the sum and difference of forward and backward phase function, halved, (m, m).

    The Henyey-Greenstein function is averaged over azimuth by its full Legendre series. Up to
    `MAX_SAMPLED_ANISOTROPY` it is sampled at the directions. A narrower forward peak falls between
    them: sampled, it scatters too far, and reflectance is 2 % low at g = 0.99. It is then projected
    on the polynomials through the directions of each range, which conserves their moments
    (Galerkin). Forward and backward scattering are projected apart, so the peak does not disturb
    the small backward part, the main part of what strongly absorbing tissue reflects. Delta-M,
    whose truncated series is wrong for singly scattered light, would do so.

    The remaining error of the sum of each column stays in the incident direction, which conserves
    energy.
    """
    rule = quadrature(eta, directions)
    count = 1 if anisotropy == 0.0 else int(np.ceil(np.log(_SERIES_END) / np.log(anisotropy))) + 1
    if anisotropy <= MAX_SAMPLED_ANISOTROPY:
        basis = legendre.legvander(rule.mu, count - 1)
    else:
        parts = [_projected_legendre(part, count) for part in _ranges(eta, directions)]
        basis = np.concatenate(parts)
    order = np.arange(count)
    basis = basis * np.sqrt((2.0 * order + 1.0) * anisotropy**order)  # 0**0 = 1
    even = basis[:, ::2] @ basis[:, ::2].T
    odd = basis[:, 1::2] @ basis[:, 1::2].T
    peak = np.diag((1.0 - even @ rule.weight) / rule.weight)
    return even + peak, odd + peak


def _ranges(eta: float, directions: int) -> Iterator[_Range]:
    """Yield the ranges of directions, beyond the critical angle first."""
    if directions < 4 or directions % 2:
        raise ValueError(f"directions: expected an even number of at least 4, got {directions}")
    Checks().within("eta", eta, f"[1, {fresnel.MAX_INDEX}]")
    critical = float(np.sqrt(1.0 - 1.0 / eta**2))
    if critical < _MIN_CRITICAL_COSINE:  # index-matched: a single range
        yield _Range(0.0, 1.0, 1, *_radau(directions))
        return
    node, weight = legendre.leggauss(directions // 2)
    yield _Range(0.0, critical, 1, 0.5 * (node + 1.0), 0.5 * weight)
    yield _Range(critical, 1.0 - critical, 2, *_radau(directions // 2))


def _radau(count: int) -> tuple[Float64Array, Float64Array]:
    """Return nodes and weights on (0, 1] with a node at 1."""
    # Roots of (P_{n-1} + P_n)/(1 + x) on [-1, 1]: Radau rule with fixed node -1, here mirrored.
    p_before = np.zeros(count + 1)
    p_before[count - 1 : count + 1] = 1.0
    free = legendre.legroots(p_before)
    free = np.sort(free.real)[1:]
    x = np.concatenate([[-1.0], free])
    p = legendre.legval(x, np.eye(count)[count - 1])
    weight = (1.0 - x) / (count**2 * p**2)
    return 0.5 * (1.0 - x[::-1]), 0.5 * weight[::-1]


def _projected_legendre(part: _Range, count: int) -> Float64Array:
    """Return Legendre polynomials projected on the directions of a range, shape (m, count).

    Each row is the mean of P_l weighted by the Lagrange polynomial of one direction. With
    ``s = 1 - u**2`` the angle from the normal grows by at most 2 per u, so that P_l has at most
    l/pi periods over u; panels of Gauss points have three periods each.
    """
    m = part.node.size
    node, node_weight = legendre.leggauss(_POINTS_PER_PANEL)
    panels = int(np.ceil(count / (np.pi * _PERIODS_PER_PANEL))) + m
    u = (np.arange(panels)[:, None] + 0.5 * (node + 1.0)).ravel() / panels
    weight = np.tile(0.5 * node_weight, panels) / panels
    s = 1.0 - u**2
    measure = weight * 2.0 * u * part.slope(s)
    to_nodes = np.linalg.inv(legendre.legvander(2.0 * part.node - 1.0, m - 1)).T
    out = np.zeros((m, count))
    points = max(_VALUES_PER_BLOCK // count, 1)
    for begin in range(0, s.size, points):
        some = slice(begin, begin + points)
        lagrange = to_nodes @ legendre.legvander(2.0 * s[some] - 1.0, m - 1).T
        polynomials = legendre.legvander(part.cosine(s[some]), count - 1)
        out += (lagrange * measure[some]) @ polynomials
    return np.asarray(out / (part.slope(part.node) * part.weight)[:, None])
