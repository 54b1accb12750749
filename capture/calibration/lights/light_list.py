"""Calibrated lights of a rig: positions, intensities, lobes, and the cameras' responses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Unpack

import numpy as np
from numpy.typing import ArrayLike

from capture.arrays import BoolArray, Float64Array
from capture.calibration.record import (
    Calibration,
    DeviceColumns,
    Origin,
    Quantity,
    device_rows,
    freeze_arrays,
    make_device_calibration,
)
from capture.rig import Rig

_OMITTED: Any = None  # __post_init__ replaces it by an array


@dataclass(frozen=True, slots=True, eq=False)
class CameraResponse:
    """Response of a camera, relative to the mean of the rig's cameras.

    Attributes
    ----------
    gain : ndarray of float64, shape (3,)
        Per channel, 1 for the mean camera.
    vignetting : ndarray of float64, shape (2,)
        Response at distance r from the image's center, r = 1 in the corner, is ``gain (1 + v0 r^2 +
        v1 r^4)``.
    gain_stderr, vignetting_stderr : ndarray of float64, shapes (3,) and (2,)
        Standard errors.
    """

    gain: Float64Array = field(default_factory=lambda: np.ones(3))
    vignetting: Float64Array = field(default_factory=lambda: np.zeros(2))
    gain_stderr: Float64Array = field(default_factory=lambda: np.zeros(3))
    vignetting_stderr: Float64Array = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self) -> None:
        """Convert to float64 and reject invalid responses."""
        freeze_arrays(self, (3,), "gain", "gain_stderr")
        freeze_arrays(self, (2,), "vignetting", "vignetting_stderr")
        if (self.gain <= 0).any() or 1 + self.vignetting.sum() <= 0:
            raise ValueError(
                f"CameraResponse: got gain {self.gain.tolist()} and vignetting"
                f" {self.vignetting.tolist()}, expected a positive response everywhere"
            )

    def at(self, pixels: ArrayLike, image_size: tuple[int, int]) -> Float64Array:
        """Return the response at pixels, shape (..., 3).

        Parameters
        ----------
        pixels : array_like, shape (..., 2)
            Column and row in px.
        image_size : tuple of int
            Columns and rows of the image.

        Examples
        --------
        >>> dim = CameraResponse(vignetting=np.array([-0.3, 0.05]))
        >>> dim.at([[49.5, 39.5], [-0.5, -0.5]], (100, 80)).round(3).tolist()
        [[1.0, 1.0, 1.0], [0.75, 0.75, 0.75]]
        """
        size = np.array(image_size, dtype=np.float64)
        offset = np.asarray(pixels, dtype=np.float64) - (size - 1) / 2
        r2 = np.sum(offset**2, axis=-1) / np.sum((size / 2) ** 2)
        falloff = 1.0 + self.vignetting[0] * r2 + self.vignetting[1] * r2**2
        return falloff[..., None] * self.gain


@dataclass(frozen=True, slots=True, eq=False)
class LightTable:
    """The lights of a rig as the reconstruction needs them.

    A perfect Lambertian white at distance d from light l, its normal rotated by theta from the
    direction to the light, at phi off the light's axis, gives ``signal = intensity[l]
    cos(phi)**exponent[l] cos(theta) / d**2`` in camera RGB (fraction of full scale per second of
    light at level 1) to a camera of response 1.

    Attributes
    ----------
    position_mm : ndarray of float64, shape (L, 3)
        Rig frame.
    intensity : ndarray of float64, shape (L, 3)
        Camera RGB, fraction of full scale per second x mm^2, >= 0.
    exponent : ndarray of float64, shape (L,)
        Exponent of the lobe, >= 0; 0: the same in all directions.
    names : tuple of str
        Names of the lights, unique.
    axis : ndarray of float64, shape (L, 3)
        Unit vectors of the lights' axes; by default towards the rig's origin.
    valid : ndarray of bool, shape (L,)
        False for lights that must not be used (dead, or of unknown position).
    position_stderr_mm, intensity_stderr, exponent_stderr : ndarray of float64
        Standard errors, shapes as the values; 0: nominal.
    cameras : mapping of str to CameraResponse
        Responses by serial; a camera without an entry has response 1.
    """

    position_mm: Float64Array
    intensity: Float64Array
    exponent: Float64Array
    names: tuple[str, ...]
    axis: Float64Array = _OMITTED
    valid: BoolArray = _OMITTED
    position_stderr_mm: Float64Array = _OMITTED
    intensity_stderr: Float64Array = _OMITTED
    exponent_stderr: Float64Array = _OMITTED
    cameras: Mapping[str, CameraResponse] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Convert to float64 and check the arrays against each other."""
        n = len(self.names)
        if len(set(self.names)) != n or not n:
            raise ValueError(f"LightTable.names: got {self.names}, expected names that differ")
        freeze_arrays(self, (n, 3), "position_mm", "position_stderr_mm")
        freeze_arrays(self, (n, 3), "intensity", "intensity_stderr")
        freeze_arrays(self, (n,), "exponent", "exponent_stderr")
        if (self.intensity < 0).any() or (self.exponent < 0).any():
            raise ValueError("LightTable: got a negative intensity or exponent, expected >= 0")
        axis = self.axis if self.axis is not None else -self.position_mm
        object.__setattr__(self, "axis", axis)
        freeze_arrays(self, (n, 3), "axis")
        length = np.linalg.norm(self.axis, axis=-1, keepdims=True)
        if (length == 0).any():
            raise ValueError("LightTable.axis: got a zero vector, expected directions")
        object.__setattr__(self, "axis", self.axis / length)
        freeze_arrays(self, (n, 3), "axis")
        valid = np.ones(n, bool) if self.valid is None else np.array(self.valid)
        if valid.shape != (n,) or valid.dtype != bool:
            raise ValueError(
                f"LightTable.valid: got {valid.dtype} of shape {valid.shape}, expected bool of"
                f" shape {(n,)}"
            )
        valid.setflags(write=False)
        object.__setattr__(self, "valid", valid)

    @classmethod
    def nominal(cls, rig: Rig, *, white_per_s: float = 1.0) -> LightTable:
        """Return the nominal lights from the rig file.

        Parameters
        ----------
        rig : Rig
            With LEDs; a flash counts by its energy.
        white_per_s : float
            Signal per second of a perfect white at the rig's origin that faces a 1 W light. The
            rig file does not contain it, so that nominal intensities are relative. > 0.

        Examples
        --------
        >>> from capture.rig import load_rig
        >>> table = LightTable.nominal(load_rig("dome"))
        >>> to_light, white = table.irradiance([[0.0, 0.0, 0.0]])
        >>> to_light.shape, white[0, 0].round(9).tolist()
        ((150, 1, 3), [1.0, 1.0, 1.0])
        """
        if not white_per_s > 0:
            raise ValueError(f"white_per_s: got {white_per_s}, expected > 0")
        position = np.array([light.position_mm for light in rig.lights])
        strength = np.array([light.power_w or light.energy_ws for light in rig.lights], np.float64)
        intensity = white_per_s * strength * np.sum(position**2, axis=-1)
        return cls(
            position,
            np.repeat(intensity[:, None], 3, axis=1),
            np.array([light.lobe_exponent for light in rig.lights]),
            tuple(light.name for light in rig.lights),
        )

    def irradiance(self, points_mm: ArrayLike) -> tuple[Float64Array, Float64Array]:
        """Return the directions to the lights and the signal of a white that faces them.

        Parameters
        ----------
        points_mm : array_like, shape (P, 3)
            Rig frame, mm.

        Returns
        -------
        direction : ndarray of float64, shape (L, P, 3)
            Unit vectors from the points to the lights.
        normal_irradiance : ndarray of float64, shape (L, P, 3)
            ``intensity lobe / d^2``: the irradiance across the direction to the light over pi, in
            the unit of the signal. 0 behind a light.

        Raises
        ------
        ValueError
            If a point is at a light.
        """
        points = np.atleast_2d(np.asarray(points_mm, dtype=np.float64))
        to_light = self.position_mm[:, None] - points[None]
        distance = np.linalg.norm(to_light, axis=-1, keepdims=True)
        if (distance == 0).any():
            raise ValueError("points_mm: got a point at a light, expected points elsewhere")
        direction = to_light / distance
        cosine = np.clip(-np.einsum("lpk,lk->lp", direction, self.axis), 0.0, None)
        lobe = cosine ** self.exponent[:, None]
        lobe[cosine == 0] = 0.0
        return direction, self.intensity[:, None] * (lobe[..., None] / distance**2)

    def response(self, serial: str, pixels: ArrayLike, image_size: tuple[int, int]) -> Float64Array:
        """Return a camera's response at pixels, shape (..., 3); see `CameraResponse.at`."""
        return self.cameras.get(serial, CameraResponse()).at(pixels, image_size)

    def to_calibration(self, **about: Unpack[Origin]) -> Calibration:
        """Return this as a `Calibration` of kind "lights", keyed by light and camera serial."""
        values = device_rows(
            self.names,
            position_mm=(self.position_mm, self.position_stderr_mm),
            axis=self.axis,
            intensity=(self.intensity, self.intensity_stderr),
            exponent=(self.exponent, self.exponent_stderr),
            valid=self.valid,
        )
        for serial, camera in self.cameras.items():
            values[serial] = {
                "gain": Quantity(camera.gain, camera.gain_stderr),
                "vignetting": Quantity(camera.vignetting, camera.vignetting_stderr),
            }
        notes = {"unit": "intensity: fraction of full scale per second x mm^2 for a perfect white"}
        return make_device_calibration("lights", values, notes, **about)

    @classmethod
    def from_calibration(cls, calibration: Calibration, rig: Rig) -> LightTable:
        """Return the calibrated lights of a rig, in the rig's order.

        Raises
        ------
        CalibrationMismatch
            If the calibration lacks a light of the rig.
        """
        cameras = {}
        for view in rig.views:
            if view.serial in calibration.values:
                gain = calibration.quantity(view.serial, "gain")
                vignetting = calibration.quantity(view.serial, "vignetting")
                cameras[view.serial] = CameraResponse(
                    gain.value, vignetting.value, gain.stderr_or_zero, vignetting.stderr_or_zero
                )
        table = DeviceColumns(calibration, [light.name for light in rig.lights])
        return cls(
            table.values("position_mm"),
            table.values("intensity"),
            table.values("exponent"),
            table.names,
            table.values("axis"),
            table.flags("valid"),
            table.errors("position_mm"),
            table.errors("intensity"),
            table.errors("exponent"),
            cameras,
        )
