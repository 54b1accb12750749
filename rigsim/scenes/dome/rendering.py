"""Render the dome by a Mitsuba scene: mesh, skin, LEDs and cameras, one light at a time."""

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import View
from rigsim.arrays import Float32Array
from rigsim.geometry.mesh import Mesh
from rigsim.light.olat import CameraSettings, Hits, Lamp, lens_of_hits
from rigsim.light.olat_kernels import BARE_COLUMNS, MATT_ROWS, SKIN_ROWS, UINT16_FULL_SCALE
from rigsim.mitsuba.image_hits import AddedLight, ImageHits
from rigsim.mitsuba.led_array import led_table
from rigsim.mitsuba.rig_camera import describe_camera
from rigsim.mitsuba.scene_radiance import load_description
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import VariantChoice
from rigsim.render.lens_kernels import MOSAIC_LIGHTS
from rigsim.sensor import apply_cfa, color_filters, filter_channels


@dataclass(frozen=True, slots=True, eq=False)
class RenderedView:
    """Hits of a camera in a scene."""

    scene: "MitsubaScene"
    """The scene."""
    lamps: tuple[Lamp, ...]
    """The LEDs, in the frame of the mesh."""
    image_hits: ImageHits
    """The integrator's hits."""
    hits: Hits
    """The same as rows, without normals and surfaces, which `image_hits` stores."""

    def surface_hits(self) -> Hits:
        """Return the rows of skin with normals and surfaces."""
        if not self.image_hits.count:
            return self.hits
        words = [
            np.stack([np.array(word) for word in band.materials[0][2]], axis=1)
            for band in self.image_hits.bands
        ]
        halves = np.ascontiguousarray(np.concatenate(words)).view(np.uint16)
        normal, surface = halves[:, :3].view(np.int16), halves[:, 3:]
        return dataclasses.replace(self.hits, normal=normal, surface=surface)


@dataclass(frozen=True, slots=True, eq=False)
class LitScene:
    """One LED that lights a scene."""

    light: int
    """Number of the LED."""
    color: Float32Array
    """Intensity on its axis, shape (3,), see `rigsim.light.led_light`."""
    added: Callable[[], AddedLight]
    """Returns subsurface light, and the relief's visible fraction."""


class MitsubaScene:
    """A face or a target in front of LEDs, as a Mitsuba scene.

    Parameters
    ----------
    mesh
        The mesh.
    material
        Description of its BSDF, see `rigsim.light.skin_material`.
    choice
        A vectorized variant.
    """

    def __init__(self, mesh: Mesh, material: dict[str, Any], choice: VariantChoice) -> None:
        self._choice = choice
        self._lamps: tuple[Lamp, ...] = ()
        self._memory = np.zeros(0, np.float32)
        mi = load_mitsuba(choice)
        self._is_skin = material["type"] == "skincoat"
        self._scene = load_description(
            mi,
            {
                "type": "scene",
                "embree_use_robust_intersections": True,
                "skin": {"type": "mesh", "mesh": mesh, "bsdf": material},
                "leds": {"type": "ledarray", "table": led_table([[0, 0, 1]], [[0, 0, -1]])},
            },
        )
        self._leds = self._scene.emitters()[0]

    def observe(
        self,
        view: View,
        lamps: tuple[Lamp, ...],
        settings: CameraSettings,
        distortion: ArrayLike | None,
    ) -> RenderedView:
        """Trace a camera's rays.

        Parameters
        ----------
        view
            The camera, in the frame of the mesh.
        lamps
            The LEDs, in the frame of the mesh: fixed in the room, around a head that moves.
        settings, distortion
            Rays and lens; its distortion, see `rigsim.mitsuba.rig_camera`.
        """
        mi = load_mitsuba(self._choice)
        camera = load_description(mi, describe_camera(view, distortion))
        self._integrator = mi.load_dict({"type": "olat", "subpixels": settings.subpixels})
        found = self._integrator.trace(self._scene, camera)
        rows = self._rows(found, view, settings)
        for band in found.bands:
            band.release_copies()
        return RenderedView(self, lamps, found, rows)

    def _rows(self, found: ImageHits, view: View, settings: CameraSettings) -> Hits:
        pixel, first, slot, position, uv = found.rows()
        hits = Hits(
            found.shape,
            found.subpixels,
            pixel,
            first,
            position,
            np.zeros((0, 3), np.int16),
            np.zeros(0, np.int32),
            slot.astype(np.uint8),
            np.rint(uv * np.float32(UINT16_FULL_SCALE)).astype(np.uint16),
            np.zeros((0, BARE_COLUMNS), np.uint16),
            np.asarray(view.position_mm, np.float64),
            SKIN_ROWS if self._is_skin else MATT_ROWS,
        )
        return lens_of_hits(hits, view, settings) if settings.optics else hits

    def render(
        self, seen: RenderedView, light: int, color: Float32Array, added: AddedLight
    ) -> Float32Array:
        """Return the image of one light.

        Parameters
        ----------
        seen
            A camera's hits in this scene.
        light
            Number of the LED.
        color
            Intensity on its axis, shape (3,), see `rigsim.light.led_light`.
        added
            Subsurface light, and the relief's visible fraction.

        Returns
        -------
        ndarray of float32
            Shape (H, W, 3), in full scales per second, averaged over whole pixels.
        """
        if not seen.image_hits.count:
            return np.zeros((*seen.hits.shape, 3), np.float32)
        parts = self._shade(seen, light, added)
        scale = np.float32(np.pi) * np.asarray(color, np.float32)
        if seen.hits.lens is None:
            return self._integrator.develop(seen.image_hits, parts, scale)
        columns = [np.concatenate([np.array(p[c]) for p in parts]) for c in range(3)]
        return seen.hits.lens.render(np.stack(columns, axis=1)) * scale

    def render_mosaics(
        self, seen: RenderedView, lights: Sequence[LitScene], cfa: str
    ) -> list[Float32Array]:
        """Return the images of lights behind a Bayer sensor's filters.

        Parameters
        ----------
        seen
            A camera's hits in this scene.
        lights
            Up to `MOSAIC_LIGHTS` lights.
        cfa
            Pattern of the filters.

        Returns
        -------
        list of ndarray of float32
            Shape (H, W), the numbers of `render` in each pixel's channel.
        """
        lens, count = seen.hits.lens, seen.image_hits.count
        if lens is None or not count:
            return [
                apply_cfa(self.render(seen, one.light, one.color, one.added()), cfa)
                for one in lights
            ]
        lanes = 1 if len(lights) == 1 else MOSAIC_LIGHTS
        size = 3 * count * lanes
        if self._memory.size < size:
            self._memory = np.zeros(size, np.float32)
        # other lights in places that are not used make images that are not used
        rows = self._memory[:size].reshape(3, count, lanes)
        for k, one in enumerate(lights):
            parts = self._shade(seen, one.light, one.added())
            for part, (_, place) in zip(parts, seen.image_hits.parts(), strict=True):
                for channel in range(3):
                    rows[channel, place, k] = part[channel].numpy()
        images = lens.render_mosaics(rows, filter_channels(cfa))
        return [
            color_filters(images[..., k], np.float32(np.pi) * one.color, cfa)
            for k, one in enumerate(lights)
        ]

    def _shade(self, seen: RenderedView, light: int, added: AddedLight) -> list[Any]:
        """Return the radiance of the hits of each band, by channel, for an intensity of 1."""
        load_mitsuba(self._choice)  # the variant is a state of the process
        if self._lamps is not seen.lamps:
            self._leds.set_table(_table(seen.lamps))
            self._lamps = seen.lamps
        shaded: list[Any] = self._integrator.shade(
            self._scene, seen.image_hits, self._leds, light, added
        )
        return shaded


def _table(lamps: Sequence[Lamp]) -> Float32Array:
    return led_table(
        [lamp.position_mm for lamp in lamps],
        [lamp.axis for lamp in lamps],
        exponent=[lamp.exponent for lamp in lamps],
        radius_mm=[lamp.radius_mm for lamp in lamps],
    )
