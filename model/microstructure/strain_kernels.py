"""Inner loops of the strain of a mesh: per triangle and at its vertices.

Symmetric 2 x 2 tensors are three numbers (11, 12, 22).
"""

# mypy: allow-untyped-defs

import math

import numpy as np
from numba import njit

MIN_HEIGHT_RATIO = 1e-6
"""A triangle is degenerate if its height is below this fraction of its longest edge."""
ISOTROPY_TOL = 1e-6
"""Relative difference of the two stretch ratios below which no axis is preferred."""
FINE, DEGENERATE, NO_TEXTURE, TURNED = range(4)
"""Kinds of triangles: usable, without area, without area in the texture, mirrored."""


@njit(inline="always")
def _cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@njit(inline="always")
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(inline="always")
def _edge(points, i, j):
    return (points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2])


@njit(inline="always")
def principal_values(p, q, r):
    """Return mean and half the difference of the eigenvalues of (p, q, r), and the larger's axis.

    The axis is the first one where both are equal.
    """
    mean, d = 0.5 * (p + r), 0.5 * (p - r)
    h = math.hypot(d, q)
    if h == 0.0:
        return mean, h, 1.0, 0.0
    # half of the angle atan2(q, d), by the root without cancellation
    if d >= 0.0:
        c = math.sqrt(0.5 * (1.0 + d / h))
        return mean, h, c, 0.5 * q / (h * c)
    s = math.sqrt(0.5 * (1.0 - d / h))
    return mean, h, 0.5 * q / (h * s), s


@njit(cache=True, nogil=True, error_model="numpy")
def triangle_strain(rest, moved, faces, uv):
    """Return the strain of each triangle in its own plane.

    Parameters
    ----------
    rest, moved : (V, 3) float64
    faces : (F, 3) int64
    uv : (V, 2) float64

    Returns
    -------
    kind : (F,) uint8
    basis : (F, 3, 3) float64
        Unit axes in the rest triangle's plane, and its normal.
    area : (F,) float64
        Twice the rest area.
    change : (F, 3) float64
        Right stretch tensor less 1, ``sqrt(F^T F) - 1``, on these axes: exactly 0 where no edge
        changes.
    to_uv : (F, 2, 2) float64
        From these axes to the texture (Q of eq. 13's text, on the plane).
    """
    count = faces.shape[0]
    kind = np.zeros(count, np.uint8)
    basis = np.zeros((count, 3, 3))
    area = np.zeros(count)
    change = np.zeros((count, 3))
    to_uv = np.zeros((count, 2, 2))
    for f in range(count):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        a, b, c = _edge(rest, i, j), _edge(rest, i, k), _edge(rest, j, k)
        aa, bb = _dot(a, a), _dot(b, b)
        longest = max(aa, max(bb, _dot(c, c)))
        n = _cross(a, b)
        twice = math.sqrt(_dot(n, n))
        if not twice > MIN_HEIGHT_RATIO * longest:
            kind[f] = DEGENERATE
            continue
        # on axes e1 = a / |a|, e2 = n x e1: a = (x, 0), b = (u, v)
        x = math.sqrt(aa)
        u, v = _dot(a, b) / x, twice / x
        for m in range(3):
            basis[f, 0, m] = a[m] / x
            basis[f, 2, m] = n[m] / twice
        e2 = _cross(basis[f, 2], basis[f, 0])
        for m in range(3):
            basis[f, 1, m] = e2[m]
        area[f] = twice
        # changes of the edges' inner products, without cancellation
        A, B = _edge(moved, i, j), _edge(moved, i, k)
        da = (A[0] - a[0], A[1] - a[1], A[2] - a[2])
        db = (B[0] - b[0], B[1] - b[1], B[2] - b[2])
        gaa = _dot(da, (A[0] + a[0], A[1] + a[1], A[2] + a[2]))
        gab = _dot(da, B) + _dot(a, db)
        gbb = _dot(db, (B[0] + b[0], B[1] + b[1], B[2] + b[2]))
        # C - 1 = X^-T [gaa gab; gab gbb] X^-1 with X = [x u; 0 v]
        p = gaa / (x * x)
        q = (gab / x - p * u) / v
        r = (gbb / v - u * (p * u / v + 2.0 * q)) / v
        # U - 1 of U = sqrt(C), Cayley-Hamilton: (C + J) / s, s^2 = tr C + 2 J
        trace, det = p + r, p * r - q * q
        J = math.sqrt(max(1.0 + trace + det, 0.0))
        s = math.sqrt(max(2.0 + trace + 2.0 * J, 0.0))
        if s > 0.0:
            rest_of_it = det / (1.0 + J + s)
            change[f, 0], change[f, 1], change[f, 2] = (
                (p + rest_of_it) / s,
                q / s,
                (r + rest_of_it) / s,
            )
        else:
            change[f, 0], change[f, 2] = -1.0, -1.0
        ua, va = uv[j, 0] - uv[i, 0], uv[j, 1] - uv[i, 1]
        ub, vb = uv[k, 0] - uv[i, 0], uv[k, 1] - uv[i, 1]
        cu, cv = ub - ua, vb - va
        longest = max(ua * ua + va * va, max(ub * ub + vb * vb, cu * cu + cv * cv))
        if not abs(ua * vb - va * ub) > MIN_HEIGHT_RATIO * longest:
            kind[f] = NO_TEXTURE
            continue
        to_uv[f, 0, 0], to_uv[f, 1, 0] = ua / x, va / x
        to_uv[f, 0, 1] = (ub - to_uv[f, 0, 0] * u) / v
        to_uv[f, 1, 1] = (vb - to_uv[f, 1, 0] * u) / v
    return kind, basis, area, change, to_uv


@njit(inline="always")
def _rotate_axes(basis, normal):
    """Return a triangle's axes after the smallest rotation into the plane across `normal`."""
    n = (basis[2, 0], basis[2, 1], basis[2, 2])
    c = _dot(n, normal)
    sign = 1.0 if c >= 0.0 else -1.0
    scale = 1.0 / (1.0 + abs(c))
    x, y, z = sign * n[0] + normal[0], sign * n[1] + normal[1], sign * n[2] + normal[2]
    a, b = _dot(basis[0], normal) * scale, _dot(basis[1], normal) * scale
    return (
        (basis[0, 0] - a * x, basis[0, 1] - a * y, basis[0, 2] - a * z),
        (basis[1, 0] - b * x, basis[1, 1] - b * y, basis[1, 2] - b * z),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def vertex_strain(faces, point_index, places, kind, basis, area, change, to_uv):
    """Average triangles at vertices, weighted by their rest areas.

    Parameters
    ----------
    faces : (F, 3) int64
    point_index : (V,) int64
        Point of the skin of each vertex: numbers below ``places``.
    places : int
    kind, basis, area, change, to_uv
        Of `triangle_strain`; triangles that oppose a vertex's texture become `TURNED`.

    Returns
    -------
    stretch : (V, 2) float64
        r_s >= r_t >= 0.
    column_s, column_t : (V, 2) float64
        S = Q R^T V (eq. 13), texture per length along the principal axes.
    tensor, metric : (V, 3) float64
        T - 1 in the tangent frame, and Q R^T, both symmetric: R is the rotation closest to Q.
    even, valid : (V,) bool
        No axis is preferred; there is a triangle, and one with a texture.
    """
    count = point_index.size
    normal = np.zeros((places, 3))
    widest = np.full(places, -1)
    for f in range(faces.shape[0]):
        if kind[f] != DEGENERATE:
            for corner in range(3):
                w = point_index[faces[f, corner]]
                if widest[w] < 0 or area[f] > area[widest[w]]:
                    widest[w] = f
                for m in range(3):
                    normal[w, m] += area[f] * basis[f, 2, m]
    axes = np.zeros((places, 2, 3))
    for w in range(places):
        if widest[w] < 0:
            continue
        length = math.sqrt(_dot(normal[w], normal[w]))
        if length <= 1e-6 * area[widest[w]]:  # normals that cancel
            normal[w] = basis[widest[w], 2]
        else:
            for m in range(3):
                normal[w, m] /= length
        first, second = _rotate_axes(basis[widest[w]], normal[w])
        for m in range(3):
            axes[w, 0, m], axes[w, 1, m] = first[m], second[m]
    tensor_at = np.zeros((places, 3))
    weight = np.zeros(places)
    # the two orientations of the texture separately: a fold would cancel in one sum
    both = np.zeros((count, 2, 2, 2))
    share = np.zeros((count, 2))
    for f in range(faces.shape[0]):
        if kind[f] == DEGENERATE:
            continue
        p, q, r = change[f, 0], change[f, 1], change[f, 2]
        for corner in range(3):
            vertex = faces[f, corner]
            w = point_index[vertex]
            here = _rotate_axes(basis[f], normal[w])
            b00, b01 = _dot(axes[w, 0], here[0]), _dot(axes[w, 0], here[1])
            b10, b11 = _dot(axes[w, 1], here[0]), _dot(axes[w, 1], here[1])
            tensor_at[w, 0] += area[f] * (b00 * b00 * p + 2.0 * b00 * b01 * q + b01 * b01 * r)
            tensor_at[w, 1] += area[f] * (
                b00 * b10 * p + (b00 * b11 + b01 * b10) * q + b01 * b11 * r
            )
            tensor_at[w, 2] += area[f] * (b10 * b10 * p + 2.0 * b10 * b11 * q + b11 * b11 * r)
            weight[w] += area[f]
            if kind[f] == NO_TEXTURE:
                continue
            m00 = to_uv[f, 0, 0] * b00 + to_uv[f, 0, 1] * b01
            m01 = to_uv[f, 0, 0] * b10 + to_uv[f, 0, 1] * b11
            m10 = to_uv[f, 1, 0] * b00 + to_uv[f, 1, 1] * b01
            m11 = to_uv[f, 1, 0] * b10 + to_uv[f, 1, 1] * b11
            side = 0 if m00 * m11 - m01 * m10 > 0.0 else 1
            share[vertex, side] += area[f]
            both[vertex, side, 0, 0] += area[f] * m00
            both[vertex, side, 0, 1] += area[f] * m01
            both[vertex, side, 1, 0] += area[f] * m10
            both[vertex, side, 1, 1] += area[f] * m11
    for f in range(faces.shape[0]):
        if kind[f] == FINE:
            for corner in range(3):
                vertex = faces[f, corner]
                if share[vertex, 0] == 0.0 or share[vertex, 1] == 0.0:
                    continue
                w = point_index[vertex]
                here = _rotate_axes(basis[f], normal[w])
                det = to_uv[f, 0, 0] * to_uv[f, 1, 1] - to_uv[f, 0, 1] * to_uv[f, 1, 0]
                det *= _dot(axes[w, 0], here[0]) * _dot(axes[w, 1], here[1]) - _dot(
                    axes[w, 0], here[1]
                ) * _dot(axes[w, 1], here[0])
                side = 0 if det > 0.0 else 1
                if share[vertex, side] < share[vertex, 1 - side]:
                    kind[f] = TURNED
    stretch = np.ones((count, 2))
    column_s, column_t = np.zeros((count, 2)), np.zeros((count, 2))
    tensor, metric = np.zeros((count, 3)), np.zeros((count, 3))
    even, valid = np.ones(count, np.bool_), np.zeros(count, np.bool_)
    for vertex in range(count):
        w = point_index[vertex]
        side = 0 if share[vertex, 0] >= share[vertex, 1] else 1
        if weight[w] == 0.0 or share[vertex, side] == 0.0:
            continue
        t = tensor_at[w] / weight[w]
        m = both[vertex, side] / share[vertex, side]
        # polar decomposition m = metric rotation; the rotation is a reflection where m mirrors
        if side == 0:
            c, s = m[0, 0] + m[1, 1], m[1, 0] - m[0, 1]
        else:
            c, s = m[0, 0] - m[1, 1], m[1, 0] + m[0, 1]
        length = math.hypot(c, s)
        c, s = c / length, s / length
        o00, o10 = c, s
        o01, o11 = (-s, c) if side == 0 else (s, -c)
        metric[vertex, 0] = m[0, 0] * o00 + m[0, 1] * o01
        metric[vertex, 2] = m[1, 0] * o10 + m[1, 1] * o11
        metric[vertex, 1] = 0.5 * (m[0, 0] * o10 + m[0, 1] * o11 + m[1, 0] * o00 + m[1, 1] * o01)
        tensor[vertex, 0] = o00 * o00 * t[0] + 2.0 * o00 * o01 * t[1] + o01 * o01 * t[2]
        tensor[vertex, 1] = o00 * o10 * t[0] + (o00 * o11 + o01 * o10) * t[1] + o01 * o11 * t[2]
        tensor[vertex, 2] = o10 * o10 * t[0] + 2.0 * o10 * o11 * t[1] + o11 * o11 * t[2]
        # from the shared tensor, so that vertices of one point have bit-identical ratios
        mean, h, ax, ay = principal_values(t[0], t[1], t[2])
        stretch[vertex, 0] = max(1.0 + mean + h, 0.0)
        stretch[vertex, 1] = max(1.0 + mean - h, 0.0)
        even[vertex] = 2.0 * h <= ISOTROPY_TOL * stretch[vertex, 0]
        if even[vertex]:
            vx, vy = 1.0, 0.0
        else:
            vx, vy = o00 * ax + o01 * ay, o10 * ax + o11 * ay
        column_s[vertex, 0] = metric[vertex, 0] * vx + metric[vertex, 1] * vy
        column_s[vertex, 1] = metric[vertex, 1] * vx + metric[vertex, 2] * vy
        column_t[vertex, 0] = -metric[vertex, 0] * vy + metric[vertex, 1] * vx
        column_t[vertex, 1] = -metric[vertex, 1] * vy + metric[vertex, 2] * vx
        valid[vertex] = True
    return stretch, column_s, column_t, tensor, metric, even, valid
