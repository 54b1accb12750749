"""Estimate melanin, blood and oxygenation from camera colors and signals under narrow-band LEDs.

Each pixel is fitted by Gauss-Newton steps in the logarithm of its signals. Melanin, blood,
oxygenation and shading are estimated under their priors; thickness, scattering, baseline and kind
of melanin are nuisance parameters, whose priors' effect is in the signals' covariance, with what
the model leaves unexplained of measured spectra (`model.tissue_optics.band_signals`).
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage, stats

from model.checks import Checks
from model.tissue_optics import SKIN_CONSTANTS
from model.tissue_optics.band_signals import NUISANCE_SD, BandSignals
from model.tissue_optics.skin_spectra import typical_skin
from reconstruction.arrays import BoolArray, Float64Array
from reconstruction.chromophores.pixel_checks import ChromophoreError
from reconstruction.chromophores.table_fit.fitting import (
    POPULATION_BLOOD,
    POPULATION_LOG_SD,
    POPULATION_MELANIN,
)

OXYGENATION_SD: Final = float(NUISANCE_SD[0])
"""Standard deviation of oxygenation over people, of its published range."""
MAX_STDERR_FRACTION: Final = 0.5**0.5
"""Standard error over that of the prior up to which an estimate is valid: the signals then have at
least the information of the prior."""
MISFIT_PROBABILITY: Final = 1e-3
"""Probability with which a pixel of modeled skin is discarded as another material."""
N_STEPS: Final = 16
STEP_TOL: Final = 1e-3
"""Step below which a pixel is done, a hundredth of its smallest standard error."""
MAX_LOG_STEP: Final = 0.7
_START_OPTICAL_DEPTHS: Final = (0.08, 0.5)  # a dark and a light skin can have one color
_NODES: Final = (25, 17, 6)
_RANGES: Final = ((np.log(0.005), np.log(2.0)), (np.log(0.0005), np.log(0.2)), (0.0, 1.0))
_CHUNK: Final = 65_536


@dataclass(frozen=True, slots=True, eq=False)
class BandFit:
    """Estimates of pixels, (n,) each."""

    melanin_optical_depth: Float64Array
    """Optical depth of melanin at 550 nm."""
    blood: Float64Array
    """Volume fraction of blood in the dermis."""
    oxygenation: Float64Array
    """Fraction of oxygenated hemoglobin, 0 to 1."""
    stderr: Float64Array
    """(n, 3): posterior standard deviations of log melanin, log blood and oxygenation."""
    noise_stderr: Float64Array
    """(n, 3): the part of it by noise, by which repeats differ."""
    misfit: Float64Array
    """Squared distance from the model over its covariance, chi-squared for skin of the model."""
    valid: BoolArray
    """Whether the signals fit the model and determine the oxygenation (`MAX_STDERR_FRACTION`)."""


@dataclass(frozen=True)
class SignalTable:
    """Log signals over melanin, blood and oxygenation, and their covariance by other optics."""

    signals: BandSignals

    @cached_property
    def skin(self) -> Float64Array:
        """Skin at the nodes, (nodes, nodes, nodes, 8)."""
        axes = [np.linspace(*ends, count) for ends, count in zip(_RANGES, _NODES, strict=True)]
        melanin, blood, oxygenation = np.meshgrid(*axes, indexing="ij")
        skin = typical_skin(np.exp(melanin), np.exp(blood))
        skin[..., 2] = oxygenation
        return skin

    @cached_property
    def values(self) -> Float64Array:
        """Log signals at the nodes, (signals, nodes, nodes, nodes)."""
        return np.ascontiguousarray(np.moveaxis(self.signals.log_signals(self.skin), -1, 0))

    @cached_property
    def splines(self) -> Float64Array:
        """Cubic spline coefficients of `values`."""
        return np.stack([ndimage.spline_filter(part, mode="mirror") for part in self.values])

    @cached_property
    def slopes(self) -> Float64Array:
        """Derivatives of `values` by the estimated properties, (signals, 3, nodes...)."""
        steps = [(b - a) / (count - 1) for (a, b), count in zip(_RANGES, _NODES, strict=True)]
        parts = [np.stack(np.gradient(part, *steps, edge_order=2)) for part in self.values]
        return np.stack(parts)

    @cached_property
    def covariance(self) -> Float64Array:
        """Covariance by other optics at typical oxygenation, (nodes, nodes, signals, signals)."""
        skin = self.skin[:, :, 0].copy()
        skin[..., 2] = SKIN_CONSTANTS.oxygenation
        moved = self.signals.jacobian(skin)[..., 3:] * NUISANCE_SD[1:]
        unknown = moved @ np.swapaxes(moved, -1, -2)
        return np.asarray(unknown + self.signals.residual_covariance(skin))

    def lookup(self, at: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return log signals (n, signals) and derivatives (n, signals, 3) at points (n, 3)."""
        place = _positions(at)
        values = [
            ndimage.map_coordinates(part, place, prefilter=False, mode="mirror")
            for part in self.splines
        ]
        slopes = [
            [ndimage.map_coordinates(part, place, order=1, mode="nearest") for part in parts]
            for parts in self.slopes
        ]
        return np.stack(values, axis=-1), np.moveaxis(np.array(slopes), -1, 0)

    def covariance_at(self, at: Float64Array) -> Float64Array:
        """Return the covariance at points (n, 3), (n, signals, signals)."""
        i, j, _ = np.rint(_positions(at)).astype(np.intp)
        return np.asarray(self.covariance[i, j])


@lru_cache(maxsize=4)
def signal_table(camera: str, illuminant: str, leds: tuple[str, ...]) -> SignalTable:
    """Return the table of a camera, its light and LEDs; it takes some seconds, once.

    Examples
    --------
    >>> signal_table("Nikon 5100 (NPL)", "D55", ("LED-580-20",)).values.shape
    (4, 25, 17, 6)
    """
    return SignalTable(BandSignals(camera, illuminant, leds))


def fit_bands(
    signals: ArrayLike, variance: ArrayLike, table: SignalTable, *, log_shading: tuple[float, float]
) -> BandFit:
    """Estimate melanin, blood and oxygenation of pixels.

    Parameters
    ----------
    signals
        (n, 3 + leds): reflectance times shading in the camera's channels and under each LED; a
        perfect white facing the light is 1. Above 0.
    variance
        (n, 3 + leds): noise variance of them.
    table
        Table of the camera, its light and the LEDs, see `signal_table`.
    log_shading
        Mean and standard deviation of log shading; all lights share the shading.

    Returns
    -------
    BandFit
        Posterior modes with linearized standard deviations.

    Raises
    ------
    ChromophoreError
        For signals of another number of LEDs, or not above 0.

    Examples
    --------
    >>> table = signal_table("Nikon 5100 (NPL)", "D55", ("LED-450-20", "LED-580-20", "LED-600-20"))
    >>> skin = typical_skin(0.15, 0.012)
    >>> light = np.exp(table.signals.log_signals(skin))[None]
    >>> found = fit_bands(light, (0.002 * light) ** 2, table, log_shading=(0.0, 0.3))
    >>> bool(abs(found.oxygenation[0] - 0.75) < 0.02), bool(found.stderr[0, 2] < 0.1)
    (True, True)
    """
    light, noise = np.asarray(signals, np.float64), np.asarray(variance, np.float64)
    count = 3 + len(table.signals.leds)
    check = Checks(ChromophoreError)
    check.numbers("signals", light, ("n", count), interval="(0, inf)")
    check.numbers("variance", noise, light.shape, interval="[0, inf)")
    log_light, relative = np.log(light), noise / light**2
    chunks = [
        _fit_chunk(log_light[k : k + _CHUNK], relative[k : k + _CHUNK], table, log_shading)
        for k in range(0, max(len(light), 1), _CHUNK)
    ]
    at, stderr, noise_stderr, misfit = (
        np.concatenate(parts) for parts in zip(*chunks, strict=True)
    )
    plausible = misfit < stats.chi2.isf(MISFIT_PROBABILITY, count)
    determined = stderr[:, 2] <= MAX_STDERR_FRACTION * OXYGENATION_SD
    return BandFit(
        np.exp(at[:, 0]),
        np.exp(at[:, 1]),
        at[:, 2],
        stderr[:, :3],
        noise_stderr[:, :3],
        misfit,
        plausible & determined,
    )


def prior_moments(log_shading: tuple[float, float]) -> tuple[Float64Array, Float64Array]:
    """Return means and standard deviations of log melanin, log blood, oxygenation, log shading.

    Examples
    --------
    >>> prior_moments((-0.5, 0.4))[1].round(2).tolist()
    [1.0, 1.5, 0.14, 0.4]
    """
    depth = POPULATION_MELANIN * SKIN_CONSTANTS.melanin_depth_factor
    mean = [np.log(depth), np.log(POPULATION_BLOOD), SKIN_CONSTANTS.oxygenation, log_shading[0]]
    return np.array(mean), np.array([*POPULATION_LOG_SD, OXYGENATION_SD, log_shading[1]])


def _fit_chunk(
    log_light: Float64Array,
    relative: Float64Array,
    table: SignalTable,
    log_shading: tuple[float, float],
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Return modes (n, 4), standard errors (n, 4), those by noise, and misfits (n,)."""
    found = [
        _descend(log_light, relative, table, log_shading, depth) for depth in _START_OPTICAL_DEPTHS
    ]
    better = found[1][3] < found[0][3]
    parts = [
        np.where(better.reshape(-1, *[1] * (b.ndim - 1)), b, a) for a, b in zip(*found, strict=True)
    ]
    return parts[0], parts[1], parts[2], parts[3]


def _descend(
    log_light: Float64Array,
    relative: Float64Array,
    table: SignalTable,
    log_shading: tuple[float, float],
    start_depth: float,
) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
    """Run Gauss-Newton steps from a start; see `_fit_chunk`."""
    mean, sd = prior_moments(log_shading)
    at = np.tile(mean, (len(log_light), 1))
    at[:, 0] = np.log(start_depth)
    low, high = np.array(_RANGES).T
    moving = np.arange(len(at))
    for _ in range(N_STEPS):
        now = at[moving]
        fit = _linearize(now, log_light[moving], relative[moving], table)
        fisher = fit.gain @ fit.slopes + np.diag(sd**-2.0)
        pull = (fit.gain @ fit.off[..., None])[..., 0] + (mean - now) / sd**2
        step = np.linalg.solve(fisher, pull[..., None])[..., 0]
        moved = now + np.clip(step, -MAX_LOG_STEP, MAX_LOG_STEP)
        moved[:, :3] = np.clip(moved[:, :3], low, high)
        at[moving] = moved
        moving = moving[(np.abs(moved - now) > STEP_TOL).any(axis=-1)]
    fit = _linearize(at, log_light, relative, table)
    misfit = np.einsum("ni,nij,nj->n", fit.off, fit.weights, fit.off)
    misfit += np.square((mean - at) / sd).sum(axis=-1)
    posterior = np.linalg.inv(fit.gain @ fit.slopes + np.diag(sd**-2.0))
    stderr = np.sqrt(np.einsum("nii->ni", posterior))
    noise = np.sqrt(np.einsum("nij,nj->ni", np.square(posterior @ fit.gain), relative))
    return at, stderr, noise, misfit


@dataclass(frozen=True, slots=True, eq=False)
class _Linearization:
    """Model around points: residual, derivatives, inverse covariance and weighted derivatives."""

    off: Float64Array
    slopes: Float64Array
    weights: Float64Array
    gain: Float64Array


def _linearize(
    at: Float64Array, log_light: Float64Array, relative: Float64Array, table: SignalTable
) -> _Linearization:
    values, slopes = table.lookup(at[:, :3])
    noise = relative[..., None] * np.eye(log_light.shape[1])
    weights = np.asarray(np.linalg.inv(table.covariance_at(at[:, :3]) + noise))
    slopes = np.concatenate([slopes, np.ones((*log_light.shape, 1))], axis=-1)
    gain = np.asarray(np.swapaxes(slopes, 1, 2) @ weights)
    return _Linearization(log_light - values - at[:, 3:], slopes, weights, gain)


def _positions(at: Float64Array) -> Float64Array:
    """Return positions on the nodes, (3, n)."""
    ends, last = np.array(_RANGES), np.array(_NODES) - 1.0
    return np.asarray(((at - ends[:, 0]) / (ends[:, 1] - ends[:, 0]) * last).T)
