"""Kernels of displacement maps under strain: parameters by stretch ratio (Nagano et al. 2015).

The strain of a mesh is `model.microstructure.mesh_strain`, its fields on a texture
`model.microstructure.strain_fields`, the convolution `model.microstructure.convolution`; `strain`
and `convolve` are re-exported here.

A neutral displacement map is convolved along the axis of strain with ``k = (1 - alpha) delta +
alpha G(sigma)`` (eq. 6): alpha > 0 blurs, alpha < 0 sharpens. A :class:`KernelTable` maps a stretch
ratio to alpha and sigma.

References
----------
Nagano et al. 2015, Skin Microstructure Deformation with Displacement Map Convolution, ACM Trans.
Graph. 34(4), 109. doi:10.1145/2766894
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from model.arrays import BoolArray, Float64Array
from model.checks import Checks
from model.checks.files import decode_json
from model.microstructure.convolution_kernels import TRUNCATE_SIGMAS

Line: TypeAlias = tuple[float, float]
"""Slope and intercept of a line over the stretch ratio."""

ALPHA_LIMITS = (-2.0, 1.0)
"""Range of the kernel's strength (Nagano2015, below eq. 6)."""
TABLE_SCHEMA = "skinrig.kernel-table/1"


MAX_WIDTH_PX = 1e6
"""Upper limit of sigma, px: wider than any map, and the weights still fit into memory."""


class KernelTableError(ValueError):
    """Error for an inconsistent table of kernels, or a stretch outside its range."""


def gaussian_weights(sigma_px: float) -> Float64Array:
    """Return the right half of the normalized discrete Gaussian, its center first.

    The continuous Gaussian at whole pixels up to ``TRUNCATE_SIGMAS`` sigmas, divided by its sum.
    Far below one pixel it is the delta function to machine precision, and blurs nothing.

    Parameters
    ----------
    sigma_px : float
        Standard deviation, px, above 0, up to `MAX_WIDTH_PX`.

    Returns
    -------
    ndarray, shape (R + 1,)
        ``w[0] + 2 * w[1:].sum() == 1``.

    Examples
    --------
    >>> gaussian_weights(0.7).round(4).tolist()
    [0.5698, 0.2054, 0.0096, 0.0001]
    >>> gaussian_weights(0.1).tolist()
    [1.0]
    """
    Checks().within("sigma_px", sigma_px, f"(0, {MAX_WIDTH_PX}]")
    k = np.arange(int(TRUNCATE_SIGMAS * sigma_px + 0.5) + 1)
    w = np.exp(-0.5 * (k / sigma_px) ** 2)
    return w / (w[0] + 2.0 * w[1:].sum())


@dataclass(frozen=True, slots=True)
class KernelTable:
    """Kernel parameters of one kind of skin by the stretch ratio r, piecewise linear in it.

    Attributes
    ----------
    alpha_breaks : tuple of float
        Stretch ratios between neighboring lines of alpha, increasing; empty for one line.
    alpha_lines : tuple of (slope, intercept)
        One more than breaks; they meet at the breaks, and alpha(1) = 0. The value is clamped to
        `ALPHA_LIMITS`, as in the kernel's definition.
    sigma_compression_um, sigma_stretch_um : (slope, intercept) or None
        Lines of sigma over r, um, for r < 1 and for r >= 1; None: that side was not measured.
    stretch_range : tuple of float
        Lowest and highest stretch ratio that the lines were fitted to.
    source : str
        Where the numbers come from.
    """

    alpha_breaks: tuple[float, ...]
    alpha_lines: tuple[Line, ...]
    sigma_compression_um: Line | None
    sigma_stretch_um: Line | None
    stretch_range: tuple[float, float]
    source: str

    def __post_init__(self) -> None:
        """Raise for lines that do not meet, miss (1, 0), or have a sigma of 0 in the range."""
        for name in ("alpha_breaks", "stretch_range"):
            object.__setattr__(self, name, tuple(float(v) for v in getattr(self, name)))
        object.__setattr__(
            self, "alpha_lines", tuple((float(a), float(b)) for a, b in self.alpha_lines)
        )
        low, high = self.stretch_range
        if not 0 < low <= high < math.inf:
            raise KernelTableError(
                f"stretch_range: got {self.stretch_range}, expected 0 < lowest <= highest"
            )
        if len(self.alpha_lines) != len(self.alpha_breaks) + 1:
            raise KernelTableError(
                f"alpha_lines: got {len(self.alpha_lines)}, expected one more than "
                f"{len(self.alpha_breaks)} breaks"
            )
        if not np.isfinite([*self.alpha_breaks, *np.ravel(self.alpha_lines)]).all():
            raise KernelTableError("alpha_lines, alpha_breaks: got NaN or infinity")
        if any(b <= a for a, b in zip(self.alpha_breaks, self.alpha_breaks[1:], strict=False)):
            raise KernelTableError(f"alpha_breaks: got {self.alpha_breaks}, expected increasing")
        for number, r in enumerate(self.alpha_breaks):
            (m0, c0), (m1, c1) = self.alpha_lines[number : number + 2]
            if abs(m0 * r + c0 - m1 * r - c1) > 1e-6 * (1 + abs(m0) + abs(m1)):
                raise KernelTableError(f"alpha_lines: lines {number} and {number + 1} do not meet")
        if abs(self.unlimited_alpha(np.array([1.0]))[0]) > 1e-9:
            raise KernelTableError("alpha_lines: got alpha(1) != 0, expected the neutral kernel")
        ends = {
            "sigma_compression_um": (low, min(high, 1.0)),
            "sigma_stretch_um": (max(low, 1.0), high),
        }
        for name, (first, last) in ends.items():
            line = getattr(self, name)
            if line is None:
                if first < last:
                    raise KernelTableError(f"{name}: got None, but {first:g}...{last:g} is covered")
                continue
            m, c = (float(v) for v in line)
            object.__setattr__(self, name, (m, c))
            if first <= last and not (m * first + c > 0 and m * last + c > 0):
                raise KernelTableError(f"{name}: got sigma <= 0 um within {first:g}...{last:g}")

    def unlimited_alpha(self, r: Float64Array) -> Float64Array:
        """Return the lines of alpha at stretch ratios r, not clamped to `ALPHA_LIMITS`."""
        line = (
            np.searchsorted(self.alpha_breaks, r) if self.alpha_breaks else np.zeros(r.shape, int)
        )
        m, c = np.asarray(self.alpha_lines).T
        return m[line] * r + c[line]

    def sigma_lines_um(self) -> tuple[Line, Line]:
        """Return sigma's lines for r < 1 and r >= 1; a side that was not measured has the other's.

        Raises
        ------
        KernelTableError
            For a table with neither.
        """
        below = self.sigma_compression_um or self.sigma_stretch_um
        above = self.sigma_stretch_um or self.sigma_compression_um
        if below is None or above is None:
            raise KernelTableError("table: got no line for sigma, expected at least one side")
        return below, above

    def inside(self, stretch: ArrayLike) -> BoolArray:
        """Return whether each stretch ratio is in the fitted range."""
        r = np.asarray(stretch, np.float64)
        return (r >= self.stretch_range[0]) & (r <= self.stretch_range[1])

    def to_json(self) -> str:
        """Return the table as one JSON object."""
        fields = {name: getattr(self, name) for name in self.__slots__}
        return json.dumps({"schema": TABLE_SCHEMA, **fields}, indent=1)

    @classmethod
    def from_json(cls, text: str) -> KernelTable:
        """Read a table from the JSON text of :meth:`to_json`.

        Raises
        ------
        KernelTableError
            For text that is not a table, unknown or missing keys, or an inconsistent table.
        """
        try:
            given: Any = decode_json(text)
        except ValueError as error:
            raise KernelTableError(f"table: got text that is not JSON: {error}") from error
        if not isinstance(given, dict) or given.get("schema") != TABLE_SCHEMA:
            got = given.get("schema") if isinstance(given, dict) else type(given).__name__
            raise KernelTableError(f"schema: got {got!r}, expected {TABLE_SCHEMA!r}")
        wrong = sorted(set(given) ^ {*cls.__slots__, "schema"})
        if wrong:
            raise KernelTableError(f"keys: unknown or missing: {', '.join(wrong)}")
        del given["schema"]
        try:
            return cls(**given)
        except KernelTableError:
            raise
        except (TypeError, ValueError, OverflowError) as error:
            raise KernelTableError(f"table: got values of a wrong kind: {error}") from error


_SLOPE_LOW, _INTERCEPT_LOW, _SLOPE_HIGH = 15.4, -13.8, 3.09  # eq. (8)

FOREHEAD = KernelTable(
    alpha_breaks=((-_SLOPE_HIGH - _INTERCEPT_LOW) / (_SLOPE_LOW - _SLOPE_HIGH),),  # of the minimum
    alpha_lines=((_SLOPE_LOW, _INTERCEPT_LOW), (_SLOPE_HIGH, -_SLOPE_HIGH)),
    sigma_compression_um=(70.5, -46.9),  # eq. (9), r < 1
    sigma_stretch_um=(38.2, -26.5),  # eq. (9), r >= 1
    stretch_range=(0.73, 1.28),  # fig. 11
    source="forehead of Nagano et al. 2015, eqs. (8) and (9), doi 10.1145/2766894",
)
"""The paper's own table; alpha = min(1, 15.4 r - 13.8, 3.09 (r - 1)), then at least -2."""


@dataclass(frozen=True, slots=True)
class KernelPoints:
    """Kernels fitted at some stretch ratios.

    Attributes
    ----------
    stretch, alpha, sigma_um : tuple of float
        One entry per point: ratio along the jaws, strength, standard deviation in um.
    """

    stretch: tuple[float, ...]
    alpha: tuple[float, ...]
    sigma_um: tuple[float, ...]


@cache
def forehead_points() -> KernelPoints:
    """Return the eight fitted points of one forehead: Nagano2015, figure 11.

    Examples
    --------
    >>> points = forehead_points()
    >>> points.stretch[0], points.alpha[0], points.sigma_um[0]
    (0.73, -2.0, 6.5)
    """
    text = resources.files("model").joinpath("data/nagano2015_fig11.csv").read_text("utf-8")
    rows = [line for line in text.splitlines() if line and not line.startswith("#")]
    values = [tuple(float(v) for v in row.split(",")) for row in rows[1:]]
    r, alpha, sigma = zip(*values, strict=True)
    return KernelPoints(r, alpha, sigma)


def kernel_parameters(
    stretch: ArrayLike,
    table: KernelTable = FOREHEAD,
    *,
    extrapolate: Literal["hold", "formula", "refuse"] = "hold",
) -> tuple[Float64Array, Float64Array]:
    """Return the kernel parameters at stretch ratios.

    Parameters
    ----------
    stretch : array_like
        Ratios r > 0 of lengths along the axis: above 1 stretched, below 1 compressed.
    table : KernelTable
        Table of the skin; the paper's forehead by default (eqs. 8 and 9).
    extrapolate : {"hold", "formula", "refuse"}
        Treatment outside the fitted range (see ``table.inside(stretch)``). "hold" takes the values
        of the nearest end. "formula" extends the lines: eq. (9) then has sigma = 0 at and below r =
        0.665, which switches sharpening off where skin is most compressed. "refuse" raises an
        error.

    Returns
    -------
    alpha, sigma_um : ndarray of float64
        Of the shape of ``stretch``: strength in [-2, 1], standard deviation in um, >= 0 (0 by
        "formula" only, and then nothing is convolved). alpha is exactly 0 at r = 1, where sigma
        jumps from one line to the other.

    Raises
    ------
    KernelTableError
        For a stretch beyond the range with "refuse", or one that is not finite and positive.

    Examples
    --------
    >>> alpha, sigma_um = kernel_parameters([0.5, 0.8, 1.0, 1.2])
    >>> alpha.round(3).tolist(), sigma_um.round(2).tolist()
    ([-2.0, -1.48, 0.0, 0.618], [4.56, 9.5, 11.7, 19.34])
    """
    Checks().choice("extrapolate", extrapolate, ("hold", "formula", "refuse"))
    r = np.asarray(stretch, np.float64)
    Checks(KernelTableError).within("stretch", r, "(0, inf)")
    low, high = table.stretch_range
    if extrapolate == "refuse" and not table.inside(r).all():
        raise KernelTableError(
            f"stretch: got {r.min():g}...{r.max():g}, expected {low:g}...{high:g}, where "
            'the table was measured; extrapolate="hold" gives the values at its ends'
        )
    if extrapolate == "hold":
        r = np.clip(r, low, high)
    # a table's alpha(1) may have a rounding error; neutral skin must not change at all
    alpha = np.where(r == 1.0, 0.0, np.clip(table.unlimited_alpha(r), *ALPHA_LIMITS))
    below, above = table.sigma_lines_um()
    sigma = np.where(r < 1.0, below[0] * r + below[1], above[0] * r + above[1])
    return alpha, np.maximum(sigma, 0.0)
