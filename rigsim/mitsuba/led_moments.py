"""Integrator `ledmoments`: polarized reflection of many LEDs, summed with a few weights per LED.

.. code-block:: python

    "type": "ledmoments",
    "table": table,          # `mi.Bitmap`, a row of four weights for each LED
    "shadows": True,
    "offset_mm": 1e-4,       # start of the shadow rays above the surface
    "subpixels": 1

The LEDs and their polarizers are those of the scene's `ledarray`. For each hit of a regular grid of
camera rays, a `skincoat` gives the Stokes vector that its surface reflects of an LED's light, and
the light that enters. Both are summed over the LEDs with four weights each, such as 1 and the
coordinates of its direction, so that one pass serves all patterns of LEDs and all angles of an
analyzer. No image of a single LED is stored. `mi.render` returns 16 channels:

- 0 to 11: four sums of S0, S1, S2, in the frame (h, v x h) of the camera ray, where v points to
  the camera and h is the image's x axis perpendicular to v;
- 12 to 15: four sums of the entering light, cosine included.
"""

from collections.abc import Callable
from typing import Any, Final

import numpy as np

from rigsim.arrays import BoolArray, Float32Array, Float64Array
from rigsim.mitsuba.image_hits import HitBand, ImageHits
from rigsim.mitsuba.olat import define_olat
from rigsim.mitsuba.plugin_class import define_plugin
from rigsim.mitsuba.polarized_light import FilmedLight

MOMENT_COUNT: Final = 4
STOKES_COUNT: Final = 3
CHANNEL_COUNT: Final = MOMENT_COUNT * (STOKES_COUNT + 1)
"""Channels of an image: Stokes vectors of each moment, then the entering light of each."""


class _LedMoments:
    """Sums over polarized LEDs; see the module."""

    mi: Any
    dr: Any
    trace: Any
    _reflected: Any

    def __init__(self, properties: Any) -> None:
        super(type(self), self).__init__(properties)  # type: ignore[call-arg]
        rows: Float64Array = np.array(properties["table"], np.float64)
        self.weights: Float64Array = rows.reshape(rows.shape[0], -1)
        if self.weights.shape[1] != MOMENT_COUNT or not np.isfinite(self.weights).all():
            raise ValueError(
                f"ledmoments, table: got shape {self.weights.shape} or values that are not finite, "
                f"expected finite (N, {MOMENT_COUNT})"
            )

    def image(
        self, scene: Any, sensor: Any, is_hidable: Callable[[int], BoolArray] | None = None
    ) -> Float32Array:
        """Return the image of a camera, (H, W, 16).

        Parameters
        ----------
        scene, sensor
            The scene and its camera.
        is_hidable
            Returns for an LED the pixels in which something may hide it, shape (H, W): others get
            no shadow ray. None: all pixels.
        """
        emitter = next((e for e in scene.emitters() if hasattr(e, "toward")), None)
        if emitter is None or emitter.count != len(self.weights):
            raise ValueError(
                f"ledmoments: got {0 if emitter is None else emitter.count} LEDs of a ledarray, "
                f"expected {len(self.weights)}, one for each row of the table"
            )
        for shape in scene.shapes():
            if not hasattr(shape.bsdf(), "reflected_stokes"):
                raise ValueError(f"ledmoments: got the BSDF {shape.bsdf()}, expected a skincoat")
        hits: ImageHits = self.trace(scene, sensor)
        matrix = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
        right = self.mi.Vector3f(*(float(-c) for c in matrix[:3, 0]))  # local +x is left
        out = np.zeros((hits.shape[0] * hits.shape[1], CHANNEL_COUNT), np.float32)
        for band in hits.bands:
            out[band.pixel] = self._band(scene, hits, band, emitter, right, is_hidable)
        return out.reshape(*hits.shape, CHANNEL_COUNT)

    def _band(
        self,
        scene: Any,
        hits: ImageHits,
        band: HitBand,
        emitter: Any,
        right: Any,
        is_hidable: Callable[[int], BoolArray] | None,
    ) -> Float32Array:
        """Return the mean over whole pixels of a band, shape (P, 16)."""
        mi, dr = self.mi, self.dr
        way = hits.camera - band.start

        def reflect(bsdf: Any, words: Any, film: FilmedLight) -> tuple[list[Any], Any]:
            stokes, entered, _, lit = bsdf.reflected_stokes(words, film, way, right)
            return [*stokes, entered], lit

        sums = [mi.Float(0.0)] * CHANNEL_COUNT
        owner = np.repeat(band.pixel, np.diff(band.first))
        for led, weights in enumerate(self.weights):
            tested = None if is_hidable is None else is_hidable(led).reshape(-1)[owner]
            seen = self._reflected(
                scene, band, emitter, led, None, reflect, STOKES_COUNT + 1, tested
            )
            strength = float(emitter.strength(led).mean())
            moments = [dr.opaque(mi.Float, strength * float(w)) for w in weights]
            terms = [w * s for w in moments for s in seen[:STOKES_COUNT]]
            terms += [w * seen[STOKES_COUNT] for w in moments]
            sums = [total + term for total, term in zip(sums, terms, strict=True)]
            dr.eval(sums)
        values = np.stack([np.array(s) for s in sums], axis=1)
        if hits.subpixels == 1:
            return values
        means = np.add.reduceat(values, band.first[:-1], axis=0) / np.float32(hits.subpixels**2)
        return np.asarray(means)


def define_led_moments(mi: Any) -> Any:
    """Return the class of the integrator for Mitsuba's active variant.

    Parameters
    ----------
    mi
        The module ``mitsuba`` with a variant.
    """
    return define_plugin(mi, define_olat(mi), _LedMoments)
