"""Inputs of extreme cases: arrays of a precision, rings of lights, sheets of triangles."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skinrig.arrays import Float64Array, Int64Array


@dataclass(frozen=True, slots=True)
class InputPrecision:
    """Floating-point precision of inputs; a call converts values to it."""

    dtype: type[np.float32] | type[np.float64]

    def __call__(self, values: ArrayLike) -> NDArray[Any]:
        """Return an array of the values in this precision; a scalar stays a scalar."""
        made: Any = self.dtype(values)  # type: ignore[arg-type]
        return made

    @property
    def single(self) -> bool:
        """Whether the significand has 24 bits (float32)."""
        return self.dtype is np.float32


def ring_directions(count: int, tilt_rad: float) -> Float64Array:
    """Return unit directions (count, 3) at a tilt from +z, at equal azimuth steps.

    Examples
    --------
    >>> ring_directions(3, 0.5)[:, 2].round(3).tolist()
    [0.878, 0.878, 0.878]
    """
    azimuth = np.arange(count) * (2.0 * np.pi / count)
    radius = np.sin(tilt_rad)
    return np.stack(
        [radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(count, np.cos(tilt_rad))], -1
    )


def sheet_faces(side: int) -> Int64Array:
    """Return the triangles (2 (side - 1)^2, 3) of a square sheet of side x side points.

    Examples
    --------
    >>> sheet_faces(2).tolist()
    [[0, 1, 3], [0, 3, 2]]
    """
    cell = np.arange(side * side).reshape(side, side)
    a, b = cell[:-1, :-1].ravel(), cell[:-1, 1:].ravel()
    c, d = cell[1:, 1:].ravel(), cell[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])


def stretched_sheet(factors: tuple[float, float, float]) -> tuple[Float64Array, ...]:
    """Return points (81, 3) of a flat sheet of 40 mm, those points scaled, and UV (81, 2)."""
    u, v = (part.ravel() for part in np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)))
    flat = np.stack([40 * u, 40 * v, 0 * u], -1)
    return flat, flat * factors, np.stack([u, v], -1)
