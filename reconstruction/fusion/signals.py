"""Signals of several rigs over melanin and blood, for one person's other properties of skin.

A signal is the logarithm of a white-balanced camera channel of the diffuse reflectance, or of the
dermis's sigma_tr in such a channel. It follows from melanin and blood, which vary over a face, and
from properties that one person has in common: the nuisance parameters of
`model.tissue_optics.uncertainty`, here in standard deviations of their published priors.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import RectBivariateSpline
from scipy.ndimage import map_coordinates

from model import spectra
from model.checks import Checks
from model.fresnel import ETA_SKIN, normal_reflectance
from model.tissue_optics import uncertainty
from model.tissue_optics.band_signals import IS_LOG, NUISANCE_SD, BandSignals
from model.tissue_optics.constants import SKIN_CONSTANTS
from model.tissue_optics.layers import C_HD_MAX, C_M_MAX
from model.tissue_optics.skin_spectra import SKIN_PARAMETERS, log_reflectance, log_sigma_tr
from reconstruction.arrays import Float64Array

SignalKind = Literal["reflectance", "sigma_tr"]

PROPERTY_NAMES: Final = SKIN_PARAMETERS[2:]
"""Properties of skin that one person has in common."""
N_PROPERTIES: Final = len(PROPERTY_NAMES)
MAX_PROPERTY_SD: Final = 2.4
"""Largest deviation of a property from its prior's mean, in standard deviations."""
GRID_NODES: Final = 28
"""Nodes along log melanin and log blood; interpolation errs by less than 1e-3 in log signal."""
_PROPERTY_STRIDE: Final = 3
_DEPTH_FACTOR: Final = SKIN_CONSTANTS.melanin_depth_factor
LOG_RANGE: Final = (
    (float(np.log(5e-4 * _DEPTH_FACTOR)), float(np.log(C_M_MAX * _DEPTH_FACTOR))),
    (float(np.log(5e-4)), float(np.log(C_HD_MAX))),
)
"""Ranges of log melanin optical depth at 550 nm and of log blood volume fraction."""
_STEP_LOG: Final = 0.01  # of central differences in log melanin and log blood
_STEP_SD: Final = 0.1  # of central differences, in standard deviations

PRESSED_BLOOD: Final = (0.5, 0.5)
"""Blood under a probe's head over that of free skin, and the standard deviation of its logarithm.

Pressure takes blood out of the skin (Reif et al. 2008, doi:10.1117/1.2870115); its amount is
assumed."""
SIGMA_TR_DISTANCE_MM: Final = 4.0
"""Distance from the source at which the light of a probe's channel has its sigma_tr.

Light of the least absorbed wavelengths travels farthest: at this distance they have most of a
channel's weight. Set on nine simulated people, types I to VI; see docs/validation/fusion.md. It
holds for the packaged probe, with fibers at 0.3 to 7.05 mm: farther fibers weight longer
wavelengths more."""
SIGMA_TR_OFFSET: Final = -0.06
"""Log sigma_tr of a probe's light on layered skin, less the dermis's at that distance.

Set on the same people."""
SIGMA_TR_SD: Final = (0.07, 0.05)
"""Deviation of log sigma_tr of a probe on layered, pressed skin from the dermis's: standard
deviations common to the channels, and of each channel."""


class FusionError(ValueError):
    """Error for measurements that cannot be combined."""


@dataclass(frozen=True, slots=True)
class RigBands:
    """Channels of one rig's measurement."""

    rig: str
    """Name of the rig in messages."""
    camera: str
    """Name of the camera's sensitivities in `model.spectra`."""
    illuminant: str
    """Name of the light's spectrum."""
    kind: SignalKind = "reflectance"
    """Quantity of the signal."""

    @property
    def bands(self) -> BandSignals:
        """Bands of the camera under the light."""
        return BandSignals(self.camera, self.illuminant, ())

    def log_signals(self, skin: Float64Array) -> Float64Array:
        """Return the three signals of skin (..., 8), see `model.tissue_optics.skin_spectra`.

        sigma_tr is the mean over a channel's light at `SIGMA_TR_DISTANCE_MM` from the source, its
        logarithm plus `SIGMA_TR_OFFSET`, of skin with `PRESSED_BLOOD`.
        """
        bands = self.bands
        if self.kind == "sigma_tr":
            pressed = skin * np.where(np.arange(skin.shape[-1]) == 1, PRESSED_BLOOD[0], 1.0)
            sigma_tr = np.exp(log_sigma_tr(bands.wavelength_nm, pressed))
            # shifted by the least sigma_tr, as exponentials far from the source underflow
            far = sigma_tr - sigma_tr.min(axis=-1, keepdims=True)
            light = np.exp(-SIGMA_TR_DISTANCE_MM * far)
            mean = (light * sigma_tr) @ bands.weights / (light @ bands.weights)
            return np.asarray(np.log(mean) + SIGMA_TR_OFFSET)
        return bands.log_signals(skin)


def skin_of_person(log_skin: ArrayLike, properties_sd: ArrayLike) -> Float64Array:
    """Return skin of given melanin and blood with a person's other properties.

    Parameters
    ----------
    log_skin
        Shape (..., 2): logarithms of melanin optical depth at 550 nm and of blood volume fraction.
    properties_sd
        Shape (6,): deviations of `PROPERTY_NAMES` from the means of their priors, in standard
        deviations; at most `MAX_PROPERTY_SD` counts.

    Returns
    -------
    ndarray
        Shape (..., 8), in the order of `model.tissue_optics.skin_spectra.SKIN_PARAMETERS`.

    Examples
    --------
    >>> skin = skin_of_person(np.log([0.2, 0.01]), [0, 1.0, 0, 0, 0, 0])
    >>> skin.round(4).tolist()
    [0.2, 0.01, 0.75, 0.1184, 9.2, 1.421, 1.0, 0.8]
    """
    at = np.asarray(log_skin, np.float64)
    check = Checks(FusionError)
    check.shape("log_skin", at, ("...", 2))
    given = check.numbers("properties_sd", properties_sd, (N_PROPERTIES,))
    step = NUISANCE_SD * np.clip(given, -MAX_PROPERTY_SD, MAX_PROPERTY_SD)
    constants = asdict(SKIN_CONSTANTS)
    usual = np.array([constants[name] for name in PROPERTY_NAMES])
    found = np.where(IS_LOG[2:], usual * np.exp(step), usual + step)
    fractions = [name in ("oxygenation", "eumelanin_fraction") for name in PROPERTY_NAMES]
    found = np.where(fractions, np.clip(found, 0.0, 1.0), found)
    rest = np.broadcast_to(found, (*at.shape[:-1], N_PROPERTIES))
    return np.concatenate([np.exp(at), rest], axis=-1)


def evaluate_signals(
    rigs: Sequence[RigBands], log_skin: Float64Array, properties_sd: Float64Array
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return signals of a few places with their derivatives, without a table.

    Parameters
    ----------
    rigs
        Rigs, three signals each.
    log_skin
        (K, 2): log melanin optical depth and log blood, within `LOG_RANGE`.
    properties_sd
        (6,): see `skin_of_person`.

    Returns
    -------
    values : ndarray
        (K, S).
    slopes : ndarray
        (K, S, 2): derivatives by log melanin and log blood.
    by_property : ndarray
        (K, S, 6): derivatives by the properties, per standard deviation.

    Examples
    --------
    >>> rigs = (RigBands("dome", "Nikon 5100 (NPL)", "LED-B3"),)
    >>> values, slopes, _ = evaluate_signals(rigs, np.log([[0.2, 0.01]]), np.zeros(6))
    >>> np.exp(values).round(2).tolist(), bool((slopes < 0.0).all())
    ([[0.26, 0.18, 0.12]], True)
    """

    def signals(skin: Float64Array) -> Float64Array:
        return np.concatenate([rig.log_signals(skin) for rig in rigs], axis=-1)

    limit = MAX_PROPERTY_SD
    moved, spans = [skin_of_person(log_skin, properties_sd)], []
    for k in range(2):
        step = _STEP_LOG * (np.arange(2) == k)
        moved += [skin_of_person(log_skin + sign * step, properties_sd) for sign in (-1.0, 1.0)]
        spans.append(2.0 * _STEP_LOG)
    for k in range(N_PROPERTIES):
        ends = np.clip(properties_sd[k] + np.array([-_STEP_SD, _STEP_SD]), -limit, limit)
        at = [np.where(np.arange(N_PROPERTIES) == k, end, properties_sd) for end in ends]
        moved += [skin_of_person(log_skin, one) for one in at]
        spans.append(float(np.ptp(ends)))
    found = signals(np.stack(moved))
    change = (found[2::2] - found[1::2]) / np.array(spans)[:, None, None]
    derivatives = np.moveaxis(change, 0, -1)
    return found[0], derivatives[..., :2], derivatives[..., 2:]


@dataclass(frozen=True, eq=False)
class SignalTable:
    """Signals of all rigs over melanin and blood around one person's properties.

    Attributes
    ----------
    rigs
        Rigs, three signals each.
    properties_sd
        Shape (6,): the person's properties.
    values
        Shape (n, n, S): signals over log melanin and log blood.
    by_property
        Shape (m, m, S, 6): derivatives by the properties at every third node, per standard
        deviation.
    """

    rigs: tuple[RigBands, ...]
    properties_sd: Float64Array
    values: Float64Array
    by_property: Float64Array

    @classmethod
    def build(cls, rigs: Sequence[RigBands], properties_sd: ArrayLike) -> "SignalTable":
        """Compute the signals and their derivatives at the nodes.

        Parameters
        ----------
        rigs
            One or more.
        properties_sd
            See `skin_of_person`.

        Examples
        --------
        >>> rigs = (RigBands("dome", "Nikon 5100 (NPL)", "LED-B3"),)
        >>> table = SignalTable.build(rigs, np.zeros(6))
        >>> signal, slope = table.evaluate(np.log([[0.2, 0.01]]))
        >>> np.exp(signal).round(2).tolist(), slope.shape
        ([[0.26, 0.18, 0.12]], (1, 3, 2))
        """
        at = Checks(FusionError).numbers("properties_sd", properties_sd, (N_PROPERTIES,))
        axes = [np.linspace(low, high, GRID_NODES) for low, high in LOG_RANGE]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

        def signals(place: Float64Array) -> Float64Array:
            skin = skin_of_person(nodes, place)
            return np.concatenate([rig.log_signals(skin) for rig in rigs], axis=-1)

        few = nodes[::_PROPERTY_STRIDE, ::_PROPERTY_STRIDE]
        by_property = evaluate_signals(rigs, few.reshape(-1, 2), at)[2]
        return cls(tuple(rigs), at, signals(at), by_property.reshape(*few.shape[:2], -1, 6))

    @cached_property
    def _splines(self) -> list[RectBivariateSpline]:
        axes = [np.linspace(low, high, GRID_NODES) for low, high in LOG_RANGE]
        return [RectBivariateSpline(*axes, v, s=0) for v in np.moveaxis(self.values, -1, 0)]

    @property
    def n_signals(self) -> int:
        """Number of signals, three per rig."""
        return 3 * len(self.rigs)

    def evaluate(self, log_skin: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return signals (N, S), and their derivatives (N, S, 2) by log melanin and log blood.

        Parameters
        ----------
        log_skin
            Shape (N, 2), within `LOG_RANGE`.
        """
        m, b = log_skin.T
        values = np.empty((len(m), self.n_signals))
        slopes = np.empty((len(m), self.n_signals, 2))
        for k, spline in enumerate(self._splines):
            values[:, k] = spline.ev(m, b)
            slopes[:, k, 0] = spline.ev(m, b, dx=1)
            slopes[:, k, 1] = spline.ev(m, b, dy=1)
        return values, slopes

    def evaluate_properties(self, log_skin: Float64Array) -> Float64Array:
        """Return derivatives of the signals by the properties, (N, S, 6), at (N, 2)."""
        count = len(self.by_property)
        places = [
            (log_skin[:, k] - low) / (high - low) * (count - 1)
            for k, (low, high) in enumerate(LOG_RANGE)
        ]
        flat = self.by_property.reshape(count, count, -1)
        found = [map_coordinates(flat[..., k], places, order=1) for k in range(flat.shape[-1])]
        return np.stack(found, axis=-1).reshape(-1, self.n_signals, N_PROPERTIES)

    def columns(self, rig: int) -> slice:
        """Return the columns of a rig's signals."""
        return slice(3 * rig, 3 * rig + 3)


def clip_to_range(log_skin: Float64Array) -> Float64Array:
    """Return log melanin and log blood, (..., 2), within `LOG_RANGE`.

    Examples
    --------
    >>> bool(np.isclose(clip_to_range(np.array([99.0, 0.0]))[1], np.log(0.32)))
    True
    """
    low, high = np.array(LOG_RANGE).T
    return np.asarray(np.clip(log_skin, low, high))


def residual_covariance(rigs: Sequence[RigBands], log_skin: Float64Array) -> Float64Array:
    """Return the covariance of all signals by what the model leaves unexplained of real skin.

    Parameters
    ----------
    rigs
        All with three signals.
    log_skin
        Shape (2,): typical melanin and blood of the face.

    Returns
    -------
    ndarray
        Shape (S, S). Reflectances of different rigs share the residuals of measured spectra;
        sigma_tr has `SIGMA_TR_SD` and an unknown
        `PRESSED_BLOOD`, independent of them.
    """
    skin = skin_of_person(log_skin, np.zeros(N_PROPERTIES))
    whole = np.exp(log_reflectance(spectra.WAVELENGTH_NM, skin)) + normal_reflectance(ETA_SKIN)
    angle = uncertainty.typology_angle(whole)
    moved = []
    for rig in rigs:
        if rig.kind == "sigma_tr":
            continue
        bands = rig.bands
        own = np.exp(log_reflectance(bands.wavelength_nm, skin))
        share = own[:, None] * bands.weights / (own @ bands.weights)
        moved.append(uncertainty.residual_factors(angle, bands.wavelength_nm) @ share)
    size = 3 * len(rigs)
    covariance = np.zeros((size, size))
    light = np.repeat([rig.kind == "reflectance" for rig in rigs], 3)
    if moved:
        factors = np.concatenate(moved, axis=-1)
        covariance[np.ix_(light, light)] = factors.T @ factors
    unstored = np.where(light, uncertainty.unstored_residual_variance(angle), 0.0)
    depth = np.outer(~light, ~light) * SIGMA_TR_SD[0] ** 2
    if not light.all():
        slopes = evaluate_signals(rigs, log_skin[None], np.zeros(N_PROPERTIES))[1][0, :, 1]
        by_blood = np.where(light, 0.0, PRESSED_BLOOD[1] * slopes)
        depth = depth + np.outer(by_blood, by_blood)
    return np.asarray(
        covariance + np.diag(unstored) + depth + np.diag(np.where(light, 0.0, SIGMA_TR_SD[1] ** 2))
    )
