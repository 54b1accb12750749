"""Fit measured BRDF tables by formulas and by other tables, and judge grids that store them.

Tables are read or generated one at a time. Each is reduced to its column on the grid of
:class:`model.brdf.tables.BrdfBasis`, some samples, and errors of fits by coarser grids.

Errors of whole tables and grids are relative: RMS of the difference over RMS of the BRDF, where
pairs of directions count by solid angle, dw_l dw_v = 4 cos(theta_d) dw_h dw_d. Light and view
within 3 degrees of the horizon do not count: measured tables are unreliable there. Errors of
held-out samples are of BRDF times the light's cosine, as in images; cosines of both exceed 0.1.

References
----------
Weyrich et al. 2005, section 7 (fits with measured tables).
Matusik et al. 2003, doi:10.1145/882262.882343 (square root of theta_h).
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from model import merl
from model.brdf import tables
from model.brdf.recipe import Brdf
from model.brdf.tables import MIN_MEASURED_COSINE
from model.traits.reduced_spaces import mixture_coordinates
from model.vectors import unit_vectors
from reconstruction import brdf_basis
from rigsim.light.generated_brdfs import generate_brdf
from skinrig.analysing.brdf_space_figures import encode_figure, new_figure
from skinrig.arrays import Float32Array, Float64Array
from skinrig.atomic_file import write_atomically
from skinrig.console import to_json_value
from skinrig.errors import UnusableError

_log = logging.getLogger(__name__)

OUTPUT_FILES: Final = ("tables.json", "grids.png")
GRID_NODES: Final = ((8, 4, 2), (16, 8, 4), (32, 16, 8), (90, 32, 12))
"""Nodes along theta_h, theta_d and phi_d of the judged grids; the last is that of the basis."""
GRID_LABELS: Final = {
    "angles": "even angles",
    "merl": "even square root of theta_h",
    "areas": "even areas: 1 - cos(theta_h), sin^2(theta_d)",
}
MIN_TABLES: Final = 3
ERROR_PERCENTILES: Final = (50, 90)
N_SAMPLES: Final = 900
"""Samples of a fit, as many as a point of the dome has; as many others are held out."""
MAX_FITS: Final = 12
SAMPLE_NOISE: Final = 0.02
"""Standard error of a sample over the sum of its value and the samples' mean."""
TABLE_NOISE: Final = 0.02
"""Standard error of a generated table's bin over its value."""
MIN_SAMPLE_COSINE: Final = 0.1
"""Least cosine of light and view of samples."""
SOLUTION_TOL: Final = 1e-4
"""Residual of the least-squares fits of grids over the right side."""


@dataclass(frozen=True, slots=True, eq=False)
class ReducedTable:
    """Column, samples and grid errors of one table.

    Attributes
    ----------
    name
        File or number.
    column
        BRDF at the basis' nodes, (32, 12, 90), 1/sr.
    samples
        BRDF of the drawn pairs of light and view, 1/sr.
    grid_errors
        Relative errors, (2, grids, sizes): of the BRDF, and of its cube root.
    """

    name: str
    column: Float32Array
    samples: Float64Array
    grid_errors: Float64Array


def generate_table(number: int, *, seed: int = 0) -> Float64Array:
    """Return a generated BRDF as a measurement would give it, on MERL's whole grid.

    Parameters
    ----------
    number, seed
        See `rigsim.light.generated_brdfs.generate_brdf`.

    Returns
    -------
    ndarray, shape (90, 90, 180)
        Mean of the channels, 1/sr, with noise of 2 %; NaN within 3 degrees of the horizon.
    """
    brdf = generate_brdf(number, seed=seed)
    table = tabulate_bins(lambda light, view: brdf(light, view).mean(axis=-1))
    rng = np.random.default_rng([seed, number, 1])
    noise = rng.standard_normal(table.shape, dtype=np.float32)
    noise *= TABLE_NOISE
    noise += 1.0
    table *= noise
    return table


def tabulate_bins(brdf: Brdf) -> Float64Array:
    """Return a BRDF at the centers of MERL's bins, (90, 90, 180); NaN near the horizon.

    Half is evaluated: BRDFs of isotropic surfaces are the same for phi_d and pi - phi_d, as are the
    averaged halves of a MERL file; see `model.brdf.tables.read_brdf`.
    """
    theta_h, theta_d, phi_d = merl.bin_centers()
    half = len(phi_d) // 2
    d, phi = np.meshgrid(theta_d, phi_d[:half], indexing="ij")
    table = np.full(merl.TABLE_SHAPE, np.nan)
    for plane, h in zip(table, theta_h, strict=True):
        light, view = merl.to_directions(h, d, phi)
        above = np.minimum(light[..., 2], view[..., 2]) > MIN_MEASURED_COSINE
        plane[:, :half][above] = brdf(light[above], view[above])
        plane[:, half:] = plane[:, half - 1 :: -1]
    return table


def fit_tables(
    out: Path,
    folder: Path | None,
    *,
    count: int,
    seed: int,
    progress: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Fit each table by the 59 formulas and by all other tables; write `OUTPUT_FILES`.

    Parameters
    ----------
    out
        Folder to write.
    folder
        MERL and RGL files; None: `count` generated tables.
    count
        Number of generated tables.
    seed
        Seed of the generated set, the samples and their noise.
    progress
        Takes a line of text per table.

    Returns
    -------
    dict
        JSON values; percentiles are over the tables.

    Raises
    ------
    UnusableError
        For fewer than three tables, or one without a value above 0 at measured angles.
    model.brdf.tables.BasisError, model.merl.MerlFileError, ...
        For unusable files; see `model.brdf.tables.load`.
    """
    files = None if folder is None else tables.list_material_files(folder)
    total = count if files is None else len(files)
    if total < MIN_TABLES:
        where, remedy = "--count", "enter more"
        if folder is not None:
            where = str(folder)
            remedy = "add MERL .binary or RGL .bsdf files, or omit the folder"
        raise UnusableError(f"{where}: got {total} tables, expected {MIN_TABLES} or more; {remedy}")
    report = progress or (lambda text: None)
    rng = np.random.default_rng([seed, 2])
    light, view = (_draw_directions(rng, 2 * N_SAMPLES) for _ in range(2))
    grids = _GridFits()
    node_root = _node_weight_roots()
    reduced: list[ReducedTable] = []
    for name, brdf, table in _each_table(files, total, seed):
        report(f"table {len(reduced) + 1} of {total}: {name}")
        column = tables.tabulate_column(brdf, 0.0)
        samples = np.nan_to_num(brdf(light, view))
        for part in (np.nan_to_num(table), column * node_root, *np.split(samples, 2)):
            if not np.any(part > 0.0):
                raise UnusableError(
                    f"{name if folder is None else folder / name}: got no value above 0 at angles "
                    "away from the horizon, expected a material that reflects; remove it"
                )
        reduced.append(ReducedTable(name, column, samples, grids.errors(table)))
    columns = np.stack([one.column for one in reduced], axis=-1)
    names = [one.name for one in reduced]
    formulas = tables.default_basis(0.0)
    mixtures = _mixture_errors(columns, formulas)
    fits = _fit_held_out(reduced, columns, light, view, formulas, rng)
    of_grids = np.stack([one.grid_errors for one in reduced])
    document: dict[str, Any] = {
        "schema": "skinrig.brdf-tables/1",
        "source": "generated" if folder is None else str(folder),
        "tables": total,
        "seed": seed,
        "mixture_error": {who: _percentiles(errors) for who, errors in mixtures.items()},
        "fit_error": {who: _percentiles(errors) for who, errors in fits.items()},
        "fits": len(fits["formulas"]),
        "grids": [
            {
                "grid": grid,
                "coefficients": int(np.prod(GRID_NODES[size])),
                "error": _percentiles(of_grids[:, 0, place, size]),
                "cube_root_error": _percentiles(of_grids[:, 1, place, size]),
            }
            for size in range(len(GRID_NODES))
            for place, grid in enumerate(GRID_LABELS)
        ],
        "each": [
            {"name": name, **{who: float(errors[k]) for who, errors in mixtures.items()}}
            for k, name in enumerate(names)
        ],
    }
    write_atomically(out / OUTPUT_FILES[1], _draw_grids(document["grids"]))
    write_atomically(
        out / OUTPUT_FILES[0], json.dumps(to_json_value(document), indent=1, allow_nan=False)
    )
    return document


def _each_table(
    files: list[Path] | None, total: int, seed: int
) -> Iterator[tuple[str, Brdf, Float64Array]]:
    """Yield name, function and table (90, 90, 180); NaN where not measured."""
    for number in range(total):
        if files is None:
            table = generate_table(number, seed=seed)
            yield f"generated {number}", tables.merl_brdf(table), table
        else:
            brdf = tables.read_brdf(files[number])
            yield files[number].name, brdf, tabulate_bins(brdf)


class _GridFits:
    """Least-squares fits of functions linear between the nodes of coarse grids to known bins."""

    def __init__(self) -> None:
        h, d, phi = merl.bin_centers()
        edges_h = (np.arange(len(h) + 1) / len(h)) ** 2 * (np.pi / 2)
        edges_d = np.linspace(0.0, np.pi / 2, len(d) + 1)
        self._solid = np.multiply.outer(np.diff(-np.cos(edges_h)), np.diff(np.sin(edges_d) ** 2))
        self._known = np.zeros(0, bool)
        folded = np.minimum(phi, np.pi - phi) * (2.0 / np.pi)
        whole_h, whole_d = 2.0 * h / np.pi, 2.0 * d / np.pi
        along = {
            "angles": (whole_h, whole_d),
            "merl": (np.sqrt(whole_h), whole_d),
            "areas": (1.0 - np.cos(h), np.sin(d) ** 2),
        }
        self._axes = [
            (_hats(along[grid][0], n_h), _hats(along[grid][1], n_d), _hats(folded, n_phi))
            for grid in GRID_LABELS
            for n_h, n_d, n_phi in GRID_NODES
        ]
        self._normals: list[sparse.csr_array] = []

    def errors(self, table: Float64Array) -> Float64Array:
        """Return relative errors (2, grids, sizes) of a table and of its cube root.

        Bins count by solid angle; unknown ones, NaN, do not count.
        """
        known = np.isfinite(table)
        weight = known * self._solid[..., None]
        if not np.array_equal(known, self._known):
            self._known = known
            self._normals = [_normal_matrix(weight, axes) for axes in self._axes]
        filled = np.where(known, table, 0.0)
        found = np.empty((2, len(self._axes)))
        for row, values in zip(found, (filled, np.cbrt(filled)), strict=True):
            weighted = weight * values
            whole = float(np.sum(weighted * values))
            for k, (axes, normal) in enumerate(zip(self._axes, self._normals, strict=True)):
                right = _project(weighted, axes).ravel()
                scale = normal.diagonal()
                inverse = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0.0)
                kept, steps = sparse.linalg.cg(
                    normal, right, rtol=SOLUTION_TOL, M=sparse.diags_array(inverse)
                )
                if steps > 0:
                    _log.warning("fit of a grid: not converged after %d steps", steps)
                gap = whole - 2.0 * kept @ right + kept @ (normal @ kept)
                row[k] = np.sqrt(max(gap / whole, 0.0))
        return found.reshape(2, len(GRID_LABELS), len(GRID_NODES))


def _hats(at: Float64Array, count: int) -> Float64Array:
    """Return functions linear between `count` even nodes of [0, 1], (bins, count)."""
    distance = np.abs(at[:, None] * (count - 1) - np.arange(count))
    return np.asarray(np.maximum(1.0 - distance, 0.0))


def _project(values: Float64Array, axes: Sequence[Float64Array]) -> Float64Array:
    """Return the sums over all bins of values (90, 90, 180) times each axis' functions."""
    along_h, along_d, along_phi = axes
    return np.asarray(np.tensordot(along_h, along_d.T @ (values @ along_phi), (0, 0)))


def _normal_matrix(weight: Float64Array, axes: Sequence[Float64Array]) -> sparse.csr_array:
    """Return the sums over all bins of weight times products of the grid's functions."""
    shape = [axis.shape[1] for axis in axes]
    nodes = np.arange(np.prod(shape)).reshape(shape)
    rows, columns, values = [], [], []
    for steps in product((-1, 0, 1), repeat=3):
        first, second = (
            [slice(max(s, 0), n + min(s, 0)) for s, n in zip(signs, shape, strict=True)]
            for signs in ([-step for step in steps], steps)
        )
        pairs = [axis[:, a] * axis[:, b] for axis, a, b in zip(axes, first, second, strict=True)]
        rows.append(nodes[tuple(first)].ravel())
        columns.append(nodes[tuple(second)].ravel())
        values.append(_project(weight, pairs).ravel())
    at = np.concatenate(rows), np.concatenate(columns)
    return sparse.csr_array((np.concatenate(values), at), shape=(nodes.size,) * 2)


def _mixture_errors(columns: Float32Array, formulas: tables.BrdfBasis) -> dict[str, Float64Array]:
    """Return each table's relative distance from mixtures of formulas and of all other tables."""
    root = _node_weight_roots()[..., None]
    rows = _as_rows(columns * root)
    size = np.linalg.norm(rows, axis=1)
    rows /= size[:, None]
    own = _as_rows(formulas.table[..., : formulas.size] * root)
    weights = mixture_coordinates(rows, own, None)
    of_tables = np.empty(len(rows))
    for k in range(len(rows)):
        others = np.delete(rows, k, axis=0)
        weight = mixture_coordinates(rows[k : k + 1], others, None)
        of_tables[k] = np.linalg.norm(rows[k] - weight[0] @ others)
    return {"formulas": np.linalg.norm(rows - weights @ own, axis=1), "tables": of_tables}


def _node_weight_roots() -> Float64Array:
    """Return the roots of the solid angles of the basis' nodes, (32, 12, 90); 0: not measured."""
    d, phi, h = tables.grid_nodes()
    at_d, at_phi, at_h = np.meshgrid(d, phi, h, indexing="ij")
    light, view = merl.to_directions(at_h, at_d, at_phi)
    known = np.minimum(light[..., 2], view[..., 2]) > MIN_MEASURED_COSINE
    return np.asarray(np.sqrt(known * np.sin(2.0 * at_d) * np.sin(at_h) * np.gradient(h)))


def _as_rows(columns: NDArray[Any]) -> Float64Array:
    return np.ascontiguousarray(columns.reshape(-1, columns.shape[-1]).T, np.float64)


def _fit_held_out(
    reduced: list[ReducedTable],
    columns: Float32Array,
    light: Float64Array,
    view: Float64Array,
    formulas: tables.BrdfBasis,
    rng: np.random.Generator,
) -> dict[str, Float64Array]:
    """Fit noisy samples of some tables; return the relative errors at the held-out pairs."""
    chosen = np.linspace(0, len(reduced) - 1, min(MAX_FITS, len(reduced))).astype(int)
    names = [one.name for one in reduced]
    found: dict[str, list[float]] = {"formulas": [], "tables": []}
    fitted, rest = slice(N_SAMPLES), slice(N_SAMPLES, None)
    up = np.array([0.0, 0.0, 1.0])
    for k in chosen:
        brdf = reduced[k].samples
        value = brdf[fitted] * light[fitted, 2]
        error = SAMPLE_NOISE * (value + value.mean())
        noisy = value + error * rng.standard_normal(len(value))
        value_of_one, variance, to_light, to_view, normals = (
            np.asarray(array, np.float32)[None]
            for array in (noisy, error**2, light[fitted], view[fitted], up)
        )
        samples = brdf_basis.SurfaceSamples(
            value_of_one, variance, to_light, to_view, normals, (value > 0.0)[None]
        )
        others = tables.basis_from_columns(
            np.delete(columns, k, axis=-1), names[:k] + names[k + 1 :], light_radius_rad=0.0
        )
        true = brdf[rest] * light[rest, 2]
        for who, basis in (("formulas", formulas), ("tables", others)):
            weights = brdf_basis.fit_weights(samples, basis).weights[0]
            model = brdf_basis.evaluate(weights, basis, light[rest], view[rest], up)
            gap = (model * light[rest, 2] - true)[true > 0.0]
            found[who].append(float(np.linalg.norm(gap) / np.linalg.norm(true)))
    return {who: np.array(errors) for who, errors in found.items()}


def _draw_directions(rng: np.random.Generator, count: int) -> Float64Array:
    drawn = unit_vectors(rng.standard_normal((8 * count, 3)))
    return np.ascontiguousarray(drawn[drawn[:, 2] > MIN_SAMPLE_COSINE][:count])


def _percentiles(errors: Float64Array) -> dict[str, float]:
    return {str(p): float(np.percentile(errors, p)) for p in ERROR_PERCENTILES}


def _draw_grids(rows: list[dict[str, Any]]) -> bytes:
    figure, axes = new_figure(6.4, 3.2, 1, 2)
    for plot, what in zip(axes[0], ("error", "cube_root_error"), strict=True):
        for grid, label in GRID_LABELS.items():
            own = [row for row in rows if row["grid"] == grid]
            errors = [100.0 * row[what]["50"] for row in own]
            counts = [row["coefficients"] for row in own]
            plot.loglog(counts, errors, "o-", ms=3, label=label.split(":")[0])
        plot.set_xlabel("coefficients")
        plot.set_title("BRDF" if what == "error" else "cube root of the BRDF", fontsize=10)
    axes[0, 0].set_ylabel("median relative error, %")
    axes[0, 0].legend(fontsize=7, frameon=False, loc="lower left")
    return encode_figure(figure)
