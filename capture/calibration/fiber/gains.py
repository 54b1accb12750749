"""Calibrate the gains of a fiber probe on a phantom of known optics."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from capture.arrays import FloatArray
from capture.calibration.fiber.crosstalk import measure_crosstalk, no_crosstalk
from capture.calibration.fiber.phantom import ExpectedReflectance
from capture.calibration.fiber.probe_calibration import FiberCalibration, FiberError, fill_invalid
from capture.calibration.fiber.readings import FiberReadings
from capture.calibration.fiber.spots import FiberSpots

DEAD_FIBER_GAIN: Final = 0.05
"""Fraction of the usual gain below which a fiber is dead."""
MIN_GAIN_SIGMAS: Final = 3.0
"""Smallest gain over its standard error."""


def calibrate_fibers(
    phantom: FiberReadings,
    masks: Mapping[int, FiberReadings],
    *,
    spots: FiberSpots,
    radius_mm: FloatArray | tuple[float, ...],
    expected: ExpectedReflectance,
    level: float = 1.0,
) -> FiberCalibration:
    """Calibrate a probe from its readings of a phantom of known optics.

    Parameters
    ----------
    phantom : FiberReadings
        Readings with all fibers uncovered.
    masks : mapping of int to FiberReadings
        Readings with one fiber uncovered, by its number, on the same phantom; empty: cross-talk and
        stray light are taken as zero.
    spots : FiberSpots
        Apertures of all readings.
    radius_mm : array_like, shape (F,)
        Distance of each fiber from the source.
    expected : ExpectedReflectance
        Expected reflectance of the phantom in each fiber.
    level : float
        Drive level of the source in all readings, 0 < level <= 1.

    Returns
    -------
    FiberCalibration

    Raises
    ------
    FiberError
        When the shapes do not match, or no fiber has light.
    """
    count, colors = phantom.signal.shape
    if expected.per_mm2.shape != (count, colors) or len(spots.names) != count:
        raise FiberError(
            f"expected reflectance: got shape {expected.per_mm2.shape} and {len(spots.names)}"
            f" spots, expected those of the readings, {(count, colors)}"
        )
    if not 0 < level <= 1:
        raise FiberError(f"level: got {level}, expected 0 < level <= 1")
    mixed = measure_crosstalk(masks, phantom) if masks else no_crosstalk(count, colors)
    signal, variance, possible = fill_invalid(phantom)
    light, spread = mixed.unmix(signal, variance)
    doubt = mixed.matrix_variance(light, light, np.zeros_like(light))
    error = np.sqrt(spread + doubt + mixed.offset_common**2)
    gain = light / expected.per_mm2
    bright = np.asarray(phantom.valid & possible & (light > MIN_GAIN_SIGMAS * error), np.bool_)
    usual = np.array([np.median(g[b]) if b.any() else 0.0 for g, b in zip(gain.T, bright.T)])  # noqa: B905
    if phantom.saturated.all():
        raise FiberError(
            "phantom: all fibers are saturated in every exposure; take shorter ones, or a lower "
            "level of the source"
        )
    if not (usual > 0).any():
        raise FiberError(
            "phantom: no fiber has light; check the source, its shutter, the head's contact "
            "with the phantom, and the exposures"
        )
    most = (light + MIN_GAIN_SIGMAS * error) / expected.per_mm2
    dim = np.asarray(phantom.valid & (most < DEAD_FIBER_GAIN * usual), np.bool_)
    dead = np.asarray(dim.any(axis=1) & ~bright.any(axis=1), np.bool_)
    valid = np.asarray(bright & spots.found.reshape(-1, 1), np.bool_)
    relative = np.hypot(
        np.sqrt(spread) / np.where(valid, light, 1.0), expected.stderr / expected.per_mm2
    )
    offsets = ("offset", "offset_stderr", "offset_common")
    mixed = replace(mixed, **{name: getattr(mixed, name) / level for name in offsets})
    errors = np.where(valid, relative * gain / level, 0.0), expected.common
    gain = np.where(valid, gain / level, 0.0)
    radius = np.asarray(radius_mm, np.float64)
    return FiberCalibration(spots, radius, gain, *errors, light / level, mixed, valid, dead)
