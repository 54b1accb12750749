"""Render depth of field: spread the light of points over pixels by their defocus.

Rays through the center of the pupil find the surface; this module distributes their light over the
whole pupil. All light of a point falls on pixels by diffraction and its circle of confusion. Near
skin occludes the far skin behind it.

Notes
-----
Weights come from the OTF of a defocused circle (`rigsim.render.lens_blur.Lens`), times those of a
pixel and of the square around each sample: without blur they are the weights of the mean over a
pixel. The weights of a pixel that views a single smooth surface are normalized to sum 1, since
radiance is constant along rays; plain spreading would have an error of 1e-4 on a face, as the
circle changes along a slope. At an edge two layers are separated at the widest gap in depth. The
far layer gets the weight that the near one leaves, also for its part hidden from the center of the
pupil, which is extrapolated from the rest. Light beyond `DefocusKernels.radius` pixels is returned
to the kernel: the far rings of diffraction, and the glare of real lenses, are not modeled.
"""

import dataclasses
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import View
from rigsim.arrays import Float32Array, Float64Array, Int32Array, UInt8Array
from rigsim.geometry.mesh import Mesh
from rigsim.render import lens_kernels as kernels
from rigsim.render.lens_blur import BlurError, Lens, focused_lens
from rigsim.render.lens_kernels import MOSAIC_LIGHTS

DEFOCUS_STEP_PX: Final = 0.1
MAX_WEIGHT_DEPTHS: Final = 33
"""Spacing of the depths with computed weights in pixels of blur diameter, and their maximum
number; weights in between are interpolated."""

DEPTH_SLICES: Final = 256
"""Number of depth levels."""

DIFFRACTION_MARGIN: Final = 4.0
"""Margin around a circle of confusion, in wavelengths times f-number."""

SPECTRUM_NODES: Final = 3
"""Number of wavelengths that sample the spectrum."""

DEPTH_GAP_MM: Final = 3.0
DEPTH_GAP_PX: Final = 3.0
"""Gap in depth, the wider of the two, from which one surface counts as in front of another."""

DEPTH_RANGE_FACTOR: Final = 1.2
"""Step of the depth ranges of tables."""

MAX_FREQUENCY: Final = 6.0
"""Highest frequency of the sum, in cycles per sample; squares transmit 0.2 % of it."""


@dataclass(frozen=True, slots=True, eq=False)
class DefocusKernels:
    """Fractions of a sample's light on the pixels around it, by depth."""

    radius: int
    """Reach in pixels on each side."""
    subpixels: int
    """Samples along each side of a pixel."""
    table: Float32Array
    """Shape (`DEPTH_SLICES`, (2 radius + 1)^2, subpixels^2): by depth, by the offset of the
    sample's pixel from the receiving one, row by row, and by its position in its pixel, row by row.
    The sum over all samples is 1."""
    distance_mm: float
    """From the pupil to the plane in focus, mm."""
    furthest: float
    """Largest `defocus` in the table."""
    gap_mm: float
    """Gap in depth from which one surface counts as in front of another."""

    def defocus(self, toward_mm: ArrayLike) -> Float64Array:
        """Return the relative circle of confusion by depths before the plane in focus, mm."""
        # A point at distance z = distance - depth has a blur diameter proportional to distance / z
        # - 1.
        depth = np.asarray(toward_mm, np.float64)
        return depth / (self.distance_mm - depth)

    def slices(self, toward_mm: ArrayLike) -> UInt8Array:
        """Return the rows of the table for depths before the plane in focus, mm."""
        place = np.abs(self.defocus(toward_mm)) * ((DEPTH_SLICES - 1) / max(self.furthest, 1e-12))
        return np.asarray(np.clip(np.rint(place), 0, DEPTH_SLICES - 1), np.uint8)

    def spilled_fraction(self, toward_mm: ArrayLike) -> Float64Array:
        """Return the fraction of a pixel's light on other pixels by depth, same shape."""
        # the weights of a sample's own pixel sum to the fraction that it keeps
        kept = self.table[:, self.table.shape[1] // 2].sum(axis=1, dtype=np.float64)
        return 1.0 - kept[self.slices(toward_mm)]

    def max_spilled_fraction(self, toward_mm: ArrayLike) -> float:
        """Return the largest fraction of a pixel's light on other pixels over some depths.

        Parameters
        ----------
        toward_mm
            Depths before the plane in focus, mm, any shape.
        """
        return float(self.spilled_fraction(toward_mm).max())


def tabulate_defocus(
    view: View, illuminant: str, *, subpixels: int, depths_mm: ArrayLike
) -> DefocusKernels:
    """Tabulate the lens blur of points in a range of depths.

    Parameters
    ----------
    view
        The camera.
    illuminant
        Name of the light's spectrum.
    subpixels
        Samples along each side of a pixel.
    depths_mm
        Depths along the optical axis that the subject reaches, from the plane in focus toward the
        camera, mm, any shape; only the extremes matter.

    Returns
    -------
    DefocusKernels

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> cam = load_rig("flash").resized(768).view("cam")
    >>> spread = tabulate_defocus(cam, "D55", subpixels=2, depths_mm=[-85.0, 25.0])
    >>> spread.radius, round(spread.max_spilled_fraction(-85.0), 2)
    (2, 0.58)
    """
    return tabulate_lens_defocus(
        focused_lens(view, illuminant), subpixels=subpixels, depths_mm=depths_mm
    )


def tabulate_lens_defocus(lens: Lens, *, subpixels: int, depths_mm: ArrayLike) -> DefocusKernels:
    """Tabulate the blur of a lens; see `tabulate_defocus`.

    Raises
    ------
    BlurError
        No depths, depths that are not finite or are behind the camera, or no samples.
    """
    depths = np.asarray(depths_mm, np.float64)
    if subpixels < 1:
        raise BlurError(f"subpixels: got {subpixels}, expected at least 1")
    if not (depths.size and np.isfinite(depths).all() and depths.max() < lens.distance_mm):
        raise BlurError(
            f"depths_mm: got {depths.tolist()}, expected finite ones that end before the camera, "
            f"{lens.distance_mm:g} mm before the plane in focus"
        )
    furthest = float(np.abs(depths / (lens.distance_mm - depths)).max())
    if furthest > 0.0:  # in steps, so that similar cameras and faces share a table
        furthest = DEPTH_RANGE_FACTOR ** math.ceil(math.log(furthest, DEPTH_RANGE_FACTOR) - 1e-9)
    return _spread(_few_colors(lens), subpixels, furthest)


@lru_cache(maxsize=8)  # a dome's cameras, and the faces in it, are similar
def _spread(lens: Lens, subpixels: int, furthest: float) -> DefocusKernels:
    pixel_mm = 1e-3 * lens.pixel_on_subject_um
    pupil_mm = 0.5 * lens.magnification * lens.distance_mm / lens.working_f_number
    rings = DIFFRACTION_MARGIN * 1e-3 * lens.cutoff_period_um
    radius = max(1, math.ceil((pupil_mm * furthest + rings) / pixel_mm))
    count = math.ceil(2.0 * pupil_mm * furthest / pixel_mm / DEFOCUS_STEP_PX) + 2
    nodes = np.linspace(0.0, furthest, min(count, MAX_WEIGHT_DEPTHS) if furthest > 0.0 else 1)
    exact = np.stack([_weights(lens, node * lens.distance_mm, radius, subpixels) for node in nodes])
    place = np.linspace(0.0, len(nodes) - 1.0, DEPTH_SLICES)
    low = np.minimum(place.astype(np.int64), max(len(nodes) - 2, 0))
    high = np.minimum(low + 1, len(nodes) - 1)
    share = (place - low)[:, None, None]
    table = ((1.0 - share) * exact[low] + share * exact[high]).astype(np.float32)
    return DefocusKernels(
        radius,
        subpixels,
        table,
        lens.distance_mm,
        furthest,
        max(DEPTH_GAP_MM, DEPTH_GAP_PX * pixel_mm),
    )


def _few_colors(lens: Lens) -> Lens:
    """Return the lens with `SPECTRUM_NODES` wavelengths: means of equal parts of the spectrum."""
    count = len(lens.wavelengths_nm)
    if count <= SPECTRUM_NODES:
        return lens
    weights = np.asarray(lens.weights)
    part = np.minimum(
        (np.cumsum(weights) - 0.5 * weights) * SPECTRUM_NODES, SPECTRUM_NODES - 1e-9
    ).astype(int)
    share = np.bincount(part, weights, SPECTRUM_NODES)
    mean = np.bincount(part, weights * np.asarray(lens.wavelengths_nm), SPECTRUM_NODES) / share
    return dataclasses.replace(
        lens, wavelengths_nm=tuple(mean.tolist()), weights=tuple((share / share.sum()).tolist())
    )


def _weights(lens: Lens, depth_mm: float, radius: int, subpixels: int) -> Float64Array:
    """Return the table at one depth, shape ((2 r + 1)^2, k^2)."""
    pixel_mm = 1e-3 * lens.pixel_on_subject_um
    wide = 2 * radius + 1
    offset = (np.arange(wide * subpixels) + 0.5) / subpixels - 0.5 * wide  # pixels
    period = 4 * wide  # pixels after which the sum over frequencies repeats
    cutoff = 1e6 * lens.magnification / (min(lens.wavelengths_nm) * lens.working_f_number)
    most = min(cutoff * pixel_mm, MAX_FREQUENCY * subpixels)
    frequency = np.arange(math.ceil(most * period) + 1) / period  # cycles per pixel
    # The weights are the inverse Fourier transform of the OTF times the sincs of pixel and sample.
    # The sum over frequencies repeats after a period that keeps the copies apart.
    squares = np.sinc(frequency) * np.sinc(frequency / subpixels)
    squares *= np.where(frequency > 0.0, 2.0, 1.0)  # negative frequencies contribute equally
    waves = np.cos(2.0 * np.pi * offset[:, None] * frequency) * squares
    radial = np.hypot(frequency[:, None], frequency) / pixel_mm
    otf = lens.otf(radial, depth_mm=depth_mm)
    found = np.maximum(waves @ otf @ waves.T, 0.0)
    found /= found.sum()
    by_pixel = found.reshape(wide, subpixels, wide, subpixels).transpose(0, 2, 1, 3)
    return np.asarray(by_pixel.reshape(wide**2, subpixels**2), np.float64)


def depth_before_focus(view: View, points_mm: Float32Array) -> Float32Array:
    """Return the distance of points before a camera's plane in focus, mm, (n, 3) to (n,)."""
    back = np.asarray(view.axes[2])
    focus = float(np.asarray(view.position_mm) @ back) - view.focus_distance_mm
    return np.asarray(points_mm @ back.astype(np.float32) - np.float32(focus), np.float32)


def depth_range(view: View, mesh: Mesh) -> tuple[float, float]:
    """Return the range of depths before the plane in focus where a mesh faces the camera, mm."""
    way = np.asarray(view.position_mm, np.float32) - mesh.vertices_mm
    facing = np.einsum("ij,ij->i", way, mesh.normals) > 0.0
    depths = depth_before_focus(view, mesh.vertices_mm[facing])
    return float(depths.min(initial=0.0)), float(depths.max(initial=0.0))


class LensImage:
    """Samples of one image, to be rendered through a lens with any light on them.

    Parameters
    ----------
    spread
        Kernels of the lens.
    shape
        Rows and columns of the image.
    pixel
        Pixels with samples, index into the flat image, ascending, shape (P,).
    first
        First sample of each of these, shape (P + 1,).
    slot
        Each sample's position in its pixel, row by row, below subpixels^2, shape (n,).
    toward_mm
        Distance of each sample before the plane in focus, mm, shape (n,).
    """

    def __init__(
        self,
        spread: DefocusKernels,
        shape: tuple[int, int],
        pixel: Int32Array,
        first: Int32Array,
        slot: UInt8Array,
        toward_mm: Float32Array,
    ) -> None:
        self.spread, self.shape = spread, shape
        lookup = np.full(shape[0] * shape[1], -1, np.int32)
        lookup[pixel] = np.arange(len(pixel), dtype=np.int32)
        toward = np.asarray(toward_mm, np.float32)
        starts, slots = np.asarray(first, np.int32), np.asarray(slot, np.uint8)
        samples = (lookup.reshape(shape), starts, slots, spread.slices(toward_mm), toward)
        self._samples = (*samples, spread.table, spread.radius)
        self._cut = np.full(shape, np.inf, np.float32)
        self._far = np.zeros(shape, np.float32)
        kernels.find_layers(*self._samples, np.float32(spread.gap_mm), self._cut, self._far)

    def render(self, rows: Float32Array) -> Float32Array:
        """Return the image of samples with given radiance.

        Parameters
        ----------
        rows
            Radiance of each sample, shape (n, C).

        Returns
        -------
        ndarray of float32
            Shape (H, W, C); only the samples emit light.
        """
        out = np.zeros((*self.shape, rows.shape[1]), np.float32)
        if len(rows):
            light = np.ascontiguousarray(rows, np.float32)
            kernels.gather(*self._samples, self._cut, self._far, light, out)
        return out

    def render_mosaics(self, light: Float32Array, cell: ArrayLike) -> Float32Array:
        """Return the channel of each pixel's filter under several lights.

        Parameters
        ----------
        light
            Radiance of each sample by channel and light, shape (C, n, L) with one light or
            `MOSAIC_LIGHTS`.
        cell
            Channels of the sensor's 2 x 2 cell, below C, shape (2, 2).

        Returns
        -------
        ndarray of float32
            Shape (H, W, L), the same numbers as those of `render`.

        Raises
        ------
        BlurError
            For another number of lights.
        """
        lights = light.shape[2]
        if lights not in (1, MOSAIC_LIGHTS):
            raise BlurError(f"light: got {lights} lights, expected 1 or {MOSAIC_LIGHTS}")
        out = np.zeros((*self.shape, lights), np.float32)
        if light.size:
            weights, toward = self.spread.table, self._samples[4]
            sum_lights = kernels.gather_mosaic if lights == 1 else kernels.gather_mosaics
            sum_lights(
                *self._weight_places(),
                toward,
                weights.reshape(-1),
                weights.shape[2],
                self.spread.radius,
                self._cut,
                self._far,
                np.ascontiguousarray(light, np.float32),
                np.ascontiguousarray(cell, np.int64),
                out,
            )
        return out

    def _weight_places(self) -> tuple[Int32Array, Int32Array]:
        """Return each pixel's first sample, and each sample's place in the flat table.

        Places count from a receiving pixel in column 0; the kernel shifts them to another one.
        """
        lookup, first, slot, slices, *_ = self._samples
        table = self.spread.table
        pixel = np.flatnonzero(lookup.reshape(-1) >= 0)
        count = np.zeros(lookup.size + 1, np.int32)
        count[pixel + 1] = np.diff(first)
        column = np.repeat((pixel % self.shape[1]).astype(np.int32), np.diff(first))
        depth = slices.astype(np.int32) * np.int32(table.shape[1] * table.shape[2])
        return np.cumsum(count, dtype=np.int32), depth + slot + np.int32(table.shape[2]) * column
