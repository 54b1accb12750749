"""Render one light at a time (OLAT) for one camera: trace once, then shadow rays and shading.

Camera rays are traced once per view. Their hits are stored as compact rows, sorted by pixel. For
each light, the rows that face it are tested against the mesh, and the arriving light is shaded and
summed into the pixels.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.rig import View
from rigsim.arrays import BoolArray, Float32Array, Float64Array, Int32Array, UInt8Array, UInt16Array
from rigsim.light import olat_kernels as kernels
from rigsim.light.olat_kernels import (
    BARE_COLUMNS,
    ETA_COLUMN,
    MAX_FUZZ,
    ROWS_PER_CHUNK,
    SKIN_ROWS,
    UINT16_FULL_SCALE,
)
from rigsim.light.surface_brdf import MAX_R_D
from rigsim.mitsuba.led_array import DISC_POINTS, disc_points
from rigsim.render import Caster, GBuffer, g_buffer
from rigsim.render.depth_of_field import LensImage, depth_before_focus, tabulate_defocus

SurfaceLookup = Callable[[GBuffer, Int32Array], tuple[Float32Array, Float32Array]]
"""Returns the shading normals, shape (n, 3), and the surfaces of a G-buffer's rays, shape (n, 7) or
with a coating (n, 11)."""

RAYS_PER_BAND: Final = 1 << 20
"""Camera rays per batch; bounds memory at full resolution."""


NORMAL_SCALE: Final = 32767.0


@dataclass(frozen=True, slots=True, eq=False)
class Lamp:
    """A light in the frame of the mesh."""

    position_mm: Float64Array
    """Center of the emitting disc, shape (3,)."""
    axis: Float64Array
    """Unit vector of the emission axis, shape (3,)."""
    exponent: float
    """Exponent of the intensity's cosine off the axis; nothing is emitted backwards."""
    radius_mm: float
    """Radius of the disc, 0 for a point."""

    def radii(self) -> tuple[Float64Array, Float64Array]:
        """Return two perpendicular radii of the disc, mm, shape (3,) each."""
        axis = np.asarray(self.axis, np.float64)
        helper = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
        side = np.cross(helper, axis)
        side *= self.radius_mm / float(np.linalg.norm(side))
        return side, np.cross(axis, side)


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """Hits of a camera's rays, as rows sorted by pixel."""

    shape: tuple[int, int]
    """Rows and columns of the image."""
    subpixels: int
    """Rays along each side of a pixel."""
    pixel: Int32Array
    """Pixels with at least one row, shape (P,), index into the flat image."""
    first: Int32Array
    """First row of each of these, shape (P + 1,)."""
    position_mm: Float32Array
    """Points, shape (n, 3), frame of the mesh."""
    normal: NDArray[np.int16]
    """Shading normals times `NORMAL_SCALE`, shape (n, 3)."""
    prim: Int32Array
    """Triangles, shape (n,)."""
    slot: UInt8Array
    """Position in the pixel, row by row, below subpixels^2, shape (n,)."""
    uv: UInt16Array
    """Texture coordinates times `UINT16_FULL_SCALE`, shape (n, 2)."""
    surface: UInt16Array
    """Square roots of r_d over its limit (3), roughness, oil, fuzz over its limit, bare; with a
    coating also film, its alpha, its index - 1, powder; times `UINT16_FULL_SCALE`; shape (n, 7) or
    (n, 11). Matt rows store their reflectance as r_d; metal rows also store their alpha as
    roughness."""
    camera_mm: Float64Array
    """Center of projection, shape (3,)."""
    kind: int
    """`SKIN_ROWS`, `MATT_ROWS` or `METAL_ROWS`."""
    lens: LensImage | None = None
    """Lens blur of the rows' light; None: sharp everywhere."""

    def scatter(self, rows: Float32Array) -> Float32Array:
        """Average rows over each pixel's covered part, shape (H, W, C); zero elsewhere."""
        count = np.diff(self.first)
        out = np.zeros((self.shape[0] * self.shape[1], rows.shape[1]), np.float32)
        if len(rows):
            sums = np.add.reduceat(rows, self.first[:-1], axis=0, dtype=np.float64)
            out[self.pixel] = sums / count[:, None]
        return out.reshape(*self.shape, rows.shape[1])

    def coverage(self) -> Float32Array:
        """Return the covered fraction of each pixel, shape (H, W)."""
        out = np.zeros(self.shape[0] * self.shape[1], np.float32)
        out[self.pixel] = np.diff(self.first) / np.float32(self.subpixels**2)
        return out.reshape(self.shape)

    def normals(self) -> Float32Array:
        """Return the shading normals, shape (n, 3)."""
        return np.asarray(self.normal, np.float32) / np.float32(NORMAL_SCALE)

    def texture_uv(self) -> Float32Array:
        """Return the texture coordinates, shape (n, 2)."""
        return np.asarray(self.uv, np.float32) / np.float32(UINT16_FULL_SCALE)


def pack_surface(values: Float32Array) -> UInt16Array:
    """Return `SkinSurface.packed` of `rigsim.light.surface_brdf`, as rows of `Hits.surface`."""
    unit = np.asarray(values, np.float32).copy()
    if not (np.isfinite(unit).all() and unit.min(initial=0.0) >= 0.0):
        raise ValueError("surface: got values that are negative or not finite, expected >= 0")
    unit[:, :3] = np.sqrt(unit[:, :3] / np.float32(MAX_R_D))
    unit[:, 5] /= np.float32(MAX_FUZZ)
    if unit.shape[1] > BARE_COLUMNS:
        unit[:, ETA_COLUMN] = np.maximum(unit[:, ETA_COLUMN] - np.float32(1.0), 0.0)
    if unit.max(initial=0.0) > 1.0 + 1e-6:
        raise ValueError(f"surface: got {unit.max(axis=0)} of its limits, expected at most 1")
    return np.rint(np.minimum(unit, 1.0) * np.float32(UINT16_FULL_SCALE)).astype(np.uint16)


def unpack_surface(surface: UInt16Array) -> Float32Array:
    """Invert `pack_surface`."""
    unit = np.asarray(surface, np.float32) / np.float32(UINT16_FULL_SCALE)
    unit[:, :3] = np.float32(MAX_R_D) * unit[:, :3] ** 2
    unit[:, 5] *= np.float32(MAX_FUZZ)
    if unit.shape[1] > BARE_COLUMNS:
        unit[:, ETA_COLUMN] += np.float32(1.0)
    return unit


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Settings of camera rays and lens."""

    subpixels: int
    """Rays along each side of a pixel."""
    illuminant: str
    """Spectrum of the lights."""
    optics: bool
    """Whether the lens blurs."""


def find_hits(
    caster: Caster,
    view: View,
    look_up: SurfaceLookup,
    settings: CameraSettings,
    kind: int = SKIN_ROWS,
    distortion: ArrayLike | None = None,
) -> Hits:
    """Trace a camera's rays and store their hits.

    Parameters
    ----------
    caster
        The mesh.
    view
        The camera, in the frame of the mesh.
    look_up
        Returns shading normals (n, 3) and surfaces, (n, 7) or (n, 11), for a G-buffer's rows.
    settings
        Settings of the camera.
    kind
        Kind of the rows' reflection.
    distortion
        Distortion of the lens, see `rigsim.render.camera_rays`.

    Returns
    -------
    Hits
        Rows sorted by pixel.
    """
    k, width, height = settings.subpixels, view.width_px, view.height_px
    band = max(1, RAYS_PER_BAND // (width * k * k))
    parts: list[tuple[Any, ...]] = []
    begin, end = _rows_of(caster, view, bent=distortion is not None and bool(np.any(distortion)))
    for top in range(begin, end, band):
        rows = (top, min(top + band, end))
        buffers = g_buffer(caster, view, subpixels=k, rows=rows, distortion=distortion)
        order, pixel, first, slot = pixel_order(buffers.mask, k)
        normal, surface = look_up(buffers, order)
        scaled_uv = buffers.uv.reshape(-1, 2)[order] * np.float32(UINT16_FULL_SCALE)
        parts.append(
            (
                np.repeat(pixel + np.int32(top * width), np.diff(first)),
                buffers.position_mm.reshape(-1, 3)[order],
                np.rint(normal * np.float32(NORMAL_SCALE)).astype(np.int16),
                buffers.prim.reshape(-1)[order],
                slot,
                np.rint(scaled_uv).astype(np.uint16),
                pack_surface(surface),
            )
        )
    owner, position, normals, prim, slots, uv, packed = (
        np.concatenate(column) for column in zip(*parts, strict=True)
    )
    starts = np.flatnonzero(np.diff(owner, prepend=-1))
    pixels, begins = owner[starts], np.append(starts, len(owner)).astype(np.int32)
    shape, eye = (height, width), np.asarray(view.position_mm, np.float64)
    hits = Hits(shape, k, pixels, begins, position, normals, prim, slots, uv, packed, eye, kind)
    return lens_of_hits(hits, view, settings) if settings.optics else hits


def lens_of_hits(hits: Hits, view: View, settings: CameraSettings) -> Hits:
    """Return hits with the blur of the camera's lens."""
    toward = depth_before_focus(view, hits.position_mm)
    depths = float(toward.min(initial=0.0)), float(toward.max(initial=0.0))
    k = hits.subpixels
    spread = tabulate_defocus(view, settings.illuminant, subpixels=k, depths_mm=depths)
    lens = LensImage(spread, hits.shape, hits.pixel, hits.first, hits.slot, toward)
    return dataclasses.replace(hits, lens=lens)


def pixel_order(
    mask: BoolArray, subpixels: int
) -> tuple[Int32Array, Int32Array, Int32Array, UInt8Array]:
    """Return the samples with a hit, sorted by pixel.

    Parameters
    ----------
    mask
        Samples with a hit, shape (H k, W k).
    subpixels
        The k above.

    Returns
    -------
    order : ndarray of int32
        Index into the flat mask, shape (n,).
    pixel, first : ndarray of int32
        Pixels with at least one, index into the flat image, shape (P,), and the first of each,
        shape (P + 1,).
    slot : ndarray of uint8
        Position in the pixel, row by row, shape (n,).

    Examples
    --------
    >>> [part.tolist() for part in pixel_order(np.array([[True, False], [True, True]]), 2)]
    [[0, 2, 3], [0], [0, 3], [0, 2, 3]]
    """
    k, wide = subpixels, mask.shape[1]
    grid = np.arange(mask.size, dtype=np.int32).reshape(-1, k, wide // k, k)
    order = grid.transpose(0, 2, 1, 3).reshape(-1)
    order = order[mask.reshape(-1)[order]]
    across, down = order % wide, order // wide
    owner = down // k * (wide // k) + across // k
    starts = np.flatnonzero(np.diff(owner, prepend=-1))
    slot = (down % k * k + across % k).astype(np.uint8)
    return order, owner[starts], np.append(starts, len(owner)).astype(np.int32), slot


def _rows_of(caster: Caster, view: View, *, bent: bool) -> tuple[int, int]:
    """Return the first image row that the mesh can reach, and the one after the last."""
    offset = caster.mesh.vertices_mm - np.asarray(view.position_mm, np.float32)
    _, up, back = (np.asarray(axis, np.float32) for axis in view.axes)
    depth = -(offset @ back)
    if bent or not float(depth.min()) > 1.0:
        return 0, view.height_px
    row = 0.5 * (view.height_px - 1) - view.focal_px * (offset @ up) / depth
    begin, end = int(row.min()) - 1, int(row.max()) + 3
    begin = min(max(begin, 0), view.height_px - 1)
    return begin, min(max(end, begin + 1), view.height_px)


def is_lamp_visible(hits: Hits, caster: Caster, lamp: Lamp) -> BoolArray:
    """Return which rows have an unoccluded ray to their point on a light.

    Every row has its own point on the disc, and neighbors' points are distributed evenly over it.
    Only shadows depend on these points. Shading uses the disc's center, whose error is the square
    of radius over distance, 2e-4 in the dome, and adds no noise.

    Parameters
    ----------
    hits
        Rows.
    caster
        The mesh that casts shadows.
    lamp
        The light.

    Returns
    -------
    ndarray of bool
        Shape (n,).
    """
    center = np.ascontiguousarray(lamp.position_mm, np.float64)
    side, other = lamp.radii()
    across, along = disc_points(DISC_POINTS)
    points = np.stack([across, along])[:, :, None] * np.stack([side, other])[:, None]
    targets = center + points.sum(axis=0)
    chunks = -(-len(hits.position_mm) // ROWS_PER_CHUNK)
    count = np.zeros(chunks + 1, np.int64)
    kernels.count_facing(hits.position_mm, hits.normal, center, count)
    count = np.cumsum(count)
    index = np.empty(count[-1], np.int32)
    start = np.empty((count[-1], 3), np.float32)
    way = np.empty((count[-1], 3), np.float32)
    length = np.empty(count[-1], np.float32)
    rows, mesh = (hits.position_mm, hits.normal, hits.prim), caster.mesh
    rays = (index, start, way, length)
    kernels.aim_shadow_rays(*rows, mesh.vertices_mm, mesh.faces, center, targets, count, *rays)
    visible = np.zeros(len(hits.position_mm), np.bool_)
    visible[index] = ~caster.is_blocked(start, way, length)
    return visible


def sum_rows(
    hits: Hits, red: Float32Array, green: Float32Array, blue: Float32Array, color: Float32Array
) -> Float32Array:
    """Sum the light of rows, shape (n,) each, times a color, into whole pixels, shape (H, W, 3)."""
    if hits.lens is not None:
        return hits.lens.render(np.stack([red, green, blue], axis=1)) * np.asarray(
            color, np.float32
        )
    out = np.zeros((hits.shape[0] * hits.shape[1], 3), np.float32)
    share = np.asarray(color, np.float32) / np.float32(hits.subpixels**2)
    kernels.sum_rows(hits.pixel, hits.first, red, green, blue, share, out)
    return out.reshape(*hits.shape, 3)


def shade_rows(
    hits: Hits,
    lamp: Lamp,
    visible: BoolArray,
    color: Float32Array,
    glow: Float32Array | None = None,
    *,
    diffuse: bool = True,
    relief: Float32Array | None = None,
) -> Float32Array:
    """Shade rows by one light and sum them into pixels.

    Parameters
    ----------
    hits
        Rows.
    lamp
        The light.
    visible
        Rows to which it is visible, see `is_lamp_visible`.
    color
        Intensity on the light's axis, shape (3,), see `rigsim.light.led_light`.
    glow
        Additional subsurface light of skin, before the boundary: pi times radiance for an
        intensity of 1 mm^2, shape (n, 3).
    diffuse
        False omits skin's own diffuse term, for a glow that includes it.
    relief
        Fraction of the light that the texture's relief leaves to each row, shape (n,); None: 1.

    Returns
    -------
    ndarray of float32
        Shape (H, W, 3), in full scales per second, averaged over whole pixels.
    """
    rows = np.zeros((3, len(hits.position_mm)), np.float32)
    extra = np.zeros((0, 3), np.float32) if glow is None else glow
    center = np.ascontiguousarray(lamp.position_mm, np.float64)
    axis = np.ascontiguousarray(lamp.axis, np.float64)
    faded = np.ones(0, np.float32) if relief is None else relief
    samples = (hits.position_mm, hits.normal, hits.surface, hits.camera_mm, hits.kind)
    light = (center, axis, float(lamp.exponent))
    kernels.shade_rows(samples, light, visible, extra, diffuse, faded, rows)
    return sum_rows(hits, rows[0], rows[1], rows[2], color)
