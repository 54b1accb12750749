"""Integrator `olat`: direct light of one light at a time, without noise.

.. code-block:: python

    "type": "olat", "subpixels": 2, "offset_mm": 0.004, "shadows": True

Camera rays through a regular grid in each pixel are traced once. For each light, one shadow ray
goes from each hit to a point of the light's disc, from a low-discrepancy sequence; the reflection
is evaluated toward the disc's center, whose error is the square of radius over distance. Light
between surfaces is left out. `mi.render` returns the sum over all lights; `stream` yields an image
for each light, so that memory does not grow with their number.

`shade_polarized` gives Stokes vectors at the camera for LEDs behind polarizers, also in variants
without polarization. With `analyzer_deg`, images are those behind an analyzer: the angle of its
transmission axis from the image's x axis toward its top, and `analyzer_leak`, its transmittance
across that axis over the one along it.

Lights are the LEDs of each `ledarray` and any other emitter as one. The BSDF `skincoat` is looked
up once for each hit; any other BSDF is evaluated for each light.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigsim.arrays import BoolArray, Float32Array, Int32Array
from rigsim.mitsuba.image_hits import NOTHING_ADDED, AddedLight, HitBand, ImageHits
from rigsim.mitsuba.led_array import DISC_POINTS, disc_points
from rigsim.mitsuba.memory import pad_memory
from rigsim.mitsuba.plugin_class import define_plugin
from rigsim.mitsuba.polarized_light import FilmedLight, double_angle

RAYS_PER_BAND: Final = 1 << 21
"""Camera rays that are traced together; bounds memory at full resolution."""

RAY_OFFSET_MM: Final = 0.004
"""Distance by which shadow rays start above a triangle: far above float32 steps at 300 mm. With
0.02 mm, light passed over rounded skin at terminators: up to 10 % of the darkest pixels there."""

_COLOR: Final = np.dtype("V12")  # three float32 at once: half the time of an assignment


class _Olat:
    """One light at a time; see the module."""

    mi: Any
    dr: Any

    def __init__(self, properties: Any) -> None:
        mi = self.mi
        self.mi.SamplingIntegrator.__init__(self, properties)
        self.subpixels = int(properties.get("subpixels", 2))
        if self.subpixels < 1:
            raise ValueError(f"olat, subpixels: got {self.subpixels}, expected at least 1")
        self.offset_mm = float(properties.get("offset_mm", RAY_OFFSET_MM))
        self.shadows = bool(properties.get("shadows", True))
        self.analyzer: tuple[float, float] | None = None
        if "analyzer_deg" in properties:
            leak = float(properties.get("analyzer_leak", 0.0))
            self.analyzer = (math.radians(float(properties["analyzer_deg"])), leak)
        self._disc = tuple(mi.Float(pad_memory(p)) for p in disc_points(DISC_POINTS))

    def render(
        self,
        scene: Any,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> Any:
        camera = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        return self.mi.TensorXf(self.image(scene, camera))

    def image(self, scene: Any, sensor: Any) -> Float32Array:
        """Return the image of a camera under all lights, (H, W, C)."""
        total = None
        for _, image in self.stream(scene, sensor):
            total = image if total is None else total + image
        if total is None:
            raise ValueError("olat: got a scene without lights, expected at least one")
        return total

    def stream(
        self, scene: Any, sensor: Any, lights: Sequence[int] | None = None
    ) -> Iterator[tuple[int, Float32Array]]:
        """Yield number and image, (H, W, 3), radiance, of each light in turn."""
        hits = self.trace(scene, sensor)
        numbered = [(e, k) for e in scene.emitters() for k in range(_light_count(e))]
        for n in range(len(numbered)) if lights is None else lights:
            emitter, k = numbered[n]
            if self.analyzer is None:
                parts = self.shade(scene, hits, emitter, k)
            else:
                parts = self._shade_analyzed(scene, sensor, hits, emitter, k, *self.analyzer)
            color = emitter.strength(k) if hasattr(emitter, "strength") else np.ones(3)
            yield n, self.develop(hits, parts, color)

    def trace(
        self, scene: Any, sensor: Any, image_rows: tuple[int, int] | None = None
    ) -> ImageHits:
        """Trace a camera's rays; see `ImageHits`. Pixels outside some rows may be left out."""
        mi = self.mi
        k = self.subpixels
        width, height = (int(n) for n in sensor.film().crop_size())
        first, end = (0, height) if image_rows is None else image_rows
        rows = max(1, RAYS_PER_BAND // (width * k * k))
        bands = []
        for top in range(first, end, rows):
            band = self._trace_rows(scene, sensor, top, min(top + rows, end))
            if band is not None:
                bands.append(band)
        ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.5), mi.Point2f(0.5))
        return ImageHits((height, width), k, mi.Point3f(ray.o), tuple(bands))

    def shade(
        self,
        scene: Any,
        hits: ImageHits,
        emitter: Any,
        light: int,
        added: AddedLight = NOTHING_ADDED,
    ) -> list[Any]:
        """Return the radiance of the hits of each band for a light of intensity 1."""
        return [
            self._shade_band(scene, hits.camera, band, emitter, light, added.part(rows))
            for band, rows in hits.parts()
        ]

    def shade_polarized(
        self,
        scene: Any,
        hits: ImageHits,
        emitter: Any,
        light: int,
        right: ArrayLike,
        added: AddedLight = NOTHING_ADDED,
    ) -> list[tuple[list[Any], list[Any]]]:
        """Return the polarized light of the hits of each band for a light of intensity 1.

        Each band has the Stokes vector (S0, S1, S2) of the surfaces' reflection, and the radiance
        behind the boundary in three channels, which `leaving_stokes` leads to the camera. The axis
        of Stokes vectors is the part of `right` across the camera's ray. BSDFs other than
        `skincoat` depolarize: all their light is in the second part.
        """
        return [
            self._shade_polarized(scene, hits.camera, band, emitter, light, right, added.part(rows))
            for band, rows in hits.parts()
        ]

    def _shade_analyzed(
        self,
        scene: Any,
        sensor: Any,
        hits: ImageHits,
        emitter: Any,
        light: int,
        angle_rad: float,
        leak: float,
    ) -> list[Any]:
        """Return the radiance behind the analyzer, in the format of `shade`."""
        mi, dr = self.mi, self.dr
        left, up, _ = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)[:3, :3].T
        absorbs = math.sin(angle_rad) * left + math.cos(angle_rad) * up
        right, film = (_opaque_vector(mi, dr, axis) for axis in (-left, absorbs))
        polarized = self.shade_polarized(scene, hits, emitter, light, -left)
        out = []
        for band, (surface, inside), leaving in zip(
            hits.bands, polarized, self.leaving_stokes(hits, -left), strict=True
        ):
            to_camera = dr.normalize(hits.camera - band.start)
            cos2, sin2 = double_angle(dr, right, dr.cross(film, to_camera), to_camera)
            glossy, matt = (
                0.5 * ((1.0 + leak) * s0 + (1.0 - leak) * (cos2 * s1 - sin2 * s2))
                for s0, s1, s2 in (surface, leaving)
            )
            parts = [glossy + matt * c for c in inside]
            dr.eval(parts)
            out.append(parts)
        return out

    def leaving_stokes(self, hits: ImageHits, right: ArrayLike) -> list[list[Any]]:
        """Return the Stokes vector at the camera of radiance 1 behind each band's boundary."""
        mi, dr = self.mi, self.dr
        axis, out = _opaque_vector(mi, dr, right), []
        for band in hits.bands:
            total = [mi.Float(1.0), mi.Float(0.0), mi.Float(0.0)]
            for bsdf, mask, kept in band.materials:
                if _stores(bsdf):
                    stokes = bsdf.leaving_stokes(kept, hits.camera - band.start, axis)
                    here = mi.Bool(True) if mask is None else mask
                    total = [dr.select(here, s, t) for s, t in zip(stokes, total, strict=True)]
            dr.eval(total)
            out.append(total)
        return out

    def develop(
        self, hits: ImageHits, parts: Sequence[Any], color: ArrayLike = (1.0, 1.0, 1.0)
    ) -> Float32Array:
        """Return the mean over whole pixels, (H, W, 3), of radiance by hit times a color."""
        mi, dr = self.mi, self.dr
        most = hits.subpixels**2
        scale = [dr.opaque(mi.Float, float(c) / most) for c in np.ravel(color)]
        # memory of pixels without a hit is never touched
        out = np.zeros((hits.shape[0] * hits.shape[1], 3), np.float32)
        colors = out.view(_COLOR)[:, 0]
        for band, rows in zip(hits.bands, parts, strict=True):
            first, after = band.ends
            sums = [mi.Float(0.0), mi.Float(0.0), mi.Float(0.0)]
            for step in range(most):
                at = first + step
                inside = at < after
                for c, row in enumerate(rows):
                    sums[c] += dr.gather(mi.Float, row, at, inside)
            light = dr.ravel(mi.Color3f(*(s * f for s, f in zip(sums, scale, strict=True))))
            colors[band.pixel] = light.numpy().view(_COLOR)
        return out.reshape(*hits.shape, 3)

    def _trace_rows(self, scene: Any, sensor: Any, top: int, end: int) -> HitBand | None:
        mi, dr = self.mi, self.dr
        k = self.subpixels
        width, height = (int(n) for n in sensor.film().crop_size())
        index = dr.arange(mi.UInt32, (end - top) * width * k * k)
        pixel, slot = index // (k * k), index % (k * k)
        x, y = pixel % width, pixel // width + dr.opaque(mi.UInt32, top)
        place = mi.Point2f(
            (mi.Float(x) + (mi.Float(slot % k) + 0.5) / k) / width,
            (mi.Float(y) + (mi.Float(slot // k) + 0.5) / k) / height,
        )
        ray, _ = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
        found = scene.ray_intersect_preliminary(ray, coherent=True)
        dr.eval(ray, found)
        kept = dr.compress(found.is_valid())
        if not dr.width(kept):
            return None
        ray, found = dr.gather(mi.Ray3f, ray, kept), dr.gather(type(found), found, kept)
        si = found.compute_surface_interaction(ray, mi.RayFlags.All)
        outside = dr.select(dr.dot(si.n, ray.d) < 0.0, 1.0, -1.0)
        start = si.p + (self.offset_mm * outside) * si.n
        owner = y * width + x
        owner, slots = dr.gather(mi.UInt32, owner, kept), dr.gather(mi.UInt32, slot, kept)
        bsdfs = _distinct_bsdfs(scene)
        materials = []
        for bsdf, shapes in bsdfs:
            mask = None
            if len(bsdfs) > 1:
                mask = mi.Bool(False)
                for shape in shapes:
                    mask |= si.shape == mi.ShapePtr(shape)
            active = mi.Bool(True) if mask is None else mask
            materials.append((bsdf, mask, bsdf.stored(si, active) if _stores(bsdf) else si))
        dr.eval(start, owner, slots, [(mask, kept) for _, mask, kept in materials])
        pixels = np.array(owner).astype(np.int32)
        starts = np.flatnonzero(np.diff(pixels, prepend=-1))
        first = np.append(starts, len(pixels)).astype(np.int32)
        return HitBand(
            pixel=pixels[starts],
            first=first,
            slot=np.array(slots).astype(np.uint16),
            prim=np.array(found.prim_index).astype(np.int32),
            position=np.array(si.p).T.astype(np.float32),
            uv=np.array(si.uv).T.astype(np.float32),
            start=start,
            ends=(_indices(mi, first[:-1]), _indices(mi, first[1:])),
            materials=materials,
        )

    def _shade_band(
        self, scene: Any, camera: Any, band: HitBand, emitter: Any, light: int, added: AddedLight
    ) -> list[Any]:
        mi, dr = self.mi, self.dr
        way, diffuse = camera - band.start, not added.replaces_diffuse

        def reflect(bsdf: Any, kept: Any, film: FilmedLight) -> tuple[list[Any], Any]:
            color, front = bsdf.reflected(kept, film.to_light, way, diffuse)
            return list(color), front

        total = self._reflected(scene, band, emitter, light, added.visible, reflect)
        if added.interior is not None:
            for bsdf, mask, kept in band.materials:
                if _stores(bsdf):
                    leaving = dr.inv_pi * bsdf.leaving(kept, way)
                    leaving = leaving if mask is None else dr.select(mask, leaving, 0.0)
                    inner = [_upload(mi, column) for column in added.interior.T]
                    total = [t + leaving * c for t, c in zip(total, inner, strict=True)]
        dr.eval(total)
        return total

    def _shade_polarized(
        self,
        scene: Any,
        camera: Any,
        band: HitBand,
        emitter: Any,
        light: int,
        right: ArrayLike,
        added: AddedLight,
    ) -> tuple[list[Any], list[Any]]:
        mi, dr = self.mi, self.dr
        way, axis = camera - band.start, _opaque_vector(mi, dr, right)

        def reflect(bsdf: Any, kept: Any, film: FilmedLight) -> tuple[list[Any], Any]:
            stokes, entered, r_d, lit = bsdf.reflected_stokes(kept, film, way, axis)
            return [*(dr.inv_pi * entered * c for c in r_d), *stokes], lit

        total = self._reflected(scene, band, emitter, light, added.visible, reflect, 6)
        if added.replaces_diffuse:
            total[:3] = [mi.Float(0.0)] * 3
        dr.eval(total)
        return total[3:], total[:3]

    def _reflected(
        self,
        scene: Any,
        band: HitBand,
        emitter: Any,
        light: int,
        visible: Float32Array | None,
        reflect: Callable[[Any, Any, FilmedLight], tuple[list[Any], Any]],
        channels: int = 3,
        is_hidable: BoolArray | None = None,
    ) -> list[Any]:
        """Return channels that `reflect` gives for `skincoat`, times the light that arrives.

        Other BSDFs reflect in the first three channels. Only hits that are hidable, shape (n,),
        get a shadow ray; None: all.
        """
        mi, dr = self.mi, self.dr
        slot = dr.arange(mi.UInt32, band.count) % DISC_POINTS
        u, v = (dr.gather(mi.Float, points, slot) for points in self._disc)
        film, target, strength = _toward(mi, dr, emitter, light, band.start, u, v)
        far = dr.norm(target)
        active = dr.max(strength) > 0.0
        total = [mi.Float(0.0)] * channels
        facing = mi.Bool(False)
        for bsdf, mask, kept in band.materials:
            if _stores(bsdf):
                values, front = reflect(bsdf, kept, film)
            else:
                color = bsdf.eval(mi.BSDFContext(), kept, kept.to_local(film.to_light), active)
                values, front = [*color, *total[3:]], dr.max(color) > 0.0
            here = front if mask is None else front & mask
            facing |= here
            total = [dr.select(here, c, t) for t, c in zip(total, values, strict=True)]
        active &= facing
        if self.shadows and is_hidable is None:
            ray = mi.Ray3f(band.start, target / far)
            ray.maxt = 0.999 * far
            active &= ~scene.ray_test(ray, True, active)
        elif self.shadows and is_hidable is not None:
            active &= ~self._is_blocked(scene, band, emitter, light, is_hidable)
        if visible is not None:
            strength *= _upload(mi, visible)
        arriving = [*strength, *[dr.mean(strength)] * (channels - 3)]
        return [dr.select(active, t * s, 0.0) for t, s in zip(total, arriving, strict=True)]

    def _is_blocked(
        self, scene: Any, band: HitBand, emitter: Any, light: int, is_hidable: BoolArray
    ) -> Any:
        """Return which hits do not see a light; only hidable ones get a ray, in own packets."""
        mi, dr = self.mi, self.dr
        blocked = dr.zeros(mi.Bool, band.count)
        if not is_hidable.any():
            return blocked
        which = _indices(mi, np.flatnonzero(is_hidable).astype(np.int32))
        start = mi.Point3f(*(dr.gather(mi.Float, part, which) for part in band.start))
        u, v = (dr.gather(mi.Float, points, which % DISC_POINTS) for points in self._disc)
        _, target, _ = _toward(mi, dr, emitter, light, start, u, v)
        far = dr.norm(target)
        ray = mi.Ray3f(start, target / far)
        ray.maxt = 0.999 * far
        dr.scatter(blocked, scene.ray_test(ray, True), which)
        return blocked


def define_olat(mi: Any) -> Any:
    """Return the class of the integrator for Mitsuba's active variant.

    Parameters
    ----------
    mi
        The module ``mitsuba`` with a variant.
    """
    return define_plugin(mi, mi.SamplingIntegrator, _Olat)


def _toward(
    mi: Any, dr: Any, emitter: Any, light: int, start: Any, u: Any, v: Any
) -> tuple[FilmedLight, Any, Any]:
    """Return a light's polarization, ways to a point of it, and its light on a facing plane."""
    if hasattr(emitter, "toward"):
        way, target, lobe = emitter.toward(start, light, u, v)
        film = emitter.filmed(dr.normalize(way), light)
        return film, target, mi.Color3f(lobe / dr.squared_norm(way))
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(start))
    si.p = start
    sample = mi.warp.uniform_disk_to_square_concentric(mi.Point2f(u, v))
    ds, weight = emitter.sample_direction(si, sample)
    unpolarized = FilmedLight(dr, ds.d, mi.Vector3f(0.0), 1.0)
    return unpolarized, ds.d * ds.dist, mi.Color3f(weight)


def _opaque_vector(mi: Any, dr: Any, vector: ArrayLike) -> Any:
    return mi.Vector3f(*(dr.opaque(mi.Float, float(c)) for c in np.ravel(vector)))


def _indices(mi: Any, values: Int32Array) -> Any:
    return mi.UInt32(pad_memory(values.astype(np.uint32)))


def _light_count(emitter: Any) -> int:
    return int(getattr(emitter, "count", 1))


def _stores(bsdf: Any) -> bool:
    return hasattr(bsdf, "stored")


def _distinct_bsdfs(scene: Any) -> list[tuple[Any, list[Any]]]:
    """Return each BSDF of a scene with its shapes."""
    found: list[tuple[Any, list[Any]]] = []
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        for known, shapes in found:
            if known is bsdf:
                shapes.append(shape)
                break
        else:
            found.append((bsdf, [shape]))
    return found


def _upload(mi: Any, values: NDArray[np.float32]) -> Any:
    return mi.Float(pad_memory(np.asarray(values, np.float32)))
