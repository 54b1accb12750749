"""Trace photons and score them in fibers, compiled (see `rigsim.fiber.profile`).

At each collision the direct light into a fiber's cone is scored (next-event estimation): the
probability of scattering into the cone, times transmittance to and through the surface. Where the
phase function is narrower than the cone, such scores are rare and large; so this estimator and
random exits are combined by their densities (the balance heuristic of Veach and Guibas 1995,
doi:10.1145/218380.218498): photons that exit within the cone directly from a collision get the
remaining weight. After a reflection at an interface they get full weight.
"""

from math import copysign, exp, log, sqrt

import numpy as np
from numba import njit

from rigsim.tissue.photon_walk import draw_disc_point, draw_uniform, fresnel, scatter_direction

TABLE_COLUMNS = 8
"""Columns of the layer table: top, bottom (mm), sigma_t (1/mm), albedo, g, eta, optical depth of
the top below the surface, fraction of the counted absorber."""

STACK_DEPTH = 512  # capacity for waiting copies; when full, photons are not split further
MAX_COPIES = 16  # largest number of copies of one photon at one collision
MAX_DEPTH_GAIN = 30.0  # largest factor of the kept weight by depth
_STATE_SIZE = 9  # x, y, z, ux, uy, uz, weight, path, layer


@njit(inline="always")
def _score_fibers(rho, value, path, rings, paths, tally, histogram):  # type: ignore[no-untyped-def]
    """Add light that exits at a distance to the fibers within reach."""
    kernels, starts, counts = rings
    log_step, path_scale = paths
    bin_ = int(rho * kernels[0, 2])
    if bin_ >= starts.shape[0]:
        return
    for fiber in range(starts[bin_], starts[bin_] + counts[bin_]):
        at = (rho - kernels[fiber, 0]) * kernels[fiber, 1]
        if at < 0.0:
            continue
        node = int(at)
        if node >= kernels.shape[1] - 4:
            continue
        share = at - node
        low = kernels[fiber, 3 + node]
        score = value * (low + share * (kernels[fiber, 4 + node] - low))
        if histogram.shape[0] == 0:
            tally[fiber] += score
        else:
            position = log(1.0 + path / path_scale) / log_step
            left = min(int(position), histogram.shape[1] - 2)
            start = path_scale * (exp(left * log_step) - 1.0)
            stop = path_scale * (exp((left + 1) * log_step) - 1.0)
            part = min((path - start) / (stop - start), 1.0)
            histogram[fiber, left] += score * (1.0 - part)
            histogram[fiber, left + 1] += score * part


@njit(
    "void(float64[:,::1], UniTuple(float64, 2), Tuple((float64[:,::1], int64[::1], int64[::1])),"
    " float64[::1], float64[::1], UniTuple(float64, 3), UniTuple(float64, 2), int64, uint64[::1],"
    " Tuple((float64[::1], float64[:,::1], float64[:,::1])))",
    cache=True,
    nogil=True,
    error_model="numpy",
)
def walk_to_fibers(  # type: ignore[no-untyped-def]
    table, sines, rings, window, chances, per_mm, paths, photons, seed, found
):
    """Trace photons from a point source in a cone and score the light in fibers.

    Parameters
    ----------
    table
        Row 0 the medium above, rows 1 to n the layers, row n + 1 the medium below; see
        `TABLE_COLUMNS`. float64, shape (n + 2, 8).
    sines
        Numerical apertures of the source and of the fibers.
    rings
        Kernels, one row a fiber, in the order of their distance: smallest exit radius it takes
        (mm), nodes per mm, bins of `starts` per mm, then its density (1/mm^2) at the nodes.
        float64, shape (F, 3 + nodes + 1), the last value 0; first fiber and number of fibers that
        reach each bin of exit radius, int64, shape (bins,).
    window
        Weight at which photons are kept, by their distance from the entry; lighter ones play,
        heavier ones are split. float64, shape (cells,); the last holds for all farther ones.
    chances
        Probability to score a collision, by its depth; 0 where no light comes up.
        float64, shape (levels,).
    per_mm
        Cells of `window` per mm, growth of the kept weight per mm of depth in units of that at the
        surface, cells of `chances` per mm.
    paths
        Step and scale of paths: nodes of the histogram lie at ``scale * (exp(step * k) - 1)`` mm.
    photons
        Photons to trace.
    seed
        State of the generator, not all zero, uint64, shape (4,).
    found
        What is added to. Light in each fiber per area, aperture^2 and photon in 1/mm^2, float64,
        shape (F,), when the histogram is empty; the histogram, the same by the path in the counted
        absorber, each score shared by the two nodes around it so that its mean path is kept.
        float64, shape (F, nodes) or (0, 0); the weight of scored collisions by distance from the
        entry; of all, in units of the weight kept at their depth. float64, shape (2, cells).
    """
    source_sine, fiber_sine = sines
    cells_per_mm, deeper_per_mm, chances_per_mm = per_mm
    tally, histogram, visited = found
    s0, s1, s2, s3 = seed[0], seed[1], seed[2], seed[3]
    last = table.shape[0] - 1
    eta_above = table[0, 5]
    cells = window.shape[0] - 1
    levels = chances.shape[0]
    waiting = np.empty((STACK_DEPTH, _STATE_SIZE))
    eta_ratio = eta_above / table[1, 5]

    for _ in range(photons):
        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
        sine2 = source_sine * source_sine * u / (eta_above * eta_above)
        reflected, mu = fresnel(sqrt(1.0 - sine2), eta_above, table[1, 5])
        x, y, z = 0.0, 0.0, 0.0  # position, mm
        ux, uy, uz = sqrt(sine2) * eta_ratio, 0.0, mu  # direction
        weight = 1.0 - reflected
        path = 0.0  # in the counted absorber, mm
        layer = 1
        direct = False  # unreflected since a collision that was scored
        chance = 0.0  # that collision's: probability to be scored, layer, direction, its cosine
        from_layer = 1
        now_z = 1.0
        turn = 1.0
        alive = 0

        while True:
            top = table[layer, 0]
            bottom = table[layer, 1]
            sigma_t = table[layer, 2]
            g = table[layer, 4]
            s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
            depth_left = -log(u)  # optical depth to the next collision

            while True:
                gap = bottom - z if uz > 0.0 else z - top
                if depth_left * abs(uz) < sigma_t * gap:
                    step = depth_left / sigma_t
                    x += step * ux
                    y += step * uy
                    z += step * uz
                    path += step * table[layer, 7]
                    weight *= table[layer, 3]
                    r2 = x * x + y * y
                    cell = min(int(sqrt(r2 + z * z) * cells_per_mm), cells)

                    level = int(z * chances_per_mm)
                    chance = chances[level] if level < levels else 0.0
                    if chance > 0.0:
                        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                        if u <= chance:
                            # A direction within the cone outside, uniform in projected angle.
                            s0, s1, s2, s3, p, q = draw_disc_point(s0, s1, s2, s3)
                            norm = p * p + q * q
                            eta = table[layer, 5]
                            p *= fiber_sine
                            q *= fiber_sine
                            norm *= fiber_sine * fiber_sine  # (eta sin)^2, kept by refraction
                            mu = sqrt(1.0 - norm / (eta * eta))
                            turn = (ux * p + uy * q) / eta - uz * mu
                            spread = 1.0 + g * g - 2.0 * g * turn
                            phase = (1.0 - g * g) / (4.0 * spread * sqrt(spread))  # times pi
                            drawn = chance * eta * eta * mu / (fiber_sine * fiber_sine)
                            value = weight * phase / (drawn + phase)
                            value *= eta_above * eta_above / (fiber_sine * fiber_sine)
                            x_out = x
                            y_out = y
                            out_path = path
                            at = z
                            tau = 0.0
                            for k in range(layer, 0, -1):
                                eta = table[k, 5]
                                mu = sqrt(1.0 - norm / (eta * eta))
                                way = (at - table[k, 0]) / mu
                                at = table[k, 0]
                                tau += way * table[k, 2]
                                x_out += way * p / eta
                                y_out += way * q / eta
                                out_path += way * table[k, 7]
                                if eta != table[k - 1, 5]:
                                    reflected, _mu = fresnel(mu, eta, table[k - 1, 5])
                                    value *= 1.0 - reflected
                            value *= exp(-tau)
                            rho = sqrt(x_out * x_out + y_out * y_out)
                            _score_fibers(rho, value, out_path, rings, paths, tally, histogram)

                    deeper = min(1.0 + z * deeper_per_mm, MAX_DEPTH_GAIN)
                    target = window[cell] * deeper
                    visited[0, cell] += weight * chance
                    visited[1, cell] += weight / deeper
                    if weight < 0.5 * target:
                        s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                        if u * target > weight:
                            break
                        weight = target
                    elif weight > 2.0 * target:
                        copies = min(int(weight / target), MAX_COPIES, STACK_DEPTH - alive + 1)
                        if copies > 1:
                            weight /= copies
                            for _copy in range(copies - 1):
                                row = waiting[alive]
                                row[0], row[1], row[2] = x, y, z
                                row[3], row[4], row[5] = ux, uy, uz
                                row[6], row[7], row[8] = weight, path, layer
                                alive += 1
                    # The direct light from here was scored in part: weight the exit by the balance
                    # heuristic.
                    direct = True
                    was_x, was_y, was_z = ux, uy, uz
                    s0, s1, s2, s3, ux, uy, uz = scatter_direction(s0, s1, s2, s3, ux, uy, uz, g)
                    from_layer, now_z = layer, uz
                    turn = was_x * ux + was_y * uy + was_z * uz
                    s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                    depth_left = -log(u)
                    continue

                # The next boundary comes first.
                step = gap / abs(uz)
                x += step * ux
                y += step * uy
                path += step * table[layer, 7]
                depth_left = max(0.0, depth_left - sigma_t * step)
                beyond = layer + 1 if uz > 0.0 else layer - 1
                z = bottom if uz > 0.0 else top
                eta = table[layer, 5]
                eta_beyond = table[beyond, 5]
                if eta != eta_beyond:
                    reflected, mu = fresnel(abs(uz), eta, eta_beyond)
                    s0, s1, s2, s3, u = draw_uniform(s0, s1, s2, s3)
                    if u <= reflected:
                        uz = -uz
                        direct = False
                        continue
                    ux *= eta / eta_beyond
                    uy *= eta / eta_beyond
                    uz = copysign(mu, uz)
                if beyond == 0:
                    sine2 = (1.0 - uz * uz) * eta_above * eta_above
                    if sine2 <= fiber_sine * fiber_sine:
                        share = 1.0
                        if direct:
                            g = table[from_layer, 4]
                            eta = table[from_layer, 5]
                            spread = 1.0 + g * g - 2.0 * g * turn
                            phase = (1.0 - g * g) / (4.0 * spread * sqrt(spread))
                            drawn = chance * eta * eta * abs(now_z) / (fiber_sine * fiber_sine)
                            share = phase / (drawn + phase)
                        value = share * weight * eta_above * eta_above / (fiber_sine * fiber_sine)
                        rho = sqrt(x * x + y * y)
                        _score_fibers(rho, value, path, rings, paths, tally, histogram)
                    break
                if beyond == last:
                    break
                layer = beyond
                top = table[layer, 0]
                bottom = table[layer, 1]
                sigma_t = table[layer, 2]
                g = table[layer, 4]

            if alive == 0:
                break
            alive -= 1
            row = waiting[alive]
            x, y, z = row[0], row[1], row[2]
            weight, path, layer = row[6], row[7], int(row[8])
            level = int(z * chances_per_mm)
            chance = chances[level] if level < levels else 0.0
            direct = True
            was_x, was_y, was_z = row[3], row[4], row[5]
            s0, s1, s2, s3, ux, uy, uz = scatter_direction(
                s0, s1, s2, s3, was_x, was_y, was_z, table[layer, 4]
            )
            from_layer, now_z = layer, uz
            turn = was_x * ux + was_y * uy + was_z * uz
