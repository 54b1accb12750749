"""Surface length of a skin profile under stretch and compression (Nagano2015, fig. 4).

The surface topography of skin is a reserve of length. A profile that is stretched or compressed
with unchanged heights becomes longer or shorter along its surface, which would strain the skin;
smoothing it under stretch and sharpening it under compression preserves the length. This module
measures lengths and finds the strength of a length-preserving kernel.

The kernel is that of eq. (6), ``(1 - alpha) delta + alpha G(sigma)``, convolved before the profile
is stretched, with sigma on the neutral profile as everywhere in `model.microstructure`. Beyond the
ends of a profile its heights are mirrored.

References
----------
Nagano et al. 2015, Skin Microstructure Deformation with Displacement Map Convolution, ACM Trans.
Graph. 34(4), 109, section 3. doi:10.1145/2766894
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import correlate1d
from scipy.optimize import brentq

from model.arrays import Float64Array
from model.checks import Checks
from model.microstructure.kernel_table import ALPHA_LIMITS, gaussian_weights

MAX_ALPHA = 1e3
"""Limit of the search for a strength: beyond it the profile has no detail at sigma's scale."""


class SurfaceProfileError(ValueError):
    """Error for a profile, a stretch or a kernel for which no length is defined."""


def surface_length(height_um: ArrayLike, *, spacing_um: float) -> Float64Array:
    """Return the length of the polygon through a profile's heights.

    Parameters
    ----------
    height_um : array_like, shape (..., N)
        Heights at equal distances, um, N >= 2.
    spacing_um : float
        Distance of heights, um, > 0.

    Returns
    -------
    ndarray of float64, shape (...)
        um, at least ``(N - 1) * spacing_um``.

    Raises
    ------
    SurfaceProfileError

    Examples
    --------
    >>> float(surface_length([0.0, 3.0, 0.0], spacing_um=4.0))
    10.0
    """
    height = _heights(height_um, spacing_um)
    return np.asarray(np.hypot(np.diff(height, axis=-1), spacing_um).sum(axis=-1))


def _heights(height_um: ArrayLike, spacing_um: float) -> Float64Array:
    height = Checks(SurfaceProfileError).numbers("height_um", height_um, ("...", "N"))
    Checks(SurfaceProfileError).within("heights of height_um", height.shape[-1], "[2, inf)")
    Checks(SurfaceProfileError).within("spacing_um", spacing_um, "(0, inf)")
    return height


def convolve_profile(
    height_um: ArrayLike, alpha: float, sigma_um: float, *, spacing_um: float
) -> Float64Array:
    """Return profiles convolved with a kernel of eq. (6), mirrored at their ends.

    Parameters
    ----------
    height_um : array_like, shape (..., N)
        um.
    alpha : float
        Strength; above 0 smooths, below 0 sharpens.
    sigma_um : float
        Standard deviation, um, > 0.
    spacing_um : float
        Distance of heights, um, > 0.

    Raises
    ------
    SurfaceProfileError
        For heights, a strength or lengths that are not finite, or lengths that are not above 0.
    """
    height = _heights(height_um, spacing_um)
    Checks(SurfaceProfileError).within("alpha", alpha)
    return height + alpha * _unit_change(height, sigma_um, spacing_um)


def _unit_change(height: Float64Array, sigma_um: float, spacing_um: float) -> Float64Array:
    """Return the blurred profile less the profile: its change per unit of alpha."""
    Checks(SurfaceProfileError).within("sigma_um", sigma_um, "(0, inf)")
    half = gaussian_weights(sigma_um / spacing_um)
    weights = np.concatenate([half[:0:-1], half])
    return np.asarray(correlate1d(height, weights, axis=-1, mode="reflect") - height)


@dataclass(frozen=True, slots=True)
class LengthChange:
    """Lengths of a surface before and after a stretch; see :func:`length_change`."""

    stretch: float
    """Ratio r along the profile."""
    neutral_um: float
    """Length of the neutral surface, um."""
    unchanged_um: float
    """Length when the profile is stretched with unchanged heights, um."""
    convolved_um: float
    """Length when it is convolved with the kernel and stretched, um."""
    alpha: float
    """Strength of the kernel."""
    sigma_um: float
    """Standard deviation of the kernel on the neutral profile, um."""

    @property
    def unchanged_ratio(self) -> float:
        """Return the length with unchanged heights over the neutral one."""
        return self.unchanged_um / self.neutral_um

    @property
    def convolved_ratio(self) -> float:
        """Return the length with the kernel over the neutral one; 1 where it is preserved."""
        return self.convolved_um / self.neutral_um


def length_change(
    height_um: ArrayLike, *, spacing_um: float, stretch: float, alpha: float, sigma_um: float
) -> LengthChange:
    """Return the surface lengths of a profile before and after a stretch, with and without kernel.

    Parameters
    ----------
    height_um : array_like, shape (N,)
        Neutral heights, um.
    spacing_um : float
        Their distance, um.
    stretch : float
        Ratio r > 0 of lengths along the profile.
    alpha, sigma_um : float
        Kernel, such as `model.microstructure.kernel_parameters` gives for the stretch.

    Returns
    -------
    LengthChange

    Raises
    ------
    SurfaceProfileError

    Examples
    --------
    >>> wave = 60.0 * np.sin(np.arange(600) / 10.0)
    >>> change = length_change(wave, spacing_um=5.0, stretch=1.2, alpha=0.6, sigma_um=19.0)
    >>> round(change.unchanged_ratio, 3), round(change.convolved_ratio, 3)
    (1.125, 1.108)
    """
    height = _profile(height_um, spacing_um, stretch)
    moved = convolve_profile(height, alpha, sigma_um, spacing_um=spacing_um)
    return LengthChange(
        stretch=float(stretch),
        neutral_um=float(surface_length(height, spacing_um=spacing_um)),
        unchanged_um=float(surface_length(height, spacing_um=spacing_um * stretch)),
        convolved_um=float(surface_length(moved, spacing_um=spacing_um * stretch)),
        alpha=float(alpha),
        sigma_um=float(sigma_um),
    )


def _profile(height_um: ArrayLike, spacing_um: float, stretch: float) -> Float64Array:
    height = Checks(SurfaceProfileError).numbers("height_um", height_um, ("N",))
    surface_length(height, spacing_um=spacing_um)
    Checks(SurfaceProfileError).within("stretch", stretch, "(0, inf)")
    return height


@dataclass(frozen=True, slots=True)
class LengthPreservingKernel:
    """The kernel that keeps a profile's length; see :func:`find_length_preserving_kernel`."""

    change: LengthChange
    """Lengths with that kernel, or the nearest one."""
    is_preserved: bool
    """Whether the length is the neutral one."""
    within_limits: bool
    """Whether the strength lies in the kernel's range, -2 to 1."""


def find_length_preserving_kernel(
    height_um: ArrayLike, *, spacing_um: float, stretch: float, sigma_um: float
) -> LengthPreservingKernel:
    """Find the strength of a kernel that keeps the length of a profile's surface.

    Parameters
    ----------
    height_um : array_like, shape (N,)
        Neutral heights, um.
    spacing_um : float
        Their distance, um.
    stretch : float
        Ratio r > 0 of lengths along the profile.
    sigma_um : float
        Standard deviation of the kernel, um.

    Returns
    -------
    LengthPreservingKernel
        Not ``is_preserved`` when smoothing cannot make up for the stretch, or when a compressed
        profile has no detail to sharpen: then with the nearest strength.

    Raises
    ------
    SurfaceProfileError

    Notes
    -----
    Slopes are linear in alpha, so the length is a convex function of it. At alpha = 0 a stretched
    surface is too long, and the least alpha > 0 that keeps the length is sought up to the minimum;
    a compressed one is too short, and the only alpha < 0 that lengthens it enough is sought.

    Examples
    --------
    >>> wave = 60.0 * np.sin(np.arange(600) / 10.0)
    >>> found = find_length_preserving_kernel(wave, spacing_um=5.0, stretch=1.05, sigma_um=30.0)
    >>> found.is_preserved, round(found.change.alpha, 2), round(found.change.convolved_ratio, 6)
    (True, 0.44, 1.0)
    """
    height = _profile(height_um, spacing_um, stretch)
    change = _unit_change(height, sigma_um, spacing_um)
    a, b = np.diff(height), np.diff(change)
    neutral = float(np.hypot(a, spacing_um).sum())
    run = spacing_um * stretch

    def excess(alpha: float) -> float:
        return float(np.hypot(a + alpha * b, run).sum()) - neutral

    def slope(alpha: float) -> float:
        c = a + alpha * b
        return float((c * b / np.hypot(c, run)).sum())

    # Blurring lowers slopes, so the length decreases with alpha at 0 unless the profile is
    # straight.
    alpha = 0.0
    if abs(excess(0.0)) > 1e-12 * neutral and slope(0.0) < 0:
        if excess(0.0) < 0:
            alpha = -_find_sign_change(lambda strength: excess(-strength), MAX_ALPHA)
        else:
            shortest = _find_sign_change(slope, MAX_ALPHA)
            alpha = _find_sign_change(excess, shortest)
    found = length_change(
        height, spacing_um=spacing_um, stretch=stretch, alpha=alpha, sigma_um=sigma_um
    )
    return LengthPreservingKernel(
        change=found,
        is_preserved=abs(found.convolved_ratio - 1.0) < 1e-9,
        within_limits=ALPHA_LIMITS[0] <= alpha <= ALPHA_LIMITS[1],
    )


def _find_sign_change(function: Callable[[float], float], last: float) -> float:
    """Return the argument of a sign change between 0 and ``last``; ``last`` if there is none."""
    if function(0.0) * function(last) > 0:
        return last
    return float(brentq(function, 0.0, last, xtol=1e-14, rtol=1e-13))
