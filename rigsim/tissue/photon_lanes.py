"""Trace the walk of `rigsim.tissue.tissue_mc` for many photons in parallel with Dr.Jit.

Each lane of the processor's vectors traces photons one after another, so that no lane waits for the
longest walk of its neighbors. Directions and positions are float32, relative to the top of the
photon's layer, so that thin and deep layers keep their digits; sums are float64.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rigsim.arrays import Float32Array, Float64Array, UInt32Array
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import choose_variant
from rigsim.tissue.photon_walk import ROULETTE_MAX_WEIGHT, ROULETTE_SURVIVAL, TALLY_COUNT

PHOTONS_PER_LANE: Final = (32, 256)
"""Range of photons per lane: with more, lanes idle less at the end."""

PHOTONS_PER_CALL: Final = 1 << 22
"""Photons whose exits are stored at once, 8 bytes each, in whole batches."""

MIN_LANES: Final = 1 << 16
"""Lanes that keep the threads busy; Dr.Jit gives 16,384 of them to each."""

INFINITE_MM: Final = 1e30
"""Replaces an infinite thickness or free path in float32."""

MAX_ISOTROPIC_G: Final = 1e-4  # |g| below which the phase function is constant in float32

_UNIFORM_STEP: Final = 2.0**-23


@dataclass(frozen=True, slots=True)
class LaneTallies:
    """Sums over the photons of each batch, as in `rigsim.tissue.photon_walk.walk`."""

    tally: Float64Array
    """Shape (batches, TALLIES + layers + rings)."""
    photons: int
    """Photons in each batch."""


def is_usable() -> bool:
    """Return whether Dr.Jit can compile for this processor (see `rigsim.mitsuba.variant`)."""
    return choose_variant("mono").is_vectorized


def walk_lanes(
    table: Float64Array, ring_edges2: Float64Array, photons: int, seed: NDArray[np.uint64]
) -> LaneTallies:
    """Trace photons that enter at the origin along +z.

    Parameters
    ----------
    table
        As `rigsim.tissue.photon_walk.walk` takes it.
    ring_edges2
        Squares of the radii of the scoring rings in mm^2, shape (rings + 1,).
    photons
        Photons in each batch, rounded up to whole lanes.
    seed
        Seeds of the batches, shape (batches, words).

    Returns
    -------
    LaneTallies
    """
    together = max(PHOTONS_PER_CALL // photons, 1)
    runs = [
        _trace_batches(table, ring_edges2, photons, seed[at : at + together], len(seed))
        for at in range(0, len(seed), together)
    ]
    return LaneTallies(np.concatenate([run.tally for run in runs]), runs[0].photons)


def _trace_batches(
    table: Float64Array, ring_edges2: Float64Array, photons: int, seed: NDArray[np.uint64], of: int
) -> LaneTallies:
    """Trace some of the batches; lanes are allocated by the total number of batches."""
    import drjit as dr

    load_mitsuba(choose_variant("mono"))
    batches = len(seed)
    per_lane = min(max(photons * of // MIN_LANES, PHOTONS_PER_LANE[0]), PHOTONS_PER_LANE[1])
    per_lane = min(per_lane, photons)
    lanes = -(-photons // per_lane)
    n_layers = len(table) - 2
    words = np.stack(
        [np.random.Generator(np.random.PCG64(row)).integers(1, 2**32, (4, lanes)) for row in seed],
        axis=1,
    ).reshape(4, batches * lanes)
    weight, r2, absorbed, roulette = _run(dr, table, words.astype(np.uint32), per_lane)
    weight = weight.reshape(batches, -1).astype(np.float64)
    r2 = r2.reshape(batches, -1)
    tally = np.zeros((batches, TALLY_COUNT + n_layers + len(ring_edges2) - 1))
    below = r2 < 0.0
    straight = weight < 0.0
    tally[:, 0] = np.where(below | straight, 0.0, weight).sum(axis=1)
    tally[:, 1] = np.where(straight & ~below, -weight, 0.0).sum(axis=1)
    tally[:, 2] = np.where(below & ~straight, weight, 0.0).sum(axis=1)
    tally[:, 3] = np.where(below & straight, -weight, 0.0).sum(axis=1)
    tally[:, 4] = roulette.reshape(batches, -1).sum(axis=1)
    for layer, part in enumerate(absorbed):
        tally[:, TALLY_COUNT + layer] = part.reshape(batches, -1).sum(axis=1)
    for batch in range(batches):
        up = (weight[batch] > 0.0) & ~below[batch]
        rings = np.histogram(
            r2[batch, up].astype(np.float64),
            np.minimum(ring_edges2, np.finfo(np.float64).max),
            weights=weight[batch, up],
        )[0]
        tally[batch, TALLY_COUNT + n_layers :] = rings
    return LaneTallies(tally, per_lane * lanes)


def _run(
    dr: Any, table: Float64Array, words: UInt32Array, per_lane: int
) -> tuple[Float32Array, Float32Array, list[Float64Array], Float64Array]:
    """Return each photon's exit weight (negative: never scattered) and r^2 (negative: below)."""
    from drjit.llvm import Bool, Float, Float64, UInt32

    lanes = words.shape[1]
    n_layers = len(table) - 2
    thickness = np.full(len(table), INFINITE_MM)
    finite = np.isfinite(table[:, :2]).all(axis=1)
    thickness[finite] = np.diff(table[finite, :2])[:, 0]
    free = 1.0 / np.maximum(table[:, 2], 1.0 / INFINITE_MM)
    half_by_g = 0.5 / np.where(np.abs(table[:, 4]) < MAX_ISOTROPIC_G, 1.0, table[:, 4])
    columns = [thickness, free, table[:, 3], table[:, 4], table[:, 5], half_by_g]
    single = n_layers == 1
    stored = [Float(column.astype(np.float32)) for column in columns]
    only = [dr.opaque(Float, float(column[1])) for column in columns]
    above, below = (dr.opaque(Float, float(table[k, 5])) for k in (0, -1))
    eta_1 = float(table[1, 5])
    start = dr.opaque(Float, 1.0 - ((eta_1 - table[0, 5]) / (eta_1 + table[0, 5])) ** 2)
    out_weight = dr.zeros(Float, lanes * per_lane)
    out_r2 = dr.zeros(Float, lanes * per_lane)
    dr.eval(out_weight, out_r2)
    end = (dr.arange(UInt32, lanes) + 1) * per_lane

    def draw(s: list[Any]) -> Any:
        """Step xoshiro128+ (Blackman, Vigna 2021, doi:10.1145/3460772); uniform in (0, 1)."""
        word = s[0] + s[3]
        t = s[1] << 9
        s[2] = s[2] ^ s[0]
        s[3] = s[3] ^ s[1]
        s[1] = s[1] ^ s[2]
        s[0] = s[0] ^ s[3]
        s[2] = s[2] ^ t
        s[3] = (s[3] << 11) | (s[3] >> 21)
        return dr.fma(Float(word >> 9), _UNIFORM_STEP, 0.5 * _UNIFORM_STEP)

    def body(*state: Any) -> tuple[Any, ...]:
        """Advance every lane by one step, and start its next photon where one ends."""
        *s, x, y, z, ux, uy, uz, weight, layer, scattered, at, lost = state[:15]
        absorbed = state[15:]
        if single:
            thick, free_mm, albedo, g, eta, half_by_g = only
        else:
            thick, free_mm, albedo, g, eta, half_by_g = (dr.gather(Float, c, layer) for c in stored)
        down = uz > 0.0
        gap = dr.select(down, thick - z, z)
        to_boundary = gap / dr.maximum(dr.abs(uz), 1e-12)
        step = -dr.log(draw(s)) * free_mm
        collides = step < to_boundary
        step = dr.minimum(step, to_boundary)
        x = dr.fma(step, ux, x)
        y = dr.fma(step, uy, y)
        chance = draw(s)

        # A collision: absorption, roulette, a new direction.
        kept = weight * albedo
        taken = weight - kept
        absorbed = tuple(
            part + Float64(dr.select(collides & (layer == k + 1), taken, 0.0))
            for k, part in enumerate(absorbed)
        )
        plays = kept < ROULETTE_MAX_WEIGHT
        dies = collides & plays & (chance > ROULETTE_SURVIVAL)
        after = dr.select(plays, dr.select(dies, 0.0, kept * (1.0 / ROULETTE_SURVIVAL)), kept)
        lost += Float64(dr.select(collides, kept - after, 0.0))
        u = draw(s)
        small = dr.abs(g) < MAX_ISOTROPIC_G
        part = (1.0 - g * g) / (1.0 - g + 2.0 * g * u)
        cosine = dr.select(small, 2.0 * u - 1.0, (1.0 + g * g - part * part) * half_by_g)
        cosine = dr.clip(cosine, -1.0, 1.0)
        sine = dr.sqrt(dr.maximum(1.0 - cosine * cosine, 0.0))
        sin_phi, cos_phi = dr.sincos((2.0 * dr.pi) * draw(s))
        # An orthonormal frame without a singularity (Duff et al. 2017, JCGT 6(1)).
        sign = dr.select(uz >= 0.0, Float(1.0), Float(-1.0))
        a = -1.0 / (sign + uz)
        b = ux * uy * a
        p, q = sine * cos_phi, sine * sin_phi
        tx = p * dr.fma(sign * a, ux * ux, 1.0) + q * b + cosine * ux
        ty = p * sign * b + q * dr.fma(a, uy * uy, sign) + cosine * uy
        tz = cosine * uz - p * sign * ux - q * uy
        length = dr.rsqrt(tx * tx + ty * ty + tz * tz)

        # A boundary: reflection or refraction, into the next layer or out.
        beyond = dr.select(down, layer + 1, layer - 1)
        if single:
            eta_beyond = dr.select(down, below, above)
        else:
            eta_beyond = dr.gather(Float, stored[4], beyond)
        ratio = eta / eta_beyond
        cos_i = dr.abs(uz)
        sin2_t = ratio * ratio * (1.0 - cos_i * cos_i)
        cos_t = dr.sqrt(dr.maximum(1.0 - sin2_t, 0.0))
        # R = ((s-/s+)^2 + (p-/p+)^2) / 2, compared without its divisions.
        s_minus, s_plus = eta * cos_i - eta_beyond * cos_t, eta * cos_i + eta_beyond * cos_t
        p_minus, p_plus = eta_beyond * cos_i - eta * cos_t, eta_beyond * cos_i + eta * cos_t
        mixed, other = s_minus * p_plus, p_minus * s_plus
        whole = s_plus * p_plus
        reflects = 2.0 * chance * whole * whole <= mixed * mixed + other * other
        matched = eta == eta_beyond
        mirrored = ~matched & (reflects | (sin2_t >= 1.0))
        crosses = ~collides & ~mirrored
        leaves = crosses & ((beyond == 0) | (beyond == n_layers + 1))

        # Rare in a vector of lanes, so that the branch saves time.
        index = at

        def leave(w: Any, r2: Any) -> Any:
            dr.scatter(out_weight, w, index, leaves)
            dr.scatter(out_r2, r2, index, leaves)
            return UInt32(0)

        dr.if_stmt(
            (dr.select(scattered, weight, -weight), dr.select(beyond == 0, x * x + y * y, -1.0)),
            leaves,
            leave,
            lambda w, r2: UInt32(0),
            mode="symbolic",
        )

        ends = leaves | dies
        bent = dr.select(matched, uz, dr.copysign(cos_t, uz))
        scale = dr.select(crosses & ~matched, ratio, 1.0)
        ux = dr.select(collides, tx * length, ux * scale)
        uy = dr.select(collides, ty * length, uy * scale)
        uz_new = dr.select(mirrored, -uz, bent)
        uz_new = dr.select(collides, tz * length, uz_new)
        if single:
            z_boundary = dr.select(down, thick, 0.0)
            z = dr.select(collides, dr.fma(step, uz, z), z_boundary)
        else:
            entered = dr.gather(Float, stored[0], beyond)
            z_boundary = dr.select(
                crosses, dr.select(down, 0.0, entered), dr.select(down, thick, 0.0)
            )
            z = dr.select(collides, dr.fma(step, uz, z), z_boundary)
            layer = dr.select(crosses, beyond, layer)
        uz = uz_new
        weight = dr.select(collides, after, weight)
        scattered |= collides

        # The next photon of the lane.
        x, y, z, ux, uy = (dr.select(ends, 0.0, part) for part in (x, y, z, ux, uy))
        uz = dr.select(ends, 1.0, uz)
        weight = dr.select(ends, start, weight)
        layer = dr.select(ends, UInt32(1), layer)
        scattered &= ~ends
        at = dr.select(ends, at + 1, at)
        return (*s, x, y, z, ux, uy, uz, weight, layer, scattered, at, lost, *absorbed)

    zero = dr.zeros(Float, lanes)
    state = (
        *(UInt32(word) for word in words),
        *(Float(zero) for _ in range(5)),
        dr.full(Float, 1.0, lanes),
        Float(zero) + start,
        dr.full(UInt32, 1, lanes),
        dr.full(Bool, False, lanes),
        end - per_lane,
        dr.zeros(Float64, lanes),
        *(dr.zeros(Float64, lanes) for _ in range(n_layers)),
    )
    done = dr.while_loop(state, lambda *v: v[13] < end, body, mode="symbolic", label="photons")
    lost, absorbed = done[14], list(done[15:])
    dr.eval(lost, absorbed, out_weight, out_r2)
    return (out_weight.numpy(), out_r2.numpy(), [part.numpy() for part in absorbed], lost.numpy())
