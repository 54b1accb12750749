"""Invert radial reflectance profiles to absorption, reduced scattering and sigma_tr.

There are three models. "photon_table" is recommended: a white Monte Carlo table with the boundary
and, for a fiber, its cone and core. "diffusion" (Kienle and Patterson 1997) is faster and has no
table limits. "dipole" is the model of Weyrich et al., the baseline.

All three are compared with a profile in the same way:

- Reflectance falls by four to six decades over a probe, and far from the source it is noise about
  zero. So residuals are linear, each over its standard deviation: a far fiber then bounds the
  reflectance from above, and negative readings are used as they are. A model that is off by some
  percent must not be weighted by a reading good to a thousandth, so each deviation includes a
  fraction of the model's profile (`ProfileModel.error`). Without a variance logarithms are
  compared, and each fiber's weight is found from the residuals around it.
- Errors common to a profile are nuisance parameters with a prior: the common scale
  (``common_error``), and for the table the asymmetry g of the phase function, which affects the
  fibers near the source. They are fitted with the coefficients, which reduces the weight of the
  near fibers without a cutoff.
- Each profile begins at the best of some hundred pairs on a grid, by logarithms, and again in a
  second valley of the misfit where there is one.
- A medium of another asymmetry than the prior's (for the table, and with a variance) is found by a
  second fit with any g, and is not valid, see `reconstruction.subsurface.asymmetry`.
- A misfit (layers, a wrong scale) is reported, and absorbed by a relative model error, equal at all
  fibers and found from the residuals; the profile is fitted again with it. Such residuals
  correlate between neighboring fibers, and standard errors grow by that correlation.

The paper does not state which fibers it fits nor their weights. Its baseline here takes all usable
fibers, and a tenth of the reflectance as the dipole's own error: that is, equal relative weights
wherever the noise is below it. Linear residuals of equal weight would leave the nearest fiber alone
to decide; those of measured variance the nearest few, where the dipole is worst.

References
----------
Weyrich et al. 2006, section 8, doi:10.1145/1141911.1141987. Jensen et al. 2001,
doi:10.1145/383259.383319. Kienle and Patterson 1997, doi:10.1364/JOSAA.14.000246.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.checks import Checks
from model.fresnel import ETA_SKIN
from reconstruction.arrays import BoolArray, Float64Array, UInt8Array
from reconstruction.subsurface import asymmetry, kernels, nearest
from reconstruction.subsurface.models import (
    FIT_METHODS,
    FiberOptics,
    Method,
    ProfileModel,
    profile_model,
)
from reconstruction.subsurface.outcome import SubsurfaceFit, evaluate_fits
from reconstruction.subsurface.profile_batch import Fits, OmissionReason, ProfileBatch
from reconstruction.subsurface.profile_fit import fit_profiles

PROFILES_PER_BATCH = 8192
"""Profiles fitted at a time; bounds the memory of temporaries."""


class SubsurfaceError(ValueError):
    """Profiles, radii or settings that cannot be fitted."""


def invert(
    radius_mm: ArrayLike,
    reflectance_per_mm2: ArrayLike,
    *,
    eta: float = ETA_SKIN,
    variance: ArrayLike | None = None,
    method: Method = "photon_table",
    common_error: float = 0.0,
    model_error: float | None = None,
    valid: ArrayLike | None = None,
    **optics: Any,
) -> SubsurfaceFit:
    """Fit the coefficients of a homogeneous half-space to radial profiles.

    Parameters
    ----------
    radius_mm : array_like, shape (F,) or broadcast to that of the profiles
        Distance of each fiber from the source, mm, at least 0.
    reflectance_per_mm2 : array_like, shape (..., F)
        Profiles, 1/mm^2: all exitance R(r), or what a fiber collects (``collection``). Values that
        are not finite are omitted, negative ones are used; sizes up to 1e30.
    eta : float
        Refractive index of the medium over that outside, at least 1.
    variance : array_like, broadcast to the profiles, optional
        Of the reflectance, 1/mm^4: noise and calibration errors that differ between fibers.
        Fibers of infinite, negative or NaN variance are omitted. None: the noise is estimated from
        the residuals.
    method : {"photon_table", "diffusion", "dipole"}
    common_error : float
        Relative standard deviation of a scale common to all fibers (of a calibration).
    model_error : float, optional
        Relative deviation of each fiber due to the model, the method's own by default. A number
        also removes the systematic error of a closed form from that of sigma_tr.
    valid : array_like of bool, broadcast to the profiles, optional
    collection : {"all", "fiber"}
        What was collected, "all" by default; the closed forms take both as exitance.
    core_mm, source_core_mm : float
        Core diameters of detection and source fiber, mm, for the table; 0 by default.
    g, g_error : float
        Asymmetry of the phase function and its standard deviation, for the table; 0 fixes it. By
        default those of soft tissue.

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
    light = FiberOptics(eta, **optics)
    _check_settings(method, light, common_error=common_error, model_error=model_error or 0.0)
    layout = _lay_out(radius_mm, reflectance_per_mm2, variance, valid)
    g_error = light.g_error if method == "photon_table" else 0.0
    batch = layout.batch(_prior(common_error, light.g, g_error))

    def fit(batch: ProfileBatch, model: ProfileModel) -> Fits:
        if model_error is not None:
            error = np.array([float(model_error), 0.0, 0.0])
            model = replace(model, error=error, bias=(0.0, 0.0))
        fits = fit_profiles(batch, model)
        if batch.logarithmic or g_error == 0.0:
            return fits

        def model_with(g: float, g_error: float) -> ProfileModel:
            free = profile_model(method, light._replace(g=g, g_error=g_error), model.radius_mm)
            return replace(free, error=model.error, bias=model.bias)

        return asymmetry.compare_asymmetries(batch, fits, model_with)

    fits = layout.fit(batch, partial(profile_model, method, light), fit, PROFILES_PER_BATCH)
    return evaluate_fits(batch, fits, layout.shape, method)


def nearest_medium(
    radius_mm: ArrayLike,
    reflectance_per_mm2: ArrayLike,
    *,
    variance: ArrayLike,
    eta: float = ETA_SKIN,
    valid: ArrayLike | None = None,
    **optics: Any,
) -> SubsurfaceFit:
    """Find the homogeneous medium whose profile is nearest to that of layered tissue.

    `reconstruction.subsurface.nearest` defines it. The profile is compared up to a factor,
    `SubsurfaceFit.scale`, by the photon table. `SubsurfaceFit.model_error` is the remaining
    distance; it is not an error of the defined medium, and intervals cover the readings' errors.

    Parameters
    ----------
        See :func:`invert`; reflectance in units of 1/mm^2, as the definition omits fibers that
        collect too little.
    collection : {"all", "fiber"}
        What was collected, "fiber" by default.

    Returns
    -------
    SubsurfaceFit

    Raises
    ------
    SubsurfaceError
        See :func:`invert`.

    Examples
    --------
    >>> from model.photon_table import table as photon_table
    >>> r = np.linspace(0.3, 7.05, 28)
    >>> profile = 0.5 * photon_table.reflectance(r, 0.1, 2.0, collection="fiber", core_mm=0.2)
    >>> fit = nearest_medium(r, profile, variance=(0.01 * profile) ** 2, core_mm=0.2)
    >>> float(fit.scale.round(2)), float(fit.sigma_s_prime_per_mm.round(1))
    (0.5, 2.0)
    """
    settings = {"collection": "fiber"} | optics
    light = FiberOptics(eta, **settings, g=nearest.NEAREST_MEDIUM_G, g_error=0.0)
    _check_settings("photon_table", light)
    layout = _lay_out(radius_mm, reflectance_per_mm2, variance, valid)
    batch = layout.batch(_prior(nearest.LOG_FACTOR_SIGMA, nearest.NEAREST_MEDIUM_G, 0.0))
    fits = layout.fit(batch, partial(profile_model, "photon_table", light), nearest.fit_nearest)
    return evaluate_fits(batch, fits, layout.shape, "photon_table", by_definition=True)


def fit_dipole(
    radius_mm: ArrayLike,
    reflectance_per_mm2: ArrayLike,
    *,
    eta: float = ETA_SKIN,
    variance: ArrayLike | None = None,
    **settings: Any,
) -> SubsurfaceFit:
    """Fit Jensen's dipole, as Weyrich et al. did: the baseline.

    Uses all usable fibers, of equal relative weight as far as their noise allows, see the module.
    On true profiles sigma_tr comes out some 5 to 25 % too small.

    Parameters
    ----------
    radius_mm, reflectance_per_mm2, eta, variance, settings
        See :func:`invert`.

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
    """Profiles, one per row, (N, F), with the fibers used."""

    y: Float64Array
    variance: Float64Array | None
    omission: UInt8Array
    radius_mm: Float64Array
    """(N or 1, F)."""
    shape: tuple[int, ...]
    """Leading axes of the profiles as given."""

    def batch(self, prior: Float64Array) -> ProfileBatch:
        """Return the profiles with a prior as a batch for fits."""
        return ProfileBatch.lay_out(self.y, self.variance, self.omission, prior)

    def fit(
        self,
        batch: ProfileBatch,
        model_at: Callable[[Float64Array], ProfileModel],
        fit: Callable[[ProfileBatch, ProfileModel], Fits],
        max_profiles: int | None = None,
    ) -> Fits:
        """Fit all profiles, those of equal radii by one model, at most so many at a time."""
        parts = []
        distinct, which = np.unique(self.radius_mm, axis=0, return_inverse=True)
        which = np.broadcast_to(which.reshape(-1), self.y.shape[:1])
        for number, radius_mm in enumerate(distinct):
            rows, model = np.flatnonzero(which == number), model_at(np.ascontiguousarray(radius_mm))
            step = max_profiles or max(rows.size, 1)
            for begin in range(0, max(rows.size, 1), step):
                some = rows[begin : begin + step]
                parts.append((some, fit(batch.select(some), model)))
        return Fits.join(parts)


def _prior(common_error: float, g: float, g_error: float) -> Float64Array:
    """Return means and standard deviations of the parameters, (4, 2)."""
    prior = np.zeros((kernels.N_PARAMETERS, 2))
    prior[:2, 1] = math.inf
    prior[2, 1] = common_error
    prior[3] = g, g_error
    return prior


def _lay_out(
    radius_mm: ArrayLike,
    reflectance_per_mm2: ArrayLike,
    variance: ArrayLike | None,
    valid: ArrayLike | None,
) -> _Layout:
    """Check profiles and lay them out as rows, see `invert`."""
    check = Checks(SubsurfaceError)
    y = np.asarray(reflectance_per_mm2, np.float64)
    check.shape("reflectance_per_mm2", y, ("...", "fibers"))
    shape, full = y.shape[:-1], y.shape
    radius = np.asarray(radius_mm, np.float64)
    if radius.shape != full[-1:]:
        radius = _broadcast("radius_mm", radius, full)
    check.within("radius_mm", radius, "[0, inf)")
    y = y.reshape(-1, full[-1])
    left_out = np.full(y.shape, OmissionReason.USED, np.uint8)

    def leave_out(where: BoolArray, reason: OmissionReason) -> None:
        left_out[(left_out == OmissionReason.USED) & where] = reason

    if valid is not None:
        given = _broadcast("valid", np.asarray(valid, bool), full).reshape(y.shape)
        leave_out(~given, OmissionReason.MASKED)
    leave_out(~np.isfinite(y), OmissionReason.NOT_FINITE)
    noise = None
    if variance is None:
        leave_out(~(y > 0.0), OmissionReason.NOT_ABOVE_ZERO)
    else:
        noise = _broadcast("variance", np.asarray(variance, np.float64), full).reshape(y.shape)
        leave_out(~((noise >= 0.0) & (noise < math.inf)), OmissionReason.NO_VARIANCE)
    rows = radius.reshape(-1, full[-1]) if radius.size else np.zeros((1, full[-1]))
    return _Layout(y, noise, left_out, rows, shape)


def _broadcast(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Return an argument broadcast to the profiles."""
    try:
        return np.broadcast_to(array, shape)
    except ValueError as error:
        raise SubsurfaceError(
            f"{name}: got shape {array.shape}, expected one that broadcasts to {shape}; "
            "give one value per fiber, or one per profile and fiber"
        ) from error


def _check_settings(method: str, optics: FiberOptics, **not_negative: float) -> None:
    check = Checks(SubsurfaceError)
    check.choice("method", method, FIT_METHODS)
    check.choice("collection", optics.collection, ("all", "fiber"))
    check.within("eta", optics.eta, "[1, inf)")
    for name in ("core_mm", "source_core_mm", "g", "g_error"):
        not_negative[name] = getattr(optics, name)
    for name, value in not_negative.items():
        check.within(name, value, "[0, inf)")
