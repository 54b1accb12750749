"""White reference: illumination and camera response per pixel, from a white tile."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.arrays import BoolArray, Float32Array, Float64Array
from capture.calibration.record import (
    Calibration,
    Provenance,
    Quantity,
    make_single_device_calibration,
)
from capture.calibration.sensor.flat_field import fit_smooth_field
from capture.calibration.sensor.transfer_curve import block_sums

N_WHITE_BLOCKS = 24  # samples along the shorter side for the smooth fit


@dataclass(frozen=True, slots=True)
class WhiteReference:
    """Signal of a perfect white diffuser at every pixel, for unit light.

    Attributes
    ----------
    signal : ndarray of float32, shape (H, W, 3)
        Fraction of full scale for reflectance 1 and unit light; NaN where not `valid`.
    stderr : ndarray of float32, shape (H, W, 3)
        Standard error; NaN where not `valid`.
    valid : ndarray of bool, shape (H, W)
    residual : ndarray of float64, shape (3,)
        Relative scatter of the tile around the smooth fit; 0 without smoothing.
    leds : mapping of str to WhiteReference
        References of the sum of the channels under narrow-band LEDs, shape (H, W, 1), by name.
    """

    signal: Float32Array
    stderr: Float32Array
    valid: BoolArray
    residual: Float64Array
    leds: "Mapping[str, WhiteReference]" = field(default_factory=dict)

    def balance(
        self, rgb: NDArray, *, light: float = 1.0, variance: NDArray | None = None
    ) -> tuple[Float32Array, Float32Array, BoolArray]:
        """Return reflectance per channel, its variance, and the mask of valid pixels.

        A white surface comes out as (1, 1, 1) in every channel and at every pixel.

        Parameters
        ----------
        rgb : ndarray of float, shape (H, W, 3)
            Linear camera RGB, fraction of full scale.
        light : float
            Amount of light relative to that of the reference (flash power).
        variance : ndarray of float, shape (H, W, 3), optional
            Variance of `rgb`.

        Returns
        -------
        reflectance, variance : ndarray of float32, shape (H, W, 3)
            NaN where not valid. The variance includes that of the reference.
        valid : ndarray of bool, shape (H, W)
        """
        if rgb.shape != self.signal.shape:
            raise ValueError(
                f"rgb: got shape {rgb.shape}, expected {self.signal.shape} as the white reference;"
                " take both with the same camera settings and demosaic [SR-CAL-008]"
            )
        if not light > 0:
            raise ValueError(f"light: got {light}, expected > 0")
        # in float64: small signals squared leave the range of float32 weights
        signal = self.signal.astype(np.float64) * light
        reflectance = rgb / signal
        own = 0.0 if variance is None else variance / signal**2
        reference = (reflectance * self.stderr.astype(np.float64) * light / signal) ** 2
        return (
            reflectance.astype(np.float32),
            (own + reference).astype(np.float32),
            self.valid & np.logical_and.reduce(np.isfinite(reflectance), axis=-1),
        )

    def to_calibration(self, **about: Unpack[Provenance]) -> Calibration:
        """Return this as a `Calibration` of kind "white" for one camera; invalid pixels are 0."""
        white = np.nanmean(self.signal[self.valid].astype(np.float64), axis=0)
        return make_single_device_calibration(
            "white",
            {"mean_signal": Quantity(white), "residual": Quantity(self.residual)},
            {"unit": "fraction of full scale for reflectance 1 at unit light"},
            maps={
                prefix + name: np.where(one.valid[..., None], values, np.float32(0.0))
                for prefix, one in {"": self, **_with_prefixes(self.leds)}.items()
                for name, values in (("signal", one.signal), ("stderr", one.stderr))
            },
            **about,
        )

    @classmethod
    def from_calibration(cls, calibration: Calibration, serial: str) -> "WhiteReference":
        """Return the white reference of one camera from a loaded `Calibration`."""
        residual, blank = calibration.quantity(serial, "residual").value, np.float32(np.nan)

        def reference(prefix: str, leds: "Mapping[str, WhiteReference]") -> WhiteReference:
            signal = np.atleast_3d(calibration.maps[f"{prefix}signal"])
            stderr = np.atleast_3d(calibration.maps[f"{prefix}stderr"])
            valid = np.logical_and.reduce(signal > 0, axis=-1)
            return cls(
                np.where(valid[..., None], signal, blank).astype(np.float32),
                np.where(valid[..., None], stderr, blank).astype(np.float32),
                valid,
                residual,
                leds,
            )

        named = [match for name in calibration.maps if (match := _LED_MAP.fullmatch(name))]
        return reference("", {f"LED-{m[2]}-{m[3]}": reference(m[1], {}) for m in named})


_LED_MAP = re.compile(r"(led_([0-9]{3})_([0-9]{1,2})_)signal")


def _with_prefixes(leds: Mapping[str, WhiteReference]) -> dict[str, WhiteReference]:
    return {f"{name.lower().replace('-', '_')}_": one for name, one in leds.items()}


def white_reference(
    images: Sequence[NDArray],
    *,
    variances: Sequence[NDArray],
    valid: Sequence[BoolArray],
    lights: ArrayLike | None = None,
    reflectance: float = 1.0,
    degree: int | None = 4,
) -> WhiteReference:
    """Average images of a white tile that fills the field into a white reference.

    Parameters
    ----------
    images : sequence of ndarray of float, shape (H, W, 3)
        Linear camera RGB, fraction of full scale. For diffuse images photograph the tile in the
        same way (crossed, or the diffuse of `reconstruction.polarization.separate`).
    variances : sequence of ndarray of float, shape (H, W, 3)
        Variance of each image.
    valid : sequence of ndarray of bool, shape (H, W)
        False where an image is saturated.
    lights : array_like, shape (N,), optional
        Relative amount of light of each image (flash power); default 1.
    reflectance : float
        Reflectance of the tile, in (0, 1].
    degree : int or None
        Total degree of the polynomial that smooths the shading; None keeps every pixel with its own
        noise.

    Returns
    -------
    WhiteReference

    Raises
    ------
    ValueError
        If shapes differ or no pixel is usable.
    """
    if not images or len({len(images), len(variances), len(valid)}) != 1:
        raise ValueError(
            f"images, variances, valid: got {len(images)}, {len(variances)} and {len(valid)},"
            " expected equally many, at least one"
        )
    if not 0 < reflectance <= 1:
        raise ValueError(f"reflectance: got {reflectance}, expected 0 < reflectance <= 1")
    if len({image.shape for image in images}) != 1 or images[0].ndim != 3:
        raise ValueError(
            f"images: got shapes {[image.shape for image in images]}, expected one (H, W, 3)"
        )
    light = np.ones(len(images)) if lights is None else np.asarray(lights, dtype=np.float64)
    if light.shape != (len(images),) or not (light > 0).all():
        raise ValueError(f"lights: got {light.tolist()}, expected {len(images)} numbers > 0")
    total = np.zeros(images[0].shape)
    weight = np.zeros(images[0].shape[:2])
    noise = np.zeros(images[0].shape)
    for image, variance, ok, x in zip(images, variances, valid, light, strict=True):
        usable = ok & np.logical_and.reduce(np.isfinite(image), axis=-1)
        # light as weight: the mean of signal / light with weights light^2 / variance ~ light
        total += np.where(usable[..., None], image, 0.0)
        noise += np.where(usable[..., None], variance, 0.0)
        weight += usable * x
    good = weight > 0
    if not good.any():
        raise ValueError("images: every pixel of the white tile is saturated; use less light")
    scale = np.where(good, weight, 1.0)[..., None] * reflectance
    signal, stderr = total / scale, np.sqrt(noise) / scale
    residual = np.zeros(3)
    if degree is not None:
        signal, stderr, residual = _smooth(signal, good, degree)
    positive = good & np.logical_and.reduce(signal > 0, axis=-1)
    return WhiteReference(
        np.where(positive[..., None], signal, np.nan).astype(np.float32),
        np.where(positive[..., None], stderr, np.nan).astype(np.float32),
        positive,
        residual,
    )


def _smooth(
    signal: Float64Array, good: BoolArray, degree: int
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Replace a shaded white tile by its polynomial, with the error of the fit."""
    height, width = good.shape
    side = max(min(height, width) // N_WHITE_BLOCKS, 1)
    count = block_sums(good.astype(np.float64), side)
    r, c = np.nonzero(count >= side * side / 2)
    rows, columns = r * side + (side - 1) / 2, c * side + (side - 1) / 2
    out, errors, residual = np.empty_like(signal), np.empty_like(signal), np.empty(3)
    for k in range(3):
        means = block_sums(np.where(good, signal[..., k], 0.0), side)[r, c] / count[r, c]
        field = fit_smooth_field(means, rows, columns, shape=(height, width), degree=degree)
        out[..., k] = field.level * field.evaluate(height, width)
        errors[..., k] = field.level * field.evaluate_stderr(height, width)
        residual[k] = field.residual
    return out, errors, residual
