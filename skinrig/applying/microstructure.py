"""Deform relief by the strain of a mesh: kernels per texel and tiled convolution."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from model.microstructure import ALPHA_LIMITS, FOREHEAD, KernelTable
from model.microstructure.convolution import (
    LineKernels,
    Sampling,
    convolve,
    convolve_tiled,
    list_tiles,
)
from model.microstructure.map_windows import MapWindow
from model.microstructure.mesh_strain import MeshStrain, strain
from model.microstructure.strain_fields import (
    KernelRegions,
    TextureStrain,
    line_kernels,
    rasterize,
    regional_kernels,
)
from skinrig.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from skinrig.atomic_file import write_atomically
from skinrig.blend_shapes.meshes import BlendShapeMesh
from skinrig.console import select_attributes

TILE_PX: Final = 2048
JOURNAL_SCHEMA: Final = "skinrig.microstructure-tiles/1"
STATISTICS_SIDE_PX: Final = 1024
"""Side of the texture on which pixel fractions are evaluated."""
MIN_SIGMA_PX: Final = 0.3
"""Minimum effective kernel width; a narrower discrete Gaussian has 99 % of its weight at one
pixel."""
ROWS_PER_DIGEST: Final = 256
"""Rows of a map per hash update."""


class ApplyMicrostructureError(ValueError):
    """Inconsistent relief and mesh, or an output file of another job."""


@dataclass(frozen=True, slots=True)
class MicrostructureReport:
    """Effect of a pose on the relief; shares are fractions of 1.

    Attributes
    ----------
    size_px : (int, int)
        Height and width of the map.
    stretch_s, stretch_t : (float, float)
        Minimum and maximum stretch ratio over vertices.
    fitted_range : (float, float)
        Stretch ratios to which the table, or the first of several, was fitted.
    outside_share : float
        Fraction of vertices with r_s or r_t outside the range of the locally dominant table.
    below_share, above_share : float
        Fraction of vertices with a ratio below, or above, that range.
    extrapolate : str
        Extrapolation mode outside the range.
    clipped_share : float
        Fraction of vertices whose alpha was clipped to [-2, 1].
    invalid_share, degenerate_share, uv_degenerate_share, uv_turned_share : float
        Fraction of vertices without strain; the others are fractions of triangles, see
        `model.microstructure.mesh_strain.MeshStrain`.
    covered_share : float
        Fraction of pixels within a triangle of the texture; others keep the neutral relief.
    changed_share : float
        Fraction of covered pixels whose kernel is not the identity.
    unresolved_share : float
        Fraction of covered pixels whose kernels are narrower than `MIN_SIGMA_PX` and thus have
        almost no effect. It is near 1 for maps of a whole face below about 8K, as microstructure
        requires pixels of 10 to 20 um.
    pixel_um : float
        Median pixel size on the skin over vertices.
    strain_s, convolution_s : float
        Run time of the strain, and of fields and convolution of the tiles of this run.
    tiles, tiles_before : int
        Total number of tiles, and those finished by an interrupted run.
    """

    size_px: tuple[int, int]
    stretch_s: tuple[float, float]
    stretch_t: tuple[float, float]
    fitted_range: tuple[float, float]
    outside_share: float
    below_share: float
    above_share: float
    extrapolate: str
    clipped_share: float
    invalid_share: float
    degenerate_share: float
    uv_degenerate_share: float
    uv_turned_share: float
    covered_share: float
    changed_share: float
    unresolved_share: float
    pixel_um: float
    strain_s: float
    convolution_s: float
    tiles: int
    tiles_before: int


@dataclass(frozen=True, slots=True, eq=False)
class AppliedMicrostructure:
    """Relief under strain, with a report.

    Attributes
    ----------
    height : ndarray of float32, shape (H, W)
        Relief in the unit of the neutral relief; a memory map if `out` was given.
    report : MicrostructureReport
    strain : MeshStrain
        Strain at the mesh's vertices.
    """

    height: Float32Array
    report: MicrostructureReport
    strain: MeshStrain


def apply_microstructure(
    mesh: BlendShapeMesh,
    weights: Mapping[str, float],
    neutral_height: Any,
    table: KernelTable | KernelRegions = FOREHEAD,
    *,
    valid: Any = None,
    extrapolate: Literal["hold", "formula"] = "hold",
    sampling: Sampling = "cubic",
    tile: int = TILE_PX,
    out: Path | str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> AppliedMicrostructure:
    """Deform relief by the strain of a mesh under blend-shape weights.

    Parameters
    ----------
    mesh : BlendShapeMesh
        Mesh, mm; the scale of its texture determines the kernels' widths in pixels.
    weights : mapping of str to float
        Weight by blend shape.
    neutral_height : array or memory map, shape (H, W)
        Displacement in the mesh's texture, any unit; row 0 is the top (v = 1).
    table : KernelTable or KernelRegions
        Kernels over stretch ratios; or several tables with their regions.
    valid : array or memory map of bool, shape (H, W), optional
        Heights that may be sampled; non-finite heights are always excluded.
    extrapolate : {"hold", "formula"}
        Extrapolation outside the table's range, see `model.microstructure.kernel_parameters`.
    sampling : {"cubic", "linear"}
        Interpolation, see `model.microstructure.convolution.convolve`.
    tile : int
        Width and height of tiles, pixels; the result does not depend on it.
    out : path, optional
        A .npy file for the result, written as a memory map. Until all tiles are finished,
        ``<out>.tiles.json`` lists those that are, so that the same call resumes an interrupted one.
    progress : callable, optional
        Called with the number of finished tiles and their total.

    Returns
    -------
    AppliedMicrostructure

    Raises
    ------
    ApplyMicrostructureError
        If heights are not a map, or `out` belongs to another job.
    rigsim.geometry.mesh.MeshError
        If the mesh lacks a blend shape.
    """
    shape = tuple(int(side) for side in np.shape(neutral_height))
    if len(shape) != 2 or min(shape) < 1:
        raise ApplyMicrostructureError(f"neutral_height: got shape {shape}, expected (H, W)")
    if valid is not None and tuple(np.shape(valid)) != shape:
        raise ApplyMicrostructureError(f"valid: got shape {np.shape(valid)}, expected {shape}")
    size = (shape[0], shape[1])
    regions = (
        table if isinstance(table, KernelRegions) else KernelRegions((table,), np.ones((1, 1, 1)))
    )
    begin = time.perf_counter()
    moved = mesh.deform(weights)
    found = strain(mesh.vertices_mm, moved, mesh.faces, mesh.uv)
    pose = _Pose(mesh, found, regions, size, extrapolate)
    strain_s = time.perf_counter() - begin

    def valid_at(window: MapWindow) -> BoolArray:
        return np.asarray(valid[window.rows, window.columns], bool)

    if out is None:
        journal = _Tiles(np.empty(size, np.float32), [])
    else:
        job = _hash_job(
            moved, mesh, neutral_height, valid, regions, (extrapolate, sampling, str(tile))
        )
        journal = _Journal.open(Path(out), job, size)
    before = list(journal.finished)

    def finished(number: int, count: int) -> None:
        journal.add(number)
        if progress is not None:
            progress(len(journal.finished), count)

    begin = time.perf_counter()
    convolve_tiled(
        neutral_height,
        journal.target,
        pose.kernels,
        tile=tile,
        sampling=sampling,
        valid_at=None if valid is None else valid_at,
        finished=before,
        progress=finished,
    )
    journal.close()
    convolution_s = time.perf_counter() - begin
    report = MicrostructureReport(
        size_px=size,
        fitted_range=regions.tables[0].stretch_range,
        extrapolate=extrapolate,
        strain_s=strain_s,
        convolution_s=convolution_s,
        tiles=len(list_tiles(size, tile)),
        tiles_before=len(before),
        **select_attributes(found, "degenerate_share", "uv_degenerate_share", "uv_turned_share"),
        **pose.shares(),
        **pose.compute_vertex_figures(),
    )
    return AppliedMicrostructure(journal.target, report, found)


def convolve_by_strain(
    height: Float32Array, found: MeshStrain, faces: Int64Array, uv: Float64Array, table: KernelTable
) -> tuple[Float32Array, TextureStrain]:
    """Convolve a map in memory by the strain of its mesh; also return the strain per pixel."""
    field = rasterize(found, faces, uv, (height.shape[0], height.shape[1]))
    s, t = line_kernels(field, table)
    return convolve(height, s.axis, t.axis, s.alpha, s.sigma_px, t.alpha, t.sigma_px), field


def strain_image(field: TextureStrain) -> Float32Array:
    """Return r_s, r_t and the angle of axis s from +x towards +y, rad, (H, W, 3).

    Examples
    --------
    >>> one = np.ones((1, 1), bool)
    >>> axes = np.array([[[[0.0, -1.0], [1.0, 0.0]]]], np.float32)  # s points up
    >>> stretch = np.array([[[1.2, 0.9]]], np.float32)
    >>> strain_image(TextureStrain(stretch, axes, stretch, one, one)).round(3).tolist()
    [[[1.2000000476837158, 0.8999999761581421, 1.5709999799728394]]]
    """
    x, y = field.axes[..., 0, 0], -field.axes[..., 0, 1]
    angle = np.arctan2(y, x)
    angle = np.where(angle > 0.5 * np.pi + 1e-6, angle - np.pi, angle)  # an axis has no sign
    angle = np.where(angle <= -0.5 * np.pi, angle + np.pi, angle)
    return np.concatenate([field.stretch, angle[..., None]], axis=-1).astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    """A mesh under strain, and the kernels of its skin."""

    mesh: BlendShapeMesh
    strain: MeshStrain
    regions: KernelRegions
    size: tuple[int, int]
    """Rows and columns of the map."""
    extrapolate: Literal["hold", "formula"]

    def kernels(self, window: MapWindow) -> tuple[LineKernels, LineKernels]:
        """Return the kernels at the pixels of a window."""
        shown = rasterize(self.strain, self.mesh.faces, self.mesh.uv, self.size, window=window)
        how: dict[str, Any] = {"window": window, "extrapolate": self.extrapolate}
        return regional_kernels(shown, self.regions, self.size, **how)

    def shares(self) -> dict[str, Any]:
        """Return fractions of covered pixels and, of these, of changed and unresolved ones."""
        coarser = math.ceil(max(self.size) / STATISTICS_SIDE_PX)
        few = (math.ceil(self.size[0] / coarser), math.ceil(self.size[1] / coarser))
        shown = rasterize(self.strain, self.mesh.faces, self.mesh.uv, few, pad_px=0)
        changed, narrow = np.zeros((2, *few), bool)
        for lines in regional_kernels(shown, self.regions, few, extrapolate=self.extrapolate):
            sigma_px = coarser * lines.sigma_px[shown.covered]
            asked = (lines.alpha[shown.covered] != 0.0) & (sigma_px > 0.0)
            wide = sigma_px >= MIN_SIGMA_PX
            changed[shown.covered] |= asked & wide
            narrow[shown.covered] |= asked & ~wide
        covered = max(int(shown.covered.sum()), 1)
        return {
            "covered_share": float(shown.covered.mean()),
            "changed_share": float(changed.sum() / covered),
            "unresolved_share": float((narrow & ~changed).sum() / covered),
        }

    def compute_vertex_figures(self) -> dict[str, Any]:
        """Return the report's entries over vertices: stretch, range, pixel size."""
        found, good = self.strain, self.strain.valid
        if not good.any():
            raise ApplyMicrostructureError(
                "mesh: got no triangle with an area and a texture area, expected some; check its "
                "texture coordinates"
            )
        both = np.stack([found.r_s[good], found.r_t[good]])
        own = self.regions.table_at(self.mesh.uv[good])
        below, above, clipped = np.zeros((3, *both.shape), bool)
        for number, table in enumerate(self.regions.tables):
            (low, high), there = table.stretch_range, own == number
            ratios = both[:, there]
            below[:, there], above[:, there] = ratios < low, ratios > high
            held = np.clip(ratios, low, high) if self.extrapolate == "hold" else ratios
            alpha = table.unlimited_alpha(held)
            clipped[:, there] = (alpha < ALPHA_LIMITS[0]) | (alpha > ALPHA_LIMITS[1])
        height, width = self.size
        scales = ((found.axis_s, found.uv_per_mm_s), (found.axis_t, found.uv_per_mm_t))
        px_per_mm = [
            np.hypot(axis[good, 0] * width, axis[good, 1] * height) * uv_per_mm[good]
            for axis, uv_per_mm in scales
        ]
        counted = {"outside": below | above, "below": below, "above": above, "clipped": clipped}
        shares = {f"{name}_share": float(v.any(axis=0).mean()) for name, v in counted.items()}
        return {
            "stretch_s": (float(both[0].min()), float(both[0].max())),
            "stretch_t": (float(both[1].min()), float(both[1].max())),
            "invalid_share": float(1.0 - good.mean()),
            "pixel_um": float(1e3 / np.median(px_per_mm)),
            **shares,
        }


def _hash_job(
    moved: Float64Array,
    mesh: BlendShapeMesh,
    height: Any,
    valid: Any,
    regions: KernelRegions,
    settings: tuple[str, ...],
) -> str:
    """Return a digest of everything that the result depends on."""
    digest = hashlib.blake2b(digest_size=16)
    for array in (moved, mesh.vertices_mm, mesh.uv, mesh.faces):
        digest.update(np.ascontiguousarray(array).data)
    for each in (height, valid, *regions.weights):
        if each is not None:
            digest.update(f"{each.dtype} {tuple(each.shape)}".encode())
            for top in range(0, each.shape[0], ROWS_PER_DIGEST):
                digest.update(np.ascontiguousarray(each[top : top + ROWS_PER_DIGEST]).data)
    digest.update(json.dumps([*(table.to_json() for table in regions.tables), *settings]).encode())
    return digest.hexdigest()


@dataclass(slots=True, eq=False)
class _Tiles:
    """A map with its finished tiles."""

    target: Any
    finished: list[int]

    def add(self, number: int) -> None:
        self.finished.append(number)

    def close(self) -> None:
        """Do nothing, as a map in memory needs no clean-up."""


@dataclass(slots=True, eq=False)
class _Journal(_Tiles):
    """List of the finished tiles of a file, stored next to it."""

    path: Path
    job: str

    @classmethod
    def open(cls, out: Path, job: str, size: tuple[int, int]) -> _Journal:
        path = out.with_name(out.name + ".tiles.json")
        if out.suffix != ".npy":
            raise ApplyMicrostructureError(
                f"out: got {out.name!r}, expected a name that ends in .npy; rename it"
            )
        if path.exists() and out.exists():
            try:
                document = json.loads(path.read_text("utf-8"))
                known = document["schema"] == JOURNAL_SCHEMA
                same, done = (
                    document["job"] == job,
                    [int(number) for number in document["finished"]],
                )
            except (ValueError, KeyError, TypeError) as error:
                raise ApplyMicrostructureError(
                    f"{path}: not a list of tiles ({error}); remove it"
                ) from error
            if not (known and same):
                raise ApplyMicrostructureError(
                    f"{path}: belongs to another relief, mesh, pose or setting; "
                    "remove it, or choose another file"
                )
            target = np.load(out, mmap_mode="r+")
            if target.shape != size or target.dtype != np.float32:
                raise ApplyMicrostructureError(f"{out}: got {target.dtype} {target.shape}")
            return cls(target, done, path, job)
        out.parent.mkdir(parents=True, exist_ok=True)
        target = np.lib.format.open_memmap(out, "w+", np.float32, size)
        journal = cls(target, [], path, job)
        journal._write()
        return journal

    def add(self, number: int) -> None:
        self.target.flush()
        self.finished.append(number)
        self._write()

    def _write(self) -> None:
        document = {"schema": JOURNAL_SCHEMA, "job": self.job, "finished": self.finished}
        write_atomically(self.path, json.dumps(document))

    def close(self) -> None:
        self.target.flush()
        self.path.unlink(missing_ok=True)
