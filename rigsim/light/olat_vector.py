"""Shade skin as `rigsim.light.olat` does, in one vectorized Dr.Jit kernel of rays and shading.

The kernel is compiled once; lights are runtime parameters. It requires Mitsuba's LLVM variants;
without them, and for targets, `rigsim.light.olat` is used. The reflection is implemented a second
time here, from the same formulas; a test compares both.
"""

import math
from typing import Any

import numpy as np

from rigsim.arrays import Float32Array, Float64Array
from rigsim.light import surface_brdf as brdf
from rigsim.light.olat import DISC_POINTS, Hits, Lamp, disc_points, shadow_ray_origins, sum_rows
from rigsim.light.olat_kernels import BARE_COLUMNS, ETA_COLUMN, MAX_FUZZ, UINT16_FULL_SCALE
from rigsim.render import Caster, load_mitsuba, pad_memory
from rigsim.tissue.skin_layers import ETA


class VectorizedShader:
    """Shader of rows of skin.

    Parameters
    ----------
    hits
        Rows of kind ``SKIN``.
    caster
        The mesh; its ``scene`` must not be None.
    """

    def __init__(self, hits: Hits, caster: Caster) -> None:
        self._choice = caster.choice
        self._scene = caster.scene
        self.hits = hits
        mi = load_mitsuba(self._choice)
        self._start = mi.Point3f(*_columns(shadow_ray_origins(hits, caster)))
        # Normal and surface as ten or fourteen half words, for a dome's sixteen views.
        halves = np.concatenate([hits.normal.view(np.uint16), hits.surface], axis=1)
        words = np.ascontiguousarray(halves).view(np.uint32)
        self._words = [mi.UInt32(pad_memory(words[:, k])) for k in range(words.shape[1])]
        self._across, self._along = (mi.Float(points) for points in disc_points(DISC_POINTS))

    def shade_rows(
        self,
        lamp: Lamp,
        color: Float32Array,
        glow: Float32Array | None = None,
        *,
        diffuse: bool = True,
        relief: Float32Array | None = None,
    ) -> Float32Array:
        """Trace shadow rays, shade and sum into pixels; see `rigsim.light.olat.shade_rows`.

        Parameters
        ----------
        lamp, color, glow, diffuse, relief
            As there.

        Returns
        -------
        ndarray of float32
            Shape (H, W, 3), as there.
        """
        if not len(self.hits.position_mm):
            return np.zeros((*self.hits.shape, 3), np.float32)
        import drjit as dr

        mi = load_mitsuba(self._choice)

        def number(value: float) -> Any:
            return dr.opaque(mi.Float, float(value))

        def vector(values: Float64Array) -> Any:
            return mi.Vector3f(*(number(v) for v in values))

        side, other = lamp.radii()
        center, axis = vector(lamp.position_mm), vector(lamp.axis)
        normal, (red, green, blue, roughness, oil, fuzz, bare, *coating) = self._unpacked(dr, mi)
        slot = dr.arange(mi.UInt32, len(self.hits.position_mm)) % DISC_POINTS
        across = dr.gather(mi.Float, self._across, slot)
        along = dr.gather(mi.Float, self._along, slot)
        way = center - self._start
        squared = dr.squared_norm(way)
        to_light = way * dr.rsqrt(squared)
        to_camera = dr.normalize(vector(self.hits.camera_mm) - self._start)
        nl = dr.minimum(dr.dot(normal, to_light), 1.0)
        nv = dr.minimum(dr.dot(normal, to_camera), 1.0)
        off = -dr.dot(axis, to_light)
        active = (nl > 0.0) & (nv > 0.0) & (off > 0.0)
        target = way + across * vector(side) + along * vector(other)
        far = dr.norm(target)
        ray = mi.Ray3f(self._start, target / far)
        ray.maxt = 0.999 * far
        active &= ~self._scene.ray_test(ray, True, active)
        lobe = dr.power(dr.maximum(off, 1e-9), number(lamp.exponent))
        strength = dr.select(active, nl / squared * lobe, 0.0)
        if relief is not None:
            strength *= mi.Float(pad_memory(relief))
        half = to_light + to_camera
        length = dr.norm(half)
        nh, lh = dr.minimum((nl + nv) / length, 1.0), 0.5 * length
        # Cosines below zero are masked; clamping keeps their square roots real.
        cl, cv = dr.maximum(nl, 1e-6), dr.maximum(nv, 1e-6)
        surface = (1.0 - oil) * _fresnel(dr, lh, ETA) * _beckmann(dr, cl, cv, nh, roughness)
        surface += (
            oil
            * _fresnel(dr, lh, brdf.ETA_OIL)
            * _ggx(dr, cl, cv, nh, brdf.OIL_SMOOTHING * roughness)
        )
        if coating:
            film, alpha, eta, _ = coating
            surface *= 1.0 - film
            surface += film * _fresnel(dr, lh, eta) * _ggx(dr, cl, cv, nh, dr.maximum(alpha, 0.01))
        through = 1.0 - dr.exp(-fuzz * (1.0 / cl + 1.0 / cv))
        surface += brdf.FUZZ_ALBEDO / (4.0 * math.pi) * through / (cl + cv)
        if coating:
            powder = coating[3]
            surface = (1.0 - powder) * surface + powder * _grains(cl, cv, lh)
        # Unless both are above the surface, n.h may be 0: avoid 0 * inf.
        gloss = dr.select(active, math.pi * strength * bare * surface, 0.0)
        leaving = 1.0 - _fresnel(dr, cv, ETA)
        rows = [gloss] * 3
        if diffuse:
            inside = strength * (1.0 - _fresnel(dr, cl, ETA)) * leaving
            rows = [row + inside * r_d for row, r_d in zip(rows, (red, green, blue), strict=True)]
        if glow is not None:
            leaving = dr.select(nv > 0.0, leaving, 0.0)
            columns = [mi.Float(column) for column in _columns(glow)]
            rows = [row + leaving * light for row, light in zip(rows, columns, strict=True)]
        dr.eval(rows)
        r, g, b = (np.asarray(row.numpy(), np.float32) for row in rows)
        return sum_rows(self.hits, r, g, b, color)

    def _unpacked(self, dr: Any, mi: Any) -> tuple[Any, list[Any]]:
        """Return unit normals and columns of `SkinSurface.packed` (`rigsim.light.surface_brdf`)."""
        low = [word & 0xFFFF for word in self._words]
        high = [word >> 16 for word in self._words]
        halves = [half for pair in zip(low, high, strict=True) for half in pair]
        # Signed halves: the top bit is the sign.
        signed = [mi.Int32(half << 16) >> 16 for half in halves[:3]]
        normal = dr.normalize(mi.Vector3f(*(mi.Float(half) for half in signed)))
        unit = [mi.Float(half) * (1.0 / UINT16_FULL_SCALE) for half in halves[3:]]
        colors = [brdf.MAX_R_D * root * root for root in unit[:3]]
        known = [*colors, unit[3], unit[4], MAX_FUZZ * unit[5], *unit[6:]]
        if len(known) > BARE_COLUMNS:
            known[ETA_COLUMN] = 1.0 + known[ETA_COLUMN]
        return normal, known


def _columns(rows: Float32Array) -> list[Float32Array]:
    return [pad_memory(np.asarray(rows[:, k], np.float32)) for k in range(rows.shape[1])]


def _grains(nl: Any, nv: Any, lh: Any) -> Any:
    g = brdf.POWDER_ASYMMETRY
    spread = 1.0 + g * g - 2.0 * g * (1.0 - 2.0 * lh * lh)
    phase = (1.0 - g * g) / (spread * spread**0.5)
    return brdf.POWDER_ALBEDO / (4.0 * math.pi) * phase / (nl + nv)


def _fresnel(dr: Any, cosine: Any, eta: Any) -> Any:
    c = dr.clip(cosine, 0.0, 1.0)
    inside = dr.sqrt(1.0 - (1.0 - c * c) / (eta * eta))
    rs = (c - eta * inside) / (c + eta * inside)
    rp = (eta * c - inside) / (eta * c + inside)
    return 0.5 * (rs * rs + rp * rp)


def _beckmann(dr: Any, nl: Any, nv: Any, nh: Any, alpha: Any) -> Any:
    a2, c2 = alpha * alpha, nh * nh
    lobe = dr.minimum((1.0 - c2) / (dr.maximum(c2, 1e-12) * a2), 60.0)
    density = dr.exp(-lobe) / (math.pi * a2 * c2 * c2)
    return density * _beckmann_g1(dr, nl, alpha) * _beckmann_g1(dr, nv, alpha) / (4.0 * nl * nv)


def _beckmann_g1(dr: Any, cosine: Any, alpha: Any) -> Any:
    slope = alpha * dr.sqrt(dr.maximum(1.0 - cosine * cosine, 0.0)) / cosine
    a = 1.0 / dr.maximum(slope, 1e-6)
    partly = (3.535 * a + 2.181 * a * a) / (1.0 + 2.276 * a + 2.577 * a * a)
    return dr.select(slope < 0.625, 1.0, partly)


def _ggx(dr: Any, nl: Any, nv: Any, nh: Any, alpha: Any) -> Any:
    a2 = alpha * alpha
    t = nh * nh * (a2 - 1.0) + 1.0
    gl = nl + dr.sqrt(a2 + (1.0 - a2) * nl * nl)
    gv = nv + dr.sqrt(a2 + (1.0 - a2) * nv * nv)
    return a2 / (math.pi * t * t) / (gl * gv)
