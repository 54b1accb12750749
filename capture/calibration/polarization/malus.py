"""Analyzer zero and extinction of a pair of polarizers, by a fit of Malus's law."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.stats import t as student

from capture.arrays import BoolArray, Float64Array
from capture.calibration.record import (
    Calibration,
    CalibrationError,
    Provenance,
    Quantity,
    make_single_device_calibration,
)

CONFIDENCE_LEVEL = 0.95
MIN_MODULATION_SIGMAS = 5.0
MAX_JITTER = 0.3  # relative; a light with larger variations is out of order


class PolarizationError(CalibrationError):
    """Raised for a Malus series that cannot be fitted; the message states what to take."""


@dataclass(frozen=True, slots=True)
class MalusFit:
    """Malus's law fitted to one or more curves ``I = a + m cos 2(angle - zero)``.

    Attributes
    ----------
    zero_rad, zero_stderr_rad : ndarray of float64, shape (C,)
        Analyzer angle of largest transmission, in [-pi/2, pi/2), and its standard error.
    leak, leak_stderr : ndarray of float64, shape (C,)
        Smallest over largest transmission, ``(a - m) / (a + m)``; may come out below zero by noise.
    extinction_lower, extinction_upper : ndarray of float64, shape (C,)
        95 % interval of the extinction ratio ``1 / leak``; the upper end is inf where the leak does
        not differ significantly from zero.
    light_jitter : ndarray of float64, shape (C,)
        Relative scatter of the light from frame to frame, estimated from the residuals.
    chi2_per_dof : ndarray of float64, shape (C,)
        Scatter over its expectation without light jitter.
    """

    zero_rad: Float64Array
    zero_stderr_rad: Float64Array
    leak: Float64Array
    leak_stderr: Float64Array
    extinction_lower: Float64Array
    extinction_upper: Float64Array
    light_jitter: Float64Array
    chi2_per_dof: Float64Array


@dataclass(frozen=True, slots=True)
class PolarizationCalibration:
    """Analyzer zero and leak of one camera with its lights.

    Attributes
    ----------
    colors : tuple of str
        ("R", "G", "B") or ("MONO",).
    zero_rad : Quantity, shape ()
        Rotator reading at which the analyzer is parallel to the lights' polarizers.
    leak : Quantity, shape (C,)
        Crossed over parallel transmission of polarized light, per color; an upper bound of the
        polarizers' leak, because a depolarizing target adds to it.
    extinction_interval : tuple of (float, float or None), per color
        95 % interval of ``1 / leak``; None for an open upper end.
    light_jitter : float
        Relative scatter of the light between frames.
    """

    colors: tuple[str, ...]
    zero_rad: Quantity
    leak: Quantity
    extinction_interval: tuple[tuple[float, float | None], ...]
    light_jitter: float

    def crossed_leak(
        self, *, parallel_rad: float = 0.0, crossed_rad: float = np.pi / 2
    ) -> Float64Array:
        """Return the crossed fraction of polarized light, over parallel, per color, shape (C,).

        Includes the deviation of the analyzer from its zero.

        Parameters
        ----------
        parallel_rad, crossed_rad : float
            Rotator readings of the two states.
        """
        leak = np.maximum(self.leak.value, 0.0)
        zero = float(self.zero_rad.value)
        passed = [
            np.cos(angle - zero) ** 2 + leak * np.sin(angle - zero) ** 2
            for angle in (crossed_rad, parallel_rad)
        ]
        return np.asarray(passed[0] / passed[1], dtype=np.float64)

    def to_calibration(self, **about: Unpack[Provenance]) -> Calibration:
        """Return this as a `Calibration` of kind "polarization" for one camera."""
        values = {
            "analyzer_zero_rad": self.zero_rad,
            "leak": self.leak,
            "light_jitter": Quantity(np.array(self.light_jitter)),
        }
        for color, interval in zip(self.colors, self.extinction_interval, strict=True):
            middle = interval[0] if interval[1] is None else np.sqrt(interval[0] * interval[1])
            values[f"extinction_{color.lower()}"] = Quantity(
                np.array(float(middle)), interval=interval
            )
        return make_single_device_calibration(
            "polarization",
            values,
            {
                "colors": " ".join(self.colors),
                "extinction": "middle of its 95 % interval; the lower end of an open interval",
            },
            **about,
        )

    @classmethod
    def from_calibration(cls, calibration: Calibration, serial: str) -> "PolarizationCalibration":
        """Return the polarization calibration of one camera from a loaded `Calibration`."""
        colors = tuple(calibration.notes["colors"].split())
        intervals: list[tuple[float, float | None]] = []
        for color in colors:
            interval = calibration.quantity(serial, f"extinction_{color.lower()}").interval
            low, high = interval if interval is not None else (None, None)
            intervals.append((low if low is not None else 1.0, high))
        return cls(
            colors=colors,
            zero_rad=calibration.quantity(serial, "analyzer_zero_rad"),
            leak=calibration.quantity(serial, "leak"),
            extinction_interval=tuple(intervals),
            light_jitter=float(calibration.quantity(serial, "light_jitter").value),
        )

    @classmethod
    def from_fit(cls, fit: MalusFit, colors: Sequence[str]) -> "PolarizationCalibration":
        """Return the calibration of one camera from the fit of its color channels.

        The channels share the scatter of the light, so that the error of their common zero is the
        smallest of theirs, not smaller.
        """
        if len(colors) != fit.leak.size:
            raise ValueError(f"colors: got {len(colors)}, expected {fit.leak.size}")
        weight = fit.zero_stderr_rad**-2
        # angles are axes, equal modulo pi: average exp(2 i angle)
        zero = 0.5 * np.angle((weight * np.exp(2j * fit.zero_rad)).sum())
        return cls(
            colors=tuple(colors),
            zero_rad=Quantity(np.array(float(zero)), np.array(float(fit.zero_stderr_rad.min()))),
            leak=Quantity(fit.leak, fit.leak_stderr),
            extinction_interval=tuple(
                (float(low), float(high) if np.isfinite(high) else None)
                for low, high in zip(fit.extinction_lower, fit.extinction_upper, strict=True)
            ),
            light_jitter=float(fit.light_jitter.max()),
        )


def fit_malus(
    angles_rad: ArrayLike, intensity: ArrayLike, *, variance: ArrayLike | None = None
) -> MalusFit:
    """Fit Malus's law to intensities over analyzer angles.

    Linear least squares in (1, cos 2 angle, sin 2 angle). With a measurement variance given,
    scatter beyond it is modeled as relative scatter of the light from frame to frame, so that the
    dark angles, which determine the extinction, keep their weight.

    Parameters
    ----------
    angles_rad : array_like, shape (N,)
        Analyzer angles; at least four that differ modulo pi.
    intensity : array_like, shape (N,) or (N, C)
        Dark-subtracted intensity of a polarized (specular) target, any unit.
    variance : array_like, shape of ``intensity``, optional
        Variance of each; without it all angles have equal uncertainty.

    Returns
    -------
    MalusFit

    Raises
    ------
    PolarizationError
        If the angles do not suffice or the intensity does not vary with them.

    Examples
    --------
    >>> angles = np.deg2rad(np.arange(0, 181, 15))
    >>> fit = fit_malus(angles, 1e-3 + np.cos(angles - 0.02) ** 2)
    >>> round(float(fit.zero_rad[0]), 6), round(float(1 / fit.leak[0]), 3)
    (0.02, 1001.0)
    """
    angles = np.asarray(angles_rad, dtype=np.float64)
    values = np.asarray(intensity, dtype=np.float64)
    curves = values[:, None] if values.ndim == 1 else values
    if angles.ndim != 1 or curves.ndim != 2 or len(curves) != len(angles):
        raise PolarizationError(
            f"angles_rad, intensity: got shapes {angles.shape} and {values.shape}, expected (N,)"
            " and (N, C)"
        )
    variances = None
    if variance is not None:
        variances = np.broadcast_to(np.asarray(variance, dtype=np.float64), values.shape)
        variances = variances.reshape(curves.shape)
        if not (np.isfinite(variances).all() and (variances > 0).all()):
            raise PolarizationError("variance: expected finite numbers > 0")
    if not (np.isfinite(angles).all() and np.isfinite(curves).all()):
        raise PolarizationError("angles_rad, intensity: expected finite numbers; omit the rest")
    doubled = np.exp(2j * angles)
    if len(np.unique(np.round(doubled, 6))) < 4:
        raise PolarizationError(
            f"angles_rad: got {len(angles)} angles with fewer than four different ones, expected"
            " for example every 15 degrees from 0 to 180"
        )
    design = np.stack([np.ones_like(angles), doubled.real, doubled.imag], axis=1)
    rows = [
        _fit_curve(design, curves[:, c], None if variances is None else variances[:, c])
        for c in range(curves.shape[1])
    ]
    return MalusFit(*(np.array(column) for column in zip(*rows, strict=True)))


def find_modulated_pixels(
    angles_rad: ArrayLike,
    images: Sequence[NDArray],
    *,
    valid: BoolArray | None = None,
    fraction: float = 0.5,
) -> BoolArray:
    """Find the pixels whose intensity follows the analyzer most: the polarized target.

    Parameters
    ----------
    angles_rad : array_like, shape (N,)
        Analyzer angles.
    images : sequence of N ndarray, shape (H, W) or (H, W, C)
        Dark-subtracted images.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that may be used (saturated in no frame).
    fraction : float
        Smallest modulation over that of the strongest pixels.

    Returns
    -------
    ndarray of bool, shape (H, W)
    """
    doubled = np.exp(2j * np.asarray(angles_rad, dtype=np.float64))
    design = np.stack([np.ones_like(doubled.real), doubled.real, doubled.imag], axis=1)
    solver = np.linalg.pinv(design)
    total: NDArray | None = None
    for row, image in zip(solver.T, images, strict=True):
        gray = np.asarray(image, dtype=np.float64)
        gray = gray.mean(axis=-1) if gray.ndim == 3 else gray
        part = row[:, None, None] * gray
        total = part if total is None else total + part
    if total is None:
        raise PolarizationError("images: got none")
    usable = np.isfinite(total).all(axis=0)
    if valid is not None:
        usable &= valid
    if not usable.any():
        raise PolarizationError("images: every pixel saturates at some angle; use less light")
    amplitude = np.where(usable, np.hypot(total[1], total[2]), 0.0)
    # the strongest pixels without the noise of the single strongest
    top = float(np.quantile(amplitude[usable], 0.999))
    return usable & (amplitude >= fraction * top) & (amplitude > 0)


def _weighted(
    design: Float64Array, y: Float64Array, variance: Float64Array
) -> tuple[Float64Array, Float64Array, float]:
    root = 1.0 / np.sqrt(variance)
    coefficients, *_ = np.linalg.lstsq(design * root[:, None], y * root, rcond=None)
    covariance = np.linalg.inv((design * root[:, None]).T @ (design * root[:, None]))
    chi2 = float((((y - design @ coefficients) * root) ** 2).sum())
    return np.asarray(coefficients, dtype=np.float64), np.asarray(covariance), chi2


def _with_jitter(
    design: Float64Array, y: Float64Array, variance: Float64Array
) -> tuple[Float64Array, Float64Array, float, float]:
    """Fit with the relative scatter of the light that makes chi2 equal its degrees of freedom."""
    dof = max(len(y) - 3, 1)
    model = np.maximum(y, 0.0)
    jitter = 0.0
    coefficients, covariance, chi2 = _weighted(design, y, variance)
    chi2_per_dof = chi2 / dof
    for _ in range(8):
        if chi2_per_dof > 1.0:

            def excess(j: float, model: Float64Array = model) -> float:
                return _weighted(design, y, variance + (j * model) ** 2)[2] - dof

            jitter = (
                float(brentq(excess, 0.0, MAX_JITTER)) if excess(MAX_JITTER) < 0 else MAX_JITTER
            )
        coefficients, covariance, chi2 = _weighted(design, y, variance + (jitter * model) ** 2)
        model = np.maximum(design @ coefficients, 0.0)
    return coefficients, covariance * max(chi2 / dof, 1.0), jitter, chi2_per_dof


def _fit_curve(
    design: Float64Array, y: Float64Array, variance: Float64Array | None
) -> tuple[float, ...]:
    dof = len(y) - 3
    if variance is None:
        coefficients, covariance, chi2 = _weighted(design, y, np.ones_like(y))
        covariance = covariance * (chi2 / max(dof, 1))
        jitter, chi2_per_dof = 0.0, 1.0
    else:
        coefficients, covariance, jitter, chi2_per_dof = _with_jitter(design, y, variance)
    a, b, c = (float(v) for v in coefficients)
    # y = a + b cos 2x + c sin 2x = a + m cos 2(x - zero), with m = |(b, c)| and zero = atan2(c, b)
    # / 2; the gradients below propagate the covariance to zero and leak.
    m = float(np.hypot(b, c))
    along = np.array([0.0, b, c]) / max(m, np.finfo(float).tiny)
    m_error = float(np.sqrt(along @ covariance @ along))
    if a <= 0 or m <= MIN_MODULATION_SIGMAS * m_error:
        raise PolarizationError(
            f"Malus series: the intensity does not follow the analyzer (modulation {m:.3g} +- "
            f"{m_error:.2g} of a mean {a:.3g}); use a specular target (a metal or glass "
            "surface, not paper or skin) and check that the lights are polarized"
        )
    across = np.array([0.0, -c, b]) / (2.0 * m**2)
    leak_slope = 2.0 * (m * np.array([1.0, 0.0, 0.0]) - a * along) / (a + m) ** 2
    leak = (a - m) / (a + m)
    leak_error = float(np.sqrt(leak_slope @ covariance @ leak_slope))
    reach = float(student.ppf(0.5 + CONFIDENCE_LEVEL / 2, max(dof, 1))) * leak_error
    return (
        (0.5 * np.arctan2(c, b) + np.pi / 2) % np.pi - np.pi / 2,
        float(np.sqrt(across @ covariance @ across)),
        leak,
        leak_error,
        1.0 / max(leak + reach, np.finfo(float).tiny),
        1.0 / (leak - reach) if leak > reach else np.inf,
        jitter,
        chi2_per_dof,
    )
