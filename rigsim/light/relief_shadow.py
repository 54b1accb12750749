"""Compute shadows of relief: horizons of a height field, and of wrinkles above a mesh.

Each line is swept along its direction from the light's side. The upper convex hull of the passed
points gives the horizon of the next point in constant time on average (Timonen and Westerholm 2010,
doi:10.1111/j.1467-8659.2009.01642.x). Lines are one pixel apart; heights between pixels are linear.
For each direction over the texture the elevation of its horizon is computed once
(`horizon_tangent`); a light below it is hidden from that texel. Horizons are those of the
relief over the mesh as if the mesh were flat over a few millimeters; rays test occlusion by the
mesh.

Interreflection between walls of grooves follows from the hidden fraction of their sky. Each
point of a relief receives light from other skin wherever the sky is hidden. That skin's light has
scattered laterally over more than a groove's width, so that its brightness is uniform nearby. The
light it sends to a point is that brightness times the hidden fraction of the point's hemisphere,
times the boundary's transmittance. On skin's shallow relief the hidden sky is near the horizon, and
light between walls is nearly parallel to the surface, where the boundary transmits little.
"""

import math
from typing import Final

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from rigsim.arrays import Float32Array
from rigsim.light.hidden_sky_kernels import add_sector, add_sector_through
from rigsim.subject import SimulatedSubject

HORIZON_DIRECTIONS: Final = 24
"""Number of directions with horizons; they are interpolated in between."""

HORIZON_SOFTNESS_RAD: Final = 0.02
"""Smallest half width of a shadow's edge in elevation: a texel is not a point."""


class HorizonError(ValueError):
    """An unusable height field or direction."""


def horizon_tangent(
    height_um: Float32Array, *, pixel_um: float, azimuth_rad: float
) -> Float32Array:
    """Return the tangent of the horizon's elevation in one direction.

    Parameters
    ----------
    height_um
        Heights, um, shape (H, W); row 0 is the top. Around the field the relief is level and too
        low to hide anything.
    pixel_um
        Distance of neighbors, um, > 0.
    azimuth_rad
        Direction of the light over the field, from +x towards the top.

    Returns
    -------
    ndarray of float32
        Shape (H, W), >= 0; 0 where nothing is higher.
    """
    height = np.ascontiguousarray(height_um, np.float32)
    if height.ndim != 2 or not np.isfinite(height).all():
        raise HorizonError(f"height_um: got shape {height.shape}, expected finite (H, W)")
    if not (0.0 < pixel_um < math.inf and math.isfinite(azimuth_rad)):
        raise HorizonError(
            f"pixel_um, azimuth_rad: got {pixel_um}, {azimuth_rad}, expected > 0 and finite"
        )
    right, down = math.cos(azimuth_rad), -math.sin(azimuth_rad)
    # sweep along the dominant axis of the direction, away from the light
    steep = abs(down) > abs(right)
    field = height.T if steep else height
    along, across = (down, right) if steep else (right, down)
    backwards = along < 0.0
    # the light is at +along: start at the far end and proceed to smaller coordinates
    field = np.ascontiguousarray(field if backwards else field[:, ::-1])
    slope = across / abs(along)  # drift across per step toward the light
    out = np.zeros_like(field)
    _sweep(field, np.float32(pixel_um * math.hypot(1.0, slope)), -slope, out)
    out = out if backwards else out[:, ::-1]
    return np.ascontiguousarray(out.T if steep else out)


class ReliefShadow:
    """Shadows of one face's relief.

    Parameters
    ----------
    subject
        The face in its pose.
    directions
        Number of directions with horizons.
    """

    def __init__(self, subject: SimulatedSubject, directions: int = HORIZON_DIRECTIONS) -> None:
        atlas = subject.atlas
        self._du, self._dv = atlas.dp_du_mm, atlas.dp_dv_mm
        self._size = atlas.size
        height = np.where(atlas.covered, subject.height_um, np.float32(0.0)).astype(np.float32)
        # um per texel; each texel's own frame gives its length along each direction
        self._horizon = np.stack(
            [
                horizon_tangent(height, pixel_um=1.0, azimuth_rad=2.0 * math.pi * k / directions)
                for k in range(directions)
            ]
        )
        self._highest = _bound_horizons(self._du, self._dv, self._horizon.max(axis=0))

    def visible_fraction(
        self,
        uv: Float32Array,
        position_mm: Float32Array,
        light_mm: ArrayLike,
        *,
        radius_mm: float = 0.0,
    ) -> Float32Array:
        """Return the fraction of a light that the relief leaves to each point.

        Parameters
        ----------
        uv
            Texture coordinates, shape (n, 2), (0, 0) is bottom left.
        position_mm
            The points, frame of the mesh, shape (n, 3).
        light_mm
            Center of the light, same frame, shape (3,).
        radius_mm
            Radius of its disc, which makes edges soft.

        Returns
        -------
        ndarray of float32
            Shape (n,), 0 to 1.
        """
        light = np.asarray(light_mm, np.float64)
        return self.visible_fractions(uv, position_mm, light[None], [radius_mm])[0]

    def visible_fractions(
        self, uv: Float32Array, position_mm: Float32Array, lights_mm: ArrayLike, radii_mm: ArrayLike
    ) -> Float32Array:
        """Return `visible_fraction` of several lights, shape (L, n).

        Parameters
        ----------
        uv, position_mm
            As for `visible_fraction`.
        lights_mm, radii_mm
            Centers of the lights, shape (L, 3), and radii of their discs, shape (L,).
        """
        lights = np.ascontiguousarray(lights_mm, np.float64)
        out = np.empty((len(lights), len(uv)), np.float32)
        points = (np.ascontiguousarray(part, np.float32) for part in (uv, position_mm))
        relief = (self._du, self._dv, self._horizon, self._highest)
        _visible_fractions(*points, lights, np.asarray(radii_mm, np.float64), *relief, out)
        return out

    def on_texture(
        self, position_mm: Float32Array, light_mm: ArrayLike, *, radius_mm: float = 0.0
    ) -> Float32Array:
        """Return `visible_fraction` per texel, shape (N, N), from positions, shape (N, N, 3)."""
        middle = (np.arange(self._size, dtype=np.float32) + np.float32(0.5)) / self._size
        uv = np.stack(np.meshgrid(middle, middle[::-1]), axis=-1).reshape(-1, 2)
        found = self.visible_fraction(
            uv.astype(np.float32), position_mm.reshape(-1, 3), light_mm, radius_mm=radius_mm
        )
        return found.reshape(self._size, self._size)


@njit(parallel=True, cache=True, error_model="numpy")
def _sweep(field, step, drift, out):  # type: ignore[no-untyped-def]
    """Sweep over the columns, from the light's side; each line drifts over the rows."""
    # The stack holds the upper convex hull of the points between the light and the current column.
    # A point below the segment from its predecessor to the current point can never again be a
    # horizon,
    # so it is removed for good: each point enters and leaves once, hence constant time on average.
    rows, columns = field.shape
    most = math.ceil(abs(drift) * (columns - 1))
    first = -most if drift > 0.0 else 0
    lines = rows + most
    for line in prange(lines):
        start = first + line
        place = np.empty(columns, np.float32)
        level = np.empty(columns, np.float32)
        top = 0
        for column in range(columns):
            exact = start + drift * column
            row = math.floor(exact + 0.5)
            if row < 0 or row >= rows:
                continue
            low = math.floor(exact)
            part = np.float32(exact - low)
            below = min(max(low, 0), rows - 1)
            above = min(max(low + 1, 0), rows - 1)
            own = (np.float32(1.0) - part) * field[below, column] + part * field[above, column]
            here = np.float32(column) * step
            # points of the hull that the next one hides from here never become a horizon again
            # slopes are compared without their divisions
            while top > 1:
                rise, far = level[top - 1] - own, here - place[top - 1]
                if (level[top - 2] - own) * far < rise * (here - place[top - 2]):
                    break
                top -= 1
            if top == 1 and level[0] <= own:
                top = 0
            if top > 0:
                rise = (level[top - 1] - own) / (here - place[top - 1])
                if rise > 0.0:
                    out[row, column] = rise
            place[top] = here
            level[top] = own
            top += 1


HORIZON_MARGIN: Final = 1e-6
"""Margin of `_bound_horizons` for rounding errors."""


def _bound_horizons(
    du_mm: Float32Array, dv_mm: Float32Array, highest: Float32Array
) -> Float32Array:
    """Return an upper bound of the sine of each texel's horizon in all directions, (N, N).

    A texel's shortest length is the square root of the smaller eigenvalue of its metric.
    """
    size = du_mm.shape[0]
    along, down = du_mm.astype(np.float64), dv_mm.astype(np.float64)
    aa, bb = (along**2).sum(axis=-1), (down**2).sum(axis=-1)
    half = np.hypot(0.5 * (aa - bb), (along * down).sum(axis=-1))
    squared = 0.5 * (aa + bb) - half - HORIZON_MARGIN * (aa + bb)
    shortest_um = 1e3 / size * np.sqrt(np.maximum(squared, MIN_SQUARED_LENGTH))
    tangent = highest / shortest_um
    return np.asarray(tangent / np.hypot(1.0, tangent) + HORIZON_MARGIN, np.float32)


MIN_SQUARED_LENGTH: Final = 1e-12
"""Smallest squared length of a texture's side along a direction, mm^2."""


@njit(parallel=True, cache=True, nogil=True)
def _visible_fractions(  # type: ignore[no-untyped-def]
    uv, position, lights, radii, du, dv, horizon, highest, out
):
    size = du.shape[0]
    turns = horizon.shape[0]
    for i in prange(uv.shape[0]):
        column = min(max(int(uv[i, 0] * size), 0), size - 1)
        row = min(max(int((1.0 - uv[i, 1]) * size), 0), size - 1)
        a0, a1, a2 = float(du[row, column, 0]), float(du[row, column, 1]), float(du[row, column, 2])
        b0, b1, b2 = float(dv[row, column, 0]), float(dv[row, column, 1]), float(dv[row, column, 2])
        n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        area = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
        for light in range(lights.shape[0]):
            w0 = lights[light, 0] - position[i, 0]
            w1 = lights[light, 1] - position[i, 1]
            w2 = lights[light, 2] - position[i, 2]
            far = math.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
            out[light, i] = 1.0
            if area <= 0.0 or far <= 0.0:
                continue
            up = (w0 * n0 + w1 * n1 + w2 * n2) / (area * far)
            if up <= 0.0:
                continue  # behind the mesh; rays test that occlusion
            soft = max(radii[light] / far, HORIZON_SOFTNESS_RAD)
            if up >= highest[row, column] + soft:
                continue  # above all horizons, as sin(a + b) <= sin(a) + b
            # the direction over the texture: w = a du + b dv + c n
            p, q = w0 * a0 + w1 * a1 + w2 * a2, w0 * b0 + w1 * b1 + w2 * b2
            aa, bb = a0 * a0 + a1 * a1 + a2 * a2, b0 * b0 + b1 * b1 + b2 * b2
            ab = a0 * b0 + a1 * b1 + a2 * b2
            a, b = bb * p - ab * q, aa * q - ab * p
            length = math.hypot(a, b)
            if length <= 0.0:
                continue  # overhead
            a, b = a / length, b / length
            squared = max(a * a * aa + 2.0 * a * b * ab + b * b * bb, MIN_SQUARED_LENGTH)
            texel_um = 1e3 / size * math.sqrt(squared)
            turn = math.atan2(b, a) / (2.0 * math.pi) % 1.0 * turns
            k = int(turn)
            share = turn - k
            low, high = horizon[k % turns, row, column], horizon[(k + 1) % turns, row, column]
            edge = math.atan(((1.0 - share) * float(low) + share * float(high)) / texel_um)
            if edge > 0.0:
                seen = 0.5 + (math.asin(min(up, 1.0)) - edge) / (2.0 * soft)
                out[light, i] = min(max(seen, 0.0), 1.0)


def hidden_sky_fraction(
    height_um: Float32Array,
    normals: Float32Array,
    *,
    margin: int,
    pixel_um: float,
    sectors: int,
    boundaries: bool = False,
) -> Float32Array:
    """Return the fraction of each point's sky that the relief hides, weighted with the cosine.

    Parameters
    ----------
    height_um
        Heights with ``margin`` more samples on all sides, um, shape (H + 2 m, W + 2 m).
    normals
        Unit normals, shape (H, W, 3); +z is up, and z is at least 0.
    margin
        Number of those samples, >= 0.
    pixel_um
        Distance of samples, um, > 0.
    sectors
        Number of directions with horizons, >= 1.
    boundaries
        Whether directions are weighted with the transmittance out of one wall and into the other:
        the square of the transmittance at the point's own angle, which represents both.

    Returns
    -------
    ndarray of float32
        Shape (H, W), 0 to 1.

    Raises
    ------
    HorizonError
        A normal points down, and for heights and numbers as `horizon_tangent`.

    Notes
    -----
    In a direction with the normal's part n_t along it and n_z up, between the point's own tangent
    plane at elevation a and the horizon at b, ``int (n_t cos e + n_z sin e) cos e de`` is
    ``n_t (e / 2 + sin 2e / 4) + n_z sin^2 e / 2`` from a to b; with boundaries it is summed at
    `ELEVATION_NODES` of `rigsim.light.hidden_sky_kernels`. Level skin around the field hides the
    sky below the horizontal.

    Examples
    --------
    A wall tilted by 60 degrees hides (1 - cos 60) / 2 of its sky below the horizontal:

    >>> tilt = math.radians(60.0)
    >>> lean = np.zeros((1, 1, 3), np.float32) + np.float32([math.sin(tilt), 0.0, math.cos(tilt)])
    >>> found = hidden_sky_fraction(np.zeros((1, 1), np.float32), lean, margin=0, pixel_um=1,
    ...     sectors=64)
    >>> round(float(found[0, 0]), 3)
    0.25
    """
    out = np.zeros(normals.shape[:2], np.float32)
    normals = np.ascontiguousarray(normals, np.float32)
    down = normals[..., 2] < 0.0
    if down.any():
        raise HorizonError(
            f"normals: got {np.count_nonzero(down)} with z < 0, expected >= 0; turn them upwards"
        )
    planes = np.ascontiguousarray(np.moveaxis(normals, -1, 0)) if boundaries else normals
    inner = slice(margin, -margin or None)
    for k in range(sectors):
        angle = 2.0 * math.pi * k / sectors
        tangent = horizon_tangent(height_um, pixel_um=pixel_um, azimuth_rad=angle)
        part = np.ascontiguousarray(tangent[inner, inner])
        if boundaries:
            add_sector_through(out, planes, part, angle, 2.0 / sectors)
        else:
            add_sector(out, normals, part, angle, 2.0 / sectors)
    return np.clip(out, 0.0, 1.0)
