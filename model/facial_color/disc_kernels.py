"""Inner loops of disc statistics: a square, two caps by row sums, two lobes by column sums."""

# mypy: allow-untyped-defs

import numpy as np
from numba import njit

from model.facial_color.row_kernels import disc_row, square_row


@njit(cache=True, nogil=True, error_model="numpy")
def _counts(image, y, x):
    """Return whether a pixel counts."""
    h, valid, masked = image
    return np.isfinite(h[y, x]) and (not masked or valid[y, x] != 0)


@njit(error_model="numpy", fastmath={"reassoc"}, forceinline=True)
def _sum_about(row, about):
    """Return the sum of the differences from a value."""
    total = 0.0
    for i in range(row.size):
        total += np.float64(row[i]) - about
    return total


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _powers(out, row, about, moment):
    """Write differences from a value, or their squares."""
    if moment == 0:
        for i in range(row.size):
            out[i] = np.float64(row[i]) - about
    else:
        for i in range(row.size):
            d = np.float64(row[i]) - about
            out[i] = d * d


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _add_down(running, new, out):
    """Advance column sums by one row."""
    for i in range(new.size):
        running[i] += new[i]
        out[i] = running[i]


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _sum_rows(v, n, r0, r1, r2, r3):
    """Write the sums along four rows, before each entry and after the last; return the largest."""
    v0, v1, v2, v3 = v[0], v[1], v[2], v[3]
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        r0[i], r1[i], r2[i], r3[i] = s0, s1, s2, s3
        s0 += v0[i]
        s1 += v1[i]
        s2 += v2[i]
        s3 += v3[i]
    for i in range(n, r0.size):
        r0[i], r1[i], r2[i], r3[i] = s0, s1, s2, s3
    return max(max(s0, s1), max(s2, s3))


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _finish(s1, s2, whole, about, rounding, mean, deviation):
    """Write mean and deviation of a row of whole discs; return how many need a second pass."""
    trusted, blur1, blur2, unit = rounding
    doubtful = 0
    per = 1.0 / whole
    for i in range(mean.size):
        m = np.float64(s1[i]) * per
        squares = np.float64(s2[i]) * per
        v = squares - m * m
        doubt = blur2 + 2.0 * abs(m) * blur1 + 4.0 * unit * whole * squares
        doubtful += whole * v * trusted < doubt
        mean[i] = about + m
        deviation[i] = np.sqrt(v if v > 0.0 else 0.0)
    return doubtful


@njit(error_model="numpy", fastmath={"reassoc"}, forceinline=True)
def _moments_of(row, about):
    """Return number, sum and sum of squares about a value of the finite entries."""
    n, s1, s2 = 0, 0.0, 0.0
    for i in range(row.size):
        d = np.float64(row[i]) - about
        finite = np.isfinite(d)
        d = d if finite else 0.0
        n += 1 if finite else 0
        s1 += d
        s2 += d * d
    return n, s1, s2


@njit(error_model="numpy", fastmath={"reassoc"}, forceinline=True)
def _valid_moments_of(row, valid, about):
    """Return `_moments_of` over the valid entries."""
    n, s1, s2 = 0, 0.0, 0.0
    for i in range(row.size):
        d = np.float64(row[i]) - about
        held = np.isfinite(d) & (valid[i] != 0)
        d = d if held else 0.0
        n += 1 if held else 0
        s1 += d
        s2 += d * d
    return n, s1, s2


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_disc(image, half, y, x):
    """Return mean and variance of one disc by summing its pixels relative to one of them."""
    h, valid, masked = image
    rows, columns = h.shape
    reach = half.size - 1
    n, s1, s2, about = 0, 0.0, 0.0, 0.0
    for k in range(max(0, y - reach), min(rows, y + reach + 1)):
        w = half[abs(k - y)]
        low, end = max(0, x - w), min(columns, x + w + 1)
        if n == 0:
            while low < end and not _counts(image, k, low):
                low += 1
            if low == end:
                continue
            about = np.float64(h[k, low])
        if masked:
            row_n, row_1, row_2 = _valid_moments_of(h[k, low:end], valid[k, low:end], about)
        else:
            row_n, row_1, row_2 = _moments_of(h[k, low:end], about)
        n += row_n
        s1 += row_1
        s2 += row_2
    m = s1 / n
    return about + m, max(s2 / n - m * m, 0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _is_constant_step(image, half, y, x, level):
    """Return whether all pixels that a disc gains by a step to column `x` have one value."""
    h = image[0]
    rows, columns = h.shape
    reach = half.size - 1
    for k in range(max(0, y - reach), min(rows, y + reach + 1)):
        c = x + half[abs(k - y)]
        if c < columns and h[k, c] != level and _counts(image, k, c):
            return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _tile(image, disc, trusted, box, room, found):
    """Compute `disc_moments` for one tile.

    Parameters
    ----------
    image
        `h`, `valid` and `masked`.
    disc
        `half`, `high`, `inner`, and the pixels of a disc.
    trusted : float
    box
        Rows y0 to y1 and columns x0 to x1.
    room
        p, q: (K, L), (K + 1, L) in the type of `h`, for sums along rows and down columns; entry j
        is column x0 - width + j. nothing: (L,), 0. Then for the sums of a tile, four rows, sums
        down columns, and over squares.
    found
        `mean`, `deviation` and `count`, written.
    """
    h, _, masked = image
    half, high, inner, whole = disc
    y0, y1, x0, x1 = box
    p, q, nothing, sums, v, down, squares_of = room
    mean, deviation, count = found
    rows, columns = h.shape
    reach, width = half.size - 1, half[0]
    k0, k1 = max(0, y0 - reach), min(rows, y1 + reach)
    c0, c1 = max(0, x0 - width), min(columns, x1 + width)
    n, seeable = x1 - x0, (k1 - k0) * (c1 - c0)
    first = np.float64(h[k0, c0])
    seen, total = 0, 0.0
    if not masked:
        for k in range(k0, k1):
            total += _sum_about(h[k, c0:c1], first)
        seen = seeable
    every = not masked and np.isfinite(total)
    if not every:
        seen, total = 0, 0.0
        for k in range(k0, k1):
            for c in range(c0, c1):
                if _counts(image, k, c):
                    if seen == 0:
                        first = np.float64(h[k, c])
                    seen += 1
                    total += np.float64(h[k, c]) - first
        every = seen == seeable
    if seen == 0:
        mean[y0:y1, x0:x1] = np.nan
        deviation[y0:y1, x0:x1] = np.nan
        count[y0:y1, x0:x1] = 0
        return
    about = first + total / seen
    partial = seen < (y1 - y0 + 2 * reach) * (n + 2 * width)
    skip = c0 - (x0 - width)
    moments = 3 if partial else 2
    high_rows = k1 - k0
    wide = c1 - c0
    running, square = down[: c1 - c0], squares_of[:n]
    q[0] = 0.0
    p[:, :skip] = 0.0
    q[:, :skip] = 0.0
    q[:, skip + c1 - c0 :] = 0.0
    largest = 0.0
    for moment in range(moments):
        running[:] = 0.0
        for k in range(0, high_rows, 4):
            for b in range(4):
                if k + b >= high_rows:
                    v[b, :wide] = 0.0
                    continue
                if every and moment < 2:
                    _powers(v[b, :wide], h[k0 + k + b, c0:c1], about, moment)
                elif every:
                    v[b, :wide] = 1.0
                else:
                    for c in range(c0, c1):
                        value = 0.0
                        if _counts(image, k0 + k + b, c):
                            d = np.float64(h[k0 + k + b, c]) - about
                            value = d if moment == 0 else (d * d if moment == 1 else 1.0)
                        v[b, c - c0] = value
                _add_down(running, v[b, :wide], q[k + b + 1, skip:])
            most = _sum_rows(
                v, wide, p[k, skip:], p[k + 1, skip:], p[k + 2, skip:], p[k + 3, skip:]
            )
            if moment == 1:
                largest = max(largest, most)
        if moment == 1:
            for value in running:
                largest = max(largest, value)
        for y in range(y0 - k0, y1 - k0):
            square_row(square, p, nothing, inner, width, high_rows, y, y == y0 - k0)
            disc_row(sums[moment, y + k0 - y0, :n], square, p, q, half, high, inner, high_rows, y)
    # bound of the rounding of the stored sums in a disc's sum of squares and sum
    unit = np.finfo(h.dtype).eps
    chain = 0.5 * unit * np.sqrt(4.0 * (reach + width))
    blur2 = chain * largest
    blur1 = chain * np.sqrt(max(p.shape[1], high_rows) * largest)
    for y in range(y0, y1):
        s1, s2 = sums[0, y - y0, :n], sums[1, y - y0, :n]
        if not partial:
            count[y, x0:x1] = whole
            rounding = (trusted, blur1, blur2, unit)
            row = (mean[y, x0:x1], deviation[y, x0:x1])
            if _finish(s1, s2, np.float64(whole), about, rounding, *row) == 0:
                continue
        constant, level = False, np.float64(0.0)  # whether the disc to the left is, and its value
        for i in range(n):
            held = np.int64(sums[moments - 1, y - y0, i]) if partial else whole
            count[y, x0 + i] = held
            if held == 0:
                mean[y, x0 + i] = np.nan
                deviation[y, x0 + i] = np.nan
                constant = False
                continue
            m = np.float64(s1[i]) / held
            squares = np.float64(s2[i]) / held
            variance = squares - m * m
            doubt = blur2 + 2.0 * abs(m) * blur1 + 4.0 * unit * held * squares
            mean[y, x0 + i] = about + m
            if held * variance * trusted >= doubt:
                constant = False
            elif constant and _is_constant_step(image, half, y, x0 + i, level):
                mean[y, x0 + i] = level
                variance = np.float64(0.0)
            else:
                level, variance = _sum_disc(image, half, y, x0 + i)
                mean[y, x0 + i] = level
                constant = variance == 0.0
            deviation[y, x0 + i] = np.sqrt(max(variance, 0.0))


def count_tiles(rows: int, columns: int, tall: int, wide: int) -> int:
    """Return the number of tiles of an image, all in pixels.

    Examples
    --------
    >>> count_tiles(9, 4, 4, 4)
    3
    """
    return -(-rows // tall) * -(-columns // wide)


@njit(cache=True, nogil=True, error_model="numpy")
def disc_moments(
    h, valid, masked, half, high, inner, tall, wide, trusted, mean, deviation, count, first, last
):
    """Write mean, deviation and number of valid pixels in a disc about each pixel.

    A tile sums differences from the mean of all pixels in its discs, in the type of `h`, which
    avoids cancellation in the sum of squares. A disc whose variance may be lost in the rounding of
    its tile's sums is summed again on its own in float64.

    Parameters
    ----------
    h : (H, W) float32 or float64
        Values that are not finite are omitted.
    valid : (H, W) uint8, or any when not `masked`
    half, high : (R + 1,), (C + 1,) int64
        Half-width of the disc at each distance of a row from its center, half-height at each
        distance of a column, px; half[0] = C and high[0] = R.
    inner : int
        Half-side of a square in the disc; no column farther out is taller than it.
    tall, wide : int
        Pixels of a tile.
    trusted : float
        Relative error of a variance that rounding may cause.
    mean, deviation : (H, W) float64, written
        NaN where no pixel of the disc counts.
    count : (H, W) int32, written
    first, last : int
        First tile, and the one after the last, of `count_tiles`.
    """
    rows, columns = h.shape
    reach, width = half.size - 1, half[0]
    across = (columns + wide - 1) // wide
    whole = np.int64(0)
    for a in range(reach + 1):
        whole += (2 * half[a] + 1) * (1 if a == 0 else 2)
    image, disc, found = (h, valid, masked), (half, high, inner, whole), (mean, deviation, count)
    # buffers are reused: allocating and clearing them per tile is slow
    most_rows = min(rows, tall + 2 * reach)
    length = min(wide, columns) + 2 * width + 1
    p = np.zeros(((most_rows + 3) // 4 * 4, length), h.dtype)
    q = np.zeros((most_rows + 4, length), h.dtype)
    nothing = np.zeros(length, h.dtype)
    sums = np.empty((3, tall, wide), h.dtype)
    v = np.empty((4, length))
    down_columns, squares = np.empty(length), np.empty(wide)
    for tile in range(first, last):
        y0, x0 = (tile // across) * tall, (tile % across) * wide
        box = (y0, min(rows, y0 + tall), x0, min(columns, x0 + wide))
        room = (p, q, nothing, sums, v, down_columns, squares)
        _tile(image, disc, trusted, box, room, found)
