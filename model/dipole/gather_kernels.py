"""Walk from exit points through a tree of sources and sum the dipole's light, compiled.

Sources nearer than their reach are summed one by one in float64. Everything else, far sources and
nodes that need not be opened, goes to a buffer that is evaluated in one stream in float32.
"""

# mypy: allow-untyped-defs

import math

import numpy as np
from numba import float32, njit

from model.dipole.direct_sum import MIN_RADIUS_PER_DEPTH, MIN_RELATIVE_LIGHT, SELF_RADIUS_FRACTION
from model.dipole.source_tree_kernels import AREA, RADIUS, REACH, SPREAD

FAR_BUFFER_SIZE = 512
NEAR_BUFFER_SIZE = 64
_FAST_MATH = {"contract", "reassoc", "nsz", "arcp"}
_TWO_PI = 2.0 * math.pi


@njit(inline="always")
def _decay(x):
    """Return exp(-x), x >= 0: relative error 5e-6 up to 20, 2e-3 up to 64; constant beyond."""
    y = min(x, float32(64.0)) * float32(-0.015625)
    p = float32(0.008333333)
    p = p * y + float32(0.041666668)
    p = p * y + float32(0.16666667)
    p = p * y + float32(0.5)
    p = p * y + float32(1.0)
    p = p * y + float32(1.0)
    p *= p
    p *= p
    p *= p
    p *= p
    p *= p
    return p * p


@njit(fastmath=_FAST_MATH, error_model="numpy", forceinline=True)
def _far(count, away2, area, light, pull, medium, total):
    """Add light and mass of a buffer in one channel, including the light's first moments."""
    sigma, depth, height, scale = medium
    s = float32(sigma)
    z_r, z_v = float32(depth), float32(height)
    z_r2, z_v2 = z_r * z_r, z_v * z_v
    lit = float32(0.0)
    mass = float32(0.0)
    for i in range(count):
        over_r = float32(1.0) / math.sqrt(away2[i] + z_r2)
        over_v = float32(1.0) / math.sqrt(away2[i] + z_v2)
        d_r, d_v = (away2[i] + z_r2) * over_r, (away2[i] + z_v2) * over_v
        x_r, x_v = s * d_r, s * d_v
        # z exp(-x) / d^3 of the real and the virtual source
        k_r = z_r * _decay(x_r) * over_r * over_r * over_r
        k_v = z_v * _decay(x_v) * over_v * over_v * over_v
        value = (float32(1.0) + x_r) * k_r + (float32(1.0) + x_v) * k_v
        slope = (float32(3.0) + x_r * (float32(3.0) + x_r)) * k_r * over_r * over_r
        slope += (float32(3.0) + x_v * (float32(3.0) + x_v)) * k_v * over_v * over_v
        lit += value * light[i] - slope * pull[i]
        mass += value * area[i]
    total[0] += scale / _TWO_PI * lit
    total[1] += scale / _TWO_PI * mass


@njit(error_model="numpy")
def _disc(r2, medium):
    """Return the profile at a radius, and the fraction of light within it."""
    sigma, depth, height, scale = medium
    value = within = 0.0
    for z in (depth, height):
        d = max(math.sqrt(r2 + z * z), 1e-300)
        x = sigma * d
        e = math.exp(-x) * z / d
        value += (1.0 + x) * e / (d * d)
        within += math.exp(-sigma * z) - e
    return scale / _TWO_PI * value, scale * within


@njit(error_model="numpy")
def _near(count, away2, reach, area, light, medium, own, total):
    """Add light and mass of sources within their reach, float64; see `direct_sum.kernel`.

    ``own`` is the light at the exit point itself; NaN: unknown, each source's own light is used.
    """
    for i in range(count):
        a = reach[i]
        fine = a <= MIN_RADIUS_PER_DEPTH * medium[1]
        r2 = float(away2[i]) if fine else a * a
        value, within = _disc(r2, medium)
        total[1] += value * area[i]
        total[0] += value * light[i]
        if not fine:
            disc = math.pi * r2
            missing = within - disc * value
            shape = 3.0 / disc * (1.0 - away2[i] / r2) ** 2
            total[1] += shape * missing * area[i]
            total[0] += shape * missing * light[i]
            if own == own:
                r2 *= SELF_RADIUS_FRACTION * SELF_RADIUS_FRACTION
                value, within = _disc(r2, medium)
                missing = within - math.pi * r2 * value
                total[0] += shape * missing * (own * area[i] - light[i])


@njit
def _medium_at(media, q, c):
    """Return the dipole of an exit point's channel."""
    sigma, depth, height, scale = media
    return sigma[q, c], depth[q, c], height[q, c], scale[q, c]


@njit
def _add_far(count, far, media, q, total):
    """Do the work of `_far` for each channel of an exit point."""
    away2, mass, light, pull = far
    for c in range(3):
        _far(count, away2, mass, light[c], pull[c], _medium_at(media, q, c), total[c])


@njit
def _add_near(count, near, media, q, own, total):
    """Do the work of `_near` for each channel of an exit point."""
    away2, reach, area, light = near
    for c in range(3):
        medium = _medium_at(media, q, c)
        _near(count, away2, reach, area, light[c], medium, own[q, c], total[c])


@njit
def _nearest(point, position, node_summary, low, high, skip):
    """Return the source nearest to a point."""
    best, found = np.inf, 0
    node = 0
    while node < len(skip):
        x = node_summary[node, 0] - point[0]
        y = node_summary[node, 1] - point[1]
        z = node_summary[node, 2] - point[2]
        gap = math.sqrt(x * x + y * y + z * z) - node_summary[node, RADIUS]
        if gap > 0.0 and gap * gap >= best:
            node = skip[node]
            continue
        if skip[node] == node + 1:
            for i in range(low[node], high[node]):
                x = position[i, 0] - point[0]
                y = position[i, 1] - point[1]
                z = position[i, 2] - point[2]
                away = x * x + y * y + z * z
                if away < best:
                    best, found = away, i
        node += 1
    return found


@njit(cache=True, nogil=True, fastmath={"contract"}, error_model="numpy")
def gather(
    exit_point,
    sigma,
    depth,
    height,
    scale,
    own,
    tolerance,
    normalize,
    position,
    reach,
    area,
    entered,
    node_summary,
    moments,
    low,
    high,
    skip,
    found,
    bound,
    work,
):
    """Fill the light that reaches each exit point (Q, 3), before R_d, its bound and its work.

    Parameters
    ----------
    at
        (Q, 3) float32, in the frame of the tree.
    sigma, depth, height, scale
        Dipoles of the exit points, (Q, 3) float64.
    own
        Light that entered at the exit points, (Q, 3); NaN: unknown.
    tolerance
        Largest error of a node over the brightest light that entered.
    place, reach, area, entered
        Sources in the tree's order, float32.
    seen, moments, low, high, skip
        The tree.
    bound
        (Q,) sum of the nodes' bounds.
    work
        (Q,) nodes and sources that were summed.
    """
    away2 = np.empty(FAR_BUFFER_SIZE, np.float32)
    mass = np.empty(FAR_BUFFER_SIZE, np.float32)
    light = np.empty((3, FAR_BUFFER_SIZE), np.float32)
    pull = np.empty((3, FAR_BUFFER_SIZE), np.float32)
    near_away2, near_reach = np.empty(NEAR_BUFFER_SIZE), np.empty(NEAR_BUFFER_SIZE)
    near_area, near_light = np.empty(NEAR_BUFFER_SIZE), np.empty((3, NEAR_BUFFER_SIZE))
    media, far = (sigma, depth, height, scale), (away2, mass, light, pull)
    near = (near_away2, near_reach, near_area, near_light)
    total = np.zeros((3, 2))
    nodes = len(skip)
    for q in range(len(exit_point)):
        p0, p1, p2 = exit_point[q, 0], exit_point[q, 1], exit_point[q, 2]
        # one kernel above those of all channels (slowest decay, largest dipole) bounds all three
        s = float32(min(sigma[q, 0], sigma[q, 1], sigma[q, 2]))
        z = min(depth[q, 0], depth[q, 1], depth[q, 2])
        least2 = float32(z * z)
        most = 0.0
        for c in range(3):
            most = max(most, scale[q, c] * (depth[q, c] + height[q, c]))
        factor = float32(0.5 * most / _TWO_PI)
        limit = float32(tolerance)
        total[:] = 0.0
        count = close = used = 0
        err = 0.0
        node = 0
        while node < nodes:
            x, y, z = (
                node_summary[node, 0] - p0,
                node_summary[node, 1] - p1,
                node_summary[node, 2] - p2,
            )
            r2 = x * x + y * y + z * z
            r = math.sqrt(r2)
            opened = True
            if r > node_summary[node, REACH]:
                gap = r - node_summary[node, RADIUS]
                d2 = gap * gap + least2
                d = math.sqrt(d2)
                t = s * d
                # exp(-t) is below (1 + t/8)^-8
                e = float32(1.0) + float32(0.125) * t
                e *= e
                e *= e
                e *= e
                bend = float32(12.0) + t * (float32(12.0) + t * (float32(5.0) + t))
                strays = factor * node_summary[node, SPREAD] * bend
                room = e * d2 * d2 * d
                if strays <= limit * room:
                    opened = False
            if not opened:
                if count == FAR_BUFFER_SIZE:
                    _add_far(count, far, media, q, total)
                    count = 0
                err += strays / room
                away2[count] = r2
                mass[count] = node_summary[node, AREA]
                for c in range(3):
                    light[c, count] = moments[node, c]
                    pull[c, count] = (
                        moments[node, 3 + 3 * c] * x
                        + moments[node, 4 + 3 * c] * y
                        + moments[node, 5 + 3 * c] * z
                    )
                count += 1
                used += 1
                node = skip[node]
                continue
            if skip[node] == node + 1:
                for i in range(low[node], high[node]):
                    x, y, z = position[i, 0] - p0, position[i, 1] - p1, position[i, 2] - p2
                    r2 = x * x + y * y + z * z
                    used += 1
                    if r2 < reach[i] * reach[i]:
                        if close == NEAR_BUFFER_SIZE:
                            _add_near(close, near, media, q, own, total)
                            close = 0
                        near_away2[close] = r2
                        near_reach[close] = reach[i]
                        near_area[close] = area[i]
                        for c in range(3):
                            near_light[c, close] = area[i] * entered[i, c]
                        close += 1
                    else:
                        if count == FAR_BUFFER_SIZE:
                            _add_far(count, far, media, q, total)
                            count = 0
                        away2[count] = r2
                        mass[count] = area[i]
                        for c in range(3):
                            light[c, count] = area[i] * entered[i, c]
                            pull[c, count] = 0.0
                        count += 1
            node += 1
        _add_far(count, far, media, q, total)
        _add_near(close, near, media, q, own, total)
        nearest = -1
        for c in range(3):
            if not normalize:
                found[q, c] = total[c, 0]
            elif total[c, 1] > MIN_RELATIVE_LIGHT:
                found[q, c] = total[c, 0] / total[c, 1]
            else:
                if nearest < 0:
                    nearest = _nearest(exit_point[q], position, node_summary, low, high, skip)
                found[q, c] = entered[nearest, c]
        bound[q] = err
        work[q] = used
