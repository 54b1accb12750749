"""Bases of tabulated isotropic BRDFs: grid, lookups and sources of the tables.

A table contains BRDFs in 1/sr over MERL's half/difference angles, coarser than MERL's files and
interpolated, each convolved with the solid angle of a light. Tables include Fresnel reflection, as
measured ones do: radiance is table value times cosine of the light, without a further factor.

References
----------
Weyrich et al. 2006, doi:10.1145/1141911.1141987, section 7.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt

from model import merl
from model.arrays import Float32Array, Float64Array
from model.brdf import recipe as brdf_recipe
from model.brdf import rgl
from model.brdf.recipe import Brdf
from model.checks import Checks
from model.vectors import unit_vectors

NODES_D, NODES_PHI, NODES_H = 32, 12, 90
VECTOR_LANES = 16  # materials are padded to full vectors of float32
MIN_STORED_VALUE = 1e-20
"""Values below this are stored as 0: a sum of denormal numbers is nine times as slow."""
LED_RADIUS_RAD = 10.0 / 700.0
"""Angular radius of the dome's lights (10 mm at 700 mm) from its center."""
RGL_SUFFIX = ".bsdf"
MATERIAL_SUFFIXES = (".binary", RGL_SUFFIX)
"""Suffixes of files of measured BRDFs: MERL and RGL."""
MIN_MEASURED_COSINE = 0.05
"""Least cosine of light and view (3 degrees from the horizon) at which measured tables count."""
_HALF_PI = 0.5 * np.pi


class BasisError(ValueError):
    """Error for a folder or a set of tables from which no basis can be made."""


@dataclass(frozen=True, slots=True, eq=False)
class BrdfBasis:
    """BRDFs of K materials on one grid.

    Attributes
    ----------
    table : ndarray of float32, shape (32, 12, 90, L)
        1/sr at nodes of theta_d (even over [0, pi/2]), phi_d (even over [0, pi/2], folded by
        reciprocity and mirror symmetry) and theta_h (even in its square root over [0, pi/2]).
        L is K rounded up to a multiple of 16; columns from K on are 0.
    names : tuple of str
        The K materials.
    light_radius_rad : float
        Angular radius of the light the tables are convolved with; 0: a point.
    """

    table: Float32Array
    names: tuple[str, ...]
    light_radius_rad: float

    def __post_init__(self) -> None:
        """Check shapes and values."""
        lanes = -(-len(self.names) // VECTOR_LANES) * VECTOR_LANES
        expected = (NODES_D, NODES_PHI, NODES_H, lanes)
        check = Checks(BasisError)
        check.within("names", len(self.names), "[1, inf)")
        check.choice("BrdfBasis.table", self.table.dtype, (np.dtype(np.float32),))
        check.shape("BrdfBasis.table", self.table, expected)
        check.within("BrdfBasis.table", self.table, "[0, inf)")

    @property
    def size(self) -> int:
        """Return the number of materials."""
        return len(self.names)

    def evaluate(
        self, light_dir: ArrayLike, view_dir: ArrayLike, normal: ArrayLike
    ) -> Float64Array:
        """Return each material's BRDF: linear in theta_d and theta_h, at the nearest phi_d.

        Parameters
        ----------
        light_dir, view_dir, normal
            Unit vectors (..., 3) in one frame, away from the surface; broadcast together.

        Returns
        -------
        ndarray, shape (..., K)
            1/sr; 0 where light or view are below the horizon.
        """
        light, view, n = (np.asarray(v, dtype=np.float64) for v in (light_dir, view_dir, normal))
        mu_l, mu_v = np.sum(light * n, axis=-1), np.sum(view * n, axis=-1)
        (i_d, i_phi, i_h), (d, h) = _locate_cell(mu_l, mu_v, np.sum(light * view, axis=-1))
        found = np.zeros(())
        for up_d in (0, 1):
            for up_h in (0, 1):
                weight = (d if up_d else 1.0 - d) * (h if up_h else 1.0 - h)
                found = found + weight[..., None] * self.table[i_d + up_d, i_phi, i_h + up_h]
        above = (mu_l > 0.0) & (mu_v > 0.0)
        return np.asarray(np.where(above[..., None], found, 0.0)[..., : self.size])

    def strength(self) -> Float64Array:
        """Return each material's RMS over the grid, (K,), 1/sr; nodes count by solid angle."""
        return np.asarray(np.sqrt(np.diag(_gram(self))))

    def cosine_similarity(self) -> Float64Array:
        """Return the cosines between the materials, (K, K): 1 for one of the same shape."""
        gram = _gram(self)
        size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
        return np.ascontiguousarray(gram / size / size[:, None])

    def mix_materials(self, weights: ArrayLike) -> BrdfBasis:
        """Return the basis whose R materials are the rows of `weights`, (R, K), at least 0."""
        rows = Checks(BasisError).numbers("weights", weights, ("R", self.size), interval="[0, inf]")
        table = self.table[..., : self.size].astype(np.float64) @ rows.T
        return _pad_table(table, [f"mix {i}" for i in range(len(rows))], self.light_radius_rad)


@lru_cache(maxsize=4)
def default_basis(light_radius_rad: float = LED_RADIUS_RAD) -> BrdfBasis:
    """Return the 59 dielectrics of :mod:`model.brdf.recipe`, made on first use (2 s).

    Parameters
    ----------
    light_radius_rad
        Angular radius of the light to convolve with, rad, in [0, 0.5].
    """
    return tabulate(dict(brdf_recipe.materials()), light_radius_rad=light_radius_rad)


def tabulate(materials: dict[str, Brdf], *, light_radius_rad: float = 0.0) -> BrdfBasis:
    """Return a basis of BRDFs given as functions.

    Parameters
    ----------
    materials
        Name to function; see :data:`Brdf`. NaN is replaced by the nearest known node; values below
        0 count as 0.
    light_radius_rad
        Angular radius of the light to convolve with, rad, in [0, 0.5].
    """
    view, lights = _lights_at_nodes(light_radius_rad)
    columns = [_average_over_light(brdf, view, lights) for brdf in materials.values()]
    if not columns:
        raise BasisError("materials: got none, expected at least one; name a material")
    return _pad_table(np.stack(columns, axis=-1), list(materials), light_radius_rad)


def basis_from_columns(
    columns: Float64Array | Float32Array, names: Sequence[str], *, light_radius_rad: float
) -> BrdfBasis:
    """Return a basis from its stored table without padding.

    Parameters
    ----------
    columns
        BRDFs at the nodes, 1/sr, shape (32, N_phi, 90, K); see `BrdfBasis.table`. Values below 0
        count as 0.
    names
        Of the K materials.
    light_radius_rad
        Of the light that they are convolved with.
    """
    return _pad_table(np.asarray(columns, np.float64), names, light_radius_rad)


def list_material_files(folder: str | os.PathLike[str]) -> list[Path]:
    """Return a folder's MERL and RGL files by name, in any case; none of a missing folder.

    Raises
    ------
    BasisError
        When two files differ in their suffix alone, so that a material would count twice.

    Examples
    --------
    >>> list_material_files("/proc/none")
    []
    """
    place = Path(folder)
    found = place.iterdir() if place.is_dir() else []
    files = sorted(p for p in found if p.suffix.lower() in MATERIAL_SUFFIXES)
    of_stem: dict[str, Path] = {}
    for file in files:
        other = of_stem.setdefault(file.stem, file)
        if other != file:
            raise BasisError(
                f"{place}: got {other.name} and {file.name}, expected one file per material; "
                "remove or rename one"
            )
    return files


def load(folder: str | os.PathLike[str], *, light_radius_rad: float = LED_RADIUS_RAD) -> BrdfBasis:
    """Return a basis of the MERL and RGL files in a folder, their channels averaged to one.

    Parameters
    ----------
    folder
        Its .binary and .bsdf files (upper or lower case) are read in the order of their names;
        other files are ignored. One file is in memory at a time.
    light_radius_rad
        Angular radius of the light to convolve with, rad, in [0, 0.5].

    Raises
    ------
    BasisError
        When the folder is missing or has no such file, or one of them has no value above 0.
    model.merl.MerlFileError, model.brdf.rgl.RglFileError, model.brdf.tensor_file.TensorFileError
        When one of them is not a MERL or RGL table.
    """
    paths = list_material_files(folder)
    if not paths:
        raise BasisError(
            f"{folder}: got no .binary or .bsdf files, expected MERL or RGL tables; "
            "name their folder"
        )
    columns = [tabulate_column(read_brdf(path), light_radius_rad) for path in paths]
    return basis_from_columns(
        np.stack(columns, -1), [path.stem for path in paths], light_radius_rad=light_radius_rad
    )


def read_brdf(path: Path) -> Brdf:
    """Return a MERL or RGL file's BRDF, the mean of its channels; NaN where not measured.

    Light or view within 3 degrees of the horizon count as not measured: values are divided by
    their cosines, and `tabulate` would fill all nodes below the horizon with the largest.

    Raises
    ------
    BasisError
        When it has no value above 0, or one beyond float32.
    model.merl.MerlFileError, model.brdf.rgl.RglFileError, model.brdf.tensor_file.TensorFileError
        When it is not such a table.
    """
    brdf, largest = _read_rgl(path) if path.suffix.lower() == RGL_SUFFIX else _read_merl(path)
    if not largest > 0.0:
        raise BasisError(f"{path}: got no value above 0, expected a material that reflects")
    if not largest < float(np.finfo(np.float32).max):
        raise BasisError(f"{path}: got {largest:.3g} 1/sr, expected less than 3e38")

    def measured(light: Float64Array, view: Float64Array) -> Float64Array:
        known = np.minimum(light[..., 2], view[..., 2]) > MIN_MEASURED_COSINE
        return np.where(known, brdf(light, view), np.nan)

    return measured


def _read_merl(path: Path) -> tuple[Brdf, float]:
    mean = merl.read_mean(path)
    other = mean[..., ::-1]  # phi_d and pi - phi_d are the same pair: reciprocity, mirror symmetry
    both = np.where(np.isnan(other), mean, 0.5 * (mean + other))
    return merl_brdf(np.where(np.isnan(mean), other, both)), float(np.nanmax(mean, initial=0.0))


def _read_rgl(path: Path) -> tuple[Brdf, float]:
    table = rgl.read(path)

    def brdf(light: Float64Array, view: Float64Array) -> Float64Array:
        return table.evaluate(light, view).mean(axis=-1)

    return brdf, float(np.nanmax(table.values, initial=0.0))


def tabulate_column(brdf: Brdf, light_radius_rad: float) -> Float32Array:
    """Return a BRDF at the nodes, (32, 12, 90), 1/sr; see `tabulate` and `basis_from_columns`."""
    return _average_over_light(brdf, *_lights_at_nodes(light_radius_rad)).astype(np.float32)


def merl_brdf(mean: Float64Array) -> Brdf:
    """Return the function that looks up the nearest bin of a table (90, 90, 180), 1/sr."""

    def brdf(light: Float64Array, view: Float64Array) -> Float64Array:
        h, d, phi = merl.to_angles(light, view, [0.0, 0.0, 1.0])
        return np.asarray(mean[merl.bin_indices(np.minimum(h, _HALF_PI), d, phi)])

    return brdf


def grid_nodes() -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return theta_d, phi_d and theta_h of the grid's nodes, rad."""
    return (
        np.linspace(0.0, _HALF_PI, NODES_D),
        np.linspace(0.0, _HALF_PI, NODES_PHI),
        np.linspace(0.0, 1.0, NODES_H) ** 2 * _HALF_PI,
    )


@lru_cache(maxsize=4)
def _gram(basis: BrdfBasis) -> Float64Array:
    """Return the products of the materials over the grid, nodes counting by solid angle."""
    d, _, h = grid_nodes()
    solid = np.sin(2.0 * d)[:, None] * (np.sin(h) * np.gradient(h))
    weight = np.sqrt(np.broadcast_to((solid / solid.sum())[:, None], basis.table.shape[:3]))
    scaled = basis.table[..., : basis.size] * weight[..., None].astype(np.float32)
    flat = scaled.reshape(-1, basis.size)
    return np.asarray(flat.T @ flat, dtype=np.float64) / NODES_PHI


def _lights_at_nodes(
    radius_rad: float,
) -> tuple[Float64Array, list[tuple[Float64Array, Float64Array]]]:
    """Return the view at each node, and directions on a disc of light with their weights."""
    Checks(BasisError).within("light_radius_rad", radius_rad, "[0, 0.5]")
    d, phi, h = np.meshgrid(*grid_nodes(), indexing="ij")
    light, view = merl.to_directions(h, d, phi)
    view.flags.writeable = light.flags.writeable = False  # all BRDFs are evaluated at the same
    if radius_rad == 0.0:
        return view, [(light, np.ones(d.shape))]
    # Seven points: exact on a disc for polynomials of degree 5 (Stroud 1971, S2 5-1).
    helper = np.where(np.abs(light[..., 1:2]) < 0.9, [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    u = unit_vectors(np.cross(helper, light))
    v = np.cross(light, u)
    lights = []
    for point in range(7):
        turn = point * np.pi / 3.0
        reach = 0.0 if point == 6 else np.tan(radius_rad) * np.sqrt(2.0 / 3.0)
        to = unit_vectors(light + reach * (np.cos(turn) * u + np.sin(turn) * v))
        to.flags.writeable = False
        lights.append((to, (0.25 if point == 6 else 0.125) * np.maximum(to[..., 2], 1e-3)))
    return view, lights


def _average_over_light(
    brdf: Brdf, view: Float64Array, lights: list[tuple[Float64Array, Float64Array]]
) -> Float64Array:
    """Return a BRDF at the nodes, averaged over weighted directions of light."""
    if len(lights) == 1:
        return _fill_unknown(np.asarray(brdf(lights[0][0], view)))
    total, weight = np.zeros(view.shape[:-1]), np.zeros(view.shape[:-1])
    for to, share in lights:
        value = np.asarray(brdf(to, view))
        known = np.isfinite(value)
        total += np.where(known, share * np.where(known, value, 0.0), 0.0)
        weight += np.where(known, share, 0.0)
    with np.errstate(invalid="ignore"):
        return _fill_unknown(total / weight)


def _fill_unknown(values: Float64Array) -> Float64Array:
    """Replace unknown values by the nearest known node, and values below 0 by 0."""
    unknown = ~np.isfinite(values)
    if np.all(unknown):
        raise BasisError(
            "table: got no known value, expected finite ones; check the material's function"
        )
    if np.any(unknown):
        nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
        values = values[tuple(nearest)]
    return np.maximum(values, 0.0)


def _pad_table(columns: Float64Array, names: Sequence[str], light_radius_rad: float) -> BrdfBasis:
    lanes = -(-len(names) // VECTOR_LANES) * VECTOR_LANES
    table = np.zeros((*columns.shape[:3], lanes), dtype=np.float32)
    table[..., : len(names)] = np.where(columns < MIN_STORED_VALUE, 0.0, columns)
    return BrdfBasis(table, tuple(names), light_radius_rad)


def _locate_cell(
    mu_l: Float64Array, mu_v: Float64Array, between: Float64Array
) -> tuple[tuple[NDArray[np.intp], ...], tuple[Float64Array, Float64Array]]:
    """Return the cell along theta_d, phi_d, theta_h and the position in it, from cosines alone."""
    cos_d = np.sqrt(np.clip(0.5 * (1.0 + between), 0.0, 1.0))
    sin_d = np.sqrt(np.clip(0.5 * (1.0 - between), 0.0, 1.0))
    cos_h = np.clip((mu_l + mu_v) / np.maximum(2.0 * cos_d, 1e-9), 0.0, 1.0)
    sin_h = np.sqrt(1.0 - cos_h**2)
    # mu_v - mu_l = 2 sin_d sin_h cos(phi_d); folding by reciprocity drops the sign
    cos_phi = np.minimum(np.abs(mu_v - mu_l) / np.maximum(2.0 * sin_d * sin_h, 1e-9), 1.0)
    place = (
        np.arctan2(sin_d, cos_d) / _HALF_PI * (NODES_D - 1),
        np.arccos(cos_phi) / _HALF_PI * (NODES_PHI - 1),
        np.sqrt(np.arccos(cos_h) / _HALF_PI) * (NODES_H - 1),
    )
    d, phi, h = place
    i_d = np.minimum(d.astype(np.intp), NODES_D - 2)
    i_h = np.minimum(h.astype(np.intp), NODES_H - 2)
    return (i_d, (phi + 0.5).astype(np.intp), i_h), (d - i_d, h - i_h)
