"""Count bytes and operations of kernels in closed form.

A cost is the least that any program needs: each array is read or written once, as if the cache held
all else. Operations are those of the formulas in the kernel's loops. Counts that depend on the data
take the fewest passes, or the same number for each item where `prepare` forces it. A division or a
square root counts apart from multiplications and additions, since its rate differs; so do
exponentials, sines and arc tangents of the C library (``exp``). A division by a constant is a
multiplication.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Cost:
    """Least work of one call."""

    bytes: float = 0.0
    """Read and written."""
    float32: float = 0.0
    """Multiplications, additions, comparisons and integer operations of 32 bits."""
    float64: float = 0.0
    """The same of 64 bits."""
    division: float = 0.0
    """Divisions and square roots of 64 bits."""
    exp: float = 0.0
    """Calls of exponentials, logarithms, sines or arc functions, of one number each."""
    normal: float = 0.0
    """Normal random numbers of float32."""
    poisson: float = 0.0
    """Poisson random numbers."""
    gather: float = 0.0
    """Reads at random places of a table larger than the cache."""


def sum_bytes(*arrays: Any) -> float:
    """Return the bytes of arrays, and of those in tuples; other arguments have none.

    >>> sum_bytes(np.zeros(3), (np.zeros(2, np.float32), 1.0), "name")
    32.0
    """
    total = 0.0
    for one in arrays:
        if isinstance(one, np.ndarray):
            total += one.nbytes
        elif isinstance(one, tuple):
            total += sum_bytes(*one)
    return total


def count_window_visits(samples: np.ndarray, radius: int) -> float:
    """Return how often samples of pixels (H, W) are summed in windows of 2 radius + 1.

    >>> count_window_visits(np.ones((3, 3)), 1)
    49.0
    """
    height, width = samples.shape
    reach = [
        np.minimum(np.arange(n) + radius, n - 1) - np.maximum(np.arange(n) - radius, 0) + 1
        for n in (height, width)
    ]
    return float(reach[0] @ samples.astype(np.float64) @ reach[1])


def _samples_of_pixels(lookup: Any, first: Any) -> np.ndarray:
    """Return the number of samples of each pixel, (H, W); row -1 of a lookup has none."""
    counts = np.append(np.diff(first), 0)
    return np.asarray(counts[np.where(lookup < 0, len(counts) - 1, lookup)])


# Sensor and lens -------------------------------------------------------------------------------


def expose(irradiance_rgb: Any, *, sensor: Any, **_: Any) -> Cost:
    """A normal number per pixel, a Poisson number per lit one; light read, 2 bytes written.

    A Poisson number of a mean below 10 takes less time, and is not counted.
    """
    pixels = irradiance_rgb.shape[0] * irradiance_rgb.shape[1]
    gray = irradiance_rgb if irradiance_rgb.ndim == 2 else irradiance_rgb.mean(axis=2)
    lit = int(np.count_nonzero(gray * sensor.gain_e_per_dn * (sensor.white - sensor.black) >= 10.0))
    return Cost(sum_bytes(irradiance_rgb) + 2 * pixels, normal=pixels, poisson=lit)


def gather(lookup, first, slot, slices, toward, table, radius, cut, far, rows, out):  # type: ignore[no-untyped-def]
    """Per visit: the layer's factor and 2 operations per channel."""
    visits = count_window_visits(_samples_of_pixels(lookup, first), radius)
    size = sum_bytes(lookup, first, slot, slices, toward, cut, far, rows) + 2 * out.nbytes
    return Cost(size, float32=visits * (2 + 2 * rows.shape[1]))


def gather_mosaics(  # type: ignore[no-untyped-def]
    starts, weight_index, toward, weights, per_pixel, radius, cut, far, light, cell, out
):
    """Per visit: the layer's factor and 2 operations per light."""
    samples = np.diff(starts).reshape(cut.shape)
    visits = count_window_visits(samples, radius)
    size = sum_bytes(starts, weight_index, toward, cut, far, light, out)
    return Cost(size, float32=visits * (2 + 2 * light.shape[-1]))


def find_layers(lookup, first, slot, slices, toward, table, radius, gap, cut, far):  # type: ignore[no-untyped-def]
    """Per visit: sums of the weights inside and of all, minimum and maximum."""
    visits = count_window_visits(_samples_of_pixels(lookup, first), radius)
    size = sum_bytes(lookup, first, slot, slices, toward, cut, far)
    return Cost(size, float32=4 * visits)


# Light of the simulated rigs -------------------------------------------------------------------


def light_plate(pixel, surface, lamps, axes, exponent, strength, out):  # type: ignore[no-untyped-def]
    """Per point and lamp: 25 operations, 4 divisions and roots, one power (2 functions)."""
    pairs = len(pixel) * len(lamps)
    size = sum_bytes(pixel, surface) + 4 * len(pixel)
    return Cost(size, float64=25 * pairs, division=4 * pairs + 2 * len(pixel), exp=2 * pairs)


def trace_plate(rays, eye, turned, reflectance, waviness, subpixels, out):  # type: ignore[no-untyped-def]
    """Per corner: 15 operations, 3 divisions; per point on the plate and wave: 9, 3, a sine."""
    corners = rays.shape[0] * rays.shape[1]
    waves = int(np.count_nonzero(out[..., 0])) * len(waviness)
    size = sum_bytes(rays, out)
    return Cost(size, float64=15 * corners + 9 * waves, division=3 * corners + 3 * waves, exp=waves)


def visible_fractions(uv, position, lights, radii, du, dv, horizon, highest, out):  # type: ignore[no-untyped-def]
    """Per point 25 operations; per light 15 and 4 roots; where its horizon matters 45, 8, 3 arcs.

    Neighbors read neighboring texels, so that reads are not at random.
    """
    points, pairs, near = len(uv), out.size, int(np.count_nonzero(out != 1.0))
    size = sum_bytes(uv, position) + out.nbytes
    flops, roots = 25 * points + 15 * pairs + 45 * near, points + 4 * pairs + 8 * near
    return Cost(size, float64=flops, division=roots, exp=3 * near)


def average_hits(self, rows):  # type: ignore[no-untyped-def]
    """Rows read, pixels written; an addition per number."""
    out = 4 * self.shape[0] * self.shape[1] * math.prod(rows.shape[1:])
    return Cost(rows.nbytes + self.first.nbytes + out, float32=rows.size)


def join_layers(parts):  # type: ignore[no-untyped-def]
    """Each number read and written."""
    return Cost(2 * sum_bytes(*parts.values()))


def flow(field, own, before, after):  # type: ignore[no-untyped-def]
    """Two passes over the field; 5 operations per texel and channel."""
    return Cost(4 * field.nbytes + sum_bytes(own, before, after), float32=5 * field.size)


def gradient_noise(points, cell, salt):  # type: ignore[no-untyped-def]
    """Per point 140 operations of noise, 17 of a hash at each of 8 corners, 3 divisions."""
    return Cost(16 * len(points), 136 * len(points), 140 * len(points), 3 * len(points))


def look_up_color(log_rgb, melanin, blood):  # type: ignore[no-untyped-def]
    """Per point and channel: 11 operations and an exponential."""
    return Cost(28 * len(melanin), float64=33 * len(melanin), exp=3 * len(melanin))


def sample_texture(texture, uv, mask):  # type: ignore[no-untyped-def]
    """Per point and channel: 11 operations, and a texel, since neighbors share the others."""
    found, channels = np.count_nonzero(mask), texture.shape[2]
    size = sum_bytes(uv, mask) + 4 * channels * (len(uv) + found)
    return Cost(size, float64=11 * found * channels)


def add_sector_through(out, normals, tangent, angle, share):  # type: ignore[no-untyped-def]
    """Per pixel: 361 operations, of which 3 pairs of nodes take most; 22 divisions and roots."""
    size = sum_bytes(normals, tangent) + 2 * out.nbytes
    return Cost(size, float64=361 * out.size, division=22 * out.size)


def look_up_moments(values, half_field, reach, least_z, normals, x, y, alphas, out):  # type: ignore[no-untyped-def]
    """Per point, level of roughness and field node: 16 nodes with 2 operations per channel."""
    levels, channels = np.count_nonzero(alphas), values.shape[5]
    size = sum_bytes(normals, x, y, alphas) + 2 * out.nbytes
    return Cost(size, float32=4 * levels * 16 * (2 + 2 * channels))


def sweep(field, step, drift, out):  # type: ignore[no-untyped-def]
    """Per pixel: 5 operations of place and interpolation; 2 and a division where a point is higher.

    Two divisions of float32 run in the time of one of float64.
    """
    higher = int(np.count_nonzero(out))
    size = field.nbytes + out.nbytes
    return Cost(size, float32=5 * field.size + 2 * higher, division=0.5 * higher)


# Dome ------------------------------------------------------------------------------------------


def force_passes(samples, geometry, way, robust, known, l1_steps, steps, settings, *rest):  # type: ignore[no-untyped-def]
    """Return arguments whose tolerance is 0, so that each point takes all steps."""
    settings = settings._replace(tolerance=type(settings.tolerance)(0.0))
    return (samples, geometry, way, robust, known, l1_steps, steps, settings, *rest)


def fit_normals(samples, geometry, way, robust, known, l1_steps, steps, settings, out, valid):  # type: ignore[no-untyped-def]
    """Per padded light and point, in the data's type.

    Two bisections of 10 passes of 2 for ranks of samples and two of residuals, with 3 and 8 of each
    start; squares 24, each step of L1 27 and a division, of the biweight 33; moments 100 and 2.
    """
    lights, points = samples[0].shape
    lanes = points * 32 * math.ceil(lights / 32)
    flops = (23 + 5 + 24 + 27 * l1_steps + 33 * steps + 2 * (23 + 8) + 100 + 12) * lanes
    halves = 0.5 if out.dtype == np.float32 else 1.0  # two divisions of float32 in the time of one
    divisions = halves * (1 + l1_steps + 2 + 2) * lanes
    used = [one for one in (*samples, *geometry) if one.size and 0 not in one.strides]
    size = sum_bytes(*used) + out.nbytes
    if out.dtype == np.float32:
        return Cost(size, float32=flops, division=divisions)
    return Cost(size, float64=flops, division=divisions)


def half_vectors(values, light_dir, view_dir, view, valid, views, normals, stderr, used):  # type: ignore[no-untyped-def]
    """Samples read once; per pair of views that agree 9 operations, a root, an arc."""
    pairs = float((used.astype(np.float64) ** 2).sum())
    size = sum_bytes(values, view) + values.size
    return Cost(size, float64=2 * values.size + 9 * pairs, division=pairs, exp=pairs)


def fit_envelope(  # type: ignore[no-untyped-def]
    f, variance, light, view, normal, valid, start, eta, tilt, has, r_d, stderr, counts, *_
):
    """Per sample: factors and 6 lobes once, then 8 steps of weights and normal equations.

    Picking 24 operations, factors 71 and 13 divisions and roots; a lobe 51 or 14 and 4. A step:
    32 and a division per channel; per lobe 2 per channel and 3; 21 products of two lobes.
    """
    samples, channels = int(np.count_nonzero(valid.any(axis=2))), f.shape[2]
    step = 32 * channels + 6 * (2 * channels + 3) + 2 * 21
    flops = (24 + 71 + 4 * 51 + 2 * 14 + 8 * step) * samples
    size = sum_bytes(f, variance, light, view, valid)
    return Cost(size, float64=flops, division=(13 + 6 * 4 + 8 * channels) * samples)


def fit_basis(table, materials, kinship, value, variance, light, view, normal, valid, again, *_):  # type: ignore[no-untyped-def]
    """Per valid sample: its row of the matrix, and one round of each solution.

    Row: 60 operations and 8 divisions or roots, 10 per column. A round: 2 per column, 3 for norms.
    """
    samples, lanes = int(np.count_nonzero(valid)), table.shape[3]
    flops = (10 + 2 * (1 + again) + 3 * again) * lanes * samples
    size = sum_bytes(value, variance, light, view, valid)
    return Cost(size, float32=flops, float64=60 * samples, division=8 * samples)


def mix_basis(table, weights, light, view, normals, out):  # type: ignore[no-untyped-def]
    """Per sample: 114 operations and 9 divisions and roots for its nodes; 9 per basis BRDF."""
    samples = int(np.count_nonzero(out))
    flops = (114 + 9 * weights.shape[1]) * samples
    return Cost(sum_bytes(light, view, out), float64=flops, division=9 * samples)


def reproject(samples, normals, known, least_cosine, out):  # type: ignore[no-untyped-def]
    """All samples read and written; 20 operations, a division."""
    count = samples[6].size
    return Cost(sum_bytes(samples, out), float64=20 * count, division=count)


def shade(samples, normals, limits, eta, out):  # type: ignore[no-untyped-def]
    """All samples read and written; 70 operations, 12 divisions and roots."""
    count = samples[5].size
    return Cost(sum_bytes(samples, out), float64=70 * count, division=12 * count)


def subtract_diffuse(f, variance, directions, normals, r_d, valid, eta, least, out):  # type: ignore[no-untyped-def]
    """All samples read and written; 70 operations, 15 divisions and roots."""
    size = sum_bytes(f, variance, directions, valid, out)
    return Cost(size, float64=70 * valid.size, division=15 * valid.size)


def assemble(table, scale, rows, lit, light_dir, white, view_dir, normals, out, cosines, valid):  # type: ignore[no-untyped-def]
    """All samples read and written; 30 operations, 3 divisions of float32."""
    size = sum_bytes(table, lit, light_dir, white, out, cosines, valid)
    return Cost(size, float32=30 * valid.size, division=1.0 * valid.size)


def sample_image(signal, variance, good, xy, row):  # type: ignore[no-untyped-def]
    """Per point: two rows of pixels of two images; 4 x 3 x 5 operations."""
    points = len(xy)
    return Cost(sum_bytes(xy, row), float32=60 * points, division=3 * points, gather=4 * points)


# Gradient rig ----------------------------------------------------------------------------------


def solve_occlusion(relief, places, samples, lights, alpha):  # type: ignore[no-untyped-def]
    """Per pixel: horizons of K directions with S samples, and lights observed at least twice.

    A sample 12 operations; an elevation 31 and 4; a light 37, with its horizon 45; 3 divisions and
    roots. Pixels without a horizon are few.
    """
    shift, numbers = samples[0], lights[0]
    pixels = places.shape[0] * places.shape[1]
    directions, steps = shift.shape[1:]
    flops = directions * (12 * steps + 31) + numbers.shape[1] * (37 + 45)
    roots = 4 * directions + 2 * 3 * numbers.shape[1]
    size = relief.nbytes + 2 * places.nbytes
    return Cost(size, float64=flops * pixels, division=roots * pixels)


def invert_moments(parallel, crossed, frame, mirror, table, *rest):  # type: ignore[no-untyped-def]
    """Moments read, normals written; two look-ups in the table of 4 x 4 x 2 splines at least."""
    pixels = parallel.shape[1]
    near = 3 if table.size and table.shape[2] > 7 else 1
    flops = 300 + (2 * (16 * 2 * (2 * near + 4) + 60) if table.size else 0)
    size = sum_bytes(parallel, crossed, rest[-1])
    return Cost(size, float64=flops * pixels, division=25 * pixels)


def fit_moments(y, noise, gain, read, noise_source, dark, out):  # type: ignore[no-untyped-def]
    """Samples read, 15 moments written; 143 operations and 9 divisions, with dark 160 and 12.

    Noise that depends on the signal takes two rounds, with 77 operations of variances in all.
    """
    pixels, rounds = y.shape[1], 2 if noise_source == 2 else 1
    size = y.nbytes + out.nbytes + (noise.nbytes if noise_source == 1 else 0)
    flops = (160 if dark else 143) * rounds + (77 if noise_source == 2 else 0)
    return Cost(size, float64=flops * pixels, division=(12 if dark else 9) * rounds * pixels)


def smooth_grid(ax, ay, inverse, b, x, odd):  # type: ignore[no-untyped-def]
    """Half of the grid's points: conductances, right side and heights read, half written."""
    return Cost(sum_bytes(ax, ay, inverse, b, x) + 0.5 * x.nbytes, float32=5 * x.size)
