"""Sum the dipole's lateral scattering directly over sources: kernel and closed forms in NumPy.

The dipole's profile around a narrow beam integrates over a plane to R_d. Divided by R_d it is a
kernel P of integral 1: the density of the entry point of exiting light. Each source represents an
area. Nearer than a source's reach, P is replaced by its value at the reach plus a smooth bump. The
bump contains the remainder of the fraction of light within the reach, which is known in closed
form. So the kernel's integral stays 1 however much finer P is than the sources; where P is much
wider than their reach, bump and P agree.

:mod:`model.dipole.gather` sums the same over a tree, hundreds of times as fast.

References
----------
Jensen et al. 2001, doi:10.1145/383259.383319 (dipole).
Jensen and Buhler 2002, doi:10.1145/566570.566619 (sums over surface points).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from model import fresnel
from model.arrays import Float64Array
from model.dipole import profile as dipole

SOURCE_RADIUS_PER_SIDE = 2.0714
"""Reach of a source in sides of a square of its area: thirteen sources contribute to the light at a
point. Of a square lattice the bumps add up to 1 within 0.5 % anywhere: their Fourier transform, of
Bessel's J3, is 0 at the lattice's frequency (third zero over 2 pi)."""
SELF_RADIUS_FRACTION = 0.25
"""Fraction of its reach, half a source's side, within which a source is the exit point's own."""
MIN_RADIUS_PER_DEPTH = 1e-4
"""Below this fraction of the source's depth a reach has no effect but rounding errors."""
MIN_RELATIVE_LIGHT = 1e-10
"""Fraction of even light below which a point counts as out of reach of all sources."""
_CHUNK_BYTES = 1 << 25
_MAX_DEPTH_RATIO = float(np.sqrt(3.0))


@dataclass(frozen=True, slots=True, eq=False)
class DipoleMedia:
    """Dipoles of exit points and channels, all arrays of one shape.

    Attributes
    ----------
    sigma_tr_per_mm : ndarray
        1/mm.
    depth_mm, height_mm : ndarray
        Distances of the real source below and of the virtual one above the surface, at least 0.
    scale : ndarray
        1 over twice the surviving fraction of light, R_d / alpha'.
    """

    sigma_tr_per_mm: Float64Array
    depth_mm: Float64Array
    height_mm: Float64Array
    scale: Float64Array

    @staticmethod
    def of(r_d: ArrayLike, translucency_mm: ArrayLike, *, eta: float) -> DipoleMedia:
        """Return the dipoles of R_d and 1/sigma_tr, mm, which broadcast together.

        R_d above 1, which no medium has, counts as 1 (no lateral scattering), and R_d below 0 as 0.
        Neither changes the amount of returned light.

        Examples
        --------
        >>> DipoleMedia.of(0.436, 3.674, eta=1.3).depth_mm.round(2).tolist()
        1.3
        """
        albedo, length = np.broadcast_arrays(
            np.asarray(r_d, np.float64), np.asarray(translucency_mm, np.float64)
        )
        lost, depth = _inverse_albedo_table(eta)
        q = np.interp(1.0 - np.clip(albedo, 0.0, 1.0), lost, depth)
        b = 1.0 + 4.0 / 3.0 * fresnel.boundary_factor(eta)
        return DipoleMedia(
            1.0 / length, q * length, b * q * length, 1.0 / (np.exp(-q) + np.exp(-b * q))
        )


@lru_cache(maxsize=8)
def _inverse_albedo_table(eta: float) -> tuple[Float64Array, Float64Array]:
    """Return 1 - R_d, rising, and sqrt(3 (1 - alpha')) at nodes, for linear interpolation."""
    q = _MAX_DEPTH_RATIO * np.linspace(0.0, 1.0, 8193) ** 3
    return dipole.absorbed_fraction(np.minimum(q**2 / 3.0, 1.0), eta), q


def profile(radius_mm: ArrayLike, media: DipoleMedia) -> Float64Array:
    """Return the dipole's profile over R_d, 1/mm^2: its integral over the plane is 1.

    Where R_d is 1 all light leaves where it entered: 0 at every distance.

    Examples
    --------
    >>> medium = DipoleMedia.of(0.436, 3.674, eta=1.3)
    >>> exact = dipole.reflectance(1.0, 0.032, 0.74, 1.3) / 0.436
    >>> bool(abs(profile(1.0, medium) / exact - 1) < 1e-3)
    True
    """
    r = np.asarray(radius_mm, np.float64)
    total = np.zeros(np.broadcast_shapes(r.shape, media.scale.shape))
    for z in (media.depth_mm, media.height_mm):
        d = np.maximum(np.hypot(r, z), 1e-300)
        x = media.sigma_tr_per_mm * d
        # multiplied one by one: squares of tiny distances would underflow
        total = total + z / d * (1.0 + x) * np.exp(-x) / d / d
    return np.asarray(media.scale * total / (2.0 * np.pi))


def encircled_fraction(radius_mm: ArrayLike, media: DipoleMedia) -> Float64Array:
    """Return the fraction of light that exits within a radius of its entry point.

    Examples
    --------
    >>> medium = DipoleMedia.of(0.436, 3.674, eta=1.3)
    >>> encircled_fraction([0.0, 1.0, 1e3], medium).round(2).tolist()
    [0.0, 0.22, 1.0]
    """
    r = np.asarray(radius_mm, np.float64)
    total = np.zeros(np.broadcast_shapes(r.shape, media.scale.shape))
    # With d^2 = r^2 + z^2, r dr = d dd: the integral of z (1 + sigma d) exp(-sigma d) / d^3 over
    # the disc, r from 0, is exp(-sigma z) - z exp(-sigma d) / d.
    for z in (media.depth_mm, media.height_mm):
        d = np.maximum(np.hypot(r, z), 1e-300)
        sigma = media.sigma_tr_per_mm
        total = total + np.where(r > 0.0, np.exp(-sigma * z) - z / d * np.exp(-sigma * d), 0.0)
    return np.asarray(media.scale * total)


def kernel(radius_mm: ArrayLike, reach_mm: ArrayLike, media: DipoleMedia) -> Float64Array:
    """Return the profile of sources with a finite reach, 1/mm^2, of integral 1.

    Parameters
    ----------
    radius_mm, reach_mm
        Distance and reach of the source, mm; broadcast with the media.
    """
    carried, own = kernel_parts(radius_mm, reach_mm, media)
    return carried + own


def kernel_parts(
    radius_mm: ArrayLike, reach_mm: ArrayLike, media: DipoleMedia
) -> tuple[Float64Array, Float64Array]:
    """Return the kernel in two parts; `own` is light that exits closer than sources resolve.

    `own` is the bump with the excess light of a quarter of the reach (`SELF_RADIUS_FRACTION`).
    """
    r, a = np.asarray(radius_mm, np.float64), np.asarray(reach_mm, np.float64)
    # a reach whose square underflows is a point's
    a = np.where(a > 1e-150, a, 0.0)
    inside = (r < a) & (a > MIN_RADIUS_PER_DEPTH * media.depth_mm)
    a = np.where(a > 0.0, a, 1.0)
    edge, missing = profile(a, media), _missing_fraction(a, media)
    # bump of integral 1: 3 / (pi a^2) (1 - r^2 / a^2)^2 on the disc of radius a, smooth at its edge
    part = np.where(inside, r, 0.0) / a  # outside, its fourth power may overflow
    shape = np.where(inside, 3.0 / (np.pi * a**2) * (1.0 - part**2) ** 2, 0.0)
    own = _missing_fraction(SELF_RADIUS_FRACTION * a, media)
    far = np.where(inside, edge, profile(r, media))
    return np.asarray(far + shape * (missing - own)), np.asarray(shape * own)


def _missing_fraction(reach_mm: Float64Array, media: DipoleMedia) -> Float64Array:
    """Return the fraction of light within a reach in excess of a disc of the edge's value."""
    return encircled_fraction(reach_mm, media) - np.pi * reach_mm**2 * profile(reach_mm, media)


def sum_exitance(
    source_mm: ArrayLike,
    source_area_mm2: ArrayLike,
    entered: ArrayLike,
    exit_mm: ArrayLike,
    r_d: ArrayLike,
    translucency_mm: ArrayLike,
    *,
    eta: float = fresnel.ETA_SKIN,
    normalize: bool = True,
    entered_at: ArrayLike | None = None,
) -> Float64Array:
    """Sum over all sources for every exit point; see `model.dipole.gather.exitance`.

    Takes Q x S x 3 evaluations of the kernel: a reference, for a few thousand of each.
    """
    source, at = np.asarray(source_mm, np.float64), np.asarray(exit_mm, np.float64)
    area, light = np.asarray(source_area_mm2, np.float64), np.asarray(entered, np.float64)
    albedo = np.broadcast_to(np.asarray(r_d, np.float64), (len(at), 3))
    length = np.broadcast_to(np.asarray(translucency_mm, np.float64), (len(at), 3))
    own = None if entered_at is None else np.asarray(entered_at, np.float64)
    reach = SOURCE_RADIUS_PER_SIDE * np.sqrt(area)
    found = np.zeros((len(at), 3))
    if not len(source):
        return found
    step = max(1, _CHUNK_BYTES // (8 * len(source)))
    for start in range(0, len(at), step):
        part = slice(start, start + step)
        away = np.zeros((len(at[part]), len(source)))
        for axis in range(3):
            away += (at[part, axis, None] - source[:, axis]) ** 2
        away = np.sqrt(away)
        nearest = light[np.argmin(away, axis=1)]
        for c in range(3):
            media = DipoleMedia.of(albedo[part, c, None], length[part, c, None], eta=eta)
            carried, near = (share * area for share in kernel_parts(away, reach, media))
            mass, total = (carried + near).sum(axis=1), carried @ light[:, c]
            total += near @ light[:, c] if own is None else near.sum(axis=1) * own[part, c]
            if normalize:
                reached = mass > MIN_RELATIVE_LIGHT
                total = np.where(reached, total / np.where(reached, mass, 1.0), nearest[:, c])
            found[part, c] = albedo[part, c] * total
    return found
