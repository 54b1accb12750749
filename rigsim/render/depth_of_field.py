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
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from capture.rig import View
from rigsim.arrays import Float32Array, Float64Array, Int32Array, UInt8Array
from rigsim.geometry.mesh import Mesh
from rigsim.render.lens_blur import BlurError, Lens, focused_lens

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

DEPTH_GAP_BINS: Final = 64
"""Number of depth bins in the search for a gap."""

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
        _layers(*self._samples, np.float32(spread.gap_mm), self._cut, self._far)

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
            _gather(*self._samples, self._cut, self._far, light, out)
        return out

    def render_mosaic(self, columns: Sequence[ArrayLike], cell: ArrayLike) -> Float32Array:
        """Return the channel of each pixel's filter, the same numbers as those of `render`.

        Parameters
        ----------
        columns
            Radiance of each sample by channel, C of shape (n,).
        cell
            Channels of the sensor's 2 x 2 cell, below C, shape (2, 2).

        Returns
        -------
        ndarray of float32
            Shape (H, W).
        """
        out = np.zeros(self.shape, np.float32)
        light = np.array(columns, np.float32)
        if light.size:
            channels = np.ascontiguousarray(cell, np.int64)
            _gather_mosaic(*self._samples, self._cut, self._far, light, channels, out)
        return out


@njit(parallel=True, cache=True)
def _layers(  # type: ignore[no-untyped-def]
    lookup, first, slot, slices, toward, table, radius, gap, cut, far
):
    """Find each pixel's far depths and the factors of the weights of both layers."""
    height, width = lookup.shape
    wide = 2 * radius + 1
    per_pixel = table.shape[2]
    for y in prange(height):
        depth = np.empty(wide * wide * per_pixel, np.float32)
        share = np.empty(wide * wide * per_pixel, np.float32)
        filled = np.empty(DEPTH_GAP_BINS, np.uint8)
        for x in range(width):
            count, missing = 0, np.float32(0.0)
            total, inside = np.float32(0.0), np.float32(0.0)
            low, high = np.float32(np.inf), np.float32(-np.inf)
            for b in range(wide * wide):
                v, u = y + b // wide - radius, x + b % wide - radius
                if v < 0 or v >= height or u < 0 or u >= width:
                    continue  # beyond its border the image is extrapolated
                for s in range(per_pixel):
                    inside += table[0, b, s]
                q = lookup[v, u]
                if q < 0:
                    missing += np.float32(1.0)
                    continue
                missing += np.float32(per_pixel - first[q + 1] + first[q])
                for i in range(first[q], first[q + 1]):
                    w = table[slices[i], b, slot[i]]
                    depth[count], share[count] = toward[i], w
                    low, high = min(low, toward[i]), max(high, toward[i])
                    total += w
                    count += 1
            if count == 0 or total <= 0.0:
                continue
            near = np.float32(0.0)
            if high - low > gap:
                # the widest run of empty bins is the gap, up to the width of a bin
                filled[:] = 0
                per_mm = np.float32(DEPTH_GAP_BINS - 1) / (high - low)
                for k in range(count):
                    filled[int((depth[k] - low) * per_mm)] = 1
                run, widest, end = 0, 0, 0
                for k in range(DEPTH_GAP_BINS):
                    run = 0 if filled[k] else run + 1
                    if run > widest:
                        widest, end = run, k
                if widest > gap * per_mm:
                    middle = np.float32(end + 1) - np.float32(0.5) * np.float32(widest)
                    cut[y, x] = low + middle / per_mm
                    for k in range(count):
                        if depth[k] >= cut[y, x]:
                            near += share[k]
                    if near > inside:  # one steep slope: no second layer
                        cut[y, x], near = np.float32(np.inf), np.float32(0.0)
            rest = total - near
            free = max(inside - near, np.float32(0.0))
            if rest <= np.float32(1e-9):
                far[y, x] = np.float32(0.0)
            elif missing > 0:  # no light there
                far[y, x] = min(np.float32(1.0), free / rest) / inside
            else:
                far[y, x] = free / rest / inside


@njit(parallel=True, cache=True)
def _gather(  # type: ignore[no-untyped-def]
    lookup, first, slot, slices, toward, table, radius, cut, far, rows, out
):
    """Sum the samples around each pixel. Unsigned indices are not wrapped, which saves time."""
    height, width = lookup.shape
    wide = 2 * radius + 1
    channels = rows.shape[1]
    for y in prange(height):
        for x in range(width):
            edge, behind = cut[y, x], far[y, x]
            for v in range(max(y - radius, 0), min(y + radius + 1, height)):
                line = lookup[v]
                row = (v - y + radius) * wide + radius - x
                for u in range(max(x - radius, 0), min(x + radius + 1, width)):
                    if line[u] < 0:
                        continue
                    q, b = np.uint64(line[u]), np.uint64(row + u)
                    for sample in range(first[q], first[q + np.uint64(1)]):
                        i = np.uint64(sample)
                        w = table[np.uint64(slices[i]), b, np.uint64(slot[i])]
                        w *= behind if toward[i] < edge else np.float32(1.0)
                        for c in range(channels):
                            out[y, x, c] += w * rows[i, c]


@njit(parallel=True, cache=True)
def _gather_mosaic(  # type: ignore[no-untyped-def]
    lookup, first, slot, slices, toward, table, radius, cut, far, light, cell, out
):
    """Do as `_gather` for the channel of each pixel's filter; `light` has a row per channel."""
    height, width = lookup.shape
    wide = 2 * radius + 1
    for y in prange(height):
        for x in range(width):
            column = light[cell[y % 2, x % 2]]
            edge, behind = cut[y, x], far[y, x]
            total = np.float32(0.0)
            for v in range(max(y - radius, 0), min(y + radius + 1, height)):
                line = lookup[v]
                row = (v - y + radius) * wide + radius - x
                for u in range(max(x - radius, 0), min(x + radius + 1, width)):
                    if line[u] < 0:
                        continue
                    q, b = np.uint64(line[u]), np.uint64(row + u)
                    for sample in range(first[q], first[q + np.uint64(1)]):
                        i = np.uint64(sample)
                        w = table[np.uint64(slices[i]), b, np.uint64(slot[i])]
                        w *= behind if toward[i] < edge else np.float32(1.0)
                        total += w * column[i]
            out[y, x] = total
