"""Sensor calibration: black, gain, read noise, saturation, linearity, pixel response, flat field.

Everything is estimated from dark frames and from pairs of flats at several amounts of light, per
CFA color, with standard errors; see `capture.calibration.sensor.transfer_curve` for the curve
itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Unpack

import numpy as np

from capture.arrays import Float64Array, UInt16Array
from capture.calibration.record import (
    Calibration,
    Provenance,
    Quantity,
    make_single_device_calibration,
)
from capture.calibration.sensor.darks import DarkStatistics, pool_estimates, reduce_darks
from capture.calibration.sensor.flat_field import SmoothField, fit_smooth_field, pixel_response
from capture.calibration.sensor.transfer_curve import (
    FlatPair,
    PhotonTransferError,
    TransferCurveFit,
    block_statistics,
    block_sums,
    cfa_offsets,
    extract_cfa_plane,
    fit_transfer_curve,
)

QUANTIZATION_DN2 = 1.0 / 12.0  # variance of rounding: uniform within +- 1/2 DN
N_FLAT_BLOCKS = 16  # samples of the flat field along the shorter side


@dataclass(frozen=True, slots=True)
class SensorCalibration:
    """Calibration of one sensor; arrays are per color, in the order of ``colors``.

    Attributes
    ----------
    pattern : str
        CFA pattern, row-major, or "MONO".
    colors : tuple of str
        ("R", "G", "B") or ("MONO",).
    white_dn : int
        White level of the frames, DN.
    black_dn : Quantity, shape (C,)
        Mean of the dark frames, DN.
    gain_e_per_dn : Quantity, shape (C,)
        Electrons per DN.
    read_noise_e : Quantity, shape (C,)
        Temporal noise without light and without the rounding to whole DN, electrons.
    saturation_dn : Quantity, shape (C,)
        Raw level at which pixels saturate, DN (a bound where `saturated_by` is "not reached").
    full_well_e : Quantity, shape (C,)
        Electrons at that level: the full well, or a lower bound of it where `saturated_by` is not
        "full well".
    saturated_by : tuple of str
        "full well", "white level" or "not reached", per color.
    nonlinearity : Quantity, shape (C,)
        Relative change of the response from no light to the most light used. It cannot be separated
        from a nonlinearity of the light source.
    linearity_deviation : Quantity, shape (C,)
        Largest relative deviation of one level from a straight line through zero.
    prnu : Quantity, shape (C,)
        Relative pixel-to-pixel standard deviation of sensitivity.
    dsnu_dn : Quantity, shape (C,)
        Pixel-to-pixel standard deviation of the dark level, DN.
    dark_e_per_s : Quantity or None
        Dark current, shape (C,); None when all dark frames have one exposure time.
    flat : tuple of SmoothField
        Shading of the flat target in this camera's image (vignetting times uneven light), per
        color, 1 at the center.
    chi2_per_dof : tuple of float
        Scatter around the photon transfer line over its expectation; near 1 when the model holds.
    hot_pixels : int
        Number of omitted pixels.
    """

    pattern: str
    colors: tuple[str, ...]
    white_dn: int
    black_dn: Quantity
    gain_e_per_dn: Quantity
    read_noise_e: Quantity
    saturation_dn: Quantity
    full_well_e: Quantity
    saturated_by: tuple[str, ...]
    nonlinearity: Quantity
    linearity_deviation: Quantity
    prnu: Quantity
    dsnu_dn: Quantity
    dark_e_per_s: Quantity | None
    flat: tuple[SmoothField, ...]
    chi2_per_dof: tuple[float, ...]
    hot_pixels: int

    def mean_gain_e_per_dn(self) -> Quantity:
        """Return the gain averaged over colors with inverse-variance weights."""
        return _combine(self.gain_e_per_dn)

    def mean_read_noise_e(self) -> Quantity:
        """Return the read noise averaged over colors with inverse-variance weights."""
        return _combine(self.read_noise_e)

    def noise_profile(self) -> tuple[float, float]:
        """Return (scale, offset) of the variance in units of the range, as in a DNG NoiseProfile.

        ``variance = scale * x + offset`` with x in [0, 1] between the black and the white level.
        """
        span = self.white_dn - float(self.black_dn.value.mean())
        gain = float(self.mean_gain_e_per_dn().value)
        offset = (float(self.mean_read_noise_e().value) / gain) ** 2 + QUANTIZATION_DN2
        return 1.0 / (gain * span), offset / span**2

    def flat_mosaic(self, height: int, width: int) -> Float64Array:
        """Return the flat field on the CFA, shape (H, W), 1 at the center of each color."""
        mosaic = np.empty((height, width))
        step = 1 if self.pattern == "MONO" else 2
        for field, positions in zip(self.flat, cfa_offsets(self.pattern).values(), strict=True):
            full = field.evaluate(height, width)
            for row, column in positions:
                mosaic[row::step, column::step] = full[row::step, column::step]
        return mosaic

    def to_calibration(self, **about: Unpack[Provenance]) -> Calibration:
        """Return this as a `Calibration` of kind "sensor" for one camera."""
        values: dict[str, Quantity] = {name: getattr(self, name) for name in _PER_COLOR}
        if self.dark_e_per_s is not None:
            values["dark_e_per_s"] = self.dark_e_per_s
        values["white_dn"] = Quantity(np.array(float(self.white_dn)))
        values["hot_pixels"] = Quantity(np.array(float(self.hot_pixels)))
        values["chi2_per_dof"] = Quantity(np.array(self.chi2_per_dof))
        values["flat_coefficients"] = Quantity(
            np.stack([f.coefficients for f in self.flat]), np.stack([f.stderr for f in self.flat])
        )
        values["flat_residual"] = Quantity(np.array([f.residual for f in self.flat]))
        return make_single_device_calibration(
            "sensor",
            values,
            {
                "pattern": self.pattern,
                "colors": " ".join(self.colors),
                "saturated_by": ", ".join(self.saturated_by),
            },
            **about,
        )

    @classmethod
    def from_calibration(cls, calibration: Calibration, serial: str) -> "SensorCalibration":
        """Return the sensor calibration of one camera from a loaded `Calibration`."""
        get = calibration.quantity
        coefficients = get(serial, "flat_coefficients")
        errors = coefficients.stderr_or_zero
        residuals = get(serial, "flat_residual").value
        has_dark = "dark_e_per_s" in calibration.values[serial]
        return cls(
            pattern=calibration.notes["pattern"],
            colors=tuple(calibration.notes["colors"].split()),
            white_dn=int(get(serial, "white_dn").value),
            saturated_by=tuple(calibration.notes["saturated_by"].split(", ")),
            dark_e_per_s=get(serial, "dark_e_per_s") if has_dark else None,
            flat=tuple(
                SmoothField(c, np.diag(e**2), float(r))
                for c, e, r in zip(coefficients.value, errors, residuals, strict=True)
            ),
            chi2_per_dof=tuple(float(v) for v in get(serial, "chi2_per_dof").value),
            hot_pixels=int(get(serial, "hot_pixels").value),
            **{name: get(serial, name) for name in _PER_COLOR},
        )


_PER_COLOR = tuple(field.name for field in fields(SensorCalibration) if field.type is Quantity)


def calibrate_sensor(
    pairs: Sequence[FlatPair],
    darks: Sequence[UInt16Array],
    *,
    white_dn: int,
    pattern: str = "RGGB",
    dark_exposures_s: Sequence[float] | None = None,
    block: int = 16,
    flat_degree: int = 4,
) -> SensorCalibration:
    """Calibrate a sensor from pairs of flats at several amounts of light and dark frames.

    Parameters
    ----------
    pairs : sequence of FlatPair
        At least three amounts of light, better eight, from 5 % to 90 % of the range or beyond.
    darks : sequence of ndarray of uint16, shape (H, W)
        At least two frames without light at the flats' exposure time, DN.
    white_dn : int
        White level, DN.
    pattern : str
        CFA pattern or "MONO".
    dark_exposures_s : sequence of float, optional
        Exposure time of each dark frame, seconds; two different times give the dark current.
    block : int
        Side of the blocks over which the variance is taken, in pixels of one CFA position.
    flat_degree : int
        Degree of the polynomial that describes the flat field.

    Returns
    -------
    SensorCalibration

    Raises
    ------
    PhotonTransferError
        If the frames are not sufficient.

    Notes
    -----
    Assumes uncompressed, linear raw data and one gain for all pixels of a color. The curve:
    Janesick, Photon Transfer, SPIE Press 2007, doi 10.1117/3.725073.
    """
    shape = _check_frames(pairs, darks, dark_exposures_s)
    planes = cfa_offsets(pattern)
    colors = []
    for positions in planes.values():
        dark = reduce_darks(darks, dark_exposures_s, positions, pattern)
        levels = [
            [
                block_statistics(a, b, black_dn=black, white_dn=white_dn, good=good, block=block)
                for a, b, black, good in zip(
                    dark.planes(pair.first), dark.planes(pair.second), *dark.levels, strict=True
                )
            ]
            for pair in pairs
        ]
        fit = fit_transfer_curve(
            [blocks for level in levels for blocks in level],
            dark_variance_dn2=dark.variance_dn2,
            dark_dof=dark.dof,
            range_dn=white_dn - dark.mean_black_dn,
        )
        room = 6.0 * np.sqrt(fit.offset_dn2 + fit.slope_dn * fit.saturation_dn)
        unsaturated = [
            max(float(b.signal.max()) for b in level) * 1.05 + room < fit.saturation_dn
            and not any(b.clipped.any() for b in level)
            for level in levels
        ]
        usable = [pair for pair, ok in zip(pairs, unsaturated, strict=True) if ok]
        if len({pair.light for pair in usable}) < 3:
            raise PhotonTransferError(
                f"photon transfer: {len(usable)} pairs lie below saturation everywhere, expected at"
                " least three amounts of light; take darker flats"
            )
        spread, field = _fixed_pattern(usable, dark, block=block, degree=flat_degree, shape=shape)
        colors.append(_ColorStatistics(fit, dark, fit_linearity(usable, dark), spread, field))
    rows = [color.numbers() for color in colors]
    numbers = {name: _quantity([row[name] for row in rows]) for name in rows[0]}
    return SensorCalibration(
        pattern=pattern,
        colors=tuple(planes),
        white_dn=white_dn,
        saturated_by=tuple(color.fit.saturated_by for color in colors),
        dark_e_per_s=numbers.pop("dark_e_per_s", None),
        flat=tuple(color.flat for color in colors),
        chi2_per_dof=tuple(color.fit.chi2_per_dof for color in colors),
        hot_pixels=sum(int((~ok).sum()) for color in colors for ok in color.dark.good),
        **numbers,
    )


def _check_frames(
    pairs: Sequence[FlatPair],
    darks: Sequence[UInt16Array],
    dark_exposures_s: Sequence[float] | None,
) -> tuple[int, int]:
    if len({pair.light for pair in pairs}) < 3:
        raise PhotonTransferError(
            f"photon transfer: got {len({p.light for p in pairs})} amounts of light, expected at"
            " least 3 (better 8)"
        )
    if len(darks) < 2:
        raise PhotonTransferError(f"photon transfer: got {len(darks)} darks, expected at least 2")
    shapes = {pair.first.shape for pair in pairs} | {dark.shape for dark in darks}
    if len(shapes) != 1:
        raise PhotonTransferError(
            f"photon transfer: frames have shapes {sorted(shapes)}, expected one shape"
        )
    if dark_exposures_s is not None and len(dark_exposures_s) != len(darks):
        raise PhotonTransferError(
            f"dark_exposures_s: got {len(dark_exposures_s)} times for {len(darks)} darks"
        )
    height, width = darks[0].shape
    return height, width


def _fixed_pattern(
    pairs: Sequence[FlatPair],
    dark: DarkStatistics,
    *,
    block: int,
    degree: int,
    shape: tuple[int, int],
) -> tuple[tuple[float, float], SmoothField]:
    """Return pixel response and flat field from the sums of all first and all second frames."""
    step = 1 if dark.pattern == "MONO" else 2
    spreads, values, rows, columns = [], [], [], []
    for position, black, good in zip(dark.positions, *dark.levels, strict=True):
        sums = []
        for frames in ([p.first for p in pairs], [p.second for p in pairs]):
            total = np.sum(
                [extract_cfa_plane(f, position, dark.pattern) - black for f in frames], axis=0
            )
            sums.append(np.where(good, total, np.nan))
        spreads.append(pixel_response(sums[0], sums[1], block=block))
        total = np.where(good, sums[0] + sums[1], 0.0)
        side = max(min(total.shape) // N_FLAT_BLOCKS, 1)
        count = block_sums(good.astype(np.float64), side)
        r, c = np.nonzero(count >= side * side / 2)
        values.append(block_sums(total, side)[r, c] / count[r, c])
        rows.append(position[0] + step * (r * side + (side - 1) / 2))
        columns.append(position[1] + step * (c * side + (side - 1) / 2))
    samples = (np.concatenate(part) for part in (values, rows, columns))
    return pool_estimates(spreads), fit_smooth_field(*samples, shape=shape, degree=degree)


@dataclass(frozen=True, slots=True, eq=False)
class _ColorStatistics:
    """Statistics of the pixels of one color."""

    fit: TransferCurveFit
    dark: DarkStatistics
    linear: tuple[float, float, float, float]
    prnu: tuple[float, float]
    flat: SmoothField

    def numbers(self) -> dict[str, tuple[float, float]]:
        """Return the quantities of `SensorCalibration`, each with its standard error."""
        fit, dark = self.fit, self.dark
        g = 1.0 / fit.slope_dn
        g_error = float(np.sqrt(fit.covariance[1, 1])) * g**2
        top = fit.saturation_dn
        top_error = float(np.sqrt(fit.offset_dn2))  # pixels differ; of the order of noise
        found = {
            "black_dn": (dark.mean_black_dn, dark.black_stderr),
            "gain_e_per_dn": (g, g_error),
            "read_noise_e": _read_noise(fit),
            "saturation_dn": (dark.mean_black_dn + top, top_error),
            "full_well_e": (top * g, float(np.hypot(top * g_error, top_error * g))),
            "nonlinearity": self.linear[:2],
            "linearity_deviation": self.linear[2:],
            "prnu": self.prnu,
            "dsnu_dn": dark.dsnu_dn,
        }
        if dark.slope_dn_per_s is not None:
            rate, rate_error = dark.slope_dn_per_s
            found["dark_e_per_s"] = (rate * g, float(np.hypot(rate_error * g, rate * g_error)))
        return found


def _read_noise(fit: TransferCurveFit) -> tuple[float, float]:
    """Return read noise in electrons: sqrt(V0 - 1/12) / K, with the error of both."""
    variance = fit.offset_dn2 - QUANTIZATION_DN2
    error = float(np.sqrt(fit.covariance[0, 0]))
    if variance <= 0:
        return 0.0, float(np.sqrt(max(error, -variance))) / fit.slope_dn
    noise = float(np.sqrt(variance)) / fit.slope_dn
    gradient = np.array([noise / (2.0 * variance), -noise / fit.slope_dn])
    return noise, float(np.sqrt(gradient @ fit.covariance @ gradient))


def _quantity(rows: Sequence[tuple[float, float]]) -> Quantity:
    value, stderr = np.array(rows, dtype=np.float64).T
    return Quantity(value, stderr)


def _combine(quantity: Quantity) -> Quantity:
    if quantity.stderr is None or not (quantity.stderr > 0).all():
        return Quantity(np.array(quantity.value.mean()))
    weight = quantity.stderr**-2
    return Quantity(
        np.array((weight * quantity.value).sum() / weight.sum()), np.array(weight.sum() ** -0.5)
    )


def fit_linearity(
    pairs: Sequence[FlatPair], dark: DarkStatistics
) -> tuple[float, float, float, float]:
    """Fit the response of one color to the amount of light.

    ``signal / light = a (1 + q light / light_max)``; the scatter is taken from the two frames of
    the pairs and from the residuals, so that the error includes a light source with poor
    repeatability.

    Parameters
    ----------
    pairs : sequence of FlatPair
        Unsaturated flats.
    dark : Darks
        Dark statistics of the same color.

    Returns
    -------
    nonlinearity, stderr : float
        q and its standard error, relative.
    deviation, deviation_stderr : float
        Largest relative deviation of one level from a straight line through zero, and the
        scatter of one level.
    """
    light = np.array([pair.light for pair in pairs])

    def level(frame: UInt16Array) -> float:
        cells = zip(dark.planes(frame), *dark.levels, strict=True)
        parts = [pixels[ok].mean() - black for pixels, black, ok in cells]
        return float(np.mean(parts))

    signals = np.array([[level(pair.first), level(pair.second)] for pair in pairs])
    response = signals.mean(axis=1) / light
    half_difference = (signals[:, 0] - signals[:, 1]) / (2.0 * signals.mean(axis=1))
    design = np.stack([np.ones_like(light), light / light.max()], axis=1)
    # an error of the black level is relatively largest for the dark levels
    weight = 1.0 / (
        1.0 + (dark.black_stderr / (signals.mean(axis=1) * max(half_difference.std(), 1e-6))) ** 2
    )
    normal = design.T @ (design * weight[:, None])
    coefficients = np.linalg.solve(normal, design.T @ (weight * response))
    misfit = response / (design @ coefficients) - 1.0
    dof = (len(pairs) - 2) + len(pairs)
    scatter = float((weight * misfit**2).sum() + (half_difference**2).sum()) / dof
    a, q = float(coefficients[0]), float(coefficients[1] / coefficients[0])
    covariance = np.linalg.inv(normal) * scatter * a**2
    gradient = np.array([-q / a, 1.0 / a])
    q_error = float(np.sqrt(gradient @ covariance @ gradient))
    straight = float((weight * response).sum() / weight.sum())
    deviation = float(np.abs(response / straight - 1.0).max())
    return q, q_error, deviation, float(np.sqrt(scatter))
