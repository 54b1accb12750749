"""Simulate an image sensor: from light to digital numbers, stepwise in electrons."""

import hashlib
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import View
from rigsim.arrays import Float32Array, UInt16Array

CFA_CHANNELS: Final = {"R": 0, "G": 1, "B": 2}
"""Layer of each filter color in camera RGB."""


def filter_channels(cfa: str) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the channels of a Bayer sensor's 2 x 2 cell.

    Examples
    --------
    >>> filter_channels("RGGB")
    ((0, 1), (1, 2))
    """
    a, b, c, d = (CFA_CHANNELS[color] for color in cfa)
    return (a, b), (c, d)


class SensorError(ValueError):
    """A sensor or light with an invalid description."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """One sensor with its fixed imperfections; the serial number seeds the pattern."""

    full_well_e: float
    """Electrons at the white level, > 0."""
    gain_e_per_dn: float
    """Conversion gain in electrons per DN, > 0."""
    read_noise_e: float
    """Read noise, electrons rms, >= 0."""
    dark_e_per_s: float
    """Dark current in electrons per second and pixel, >= 0."""
    prnu: float
    """Relative standard deviation of the pixels' responses, 0 to 0.1."""
    dsnu_e: float
    """Standard deviation of the pixels' fixed offsets, electrons, >= 0."""
    black: int
    """DN without light, >= 0."""
    white: int
    """DN of saturation, > black."""
    bits: int
    """Bits of the converter, 8 to 16."""
    cfa: Literal["RGGB", "BGGR", "GRBG", "GBRG", "MONO"]
    """Colors of the 2 x 2 cell read row by row, or MONO."""
    vignetting: float
    """Light lost in the corner relative to the center, 0 to 0.9."""
    serial: str
    """Serial number; seeds the fixed pattern."""

    WELL_HEADROOM = 1.05
    """Electrons of the full well over those of the white level: the converter clips first,
    so that saturated pixels all read the white level."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name, low, high in (
            ("full_well_e", 1.0, 1e9),
            ("gain_e_per_dn", 1e-6, 1e6),
            ("read_noise_e", 0.0, 1e5),
            ("dark_e_per_s", 0.0, 1e6),
            ("prnu", 0.0, 0.1),
            ("dsnu_e", 0.0, 1e4),
            ("vignetting", 0.0, 0.9),
            ("bits", 8, 16),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise SensorError(f"{name}: got {value}, expected {low} to {high}")
        if not 0 <= self.black < self.white <= 2**self.bits - 1:
            raise SensorError(
                f"black, white: got {self.black}, {self.white}, "
                f"expected 0 <= black < white <= {2**self.bits - 1}"
            )
        if self.cfa not in ("RGGB", "BGGR", "GRBG", "GBRG", "MONO"):
            raise SensorError(f"cfa: got {self.cfa!r}, expected a Bayer pattern or MONO")

    def noise_profile(self, exposure_s: float = 0.0) -> tuple[float, float]:
        """Return scale and offset of the variance over the signal, in units of full scale.

        Parameters
        ----------
        exposure_s
            Exposure time, s; longer ones add dark noise.

        Returns
        -------
        scale, offset : float
            variance = scale x + offset, where x = (DN - black) / (white - black) without the dark
            signal; shot, dark, read and rounding noise, as in DNG's NoiseProfile.
        """
        range_e = self.gain_e_per_dn * (self.white - self.black)
        dark_e = self.dark_e_per_s * exposure_s
        rounding_e2 = self.gain_e_per_dn**2 / 12.0
        floor_e2 = self.read_noise_e**2 + dark_e + rounding_e2
        return 1.0 / range_e, floor_e2 / range_e**2


def make_sensor(
    view: View,
    *,
    dark_e_per_s: float = 0.2,
    prnu: float = 0.006,
    dsnu_e: float = 1.0,
    vignetting: float = 0.25,
) -> Sensor:
    """Return the sensor of a view, with typical values where the rig has none.

    Parameters
    ----------
    view
        Nominal camera: full well, read noise, levels, filter pattern, serial number.
    dark_e_per_s, prnu, dsnu_e, vignetting
        As the fields of `Sensor`.

    Returns
    -------
    Sensor
        A sensor whose full well corresponds to the white level.
    """
    return Sensor(
        full_well_e=view.full_well_e,
        gain_e_per_dn=view.gain_e_per_dn,
        read_noise_e=view.read_noise_e,
        dark_e_per_s=dark_e_per_s,
        prnu=prnu,
        dsnu_e=dsnu_e,
        black=view.black_level,
        white=view.white_level,
        bits=view.bit_depth,
        cfa=view.cfa,
        vignetting=vignetting,
        serial=view.serial,
    )


def expose_sensor(
    irradiance_rgb: ArrayLike, *, sensor: Sensor, rng: np.random.Generator, exposure_s: float = 0.0
) -> UInt16Array:
    """Simulate one exposure of the sensor.

    Parameters
    ----------
    irradiance_rgb
        Light behind each filter as fraction of full scale in the center of an ideal
        sensor, shape (H, W, 3), >= 0, or behind each pixel's own filter, shape (H, W). A MONO
        sensor averages three channels.
    sensor
        The sensor.
    rng
        Source of shot, dark and read noise.
    exposure_s
        Exposure time, s; it affects the dark current only, since the light is given.

    Returns
    -------
    ndarray of uint16
        Raw DN, shape (H, W); the filter pattern starts at its first letter in the top left.

    Raises
    ------
    SensorError
        The light has a wrong shape, is negative or is not finite.
    """
    light = np.asarray(irradiance_rgb, np.float32)
    if not np.isfinite(light).all() or (light.size and light.min() < 0.0):
        raise SensorError("irradiance_rgb: got negative or non-finite values, expected >= 0")
    if not 0.0 <= exposure_s < math.inf:
        raise SensorError(f"exposure_s: got {exposure_s}, expected >= 0")
    filtered = apply_cfa(light, sensor.cfa)
    pattern = fixed_pattern(sensor, filtered.shape)
    full_e = sensor.gain_e_per_dn * (sensor.white - sensor.black)
    mean_e = filtered * pattern.response * np.float32(full_e)
    mean_e += np.float32(sensor.dark_e_per_s * exposure_s)
    # NumPy's Poisson sampler is limited to 2^63; the well saturates far below.
    well_e = sensor.WELL_HEADROOM * sensor.full_well_e
    electrons = rng.poisson(np.minimum(mean_e, 4.0 * well_e + 1e3)).astype(np.float32)
    np.minimum(electrons, np.float32(well_e), out=electrons)
    electrons += rng.standard_normal(filtered.shape, np.float32) * np.float32(sensor.read_noise_e)
    electrons += pattern.offset_e
    dn = np.rint(electrons / np.float32(sensor.gain_e_per_dn)) + sensor.black
    return np.clip(dn, 0, sensor.white).astype(np.uint16)


def apply_cfa(light: ArrayLike, cfa: str) -> Float32Array:
    """Return the channel of each pixel's filter.

    Parameters
    ----------
    light
        Camera RGB, shape (H, W, 3), or the light behind each pixel's filter, (H, W).
    cfa
        Colors of the 2 x 2 cell read row by row, or MONO.

    Returns
    -------
    ndarray of float32
        Shape (H, W).

    Examples
    --------
    >>> apply_cfa(np.broadcast_to([1.0, 2.0, 3.0], (2, 2, 3)), "RGGB").tolist()
    [[1.0, 2.0], [2.0, 3.0]]
    """
    image = np.asarray(light, np.float32)
    if image.ndim == 2:
        return image.copy()
    if image.ndim == 3 and cfa == "MONO":
        return np.asarray(image.mean(axis=-1), np.float32)
    if image.ndim != 3 or image.shape[-1] != 3:
        raise SensorError(f"irradiance_rgb: got shape {image.shape}, expected (H, W, 3) or (H, W)")
    out = np.empty(image.shape[:2], np.float32)
    for index, color in enumerate(cfa):
        row, column = divmod(index, 2)
        out[row::2, column::2] = image[row::2, column::2, CFA_CHANNELS[color]]
    return out


def color_filters(gray: ArrayLike, color: ArrayLike, cfa: str) -> Float32Array:
    """Return light of one color behind each pixel's filter.

    Parameters
    ----------
    gray
        Light, or light behind the filters before its color, shape (H, W).
    color
        Factor of each channel, shape (3,).
    cfa
        Colors of the 2 x 2 cell read row by row; MONO takes the mean of the factors.

    Returns
    -------
    ndarray of float32
        Shape (H, W).

    Examples
    --------
    >>> color_filters(np.ones((2, 3)), [1.0, 2.0, 3.0], "RGGB").tolist()
    [[1.0, 2.0, 1.0], [2.0, 3.0, 2.0]]
    """
    out = np.array(gray, np.float32)
    if cfa == "MONO":
        return np.asarray(out * np.asarray(color, np.float32).mean(), np.float32)
    for row, channels in enumerate(filter_channels(cfa)):
        for column, channel in enumerate(channels):
            out[row::2, column::2] *= np.asarray(color, np.float32)[channel]
    return out


@dataclass(frozen=True, slots=True)
class FixedPattern:
    """Variation between pixels that is constant between frames."""

    response: Float32Array
    """Relative response with vignetting, shape (H, W), 1 in the center on average."""
    offset_e: Float32Array
    """Offset in electrons, shape (H, W), 0 on average."""


def fixed_pattern(sensor: Sensor, shape: tuple[int, ...]) -> FixedPattern:
    """Return the fixed pattern of a sensor, determined by its serial number and size.

    Parameters
    ----------
    sensor
        The sensor.
    shape
        Rows and columns.

    Returns
    -------
    FixedPattern
        Read-only arrays.
    """
    return _fixed_pattern(sensor, int(shape[0]), int(shape[1]))


@lru_cache(maxsize=16)  # one per camera of a dome
def _fixed_pattern(sensor: Sensor, rows: int, columns: int) -> FixedPattern:
    digest = hashlib.sha256(sensor.serial.encode()).digest()
    rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
    response = 1.0 + np.float32(sensor.prnu) * rng.standard_normal((rows, columns), np.float32)
    # A deviation below -5 sigma must not make a pixel's response negative.
    response = np.maximum(response, np.float32(0.01))
    response *= vignetting_map(sensor.vignetting, rows, columns)
    offset = np.float32(sensor.dsnu_e) * rng.standard_normal((rows, columns), np.float32)
    response.setflags(write=False)
    offset.setflags(write=False)
    return FixedPattern(response, offset)


def vignetting_map(loss: float, rows: int, columns: int) -> Float32Array:
    """Return the falloff of a lens with the form of the cos^4 law, 1 in the center.

    Parameters
    ----------
    loss
        Light lost in the corner, 0 to 0.9.
    rows, columns
        Size of the image.

    Returns
    -------
    ndarray of float32
        Shape (H, W).

    Examples
    --------
    >>> corner = vignetting_map(0.25, 101, 201)
    >>> round(float(corner[0, 0]), 3), float(corner[50, 100])
    (0.75, 1.0)
    """
    y = np.linspace(-1.0, 1.0, rows) if rows > 1 else np.zeros(1)
    x = np.linspace(-1.0, 1.0, columns) if columns > 1 else np.zeros(1)
    diagonal2 = rows**2 + columns**2
    r2 = ((y * rows) ** 2)[:, None] / diagonal2 + ((x * columns) ** 2)[None, :] / diagonal2
    # cos^4 = (1 + tan^2)^-2 with tan^2 proportional to r^2; r = 1 in the corner sets k.
    k = 1.0 / math.sqrt(1.0 - loss) - 1.0
    return ((1.0 + k * r2) ** -2).astype(np.float32)
