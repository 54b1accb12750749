"""Solve non-negative least squares of many points, each with its own matrix from the tables.

Per point: the rows of its matrix from the tables, then rounds of two steps. Lawson and Hanson's
active sets solve for a small working set of columns through its Gram matrix, and one pass over the
whole matrix finds the columns outside that would lower the misfit most. The full Gram matrix is
never formed. Each point starts from its neighbor's columns, each reweighting from its own.

References
----------
Lawson and Hanson 1974, Solving Least Squares Problems, chapter 23.
"""

import math

import numpy as np
from numba import boolean, float32, float64, int64, njit, types, void

from reconstruction.brdf_basis.row_kernels import (
    FAST_MATH,
    dot,
    fill_16,
    fill_64,
    fill_any,
    find_nodes,
    gather_column,
    multiply_transpose,
    weighted_column_norms,
)

MAX_ACTIVE_COLUMNS = 32
"""Size of a working set; when it is full, unused columns leave it."""
MAX_JOINING_COLUMNS = 4
"""Largest number of columns that join a working set at once."""
MISFIT_TOL = 4e-5
"""Root of the relative decrease of the squared misfit from which a column joins."""
MIN_INDEPENDENT_FRACTION = 1e-7
"""Fraction of a column's square outside those in use, below which it is refused: the Gram matrix,
summed in float32, does not resolve less."""
HUBER_SIGMAS = 3.0
"""Standard deviations beyond which the weight of a residual falls as its inverse."""


@njit(nogil=True)
def _extend_normal_equations(begin, end, column, target, count, gram, rhs):  # type: ignore[no-untyped-def]
    """Fill the Gram matrix and the right-hand side of columns ``begin`` to ``end``."""
    for p in range(begin, end):
        for q in range(p + 1):
            gram[p, q] = gram[q, p] = dot(column[p], column[q], count)
        rhs[p] = dot(column[p], target, count)


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
def _minimize_active_set(gram, rhs, size, norm, x, active, low, trial, refused):  # type: ignore[no-untyped-def]
    """Minimize x' G x / 2 - rhs' x over x >= 0 by active sets from ``x``; return if it ended."""
    used = int64(0)
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
                    if entering >= 0:  # it stays; columns refused before may fit now
                        for p in range(size):
                            refused[p] = False
                    break
            gone = active[first]
            x[gone] = 0.0
            if gone == entering:
                refused[gone] = True  # it left at once: refused
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
            return True
        active[used] = entering
        used += 1
    return False


@njit(fastmath=FAST_MATH, forceinline=True)
def _misfit(column, x, size, target, count, residual):  # type: ignore[no-untyped-def]
    """Fill target - columns x, return its norm."""
    for i in range(count):
        residual[i] = target[i]
    for p in range(size):
        if x[p] > 0.0:
            share, one = float32(x[p]), column[p]
            for i in range(count):
                residual[i] -= share * one[i]
    return math.sqrt(dot(residual, residual, count))


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
    """Solve one weighted problem from a working set; return the new size, and False at a limit."""
    ended = False
    for i in range(count):
        root[i] = math.sqrt(weight[i])
        target[i] = root[i] * value[i]
    for p in range(size):
        gather_column(rows, root, working[p], count, column[p])
    _extend_normal_equations(0, size, column, target, count, gram, rhs)
    norm = math.sqrt(dot(target, target, count))
    for step in range(materials + 2):
        # The first round's tolerance is coarse, as its misfit is that of the starting set
        minimized = _minimize_active_set(
            gram, rhs, size, 1e-3 * norm if step == 0 else norm, x, active, low, trial, refused
        )
        norm = _misfit(column, x, size, target, count, residual)
        for i in range(count):
            force[i] = root[i] * residual[i]
        multiply_transpose(rows, force, count, pull)
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
            _extend_normal_equations(0, size, column, target, count, gram, rhs)
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
            for k in range(materials):  # a step along it lowers others' pull
                pull[k] -= kinship[joining, k] * best
            pull[joining] = 0.0
            working[size] = joining
            x[size] = 0.0
            gather_column(rows, root, joining, count, column[size])
            size += 1
        if size == before:
            ended = minimized
            break
        _extend_normal_equations(before, size, column, target, count, gram, rhs)
    return size, ended


@njit(nogil=True)
def _update_weights(value, variance, model, count, weight, scatter):  # type: ignore[no-untyped-def]
    """Weight samples by noise plus a misfit uniform in cube roots; return its updated square.

    With u the model, a misfit tau of cube roots is 3 u^(2/3) tau of u, so the weight is
    1 / (var + 9 tau^2 u^(4/3)). tau^2 is the excess of the squared residuals over the noise.
    """
    mean = 0.0
    for i in range(count):
        mean += model[i]
    mean /= count
    if mean < 1e-30:  # the cube roots of a zero model are 0
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
        # An outlier does not inform the others' misfit: clip it
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
    void(
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
        types.Array(float64, 1, "C"),
        types.Array(float64, 1, "C"),
        types.Array(boolean, 1, "C"),
        int64,
        int64,
    ),
    cache=True,
    nogil=True,
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
    rms,
    stderr,
    ended,
    first,
    last,
):
    """Fit points; fill ``weights`` (P, K), weighted RMS residuals and standard errors (P,).

    ``ended`` (P,): False where the last search ended at a limit of steps or columns.
    ``reweightings`` 0: weights from the variances alone (1 where a point has none); otherwise so
    many passes weight by noise and by cube roots. ``block`` points share their working memory, and
    start from each other's columns. The standard error is that of the lobe's scale, as a fraction
    of it. ``first`` and ``last`` are a range of points, of whole blocks.
    """
    samples = value.shape[1]
    lanes = table.shape[3]
    flat = table.reshape(-1)
    for begin in range(first, last, block):
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
        size = int64(0)  # a literal would be a type of its own, and compile `_solve` again
        for point in range(begin, min(begin + block, last)):
            count = int64(0)
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
            rms[point] = stderr[point] = np.nan
            ended[point] = True
            if count == 0:
                continue
            top /= count
            # The first pass of several: noise, and an even misfit of 3 % of the RMS
            for i in range(count):
                if reweightings > 0:
                    weight[i] = 1.0 / (var[i] + 1e-3 * top + 1e-30)
                else:
                    weight[i] = 1.0 / var[i] if known else 1.0
            find_nodes(light[point], view[point], normal[point], picked, count, cos_l, place)
            if lanes == 64:
                fill_64(flat, cos_l, place, weight, count, rows, square)
            elif lanes == 16:
                fill_16(flat, cos_l, place, weight, count, rows, square)
            else:
                fill_any(flat, cos_l, place, weight, count, rows, square)
            kept = int64(0)
            for p in range(size):  # the neighbor's columns in use
                if x[p] > 0.0:
                    working[kept] = working[p]
                    kept += 1
            size = kept
            x[:] = 0.0
            size, ended[point] = _solve(
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
                scatter = _update_weights(y, var, model, count, weight, scatter)
                weighted_column_norms(rows, weight, count, square)
                size, ended[point] = _solve(
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
