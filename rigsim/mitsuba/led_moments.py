"""Integrator `ledmoments`: polarized reflection of many LEDs, summed with a few weights per LED.

.. code-block:: python

    "type": "ledmoments",
    "table": table,          # `mi.Bitmap`, a row for each LED: absorbing axis, four weights
    "extinction": 1000.0,    # of the linear polarizers on the LEDs; inf: ideal
    "shadows": True,
    "offset_mm": 1e-4,       # start of the shadow rays above the surface
    "subpixels": 1

Each LED of the scene's `ledarray` has a linear polarizer. For each hit of a regular grid of camera
rays, the facets of a `skincoat` give the Stokes vector that an LED reflects, and the boundary the
light of the LED that enters. Both are summed over the LEDs with four weights each, such as 1 and
the coordinates of its direction, so that one pass serves all patterns of LEDs and all angles of an
analyzer. No image of a single LED is stored. `mi.render` returns 16 channels:

- 0 to 11: four sums of S0, S1, S2, in the frame (h, v x h) of the camera ray, where v points to
  the camera and h is the image's x axis perpendicular to v;
- 12 to 15: four sums of the entering light, cosine included.

Vellus hair and coatings have no closed form here and are refused.

References
----------
Walter et al. 2007 (facets); Born and Wolf, Principles of Optics, section 1.5 (Fresnel's
amplitudes).
"""

import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from rigsim.arrays import Float32Array, Float64Array
from rigsim.mitsuba.image_hits import HitBand, ImageHits
from rigsim.mitsuba.led_array import DISC_POINTS
from rigsim.mitsuba.olat import define_olat
from rigsim.mitsuba.plugin_class import define_plugin
from rigsim.mitsuba.skin_coat import MIN_COSINE, beckmann_facets, ggx_facets

MOMENT_COUNT: Final = 4
STOKES_COUNT: Final = 3
CHANNEL_COUNT: Final = MOMENT_COUNT * (STOKES_COUNT + 1)
"""Channels of an image: Stokes vectors of each moment, then the entering light of each."""

POLARIZER_COLUMNS: Final = 3 + MOMENT_COUNT


class _LedMoments:
    """Sums over polarized LEDs; see the module."""

    mi: Any
    dr: Any
    trace: Any
    _disc: Any

    def __init__(self, properties: Any) -> None:
        super(type(self), self).__init__(properties)  # type: ignore[call-arg]
        rows: Float64Array = np.array(properties["table"], np.float64)
        table: Float64Array = rows.reshape(rows.shape[0], -1)
        if table.shape[1] != POLARIZER_COLUMNS or not np.isfinite(table).all():
            raise ValueError(
                f"ledmoments, table: got shape {table.shape} or values that are not finite, "
                f"expected finite (N, {POLARIZER_COLUMNS})"
            )
        self.table = table
        self.leak = 1.0 / float(properties.get("extinction", math.inf))
        self.shadows = bool(properties.get("shadows", True))

    def render(
        self,
        scene: Any,
        sensor: Any = 0,
        seed: Any = 0,
        spp: int = 0,
        develop: bool = True,
        evaluate: bool = True,
    ) -> Any:
        mi = self.mi
        camera = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
        return mi.TensorXf(self.moments(scene, camera))

    def moments(self, scene: Any, sensor: Any) -> Float32Array:
        """Return the image, (H, W, 16), of one camera."""
        mi = self.mi
        emitter = next((e for e in scene.emitters() if hasattr(e, "toward")), None)
        if emitter is None or emitter.count != len(self.table):
            raise ValueError(
                f"ledmoments: got {0 if emitter is None else emitter.count} LEDs of a ledarray, "
                f"expected {len(self.table)}, one for each row of the table"
            )
        hits: ImageHits = self.trace(scene, sensor)
        matrix = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
        right = mi.Vector3f(*(float(-c) for c in matrix[:3, 0]))  # local +x is left
        out = np.zeros((hits.shape[0] * hits.shape[1], CHANNEL_COUNT), np.float32)
        for band in hits.bands:
            for bsdf, _, _ in band.materials:
                _refuse_other_lobes(bsdf)
            out[band.pixel] = self._band(scene, hits, band, emitter, right)
        return out.reshape(*hits.shape, CHANNEL_COUNT)

    def _band(
        self, scene: Any, hits: ImageHits, band: HitBand, emitter: Any, right: Any
    ) -> Float32Array:
        """Return the mean over whole pixels of a band, shape (P, 16)."""
        mi, dr = self.mi, self.dr
        slot = dr.arange(mi.UInt32, band.count) % DISC_POINTS
        u, v = (dr.gather(mi.Float, points, slot) for points in self._disc)
        sums = [mi.Float(0.0)] * CHANNEL_COUNT
        for led, row in enumerate(self.table):
            strength = float(emitter.strength(led).mean())
            if strength == 0.0:
                continue
            way, target, lobe = emitter.toward(band.start, led, u, v)
            light = lobe * dr.opaque(mi.Float, strength) / dr.squared_norm(way)
            to_light = dr.normalize(way)
            absorbs = mi.Vector3f(*(dr.opaque(mi.Float, float(c)) for c in row[:3]))
            weights = [dr.opaque(mi.Float, float(c)) for c in row[3:]]
            values = [mi.Float(0.0)] * (STOKES_COUNT + 1)
            for bsdf, mask, words in band.materials:
                found = self._reflect(
                    bsdf, words, to_light, hits.camera - band.start, absorbs, right
                )
                here = mi.Bool(True) if mask is None else mask
                values = [a + dr.select(here, b, 0.0) for a, b in zip(values, found, strict=True)]
            active = (light > 0.0) & ((values[0] > 0.0) | (values[3] > 0.0))
            if self.shadows:
                far = dr.norm(target)
                ray = mi.Ray3f(band.start, target / far)
                ray.maxt = 0.999 * far
                active &= ~scene.ray_test(ray, True, active)
            seen = dr.select(active, light, 0.0)
            order = [3 * m + s for m in range(MOMENT_COUNT) for s in range(STOKES_COUNT)]
            for k in order:
                sums[k] = sums[k] + weights[k // 3] * seen * values[k % 3]
            for m in range(MOMENT_COUNT):
                sums[12 + m] = sums[12 + m] + weights[m] * seen * values[3]
            dr.eval(sums)
        return self._pixel_means(hits.subpixels**2, band, sums)

    def _pixel_means(self, most: int, band: HitBand, sums: Sequence[Any]) -> Float32Array:
        values = np.stack([np.array(s) for s in sums], axis=1)
        if most == 1:
            return values
        return np.asarray(np.add.reduceat(values, band.first[:-1], axis=0) / np.float32(most))

    def _reflect(
        self, bsdf: Any, words: Any, to_light: Any, way_to_camera: Any, absorbs: Any, right: Any
    ) -> list[Any]:
        """Return S0, S1, S2 and the entering light of `stored` points, cosine included."""
        dr = self.dr
        normal, _, (alpha, oil, _, bare) = bsdf.restored(words)
        to_camera = dr.normalize(way_to_camera)
        nl, nv = dr.dot(normal, to_light), dr.dot(normal, to_camera)
        lit = nl > 0.0
        both = lit & (nv > 0.0)
        nl, nv = dr.clip(nl, MIN_COSINE, 1.0), dr.clip(nv, MIN_COSINE, 1.0)
        total = to_light + to_camera
        length = dr.norm(total)
        nh, lh = dr.minimum((nl + nv) / length, 1.0), dr.minimum(0.5 * length, 1.0)
        material = bsdf.material
        smooth = material["oil_smoothing"] * alpha
        matt = bare * (1.0 - oil) * nl * beckmann_facets(dr, nl, nv, nh, alpha)
        glossy = bare * oil * nl * ggx_facets(dr, nl, nv, nh, smooth)
        # axes perpendicular to the plane of both rays, and in the plane perpendicular to the light
        s = dr.cross(to_camera, to_light)
        spare = dr.cross(right, to_light)  # at normal incidence the plane is arbitrary
        s = dr.normalize(dr.select(dr.squared_norm(s) > 1e-10, s, spare))
        field = dr.normalize(dr.cross(absorbs, to_light))  # which the polarizer transmits
        a, b = dr.dot(field, s), dr.dot(field, dr.cross(s, to_light))
        h = dr.normalize(right - dr.dot(right, to_camera) * to_camera)
        x, y = dr.dot(s, h), dr.dot(s, dr.cross(to_camera, h))
        parts = [self._facet_stokes(lh, material["int_ior"], a, b)]
        parts.append(self._facet_stokes(lh, material["oil_ior"], a, b))
        s0, s1, s2 = (matt * m + glossy * g for m, g in zip(*parts, strict=True))
        cos2, sin2 = x * x - y * y, 2.0 * x * y
        stokes = [s0, s1 * cos2 - s2 * sin2, s1 * sin2 + s2 * cos2]
        entered = nl * self._entry(normal, to_light, nl, field, material["int_ior"])
        return [dr.select(both, c, 0.0) for c in stokes] + [dr.select(lit, entered, 0.0)]

    def _facet_stokes(self, cosine: Any, eta: float, a: Any, b: Any) -> list[Any]:
        """Return the Stokes vector that a facet makes of polarized light, in its own frame.

        The field has the parts a and b across and along the plane of incidence; the polarizer's
        leak has b and -a.
        """
        rs, rp = self._amplitudes(cosine, eta)
        across, along = (rs * a) * (rs * a), (rp * b) * (rp * b)
        leaked_across, leaked_along = (rs * b) * (rs * b), (rp * a) * (rp * a)
        return [
            0.5 * (across + along + self.leak * (leaked_across + leaked_along)),
            0.5 * (across - along + self.leak * (leaked_across - leaked_along)),
            (1.0 - self.leak) * rs * rp * a * b,
        ]

    def _entry(self, normal: Any, to_light: Any, nl: Any, field: Any, eta: float) -> Any:
        """Return the fraction of an LED's light, before its polarizer, that enters."""
        dr = self.dr
        rs, rp = self._amplitudes(nl, eta)
        ts, tp = 1.0 - rs * rs, 1.0 - rp * rp
        across = dr.cross(normal, to_light)
        squared = dr.squared_norm(across)
        # at normal incidence both transmittances are equal
        part = dr.dot(field, across)
        c2 = dr.select(squared > 1e-12, dr.minimum(part * part / squared, 1.0), 0.5)
        passed = ts * c2 + tp * (1.0 - c2)
        leaked = ts * (1.0 - c2) + tp * c2
        return 0.5 * (passed + self.leak * leaked)

    def _amplitudes(self, cosine: Any, eta: float) -> tuple[Any, Any]:
        dr = self.dr
        inside = dr.sqrt(1.0 - (1.0 - cosine * cosine) / (eta * eta))
        rs = (cosine - eta * inside) / (cosine + eta * inside)
        rp = (eta * cosine - inside) / (eta * cosine + inside)
        return rs, rp


def polarizer_table(absorbs: Float64Array, weights: Float64Array) -> Float32Array:
    """Return the table of `ledmoments`, shape (N, 7).

    Parameters
    ----------
    absorbs
        Absorbing axes of the LEDs' polarizers, unit vectors, shape (N, 3).
    weights
        Weights of each LED in the four sums, shape (N, 4).

    Examples
    --------
    >>> import numpy as np
    >>> polarizer_table(np.array([[1.0, 0.0, 0.0]]), np.array([[1.0, 0.0, 0.0, 1.0]])).tolist()
    [[1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0]]
    """
    return np.concatenate([absorbs, weights], axis=1).astype(np.float32)


def _refuse_other_lobes(bsdf: Any) -> None:
    if not hasattr(bsdf, "restored") or bsdf.is_coated or bsdf.textures["vellus"].max() > 0.0:
        raise ValueError(
            f"ledmoments: got the BSDF {bsdf}, expected a skincoat without vellus hair and coating"
        )


def define_led_moments(mi: Any) -> Any:
    """Return the class of the integrator for Mitsuba's active variant.

    Parameters
    ----------
    mi
        The module ``mitsuba`` with a variant.
    """
    return define_plugin(mi, define_olat(mi), _LedMoments)
