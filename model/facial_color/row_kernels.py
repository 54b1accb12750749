"""Sum one row of discs by running sums, compiled."""

# mypy: allow-untyped-defs

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _add_run(t, a, left, right):
    """Add the sum between entries `left` and `right` of one row of prefix sums."""
    al, ar = a[left:], a[right:]
    for i in range(t.size):
        t[i] += ar[i] - al[i]


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _add_runs(t, a, b, c, d, width, w, v):
    """Add runs of half-width `w` of rows `a` and `b`, and of half-width `v` of `c` and `d`."""
    left, right, left2, right2 = width - w, width + w + 1, width - v, width + v + 1
    al, ar, bl, br = a[left:], a[right:], b[left:], b[right:]
    cl, cr, dl, dr = c[left2:], c[right2:], d[left2:], d[right2:]
    for i in range(t.size):
        t[i] += ((ar[i] - al[i]) + (br[i] - bl[i])) + ((cr[i] - cl[i]) + (dr[i] - dl[i]))


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _add_columns(t, upper, lower, one, other):
    """Add the columns' sums between two rows of prefix sums, of columns on both sides."""
    ul, ur, ll, lr = upper[one:], upper[other:], lower[one:], lower[other:]
    for i in range(t.size):
        t[i] += (ll[i] - ul[i]) + (lr[i] - ur[i])


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _add_column_pairs(t, upper, lower, upper2, lower2, one, other):
    """Do `_add_columns`, also for the next columns outward between other rows."""
    ul, ur, ll, lr = upper[one:], upper[other:], lower[one:], lower[other:]
    vl, vr = upper2[one - 1 :], upper2[other + 1 :]
    ml, mr = lower2[one - 1 :], lower2[other + 1 :]
    for i in range(t.size):
        t[i] += ((ll[i] - ul[i]) + (lr[i] - ur[i])) + ((ml[i] - vl[i]) + (mr[i] - vr[i]))


@njit(cache=True, nogil=True, error_model="numpy", inline="never")
def _move_square(square, new, old, left, right):
    """Add a run of the row that a square enters, subtract that of the row that it leaves."""
    nl, nr, ol, orr = new[left:], new[right:], old[left:], old[right:]
    for i in range(square.size):
        square[i] += np.float64(nr[i] - nl[i]) - np.float64(orr[i] - ol[i])


@njit(cache=True, nogil=True, error_model="numpy")
def disc_row(t, square, p, q, half, high, inner, rows, y):
    """Write the sums over the discs about one row of a tile.

    Parameters
    ----------
    t : (n,), written
    square : (n,) float64
        Sum over the square of half-side `inner`.
    p, q : (K, L), (K + 1, L)
        Sums along rows and down columns, before each entry, of the rows within reach of the tile.
    half, high : (R + 1,), (C + 1,) int64
    inner, rows : int
        Rows before 0 and from `rows` on are empty.
    y : int
        The row.
    """
    reach, width = half.size - 1, half[0]
    for i in range(t.size):
        t[i] = square[i]
    a = inner + 1
    while a <= width:
        w = high[a]
        upper, lower = q[max(y - w, 0)], q[min(y + w + 1, rows)]
        if a < width:
            v = high[a + 1]
            _add_column_pairs(
                t, upper, lower, q[max(y - v, 0)], q[min(y + v + 1, rows)], width - a, width + a
            )
            a += 2
        else:
            _add_columns(t, upper, lower, width - a, width + a)
            a += 1
    a = inner + 1
    while a <= reach:
        w = half[a]
        if a < reach and y - a - 1 >= 0 and y + a + 1 < rows:
            _add_runs(t, p[y - a], p[y + a], p[y - a - 1], p[y + a + 1], width, w, half[a + 1])
            a += 2
            continue
        if y - a >= 0:
            _add_run(t, p[y - a], width - w, width + w + 1)
        if y + a < rows:
            _add_run(t, p[y + a], width - w, width + w + 1)
        a += 1


@njit(cache=True, nogil=True, error_model="numpy")
def square_row(square, p, empty, inner, width, rows, y, first):
    """Move the square's sums down to row `y`, or begin them there."""
    left, right = width - inner, width + inner + 1
    if first:
        square[:] = 0.0
        for k in range(max(y - inner, 0), min(y + inner + 1, rows)):
            _move_square(square, p[k], empty, left, right)
        return
    new = p[y + inner] if y + inner < rows else empty
    old = p[y - inner - 1] if y - inner - 1 >= 0 else empty
    _move_square(square, new, old, left, right)
