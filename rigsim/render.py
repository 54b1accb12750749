"""The only module that talks to Mitsuba: rays against a mesh, and radiance of described scenes.

Rays are traced by Mitsuba's LLVM variants where they work, else by Embree through embreex, which
needs no LLVM; scalar variants of Mitsuba then render what is described as a scene.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from capture.rig import View
from rigsim.atlas import BoolArray, interpolate
from rigsim.dome_build import unbend
from rigsim.mesh import Float32Array, Int32Array, Mesh
from rigsim.variant import Kind, VariantChoice, choose_variant

__all__ = [
    "Caster",
    "GBuffer",
    "MovedLight",
    "RenderError",
    "VariantChoice",
    "camera_rays",
    "choose_variant",
    "g_buffer",
    "load",
    "look_at",
    "radiance",
    "trace",
    "visibility",
]

logger = logging.getLogger(__name__)

RAYS_PER_CALL: Final = 1 << 22
"""Rays traced in one call; bounds the memory that a ray batch takes."""

OFFSET_MM: Final = 0.02
"""Distance by which shadow rays start above the surface; far above float32 steps at 200 mm."""


class RenderError(RuntimeError):
    """Mitsuba gave an image that cannot be used, or cannot be started."""


@dataclass(frozen=True, slots=True)
class GBuffer:
    """What each camera ray meets first; shapes (H, W[, C]), row 0 is the top."""

    mask: BoolArray
    """Rays that meet the mesh."""
    prim: Int32Array
    """Triangle met, -1 for none."""
    position_mm: Float32Array
    """Point met, rig frame, zeros where nothing is met."""
    normal: Float32Array
    """Unit interpolated shading normal."""
    face_normal: Float32Array
    """Unit normal of the triangle."""
    uv: Float32Array
    """Texture coordinates."""
    to_camera: Float32Array
    """Unit vector from the point to the camera."""


class _Tracer(Protocol):
    scene: Any

    def first_hit(
        self, origins: Float32Array, directions: Float32Array
    ) -> tuple[Int32Array, Float32Array]: ...

    def blocked(
        self, origins: Float32Array, directions: Float32Array, length: Float32Array
    ) -> BoolArray: ...


class Caster:
    """Traces rays against one mesh.

    Parameters
    ----------
    mesh
        The mesh; it is copied.
    choice
        Variant to use; ``None`` chooses one for this machine.
    """

    def __init__(self, mesh: Mesh, *, choice: VariantChoice | None = None) -> None:
        self.mesh = mesh
        self.choice = choose_variant("rgb") if choice is None else choice
        self.attributes = np.concatenate([mesh.vertices_mm, mesh.normals, mesh.uv], axis=1)
        self._face_normals: Float32Array | None = None
        self._tracer: _Tracer
        if self.choice.is_vectorized:
            self._tracer = _MitsubaTracer(mesh, self.choice)
        else:
            self._tracer = _EmbreeTracer(mesh)

    @property
    def face_normals(self) -> Float32Array:
        """Unit normals of the triangles, shape (F, 3); zero where one has no area."""
        if self._face_normals is None:
            corners = self.mesh.vertices_mm[self.mesh.faces]
            edges = corners[:, 1:] - corners[:, :1]
            self._face_normals = _unit(np.cross(edges[:, 0], edges[:, 1]))
        return self._face_normals

    @property
    def scene(self) -> Any:
        """Mitsuba's scene of the mesh, for kernels that trace and shade at once, or None."""
        return self._tracer.scene

    def first_hit(
        self, origins: ArrayLike, directions: ArrayLike
    ) -> tuple[Int32Array, Float32Array]:
        """Find the first triangle on each ray.

        Parameters
        ----------
        origins
            Start points in mm, shape (N, 3).
        directions
            Unit vectors, shape (N, 3).

        Returns
        -------
        prim : ndarray of int32
            Triangle met, shape (N,), -1 for none.
        weight : ndarray of float32
            Weights of the triangle's second and third corner, shape (N, 2).
        """
        start, way = _ray_arrays(origins, directions)
        prim = np.empty(len(start), np.int32)
        weight = np.empty((len(start), 2), np.float32)
        for part in _parts(len(start)):
            prim[part], weight[part] = self._tracer.first_hit(start[part], way[part])
        return prim, weight

    def blocked(self, origins: ArrayLike, directions: ArrayLike, length_mm: ArrayLike) -> BoolArray:
        """Tell which rays meet a triangle before their end.

        Parameters
        ----------
        origins
            Start points in mm, shape (N, 3).
        directions
            Unit vectors, shape (N, 3).
        length_mm
            Length of each ray in mm, shape (N,).

        Returns
        -------
        ndarray of bool
            Shape (N,).
        """
        start, way = _ray_arrays(origins, directions)
        length = np.ascontiguousarray(np.broadcast_to(length_mm, len(start)), np.float32)
        out = np.empty(len(start), np.bool_)
        for part in _parts(len(start)):
            out[part] = self._tracer.blocked(start[part], way[part], length[part])
        return out


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
        k1, k2, p1, p2, k3 of the lens, see `rigsim.dome_build`; ``None`` for a pinhole.

    Returns
    -------
    origins, directions : ndarray of float32
        Shape (H k, W k, 3) each for k subpixels, rig frame in mm, directions of unit length.
    """
    if subpixels < 1:
        raise ValueError(f"subpixels: got {subpixels}, expected at least 1")
    k = subpixels
    right, up, back = (np.array(axis) for axis in view.axes)
    # Pixel (0, 0)'s centre is (0, 0); the optical axis meets the middle of the sensor.
    x = (np.arange(view.width_px * k) + 0.5) / k - 0.5 - 0.5 * (view.width_px - 1)
    first, last = (0, view.height_px) if rows is None else rows
    y = (np.arange(first * k, last * k) + 0.5) / k - 0.5 - 0.5 * (view.height_px - 1)
    if distortion is not None and np.any(distortion):
        slopes = np.stack(np.meshgrid(x / view.focal_px, y / view.focal_px), axis=-1)
        slopes = unbend(slopes, distortion)
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
    """Look at a mesh through a camera.

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
        Point samples; nothing is averaged over a pixel.
    """
    origins, directions = camera_rays(view, subpixels=subpixels, rows=rows, distortion=distortion)
    return trace(caster, origins, directions)


def trace(caster: Caster, origins: Float32Array, directions: Float32Array) -> GBuffer:
    """Look at a mesh along a grid of rays; see `g_buffer`, which makes them for a rig's camera.

    Parameters
    ----------
    caster
        The mesh.
    origins, directions
        Start points in mm and unit vectors, shape (H, W, 3), neighbours beside each other.

    Returns
    -------
    GBuffer
        What each ray meets first.
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
        normal=_unit(normal),
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
    """Trace rays again, a little aside, that slipped between triangles, in place.

    Ray tracers in single precision miss a shared edge now and then: one ray without a hit amid
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
) -> Float32Array:
    """Return which part of a round light each surface point sees.

    Parameters
    ----------
    caster
        The mesh that casts shadows.
    position_mm
        Surface points, shape (..., 3), rig frame.
    normal
        Unit normals, shape (..., 3); rays start that side of the surface.
    light_mm
        Centre of the light, shape (3,); its disc faces the rig's origin.
    radius_mm
        Radius of the disc, 0 for a point.
    samples
        Points on the disc; the same golden spiral for every surface point, turned by an angle
        that depends on the point's index only.

    Returns
    -------
    ndarray of float32
        Shape (...), 0 to 1. Points whose normal looks away from the light's centre by more than
        the disc can reach get 0 without a ray.
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
    index = np.flatnonzero(reach)
    axis = light / max(float(np.linalg.norm(light)), 1e-6)
    helper = np.array([0.0, 1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    side = np.cross(helper, axis)
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    start = points[index] + np.float32(OFFSET_MM) * normals[index]
    golden = np.pi * (3.0 - np.sqrt(5.0))
    turn = (index * 0.754877666) % 1.0 * 2.0 * np.pi  # inverse of the plastic number: well spread
    for k in range(samples):
        r = radius_mm * np.sqrt((k + 0.5) / samples) if samples > 1 else 0.0
        angle = turn + k * golden
        target = light + r * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other)
        way = target - start
        length = np.linalg.norm(way, axis=-1)
        way /= length[:, None]
        front = np.einsum("ij,ij->i", way, normals[index]) > 0.0
        ray = np.flatnonzero(front)
        free = ~caster.blocked(start[ray], way[ray], length[ray] * np.float32(0.999))
        seen[index[ray]] += free
    return (seen / np.float32(samples)).reshape(leading)


def radiance(
    description: Mapping[str, Any],
    *,
    kind: Kind,
    samples: int,
    seed: int = 0,
) -> NDArray[np.float32]:
    """Render a described scene.

    Parameters
    ----------
    description
        Mitsuba's scene dictionary, with numbers, texts and arrays only; a ``to_world`` is a 4 x 4
        array, a ``bitmap`` an image; a shape of type ``mesh`` has a `rigsim.mesh.Mesh` as ``mesh``.
    kind
        Variant kind, see `rigsim.variant.choose_variant`.
    samples
        Samples per pixel.
    seed
        Seed of the sampler.

    Returns
    -------
    ndarray of float32
        The film, shape (H, W, channels).

    Raises
    ------
    RenderError
        A light's radiance is negative or not finite, which Mitsuba would render, or the image
        holds values that are not finite.
    """
    _refuse_negative_light(description)
    mi = load(choose_variant(kind))
    scene = mi.load_dict(_with_transforms(mi, description))
    image = np.array(mi.TensorXf(mi.render(scene, spp=samples, seed=seed)).numpy(), np.float32)
    bad = int(np.count_nonzero(~np.isfinite(image).all(axis=-1)))
    if bad:
        raise RenderError(f"Mitsuba gave {bad} pixels that are not finite, expected none")
    return image


_EMISSION = ("radiance", "irradiance", "intensity")


def _refuse_negative_light(description: Mapping[str, Any], where: str = "") -> None:
    shines = ("bitmap",) if description.get("type") == "envmap" else _EMISSION
    for name, entry in description.items():
        value = entry
        if isinstance(entry, Mapping):
            _refuse_negative_light(entry, f"{where}{name}.")
            value = entry.get("value")
        if name in shines and isinstance(value, (int, float, list, tuple, np.ndarray)):
            least, most = (
                float(end(np.asarray(value, np.float64), initial=0.0)) for end in (np.min, np.max)
            )
            if not (least >= 0.0 and most < np.inf):
                raise RenderError(
                    f"{where}{name}: got values of {least:g} to {most:g}, expected finite light, "
                    ">= 0"
                )


class MovedLight:
    """A described scene whose one point light is moved from render to render.

    Nothing is compiled or parsed anew when the light moves, so that the time of a call is the time
    of rendering.

    Parameters
    ----------
    description
        As for `radiance`; the entry ``light`` must be a point light.
    kind
        Variant kind.
    """

    def __init__(self, description: Mapping[str, Any], *, kind: Kind) -> None:
        self._choice = choose_variant(kind)
        mi = load(self._choice)
        self._scene = mi.load_dict(_with_transforms(mi, description))
        self._parameters = mi.traverse(self._scene)

    def radiance(self, light_mm: ArrayLike, *, samples: int, seed: int = 0) -> NDArray[np.float32]:
        """Render with the light at a place, shape (H, W, channels).

        Parameters
        ----------
        light_mm
            Where it stands, shape (3,).
        samples, seed
            As for `radiance`.
        """
        mi = load(self._choice)
        self._parameters["light.position"] = mi.Point3f(*(float(x) for x in np.ravel(light_mm)))
        self._parameters.update()
        image = np.array(mi.render(self._scene, spp=samples, seed=seed).numpy(), np.float32)
        if not np.isfinite(image).all():
            raise RenderError(
                f"light at {np.ravel(light_mm).tolist()} mm: got pixels that are not finite, "
                "expected none; move it off the surface"
            )
        return image


def look_at(origin: ArrayLike, target: ArrayLike, up: ArrayLike) -> NDArray[np.float64]:
    """Return the transform that puts a sensor or a rectangle somewhere, facing somewhere.

    Parameters
    ----------
    origin, target
        Where it stands and what it faces (with its local +z), shape (3,).
    up
        Direction of its local +y, as far as possible, shape (3,).

    Returns
    -------
    ndarray
        Shape (4, 4), for ``to_world``; Mitsuba's local +x points to the left seen from behind.
    """
    place = np.asarray(origin, np.float64)
    forward = np.asarray(target, np.float64) - place
    forward /= np.linalg.norm(forward)
    left = np.cross(np.asarray(up, np.float64), forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3] = np.column_stack([left, np.cross(forward, left), forward, place])
    return matrix


def _with_transforms(mi: Any, description: Mapping[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for name, value in description.items():
        if isinstance(value, Mapping) and value.get("type") == "mesh":
            out[name] = _shape(mi, name, value)
        elif isinstance(value, Mapping):
            out[name] = _with_transforms(mi, value)
        elif isinstance(value, np.ndarray) and name == "bitmap":
            out[name] = mi.Bitmap(np.ascontiguousarray(value, np.float32))
        elif name == "to_world":
            out[name] = mi.ScalarTransform4f(np.asarray(value, np.float64))
        else:
            out[name] = value
    return out


def _shape(mi: Any, name: str, description: Mapping[str, Any]) -> Any:
    """Return Mitsuba's mesh with normals, texture coordinates and a material."""
    mesh: Mesh = description["mesh"]
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(_with_transforms(mi, description["bsdf"]))
    shape = mi.Mesh(
        name,
        len(mesh.vertices_mm),
        len(mesh.faces),
        has_vertex_normals=True,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.ravel(mesh.vertices_mm)
    parameters["vertex_normals"] = np.ravel(mesh.normals)
    parameters["vertex_texcoords"] = np.ravel(mesh.uv)
    parameters["faces"] = np.ravel(mesh.faces).astype(np.uint32)
    parameters.update()
    return shape


def load(choice: VariantChoice) -> Any:
    """Import Mitsuba with a variant set.

    Parameters
    ----------
    choice
        Result of `rigsim.variant.choose_variant`; its library is set before the first import.

    Returns
    -------
    module
        ``mitsuba`` with the variant active.
    """
    mi = _import_mitsuba(choice.library)
    if mi.variant() != choice.name:
        try:
            mi.set_variant(choice.name)
        except ImportError as error:
            raise RenderError(f"Mitsuba's variant {choice.name} is missing: {error}") from error
    return mi


@cache
def _import_mitsuba(library: str) -> Any:
    if library:
        os.environ["DRJIT_LIBLLVM_PATH"] = library
    try:
        import drjit as dr
        import mitsuba as mi
    except ImportError as error:
        raise RenderError(f"Mitsuba cannot be imported: {error}") from error
    dr.set_thread_count(thread_count())
    mi.set_log_level(mi.LogLevel.Error)
    return mi


def thread_count() -> int:
    """Return how many threads rendering may use: this process's cores, at most 16."""
    try:
        cores = len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        cores = os.cpu_count() or 1
    return max(1, min(cores, 16))


SLACK: Final = 64


def with_slack(values: NDArray[np.generic]) -> NDArray[Any]:
    """Return a copy of a row of numbers whose memory goes on beyond its end.

    The renderer works on NumPy's memory itself, in whole vectors of up to 16 numbers, and Embree
    reads 16 bytes at a mesh's last corner: at the end of a page of memory either would read what
    is not the process's, and end it.

    Examples
    --------
    >>> row = with_slack(np.arange(5, dtype=np.float32))
    >>> row.tolist(), row.base.size - row.size
    ([0.0, 1.0, 2.0, 3.0, 4.0], 64)
    """
    held = np.zeros(values.size + SLACK, values.dtype)
    held[: values.size] = values.reshape(-1)
    return held[: values.size]


class _MitsubaTracer:
    def __init__(self, mesh: Mesh, choice: VariantChoice) -> None:
        self._choice = choice
        mi = load(choice)
        shape = mi.Mesh("mesh", len(mesh.vertices_mm), len(mesh.faces))
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = with_slack(np.ravel(mesh.vertices_mm))
        parameters["faces"] = with_slack(np.ravel(mesh.faces).astype(np.uint32))
        parameters.update()
        self.scene: Any = mi.load_dict({"type": "scene", "mesh": shape})

    def _ray(
        self, mi: Any, origins: Float32Array, directions: Float32Array, length: Any = None
    ) -> Any:
        start = mi.Point3f(*(with_slack(origins[:, k]) for k in range(3)))
        way = mi.Vector3f(*(with_slack(directions[:, k]) for k in range(3)))
        ray = mi.Ray3f(start, way)
        if length is not None:
            ray.maxt = mi.Float(with_slack(length))
        return ray

    def first_hit(
        self, origins: Float32Array, directions: Float32Array
    ) -> tuple[Int32Array, Float32Array]:
        mi = load(self._choice)
        hit = self.scene.ray_intersect_preliminary(
            self._ray(mi, origins, directions), coherent=True
        )
        _evaluate(hit)  # else each of the reads below would trace anew
        valid = np.array(hit.is_valid())
        prim = np.where(valid, np.array(hit.prim_index).astype(np.int64), -1).astype(np.int32)
        weight = np.stack([np.array(hit.prim_uv.x), np.array(hit.prim_uv.y)], axis=-1)
        return prim, np.where(valid[:, None], weight, 0.0).astype(np.float32)

    def blocked(
        self, origins: Float32Array, directions: Float32Array, length: Float32Array
    ) -> BoolArray:
        mi = load(self._choice)
        hit = self.scene.ray_test(self._ray(mi, origins, directions, length), coherent=True)
        return np.array(hit, np.bool_)


class _EmbreeTracer:
    def __init__(self, mesh: Mesh) -> None:
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        self.scene: Any = None
        self._scene = rtcore_scene.EmbreeScene()
        TriangleMesh(self._scene, mesh.vertices_mm, mesh.faces)

    def first_hit(
        self, origins: Float32Array, directions: Float32Array
    ) -> tuple[Int32Array, Float32Array]:
        if not len(origins):
            return np.zeros(0, np.int32), np.zeros((0, 2), np.float32)
        hit = self._scene.run(origins, directions, output=True)
        prim = np.asarray(hit["primID"], np.int32)
        weight = np.stack([hit["u"], hit["v"]], axis=-1).astype(np.float32)
        return prim, np.where(prim[:, None] >= 0, weight, np.float32(0.0))

    def blocked(
        self, origins: Float32Array, directions: Float32Array, length: Float32Array
    ) -> BoolArray:
        if not len(origins):
            return np.zeros(0, np.bool_)
        hit = self._scene.run(origins, directions, dists=length.copy(), query="OCCLUDED")
        return np.asarray(hit) != -1


def _evaluate(result: Any) -> None:
    import drjit as dr

    dr.eval(result)


def _ray_arrays(origins: ArrayLike, directions: ArrayLike) -> tuple[Float32Array, Float32Array]:
    start = np.ascontiguousarray(origins, np.float32)
    way = np.ascontiguousarray(directions, np.float32)
    if start.shape != way.shape or start.ndim != 2 or start.shape[1] != 3:
        raise ValueError(f"rays: got shapes {start.shape} and {way.shape}, expected (N, 3) twice")
    return start, way


def _parts(count: int) -> list[slice]:
    return [slice(at, min(at + RAYS_PER_CALL, count)) for at in range(0, count, RAYS_PER_CALL)]


def _unit(vectors: Float32Array) -> Float32Array:
    squared = np.einsum("...i,...i->...", vectors, vectors)
    inverse = np.zeros_like(squared)
    np.divide(np.float32(1.0), np.sqrt(squared), out=inverse, where=squared > 0.0)
    return vectors * inverse[..., None]
