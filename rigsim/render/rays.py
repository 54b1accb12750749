"""Trace a camera's rays on a mesh, and the visible fraction of a light from its points."""

from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import maximum_filter, minimum_filter

from capture.rig import View
from rigsim.arrays import BoolArray, Float32Array, Int32Array
from rigsim.as_built.dome import undistort
from rigsim.geometry.atlas import interpolate
from rigsim.mitsuba.olat import RAY_OFFSET_MM
from rigsim.mitsuba.render_error import RenderError
from rigsim.render.caster import Caster, normalize


@dataclass(frozen=True, slots=True)
class GBuffer:
    """First hit of each camera ray; shapes (H, W[, C]), row 0 is the top."""

    mask: BoolArray
    """Rays that hit the mesh."""
    prim: Int32Array
    """Triangle that was hit, -1 for none."""
    position_mm: Float32Array
    """Hit point, rig frame; zeros for rays without a hit."""
    normal: Float32Array
    """Unit interpolated shading normal."""
    face_normal: Float32Array
    """Unit normal of the triangle."""
    uv: Float32Array
    """Texture coordinates."""
    to_camera: Float32Array
    """Unit vector from the point to the camera."""

    def hit_samples(
        self,
    ) -> tuple[NDArray[np.int_], Float32Array, Float32Array, Float32Array, Float32Array]:
        """Return index, uv, position, normal and direction to the camera of samples on the mesh.

        Shapes (n,), (n, 2), and (n, 3) thrice; the index is into the flat mask.
        """
        at = np.flatnonzero(self.mask.reshape(-1))
        vectors = (self.position_mm, self.normal, self.to_camera)
        position, normal, to_camera = (part.reshape(-1, 3)[at] for part in vectors)
        return at, self.uv.reshape(-1, 2)[at], position, normal, to_camera


def camera_rays(
    view: View,
    *,
    subpixels: int = 1,
    rows: tuple[int, int] | None = None,
    distortion: ArrayLike | None = None,
) -> tuple[Float32Array, Float32Array]:
    """Return the rays of a camera through its pixels or a regular grid inside them.

    Parameters
    ----------
    view
        The camera; pixel (0, 0) is the top left one.
    subpixels
        Rays along each side of a pixel.
    rows
        First row and the one after the last; ``None`` takes all.
    distortion
        k1, k2, p1, p2, k3 of the lens, see `rigsim.as_built.dome`; ``None`` for a pinhole.

    Returns
    -------
    origins, directions : ndarray of float32
        Shape (H k, W k, 3) each for k subpixels, rig frame in mm, directions of unit length.
    """
    if subpixels < 1:
        raise ValueError(f"subpixels: got {subpixels}, expected at least 1")
    k = subpixels
    right, up, back = (np.array(axis) for axis in view.axes)
    # The center of pixel (0, 0) is (0, 0); the optical axis passes the sensor's center.
    x = (np.arange(view.width_px * k) + 0.5) / k - 0.5 - 0.5 * (view.width_px - 1)
    first, last = (0, view.height_px) if rows is None else rows
    y = (np.arange(first * k, last * k) + 0.5) / k - 0.5 - 0.5 * (view.height_px - 1)
    if distortion is not None and np.any(distortion):
        slopes = np.stack(np.meshgrid(x / view.focal_px, y / view.focal_px), axis=-1)
        slopes = undistort(slopes, distortion)
        bent = slopes[..., :1] * right - slopes[..., 1:] * up - back
        bent /= np.linalg.norm(bent, axis=-1, keepdims=True)
        directions = bent.astype(np.float32)
        return np.broadcast_to(np.asarray(view.position_mm, np.float32), bent.shape), directions
    across, down = x[:, None] * right - view.focal_px * back, y[:, None] * up
    # The axes are perpendicular, so a ray's squared length is the sum of three squares.
    length = np.sqrt(x[None, :] ** 2 + y[:, None] ** 2 + view.focal_px**2)
    directions = ((across[None] - down[:, None]) / length[..., None]).astype(np.float32)
    origins = np.broadcast_to(np.asarray(view.position_mm, np.float32), directions.shape)
    return origins, directions


def g_buffer(
    caster: Caster,
    view: View,
    *,
    subpixels: int = 1,
    rows: tuple[int, int] | None = None,
    distortion: ArrayLike | None = None,
) -> GBuffer:
    """Trace a camera's rays on a mesh into a G-buffer.

    Parameters
    ----------
    caster
        The mesh.
    view
        The camera.
    subpixels
        Rays along each side of a pixel; buffers are that much larger.
    rows
        First row of pixels and the one after the last; ``None`` takes all.
    distortion
        As for `camera_rays`.

    Returns
    -------
    GBuffer
        Point samples, not averages over a pixel.
    """
    origins, directions = camera_rays(view, subpixels=subpixels, rows=rows, distortion=distortion)
    return trace(caster, origins, directions)


def trace(caster: Caster, origins: Float32Array, directions: Float32Array) -> GBuffer:
    """Trace a grid of rays on a mesh; see `g_buffer`, which generates them for a rig's camera.

    Parameters
    ----------
    caster
        The mesh.
    origins, directions
        Start points in mm and unit vectors, shape (H, W, 3), in image order.

    Returns
    -------
    GBuffer
        First hit of each ray.
    """
    shape = directions.shape[:2]
    prim, weight = caster.first_hit(origins.reshape(-1, 3), directions.reshape(-1, 3))
    _close_cracks(caster, origins, directions, prim, weight)
    mesh = caster.mesh
    position, normal, uv = np.split(
        interpolate(caster.attributes, mesh.faces, prim, weight).reshape(*shape, 8), [3, 6], axis=-1
    )
    mask = prim >= 0
    face_normal = np.zeros((len(prim), 3), np.float32)
    face_normal[mask] = caster.face_normals[prim[mask]]
    buffers = GBuffer(
        mask=mask.reshape(shape),
        prim=prim.reshape(shape),
        position_mm=position,
        normal=normalize(normal),
        face_normal=face_normal.reshape(*shape, 3),
        uv=uv,
        to_camera=-directions,
    )
    for name in ("position_mm", "normal", "face_normal", "uv"):
        if not np.isfinite(getattr(buffers, name)).all():
            raise RenderError(f"g-buffer {name}: values that are not finite; check the mesh")
    return buffers


def _close_cracks(
    caster: Caster,
    origins: Float32Array,
    directions: Float32Array,
    prim: Int32Array,
    weight: Float32Array,
) -> None:
    """Retrace rays that slipped between triangles, slightly shifted, in place.

    Ray tracers in single precision occasionally miss a shared edge: one ray without a hit among
    eight that have one.
    """
    hit = np.pad(prim.reshape(directions.shape[:2]) >= 0, 1)
    height, width = directions.shape[:2]
    around = np.zeros((height, width), np.int32)
    for dy in range(3):
        for dx in range(3):
            around += hit[dy : dy + height, dx : dx + width]
    lost = np.flatnonzero(((around == 8) & ~hit[1:-1, 1:-1]).reshape(-1))
    if len(lost):
        aside = directions.reshape(-1, 3)[lost] + np.float32(2e-6) * np.array([1.0, -0.7, 0.3])
        again, share = caster.first_hit(origins.reshape(-1, 3)[lost], aside.astype(np.float32))
        prim[lost], weight[lost] = again, share


def visibility(
    caster: Caster,
    position_mm: Float32Array,
    normal: Float32Array,
    light_mm: ArrayLike,
    *,
    radius_mm: float = 0.0,
    samples: int = 1,
    chosen: BoolArray | None = None,
) -> Float32Array:
    """Return the fraction of a round light that is visible from each surface point.

    Parameters
    ----------
    caster
        The mesh that casts shadows.
    position_mm
        Surface points, shape (..., 3), rig frame.
    normal
        Unit normals, shape (..., 3); rays start on that side of the surface.
    light_mm
        Center of the light, shape (3,); its disc faces the rig's origin.
    radius_mm
        Radius of the disc, 0 for a point.
    samples
        Points on the disc; the same golden spiral for every surface point, rotated by an angle
        that depends on the point's index only.
    chosen
        Points that are evaluated, shape (...); the others get 0. None: all.

    Returns
    -------
    ndarray of float32
        Shape (...), 0 to 1. Points whose normal is turned away from the light's center by more than
        the disc's extent get 0 without a ray.
    """
    if samples < 1 or radius_mm < 0.0:
        raise ValueError(f"samples, radius_mm: got {samples}, {radius_mm}, expected >= 1, >= 0")
    leading = position_mm.shape[:-1]
    points = position_mm.reshape(-1, 3)
    normals = normal.reshape(-1, 3)
    light = np.asarray(light_mm, np.float32)
    seen = np.zeros(len(points), np.float32)
    toward = light - points
    reach = np.einsum("ij,ij->i", toward, normals) > -radius_mm
    if chosen is not None:
        reach &= chosen.reshape(-1)
    index = np.flatnonzero(reach)
    axis = light / max(float(np.linalg.norm(light)), 1e-6)
    helper = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    side = np.cross(helper, axis)
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    start = points[index] + np.float32(RAY_OFFSET_MM) * normals[index]
    golden = np.pi * (3.0 - np.sqrt(5.0))
    # Multiples of the inverse plastic number modulo 1 are a low-discrepancy sequence.
    turn = (index * 0.754877666) % 1.0 * 2.0 * np.pi
    for k in range(samples):
        r = radius_mm * np.sqrt((k + 0.5) / samples) if samples > 1 else 0.0
        angle = turn + k * golden
        target = light + r * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other)
        way = target - start
        length = np.linalg.norm(way, axis=-1)
        way /= length[:, None]
        front = np.einsum("ij,ij->i", way, normals[index]) > 0.0
        ray = np.flatnonzero(front)
        free = ~caster.is_blocked(start[ray], way[ray], length[ray] * np.float32(0.999))
        seen[index[ray]] += free
    return (seen / np.float32(samples)).reshape(leading)


COARSE_STEP: Final = 4
"""Texels between those that choose where shadows need rays."""


def texture_visibility(
    caster: Caster,
    position_mm: Float32Array,
    normal: Float32Array,
    light_mm: ArrayLike,
    *,
    radius_mm: float = 0.0,
    samples: int = 1,
) -> Float32Array:
    """Return `visibility` on a texture; only texels near the edges of shadows get rays.

    Every `COARSE_STEP`-th texel along both axes is traced. Where a coarse texel and its eight
    neighbors have all light, or none, the texels around it have the same. Others are traced.

    Parameters
    ----------
    caster, light_mm, radius_mm, samples
        As for `visibility`.
    position_mm, normal
        Surface points and unit normals, shape (N, N, 3).
    """
    shape = position_mm.shape[:2]
    cast = partial(
        visibility, caster, position_mm, normal, light_mm, radius_mm=radius_mm, samples=samples
    )
    if min(shape) < MIN_COARSE_SIZE:
        return cast()
    nodes = [np.arange(0, n + COARSE_STEP - 1, COARSE_STEP).clip(max=n - 1) for n in shape]
    on_node = np.zeros(shape, np.bool_)
    on_node[np.ix_(*nodes)] = True
    seen = cast(chosen=on_node)
    coarse = seen[np.ix_(*nodes)]
    low, high = minimum_filter(coarse, size=3), maximum_filter(coarse, size=3)
    nearest = np.ix_(
        *(
            np.minimum((np.arange(n) + COARSE_STEP // 2) // COARSE_STEP, len(k) - 1)
            for n, k in zip(shape, nodes, strict=True)
        )
    )
    mixed = (low < high) | ((low > 0.0) & (high < 1.0))
    edge = mixed[nearest] & ~on_node
    out = np.where(on_node | edge, seen, low[nearest])
    out[edge] = cast(chosen=edge)[edge]
    return np.asarray(out, np.float32)


MIN_COARSE_SIZE: Final = 128
"""Texels along a texture's side from which on coarse texels choose the traced ones."""
