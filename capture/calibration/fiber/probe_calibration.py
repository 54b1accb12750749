"""Calibration of a fiber probe: gains, cross-talk, stray light, and reflectance from readings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date
from pathlib import Path
from typing import Unpack

import numpy as np

from capture.arrays import BoolArray, Float64Array
from capture.calibration.fiber.crosstalk import CrossTalk
from capture.calibration.fiber.readings import FiberReadings
from capture.calibration.fiber.spots import FiberSpots
from capture.calibration.record import (
    Calibration,
    CalibrationError,
    CalibrationMismatch,
    DeviceColumns,
    Origin,
    Quantity,
    device_rows,
    freeze_arrays,
    make_device_calibration,
)
from capture.calibration.store import load
from capture.calibration.validity import require_valid
from capture.rig import Rig


class FiberError(CalibrationError):
    """Raised for readings that cannot calibrate a fiber probe, or are of another probe."""


@dataclass(frozen=True, slots=True, eq=False)
class FiberReflectance:
    """Reflectance in each fiber, with the common part of its errors kept separate.

    Attributes
    ----------
    names : tuple of str
        Names of the F fibers.
    radius_mm : ndarray of float64, shape (F,)
        Distance from the source.
    reflectance_per_mm2 : ndarray of float64, shape (F, C)
        May be negative for a fiber without light; 0 where not valid.
    variance : ndarray of float64, shape (F, C)
        1/mm^4, independent between fibers: readings, stray light, cross-talk, gain.
    common_per_mm2 : ndarray of float64, shape (T, F, C)
        One pattern for each of T causes at one standard uncertainty: the phantom's certificate, and
        last the common error of stray light.
    valid : ndarray of bool, shape (F, C)
    saturated : ndarray of bool, shape (F, C)
    reasons : mapping of str to str
        Reason by fiber why it is not valid in some color.
    """

    names: tuple[str, ...]
    radius_mm: Float64Array
    reflectance_per_mm2: Float64Array
    variance: Float64Array
    common_per_mm2: Float64Array
    valid: BoolArray
    saturated: BoolArray
    reasons: Mapping[str, str] = field(default_factory=dict)

    @property
    def stderr(self) -> Float64Array:
        """Standard error of each fiber, common part included, 1/mm^2, shape (F, C)."""
        return np.sqrt(self.variance + (self.common_per_mm2**2).sum(axis=0))

    @property
    def covariance(self) -> Float64Array:
        """Covariance of the fibers in each color, 1/mm^4, shape (C, F, F)."""
        count = len(self.names)
        own = self.variance.T[:, :, None] * np.eye(count)
        return np.asarray(own + np.einsum("tfc,tgc->cfg", self.common_per_mm2, self.common_per_mm2))


@dataclass(frozen=True, slots=True, eq=False)
class FiberCalibration:
    """Gains, cross-talk and stray light of a fiber probe.

    Attributes
    ----------
    spots : FiberSpots
        Positions of the fibers' ends in the image, and their names.
    radius_mm : ndarray of float64, shape (F,)
        Distance of each fiber from the source.
    gain, gain_stderr : ndarray of float64, shape (F, C)
        Full scales per second for a reflectance of 1/mm^2, the source at level 1; the error is
        independent between fibers, without that of cross-talk.
    common : ndarray of float64, shape (T, F, C)
        Relative errors common to all gains, see `ExpectedReflectance.common`.
    light : ndarray of float64, shape (F, C)
        Light of the phantom, unmixed, full scales per second at level 1.
    crosstalk : CrossTalk
        Cross-talk, with the offset at level 1.
    valid : ndarray of bool, shape (F, C)
        Fibers and colors with a known gain.
    dead : ndarray of bool, shape (F,)
        Fibers without light.
    """

    spots: FiberSpots
    radius_mm: Float64Array
    gain: Float64Array
    gain_stderr: Float64Array
    common: Float64Array
    light: Float64Array
    crosstalk: CrossTalk
    valid: BoolArray
    dead: BoolArray

    def __post_init__(self) -> None:
        """Convert and check the arrays against each other."""
        count, colors = np.shape(self.gain)
        freeze_arrays(self, (count,), "radius_mm")
        freeze_arrays(self, (count, colors), "gain", "gain_stderr", "light")
        freeze_arrays(self, (len(self.common), count, colors), "common")
        freeze_arrays(self, (count, colors), "valid", kind=np.bool_)
        freeze_arrays(self, (count,), "dead", kind=np.bool_)
        if len(self.spots.names) != count or self.crosstalk.offset.shape != (count, colors):
            raise ValueError(
                f"FiberCalibration: got {len(self.spots.names)} spots and cross-talk of "
                f"{self.crosstalk.offset.shape}, expected {count} fibers in {colors} colors"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the fibers."""
        return self.spots.names

    def reflectance(self, readings: FiberReadings, *, level: float = 1.0) -> FiberReflectance:
        """Return the reflectance in each fiber.

        Parameters
        ----------
        readings : FiberReadings
            Readings of this probe, by the same apertures.
        level : float
            Drive level of the source, 0 < level <= 1.

        Returns
        -------
        FiberReflectance

        Raises
        ------
        FiberError
            When the readings are of other fibers or colors.

        Notes
        -----
        ``R = X^-1 (s - o) / gain``. A saturated fiber still leaks into its neighbors: its light is
        interpolated from theirs, with an error as large as the estimate.
        """
        if readings.names != self.names or readings.signal.shape != self.gain.shape:
            raise FiberError(
                f"readings: got {len(readings.names)} fibers from {readings.names[:1]} in "
                f"{readings.signal.shape[-1]} colors, expected those of the calibration, "
                f"{len(self.names)} from {self.names[:1]} in {self.gain.shape[1]}; read this "
                "probe's frames again"
            )
        if not 0 < level <= 1:
            raise FiberError(f"level: got {level}, expected 0 < level <= 1")
        signal, variance, possible = fill_invalid(readings)
        light, spread = self.crosstalk.unmix(signal / level, variance / level**2)
        valid = np.asarray(readings.valid & self.valid & possible, np.bool_)
        gain = np.where(self.valid, self.gain, 1.0)
        ratio = np.where(self.valid, light / np.where(self.valid, self.light, 1.0), 0.0)
        spread = spread + self.crosstalk.matrix_variance(light, self.light, ratio)
        value = np.where(valid, light / gain, 0.0)
        own = spread / gain**2 + (value * self.gain_stderr / gain) ** 2
        # the phantom's light has the same error of stray light, which cancels in part
        stray = -self.crosstalk.offset_common / gain * (1.0 - ratio)
        # counted as independent per fiber, and again as the part that moves all far fibers together
        mixed = self.crosstalk.shared_changes(light, self.light, ratio) / gain
        common = np.concatenate([value * self.common, stray[None], mixed])
        return FiberReflectance(
            self.names,
            self.radius_mm,
            value,
            np.where(valid, own, 0.0),
            np.where(valid, common, 0.0),
            valid,
            readings.saturated,
            self._reasons(readings),
        )

    def _reasons(self, readings: FiberReadings) -> dict[str, str]:
        reasons = {}
        for i, name in enumerate(self.names):
            if self.dead[i]:
                reasons[name] = "dead: no light from the phantom"
            elif not self.spots.found[i]:
                reasons[name] = "has no spot of its own in the image"
            elif not self.valid[i].all():
                reasons[name] = (
                    "its gain is not known: too little light from the phantom, or saturated"
                )
            elif readings.saturated[i].any():
                reasons[name] = "saturated even in the shortest exposure"
            elif not readings.valid[i].all():
                reasons[name] = "too many hot pixels in its spot"
        return reasons

    def to_calibration(self, *, serial: str, **about: Unpack[Origin]) -> Calibration:
        """Return this as a `Calibration` of kind "fiber", keyed by fiber and camera.

        Parameters
        ----------
        serial
            Serial number of the camera.
        rig, source, created
            As in `Calibration`.
        **about
            ``valid_until``, ``notes``, ``inputs``, ``versions`` of `Calibration`.
        """
        spots, mixed = self.spots, self.crosstalk
        values = device_rows(
            self.names,
            spot_px=(spots.center_px, spots.center_stderr_px),
            spot_radius_px=(spots.radius_px, spots.radius_stderr_px),
            spot_edge_px=spots.edge_px,
            found=spots.found,
            radius_mm=self.radius_mm,
            gain=(self.gain, self.gain_stderr),
            gain_common=self.common.transpose(1, 0, 2),
            phantom_light=self.light,
            stray=(mixed.offset, mixed.offset_stderr),
            stray_common=mixed.offset_common,
            crosstalk=(mixed.matrix, mixed.stderr),
            valid=self.valid,
            dead=self.dead,
        )
        values[serial] = {
            "aperture_px": Quantity(np.array(spots.aperture_px)),
            "row_shift_px": Quantity(np.array(spots.shift_px)),
            "row_rotation_rad": Quantity(np.array(spots.rotation_rad)),
            "crosstalk_measured": Quantity(np.array(mixed.measured)),
            "cover_leak": Quantity(np.array(mixed.cover_leak), np.array(mixed.cover_leak_stderr)),
        }
        notes = {
            "unit": "gain: full scales per second, summed over a spot, for a reflectance in the"
            " fiber of 1/mm^2 with the source at level 1",
            "crosstalk": "row: what this spot reads of each fiber's light",
            "gain_common": "relative, at one standard uncertainty of each cause",
        }
        return make_device_calibration("fiber", values, notes, **about)

    @classmethod
    def from_calibration(cls, calibration: Calibration, rig: Rig, serial: str) -> FiberCalibration:
        """Return the calibrated probe of a rig, in the rig's order.

        Raises
        ------
        CalibrationMismatch
            If the calibration is of another rig or camera, or lacks one of the rig's fibers.
        """
        if calibration.kind != "fiber" or calibration.rig != rig.name or rig.probe is None:
            raise CalibrationMismatch(
                f"calibration: got kind {calibration.kind!r} of rig {calibration.rig!r}, "
                f"expected 'fiber' of {rig.name!r}, a rig with a probe"
            )
        table = DeviceColumns(calibration, [fiber.name for fiber in rig.probe.fibers])

        def camera(name: str) -> Float64Array:
            return calibration.quantity(serial, name).value

        shift, leak = camera("row_shift_px"), calibration.quantity(serial, "cover_leak")
        discs = (
            *table.values_and_errors("spot_px"),
            *table.values_and_errors("spot_radius_px"),
            table.values("spot_edge_px"),
        )
        moved = float(shift[0]), float(shift[1])
        aperture_px, turned = float(camera("aperture_px")), float(camera("row_rotation_rad"))
        spots = FiberSpots(table.names, *discs, table.flags("found"), aperture_px, moved, turned)
        mixing = (
            *table.values_and_errors("crosstalk"),
            *table.values_and_errors("stray"),
            table.values("stray_common"),
        )
        leaks = float(leak.value), float(leak.stderr_or_zero)
        mixed = CrossTalk(*mixing, bool(camera("crosstalk_measured")), *leaks)
        gains = *table.values_and_errors("gain"), table.values("gain_common").transpose(1, 0, 2)
        flags = table.flags("valid"), table.flags("dead")
        light = table.values("phantom_light")
        return cls(spots, table.values("radius_mm"), *gains, light, mixed, *flags)

    @classmethod
    def load(
        cls, folder: str | Path, rig: Rig, *, view: str = "cam", on: date | None = None
    ) -> FiberCalibration:
        """Return the calibrated probe of a rig from a CALIBRATION/ folder.

        Parameters
        ----------
        folder : str or Path
        rig : Rig
        view : str
            Name of the camera behind the fibers.
        on : date, optional
            Day of use; None skips the check of the validity.

        Raises
        ------
        CalibrationMissing
            If there is none.
        CalibrationMismatch, CalibrationExpired, CalibrationDamaged
            If it cannot be used.
        """
        serial = rig.view(view).serial
        found = load(folder, "fiber")
        if on is not None:
            require_valid(found, rig=rig.name, serials=[serial], on_date=on, kind="fiber")
        return cls.from_calibration(found, rig, serial)


def fill_invalid(readings: FiberReadings) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Fill signal and variance of invalid fibers from their neighbors.

    Also returns the colors in which that is possible, shape (C,): where all fibers are saturated
    the leaking light is unknown.
    """
    signal, variance = readings.signal.copy(), readings.variance.copy()
    possible = np.ones(signal.shape[1], np.bool_)
    place = np.arange(len(signal))
    for c in range(signal.shape[1]):
        detected = readings.detected[:, c]
        gap = ~readings.valid[:, c]
        if not gap.any():
            continue
        if not detected.any():
            possible[c] = not readings.saturated[:, c].any()
            continue
        # at the ends of the row, extrapolate by the slope of the next two
        known, value = place[detected], np.log(signal[detected, c])
        guess = np.interp(place, known, value)
        if len(known) > 1:
            slope = (value[1] - value[0]) / (known[1] - known[0])
            guess = np.where(place < known[0], value[0] + slope * (place - known[0]), guess)
        signal[gap, c] = np.exp(np.minimum(guess, value.max() + 10.0))[gap]
        variance[gap, c] = signal[gap, c] ** 2
    return signal, variance, possible
