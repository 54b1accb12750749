"""Define forward models of radial profiles, and the starts of their fits.

"photon_table" is `model.photon_table`, laid out for given fibers as logarithms on a grid;
"diffusion" is Kienle and Patterson's, "dipole" Jensen's, both as closed forms. Neither of the two
models a fiber's cone or core: they take R(r) of all directions at the fiber's middle instead.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
from threadpoolctl import ThreadpoolController

from model import fresnel
from model.dipole import kienle_patterson as diffusion
from model.photon_table import stored_asymmetries
from model.photon_table import table as photon_table
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.subsurface import kernels

Method = Literal["photon_table", "diffusion", "dipole"]
FIT_METHODS: tuple[Method, ...] = ("photon_table", "diffusion", "dipole")
Collection = Literal["all", "fiber"]
G_SKIN, G_SKIN_SIGMA = 0.825, 0.072
"""Asymmetry of soft tissue: mean and standard deviation of 0.7...0.95, all equally likely."""

SIGMA_A_RANGE = (1e-6, 100.0)
SIGMA_S_RANGE = (1e-3, 1e3)
SCALE_RANGE = (1e-3, 1e3)
"""Ranges of the closed forms, 1/mm and 1: beyond them no reading of a probe changes."""
MAX_DIFFUSION_RATIO = 0.3
"""sigma_a/sigma_s' up to which diffusion is within some 25 % of transport next to a fiber."""
DIFFUSION_ERROR = np.array([0.03, 0.4, 0.8])
"""Relative: in the middle of a profile of weak absorption, at the source, by sigma_a/sigma_s'.
From the photon table in fibers of 0.2 mm at 0.3 to 7 mm, sigma_tr 0.3 to 3, sigma_s' 0.5 to 5 per
mm and g 0.7 to 0.95; to a factor of two."""
DIFFUSION_BIAS, DIPOLE_BIAS = (0.02, 0.25), (0.1, 0.15)
"""Relative error of sigma_tr on such profiles, and what is added to it by sigma_a/sigma_s'; rounded
from -1 to -14 % and -5 to -22 %."""
DIPOLE_ERROR = np.array([0.1, 0.0, 0.0])
"""Equal weights; the dipole is off by more than that."""
MAX_START_RATIO = 15.0
"""Greatest sigma_a/sigma_s' that a fit begins with."""
TABLE_SIGMA_S_RANGE = (0.05, 200.0)
"""Range of the table, 1/mm; layered tissue may seem to scatter more than any medium does."""
TABLE_ERROR = np.array([0.005, 0.0, 0.0])
"""Relative: the table's own noise."""
MIN_DIFFUSE_DISTANCE = 30.0
"""Distance in 1/sigma_s' from which weakly absorbed light is diffuse: the table over Kienle and
Patterson's diffusion changes by no more than its own noise beyond. Its last nodes, at 45 to 50, are
off by up to 3 % under vanishing absorption, and the table ends there."""
DIFFUSE_RATIO_RANGE = (0.003, 0.01)
"""sigma_a/sigma_s' up to which diffusion continues the table, and from which it does not."""
START_SIGMA_TR = np.geomspace(0.01, 15.0, 40)
START_SIGMA_S = np.geomspace(0.06, 190.0, 19)
"""Grid of pairs that each profile is compared with to find its starts, 1/mm."""
PROFILES_PER_BLOCK = 1024
"""Profiles per block; their misfits stay in the cache."""
MIN_LOG_REFLECTANCE = -100.0
"""Logarithm of reflectance at which starts clip it."""


class FiberOptics(NamedTuple):
    """Optics between source, medium and detecting fiber."""

    eta: float = fresnel.ETA_SKIN
    """Refractive index of the medium over that outside, at least 1."""
    collection: Collection = "all"
    core_mm: float = 0.0
    source_core_mm: float = 0.0
    """The last three as of `model.photon_table.reflectance`; closed forms ignore them."""
    g: float = G_SKIN
    g_error: float = G_SKIN_SIGMA
    """The asymmetry's prior; closed forms ignore it."""


@dataclass(frozen=True, slots=True)
class ProfileModel:
    """One forward model at fixed radii.

    Attributes
    ----------
    curves : ForwardModel
        Arrays for the kernels.
    bounds : ndarray, shape (4, 2)
        Of log sigma_a, log sigma_s', log of the common factor, g.
    error : ndarray, shape (3,)
        Relative model error, see `levenberg_marquardt.FitProblem`.
    bias : tuple of float
        Relative systematic error of sigma_tr, and its growth with sigma_a/sigma_s'.
    max_ratio : float
        Largest sigma_a/sigma_s' in the model's domain.
    """

    curves: kernels.ForwardModel
    bounds: Float64Array
    error: Float64Array
    bias: tuple[float, float]
    max_ratio: float

    @property
    def radius_mm(self) -> Float64Array:
        """Distances of the fibers from the source, (F,)."""
        return self.curves.radius_mm

    def profiles(self, theta: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return profiles (N, F), 1/mm^2, of parameters (N, 4), and derivatives (N, 4, F)."""
        out = np.empty((theta.shape[0], self.radius_mm.size))
        slopes = np.zeros((theta.shape[0], kernels.N_PARAMETERS, self.radius_mm.size))
        kernels.evaluate(self.curves, np.ascontiguousarray(theta), out, slopes)
        return out, slopes

    def contains(self, theta: Float64Array) -> BoolArray:
        """Return whether parameters (N, 4) are in the model's domain."""
        return np.asarray(theta[:, 0] - theta[:, 1] <= np.log(self.max_ratio))

    def at_bound(self, theta: Float64Array) -> BoolArray:
        """Return whether sigma_a or sigma_s' of parameters (N, 4) is at its limit."""
        low, high = self.bounds[:2].T
        pair = theta[:, :2]
        return np.asarray(((pair <= low + 1e-6) | (pair >= high - 1e-6)).any(axis=1))

    def relative_variance(self, theta: Float64Array) -> Float64Array:
        """Return the model's own squared relative error at every fiber, (N, F)."""
        a, s = np.exp(theta[:, :1]), np.exp(theta[:, 1:2])
        everywhere, near, by_ratio = self.error
        source = near * np.exp(-self.radius_mm * (a + s))
        return np.asarray(everywhere**2 + source**2 + (by_ratio * a / s) ** 2)

    def systematic(self, theta: Float64Array) -> Float64Array:
        """Return the model's systematic error of log sigma_tr, (N,)."""
        ratio = np.minimum(np.exp(theta[:, 0] - theta[:, 1]), 1.0)
        return np.asarray(self.bias[0] + self.bias[1] * ratio)

    def starts(
        self,
        log_reflectance: Float64Array,
        weight: Float64Array,
        g: float,
        common_error: float = 0.0,
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Find starts of fits: the valleys of the misfit of logarithms along sigma_s'.

        For each sigma_s' of a grid the best sigma_tr is found, refined between its grid's nodes by
        the parabola through three of them.

        Parameters
        ----------
        log_reflectance, weight : ndarray, shape (N, F)
            Weight 0 omits a logarithm.
        g : float
            Asymmetry to begin with.
        common_error : float
            Standard deviation of the log of a common factor, which takes its best value for each
            pair of the grid; 0: the factor is 1.

        Returns
        -------
        best, second : ndarray, shape (N, 4)
            Parameters in the deepest valley and in the next.
        rise : ndarray, shape (N,)
            Excess of the second's sum of weighted squares; infinite without a second.
        """
        log_k, log_s = np.log(START_SIGMA_TR), np.log(START_SIGMA_S)
        theta = np.zeros((log_s.size, log_k.size, kernels.N_PARAMETERS))
        theta[..., 0] = _log_absorption(log_k, log_s[:, None])
        theta[..., 1], theta[..., 3] = log_s[:, None], g
        outside = (theta[..., 0] - theta[..., 1] > np.log(MAX_START_RATIO)) | np.any(
            (theta < self.bounds[:, 0]) | (theta > self.bounds[:, 1]), axis=2
        )
        profiles = self.profiles(theta.reshape(-1, kernels.N_PARAMETERS))[0]
        curves = np.log(np.maximum(profiles, np.exp(MIN_LOG_REFLECTANCE)))
        # sum w (y - c)^2 = const + (w y)(-2 c) + w c^2: one matrix product for all pairs; without
        # the median, single precision suffices
        middle = np.median(curves, axis=0)
        curves = (curves - middle).astype(np.float32)
        grid = np.concatenate([-2.0 * curves, curves**2], axis=1).T
        nowhere = np.where(outside.ravel(), np.float32(np.inf), np.float32(0.0))
        place, depth = np.empty((2, 2, len(weight)))
        valley = np.empty((2, len(weight)), np.int64)
        for begin in range(0, len(weight), PROFILES_PER_BLOCK):
            part = slice(begin, begin + PROFILES_PER_BLOCK)
            given = weight[part].astype(np.float32)
            off = (log_reflectance[part] - middle).astype(np.float32)
            with blas_threads().limit(limits=1):  # threads would wait for one another
                score = np.concatenate([given * off, given], axis=1) @ grid
                # a common factor, prior 1 / e^2, lowers it by (sum w r)^2 / (sum w + 1 / e^2)
                if common_error > 0.0:
                    left = (given * off).sum(axis=1, keepdims=True) - given @ curves.T
                    firm = given.sum(axis=1, keepdims=True) + np.float32(common_error**-2)
                    np.divide(left**2, firm, out=left, where=firm > 0.0)
                    score -= left
            score += nowhere
            score = score.reshape(-1, log_s.size, log_k.size)
            kernels.find_valleys(score, valley[:, part], place[:, part], depth[:, part])
        ends = []
        for which, at in zip(valley, place, strict=True):
            start = np.zeros((which.size, kernels.N_PARAMETERS))
            refined = log_k[0] + at * (log_k[1] - log_k[0])
            start[:, 0] = _log_absorption(refined, log_s[which])
            start[:, 1], start[:, 3] = log_s[which], g
            if common_error > 0.0:
                shown = np.log(np.maximum(self.profiles(start)[0], np.exp(MIN_LOG_REFLECTANCE)))
                off = (weight * (log_reflectance - shown)).sum(axis=1)
                start[:, 2] = off / (weight.sum(axis=1) + common_error**-2)
            ends.append(np.clip(start, self.bounds[:, 0], self.bounds[:, 1]))
        rise = np.full(depth.shape[1], np.inf)
        np.subtract(depth[1], depth[0], out=rise, where=np.isfinite(depth[1]))
        return ends[0], ends[1], rise


@lru_cache(maxsize=1)
def blas_threads() -> ThreadpoolController:
    """Return the controller of the threads of matrix products."""
    return ThreadpoolController().select(user_api="blas")


def _log_absorption(log_sigma_tr: Float64Array, log_sigma_s: Float64Array) -> Float64Array:
    """Return log sigma_a of sigma_tr and sigma_s', without cancellation."""
    # the root of 3 a (a + s) = k^2: a / s = x / (1 + sqrt(1 + 2 x)) with x = 2 k^2 / (3 s^2)
    x = 2.0 / 3.0 * np.exp(2.0 * (log_sigma_tr - log_sigma_s))
    return np.asarray(log_sigma_s + np.log(x) - np.log1p(np.sqrt(1.0 + 2.0 * x)))


def profile_model(method: Method, optics: FiberOptics, radius_mm: Float64Array) -> ProfileModel:
    """Return a method's model at some radii (F,)."""
    if method == "photon_table":
        return _tabled(radius_mm.tobytes(), optics)
    constants, error, bias = _CLOSED_FORM_MODELS[method](optics.eta)
    return ProfileModel(
        curves=kernels.ForwardModel(
            0, radius_mm, constants, np.ones((3, 2)), np.zeros((1, 1, 1, 1))
        ),
        bounds=_bounds(SIGMA_S_RANGE, (0.0, 1.0)),
        error=error,
        bias=bias,
        max_ratio=MAX_DIFFUSION_RATIO,
    )


def _bounds(sigma_s: tuple[float, float], g: tuple[float, float]) -> Float64Array:
    return np.vstack([np.log(np.array([SIGMA_A_RANGE, sigma_s, SCALE_RANGE])), g])


@lru_cache(maxsize=16)
def _tabled(radius: bytes, optics: FiberOptics) -> ProfileModel:
    """Lay the photon table out as log R + sigma_tr r over (sigma_s', root, g)."""
    radius_mm = np.frombuffer(radius, np.float64).copy()  # not read-only: one kernel for all
    held = stored_asymmetries()
    low = max(optics.g - 3.0 * optics.g_error, held[0])
    high = min(optics.g + 3.0 * optics.g_error, held[-1])
    count = 4 if high - low > 1e-6 else 1
    # a single asymmetry is used for layered tissue, which resembles media of strong scattering:
    # between nodes log R curves with sigma_tr r, which grows with scattering
    fine = 0.075 if count > 1 else 0.0375
    steps = np.array([0.1, fine, (high - low) / 3.0 if count > 1 else 1.0])
    first, last = np.log(TABLE_SIGMA_S_RANGE)
    logs = np.arange(first, last + steps[0], steps[0])
    most = np.log1p(10.0 * np.sqrt(photon_table.MAX_ABSORPTION_RATIO))
    roots = np.arange(0.0, most + steps[1], steps[1])
    s = np.exp(logs)[:, None]
    a = s * (0.1 * np.expm1(roots)) ** 2
    grid = np.empty((*a.shape, count, radius_mm.size))
    decay = np.sqrt(3.0 * a * (a + s))[..., None] * radius_mm  # the remainder is smooth
    a, s = a[..., None], s[..., None]

    of_tissue: dict[str, Any] = {"eta": optics.eta, "collection": optics.collection}

    def log_table(r: Float64Array, g: float, cores_mm: tuple[float, float]) -> Float64Array:
        cores: dict[str, Any] = {"core_mm": cores_mm[0], "source_core_mm": cores_mm[1]}
        profile = photon_table.reflectance(r, a, s, g=g, **of_tissue, **cores)
        return np.asarray(np.log(np.maximum(profile, 1e-290)))

    points, cores_mm = (0.0, 0.0), (optics.core_mm, optics.source_core_mm)
    for n, g in enumerate(np.linspace(low, high, count).tolist()):
        # without cores, as strongly scattered light turns diffuse within a core's width
        end = log_table(MIN_DIFFUSE_DISTANCE / s, g, points)
        r = np.where(radius_mm > 0.0, radius_mm, radius_mm.max(initial=1.0))
        beyond = _diffused(log_table(r, g, points), r, a, s, end, optics.eta)
        grid[:, :, n] = log_table(radius_mm, g, cores_mm) + beyond + decay
    axes = np.stack([np.array([logs[0], roots[0], low]), steps], axis=1)
    return ProfileModel(
        curves=kernels.ForwardModel(kernels.TABLE_MODEL, radius_mm, np.zeros(4), axes, grid),
        bounds=_bounds(TABLE_SIGMA_S_RANGE, (low, high)),
        error=TABLE_ERROR,
        bias=(0.0, 0.0),
        max_ratio=photon_table.MAX_ABSORPTION_RATIO,
    )


def _diffused(
    log_profile: Float64Array,
    radius_mm: Float64Array,
    a: Float64Array,
    s: Float64Array,
    log_end: Float64Array,
    eta: float,
) -> Float64Array:
    """Return what diffusion beyond a table's far end adds to its logarithms, (S, U, F).

    Parameters
    ----------
    log_profile, log_end
        The table's at the radii, and (S, U, 1) at the distance from which light is diffuse.
    radius_mm, a, s
        Broadcast to the table.
    """
    near, far = DIFFUSE_RATIO_RANGE
    distance = MIN_DIFFUSE_DISTANCE / s
    share = np.clip((far - a / s) / (far - near), 0.0, 1.0)
    share = share * (radius_mm * s > MIN_DIFFUSE_DISTANCE)
    weak = np.minimum(a, far * s)  # stronger absorption has weight 0
    there, end = (diffusion.reflectance(r, weak, s, eta) for r in (radius_mm, distance))
    continued = log_end + np.log(np.maximum(there, 1e-290)) - np.log(np.maximum(end, 1e-290))
    return np.asarray(share * (continued - log_profile))


def _dipole(eta: float) -> tuple[Float64Array, Float64Array, tuple[float, float]]:
    """Return constants of Jensen's dipole; its error, equal for all fibers."""
    stretch = 1.0 + 4.0 / 3.0 * fresnel.boundary_factor(eta)
    return np.array([stretch, 0.0, 1.0, 1.0]), DIPOLE_ERROR, DIPOLE_BIAS


def _diffusion(eta: float) -> tuple[Float64Array, Float64Array, tuple[float, float]]:
    """Return constants of Kienle and Patterson's diffusion; its error grows at the source."""
    stretch, (c_phi, c_j) = diffusion.image_depth(eta), diffusion.exit_coefficients(eta)
    return np.array([stretch, c_phi, c_j, 1.0]), DIFFUSION_ERROR, DIFFUSION_BIAS


_CLOSED_FORM_MODELS = {"dipole": _dipole, "diffusion": _diffusion}
