"""Trace photons through anisotropic tissue, compiled (see `rigsim.fiber.anisotropic_tissue`)."""

from math import exp, log, sqrt

import numpy as np
from numba import njit

from rigsim.fiber.walk import MAX_COPIES, MAX_DEPTH_GAIN, STACK_DEPTH
from rigsim.tissue.photon_walk import draw_disc_point, draw_uniform, fresnel, scatter_direction


@njit(inline="always")
def _scatter_direction(s0, s1, s2, s3, ux, uy, uz, g, strength, most):  # type: ignore[no-untyped-def]
    """Draw a Henyey-Greenstein direction; accept it with the weight a(w') of the new direction."""
    while True:
        s0, s1, s2, s3, vx, vy, vz = scatter_direction(s0, s1, s2, s3, ux, uy, uz, g)
        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
        if u * most <= 1.0 + strength * (vx * vx - 1.0 / 3.0):
            return s0, s1, s2, s3, vx, vy, vz


@njit(cache=True, nogil=True, error_model="numpy")
def walk_anisotropic(  # type: ignore[no-untyped-def]
    medium, sines, core_centers, bins, rings, window, per_mm, photons, seed, found
):
    """Trace photons from a point source in a cone and score fibers at their positions.

    Parameters
    ----------
    medium
        sigma_a, sigma_s (1/mm), g, eta, strength; the preferred axis is x. float64, shape (5,).
    sines
        Numerical apertures of the source and of the fibers.
    spots
        Positions, x and y of the fibers in mm, by increasing distance, float64, shape (F, 2);
        density of (point in one core - point in the other) in 1/mm^2 by distance from the mean, the
        last node 0, shape (nodes,); and its nodes per mm.
    bins
        First fiber and number of fibers that reach each bin of exit radius, and bins per mm.
    rings
        For each of some distances: first exit radius (mm), nodes per mm and, by node, the density's
        even harmonics over the direction; then light is scored by harmonics, and `bins` are those
        of distances. float64, shape (R, 1 + nodes, H); R = 0 for light scored in places.
    window, photons, seed
        As in `rigsim.fiber.walk.walk_to_fibers`.
    per_mm
        Cells of `window` per mm, and growth of the kept weight per mm of depth.
    found
        What is added to: light by fiber, shape (F, 1), or by distance and harmonic, shape (R, H);
        and the weight that visited each distance, see there.
    """
    source_sine, fiber_sine = sines
    places, overlap, overlap_per_mm = core_centers
    starts, counts, bins_per_mm = bins
    cells_per_mm, deeper_per_mm = per_mm
    tally, visited = found
    s0, s1, s2, s3 = seed[0], seed[1], seed[2], seed[3]
    sigma_a, sigma_s, g, eta, strength = medium[0], medium[1], medium[2], medium[3], medium[4]
    most = max(1.0 + strength * 2.0 / 3.0, 1.0 - strength / 3.0)
    cells = window.shape[0] - 1
    by_ring = rings.shape[0] > 0
    waiting = np.empty((STACK_DEPTH, 7))
    for _ in range(photons):
        s0, s1, s2, s3, ux, uy = draw_disc_point(s0, s1, s2, s3)
        ux *= source_sine
        uy *= source_sine
        reflected, uz = fresnel(sqrt(1.0 - ux * ux - uy * uy), 1.0, eta)
        ux /= eta
        uy /= eta
        x, y, z = 0.0, 0.0, 0.0
        weight = 1.0 - reflected
        alive = 0
        while True:
            while True:
                along = ux * ux - 1.0 / 3.0
                kept = 1.0 + strength * g * g * along
                scattering = sigma_s * (1.0 + strength * along) * kept
                sigma_t = sigma_a + scattering
                s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                step = -log(u) / sigma_t
                if z + step * uz < 0.0:
                    step = -z / uz
                    x += step * ux
                    y += step * uy
                    z = 0.0
                    reflected, _mu = fresnel(-uz, eta, 1.0)
                    s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                    if u > reflected:
                        break  # already scored: all exiting light comes directly from a collision
                    uz = -uz
                    continue
                x += step * ux
                y += step * uy
                z += step * uz
                weight *= scattering / sigma_t
                cell = min(int(sqrt(x * x + y * y + z * z) * cells_per_mm), cells)
                chance = min(exp(1.5 - sigma_s * z), 1.0)
                deeper = min(1.0 + z * deeper_per_mm, MAX_DEPTH_GAIN)
                visited[0, cell] += weight * chance
                visited[1, cell] += weight / deeper
                s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                if u <= chance:
                    s0, s1, s2, s3, p, q = draw_disc_point(s0, s1, s2, s3)
                    p *= fiber_sine / eta
                    q *= fiber_sine / eta
                    mu = sqrt(1.0 - p * p - q * q)
                    turn = ux * p + uy * q - uz * mu
                    spread = 1.0 + g * g - 2.0 * g * turn
                    out = p * p - 1.0 / 3.0
                    value = weight * (1.0 - g * g) / (4.0 * spread * sqrt(spread))
                    value *= (1.0 + strength * out) / kept / (eta * eta * mu * chance)
                    leaving = (1.0 + strength * out) * (1.0 + strength * g * g * out)
                    value *= exp(-(sigma_a + sigma_s * leaving) * z / mu)
                    reflected, _mu = fresnel(mu, eta, 1.0)
                    value *= 0.25 * (1.0 - reflected)  # four mirror images
                    x_out = abs(x + z * p / mu)
                    y_out = abs(y + z * q / mu)
                    bin_ = int(sqrt(x_out * x_out + y_out * y_out) * bins_per_mm)
                    if bin_ < starts.shape[0]:
                        for ring in range(
                            starts[bin_] if by_ring else 0,
                            starts[bin_] + counts[bin_] if by_ring else 0,
                        ):
                            far = sqrt(x_out * x_out + y_out * y_out)
                            at = (far - rings[ring, 0, 0]) * rings[ring, 0, 1]
                            node = int(at)
                            if at < 0.0 or node >= rings.shape[1] - 2:
                                continue
                            share = at - node
                            double = 1.0
                            if far > 0.0:
                                double = (x_out * x_out - y_out * y_out) / (far * far)
                            before = double  # cosines of even multiples of the direction
                            cosine = 1.0
                            for k in range(rings.shape[2]):
                                low = rings[ring, 1 + node, k]
                                high = rings[ring, 2 + node, k]
                                density = low + share * (high - low)
                                tally[ring, k] += 4.0 * value * density * cosine
                                cosine, before = 2.0 * double * cosine - before, cosine
                        for fiber in range(
                            starts[bin_], starts[bin_] + (0 if by_ring else counts[bin_])
                        ):
                            for image in range(4):
                                dx = places[fiber, 0] - (x_out if image & 1 else -x_out)
                                dy = places[fiber, 1] - (y_out if image & 2 else -y_out)
                                at = sqrt(dx * dx + dy * dy) * overlap_per_mm
                                node = int(at)
                                if node < overlap.shape[0] - 1:
                                    low = overlap[node]
                                    share = at - node
                                    tally[fiber, 0] += value * (
                                        low + share * (overlap[node + 1] - low)
                                    )
                target = window[cell] * deeper
                if weight < 0.5 * target:
                    s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                    if u * target > weight:
                        break
                    weight = target
                elif weight > 2.0 * target:
                    copies = min(int(weight / target), MAX_COPIES, STACK_DEPTH - alive + 1)
                    weight /= copies
                    for _copy in range(copies - 1):
                        row = waiting[alive]
                        row[0], row[1], row[2] = x, y, z
                        row[3], row[4], row[5], row[6] = ux, uy, uz, weight
                        alive += 1
                s0, s1, s2, s3, ux, uy, uz = _scatter_direction(
                    s0, s1, s2, s3, ux, uy, uz, g, strength, most
                )
            if alive == 0:
                break
            alive -= 1
            row = waiting[alive]
            x, y, z, weight = row[0], row[1], row[2], row[6]
            ux, uy, uz = row[3], row[4], row[5]
            s0, s1, s2, s3, ux, uy, uz = _scatter_direction(
                s0, s1, s2, s3, ux, uy, uz, g, strength, most
            )
