"""Walk photons from a fiber and lay each path into skin that differs from place to place, compiled.

See `rigsim.scenes.reference.placed_paths` for the method.
"""

from math import atan2, cos, exp, inf, log, pi, sin, sqrt

import numpy as np
from numba import njit

from rigsim.tissue.photon_walk import draw_disc_point, draw_uniform, fresnel, scatter_direction

LAYER_COLUMNS = 5
"""Columns of the layers: top, bottom (mm), sigma_s, even sigma_a (1/mm), scattering depth of the
top."""
MAX_VERTICES = 1 << 16
STACK_DEPTH = 512
MAX_COPIES = 16
MAX_DEPTH_GAIN = 30.0
SCORED_OPTICAL_DEPTH = 1.5
_STATE_SIZE = 10


@njit(inline="always")
def _mean_on_line(values, x0, y0, x1, y1):  # type: ignore[no-untyped-def]
    """Return the mean of cells along a line in units of cells; the border continues outside."""
    rows, columns = values.shape
    column, row = int(np.floor(x0)), int(np.floor(y0))
    dx, dy = x1 - x0, y1 - y0
    step_x, step_y = 1 if dx > 0.0 else -1, 1 if dy > 0.0 else -1
    next_x, next_y = inf, inf
    if dx != 0.0:
        next_x = (column + (1 if dx > 0.0 else 0) - x0) / dx
    if dy != 0.0:
        next_y = (row + (1 if dy > 0.0 else 0) - y0) / dy
    total, now = 0.0, 0.0
    while True:
        then = min(next_x, next_y, 1.0)
        here = values[min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)]
        total += (then - now) * here
        if then >= 1.0:
            return total
        now = then
        if next_x <= next_y:
            column += step_x
            next_x += step_x / dx
        else:
            row += step_y
            next_y += step_y / dy


@njit
def excess_depth(path, count, maps, corner_mm, cells_per_mm, turn, shift):  # type: ignore[no-untyped-def]
    """Return the integral of the excess absorption along a path that is turned and shifted.

    Parameters
    ----------
    path
        Vertices, rows x, y, length of the step that ends there in mm, and its layer. float64,
        shape (vertices, 4); the first is the entry.
    count
        Number of vertices.
    maps
        Excess of sigma_a, 1/mm, float64, shape (layers, ny, nx).
    corner_mm, cells_per_mm
        Position of the maps' corner along both axes, and cells per mm.
    turn, shift
        Angle in radians, and offset (x, y) in mm.
    """
    c, s = cos(turn) * cells_per_mm, sin(turn) * cells_per_mm
    left = (shift[0] - corner_mm) * cells_per_mm
    low = (shift[1] - corner_mm) * cells_per_mm
    x0 = c * path[0, 0] - s * path[0, 1] + left
    y0 = s * path[0, 0] + c * path[0, 1] + low
    total = 0.0
    for k in range(1, count):
        x1 = c * path[k, 0] - s * path[k, 1] + left
        y1 = s * path[k, 0] + c * path[k, 1] + low
        total += path[k, 2] * _mean_on_line(maps[int(path[k, 3])], x0, y0, x1, y1)
        x0, y0 = x1, y1
    return total


@njit(inline="always")
def _draw_place(s0, s1, s2, s3, rho, radius, cores):  # type: ignore[no-untyped-def]
    """Draw a point of the source's core, and the direction of a displacement to the other core."""
    both = cores[0] + cores[1]
    widest = pi
    if rho + radius > both:
        widest = np.arccos(
            min(max((rho * rho + radius * radius - both * both) / (2.0 * rho * radius), -1.0), 1.0)
        )
    while True:
        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
        phi = (2.0 * u - 1.0) * widest
        s0, s1, s2, s3, p, q = draw_disc_point(s0, s1, s2, s3)
        p *= cores[0]
        q *= cores[0]
        x, y = p + rho * cos(phi) - radius, q + rho * sin(phi)
        if x * x + y * y <= cores[1] * cores[1]:
            return s0, s1, s2, s3, p, q, phi


@njit(cache=True, nogil=True, error_model="numpy")
def walk_placed_paths(  # type: ignore[no-untyped-def]
    layers,
    optics,
    fibers,
    rings,
    window,
    per_mm,
    maps,
    corner,
    places,
    replays,
    photons,
    seed,
    found,
):
    """Trace photons from a point, score them in rings, and lay some of the paths into the maps.

    Parameters
    ----------
    layers
        See `LAYER_COLUMNS`; the last bottom is infinite. float64, shape (n, 5).
    optics
        g, refractive index, apertures of source and fibers, radii of their cores in mm.
    fibers
        Distances of the fibers, mm, increasing, shape (F,).
    rings
        As `rigsim.fiber.rings.ring_kernels` returns them.
    window
        Weight at which photons are kept, by distance from the entry, shape (cells + 1,).
    per_mm
        Cells of `window` per mm; growth of the kept weight per mm of depth.
    maps
        Excess of sigma_a over the layers' even one, 1/mm, shape (n, ny, nx).
    corner
        Position of the maps' corner along both axes, mm, and cells per mm.
    places
        Position of the source, mm, and direction of the row, radians, shape (P, 3).
    replays
        Paths to lay into the maps, per score, shape (F,); 0 for none.
    photons
        Photons to trace.
    seed
        State of the generator, uint64, shape (4,).
    found
        Added to: R_f of the even layers, shape (F,); weight of visits by distance, shape
        (2, cells + 1); of the laid paths their R_f in even layers, then in each place, shape
        (F, 1 + P).

    Returns
    -------
    int
        Photons that had more than `MAX_VERTICES` vertices.
    """
    g, eta, source_sine, fiber_sine, source_core, fiber_core = optics
    kernels, starts, counts = rings
    tally, visited, laid = found
    cores = source_core, fiber_core
    s0, s1, s2, s3 = seed[0], seed[1], seed[2], seed[3]
    cells = window.shape[0] - 1
    last = layers.shape[0] - 1
    path = np.zeros((MAX_VERTICES + last + 2, 4))
    waiting = np.empty((STACK_DEPTH, _STATE_SIZE))
    lost = 0
    for _ in range(photons):
        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
        sine2 = source_sine * source_sine * u
        reflected, mu = fresnel(sqrt(1.0 - sine2), 1.0, eta)
        x, y, z = 0.0, 0.0, 0.0
        ux, uy, uz = sqrt(sine2) / eta, 0.0, mu
        weight = 1.0 - reflected
        layer, count, alive = 0, 1, 0
        while True:
            s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
            left = -log(u)
            ended = False
            while True:
                rate = layers[layer, 2]
                gap = layers[layer, 1] - z if uz > 0.0 else z - layers[layer, 0]
                collides = left * abs(uz) < rate * gap
                step = left / rate if collides else gap / abs(uz)
                x += step * ux
                y += step * uy
                weight *= exp(-layers[layer, 3] * step)
                path[count, 0], path[count, 1] = x, y
                path[count, 2], path[count, 3] = step, layer
                count += 1
                if count >= MAX_VERTICES:
                    lost += 1
                    ended = True
                    break
                if collides:
                    z += step * uz
                    break
                left = max(left - rate * step, 0.0)
                if uz > 0.0:
                    z = layers[layer, 1]
                    layer += 1
                    continue
                z = layers[layer, 0]
                if layer > 0:
                    layer -= 1
                    continue
                reflected, mu = fresnel(-uz, eta, 1.0)
                s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                if u > reflected:
                    ended = True
                    break
                uz = -uz
            if not ended:
                cell = min(int(sqrt(x * x + y * y + z * z) * per_mm[0]), cells)
                above = layers[layer, 4] + layers[layer, 2] * (z - layers[layer, 0])
                chance = exp(min(SCORED_OPTICAL_DEPTH - above, 0.0))
                s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                if u <= chance:
                    s0, s1, s2, s3, p, q = draw_disc_point(s0, s1, s2, s3)
                    p *= fiber_sine / eta
                    q *= fiber_sine / eta
                    mu = sqrt(1.0 - p * p - q * q)
                    turn = ux * p + uy * q - uz * mu
                    spread = 1.0 + g * g - 2.0 * g * turn
                    value = weight * (1.0 - g * g) / (4.0 * spread * sqrt(spread))
                    value *= (1.0 - fresnel(mu, eta, 1.0)[0]) / (eta * eta * mu * chance)
                    x_out, y_out, at, end = x, y, z, count
                    for k in range(layer, -1, -1):
                        way = (at - layers[k, 0]) / mu
                        at = layers[k, 0]
                        value *= exp(-way * (layers[k, 2] + layers[k, 3]))
                        x_out += way * p
                        y_out += way * q
                        path[end, 0], path[end, 1] = x_out, y_out
                        path[end, 2], path[end, 3] = way, k
                        end += 1
                    rho = sqrt(x_out * x_out + y_out * y_out)
                    bin_ = int(rho * kernels[0, 2])
                    first, stop = 0, 0
                    if bin_ < starts.shape[0]:
                        first, stop = starts[bin_], starts[bin_] + counts[bin_]
                    for fiber in range(first, stop):
                        place = (rho - kernels[fiber, 0]) * kernels[fiber, 1]
                        node = int(place)
                        if place < 0.0 or node >= kernels.shape[1] - 4:
                            continue
                        low = kernels[fiber, 3 + node]
                        score = low + (place - node) * (kernels[fiber, 4 + node] - low)
                        score *= value
                        tally[fiber] += score
                        pick = score * replays[fiber]
                        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                        if u > pick:
                            continue
                        score /= min(pick, 1.0)
                        s0, s1, s2, s3, px, py, phi = _draw_place(
                            s0, s1, s2, s3, rho, fibers[fiber], cores
                        )
                        phi -= atan2(y_out, x_out)
                        laid[fiber, 0] += score
                        for k in range(places.shape[0]):
                            c, s = cos(places[k, 2]), sin(places[k, 2])
                            shift = (places[k, 0] + c * px - s * py, places[k, 1] + s * px + c * py)
                            excess = excess_depth(
                                path, end, maps, corner[0], corner[1], phi + places[k, 2], shift
                            )
                            laid[fiber, 1 + k] += score * exp(-excess)
                deeper = min(1.0 + z * per_mm[1], MAX_DEPTH_GAIN)
                target = window[cell] * deeper
                visited[0, cell] += weight * chance
                visited[1, cell] += weight / deeper
                if weight < 0.5 * target:
                    s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                    if u * target > weight:
                        ended = True
                    weight = target
                elif weight > 2.0 * target:
                    copies = min(int(weight / target), MAX_COPIES, STACK_DEPTH - alive + 1)
                    if copies > 1:
                        weight /= copies
                        for _copy in range(copies - 1):
                            row = waiting[alive]
                            row[0], row[1], row[2] = x, y, z
                            row[3], row[4], row[5] = ux, uy, uz
                            row[6], row[7], row[8] = weight, layer, count
                            alive += 1
            if ended:
                if alive == 0:
                    break
                # copies end in the reverse order, so that the vertices before a split are unchanged
                alive -= 1
                row = waiting[alive]
                x, y, z = row[0], row[1], row[2]
                ux, uy, uz = row[3], row[4], row[5]
                weight, layer, count = row[6], int(row[7]), int(row[8])
            s0, s1, s2, s3, ux, uy, uz = scatter_direction(s0, s1, s2, s3, ux, uy, uz, g)
    return lost
