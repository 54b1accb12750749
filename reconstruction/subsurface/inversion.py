"""Radial profiles of reflectance to absorption, reduced scattering and sigma_tr, with intervals.

Three models stand to choose. "photon_table" is recommended: a white Monte Carlo table with the
boundary and, for a fibre, its cone and core. "diffusion" (Kienle and Patterson 1997) is faster and
does without the table's limits. "dipole" is what Weyrich et al. fitted, and the baseline.

How a profile is compared, for all three:

- Reflectance falls by four to six decades over a probe, and far from the source it is noise about
  zero. So residuals are linear, each over its standard deviation: a far fibre then says no more
  than that the reflectance is small, and negative readings are used as they are. A model that is
  off by some percent must not be weighed by a reading good to a thousandth, so that a share of the
  model's profile joins each deviation (`ProfileModel.error`). Without a variance logarithms are
  compared, and each fibre's weight is then found from the residuals around it.
- What one number per profile may be off, one nuisance parameter with a prior describes: the common
  scale (``common_error``), and for the table the asymmetry g of the phase function, which the
  fibres near the source depend on. They are fitted along, which weighs the near fibres down rather
  than cutting them off.
- Each profile begins at the best of some hundred pairs on a grid, by logarithms, and again in a
  second valley of the misfit where there is one.
- A misfit (layers, a wrong scale) is reported, and taken up by a relative model error, equal at all
  fibres, which is found from the residuals; the profile is fitted again with it. As such residuals
  are alike at neighbouring fibres, standard errors grow by how much they repeat each other.

The paper does not say which fibres it fits nor how it weighs them. Its baseline here takes all
fibres whose reading means something, and a tenth of the reflectance as the dipole's own error: that
is, equal relative weights wherever the noise is below it. Linear residuals of equal weight would
leave the nearest fibre alone to decide; those of measured variance the nearest few, where the
dipole is worst.

References
----------
Weyrich et al. 2006, section 8, doi:10.1145/1141911.1141987. Jensen et al. 2001,
doi:10.1145/383259.383319. Kienle and Patterson 1997, doi:10.1364/JOSAA.14.000246.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.fresnel import ETA_SKIN
from reconstruction.arrays import Float64Array, UInt8Array
from reconstruction.subsurface import kernels, nearest
from reconstruction.subsurface.models import METHODS, Collection, Method, profile_model
from reconstruction.subsurface.outcome import LEFT_OUT, Outcome, SubsurfaceFit, judged
from reconstruction.subsurface.profile_batch import ProfileBatch

__all__ = [
    "LEFT_OUT",
    "Outcome",
    "SubsurfaceError",
    "SubsurfaceFit",
    "fit_dipole",
    "invert",
    "nearest_medium",
]


G_SKIN, G_SKIN_ERROR = 0.825, 0.072
"""Asymmetry of soft tissue: mean and standard deviation of 0.7...0.95, all equally likely."""
BATCH = 8192
"""Profiles fitted at a time, for the size of temporaries."""


class SubsurfaceError(ValueError):
    """Profiles, radii or settings that no fit can be made of."""


def invert(
    radius_mm: ArrayLike,
    reflectance_per_mm2: ArrayLike,
    *,
    eta: float = ETA_SKIN,
    variance: ArrayLike | None = None,
    method: Method = "photon_table",
    collection: Collection = "all",
    core_mm: float = 0.0,
    source_core_mm: float = 0.0,
    common_error: float = 0.0,
    g: float = G_SKIN,
    g_error: float = G_SKIN_ERROR,
    model_error: float | None = None,
    valid: ArrayLike | None = None,
) -> SubsurfaceFit:
    """Fit the coefficients of a homogeneous half-space to radial profiles.

    Parameters
    ----------
    radius_mm : array_like, shape (F,) or broadcast to that of the profiles
        Distance of each fibre from the source, mm, at least 0.
    reflectance_per_mm2 : array_like, shape (..., F)
        Profiles, 1/mm^2: all exitance R(r), or what a fibre takes (``collection``). Values that
        are not finite are left out, negative ones are used; sizes up to 1e30.
    eta : float
        Refractive index of the medium over that outside, at least 1.
    variance : array_like, broadcast to the profiles, optional
        Of the reflectance, 1/mm^4: noise and what differs from fibre to fibre in the calibration.
        Fibres of infinite, negative or NaN variance are left out. None: the noise is taken from the
        residuals.
    method : {"photon_table", "diffusion", "dipole"}
    collection : {"all", "fibre"}
        What was collected; the closed forms take both as exitance.
    core_mm, source_core_mm : float
        Core diameters of detection and source fibre, mm, for the table.
    common_error : float
        Relative standard deviation of a scale common to all fibres (of a calibration).
    g, g_error : float
        Asymmetry of the phase function and its standard deviation, for the table; 0 fixes it.
    model_error : float, optional
        Relative deviation of each fibre for the model's sake, the method's own by default. Given
        a number, no systematic error of a closed form is added to sigma_tr either.
    valid : array_like of bool, broadcast to the profiles, optional

    Returns
    -------
    SubsurfaceFit

    Raises
    ------
    SubsurfaceError
        For shapes that do not fit, or settings outside their range.

    Examples
    --------
    >>> from model.dipole import profile as dipole
    >>> r = np.linspace(0.3, 7.05, 28)
    >>> fit = invert(r, dipole.reflectance(r, 0.04, 1.5, 1.4), method="dipole")
    >>> float(fit.sigma_a_per_mm.round(6)), float(fit.sigma_s_prime_per_mm.round(6))
    (0.04, 1.5)
    """
    _check_settings(
        method,
        collection,
        eta,
        core_mm=core_mm,
        source_core_mm=source_core_mm,
        common_error=common_error,
        g=g,
        g_error=g_error,
        model_error=model_error or 0.0,
    )
    laid = _lay_out(radius_mm, reflectance_per_mm2, variance, valid)
    y, left_out = laid.y, laid.left_out
    prior = np.zeros((kernels.PARAMETERS, 2))
    prior[:2, 1] = math.inf
    prior[2, 1] = common_error
    prior[3] = g, g_error if method == "photon_table" else 0.0
    batch = ProfileBatch.of(y, laid.variance, left_out == 0, prior)
    domain, bias = np.zeros(y.shape[0], np.bool_), np.zeros(y.shape[0])
    bounds = np.zeros((kernels.PARAMETERS, 2))
    for own, members in laid.by_radius():
        model = profile_model(
            method,
            np.ascontiguousarray(own),
            eta=float(eta),
            collection=collection,
            core_mm=float(core_mm),
            source_core_mm=float(source_core_mm),
            g=float(g),
            g_error=float(g_error),
        )
        if model_error is not None:
            model = replace(model, error=np.array([float(model_error), 0.0, 0.0]))
        bounds = model.bounds
        for begin in range(0, members.size, BATCH):
            chosen = members[begin : begin + BATCH]
            batch.fit(model, chosen)
            domain[chosen] = model.holds(batch.theta[chosen])
            if model_error is None:
                bias[chosen] = model.systematic(batch.theta[chosen])
    return judged(batch, bounds, domain, bias, left_out, laid.shape, method)


def nearest_medium(
    radius_mm: ArrayLike,
    reflectance_per_mm2: ArrayLike,
    *,
    variance: ArrayLike,
    eta: float = ETA_SKIN,
    collection: Collection = "fibre",
    core_mm: float = 0.0,
    source_core_mm: float = 0.0,
    valid: ArrayLike | None = None,
) -> SubsurfaceFit:
    """Find the homogeneous medium whose profile is nearest to that of tissue that is none.

    `reconstruction.subsurface.nearest` has the definition. The profile is compared up to a factor,
    which is in `SubsurfaceFit.scale`, by the photon table; `SubsurfaceFit.model_error` says how far
    it is off, and is no error of what is defined: intervals are of the readings.

    Parameters
    ----------
    radius_mm, reflectance_per_mm2, eta, variance, collection, core_mm, source_core_mm, valid
        As of :func:`invert`; reflectance in units of 1/mm^2, as the definition leaves out fibres
        that take too little.

    Returns
    -------
    SubsurfaceFit

    Raises
    ------
    SubsurfaceError
        As of :func:`invert`.

    Examples
    --------
    >>> from model.photon_table import table as photon_table
    >>> r = np.linspace(0.3, 7.05, 28)
    >>> profile = 0.5 * photon_table.reflectance(r, 0.1, 2.0, collection="fibre", core_mm=0.2)
    >>> fit = nearest_medium(r, profile, variance=(0.01 * profile) ** 2, core_mm=0.2)
    >>> float(fit.scale.round(2)), float(fit.sigma_s_prime_per_mm.round(1))
    (0.5, 2.0)
    """
    _check_settings("photon_table", collection, eta, core_mm=core_mm, source_core_mm=source_core_mm)
    laid = _lay_out(radius_mm, reflectance_per_mm2, variance, valid)
    prior = np.zeros((kernels.PARAMETERS, 2))
    prior[:2, 1] = math.inf
    prior[2, 1], prior[3, 0] = nearest.DIMMING, nearest.G
    batch = ProfileBatch.of(laid.y, laid.variance, laid.left_out == 0, prior)
    batch.erring = False
    domain, bounds = np.zeros(laid.y.shape[0], np.bool_), np.zeros((kernels.PARAMETERS, 2))
    for own, members in laid.by_radius():
        model = profile_model(
            "photon_table",
            np.ascontiguousarray(own),
            eta=float(eta),
            collection=collection,
            core_mm=float(core_mm),
            source_core_mm=float(source_core_mm),
            g=nearest.G,
            g_error=0.0,
        )
        bounds = model.bounds
        nearest.fit_nearest(batch, model, members)
        domain[members] = model.holds(batch.theta[members])
    nothing = np.zeros(laid.y.shape[0])
    return judged(batch, bounds, domain, nothing, laid.left_out, laid.shape, "photon_table")


def fit_dipole(
    radius_mm: ArrayLike,
    reflectance_per_mm2: ArrayLike,
    *,
    eta: float = ETA_SKIN,
    variance: ArrayLike | None = None,
    **settings: Any,
) -> SubsurfaceFit:
    """Fit Jensen's dipole, as Weyrich et al. did: the baseline.

    Fibres and weights as the module says: all that can be used, of equal relative weight as far as
    their noise allows. On true profiles sigma_tr comes out some 5 to 25 % too small.

    Parameters
    ----------
    radius_mm, reflectance_per_mm2, eta, variance, settings
        As of :func:`invert`.

    Examples
    --------
    >>> from model.dipole import profile as dipole
    >>> r = np.linspace(0.3, 7.05, 28)
    >>> fit = fit_dipole(r, dipole.reflectance(r, 0.25, 2.0, 1.4))
    >>> bool(abs(fit.sigma_tr_per_mm / dipole.effective_transport(0.25, 2.0) - 1.0) < 1e-6)
    True
    """
    return invert(
        radius_mm, reflectance_per_mm2, eta=eta, variance=variance, method="dipole", **settings
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Layout:
    """Profiles one a row, (N, F), with what of them is used."""

    y: Float64Array
    variance: Float64Array | None
    left_out: UInt8Array
    radius_mm: Float64Array
    """(N or 1, F)."""
    shape: tuple[int, ...]
    """Leading axes of the profiles as given."""

    def by_radius(self) -> Iterator[tuple[Float64Array, NDArray[np.intp]]]:
        """Yield each set of radii with the rows that have it."""
        distinct, which = np.unique(self.radius_mm, axis=0, return_inverse=True)
        which = np.broadcast_to(which.reshape(-1), self.y.shape[:1])
        for number, own in enumerate(distinct):
            yield own, np.flatnonzero(which == number)


def _lay_out(
    radius_mm: ArrayLike,
    reflectance_per_mm2: ArrayLike,
    variance: ArrayLike | None,
    valid: ArrayLike | None,
) -> _Layout:
    """Check profiles and lay them out, see `invert`."""
    y = np.asarray(reflectance_per_mm2, np.float64)
    if y.ndim == 0 or y.shape[-1] == 0:
        raise SubsurfaceError(f"reflectance_per_mm2: got shape {y.shape}, expected (..., fibres)")
    shape, fibres = y.shape[:-1], y.shape[-1]
    radius = _spread("radius_mm", np.asarray(radius_mm, np.float64), y.shape)
    if not np.all((radius >= 0.0) & np.isfinite(radius)):
        raise SubsurfaceError("radius_mm: got negative or not finite values, expected at least 0")
    y = y.reshape(-1, fibres)
    spread = None
    if variance is not None:
        spread = _spread("variance", np.asarray(variance, np.float64), (*shape, fibres))
        spread = spread.reshape(y.shape)
    left_out = np.zeros(y.shape, np.uint8)
    if valid is not None:
        given = _spread("valid", np.asarray(valid, bool), (*shape, fibres)).reshape(y.shape)
        left_out[~given] = 1
    left_out[(left_out == 0) & ~np.isfinite(y)] = 2
    if spread is None:
        with np.errstate(invalid="ignore"):
            left_out[(left_out == 0) & ~(y > 0.0)] = 4
    else:
        left_out[(left_out == 0) & ~((spread >= 0.0) & (spread < math.inf))] = 3
    rows = radius.reshape(-1, fibres) if radius.ndim > 1 else radius[None]
    return _Layout(y, spread, left_out, rows, shape)


def _spread(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an argument broadcast to the profiles; radii of one axis stay as they are."""
    if name == "radius_mm" and array.shape == shape[-1:]:
        return array
    try:
        return np.broadcast_to(array, shape)
    except ValueError as error:
        raise SubsurfaceError(
            f"{name}: got shape {array.shape}, expected one that broadcasts to {shape}"
        ) from error


def _check_settings(method: str, collection: str, eta: float, **not_negative: float) -> None:
    if method not in METHODS:
        raise SubsurfaceError(f"method: got {method!r}, expected one of {', '.join(METHODS)}")
    if collection not in ("all", "fibre"):
        raise SubsurfaceError(f'collection: got {collection!r}, expected "all" or "fibre"')
    if not 1.0 <= eta < math.inf:
        raise SubsurfaceError(f"eta: got {eta}, expected a relative refractive index >= 1")
    for name, value in not_negative.items():
        if not 0.0 <= value < math.inf:
            raise SubsurfaceError(f"{name}: got {value}, expected a number of at least 0")
