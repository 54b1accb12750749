"""A fibre probe as calibrated: gains, cross-talk and stray light, and the reflectance they give."""

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
    """Readings that a fibre probe cannot be calibrated from, or that are not this probe's."""


@dataclass(frozen=True, slots=True, eq=False)
class FiberReflectance:
    """Reflectance in each fibre, with what its errors have in common kept apart.

    Attributes
    ----------
    names : tuple of str
        Of the F fibres.
    radius_mm : ndarray of float64, shape (F,)
        Distance from the source.
    reflectance_per_mm2 : ndarray of float64, shape (F, C)
        May be negative where there is no light; 0 where not valid.
    variance : ndarray of float64, shape (F, C)
        1/mm^4, of each fibre by itself: readings, stray light, cross-talk, gain.
    common_per_mm2 : ndarray of float64, shape (T, F, C)
        One pattern for each of T causes at one standard uncertainty of it: what the phantom's
        certificate leaves uncertain, and last the error of stray light that the fibres share.
    valid : ndarray of bool, shape (F, C)
    saturated : ndarray of bool, shape (F, C)
    reasons : mapping of str to str
        By fibre: why it is not valid in some color.
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
        """Standard error of each fibre, with the common part, 1/mm^2, shape (F, C)."""
        return np.sqrt(self.variance + (self.common_per_mm2**2).sum(axis=0))

    @property
    def covariance(self) -> Float64Array:
        """Covariance of the fibres in each color, 1/mm^4, shape (C, F, F)."""
        count = len(self.names)
        own = self.variance.T[:, :, None] * np.eye(count)
        return np.asarray(own + np.einsum("tfc,tgc->cfg", self.common_per_mm2, self.common_per_mm2))


@dataclass(frozen=True, slots=True, eq=False)
class FiberCalibration:
    """Gains, cross-talk and stray light of a fibre probe.

    Attributes
    ----------
    spots : FiberSpots
        Where the fibres end in the image, and their names.
    radius_mm : ndarray of float64, shape (F,)
        Distance of each fibre from the source.
    gain, gain_stderr : ndarray of float64, shape (F, C)
        Full scales per second for a reflectance of 1/mm^2, the source at level 1; the error is of
        each fibre by itself, without cross-talk's.
    common : ndarray of float64, shape (T, F, C)
        Relative errors of all gains together, see `ExpectedReflectance.common`.
    light : ndarray of float64, shape (F, C)
        Of the phantom, unmixed, full scales per second at level 1.
    crosstalk : CrossTalk
        Its offset at level 1.
    valid : ndarray of bool, shape (F, C)
        Where the gain is known.
    dead : ndarray of bool, shape (F,)
        Fibres that give no light.
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
                f"FibreCalibration: got {len(self.spots.names)} spots and cross-talk of"
                f" {self.crosstalk.offset.shape}, expected {count} fibres in {colors} colors"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Of the fibres."""
        return self.spots.names

    def reflectance(self, readings: FiberReadings, *, level: float = 1.0) -> FiberReflectance:
        """Return the reflectance in each fibre.

        Parameters
        ----------
        readings : FiberReadings
            Of this probe, by the same apertures.
        level : float
            Of the source, 0 < level <= 1.

        Returns
        -------
        FiberReflectance

        Raises
        ------
        FiberError
            Where the readings are of other fibres or colors.

        Notes
        -----
        ``R = X^-1 (s - o) / gain``. A fibre that is saturated still leaks into its neighbors: its
        light is guessed from theirs, with an error as large as the guess.
        """
        if readings.names != self.names or readings.signal.shape != self.gain.shape:
            raise FiberError(
                f"readings: got {len(readings.names)} fibres from {readings.names[:1]} in"
                f" {readings.signal.shape[-1]} colors, expected those of the calibration,"
                f" {len(self.names)} from {self.names[:1]} in {self.gain.shape[1]}"
            )
        if not 0 < level <= 1:
            raise FiberError(f"level: got {level}, expected 0 < level <= 1")
        signal, variance, told = fill_invalid(readings)
        light, spread = self.crosstalk.unmix(signal / level, variance / level**2)
        valid = np.asarray(readings.valid & self.valid & told, np.bool_)
        gain = np.where(self.valid, self.gain, 1.0)
        ratio = np.where(self.valid, light / np.where(self.valid, self.light, 1.0), 0.0)
        spread = spread + self.crosstalk.matrix_variance(light, self.light, ratio)
        value = np.where(valid, light / gain, 0.0)
        own = spread / gain**2 + (value * self.gain_stderr / gain) ** 2
        # the phantom's light has the same error of stray light, which cancels in part
        stray = -self.crosstalk.offset_common / gain * (1.0 - ratio)
        # weighed as if each fibre's own, and once more as what moves all far fibres together
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
                reasons[name] = "dead: gives no light of the phantom"
            elif not self.spots.found[i]:
                reasons[name] = "has no spot of its own in the image"
            elif not self.valid[i].all():
                reasons[name] = (
                    "its gain is not known: too little light of the phantom, or saturated"
                )
            elif readings.saturated[i].any():
                reasons[name] = "saturated even in the shortest exposure"
            elif not readings.valid[i].all():
                reasons[name] = "too many hot pixels in its spot"
        return reasons

    def to_calibration(self, *, serial: str, **about: Unpack[Origin]) -> Calibration:
        """Return this as a `Calibration` of kind "fibre", by fibre, and of the camera.

        Parameters
        ----------
        serial
            Of the camera.
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
            " fibre of 1/mm^2 with the source at level 1",
            "crosstalk": "row: what this spot reads of each fibre's light",
            "gain_common": "relative, at one standard uncertainty of each cause",
        }
        return make_device_calibration("fibre", values, notes, **about)

    @classmethod
    def from_calibration(cls, calibration: Calibration, rig: Rig, serial: str) -> FiberCalibration:
        """Return the calibrated probe of a rig, in the rig's order.

        Raises
        ------
        CalibrationMismatch
            If the calibration is of another rig or camera, or lacks one of the rig's fibres.
        """
        if calibration.kind != "fibre" or calibration.rig != rig.name or rig.probe is None:
            raise CalibrationMismatch(
                f"calibration: got kind {calibration.kind!r} of rig {calibration.rig!r}, expected"
                f" 'fibre' of {rig.name!r}, a rig with a probe"
            )
        table = DeviceColumns(calibration, [fibre.name for fibre in rig.probe.fibres])

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
            Name of the camera behind the fibres.
        on : date, optional
            Day of use; None does not ask how old the calibration is.

        Raises
        ------
        CalibrationMissing
            If there is none.
        CalibrationMismatch, CalibrationExpired, CalibrationDamaged
            If it cannot be used.
        """
        serial = rig.view(view).serial
        found = load(folder, "fibre")
        if on is not None:
            require_valid(found, rig=rig.name, serials=[serial], on_date=on, kind="fibre")
        return cls.from_calibration(found, rig, serial)


def fill_invalid(readings: FiberReadings) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return signal and variance, those of fibres that are not valid guessed from the next ones.

    And in which colors that can be done, shape (C,): where all are saturated nothing is known of
    the light that leaks.
    """
    signal, variance = readings.signal.copy(), readings.variance.copy()
    possible = np.ones(signal.shape[1], np.bool_)
    place = np.arange(len(signal))
    for c in range(signal.shape[1]):
        told = readings.detected[:, c]
        gap = ~readings.valid[:, c]
        if not gap.any():
            continue
        if not told.any():
            possible[c] = not readings.saturated[:, c].any()
            continue
        # at the ends of the row by the slope of the two next ones
        known, value = place[told], np.log(signal[told, c])
        guess = np.interp(place, known, value)
        if len(known) > 1:
            slope = (value[1] - value[0]) / (known[1] - known[0])
            guess = np.where(place < known[0], value[0] + slope * (place - known[0]), guess)
        signal[gap, c] = np.exp(np.minimum(guess, value.max() + 10.0))[gap]
        variance[gap, c] = signal[gap, c] ** 2
    return signal, variance, possible
