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
- Each profile begins at the best of some hundred pairs on a grid, by logarithms.

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
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import Any

import numpy as np
from numba import get_num_threads
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import uniform_filter1d
from scipy.special import gammaincc, stdtrit

from model.fresnel import ETA_SKIN
from reconstruction import subsurface_kernels as kernels
from reconstruction.subsurface_models import (
    METHODS,
    Collection,
    Method,
    ProfileModel,
    profile_model,
)

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Codes = NDArray[np.uint16]

G_SKIN, G_SKIN_ERROR = 0.825, 0.072
"""Asymmetry of soft tissue: mean and standard deviation of 0.7...0.95, all equally likely."""
FEWEST_FIBRES = 4
FEWEST_READINGS = 3
"""Fibres that must stand out of the noise by `SIGNAL` standard deviations."""
SIGNAL = 3.0
LOG_LIMIT = 0.5
"""Standard error of log sigma_tr above which the profile does not tell it."""
COEFFICIENT_LIMIT = 0.3
"""Likewise of log sigma_a and log sigma_s', which is said apart."""
MISFIT_CHANCE = 1e-3
"""A chi2 that chance exceeds so rarely is a misfit."""
FAR_OFF = 0.7
"""Weighted root mean square of relative residuals above which a profile is of no such medium."""
ROUNDS, STEPS = 4, 60
NEIGHBOURS = 3
"""Fibres to either side whose residuals tell the noise of one, without a variance."""
LEAST_DEVIATION = 1e-3
"""Relative deviation of a reading at least, without a variance."""
INITIAL_DEVIATION = 0.05
"""Likewise, for the first of the fits without a variance."""
CLEAR = 0.2
"""Standard error of log sigma_tr up to which its interval is symmetric in the logarithm."""
SHARE = 0.6827
"""Of the interval."""
START_ERROR = 0.1
"""Relative error added for the comparison with starts."""
RISE = 50.0
"""A second valley of the misfit is tried when it begins no higher above the deepest."""
BATCH = 8192
"""Profiles fitted at a time, for the size of temporaries."""


class SubsurfaceError(ValueError):
    """Profiles, radii or settings that no fit can be made of."""


class Outcome(IntFlag):
    """What became of a fit; the first eight bits make it invalid, the others are remarks."""

    GOOD = 0
    TOO_FEW_FIBRES = 1
    NO_SIGNAL = 2
    NOT_CONVERGED = 4
    AT_BOUND = 8
    OUTSIDE_DOMAIN = 16
    NOT_IDENTIFIED = 32
    WRONG_PROFILE = 64
    MISFIT = 256
    COEFFICIENTS_NOT_IDENTIFIED = 512


_INVALID = 255
REASONS = {
    Outcome.TOO_FEW_FIBRES: f"fewer than {FEWEST_FIBRES} fibres to use",
    Outcome.NO_SIGNAL: f"fewer than {FEWEST_READINGS} fibres stand out of their noise",
    Outcome.NOT_CONVERGED: "the fit did not settle",
    Outcome.AT_BOUND: "a coefficient runs against its limit",
    Outcome.OUTSIDE_DOMAIN: "sigma_a / sigma_s' is beyond what the model is good for",
    Outcome.NOT_IDENTIFIED: "the profile does not tell sigma_tr",
    Outcome.WRONG_PROFILE: "no medium of this kind has such a profile, or its scale is wrong",
    Outcome.MISFIT: "residuals exceed their errors; the errors are enlarged",
    Outcome.COEFFICIENTS_NOT_IDENTIFIED: "sigma_a and sigma_s' are not told apart well",
}
LEFT_OUT = ("used", "masked", "not finite", "no variance", "not above zero")
"""Meaning of `SubsurfaceFit.left_out`."""


@dataclass(frozen=True, slots=True)
class SubsurfaceFit:
    """Coefficients of the media that profiles come from, leading axes as the profiles'.

    Attributes
    ----------
    sigma_a_per_mm, sigma_s_prime_per_mm, sigma_tr_per_mm : ndarray, shape (...)
        Absorption, reduced scattering, and sqrt(3 sigma_a (sigma_a + sigma_s')), 1/mm; NaN where
        the fibres do not suffice (`Outcome.TOO_FEW_FIBRES`, `Outcome.NO_SIGNAL`).
    covariance : ndarray, shape (..., 2, 2)
        Of (sigma_a, sigma_s'), 1/mm^2, nuisances included; infinite where nothing is told.
    valid : ndarray of bool, shape (...)
        sigma_tr can be used. False with a reason in `outcome`.
    sigma_tr_stderr : ndarray, shape (...)
        By propagation of `covariance`, 1/mm.
    interval_per_mm : ndarray, shape (..., 2)
        68 % interval of sigma_tr, 1/mm.
    chi2, p_value : ndarray, shape (...)
        Squared residuals over their variances, with the nuisances' priors; the chance of more.
        Without a variance chi2 equals `dof` but for its smoothing and says little.
    dof : ndarray of int, shape (...)
        Fibres used less two.
    inflation : ndarray, shape (...)
        Factor that enlarged all standard errors, for a misfit; 1 without.
    used : ndarray of bool, shape (..., F)
    left_out : ndarray of uint8, shape (..., F)
        Index into `LEFT_OUT`, 0 where used.
    outcome : ndarray of uint16, shape (...)
        Bits of `Outcome`.
    predicted_per_mm2 : ndarray, shape (..., F)
        The fitted profile with the common factor, 1/mm^2, at every fibre.
    residual : ndarray, shape (..., F)
        (reflectance - predicted) over its standard deviation, model error included; without a
        variance of logarithms; 0 where not used.
    scale : ndarray, shape (...)
        Common factor of the reading, 1 without ``common_error``.
    asymmetry : ndarray, shape (...)
        g as fitted, or as given.
    evaluations : ndarray of int, shape (...)
        Profiles computed for the fit.
    method : str
    """

    sigma_a_per_mm: Floats
    sigma_s_prime_per_mm: Floats
    sigma_tr_per_mm: Floats
    covariance: Floats
    valid: Bools
    sigma_tr_stderr: Floats
    interval_per_mm: Floats
    chi2: Floats
    dof: NDArray[np.int64]
    p_value: Floats
    inflation: Floats
    used: Bools
    left_out: NDArray[np.uint8]
    outcome: Codes
    predicted_per_mm2: Floats
    residual: Floats
    scale: Floats
    asymmetry: Floats
    evaluations: NDArray[np.int64]
    method: Method

    @property
    def sigma_a_stderr(self) -> Floats:
        """Standard error of sigma_a, 1/mm, shape (...)."""
        return np.asarray(np.sqrt(self.covariance[..., 0, 0]))

    @property
    def sigma_s_prime_stderr(self) -> Floats:
        """Standard error of sigma_s', 1/mm, shape (...)."""
        return np.asarray(np.sqrt(self.covariance[..., 1, 1]))

    @property
    def correlation(self) -> Floats:
        """Correlation of sigma_a and sigma_s', shape (...); NaN where nothing is told."""
        spread = self.sigma_a_stderr * self.sigma_s_prime_stderr
        known = np.isfinite(spread) & (spread > 0.0)
        ratio = np.full(spread.shape, np.nan)
        return np.divide(self.covariance[..., 0, 1], spread, out=ratio, where=known)

    @property
    def coefficients_identified(self) -> Bools:
        """Whether sigma_a and sigma_s' are told one by one; `valid` speaks of sigma_tr alone."""
        unclear = Outcome.COEFFICIENTS_NOT_IDENTIFIED | Outcome.TOO_FEW_FIBRES | Outcome.NO_SIGNAL
        return np.asarray((self.outcome & np.uint16(unclear)) == 0)

    def reason(self, index: int | tuple[int, ...] = ()) -> str:
        """Return what is to be said of one fit, empty for a good one.

        Parameters
        ----------
        index
            Of the leading axes; () for a single profile.
        """
        code = int(self.outcome[index])
        return "; ".join(text for bit, text in REASONS.items() if code & bit)


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
        are not finite are left out, negative ones are used.
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
        Relative deviation of each fibre for the model's sake; the method's own by default.
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
    >>> from model import dipole
    >>> r = np.linspace(0.3, 7.05, 28)
    >>> fit = invert(r, dipole.reflectance(r, 0.04, 1.5, 1.4), method="dipole")
    >>> float(fit.sigma_a_per_mm.round(6)), float(fit.sigma_s_prime_per_mm.round(6))
    (0.04, 1.5)
    """
    _check_settings(
        method, collection, eta, core_mm=core_mm, source_core_mm=source_core_mm,
        common_error=common_error, g=g, g_error=g_error, model_error=model_error or 0.0,
    )  # fmt: skip
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
    prior = np.zeros((kernels.PARAMETERS, 2))
    prior[:2, 1] = math.inf
    prior[2, 1] = common_error
    prior[3] = g, g_error if method == "photon_table" else 0.0
    work = _Work.of(y, spread, left_out == 0, prior)
    rows = radius.reshape(-1, fibres) if radius.ndim > 1 else radius[None]
    distinct, which = np.unique(rows, axis=0, return_inverse=True)
    which = np.broadcast_to(which.reshape(-1), y.shape[:1])
    domain, bounds = np.zeros(y.shape[0], np.bool_), np.zeros((kernels.PARAMETERS, 2))
    for number, own in enumerate(distinct):
        model = profile_model(
            method, np.ascontiguousarray(own), eta=float(eta), collection=collection,
            core_mm=float(core_mm), source_core_mm=float(source_core_mm), g=float(g),
            g_error=float(g_error),
        )  # fmt: skip
        if model_error is not None:
            model = replace(model, error=np.array([float(model_error), 0.0, 0.0]))
        bounds = model.bounds
        members = np.flatnonzero(which == number)
        for begin in range(0, members.size, BATCH):
            chosen = members[begin : begin + BATCH]
            work.fit(model, chosen)
            domain[chosen] = model.holds(work.theta[chosen])
    return _judged(work, bounds, domain, left_out, shape, method)


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
    >>> from model import dipole
    >>> r = np.linspace(0.3, 7.05, 28)
    >>> fit = fit_dipole(r, dipole.reflectance(r, 0.25, 2.0, 1.4))
    >>> bool(abs(fit.sigma_tr_per_mm / dipole.effective_transport(0.25, 2.0) - 1.0) < 1e-6)
    True
    """
    return invert(
        radius_mm, reflectance_per_mm2, eta=eta, variance=variance, method="dipole", **settings
    )


@dataclass(slots=True)
class _Work:
    """Profiles as the kernel takes them, and what it makes of them."""

    y: Floats
    """Reflectance, or its logarithm; 0 where not used."""
    variance: Floats
    """Of `y`, infinite where not used."""
    used: Bools
    logarithmic: bool
    prior: Floats
    seen: Bools
    """Readings that stand out of their noise."""
    theta: Floats
    covariance: Floats
    chi2: Floats
    predicted: Floats
    total: Floats
    """Variance of `y` with the model's error."""
    steps: NDArray[np.int64]

    @classmethod
    def of(cls, y: Floats, variance: Floats | None, used: Bools, prior: Floats) -> _Work:
        """Lay out profiles (N, F)."""
        n, fibres = y.shape
        clean = np.where(used, y, 0.0)
        if variance is None:
            spread = np.where(used, INITIAL_DEVIATION**2, math.inf)
            seen = used
            clean = np.log(np.where(used, y, 1.0))
        else:
            spread = np.where(used, variance, math.inf)
            seen = used & (clean > SIGNAL * np.sqrt(spread))
        return cls(
            clean, spread, used, variance is None, prior, seen, np.zeros((n, 4)),
            np.zeros((n, 4, 4)), np.zeros(n), np.zeros((n, fibres)), np.zeros((n, fibres)),
            np.zeros(n, np.int64),
        )  # fmt: skip

    def fit(self, model: ProfileModel, chosen: NDArray[np.intp]) -> None:
        """Fit some of the profiles from the best of the starts on."""
        y, variance, seen = self.y[chosen], self.variance[chosen], self.seen[chosen]
        if self.logarithmic:
            logs, weight = y, seen.astype(np.float64)
        else:
            safe = np.where(seen, y, 1.0)
            logs = np.log(safe)
            weight = np.zeros(y.shape)
            np.divide(1.0, variance / safe**2 + START_ERROR**2, out=weight, where=seen)
        g = float(self.prior[3, 0])
        best, second, rise = model.starts(logs, weight, g)
        self._run(model, chosen, y, variance, best)
        doubt = np.flatnonzero(np.isfinite(rise) & ((rise < RISE) | self._misfits(chosen)))
        if doubt.size:
            self._run(model, chosen[doubt], y[doubt], variance[doubt], second[doubt], better=True)
        for _ in range(2 if self.logarithmic else 0):
            off = np.where(seen, y - np.log(np.maximum(self.predicted[chosen], 1e-290)), 0.0)
            variance = _local_variance(model.radius_mm, off, seen)
            self._run(model, chosen, y, variance, self.theta[chosen])

    def _misfits(self, chosen: NDArray[np.intp]) -> Bools:
        """Return which fits are so bad that another minimum may be better."""
        seen = self.seen[chosen].sum(axis=1)
        dof = np.maximum(seen - 2, 1)
        return (seen >= FEWEST_READINGS) & (
            (self.chi2[chosen] > dof + 4.0 * np.sqrt(2.0 * dof)) | (self.steps[chosen] < 0)
        )

    def _run(
        self,
        model: ProfileModel,
        chosen: NDArray[np.intp],
        y: Floats,
        variance: Floats,
        theta: Floats,
        *,
        better: bool = False,
    ) -> None:
        """Fit from `theta` on and keep the results; with `better` only the likelier ones."""
        n = y.shape[0]
        covariance, chi2 = np.empty((n, 4, 4)), np.empty(n)
        predicted, total, steps = np.empty(y.shape), np.empty(y.shape), np.empty(n, np.int64)
        parts = min(get_num_threads(), max(1, n // 64))
        kernels.fit(
            model.kind, model.radius_mm, model.constants, model.axes, model.grid, y, variance,
            model.error, self.logarithmic, self.prior, model.bounds, theta, ROUNDS, STEPS, parts,
            covariance, chi2, predicted, total, steps,
        )  # fmt: skip
        if better:
            won = chi2 + _log_volume(total) < self.chi2[chosen] + _log_volume(self.total[chosen])
            chosen, theta, covariance, chi2 = chosen[won], theta[won], covariance[won], chi2[won]
            predicted, total, steps = predicted[won], total[won], steps[won]
        self.theta[chosen], self.covariance[chosen], self.chi2[chosen] = theta, covariance, chi2
        self.predicted[chosen], self.total[chosen], self.steps[chosen] = predicted, total, steps


def _log_volume(total: Floats) -> Floats:
    """Return the sum of the logarithms of the variances of what is used."""
    return np.asarray(np.log(np.where(np.isfinite(total), total, 1.0) + 1e-300).sum(axis=1))


def _local_variance(radius_mm: Floats, residual: Floats, seen: Bools) -> Floats:
    """Return each fibre's variance from the squared residuals around it, infinite where unseen."""
    order = np.argsort(radius_mm, kind="stable")
    width = 2 * NEIGHBOURS + 1
    squares = uniform_filter1d(residual[:, order] ** 2, width, axis=1, mode="constant")
    count = uniform_filter1d(seen[:, order].astype(np.float64), width, axis=1, mode="constant")
    out = np.full(residual.shape, math.inf)
    total = seen.sum(axis=1, keepdims=True)
    spared = total / np.maximum(total - 2, 1)  # residuals of a fit are smaller than errors
    mean = squares / np.maximum(count, 0.5 / width) * spared
    out[:, order] = np.where(seen[:, order], np.maximum(mean, LEAST_DEVIATION**2), math.inf)
    return out


def _judged(
    work: _Work,
    bounds: Floats,
    inside: Bools,
    left_out: NDArray[np.uint8],
    shape: tuple[int, ...],
    method: Method,
) -> SubsurfaceFit:
    """Return estimates with errors, and say which can be used."""
    a, s = np.exp(work.theta[:, 0]), np.exp(work.theta[:, 1])
    sigma_tr = np.sqrt(3.0 * a * (a + s))
    fibres = work.used.sum(axis=1)
    dof = np.maximum(fibres - 2, 0)
    p_value = np.where(dof > 0, gammaincc(np.maximum(dof, 1) / 2.0, work.chi2 / 2.0), 1.0)
    reduced = work.chi2 / np.maximum(dof, 1)
    large = (reduced > 1.0) & ((p_value < MISFIT_CHANCE) | work.logarithmic)
    inflation = np.where(large, np.sqrt(reduced), 1.0)
    logs = work.covariance[:, :2, :2] * (inflation**2)[:, None, None]
    slope = 0.5 * np.stack([1.0 + a / (a + s), s / (a + s)], axis=1)  # of log sigma_tr
    told = np.isfinite(logs).all(axis=(1, 2))
    safe = np.where(told[:, None, None], logs, 0.0)
    log_variance = np.einsum("ni,nij,nj->n", slope, safe, slope)
    log_stderr = np.where(told, np.sqrt(np.maximum(log_variance, 0.0)), math.inf)
    scales = np.stack([a, s], axis=1)
    covariance = safe * scales[:, :, None] * scales[:, None, :]
    covariance[~told] = math.inf
    apart = np.where(told, np.sqrt(np.maximum(safe[:, 0, 0], safe[:, 1, 1])), math.inf)

    seen = work.seen.sum(axis=1)
    with np.errstate(divide="ignore"):
        off = (
            work.y - np.log(work.predicted)
            if work.logarithmic
            else (
                np.log(np.where(work.seen, work.y, 1.0))
                - np.log(np.maximum(work.predicted, 1e-290))
            )
        )
    far = np.sqrt(np.where(work.seen, off**2, 0.0).sum(axis=1) / np.maximum(seen, 1))
    at_bound = (
        (work.theta[:, :2] <= bounds[:2, 0] + 1e-6) | (work.theta[:, :2] >= bounds[:2, 1] - 1e-6)
    ).any(axis=1)
    outcome = np.zeros(a.shape, np.uint16)
    for bit, where in (
        (Outcome.TOO_FEW_FIBRES, fibres < FEWEST_FIBRES),
        (Outcome.NO_SIGNAL, (fibres >= FEWEST_FIBRES) & (seen < FEWEST_READINGS)),
        (Outcome.NOT_CONVERGED, work.steps < 0),
        (Outcome.AT_BOUND, at_bound),
        (Outcome.OUTSIDE_DOMAIN, ~inside),
        (Outcome.NOT_IDENTIFIED, log_stderr > LOG_LIMIT),
        (Outcome.WRONG_PROFILE, far > FAR_OFF),
        (Outcome.MISFIT, (p_value < MISFIT_CHANCE) & ~np.bool_(work.logarithmic)),
        (Outcome.COEFFICIENTS_NOT_IDENTIFIED, apart > COEFFICIENT_LIMIT),
    ):
        outcome[where] |= np.uint16(bit)
    nothing = (outcome & np.uint16(Outcome.TOO_FEW_FIBRES | Outcome.NO_SIGNAL)) != 0
    outcome[nothing] &= np.uint16(Outcome.TOO_FEW_FIBRES | Outcome.NO_SIGNAL)
    for estimate in (a, s, sigma_tr, p_value):
        estimate[nothing] = math.nan
    covariance[nothing] = math.inf
    log_stderr[nothing] = math.inf
    reach = np.full(a.shape, 1.0)
    if work.logarithmic:  # the noise itself is known from few residuals
        reach = stdtrit(np.maximum(dof, 1), 0.5 + 0.5 * SHARE)
    low, high = _interval(sigma_tr, log_stderr * reach)
    residual = np.zeros(work.y.shape)
    model_value = np.log(np.maximum(work.predicted, 1e-290)) if work.logarithmic else work.predicted
    np.divide(work.y - model_value, np.sqrt(work.total), out=residual, where=work.used)
    predicted = np.where(nothing[:, None], math.nan, work.predicted)
    return SubsurfaceFit(
        sigma_a_per_mm=a.reshape(shape),
        sigma_s_prime_per_mm=s.reshape(shape),
        sigma_tr_per_mm=sigma_tr.reshape(shape),
        covariance=covariance.reshape((*shape, 2, 2)),
        valid=((outcome & np.uint16(_INVALID)) == 0).reshape(shape),
        sigma_tr_stderr=_product(sigma_tr, log_stderr).reshape(shape),
        interval_per_mm=np.stack([low, high], axis=-1).reshape((*shape, 2)),
        chi2=work.chi2.reshape(shape),
        dof=dof.reshape(shape),
        p_value=p_value.reshape(shape),
        inflation=inflation.reshape(shape),
        used=work.used.reshape((*shape, -1)),
        left_out=left_out.reshape((*shape, -1)),
        outcome=outcome.reshape(shape),
        predicted_per_mm2=predicted.reshape((*shape, -1)),
        residual=residual.reshape((*shape, -1)),
        scale=np.exp(work.theta[:, 2]).reshape(shape),
        asymmetry=work.theta[:, 3].reshape(shape),
        evaluations=np.abs(work.steps).reshape(shape),
        method=method,
    )


def _interval(sigma_tr: Floats, log_stderr: Floats) -> tuple[Floats, Floats]:
    """Return the ends of the 68 % interval of sigma_tr.

    Symmetric in the logarithm while that is well told; then in sigma_tr^2, which a profile is
    linear in where the absorption is next to none.
    """
    clear = log_stderr < CLEAR
    spread = np.where(clear, log_stderr, 0.0)
    low, high = sigma_tr * np.exp(-spread), sigma_tr * np.exp(spread)
    wide = np.where(np.isfinite(log_stderr), 2.0 * log_stderr, 0.0)
    low = np.where(clear, low, sigma_tr * np.sqrt(np.maximum(1.0 - wide, 0.0)))
    high = np.where(clear, high, sigma_tr * np.sqrt(1.0 + wide))
    nothing = ~np.isfinite(log_stderr)
    return np.where(nothing, 0.0, low), np.where(nothing, math.inf, high)


def _product(value: Floats, log_stderr: Floats) -> Floats:
    known = np.isfinite(value) & np.isfinite(log_stderr)
    return np.where(known, np.where(known, value, 0.0) * np.where(known, log_stderr, 0.0), math.inf)


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
