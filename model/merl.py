"""Read and write MERL .binary tables of isotropic BRDFs, and convert half/difference angles.

References
----------
Matusik et al. 2003, doi:10.1145/882262.882343 (tables).
Rusinkiewicz 1998, doi:10.1007/978-3-7091-6453-2_2 (angles).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import BoolArray, Float64Array
from model.checks import Checks

TABLE_SHAPE = (90, 90, 180)
"""Bins over theta_h, theta_d and phi_d."""
BRDF_SCALE = np.array([1.0, 1.15, 1.66]) / 1500.0
"""BRDF in 1/sr per stored unit, red, green, blue."""
UNMEASURED_VALUE = -1.0
"""Stored where the BRDF was not measured; readers accept any negative value."""
FILE_BYTES = 12 + 3 * 8 * 90 * 90 * 180

_HALF_PI = 0.5 * np.pi


class MerlFileError(ValueError):
    """Error for a file that is not a MERL table, or only part of one."""


@dataclass(frozen=True, slots=True)
class MerlTable:
    """An isotropic BRDF, one value per bin and channel.

    Attributes
    ----------
    stored : ndarray of float64, shape (3, 90, 90, 180)
        As in the file: times :data:`BRDF_SCALE` it is the BRDF in 1/sr; channels red, green, blue;
        then theta_h, theta_d, phi_d. Negative: not measured.
    """

    stored: Float64Array

    def __post_init__(self) -> None:
        """Check the shape."""
        Checks().shape("MerlTable.stored", self.stored, (3, *TABLE_SHAPE))

    @classmethod
    def from_values(cls, values: ArrayLike) -> MerlTable:
        """Make a table of BRDF values in 1/sr, (90, 90, 180, 3) or broadcast.

        A negative value in any channel means not measured: -1 is stored for all three.
        """
        brdf = np.broadcast_to(np.asarray(values, dtype=np.float64), (*TABLE_SHAPE, 3))
        none = np.any(brdf < 0.0, axis=-1)
        stored = np.empty((3, *TABLE_SHAPE))
        for channel, scale in enumerate(BRDF_SCALE):
            np.divide(brdf[..., channel], scale, out=stored[channel])
            stored[channel][none] = UNMEASURED_VALUE
        return cls(stored)

    def lookup(self, theta_h: ArrayLike, theta_d: ArrayLike, phi_d: ArrayLike) -> Float64Array:
        """Return the BRDF of the nearest bin.

        Parameters
        ----------
        theta_h, theta_d
            Half and difference angle, rad, in [0, pi/2]; broadcast together.
        phi_d
            Azimuth of the difference, rad, in [-2 pi, 2 pi]; phi_d and phi_d + pi are the same by
            reciprocity.

        Returns
        -------
        ndarray, shape (..., 3)
            1/sr; negative where not measured.

        Raises
        ------
        ValueError
            For angles out of range or not finite, and shapes that do not broadcast.
        """
        h, d, phi = bin_indices(
            *Checks().broadcast_together(theta_h=theta_h, theta_d=theta_d, phi_d=phi_d)
        )
        return np.asarray(np.moveaxis(self.stored[:, h, d, phi], 0, -1) * BRDF_SCALE)

    @property
    def measured(self) -> BoolArray:
        """Return the bins measured in all channels, (90, 90, 180)."""
        return np.asarray(np.all(self.stored >= 0.0, axis=0))


def bin_indices(
    theta_h: ArrayLike, theta_d: ArrayLike, phi_d: ArrayLike
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return the bin of each angle; theta_h's bins are spaced by its square root.

    Examples
    --------
    >>> [int(i) for i in bin_indices(0.0, 0.0, -3.141592)]
    [0, 0, 0]
    """
    h = np.asarray(theta_h, dtype=np.float64)
    d = np.asarray(theta_d, dtype=np.float64)
    azimuth = np.asarray(phi_d, dtype=np.float64)
    for name, angle in (("theta_h", h), ("theta_d", d)):
        Checks().within(f"{name}, rad", angle, f"[0, {_HALF_PI + 1e-6}]")
    Checks().within("phi_d", azimuth)
    phi = np.mod(azimuth, np.pi)
    index_h = np.minimum(
        (TABLE_SHAPE[0] * np.sqrt(h / _HALF_PI)).astype(np.intp), TABLE_SHAPE[0] - 1
    )
    index_d = np.minimum((TABLE_SHAPE[1] * d / _HALF_PI).astype(np.intp), TABLE_SHAPE[1] - 1)
    index_phi = np.minimum((TABLE_SHAPE[2] * phi / np.pi).astype(np.intp), TABLE_SHAPE[2] - 1)
    return index_h, index_d, index_phi


def bin_centers() -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return theta_h (90), theta_d (90) and phi_d (180) at the middles of the bins, rad."""
    h = ((np.arange(TABLE_SHAPE[0]) + 0.5) / TABLE_SHAPE[0]) ** 2 * _HALF_PI
    d = (np.arange(TABLE_SHAPE[1]) + 0.5) / TABLE_SHAPE[1] * _HALF_PI
    phi = (np.arange(TABLE_SHAPE[2]) + 0.5) / TABLE_SHAPE[2] * np.pi
    return h, d, phi


def to_angles(
    light_dir: ArrayLike, view_dir: ArrayLike, normal: ArrayLike
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return half and difference angles of directions at a surface.

    Parameters
    ----------
    light_dir, view_dir, normal
        Unit vectors (..., 3) in one frame, away from the surface; broadcast together.

    Returns
    -------
    theta_h, theta_d, phi_d : ndarray, shape (...)
        rad; phi_d in (-pi, pi], 0 where it is undefined (half vector at the normal, or light equal
        to view). The difference vector is the light, as in the tables' definition.
    """
    light, view, n = np.broadcast_arrays(
        *(np.asarray(v, dtype=np.float64) for v in (light_dir, view_dir, normal))
    )
    total = light + view
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    half = np.where(length > 0.0, total / np.where(length > 0.0, length, 1.0), n)
    along = np.cross(n, half)
    sin_h = np.linalg.norm(along, axis=-1)
    cos_h = np.sum(n * half, axis=-1)
    difference = light - view
    sin_d = 0.5 * np.linalg.norm(difference, axis=-1)
    # In the frame of the half vector: y is n x h, x is y x h; x points where the half angle grows.
    y = along / np.where(sin_h > 0.0, sin_h, 1.0)[..., None]
    x = np.cross(y, half)
    phi = np.arctan2(np.sum(difference * y, axis=-1), np.sum(difference * x, axis=-1))
    phi = np.where((sin_h > 0.0) & (sin_d > 0.0), phi, 0.0)
    return (
        np.asarray(np.arctan2(sin_h, cos_h)),
        np.asarray(np.arctan2(sin_d, 0.5 * length[..., 0])),
        np.asarray(phi),
    )


def to_directions(
    theta_h: ArrayLike, theta_d: ArrayLike, phi_d: ArrayLike
) -> tuple[Float64Array, Float64Array]:
    """Return light and view of half and difference angles, in the frame whose normal is +z.

    The half vector is put at azimuth 0 (an isotropic BRDF has no other). Angles can lie such that
    a direction is below the surface.

    Returns
    -------
    light_dir, view_dir : ndarray, shape (..., 3)
        Unit vectors.

    Examples
    --------
    >>> light, view = to_directions(0.0, 0.5, 0.0)
    >>> light.round(3).tolist(), view.round(3).tolist()
    ([0.479, 0.0, 0.878], [-0.479, 0.0, 0.878])
    """
    h, d, phi = np.broadcast_arrays(
        *(np.asarray(angle, dtype=np.float64) for angle in (theta_h, theta_d, phi_d))
    )
    half = np.stack([np.sin(h), np.zeros_like(h), np.cos(h)], axis=-1)
    x = np.stack([np.cos(h), np.zeros_like(h), -np.sin(h)], axis=-1)
    y = np.array([0.0, 1.0, 0.0])
    across = np.sin(d)[..., None] * (np.cos(phi)[..., None] * x + np.sin(phi)[..., None] * y)
    along = np.cos(d)[..., None] * half
    return along + across, along - across


def read(path: str | os.PathLike[str]) -> MerlTable:
    """Read a MERL .binary file.

    Raises
    ------
    MerlFileError
        When the file is too short or long, or its header is not that of 90 x 90 x 180 bins.
    """
    return MerlTable(np.stack(list(_planes(Path(path)))))


def read_mean(path: str | os.PathLike[str]) -> Float64Array:
    """Read the mean of a file's channels, one at a time, with half the memory of `read`.

    Returns
    -------
    ndarray of float64, shape (90, 90, 180)
        1/sr; NaN where a channel was not measured.

    Raises
    ------
    MerlFileError
        As `read`.
    """
    mean = np.zeros(TABLE_SHAPE)
    for plane, scale in zip(_planes(Path(path)), BRDF_SCALE, strict=True):
        plane[plane < 0.0] = np.nan
        plane *= scale / 3.0
        mean += plane
    return mean


def _planes(file: Path) -> Iterator[Float64Array]:
    """Yield the channels, each (90, 90, 180), of a file whose size and header are right."""
    size = file.stat().st_size
    with file.open("rb") as stream:
        start = stream.read(12)
        if len(start) < 12:
            raise MerlFileError(f"{file}: got {size} bytes, expected {FILE_BYTES}")
        header = np.frombuffer(start, dtype="<i4")
        if tuple(header) != TABLE_SHAPE:
            got = " x ".join(str(int(n)) for n in header)
            raise MerlFileError(f"{file}: got a table of {got} bins, expected 90 x 90 x 180")
        if size != FILE_BYTES:
            word = "truncated" if size < FILE_BYTES else "followed by something else"
            raise MerlFileError(f"{file}: {word}: got {size} bytes, expected {FILE_BYTES}")
        for _ in range(3):
            plane = np.fromfile(stream, dtype="<f8", count=int(np.prod(TABLE_SHAPE)))
            if not np.all(np.isfinite(plane)):
                raise MerlFileError(f"{file}: got values that are not finite, expected finite ones")
            yield plane.astype(np.float64, copy=False).reshape(TABLE_SHAPE)


def write(path: str | os.PathLike[str], table: MerlTable) -> None:
    """Write a MERL .binary file, 34,992,012 bytes.

    Raises
    ------
    ValueError
        When the table contains values that are not finite.
    """
    Checks().within("MerlTable.stored", table.stored)
    with Path(path).open("wb") as stream:
        stream.write(np.array(TABLE_SHAPE, dtype="<i4").tobytes())
        table.stored.astype("<f8", copy=False).tofile(stream)
