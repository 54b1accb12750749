"""Calibrated lights of a polarized sphere: directions, intensities, polarizers, and leakage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Unpack

import numpy as np

from capture.arrays import BoolArray, Float64Array
from capture.calibration.record import (
    Calibration,
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


@dataclass(frozen=True, slots=True, eq=False)
class SphereLightTable:
    """Directions and intensities of the lights.

    Attributes
    ----------
    names : tuple of str
        Names in the rig's order.
    directions : ndarray of float64, shape (L, 3)
        Unit vectors from the rig's origin.
    directions_stderr : ndarray of float64, shape (L, 3)
        Standard errors; the error of the ball's position is common to them.
    intensities, intensities_stderr : ndarray of float64, shape (L,)
        Irradiance at the origin, over the mean of the valid lights.
    seen : ndarray of bool, shape (L,)
        Lights with a measured direction; the others are nominal.
    valid : ndarray of bool, shape (L,)
        Lights with a measured intensity; the others are nominal, 1.
    dead : ndarray of bool, shape (L,)
        Lights that did not shine; they are valid, with an intensity near 0.
    """

    names: tuple[str, ...]
    directions: Float64Array
    directions_stderr: Float64Array
    intensities: Float64Array
    intensities_stderr: Float64Array
    seen: BoolArray
    valid: BoolArray
    dead: BoolArray

    def __post_init__(self) -> None:
        """Convert and check the arrays against each other."""
        n = len(self.names)
        of = f" for {n} lights"
        freeze_arrays(self, (n, 3), "directions", "directions_stderr", owner=of)
        freeze_arrays(self, (n,), "intensities", "intensities_stderr", owner=of)
        freeze_arrays(self, (n,), "seen", "valid", "dead", kind=np.bool_, owner=of)
        length = np.linalg.norm(self.directions, axis=1)
        if (np.abs(length - 1) > 1e-6).any():
            raise ValueError("SphereLightTable.directions: expected unit vectors")
        for name in ("directions_stderr", "intensities_stderr"):
            if (getattr(self, name) < 0).any():
                raise ValueError(f"SphereLightTable.{name}: got a negative number, expected >= 0")

    @classmethod
    def nominal(cls, rig: Rig) -> SphereLightTable:
        """Return the nominal lights from the rig file, errors 0, all with equal intensity.

        Examples
        --------
        >>> from capture.rig import load_rig
        >>> table = SphereLightTable.nominal(load_rig("gradient"))
        >>> table.directions[0].round(3).tolist(), float(table.intensities.mean())
        ([-0.173, -0.073, 0.982], 1.0)
        """
        place = np.array([light.position_mm for light in rig.lights], np.float64)
        strength = np.array([light.power_w or 0.0 for light in rig.lights])
        strength = strength / np.sum(place**2, axis=1)
        n = len(rig.lights)
        names = tuple(light.name for light in rig.lights)
        directions = place / np.linalg.norm(place, axis=1, keepdims=True)
        flags = [np.zeros(n, bool)] * 3
        strengths = strength / strength.mean()
        return cls(names, directions, np.zeros((n, 3)), strengths, np.zeros(n), *flags)

    def to_calibration(
        self, *, ball: Mapping[str, Quantity] | None = None, **about: Unpack[Origin]
    ) -> Calibration:
        """Return this as a `Calibration` of kind "lights", keyed by light.

        Parameters
        ----------
        rig, source, created
            As in `Calibration`.
        ball : mapping of str to Quantity, optional
            Ball of the target, stored under the serial "ball".
        **about
            ``valid_until``, ``notes``, ``inputs``, ``versions`` of `Calibration`.
        """
        values = device_rows(
            self.names,
            direction=(self.directions, self.directions_stderr),
            intensity=(self.intensities, self.intensities_stderr),
            seen=self.seen,
            valid=self.valid,
            dead=self.dead,
        )
        if ball:
            values["ball"] = dict(ball)
        notes = {"unit": "intensity: light at the origin over the mean of the measured lights"}
        return make_device_calibration("lights", values, notes, **about)

    @classmethod
    def from_calibration(cls, calibration: Calibration, rig: Rig) -> SphereLightTable:
        """Return the calibrated lights of a rig, in the rig's order.

        Raises
        ------
        CalibrationMismatch
            If the calibration is of another rig or lacks one of its lights.
        """
        table = _columns(calibration, rig, "lights")
        return cls(
            table.names,
            *table.values_and_errors("direction"),
            *table.values_and_errors("intensity"),
            table.flags("seen"),
            table.flags("valid"),
            table.flags("dead"),
        )


@dataclass(frozen=True, slots=True, eq=False)
class SpherePolarizers:
    """Leakage of the polarizers, measured on glass and predicted for skin.

    Attributes
    ----------
    names : tuple of str
    leakage, leakage_stderr : ndarray of float64, shape (L,)
        Specular reflection of each light by a surface of index `eta`: crossed over parallel.
    glass_leakage, glass_leakage_stderr : ndarray of float64, shape (L,)
        Leakage on the ball, as measured.
    axis_error_rad, axis_error_stderr_rad : ndarray of float64, shape (L,)
        Deviation of each light's polarizer from its nominal axis.
    valid : ndarray of bool, shape (L,)
        Lights with measured leakage on glass; for the others `axis_error_rad` is the prior's width,
        and `leakage` follows from the polarizers alone.
    misalignment_rad, misalignment_stderr_rad : float
        True angle of the analyzer minus its reading.
    light_leak, light_leak_stderr, analyzer_leak, analyzer_leak_stderr : float
        Inverse extinction ratios of the polarizers.
    eta : float
        Refractive index of the surface of `leakage`.
    """

    names: tuple[str, ...]
    leakage: Float64Array
    leakage_stderr: Float64Array
    glass_leakage: Float64Array
    glass_leakage_stderr: Float64Array
    axis_error_rad: Float64Array
    axis_error_stderr_rad: Float64Array
    valid: BoolArray
    misalignment_rad: float
    misalignment_stderr_rad: float
    light_leak: float
    light_leak_stderr: float
    analyzer_leak: float
    analyzer_leak_stderr: float
    eta: float

    def __post_init__(self) -> None:
        """Convert and check the arrays against each other."""
        n = len(self.names)
        arrays = (*_LEAKAGE_FIELDS, *(f"{name}_stderr" for name in _LEAKAGE_FIELDS[:2]))
        of = f" for {n} lights"
        freeze_arrays(self, (n,), *arrays, "axis_error_stderr_rad", owner=of)
        freeze_arrays(self, (n,), "valid", kind=np.bool_, owner=of)
        if (self.leakage < 0).any() or not self.eta > 1:
            raise ValueError("SphereFilms: got a leakage < 0 or eta <= 1, expected >= 0 and > 1")

    def to_calibration(self, *, serial: str, **about: Unpack[Origin]) -> Calibration:
        """Return this as a `Calibration` of kind "polarization", keyed by light and camera.

        Parameters
        ----------
        serial
            Serial number of the camera behind the analyzer.
        rig, source, created, **about
            As in `SphereLightTable.to_calibration`.
        """
        values = device_rows(
            self.names,
            leakage=(self.leakage, self.leakage_stderr),
            glass_leakage=(self.glass_leakage, self.glass_leakage_stderr),
            axis_error_rad=(self.axis_error_rad, self.axis_error_stderr_rad),
            valid=self.valid,
        )
        values[serial] = {
            "analyzer_zero_rad": _one(self.misalignment_rad, self.misalignment_stderr_rad),
            "light_leak": _one(self.light_leak, self.light_leak_stderr),
            "analyzer_leak": _one(self.analyzer_leak, self.analyzer_leak_stderr),
            "eta": Quantity(np.array(self.eta)),
        }
        notes = {
            "leakage": "of a mirror reflection into the camera, crossed over parallel",
            "analyzer_zero": "true angle of the analyzer less its reading; from +x towards +y",
        }
        return make_device_calibration("polarization", values, notes, **about)

    @classmethod
    def from_calibration(cls, calibration: Calibration, rig: Rig, serial: str) -> SpherePolarizers:
        """Return the calibrated polarizers of a rig and one of its cameras, in the rig's order.

        Raises
        ------
        CalibrationMismatch
            If the calibration is of another rig or camera, or lacks one of the rig's lights.
        """
        table = _columns(calibration, rig, "polarization")
        leakage, glass, axis = (table.values_and_errors(name) for name in _LEAKAGE_FIELDS)
        zero, light, analyzer = (
            calibration.quantity(serial, name)
            for name in ("analyzer_zero_rad", "light_leak", "analyzer_leak")
        )
        return cls(
            table.names,
            *leakage,
            *glass,
            *axis,
            table.flags("valid"),
            *_pair(zero),
            *_pair(light),
            *_pair(analyzer),
            float(calibration.quantity(serial, "eta").value),
        )


_LEAKAGE_FIELDS = ("leakage", "glass_leakage", "axis_error_rad")


@dataclass(frozen=True, slots=True, eq=False)
class SphereCalibration:
    """Calibration of a polarized sphere, from a CALIBRATION/ folder.

    Attributes
    ----------
    lights : SphereLightTable
    polarizers : SphereFilms
    """

    lights: SphereLightTable
    polarizers: SpherePolarizers

    @classmethod
    def load(
        cls, folder: str | Path, rig: Rig, *, view: str = "cam", on: date | None = None
    ) -> SphereCalibration:
        """Return the calibrated sphere of a rig from a CALIBRATION/ folder.

        Parameters
        ----------
        folder : str or Path
        rig : Rig
            Its lights are returned, in its order.
        view : str
            Name of the camera behind the analyzer.
        on : date, optional
            Day of use; None skips the check of the validity.

        Raises
        ------
        CalibrationMissing
            If a kind is missing.
        CalibrationMismatch, CalibrationExpired, CalibrationDamaged
            If one cannot be used.
        """
        serial = rig.view(view).serial
        names = [light.name for light in rig.lights]
        lights, films = load(folder, "lights"), load(folder, "polarization")
        if on is not None:
            require_valid(lights, rig=rig.name, serials=names, on_date=on, kind="lights")
            serials = [*names, serial]
            require_valid(films, rig=rig.name, serials=serials, on_date=on, kind="polarization")
        return cls(
            SphereLightTable.from_calibration(lights, rig),
            SpherePolarizers.from_calibration(films, rig, serial),
        )

    @property
    def usable(self) -> BoolArray:
        """Lights of measured intensity that shine, shape (L,)."""
        return self.lights.valid & ~self.lights.dead


def _columns(calibration: Calibration, rig: Rig, kind: str) -> DeviceColumns:
    """Return the quantities of a rig's lights; reject another kind or rig."""
    if calibration.kind != kind or calibration.rig != rig.name:
        raise CalibrationMismatch(
            f"calibration: got kind {calibration.kind!r} of rig {calibration.rig!r}, expected"
            f" {kind!r} of {rig.name!r}"
        )
    return DeviceColumns(calibration, [light.name for light in rig.lights])


def _one(value: float, stderr: float) -> Quantity:
    return Quantity(np.array(value), np.array(stderr))


def _pair(quantity: Quantity) -> tuple[float, float]:
    return float(quantity.value), float(quantity.stderr_or_zero)
