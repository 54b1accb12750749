"""Read, write and evaluate isotropic BRDFs of RGL's .bsdf format (Mitsuba's ``measured``).

Per view elevation a file contains, over the unit square, f_r times the cosine of the light, times 4
sigma(view) / ndf(half). The square is that of the half vector, (sqrt(2 theta / pi), (phi + pi) / 2
pi) with phi from the view's azimuth, flattened by the inverse of the sampling of a tabulated
density ("vndf"). Everything is interpolated linearly.

Files written here have a constant density, ndf = 1 and sigma = 1/4. The square is then that of the
half vector and the values are f_r times the cosine, whether or not a reader uses the file's
``jacobian``. ``luminance`` is the density that light directions are drawn from.

References
----------
Dupuy and Jakob 2018, doi:10.1145/3272127.3275059.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.arrays import Float32Array, Float64Array
from model.brdf import tensor_file
from model.brdf.recipe import Brdf
from model.checks import Checks
from model.vectors import unit_vectors

N_ELEVATIONS = 45
TABLE_SIDE = 90
MAX_ELEVATION_RAD = np.deg2rad(89.0)
"""View elevation of the last table; also used for views closer to the horizon."""
_MIN_JACOBIAN = 1e-6  # smallest sine at the pole of the half vector, as in other readers
_MIN_DENSITY_RATIO = 1e-3  # fraction of the mean density that every direction gets


class RglFileError(ValueError):
    """Error for a tensor file that is not an isotropic measured material."""


@dataclass(frozen=True, slots=True, eq=False)
class RglTable:
    """An isotropic material.

    Attributes
    ----------
    theta_i
        View elevations, rad, growing, shape (T,).
    ndf, sigma
        Density of facets over the half vector's square and projected area over the view's, (Y, X).
    vndf
        Density whose sampling flattens the half vector's square, (T, Y, X), at least 0.
    luminance
        Density to draw from over the flattened square, (T, N, N).
    values
        f_r times the cosine of the light times 4 sigma / ndf, (T, C, N, N); NaN: unknown.
    wavelengths_nm
        Of the C channels; empty: red, green and blue.
    description
        Text.
    """

    theta_i: Float32Array
    ndf: Float32Array
    sigma: Float32Array
    vndf: Float32Array
    luminance: Float32Array
    values: Float32Array
    wavelengths_nm: Float32Array
    description: str

    def __post_init__(self) -> None:
        """Check shapes and densities."""
        count = len(self.theta_i)
        channels = len(self.wavelengths_nm) or 3
        check = Checks(RglFileError)
        check.shape("values", self.values, (count, channels, *self.values.shape[-1:] * 2))
        check.shape("luminance", self.luminance, (count, *self.values.shape[-1:] * 2))
        check.shape("vndf", self.vndf, (count, *self.vndf.shape[-2:]))
        if not (np.all(np.diff(self.theta_i) > 0) and np.all(np.isfinite(self.theta_i))):
            raise RglFileError("theta_i: got unsorted elevations, expected increasing ones")
        for name in ("ndf", "sigma", "vndf", "luminance"):
            grid = getattr(self, name)
            check.require(min(grid.shape[-2:]) >= 2, name, grid.shape, "at least 2 x 2 nodes")
            check.within(name, grid, "[0, inf)")
        if not np.all(self.vndf.sum((1, 2)) > 0.0):
            raise RglFileError("vndf: got an elevation without a value above 0")

    def evaluate(self, light_dir: ArrayLike, view_dir: ArrayLike) -> Float64Array:
        """Return the BRDF for pairs of light and view direction.

        Parameters
        ----------
        light_dir, view_dir
            Unit vectors (..., 3) away from the surface, whose normal is +z.

        Returns
        -------
        ndarray, shape (..., C)
            1/sr, without the cosine; 0 where light or view are below the horizon. Interpolated
            together with the cosine, so the relative error grows towards the horizon.
        """
        light, view = np.broadcast_arrays(
            *(np.asarray(v, dtype=np.float64) for v in (light_dir, view_dir))
        )
        above = (light[..., 2] > 0.0) & (view[..., 2] > 0.0)
        to, at = light[above], view[above]
        half = unit_vectors(to + at)
        turn = np.arctan2(half[:, 1], half[:, 0]) - np.arctan2(at[:, 1], at[:, 0])
        square = np.stack(
            [np.sqrt(_elevation(half) * (2.0 / np.pi)), np.mod(turn / (2.0 * np.pi) + 0.5, 1.0)], -1
        )
        slices = _Interpolation.of(self.theta_i.astype(np.float64), _elevation(at))
        found = slices.bilinear(self.values, _invert_sampling(self.vndf, slices, square))
        own = np.stack([np.sqrt(_elevation(at) * (2.0 / np.pi)), np.zeros(len(at))], -1)
        first = _Interpolation(*(np.zeros(len(at), np.intp),) * 2, np.zeros(len(at)))
        # +x is the view's azimuth; the projected area of an isotropic material depends on elevation
        # alone
        scale = first.bilinear(self.ndf[None, None], square) / (
            4.0 * first.bilinear(self.sigma[None, None], own)
        )
        out = np.zeros((*above.shape, self.values.shape[1]))
        out[above] = found * scale / to[:, 2:]
        return out


def tabulate_brdf(brdf: Brdf, *, description: str) -> RglTable:
    """Tabulate a BRDF given as a function.

    Parameters
    ----------
    brdf
        Takes light and view, unit vectors (n, 3) where +z is the normal; gives 1/sr, (n,) or
        (n, 3), finite, at least 0.
    description
        Text for the file.
    side
        Nodes along the half vector's angle (even in its square root; 90 are the nodes of
        :class:`model.brdf.tables.BrdfBasis`) and its azimuth.

    Raises
    ------
    ValueError
        When the BRDF is negative or not finite somewhere.
    """
    theta_i = np.linspace(0.0, MAX_ELEVATION_RAD, N_ELEVATIONS)
    u, v = np.meshgrid(np.linspace(0.0, 1.0, TABLE_SIDE), np.linspace(0.0, 1.0, TABLE_SIDE))
    theta, phi = u**2 * (np.pi / 2.0), (2.0 * v - 1.0) * np.pi
    half = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    values = np.zeros((N_ELEVATIONS, 3, TABLE_SIDE, TABLE_SIDE), np.float32)
    luminance = np.zeros((N_ELEVATIONS, TABLE_SIDE, TABLE_SIDE), np.float32)
    for k, elevation in enumerate(theta_i):
        view = np.array([np.sin(elevation), 0.0, np.cos(elevation)])
        along = half @ view
        light = 2.0 * along[..., None] * half - view
        seen = (along > 0.0) & (light[..., 2] > 0.0)
        to = unit_vectors(light[seen])
        found = np.asarray(brdf(to, np.broadcast_to(view, to.shape)), np.float64)
        Checks().within("brdf", found, "[0, inf)")
        rgb = np.broadcast_to(found.reshape(len(to), -1), (len(to), 3)) * to[:, 2:]
        values[k][:, seen] = rgb.T
        jacobian = np.maximum(2.0 * np.pi**2 * u * np.sin(theta), _MIN_JACOBIAN) * 4.0 * along
        density = np.where(seen, values[k].mean(0) * jacobian, 0.0)
        luminance[k] = density + (_MIN_DENSITY_RATIO * density.mean() or 1.0)
    flat = np.ones((2, 2), np.float32)
    return RglTable(
        theta_i.astype(np.float32),
        flat,
        0.25 * flat,
        np.ones((N_ELEVATIONS, 2, 2), np.float32),
        luminance,
        values,
        np.zeros(0, np.float32),
        description,
    )


def read(path: str | os.PathLike[str]) -> RglTable:
    """Read an isotropic .bsdf, RGB or spectral.

    Raises
    ------
    model.brdf.tensor_file.TensorFileError
        When it is not a tensor file, or truncated.
    RglFileError
        When a field is missing or has another shape, or the material is anisotropic.
    """
    fields = tensor_file.read(path)
    spectral = "wavelengths" in fields
    data = "spectra" if spectral else "rgb"
    needed = ("theta_i", "phi_i", "ndf", "sigma", "vndf", "luminance", data)
    missing = [name for name in needed if name not in fields]
    if missing:
        raise RglFileError(
            f"{path}: field {missing[0]} is missing, got {', '.join(fields) or 'none'}"
        )
    azimuths = fields["phi_i"].size
    if azimuths > 2:
        raise RglFileError(
            f"{path}: got an anisotropic material ({azimuths} azimuths), expected an isotropic one"
        )
    axes = {"theta_i": 1, "ndf": 2, "sigma": 2, "vndf": 4, "luminance": 4, data: 5}
    for name, dimensions in axes.items():
        got = f"{fields[name].ndim} dimensions"
        Checks(RglFileError).require(
            fields[name].ndim == dimensions, f"{path}: {name}", got, str(dimensions)
        )
    grids = {name: np.asarray(array, np.float32) for name, array in fields.items() if array.size}
    scaled = bool(fields["jacobian"][0]) if "jacobian" in fields else True
    text = fields.get("description", np.zeros(0, np.uint8))
    try:
        return RglTable(
            grids["theta_i"],
            grids["ndf"] if scaled else np.ones((2, 2), np.float32),
            grids["sigma"] if scaled else np.full((2, 2), 0.25, np.float32),
            grids["vndf"][0],
            grids["luminance"][0],
            grids[data][0],
            grids["wavelengths"] if spectral else np.zeros(0, np.float32),
            text.astype(np.uint8).tobytes().decode("utf-8", "replace").rstrip("\0"),
        )
    except (KeyError, RglFileError) as error:
        raise RglFileError(f"{path}: {error}") from error


def write(path: str | os.PathLike[str], table: RglTable) -> None:
    """Write a table as a .bsdf file."""
    spectral = len(table.wavelengths_nm) > 0
    fields: dict[str, NDArray[Any]] = {
        "description": np.frombuffer(table.description.encode() or b" ", np.uint8),
        "jacobian": np.ones(1, np.uint8),
        "phi_i": np.zeros(1, np.float32),
        "theta_i": table.theta_i,
        "ndf": table.ndf,
        "sigma": table.sigma,
        "vndf": table.vndf[None],
        "luminance": table.luminance[None],
        "spectra" if spectral else "rgb": table.values[None],
    }
    if spectral:
        fields["wavelengths"] = table.wavelengths_nm
    tensor_file.write(Path(path), fields)


def _elevation(unit: Float64Array) -> Float64Array:
    """Return the angle to +z, rad, without cancellation near 0."""
    apart = np.linalg.norm(unit - [0.0, 0.0, 1.0], axis=-1)
    return np.asarray(2.0 * np.arcsin(np.minimum(0.5 * apart, 1.0)))


@dataclass(frozen=True, slots=True)
class _Interpolation:
    """Neighboring tables of each sample, and the interpolation weight."""

    low: NDArray[np.intp]
    high: NDArray[np.intp]
    fraction: Float64Array

    @classmethod
    def of(cls, nodes: Float64Array, at: Float64Array) -> _Interpolation:
        if len(nodes) == 1:
            zero = np.zeros(len(at), np.intp)
            return cls(zero, zero, np.zeros(len(at)))
        low = np.clip(np.searchsorted(nodes, at) - 1, 0, len(nodes) - 2)
        share = np.clip((at - nodes[low]) / (nodes[low + 1] - nodes[low]), 0.0, 1.0)
        return cls(low, low + 1, share)

    def take(self, grids: Float64Array, *index: NDArray[np.intp]) -> Float64Array:
        """Return elements of (T, ...), interpolated between two tables."""
        low, high = grids[(self.low, *index)], grids[(self.high, *index)]
        return np.asarray((1.0 - self.fraction) * low + self.fraction * high)

    def bilinear(self, grids: Float32Array, square: Float64Array) -> Float64Array:
        """Return (n, C) of (T, C, Y, X) at positions (n, 2), x first."""
        (x, y), (fx, fy) = _cells(square, grids.shape[-1], grids.shape[-2])
        out = np.zeros((len(square), grids.shape[1]))
        for table, part in ((self.low, 1.0 - self.fraction), (self.high, self.fraction)):
            for dy in (0, 1):
                for dx in (0, 1):
                    weight = part * (fy if dy else 1.0 - fy) * (fx if dx else 1.0 - fx)
                    out += weight[:, None] * grids[table, :, y + dy, x + dx]
        return out


def _cells(
    square: Float64Array, width: int, height: int
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], tuple[Float64Array, Float64Array]]:
    x, y = square[:, 0] * (width - 1), square[:, 1] * (height - 1)
    column = np.clip(x.astype(np.intp), 0, width - 2)
    row = np.clip(y.astype(np.intp), 0, height - 2)
    return (column, row), (x - column, y - row)


def _invert_sampling(
    vndf: Float32Array, slices: _Interpolation, square: Float64Array
) -> Float64Array:
    """Return the uniform numbers (n, 2) that a piecewise bilinear density maps to these positions.

    The inverse of sampling is the cumulative distribution: of the marginal density over rows, then
    of the conditional density over columns within the row.
    """
    density = vndf.astype(np.float64)
    _, height, width = density.shape
    along = np.zeros_like(density)  # mass to the left of a node in its row
    along[..., 1:] = np.cumsum(0.5 * (density[..., 1:] + density[..., :-1]), axis=-1)
    rows = along[..., -1]
    below = np.zeros_like(rows)  # mass of the rows below
    below[:, 1:] = np.cumsum(0.5 * (rows[:, 1:] + rows[:, :-1]), axis=-1)
    total = below[:, -1:].copy()
    along, below, rows = along / total[..., None], below / total, rows / total
    density = density / total[..., None]
    (column, row), (fx, fy) = _cells(square, width, height)

    def at(grids: Float64Array, *index: NDArray[np.intp]) -> Float64Array:
        return slices.take(grids, *index)

    left = (1.0 - fy) * at(density, row, column) + fy * at(density, row + 1, column)
    right = (1.0 - fy) * at(density, row, column + 1) + fy * at(density, row + 1, column + 1)
    first, second = at(rows, row), at(rows, row + 1)
    passed = (1.0 - fy) * at(along, row, column) + fy * at(along, row + 1, column)
    whole = (1.0 - fy) * first + fy * second
    x = passed + fx * (left + 0.5 * fx * (right - left))
    y = at(below, row) + fy * (first + 0.5 * fy * (second - first))
    x = np.divide(x, whole, out=fx.copy(), where=whole > 0.0)
    return np.stack([np.clip(x, 0.0, 1.0), np.clip(y, 0.0, 1.0)], -1)
