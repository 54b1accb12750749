"""Store samples of many surface points, written image by image and read point by point.

Each image is read once. Its samples of the points are one row of its camera's table, on disk where
a folder is given; a chunk of points reads its columns of all rows. Memory contains one image, one
row and one chunk, however many points there are. Without a folder the tables are in memory, as are
the chunks of a small surface, which every estimate reads.
"""

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike, DTypeLike, NDArray

from model.checks import Checks
from reconstruction.arrays import BoolArray, Float32Array, Float64Array, FloatArray, Int32Array
from reconstruction.lumitexels.ray_casting import RayCaster
from reconstruction.lumitexels.samples import (
    MIN_VISIBLE_COSINE,
    SHADOW_RAY_OFFSET_MM,
    CameraProjection,
    LightSources,
    Lumitexels,
    SampledSurface,
    compute_visibility,
)

BYTES_PER_SAMPLE: Final = 57
"""Bytes of one sample of `Lumitexels`."""
MAX_CACHED_BYTES: Final = 2**28
"""Up to this size chunks are cached for the next estimate, unless the tables are on disk."""


@dataclass(frozen=True, slots=True, eq=False)
class ViewSamples:
    """Samples of all images of one camera, as `LumitexelStore` keeps them."""

    table: NDArray[Any] | None
    """(L, 2, rows, 3): signal and its standard error over ``scale``; None: in the folder."""
    scale: Float32Array
    """(L, 2)."""


class LumitexelStore:
    """Lumitexels of a surface, filled image by image.

    Parameters
    ----------
    surface : SampledSurface
        Points in the frame of the reconstruction.
    cameras : sequence of CameraProjection
    lights : LightSources
    caster : RayCaster
        Geometry that casts shadows.
    poses : array_like, shape (L, 4, 4) or (V L, 4, 4), optional
        Motion of the subject: transforms the points to their positions, by light (all cameras
        expose together) or by frame. Needs `lights` to be a dataclass with ``position_mm`` and,
        where the lights have one, ``axis``. Shadows are those of the pose at rest.
    binning : int
        Camera pixels along each side of an image pixel: 2 for images of 2 x 2 cells.
    light_radius_mm, offset_mm : float
        See `reconstruction.lumitexels.compute_visibility`.
    folder : Path, optional
        Existing folder for the tables; in memory by default. Tables of an equal store in it keep
        their content.
    dtype : dtype
        Type of the tables. float16 resolves 0.05 %, well below the noise of a sample, of values
        that are scaled row by row.
    """

    def __init__(
        self,
        surface: SampledSurface,
        *,
        cameras: Sequence[CameraProjection],
        lights: LightSources,
        caster: RayCaster,
        poses: ArrayLike | None = None,
        binning: int = 1,
        light_radius_mm: float = 0.0,
        offset_mm: float = SHADOW_RAY_OFFSET_MM,
        folder: Path | None = None,
        dtype: DTypeLike = np.float16,
    ) -> None:
        self.surface = surface
        self.light_count = len(lights.position_mm)
        self._cameras, self._lights, self._binning = tuple(cameras), lights, binning
        self._poses = _checked_poses(poses, len(cameras), self.light_count)
        Checks().within("binning", binning, "[1, inf)")
        seen = compute_visibility(
            surface,
            caster,
            cameras_mm=np.array([camera.center_mm for camera in cameras]).reshape(-1, 3),
            lights_mm=lights.position_mm,
            light_radius_mm=light_radius_mm,
            offset_mm=offset_mm,
        )
        self._lit = np.packbits(seen.light, axis=0, bitorder="little")  # (L / 8, P)
        self._rows = [np.flatnonzero(row).astype(np.int32) for row in seen.view]
        self._scale = np.zeros((len(cameras), self.light_count, 2), np.float32)
        self._on_disk = folder is not None
        self._kept_bytes = 0 if self._on_disk else MAX_CACHED_BYTES
        self._kept: dict[tuple[int, int], Lumitexels] = {}
        self._lock = threading.Lock()
        self._tables = [
            _table(folder, view, (self.light_count, 2, len(rows), 3), np.dtype(dtype))
            for view, rows in enumerate(self._rows)
        ]

    @property
    def view_count(self) -> int:
        """Number of cameras."""
        return len(self._cameras)

    def add(
        self,
        view: int,
        light: int,
        signal: FloatArray,
        variance: FloatArray,
        good: BoolArray | None = None,
        *,
        response: Callable[[FloatArray], FloatArray] | None = None,
    ) -> None:
        """Sample one image at the points.

        Parameters
        ----------
        view, light : int
            Indices into cameras and lights.
        signal, variance : ndarray, shape (H, W, 3)
            In the unit of the lights' irradiance, and its square.
        good : ndarray of bool, shape (H, W), optional
            Usable pixels; all by default. Non-finite pixels are never used.
        response : callable, optional
            Returns the camera's relative response, shape (N, 3), at camera pixels, shape (N, 2);
            the signal is divided by it.
        """
        Checks().shape("signal", signal, ("H", "W", 3))
        Checks().shape("variance", variance, signal.shape)
        Checks().shape("good", good, signal.shape[:2])
        self._kept.clear()
        points = self.surface.points_mm[self._rows[view]]
        pose = self._pose(view, light)
        if pose is not None:
            points = points @ pose[:3, :3].T.astype(np.float32) + pose[:3, 3].astype(np.float32)
        pixels = self._cameras[view].project(points)
        xy = (pixels - 0.5 * (self._binning - 1)) / self._binning
        usable = np.ones(signal.shape[:2], np.bool_) if good is None else good
        row = np.empty((2, len(points), 3), np.float32)
        _sample(
            np.ascontiguousarray(signal, np.float32),
            np.ascontiguousarray(variance, np.float32),
            np.ascontiguousarray(usable),
            np.ascontiguousarray(xy, np.float32),
            row,
        )
        if response is not None:
            row /= np.asarray(response(pixels), np.float32)
        for kind in range(2):
            values = np.abs(row[kind])
            top = float(np.max(values, where=np.isfinite(values), initial=0.0))
            self._scale[view, light, kind] = top if top > 0 else 1.0
        self._tables[view][light] = row / self._scale[view, light, :, None, None]

    def view_samples(self, view: int) -> ViewSamples:
        """Return the samples of one camera; do not modify them. Tables on disk are flushed."""
        table = self._tables[view]
        if isinstance(table, np.memmap):
            table.flush()
        return ViewSamples(None if self._on_disk else table, self._scale[view].copy())

    def put_view(self, view: int, samples: ViewSamples) -> None:
        """Replace the samples of one camera by those of `view_samples` of an equal store."""
        self._kept.clear()
        if samples.table is not None and samples.table is not self._tables[view]:
            self._tables[view][...] = samples.table
        self._scale[view] = samples.scale

    def chunks(self, size: int) -> Iterator[tuple[slice, Lumitexels]]:
        """Yield the lumitexels of all points, at most `size` at a time (about 60 B per sample)."""
        Checks().within("size", size, "[1, inf)")
        for start in range(0, len(self.surface), size):
            stop = min(start + size, len(self.surface))
            yield slice(start, stop), self.chunk(start, stop)

    def chunk(self, start: int, stop: int) -> Lumitexels:
        """Return the lumitexels of the points in [start, stop); do not modify them."""
        part = (start, stop)
        if part in self._kept:
            return self._kept[part]
        found = self._samples(slice(start, stop))
        with self._lock:  # several threads read chunks at once
            samples = sum(kept.valid.size for kept in (found, *self._kept.values()))
            if BYTES_PER_SAMPLE * samples <= self._kept_bytes:
                self._kept[part] = found
        return found

    def points(self, indices: NDArray[np.integer]) -> Lumitexels:
        """Return the lumitexels of the points of ascending indices, shape (P,)."""
        return self._samples(np.asarray(indices))

    def _samples(self, part: slice | NDArray[np.integer]) -> Lumitexels:
        points = self.surface.points_mm[part].astype(np.float64)
        normals = self.surface.normals[part]
        count, views, lights = len(points), len(self._cameras), self.light_count
        f = np.zeros((count, views, lights, 3), np.float32)
        variance = np.full((count, views, lights, 3), np.inf, np.float32)
        light_dir = np.empty((count, views, lights, 3), np.float32)
        view_dir = np.empty((count, views, lights, 3), np.float32)
        cosines = np.empty((2, count, views, lights), np.float32)
        valid = np.zeros((count, views, lights), np.bool_)
        lit = np.unpackbits(self._lit[:, part], axis=0, bitorder="little", count=lights)
        geometry: tuple[FloatArray, FloatArray] | None = None
        for view in range(views):
            if geometry is None or self._differs_by_view():
                geometry = self._light_geometry(view, points)
            columns, places = _find_columns(self._rows[view], part)
            _assemble(
                np.asarray(self._tables[view][:, :, columns]).astype(np.float32),
                self._scale[view],
                places,
                lit,
                *geometry,
                self._view_geometry(view, points),
                normals,
                (f[:, view], variance[:, view], light_dir[:, view], view_dir[:, view]),
                (cosines[0, :, view], cosines[1, :, view]),
                valid[:, view],
            )
        samples = views * lights
        return Lumitexels(
            f.reshape(count, samples, 3),
            variance.reshape(count, samples, 3),
            light_dir.reshape(count, samples, 3),
            view_dir.reshape(count, samples, 3),
            cosines[0].reshape(count, samples),
            cosines[1].reshape(count, samples),
            np.tile(np.arange(lights, dtype=np.int32), views),
            np.repeat(np.arange(views, dtype=np.int32), lights),
            valid.reshape(count, samples),
        )

    def _pose(self, view: int, light: int) -> Float64Array | None:
        return None if self._poses is None else self._poses[view, light]

    def _differs_by_view(self) -> bool:
        return self._poses is not None and bool((self._poses != self._poses[:1]).any())

    def _light_geometry(self, view: int, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return directions and irradiance, shape (L, P, 3) each, in the frame of the points."""
        lights = self._lights if self._poses is None else _moved(self._lights, self._poses[view])
        direction, white = lights.irradiance(points)
        return (
            np.ascontiguousarray(direction, np.float32),
            np.ascontiguousarray(white, np.float32),
        )

    def _view_geometry(self, view: int, points: FloatArray) -> Float32Array:
        """Return unit vectors to the camera, shape (1 or L, P, 3), in the frame of the points."""
        center = self._cameras[view].center_mm[None]
        if self._poses is not None:
            center = _back(self._poses[view], center[0])
        way = center[:, None] - points[None]
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        return np.ascontiguousarray(way, np.float32)


def _find_columns(
    rows: Int32Array, part: slice | NDArray[np.integer]
) -> tuple[slice | NDArray[np.integer], Int32Array]:
    """Return a table's columns of the points that its camera sees, and their places in the part."""
    if isinstance(part, slice):
        first, last = np.searchsorted(rows, (part.start, part.stop))
        return slice(first, last), rows[first:last] - np.int32(part.start)
    _, places, columns = np.intersect1d(part, rows, assume_unique=True, return_indices=True)
    return columns, places.astype(np.int32)


def _table(
    folder: Path | None, view: int, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> NDArray[Any]:
    """Return a table of NaN; on disk it is sparse until it is written, or an earlier one."""
    if folder is None or 0 in shape:
        return np.full(shape, np.nan, dtype)
    path = folder / f"view{view:03d}.npy"
    # a row that is never written has scale 0, which _assemble masks
    with suppress(OSError, ValueError):  # of another store, or cut
        found = np.lib.format.open_memmap(path, mode="r+")
        if found.shape == shape and found.dtype == dtype:
            return found
    return np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=shape)


def _checked_poses(poses: ArrayLike | None, views: int, lights: int) -> Float64Array | None:
    if poses is None:
        return None
    given = np.asarray(poses, np.float64)
    if given.shape == (lights, 4, 4):
        given = np.broadcast_to(given, (views, lights, 4, 4))
    elif given.shape == (views * lights, 4, 4):
        given = given.reshape(views, lights, 4, 4)
    else:
        raise ValueError(
            f"poses: got shape {given.shape}, expected ({lights}, 4, 4) or "
            f"({views * lights}, 4, 4); give one pose per light or per frame"
        )
    turn = given[..., :3, :3]
    if not np.allclose(turn @ np.swapaxes(turn, -1, -2), np.eye(3), atol=1e-6):
        raise ValueError("poses: got matrices that are not rigid; normalize their rotations")
    return given


def _back(poses: Float64Array, point: FloatArray) -> Float64Array:
    """Return the position of a fixed rig point in the subject's frames, shape (L, 3)."""
    # a pose x = R p + t has the inverse p = R' (x - t)
    return np.asarray(np.einsum("lji,lj->li", poses[:, :3, :3], point - poses[:, :3, 3]))


def _moved(lights: LightSources, poses: Float64Array) -> LightSources:
    """Return the lights in the subject's frame at each light's pose."""
    names = getattr(lights, "__dataclass_fields__", {})
    if "position_mm" not in names:
        got = f"got {type(lights).__name__}, expected a dataclass"
        raise TypeError(f"lights: {got}; give a table with position_mm")
    held: Any = lights
    turn, shift = poses[:, :3, :3], poses[:, :3, 3]
    changes: dict[str, Any] = {
        "position_mm": np.einsum("lji,lj->li", turn, held.position_mm - shift)
    }
    if "axis" in names:
        changes["axis"] = np.einsum("lji,lj->li", turn, held.axis)
    moved: LightSources = replace(held, **changes)
    return moved


@njit(cache=True, nogil=True)
def _sample(signal, variance, good, xy, row):  # type: ignore[no-untyped-def]
    """Sample an image bilinearly at xy; NaN where one of the pixels is missing or invalid."""
    height, width = good.shape
    for p in range(xy.shape[0]):
        x, y = xy[p, 0], xy[p, 1]
        inside = x >= 0.0 and y >= 0.0 and x <= width - 1 and y <= height - 1
        if not inside:  # also False for NaN
            row[:, p] = np.nan
            continue
        i, j = min(int(y), height - 2), min(int(x), width - 2)
        b, a = np.float32(y - i), np.float32(x - j)
        row[:, p] = 0.0
        for di in range(2):
            for dj in range(2):
                weight = (b if di else 1 - b) * (a if dj else 1 - a)
                if weight <= 0.0:
                    continue
                if not good[i + di, j + dj]:
                    row[:, p] = np.nan
                for c in range(3):
                    row[0, p, c] += weight * signal[i + di, j + dj, c]
                    row[1, p, c] += weight * weight * variance[i + di, j + dj, c]
        for c in range(3):
            row[1, p, c] = np.sqrt(row[1, p, c])


@njit(cache=True, parallel=True)
def _assemble(  # type: ignore[no-untyped-def]
    table, scale, rows, lit, light_dir, white, view_dir, normals, out, cosines, valid
):
    """Divide the samples of one view by irradiance and cosine, and mask the invalid ones."""
    f, variance, light_out, view_out = out
    cos_light, cos_view = cosines
    lights, points = lit.shape
    slot = np.full(points, -1, np.int32)
    for k in range(len(rows)):
        slot[rows[k]] = k
    for p in prange(points):
        for m in range(lights):
            v = view_dir[m if view_dir.shape[0] > 1 else 0, p]
            cl, cv = np.float32(0.0), np.float32(0.0)
            for c in range(3):
                light_out[p, m, c] = light_dir[m, p, c]
                view_out[p, m, c] = v[c]
                cl += light_dir[m, p, c] * normals[p, c]
                cv += v[c] * normals[p, c]
            cos_light[p, m], cos_view[p, m] = cl, cv
            k = slot[p]
            if k < 0 or not lit[m, p] or scale[m, 0] == 0.0:
                continue
            if cl <= MIN_VISIBLE_COSINE or cv <= MIN_VISIBLE_COSINE:
                continue
            fine = True
            for c in range(3):
                signal = table[m, 0, k, c]
                spread = table[m, 1, k, c]
                fine &= np.isfinite(signal) and np.isfinite(spread) and white[m, p, c] > 0.0
            if not fine:
                continue
            valid[p, m] = True
            for c in range(3):
                over = np.float32(1.0) / (np.float32(np.pi) * white[m, p, c] * cl)
                f[p, m, c] = table[m, 0, k, c] * scale[m, 0] * over
                spread = table[m, 1, k, c] * scale[m, 1] * over
                variance[p, m, c] = spread * spread
