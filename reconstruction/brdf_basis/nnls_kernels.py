"""Non-negative least squares of many points at once, each with its own matrix from the tables.

Per point: the rows of its matrix from the tables, then rounds of two steps. A small working set of
columns is solved by Lawson and Hanson's active sets through its Gram matrix, and one pass over the
whole matrix finds the columns outside that would lower the misfit most. The full Gram matrix is
never formed. A point starts from its neighbour's columns, and a reweighting from its own.

References
----------
Lawson and Hanson 1974, Solving Least Squares Problems, chapter 23.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import boolean, float32, float64, int64, njit, prange, types, uint64

NODES_D, NODES_PHI, NODES_H = 32, 12, 90  # of model.brdf.tables; its tests hold them equal
MAX_ACTIVE_COLUMNS = 32
"""Most columns in a working set; when it is full, the unused ones leave it."""
MAX_JOINING_COLUMNS = 4
"""Most columns that join a working set at once."""
MISFIT_TOL = 4e-5
"""A column joins while it alone would lower the squared misfit by more than this squared."""
MIN_INDEPENDENT_FRACTION = 1e-7
"""A column whose part outside those in use is a smaller share of its square than this is refused:
the Gram matrix, summed in float32, knows no more."""
HUBER_SIGMAS = 3.0
"""Residuals beyond so many standard deviations pull with constant force."""

_HALF_PI = 0.5 * math.pi
_FAST_MATH = {"contract", "reassoc", "nsz"}


@njit(inline="always")
def _angle(c):  # type: ignore[no-untyped-def]
    """Return acos(c) / (pi/2) for c in [0, 1] within 2e-8 rad (Abramowitz and Stegun 4.4.46)."""
    p = -0.0012624911
    p = p * c + 0.0066700901
    p = p * c - 0.0170881256
    p = p * c + 0.0308918810
    p = p * c - 0.0501743046
    p = p * c + 0.0889789874
    p = p * c - 0.2145988016
    p = p * c + 1.5707963050
    return math.sqrt(max(1.0 - c, 0.0)) * p / _HALF_PI


@njit(nogil=True, fastmath={"contract", "reassoc", "nsz", "arcp", "nnan"})
def _places(light, view, normal, picked, count, cos_l, place):  # type: ignore[no-untyped-def]
    """Fill the cosine of the light and the place on the table's axes of the picked samples."""
    n0, n1, n2 = float64(normal[0]), float64(normal[1]), float64(normal[2])
    on_d, on_phi, on_h = place[0], place[1], place[2]
    for j in range(count):
        i = picked[j]
        l0, l1, l2 = float64(light[i, 0]), float64(light[i, 1]), float64(light[i, 2])
        v0, v1, v2 = float64(view[i, 0]), float64(view[i, 1]), float64(view[i, 2])
        cos_l[j] = l0 * n0 + l1 * n1 + l2 * n2
        on_d[j] = l0 * v0 + l1 * v1 + l2 * v2
        on_phi[j] = v0 * n0 + v1 * n1 + v2 * n2
    for j in range(count):  # apart from the first loop, this one runs in whole vectors
        mu_l, mu_v = cos_l[j], on_phi[j]
        between = max(min(on_d[j], 1.0), -1.0)
        cos_d = math.sqrt(0.5 * (1.0 + between))
        sin_d = math.sqrt(0.5 * (1.0 - between))
        cos_h = max(min((mu_l + mu_v) / max(2.0 * cos_d, 1e-9), 1.0), 0.0)
        sin_h = math.sqrt(1.0 - cos_h * cos_h)
        cos_phi = min(abs(mu_v - mu_l) / max(2.0 * sin_d * sin_h, 1e-9), 1.0)
        on_d[j] = _angle(min(cos_d, 1.0)) * (NODES_D - 1)
        on_phi[j] = _angle(cos_phi) * (NODES_PHI - 1)
        on_h[j] = math.sqrt(_angle(cos_h)) * (NODES_H - 1)


def _row_filler(fixed: int) -> Callable[..., Any]:
    """Return the kernel that fills a matrix; one of fixed width runs in unrolled vectors."""

    @njit(nogil=True, fastmath=_FAST_MATH)
    def fill(flat, cos_l, place, weight, count, rows, square):  # type: ignore[no-untyped-def]
        """Fill the matrix and the weighted squares of its columns."""
        lanes = uint64(fixed) if fixed > 0 else uint64(rows.shape[1])
        out = rows.reshape(-1)
        block = np.zeros(rows.shape[1], dtype=np.float32)
        square[:] = 0.0
        for i in range(count):
            d, h = place[0, i], place[2, i]
            i_d = min(int64(d), NODES_D - 2)
            i_phi = int64(place[1, i] + 0.5)
            i_h = min(int64(h), NODES_H - 2)
            d, h = d - i_d, h - i_h
            # Unsigned offsets into a flat table: no test for negative ones keeps the loop whole.
            a = uint64((i_d * NODES_PHI + i_phi) * NODES_H + i_h) * lanes
            b = a + uint64(NODES_H * NODES_PHI) * lanes
            w_a = float32(cos_l[i] * (1.0 - d) * (1.0 - h))
            w_b = float32(cos_l[i] * (1.0 - d) * h)
            w_e = float32(cos_l[i] * d * (1.0 - h))
            w_f = float32(cos_l[i] * d * h)
            w = weight[i]
            o = uint64(i) * lanes
            for k in range(lanes):
                element = (w_a * flat[a + k] + w_b * flat[a + lanes + k]) + (
                    w_e * flat[b + k] + w_f * flat[b + lanes + k]
                )
                out[o + k] = element
                block[k] += (w * element) * element
            if i % 64 == 63 or i == count - 1:
                for k in range(lanes):
                    square[k] += block[k]
                    block[k] = float32(0.0)

    return fill


_fill_64 = _row_filler(64)
_fill_16 = _row_filler(16)
_fill_any = _row_filler(0)


@njit(nogil=True, fastmath=_FAST_MATH)
def _pull(rows, force, count, total):  # type: ignore[no-untyped-def]
    """Fill the matrix' transpose times ``force``, in blocks of float32 added up in float64."""
    lanes = rows.shape[1]
    block = np.empty(lanes, dtype=np.float32)
    total[:] = 0.0
    for begin in range(0, count, 64):
        block[:] = float32(0.0)
        i = begin
        while i + 4 <= min(begin + 64, count):
            f0, f1, f2, f3 = force[i], force[i + 1], force[i + 2], force[i + 3]
            r0, r1, r2, r3 = rows[i], rows[i + 1], rows[i + 2], rows[i + 3]
            for k in range(lanes):
                block[k] += (f0 * r0[k] + f1 * r1[k]) + (f2 * r2[k] + f3 * r3[k])
            i += 4
        while i < min(begin + 64, count):
            f0, r0 = force[i], rows[i]
            for k in range(lanes):
                block[k] += f0 * r0[k]
            i += 1
        for k in range(lanes):
            total[k] += block[k]


@njit(nogil=True, fastmath=_FAST_MATH)
def _squares(rows, weight, count, total):  # type: ignore[no-untyped-def]
    """Fill the weighted square of each column."""
    lanes = rows.shape[1]
    block = np.empty(lanes, dtype=np.float32)
    total[:] = 0.0
    for begin in range(0, count, 64):
        block[:] = float32(0.0)
        for i in range(begin, min(begin + 64, count)):
            w, row = weight[i], rows[i]
            for k in range(lanes):
                block[k] += (w * row[k]) * row[k]
        for k in range(lanes):
            total[k] += block[k]


@njit(nogil=True, fastmath=_FAST_MATH)
def _dot(a, b, count):  # type: ignore[no-untyped-def]
    total = float32(0.0)
    for i in range(count):
        total += a[i] * b[i]
    return float64(total)


@njit(nogil=True, fastmath=_FAST_MATH)
def _gather(rows, root, material, count, column):  # type: ignore[no-untyped-def]
    """Copy a column of the matrix, times the roots of the weights."""
    for i in range(count):
        column[i] = root[i] * rows[i, material]


@njit(nogil=True)
def _join(begin, end, column, target, count, gram, rhs):  # type: ignore[no-untyped-def]
    """Fill the Gram matrix and the right-hand side of columns ``begin`` to ``end``."""
    for p in range(begin, end):
        for q in range(p + 1):
            gram[p, q] = gram[q, p] = _dot(column[p], column[q], count)
        rhs[p] = _dot(column[p], target, count)


@njit(nogil=True)
def _cholesky(gram, rhs, active, used, low, trial):  # type: ignore[no-untyped-def]
    """Solve for the active columns; return the place of the first dependent one, or -1."""
    for i in range(used):
        for j in range(i + 1):
            s = gram[active[i], active[j]]
            for k in range(j):
                s -= low[i, k] * low[j, k]
            if i == j:
                if s <= MIN_INDEPENDENT_FRACTION * gram[active[i], active[i]]:
                    return i
                low[i, i] = math.sqrt(s)
            else:
                low[i, j] = s / low[j, j]
    for i in range(used):
        s = rhs[active[i]]
        for k in range(i):
            s -= low[i, k] * trial[k]
        trial[i] = s / low[i, i]
    for i in range(used - 1, -1, -1):
        s = trial[i]
        for k in range(i + 1, used):
            s -= low[k, i] * trial[k]
        trial[i] = s / low[i, i]
    return -1


@njit(nogil=True)
def _small(gram, rhs, size, norm, x, active, low, trial, refused):  # type: ignore[no-untyped-def]
    """Minimize x' G x / 2 - rhs' x over x >= 0 by active sets, from the ``x`` given."""
    used = 0
    for p in range(size):
        refused[p] = False
        if x[p] > 0.0:
            active[used] = p
            used += 1
    entering = -1
    for _ in range(4 * size + 4):
        while used > 0:
            bad = _cholesky(gram, rhs, active, used, low, trial)
            first, reach = bad, 0.0
            if bad >= 0:
                refused[active[bad]] = True
            else:
                reach = 1.0
                for i in range(used):
                    if trial[i] <= 0.0:
                        now = x[active[i]]
                        part = now / (now - trial[i]) if now > 0.0 else 0.0
                        if first < 0 or part < reach:
                            first, reach = i, part
                for i in range(used):
                    p = active[i]
                    x[p] = max(x[p] + reach * (trial[i] - x[p]), 0.0)
                if first < 0:
                    if entering >= 0:  # it stays: those refused before may fit now
                        for p in range(size):
                            refused[p] = False
                    break
            gone = active[first]
            x[gone] = 0.0
            if gone == entering:
                refused[gone] = True  # it came in and went at once: not again
            used -= 1
            for i in range(first, used):
                active[i] = active[i + 1]
        best = MISFIT_TOL * norm
        entering = -1
        for p in range(size):
            if x[p] == 0.0 and gram[p, p] > 0.0 and not refused[p]:
                gain = rhs[p]
                for i in range(used):
                    gain -= gram[p, active[i]] * x[active[i]]
                gain /= math.sqrt(gram[p, p])
                if gain > best:
                    best, entering = gain, p
        if entering < 0:
            break
        active[used] = entering
        used += 1


@njit(nogil=True, fastmath=_FAST_MATH)
def _misfit(column, x, size, target, count, residual):  # type: ignore[no-untyped-def]
    """Fill target - columns x, return its norm."""
    for i in range(count):
        residual[i] = target[i]
    for p in range(size):
        if x[p] > 0.0:
            share, one = float32(x[p]), column[p]
            for i in range(count):
                residual[i] -= share * one[i]
    return math.sqrt(_dot(residual, residual, count))


@njit(nogil=True)
def _solve(  # type: ignore[no-untyped-def]
    rows,
    value,
    weight,
    count,
    materials,
    kinship,
    working,
    size,
    x,
    column,
    gram,
    rhs,
    low,
    active,
    trial,
    refused,
    square,
    pull,
    root,
    target,
    residual,
    force,
):
    """Solve one weighted problem from a working set; return the new set's size."""
    for i in range(count):
        root[i] = math.sqrt(weight[i])
        target[i] = root[i] * value[i]
    for p in range(size):
        _gather(rows, root, working[p], count, column[p])
    _join(0, size, column, target, count, gram, rhs)
    norm = math.sqrt(_dot(target, target, count))
    for step in range(materials + 2):
        # The first round's misfit is that of what the set explains at best
        _small(gram, rhs, size, 1e-3 * norm if step == 0 else norm, x, active, low, trial, refused)
        norm = _misfit(column, x, size, target, count, residual)
        for i in range(count):
            force[i] = root[i] * residual[i]
        _pull(rows, force, count, pull)
        for p in range(size):
            pull[working[p]] = 0.0
        if size + MAX_JOINING_COLUMNS > MAX_ACTIVE_COLUMNS:
            kept = 0
            for p in range(size):
                if x[p] > 0.0:
                    working[kept], x[kept] = working[p], x[p]
                    for q in range(count):
                        column[kept, q] = column[p, q]
                    kept += 1
            size = kept
            if size + MAX_JOINING_COLUMNS > MAX_ACTIVE_COLUMNS:
                break
            _join(0, size, column, target, count, gram, rhs)
        before = size
        for k in range(materials):
            pull[k] = pull[k] / math.sqrt(square[k]) if square[k] > 0.0 else 0.0
        for _ in range(MAX_JOINING_COLUMNS):
            best = MISFIT_TOL * norm
            joining = -1
            for k in range(materials):
                if pull[k] > best:
                    best, joining = pull[k], k
            if joining < 0:
                break
            for k in range(materials):  # a step along this column leaves about so much to others
                pull[k] -= kinship[joining, k] * best
            pull[joining] = 0.0
            working[size] = joining
            x[size] = 0.0
            _gather(rows, root, joining, count, column[size])
            size += 1
        if size == before:
            break
        _join(before, size, column, target, count, gram, rhs)
    return size


@njit(nogil=True)
def _reweigh(value, variance, model, count, weight, scatter):  # type: ignore[no-untyped-def]
    """Weigh samples by noise plus a misfit that is even in cube roots; return its new square.

    With u the model, a misfit tau of cube roots is 3 u^(2/3) tau of u, so the weight is
    1 / (var + 9 tau^2 u^(4/3)). tau^2 is what the residuals leave over the noise.
    """
    mean = 0.0
    for i in range(count):
        mean += model[i]
    mean /= count
    if mean < 1e-30:  # a model without light has no cube roots to weigh by
        return scatter
    floor = 0.02 * mean
    above = 0.0
    below = 0.0
    for i in range(count):
        u = max(float64(model[i]), floor)
        spread = 9.0 * u * u ** (1.0 / 3.0)
        total = float64(variance[i]) + scatter * spread
        share = spread / (total * total)
        r = float64(value[i]) - model[i]
        # An outlier tells nothing of the others' misfit.
        above += share * (min(r * r, HUBER_SIGMAS * HUBER_SIGMAS * total) - variance[i])
        below += share * spread
    scatter = max(above / below, 1e-8 * mean ** (2.0 / 3.0))
    for i in range(count):
        u = max(float64(model[i]), floor)
        total = float64(variance[i]) + scatter * 9.0 * u * u ** (1.0 / 3.0)
        z = abs(float64(value[i]) - model[i]) / math.sqrt(total)
        weight[i] = min(1.0, HUBER_SIGMAS / max(z, 1e-9)) / total
    return scatter


@njit(
    types.UniTuple(types.Array(float64, 1, "C"), 2)(
        types.Array(float32, 4, "C", readonly=True),
        int64,
        types.Array(float64, 2, "C", readonly=True),
        types.Array(float32, 2, "C", readonly=True),
        types.Array(float32, 2, "C", readonly=True),
        types.Array(float32, 3, "C", readonly=True),
        types.Array(float32, 3, "C", readonly=True),
        types.Array(float32, 2, "C", readonly=True),
        types.Array(boolean, 2, "C", readonly=True),
        int64,
        int64,
        types.Array(float64, 2, "C"),
    ),
    parallel=True,
    cache=True,
)
def fit_points(  # type: ignore[no-untyped-def]
    table,
    materials,
    kinship,
    value,
    variance,
    light,
    view,
    normal,
    valid,
    reweightings,
    block,
    weights,
):
    """Fit every point; fill ``weights`` (P, K), return weighted RMS residuals and standard errors.

    ``reweightings`` 0: weights from the variances alone (1 where a point has none); otherwise so
    many passes weigh by noise and by cube roots. ``block`` points share their working memory, and
    start from each other's columns. The standard error is that of the lobe's scale, as a fraction
    of it.
    """
    points, samples = value.shape
    lanes = table.shape[3]
    flat = table.reshape(-1)
    rms = np.full(points, np.nan)
    stderr = np.full(points, np.nan)
    for chunk in prange((points + block - 1) // block):
        rows = np.empty((samples, lanes), dtype=np.float32)  # the matrix
        cos_l = np.empty(samples)  # of the light
        picked = np.empty(samples, dtype=np.int64)  # the valid samples
        place = np.empty((3, samples))  # on the table's axes
        y = np.empty(samples, dtype=np.float32)
        var = np.empty(samples, dtype=np.float32)
        weight = np.empty(samples, dtype=np.float32)
        root = np.empty(samples, dtype=np.float32)  # of the weights
        target = np.empty(samples, dtype=np.float32)  # root x y
        residual = np.empty(samples, dtype=np.float32)  # root x (y - model)
        force = np.empty(samples, dtype=np.float32)  # weight x (y - model)
        model = np.empty(samples, dtype=np.float32)
        column = np.empty(
            (MAX_ACTIVE_COLUMNS, samples), dtype=np.float32
        )  # of the working set, x root
        working = np.empty(MAX_ACTIVE_COLUMNS, dtype=np.int64)  # its materials
        active = np.empty(MAX_ACTIVE_COLUMNS + 1, dtype=np.int64)  # those of them in use
        refused = np.empty(MAX_ACTIVE_COLUMNS, dtype=np.bool_)
        gram = np.empty((MAX_ACTIVE_COLUMNS, MAX_ACTIVE_COLUMNS))
        low = np.empty((MAX_ACTIVE_COLUMNS + 1, MAX_ACTIVE_COLUMNS + 1))
        rhs = np.empty(MAX_ACTIVE_COLUMNS)
        x = np.zeros(MAX_ACTIVE_COLUMNS)
        trial = np.empty(MAX_ACTIVE_COLUMNS + 1)
        square = np.empty(lanes)
        pull = np.empty(lanes)
        size = 0
        for point in range(chunk * block, min((chunk + 1) * block, points)):
            count = 0
            known = True
            top = 0.0
            for i in range(samples):
                if valid[point, i]:
                    y[count] = value[point, i]
                    var[count] = variance[point, i]
                    known &= var[count] > 0.0
                    picked[count] = i
                    top += float64(y[count]) * y[count]
                    count += 1
            weights[point, :] = 0.0
            if count == 0:
                continue
            top /= count
            # The first pass of several: noise, and an even misfit of 3 % of the RMS
            for i in range(count):
                if reweightings > 0:
                    weight[i] = 1.0 / (var[i] + 1e-3 * top + 1e-30)
                else:
                    weight[i] = 1.0 / var[i] if known else 1.0
            _places(light[point], view[point], normal[point], picked, count, cos_l, place)
            if lanes == 64:
                _fill_64(flat, cos_l, place, weight, count, rows, square)
            elif lanes == 16:
                _fill_16(flat, cos_l, place, weight, count, rows, square)
            else:
                _fill_any(flat, cos_l, place, weight, count, rows, square)
            kept = 0
            for p in range(size):  # the neighbour's columns in use
                if x[p] > 0.0:
                    working[kept] = working[p]
                    kept += 1
            size = kept
            x[:] = 0.0
            size = _solve(
                rows,
                y,
                weight,
                count,
                materials,
                kinship,
                working,
                size,
                x,
                column,
                gram,
                rhs,
                low,
                active,
                trial,
                refused,
                square,
                pull,
                root,
                target,
                residual,
                force,
            )
            scatter = 1e-3 * top / (9.0 * max(top, 1e-60) ** (2.0 / 3.0))
            for _ in range(reweightings):
                for i in range(count):
                    model[i] = y[i] - residual[i] / root[i]
                scatter = _reweigh(y, var, model, count, weight, scatter)
                _squares(rows, weight, count, square)
                size = _solve(
                    rows,
                    y,
                    weight,
                    count,
                    materials,
                    kinship,
                    working,
                    size,
                    x,
                    column,
                    gram,
                    rhs,
                    low,
                    active,
                    trial,
                    refused,
                    square,
                    pull,
                    root,
                    target,
                    residual,
                    force,
                )
            misfit = 0.0
            total = 0.0
            power = 0.0
            for i in range(count):
                explained = float64(target[i]) - residual[i]
                misfit += float64(residual[i]) * residual[i]
                power += explained * explained
                total += weight[i]
            for p in range(size):
                weights[point, working[p]] = x[p]
            rms[point] = math.sqrt(misfit / total)
            if power > 0.0:
                noise = 1.0 if known or reweightings > 0 else misfit / count
                stderr[point] = math.sqrt(noise / power)
    return rms, stderr
