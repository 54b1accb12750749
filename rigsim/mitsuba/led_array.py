"""Emitter `ledarray`: many small LEDs, each with a position, axis, lobe, size, color and level.

.. code-block:: python

    "type": "ledarray",
    "filename": "lights.csv",   # a header line, then a row of `LED_COLUMNS` for each LED

or, from Python, ``"table"``: a `mi.Bitmap` or `mi.TensorXf` of the rows, see `led_table`. Rows may
end with `FILM_COLUMNS`, a polarizer in front of each LED; unpolarized variants dim its light only.

An LED of intensity I on its axis emits I cos(angle)^exponent per steradian, and nothing backwards.
Stock integrators choose one of the LEDs by its intensity times its level, and a point of its disc;
the integrator `olat` takes them one by one.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rigsim.arrays import Float32Array
from rigsim.mitsuba.memory import pad_memory
from rigsim.mitsuba.plugin_class import define_plugin
from rigsim.mitsuba.polarized_light import FilmedLight, filmed_spectrum

LED_COLUMNS: Final = (
    "x_mm",
    "y_mm",
    "z_mm",
    "axis_x",
    "axis_y",
    "axis_z",
    "red",
    "green",
    "blue",
    "exponent",
    "radius_mm",
    "level",
)
"""Columns of an LED's row: center and unit axis, intensity on the axis per steradian, exponent of
the lobe, radius of the disc, level."""

FILM_COLUMNS: Final = ("absorbs_x", "absorbs_y", "absorbs_z", "leak")
"""Optional columns of an LED's polarizer: absorbing axis, transmittance along it over that across
it; 0 is ideal, 1 is none."""

INVERSE_PLASTIC_NUMBER: Final = 0.7548776662466927
"""Inverse of the plastic number, the root of x^3 = x + 1."""

DISC_POINTS: Final = 1 << 12
"""Points on a light's disc, assigned to hits cyclically."""


def led_table(
    position_mm: ArrayLike,
    axis: ArrayLike,
    *,
    intensity: ArrayLike = (1.0, 1.0, 1.0),
    exponent: ArrayLike = 0.0,
    radius_mm: ArrayLike = 0.0,
    level: ArrayLike = 1.0,
    absorbs: ArrayLike | None = None,
    leak: ArrayLike = 0.0,
) -> NDArray[np.float32]:
    """Return the table of an `ledarray`, shape (N, 12), or (N, 16) with polarizers.

    Parameters
    ----------
    position_mm, axis
        Centers and unit axes, shape (N, 3).
    intensity
        Radiant intensity on the axis, shape (3,) or (N, 3).
    exponent, radius_mm, level
        Numbers, or one for each LED, shape (N,).
    absorbs, leak
        Absorbing axes of polarizers, unit vectors, shape (N, 3), None without them; their
        transmittance along that axis over that across it.

    Examples
    --------
    >>> led_table([[0.0, 0.0, 700.0]], [[0.0, 0.0, -1.0]], exponent=2.0)[0].tolist()
    [0.0, 0.0, 700.0, 0.0, 0.0, -1.0, 1.0, 1.0, 1.0, 2.0, 0.0, 1.0]
    """
    place = np.atleast_2d(np.asarray(position_mm, np.float32))
    columns = len(LED_COLUMNS) + (0 if absorbs is None else len(FILM_COLUMNS))
    table = np.zeros((len(place), columns), np.float32)
    table[:, :3], table[:, 3:6], table[:, 6:9] = place, axis, intensity
    table[:, 9], table[:, 10], table[:, 11] = exponent, radius_mm, level
    if absorbs is not None:
        table[:, 12:15], table[:, 15] = absorbs, leak
    return _checked(table, "table")


def _checked(table: NDArray[np.float32], where: str) -> NDArray[np.float32]:
    bare, filmed = len(LED_COLUMNS), len(LED_COLUMNS) + len(FILM_COLUMNS)
    if table.ndim != 2 or table.shape[1] not in (bare, filmed) or not len(table):
        raise ValueError(
            f"ledarray, {where}: got shape {table.shape}, expected (N, {bare}) or (N, {filmed})"
        )
    axes = [table[:, 3:6]] + ([table[:, 12:15]] if table.shape[1] == filmed else [])
    length = np.linalg.norm(np.concatenate(axes), axis=1)
    light = np.delete(table[:, 6:], np.s_[6:9], axis=1)  # without the polarizers' axes
    if not np.isfinite(table).all() or np.abs(length - 1.0).max() > 1e-3 or light.min() < 0:
        raise ValueError(
            f"ledarray, {where}: got values that are not finite, negative light or axes of length "
            f"{length.min():g} to {length.max():g}; expected finite numbers, >= 0, unit axes"
        )
    return table


def _radii(table: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return two perpendicular radii of each LED's disc, mm, shape (N, 3) each."""
    axis = table[:, 3:6]
    helper = np.where(np.abs(axis[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(helper, axis)
    side *= table[:, 10:11] / np.linalg.norm(side, axis=1, keepdims=True)
    return side.astype(np.float32), np.cross(axis, side).astype(np.float32)


class _LedArray:
    """LEDs; see the module."""

    mi: Any
    dr: Any

    def __init__(self, properties: Any) -> None:
        mi = self.mi
        self.mi.Emitter.__init__(self, properties)
        if "filename" in properties:
            name = mi.file_resolver().resolve(str(properties["filename"]))
            rows = np.loadtxt(Path(str(name)), delimiter=",", skiprows=1, ndmin=2)
            table = _checked(rows.astype(np.float32), str(name))
        else:
            table = np.array(properties["table"], np.float32)
            table = _checked(table.reshape(table.shape[:2]), "table")
        self.m_flags = +mi.EmitterFlags.DeltaPosition
        self.set_table(table)

    def set_table(self, table: ArrayLike) -> None:
        """Replace the LEDs by the rows of a table, shape (N, 12) or (N, 16)."""
        mi = self.mi
        self.table = np.asarray(table, np.float32)
        self.count = len(self.table)
        self._columns = [mi.Float(pad_memory(column)) for column in self.table.T]
        self._rows = np.column_stack([self.table[:, :6], *_radii(self.table), self.table[:, 9]])
        self._frames = [
            [mi.Float(pad_memory(column)) for column in self._rows[:, k : k + 3].T]
            for k in (0, 3, 6, 9)
        ]
        filmed = self.table.shape[1] > len(LED_COLUMNS)
        self._films = self.table[:, 12:] if filmed else None
        self._passed = 0.5 * (1.0 + self.table[:, 15]) if filmed else np.ones(self.count)
        power = self.table[:, 6:9].sum(axis=1) * self.table[:, 11]
        least = 1e-12 * max(float(power.max()), 1e-20)  # a rig may be dark
        self._chosen = mi.DiscreteDistribution(mi.Float(pad_memory(power + np.float32(least))))

    def traverse(self, callback: Any) -> None:
        mi = self.mi
        for name, column in zip(LED_COLUMNS + FILM_COLUMNS, self._columns, strict=False):
            callback.put(name, column, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: list[str]) -> None:
        """Take the values that `mi.traverse` changed; they are checked as a table's are."""
        del keys
        changed = np.stack([np.array(column, np.float32) for column in self._columns], axis=1)
        self.set_table(_checked(changed, "parameters"))

    def to_string(self) -> str:
        return f"LedArray[{self.count} LEDs]"

    def toward(self, point: Any, led: int, u: Any, v: Any) -> tuple[Any, Any, Any]:
        """Return ways from points to an LED's center and to a point of its disc, and its lobe.

        `u` and `v` are coordinates in the unit disc. The lobe is relative to the axis, behind the
        polarizer, and has no distance in it.
        """
        mi, dr = self.mi, self.dr
        # opaque numbers: one kernel serves all LEDs
        row = [dr.opaque(mi.Float, float(value)) for value in self._rows[led]]
        center, axis, side, other = (mi.Vector3f(*row[k : k + 3]) for k in (0, 3, 6, 9))
        way = mi.Vector3f(center - point)
        off = -dr.dot(axis, way) * dr.rsqrt(dr.squared_norm(way))
        passed = dr.opaque(mi.Float, self._passed[led])
        lobe = dr.select(off > 0.0, passed * dr.power(dr.maximum(off, 1e-9), row[12]), 0.0)
        return way, way + u * side + v * other, lobe

    def strength(self, led: int) -> NDArray[np.float32]:
        """Return an LED's intensity on its axis times its level, shape (3,)."""
        return np.asarray(self.table[led, 6:9] * self.table[led, 11])

    def filmed(self, to_light: Any, led: int) -> FilmedLight:
        """Return the polarization of an LED's light."""
        mi, dr = self.mi, self.dr
        film = (0.0, 1.0, 0.0, 1.0) if self._films is None else self._films[led]
        x, y, z, leak = (dr.opaque(mi.Float, float(c)) for c in film)
        return FilmedLight(dr, to_light, mi.Vector3f(x, y, z), leak)

    def _color(self, led: Any) -> Any:
        mi, dr = self.mi, self.dr
        level = dr.gather(mi.Float, self._columns[11], led)
        parts = [dr.gather(mi.Float, column, led) * level for column in self._columns[6:9]]
        if dr.size_v(mi.UnpolarizedSpectrum) == 3:
            return mi.UnpolarizedSpectrum(*parts)
        return mi.UnpolarizedSpectrum((parts[0] + parts[1] + parts[2]) / 3.0)

    def sample_direction(self, it: Any, sample: Any, active: Any = True) -> tuple[Any, Any]:
        mi, dr = self.mi, self.dr
        led, rest, share = self._chosen.sample_reuse_pmf(sample.x, active)
        disc = mi.warp.square_to_uniform_disk(mi.Point2f(rest, sample.y))
        place, axis, side, other = (
            mi.Vector3f(*(dr.gather(mi.Float, column, led) for column in columns))
            for columns in self._frames
        )
        way = place + disc.x * side + disc.y * other - it.p
        squared = dr.squared_norm(way)
        out = dr.zeros(mi.DirectionSample3f)
        out.p, out.dist, out.pdf = mi.Point3f(it.p + way), dr.sqrt(squared), share
        out.d = way / out.dist
        out.n, out.time, out.delta = mi.Normal3f(-out.d), it.time, True
        out.emitter = mi.EmitterPtr(self)
        exponent = dr.gather(mi.Float, self._columns[9], led)
        off = -dr.dot(axis, out.d)
        lobe = dr.select(off > 0.0, dr.power(dr.maximum(off, 1e-9), exponent), 0.0)
        weight = self._color(led) * (lobe / (squared * share))
        weight = dr.select(mi.Bool(active) & (lobe > 0.0), weight, 0.0)
        if self._films is None:
            return out, mi.depolarizer(weight)
        x, y, z, leak = (dr.gather(mi.Float, column, led) for column in self._columns[12:])
        weight *= 0.5 * (1.0 + leak)
        light = FilmedLight(dr, out.d, mi.Vector3f(x, y, z), leak)
        return out, filmed_spectrum(mi, weight, light)

    def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        mi = self.mi
        return mi.Float(0.0)

    def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
        mi = self.mi
        return mi.depolarizer(mi.UnpolarizedSpectrum(0.0))

    def eval(self, si: Any, active: Any = True) -> Any:
        mi = self.mi
        return mi.depolarizer(mi.UnpolarizedSpectrum(0.0))

    def bbox(self) -> Any:
        mi = self.mi
        places = self.table[:, :3]
        low, high = places.min(axis=0), places.max(axis=0)
        return mi.ScalarBoundingBox3f(low.tolist(), high.tolist())


def define_led_array(mi: Any) -> Any:
    """Return the class of the emitter for Mitsuba's active variant.

    Parameters
    ----------
    mi
        The module ``mitsuba`` with a variant.
    """
    return define_plugin(mi, mi.Emitter, _LedArray)


def disc_points(count: int) -> tuple[Float32Array, Float32Array]:
    """Return points of the unit disc, shape (count,) each, in a low-discrepancy order.

    The additive sequence of the plastic number is mapped to the disc with uniform density: the
    radius is the square root of one coordinate, so that equal areas receive equal numbers.
    """
    index = np.arange(count)
    u, v = (
        (0.5 + index * INVERSE_PLASTIC_NUMBER) % 1.0,
        (0.5 + index * INVERSE_PLASTIC_NUMBER**2) % 1.0,
    )
    radius, angle = np.sqrt(u), 2.0 * np.pi * v
    return (radius * np.cos(angle)).astype(np.float32), (radius * np.sin(angle)).astype(np.float32)
