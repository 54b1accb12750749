"""Compute energy and forces of a stretched surface layer on a periodic grid, compiled."""

import math

import numpy as np
from numba import njit, prange

LEAST_LOG_AREA = 0.05
"""Projected area, over that of the affine state, below which -log J continues as a parabola."""

# Energies are sums over nodes; the caller divides by their number. Rows grow with y. Every square
# of four nodes is covered by its four corner triangles with weight one quarter each (flat finite
# elements over both diagonals): so no mode of the grid has zero energy.


@njit(cache=True, inline="always")
def _corner(a1, a2, a3, b1, b2, b3, p, q):  # type: ignore[no-untyped-def]
    """Return energy of a unit membrane and its derivatives by the two edge vectors.

    Incompressible neo-Hookean: (tr C + 1 / det C - 3) / 2 per reference area, C the metric
    (a, b) against that of the neutral slopes (p, q).
    """
    aa = a1 * a1 + a2 * a2 + a3 * a3
    bb = b1 * b1 + b2 * b2 + b3 * b3
    ab = a1 * b1 + a2 * b2 + a3 * b3
    g = 1.0 + p * p + q * q
    det = aa * bb - ab * ab
    area = math.sqrt(g)
    pp = (1.0 + q * q) / g
    pq = -p * q / g
    qq = (1.0 + p * p) / g
    ratio = g / det
    energy = 0.5 * area * (pp * aa + 2.0 * pq * ab + qq * bb + ratio - 3.0)
    falling = ratio / det
    caa = area * (pp - falling * bb)
    cab = area * (pq + falling * ab)
    cbb = area * (qq - falling * aa)
    return energy, caa, cab, cbb


@njit(cache=True)
def _squeezed(area):  # type: ignore[no-untyped-def]
    """Return J - 1 - log J and its derivative, or of its parabola below `LEAST_LOG_AREA`."""
    if area > LEAST_LOG_AREA:
        return area - 1.0 - math.log(area), 1.0 - 1.0 / area
    below = (area - LEAST_LOG_AREA) / LEAST_LOG_AREA
    energy = area - 1.0 - math.log(LEAST_LOG_AREA) - below + 0.5 * below * below
    return energy, 1.0 - (1.0 - below) / LEAST_LOG_AREA


@njit(parallel=True, cache=True, fastmath=True)
def add_membrane_forces(v, neutral, stiffness, f, bulk, texel, force):  # type: ignore[no-untyped-def]
    """Add the forces of the stretched membrane to ``force``; return its energy, summed over nodes.

    Parameters
    ----------
    v : ndarray (3, N, M)
        In-plane displacement (x, y) from the affine state and height, um; N is even.
    neutral : ndarray (N, M)
        Height of the neutral state, um.
    stiffness : ndarray (N, M)
        Shear modulus times thickness in units of the foundation's modulus times um.
    f : ndarray (2, 2)
        Mean deformation gradient.
    bulk : float
        Stiffness of the tissue's skin against losing area: bulk (J - 1 - log J) per area, J the
        projected area over that of the affine state. Below `LEAST_LOG_AREA` it continues as its
        parabola, so that one point about to change sides does not stop the search of all others.
    texel : float
        Distance of nodes, um.
    force : ndarray (3, N, M)
        Derivative of the energy by ``v`` is added.
    """
    rows, columns = neutral.shape
    part = np.zeros(rows)
    h = 1.0 / texel
    fxx, fxy, fyx, fyy = f[0, 0], f[0, 1], f[1, 0], f[1, 1]
    whole = fxx * fyy - fxy * fyx
    # A row of squares writes two rows of nodes: even rows first, then odd ones, which avoids races.
    for parity in range(2):
        for half in prange(rows // 2):
            i = 2 * half + parity
            k = (i + 1) % rows
            total = 0.0
            for j in range(columns):
                m = j + 1 if j + 1 < columns else 0
                x00, x10, x01, x11 = v[0, i, j], v[0, i, m], v[0, k, j], v[0, k, m]
                y00, y10, y01, y11 = v[1, i, j], v[1, i, m], v[1, k, j], v[1, k, m]
                z00, z10, z01, z11 = v[2, i, j], v[2, i, m], v[2, k, j], v[2, k, m]
                n00, n10 = neutral[i, j], neutral[i, m]
                n01, n11 = neutral[k, j], neutral[k, m]
                weight = 0.0625 * (
                    stiffness[i, j] + stiffness[i, m] + stiffness[k, j] + stiffness[k, m]
                )
                # Edges along x below and above, along y left and right, in the deformed state.
                b1, b2, b3 = fxx + h * (x10 - x00), fyx + h * (y10 - y00), h * (z10 - z00)
                t1, t2, t3 = fxx + h * (x11 - x01), fyx + h * (y11 - y01), h * (z11 - z01)
                l1, l2, l3 = fxy + h * (x01 - x00), fyy + h * (y01 - y00), h * (z01 - z00)
                r1, r2, r3 = fxy + h * (x11 - x10), fyy + h * (y11 - y10), h * (z11 - z10)
                pb, pt = h * (n10 - n00), h * (n11 - n01)
                ql, qr = h * (n01 - n00), h * (n11 - n10)
                e1, a1, c1, d1 = _corner(b1, b2, b3, l1, l2, l3, pb, ql)
                e2, a2, c2, d2 = _corner(b1, b2, b3, r1, r2, r3, pb, qr)
                e3, a3, c3, d3 = _corner(t1, t2, t3, l1, l2, l3, pt, ql)
                e4, a4, c4, d4 = _corner(t1, t2, t3, r1, r2, r3, pt, qr)
                total += weight * (e1 + e2 + e3 + e4)
                j1, j2 = b1 * l2 - b2 * l1, b1 * r2 - b2 * r1
                j3, j4 = t1 * l2 - t2 * l1, t1 * r2 - t2 * r1
                w = 0.25 * bulk * h
                if min(min(j1, j2), min(j3, j4)) > LEAST_LOG_AREA * whole:
                    total += (
                        0.25
                        * bulk
                        * (
                            (j1 + j2 + j3 + j4) / whole
                            - 4.0
                            - math.log(j1 * j2 * (j3 * j4) / (whole * whole * whole * whole))
                        )
                    )
                    g1, g2 = w * (1.0 / whole - 1.0 / j1), w * (1.0 / whole - 1.0 / j2)
                    g3, g4 = w * (1.0 / whole - 1.0 / j3), w * (1.0 / whole - 1.0 / j4)
                else:
                    (s1, g1), (s2, g2) = _squeezed(j1 / whole), _squeezed(j2 / whole)
                    (s3, g3), (s4, g4) = _squeezed(j3 / whole), _squeezed(j4 / whole)
                    total += 0.25 * bulk * (s1 + s2 + s3 + s4)
                    g1, g2 = w * g1 / whole, w * g2 / whole
                    g3, g4 = w * g3 / whole, w * g4 / whole
                w = weight * h
                ab, at, al, ar = w * (a1 + a2), w * (a3 + a4), w * (d1 + d3), w * (d2 + d4)
                c1, c2, c3, c4 = w * c1, w * c2, w * c3, w * c4
                for axis in range(3):
                    if axis == 0:
                        b, t, e, r = b1, t1, l1, r1
                    elif axis == 1:
                        b, t, e, r = b2, t2, l2, r2
                    else:
                        b, t, e, r = b3, t3, l3, r3
                    db = ab * b + c1 * e + c2 * r
                    dt = at * t + c3 * e + c4 * r
                    dl = al * e + c1 * b + c3 * t
                    dr = ar * r + c2 * b + c4 * t
                    if axis == 0:
                        db += g1 * l2 + g2 * r2
                        dt += g3 * l2 + g4 * r2
                        dl -= g1 * b2 + g3 * t2
                        dr -= g2 * b2 + g4 * t2
                    elif axis == 1:
                        db -= g1 * l1 + g2 * r1
                        dt -= g3 * l1 + g4 * r1
                        dl += g1 * b1 + g3 * t1
                        dr += g2 * b1 + g4 * t1
                    force[axis, i, j] -= db + dl
                    force[axis, i, m] += db - dr
                    force[axis, k, j] += dl - dt
                    force[axis, k, m] += dt + dr
            part[i] = total
    return part.sum()


@njit(cache=True)
def find_least_area(v, f, texel):  # type: ignore[no-untyped-def]
    """Return the least projected area of an element over that of the affine state; <= 0: inverted.

    Parameters are those of `add_membrane_forces`.
    """
    rows, columns = v.shape[1:]
    h = 1.0 / texel
    least = np.inf
    for i in range(rows):
        k = (i + 1) % rows
        for j in range(columns):
            m = (j + 1) % columns
            b1, b2 = (
                f[0, 0] + h * (v[0, i, m] - v[0, i, j]),
                f[1, 0] + h * (v[1, i, m] - v[1, i, j]),
            )
            t1, t2 = (
                f[0, 0] + h * (v[0, k, m] - v[0, k, j]),
                f[1, 0] + h * (v[1, k, m] - v[1, k, j]),
            )
            l1, l2 = (
                f[0, 1] + h * (v[0, k, j] - v[0, i, j]),
                f[1, 1] + h * (v[1, k, j] - v[1, i, j]),
            )
            r1, r2 = (
                f[0, 1] + h * (v[0, k, m] - v[0, i, m]),
                f[1, 1] + h * (v[1, k, m] - v[1, i, m]),
            )
            below = min(b1 * l2 - b2 * l1, b1 * r2 - b2 * r1)
            least = min(least, min(below, min(t1 * l2 - t2 * l1, t1 * r2 - t2 * r1)))
    return least / (f[0, 0] * f[1, 1] - f[0, 1] * f[1, 0])


@njit(parallel=True, cache=True, fastmath=True)
def add_bending_forces(height, neutral, stiffness, texel, moment, force):  # type: ignore[no-untyped-def]
    """Add the forces against a change of curvature to ``force``; return the energy's sum.

    Parameters
    ----------
    height, neutral : ndarray (N, M)
        um.
    stiffness : ndarray (N, M)
        Bending stiffness in units of the foundation's modulus times um^3.
    texel : float
        um.
    moment : ndarray (N, M)
        Work space.
    force : ndarray (N, M)
        Derivative by ``height`` is added.
    """
    rows, columns = height.shape
    part = np.zeros(rows)
    h2 = 1.0 / (texel * texel)
    for i in prange(rows):
        up, down = (i + 1) % rows, i - 1 if i > 0 else rows - 1
        total = 0.0
        for j in range(columns):
            right, left = j + 1 if j + 1 < columns else 0, j - 1 if j > 0 else columns - 1
            curved = h2 * (
                (height[up, j] - neutral[up, j])
                + (height[down, j] - neutral[down, j])
                + (height[i, right] - neutral[i, right])
                + (height[i, left] - neutral[i, left])
                - 4.0 * (height[i, j] - neutral[i, j])
            )
            moment[i, j] = stiffness[i, j] * curved
            total += 0.5 * moment[i, j] * curved
        part[i] = total
    for i in prange(rows):
        up, down = (i + 1) % rows, i - 1 if i > 0 else rows - 1
        for j in range(columns):
            right, left = j + 1 if j + 1 < columns else 0, j - 1 if j > 0 else columns - 1
            force[i, j] += h2 * (
                moment[up, j]
                + moment[down, j]
                + moment[i, right]
                + moment[i, left]
                - 4.0 * moment[i, j]
            )
    return part.sum()


@njit(parallel=True, cache=True, fastmath=True)
def rotate_coefficients(q, scale, unit, out):  # type: ignore[no-untyped-def]
    """Rotate scaled coefficients from (along, across, normal) of each wave to x, y, z.

    Parameters
    ----------
    q : ndarray (3, N, K) of complex128
    scale : ndarray (3, N, K)
    unit : ndarray (2, N, K)
        Directions of the waves.
    out : ndarray (3, N, K) of complex128
        Result.
    """
    for i in prange(q.shape[1]):
        for j in range(q.shape[2]):
            along = 1j * (scale[0, i, j] * q[0, i, j])
            across = 1j * (scale[1, i, j] * q[1, i, j])
            out[0, i, j] = unit[0, i, j] * along - unit[1, i, j] * across
            out[1, i, j] = unit[1, i, j] * along + unit[0, i, j] * across
            out[2, i, j] = scale[2, i, j] * q[2, i, j]


@njit(parallel=True, cache=True, fastmath=True)
def add_tissue_forces(hat, elastic, unit, weight, force):  # type: ignore[no-untyped-def]
    """Add the forces of a half-space to ``force``; return its energy.

    Parameters
    ----------
    hat : ndarray (3, N, K) of complex128
        Displacement's coefficients.
    elastic : ndarray (3, N, K)
        Stiffness of normal, across and mixed motion.
    unit : ndarray (2, N, K)
    weight : ndarray (N, K)
        Multiplicity of a coefficient: 2 where the conjugate half is omitted.
    force : ndarray (3, N, K) of complex128
        Forces' coefficients are added.
    """
    part = np.zeros(hat.shape[1])
    for i in prange(hat.shape[1]):
        total = 0.0
        for j in range(hat.shape[2]):
            ux, uy = unit[0, i, j], unit[1, i, j]
            along = ux * hat[0, i, j] + uy * hat[1, i, j]
            across = ux * hat[1, i, j] - uy * hat[0, i, j]
            up = hat[2, i, j]
            mixed = 1j * elastic[2, i, j]
            f_along = elastic[0, i, j] * along + mixed * up
            f_across = elastic[1, i, j] * across
            f_up = elastic[0, i, j] * up - mixed * along
            total += weight[i, j] * (
                along.real * f_along.real
                + along.imag * f_along.imag
                + across.real * f_across.real
                + across.imag * f_across.imag
                + up.real * f_up.real
                + up.imag * f_up.imag
            )
            force[0, i, j] += ux * f_along - uy * f_across
            force[1, i, j] += uy * f_along + ux * f_across
            force[2, i, j] += f_up
        part[i] = total
    return 0.5 * part.sum()


@njit(parallel=True, cache=True, fastmath=True)
def gather_coefficient_forces(hat, scale, unit, weight, out):  # type: ignore[no-untyped-def]
    """Convert forces on x, y, z to derivatives by scaled coefficients.

    This is the adjoint of `rotate_coefficients`.
    """
    for i in prange(hat.shape[1]):
        for j in range(hat.shape[2]):
            ux, uy, w = unit[0, i, j], unit[1, i, j], weight[i, j]
            along = ux * hat[0, i, j] + uy * hat[1, i, j]
            across = ux * hat[1, i, j] - uy * hat[0, i, j]
            out[0, i, j] = -1j * (w * scale[0, i, j] * along)
            out[1, i, j] = -1j * (w * scale[1, i, j] * across)
            out[2, i, j] = w * scale[2, i, j] * hat[2, i, j]


@njit(cache=True, inline="always")
def _basis(k, t):  # type: ignore[no-untyped-def]
    """Return the k-th of the four weights of a cubic B-spline in a cell, and its slope."""
    if k == 0:
        return (1.0 - t) ** 3 / 6.0, -0.5 * (1.0 - t) ** 2
    if k == 1:
        return (4.0 - 6.0 * t * t + 3.0 * t**3) / 6.0, -2.0 * t + 1.5 * t * t
    if k == 2:
        r = 1.0 - t
        return (4.0 - 6.0 * r * r + 3.0 * r**3) / 6.0, 2.0 * r - 1.5 * r * r
    return t**3 / 6.0, 0.5 * t * t


@njit(parallel=True, cache=True)
def evaluate_spline(coefficients, row, column, want_slope, value, along_row, along_column):  # type: ignore[no-untyped-def]
    """Evaluate a cubic B-spline and its derivatives at points inside the grid.

    Parameters
    ----------
    coefficients : ndarray (N, M)
        Of `scipy.ndimage.spline_filter` with mode "mirror".
    row, column : ndarray (P,)
        Positions in texels; a position outside gives NaN.
    want_slope : bool
        False skips the derivatives.
    value, along_row, along_column : ndarray (P,)
        Results, derivatives per texel.
    """
    rows, columns = coefficients.shape
    for n in prange(row.size):
        y, x = row[n], column[n]
        if not (0.0 <= y <= rows - 1.0 and 0.0 <= x <= columns - 1.0):
            value[n] = np.nan
            if want_slope:
                along_row[n], along_column[n] = np.nan, np.nan
            continue
        i, j = min(int(y), rows - 2), min(int(x), columns - 2)
        s, t = y - i, x - j
        total, by_row, by_column = 0.0, 0.0, 0.0
        for a in range(4):
            wy, dy = _basis(a, s)
            k = i + a - 1
            k = -k if k < 0 else (2 * rows - 2 - k if k >= rows else k)
            line, slope = 0.0, 0.0
            for b in range(4):
                wx, dx = _basis(b, t)
                m = j + b - 1
                m = -m if m < 0 else (2 * columns - 2 - m if m >= columns else m)
                line += wx * coefficients[k, m]
                slope += dx * coefficients[k, m]
            total += wy * line
            by_row += dy * line
            by_column += wy * slope
        value[n] = total
        if want_slope:
            along_row[n], along_column[n] = by_row, by_column
