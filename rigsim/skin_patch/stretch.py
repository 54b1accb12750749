"""Stretch or compress a patch of skin between jaws, and sample its surface in the rig frame.

The mechanics and the search for equilibrium are in `rigsim.skin_patch.equilibrium`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft
from scipy.ndimage import spline_filter

from rigsim.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from rigsim.skin_patch.equilibrium import Convergence, LayerProblem, find_equilibrium
from rigsim.skin_patch.microrelief import MicroSkin
from rigsim.skin_patch.stretch_kernels import evaluate_spline

Compensation = Literal["volume", "none"] | float

STRETCH_RANGE: Final = (0.5, 2.0)
FORCE_TOLERANCE: Final = 5e-3
"""Accepted out-of-balance force, relative to that of a relief without a layer."""
BLEND_UM: Final = 320.0
"""Smallest width of the mirror image that continues the patch beyond its border, um."""


class StretchError(ValueError):
    """Error for a stretch outside the range of skin, or one that the patch does not cover."""


@dataclass(frozen=True, slots=True)
class SurfaceSample:
    """The surface at points; arrays have the points' shape. 0 where not `inside`."""

    height_um: Float32Array
    """Height above the mean plane, um."""
    slope_x: Float32Array
    """dh/dx of the interpolated height, dimensionless."""
    slope_y: Float32Array
    """dh/dy, y up."""
    albedo: Float32Array
    """Diffuse reflectance, 0 to 1."""
    alpha: Float32Array
    """GGX roughness of facets below 10 um."""
    inside: BoolArray
    """Whether the point is on the patch."""


@dataclass(frozen=True, slots=True, eq=False)
class StretchedSkin:
    """A patch in equilibrium under a stretch; frame of the rig, origin in the patch's middle."""

    skin: MicroSkin
    stretch_s: float
    """Stretch r along the jaws' axis."""
    stretch_t: float
    """Stretch across."""
    angle_deg: float
    """Direction of the jaws' axis from +x towards +y, degrees."""
    gradient: Float64Array
    """Mean deformation gradient F, (2, 2): a point X of the neutral skin is at F X."""
    height_um: Float32Array
    """Height over the affinely moved grid of the neutral texels, (N, N), row 0 is +y."""
    albedo: Float32Array
    """On the same grid."""
    alpha: Float32Array
    displacement_um: Float32Array
    """Displacement of the neutral texels from F X, in the rig's x and y, (N, N, 2), um."""
    excess_length: float
    """Mean length of lines along the jaws' axis over their projection, less 1."""
    neutral_excess_length: float
    """The same before the stretch."""
    convergence: Convergence
    _coefficients: Float64Array = field(repr=False)
    _pigment: Float64Array = field(repr=False)

    @property
    def membrane_strain(self) -> float:
        """Return the relative elongation of surface lines along the jaws' axis.

        0 if the relief's excess length alone followed the jaws, `stretch_s` - 1 if none did.
        """
        return self.stretch_s * (1.0 + self.excess_length) / (1.0 + self.neutral_excess_length) - 1

    def sample(self, x_mm: ArrayLike, y_mm: ArrayLike) -> SurfaceSample:
        """Return the surface at points of the rig frame.

        Parameters
        ----------
        x_mm, y_mm
            Points, y up, mm; same shape or broadcast against each other.

        Returns
        -------
        SurfaceSample
            Height and albedo by cubic B-splines, so that slopes are continuous and exactly those
            of the height; alpha bilinear.
        """
        x, y = np.broadcast_arrays(np.asarray(x_mm, np.float64), np.asarray(y_mm, np.float64))
        count, texel = self._coefficients.shape[0], self.skin.texel_um
        inverse = np.linalg.inv(self.gradient) * (1e3 / texel)
        middle = 0.5 * (count - 1)
        column = (inverse[0, 0] * x + inverse[0, 1] * y + middle).reshape(-1)
        row = (middle - inverse[1, 0] * x - inverse[1, 1] * y).reshape(-1)
        height, by_row, by_column = (np.empty(row.size) for _ in range(3))
        evaluate_spline(self._coefficients, row, column, True, height, by_row, by_column)
        inside = np.isfinite(height)
        for values in (height, by_row, by_column):
            values[~inside] = 0.0
        # Rows grow downwards, Y upwards; inverse already holds texels per mm, heights are um.
        slope_x = 1e-3 * (by_column * inverse[0, 0] - by_row * inverse[1, 0])
        slope_y = 1e-3 * (by_column * inverse[0, 1] - by_row * inverse[1, 1])
        albedo = np.empty(row.size)
        evaluate_spline(self._pigment, row, column, False, albedo, albedo, albedo)
        albedo = np.where(inside, albedo, 0.0)
        alpha = np.where(inside, _bilinear(self.alpha, row, column), 0.0)
        maps = [
            np.asarray(values.reshape(x.shape), np.float32)
            for values in (height, slope_x, slope_y, albedo, alpha)
        ]
        return SurfaceSample(maps[0], maps[1], maps[2], maps[3], maps[4], inside.reshape(x.shape))


def principal_stretches(
    stretch: float, compensation: Compensation = "volume"
) -> tuple[float, float]:
    """Return the stretches along and across the jaws' axis.

    Parameters
    ----------
    stretch
        Along the axis, 0.5 to 2.
    compensation
        Stretch across the axis: "none" keeps the width; "volume" gives r^-1/2, as for a block of
        constant volume and free thickness; a number p, 0 to 1, gives r^-p (1 keeps the area).

    Raises
    ------
    StretchError
        When an argument is outside its range.

    Examples
    --------
    >>> principal_stretches(1.21)[1] == 1.21**-0.5, principal_stretches(1.21, "none")
    (True, (1.21, 1.0))
    """
    if not STRETCH_RANGE[0] <= stretch <= STRETCH_RANGE[1]:
        raise StretchError(f"stretch: got {stretch}, expected {STRETCH_RANGE[0]} to 2")
    if compensation == "volume":
        power = 0.5
    elif compensation == "none":
        power = 0.0
    elif isinstance(compensation, (int, float)) and 0.0 <= compensation <= 1.0:
        power = float(compensation)
    else:
        raise StretchError(f"compensation: got {compensation!r}, expected 'volume', 'none' or 0-1")
    return float(stretch), float(stretch**-power)


def mean_gradient(
    stretch: float, angle_deg: float, compensation: Compensation = "volume"
) -> Float64Array:
    """Return the mean deformation gradient F, symmetric, (2, 2), rig axes.

    Examples
    --------
    >>> mean_gradient(0.64, 90.0).round(3).tolist()
    [[1.25, 0.0], [0.0, 0.64]]
    """
    s, t = principal_stretches(stretch, compensation)
    if not math.isfinite(angle_deg):
        raise StretchError(f"angle_deg: got {angle_deg}, expected a finite angle")
    # A quarter turn is computed exactly, so that states at 0 and 90 degrees have no shear.
    quarter = {0: (1.0, 0.0), 90: (0.0, 1.0)}.get(angle_deg % 180.0)  # type: ignore[call-overload]
    angle = math.radians(angle_deg)
    c, d = quarter or (math.cos(angle), math.sin(angle))
    shear = (s - t) * c * d + 0.0
    return np.array([[s * c * c + t * d * d, shear], [shear, s * d * d + t * c * c]])


def required_size_mm(
    field_mm: float,
    stretch: float | Sequence[float],
    *,
    angle_deg: float | None = None,
    shift_mm: float = 0.0,
) -> float:
    """Return the size of a patch that fills a square field of view, mm.

    Parameters
    ----------
    field_mm
        Side of the field, mm.
    stretch
        The stretch, or all that occur; the smallest one needs the largest patch.
    angle_deg
        Of the jaws; None allows any.
    shift_mm
        Largest distance of the skin's center from the field's.

    Examples
    --------
    >>> required_size_mm(2.0, 1.0, angle_deg=0.0)
    2.04
    >>> required_size_mm(2.0, (0.8, 1.2), angle_deg=0.0) > 2.5
    True
    """
    values = [stretch] if isinstance(stretch, (int, float)) else list(stretch)
    angles = np.arange(0.0, 180.0, 5.0) if angle_deg is None else [angle_deg]
    half = 0.5 * field_mm + shift_mm
    corners = np.array([[half, half], [half, -half]])
    inverses = [np.linalg.inv(mean_gradient(s, float(a))) for s in values for a in angles]
    reach = max(float(np.abs(corners @ inverse).max()) for inverse in inverses)
    return round(2.0 * reach + 0.04, 6)


def stretch_skin(
    skin: MicroSkin,
    *,
    stretch: float,
    angle_deg: float,
    compensation: Compensation = "volume",
    tolerance: float = FORCE_TOLERANCE,
) -> StretchedSkin:
    """Stretch a patch along an axis and find its equilibrium.

    Parameters
    ----------
    skin
        The neutral patch.
    stretch
        Of the skin along the jaws' axis, 0.5 to 2; 1 gives the neutral patch itself.
    angle_deg
        Direction of the axis from +x towards +y, degrees.
    compensation
        Stretch across the axis: see `principal_stretches`.
    tolerance
        Out-of-balance force at which the search for the equilibrium ends, relative to that of the
        affinely deformed relief, 1e-8 to 0.5.

    Returns
    -------
    StretchedSkin

    Raises
    ------
    StretchError
        An argument is outside its range, or the surface would fold over.
    rigsim.skin_patch.equilibrium.EquilibriumError
        When no equilibrium was found.

    Notes
    -----
    The patch is continued by its mirror image, so its border is neither fixed nor free. The layer's
    modulus is `skin.stiffness_ratio` times the tissue's, its thickness `skin.layer_um`; both are
    incompressible when strained quickly; `skin.poisson` describes the drained tissue.

    Examples
    --------
    >>> from rigsim.skin_patch.microrelief import make_micro_skin
    >>> skin = make_micro_skin("cheek", seed=1, size_mm=0.6)
    >>> long = stretch_skin(skin, stretch=1.2, angle_deg=0.0)
    >>> bool(long.excess_length < long.neutral_excess_length)
    True
    """
    if not 1e-8 <= tolerance <= 0.5:
        raise StretchError(f"tolerance: got {tolerance}, expected 1e-8 to 0.5")
    gradient = mean_gradient(stretch, angle_deg, compensation)
    s, t = principal_stretches(stretch, compensation)
    before = _excess_length(skin.height_um, skin.texel_um, np.eye(2), angle_deg)
    made = partial(StretchedSkin, skin, s, t, angle_deg, gradient)
    if s == 1.0 and t == 1.0:
        still = np.zeros((*skin.height_um.shape, 2), np.float32)
        none = Convergence(0, 0.0, math.nan, (), ())
        splines = _coefficients(skin.height_um), _coefficients(skin.albedo)
        return made(skin.height_um, skin.albedo, skin.alpha, still, before, before, none, *splines)
    count = skin.height_um.shape[0]
    mean = float(skin.height_um.mean())
    problem = layer_problem(skin, gradient)
    state, convergence = find_equilibrium(problem, tolerance=tolerance)
    row, column = _pull_back(state[:2], gradient, skin.texel_um, count)
    height = np.empty(row.size)
    evaluate_spline(_spline_coefficients(state[2]), row, column, False, height, height, height)
    # Rows of the equilibrium grow with y.
    height = height.reshape(count, count)[::-1] + problem.rise * mean
    last = count - 1.0
    inner = (
        np.clip(last - (row - _SPLINE_MARGIN), 0.0, last),
        np.clip(column - _SPLINE_MARGIN, 0.0, last),
    )
    tint = np.empty(row.size)
    evaluate_spline(_coefficients(skin.albedo), *inner, False, tint, tint, tint)
    albedo = tint.reshape(count, count)[::-1]
    alpha = _bilinear(skin.alpha, *inner).reshape(count, count)[::-1]
    displacement = np.moveaxis(state[:2, :count, :count], 0, -1)[::-1]
    return made(
        np.asarray(height, np.float32),
        np.asarray(albedo, np.float32),
        np.asarray(alpha, np.float32),
        np.asarray(displacement, np.float32),
        _excess_length(height, skin.texel_um, gradient, angle_deg),
        before,
        convergence,
        _coefficients(height),
        _coefficients(albedo),
    )


_SPLINE_MARGIN: Final = 16
"""Margin of the periodic continuation for splines around a patch, texels."""


def layer_problem(skin: MicroSkin, gradient: Float64Array) -> LayerProblem:
    """Return the mechanical problem of a patch under a mean deformation.

    Parameters
    ----------
    skin
        The neutral patch; its mean height is subtracted.
    gradient
        Mean deformation gradient F, (2, 2).

    Returns
    -------
    LayerProblem
        On a periodic grid whose first N rows (bottom up) and columns are the patch.
    """
    height = skin.height_um[::-1].astype(np.float64)
    height -= height.mean()
    layer = _periodic(skin.layer_um[::-1].astype(np.float64), skin.texel_um)
    neutral = _periodic(height, skin.texel_um)
    # Layer incompressible: shear modulus E / 3, plate modulus E / (1 - 1/4).
    return LayerProblem(
        neutral_um=neutral - neutral.mean(),
        membrane_um=skin.stiffness_ratio / 3.0 * layer,
        bending_um3=skin.stiffness_ratio / 9.0 * layer**3,
        texel_um=skin.texel_um,
        gradient=gradient,
        poisson=skin.poisson,
    )


def _periodic(values: Float64Array, texel_um: float) -> Float64Array:
    """Continue a patch by its mirror images to a periodic grid."""
    count = values.shape[0]
    least = count + min(count // 2 * 2, max(8, math.ceil(BLEND_UM / texel_um)))
    total = least
    while total % 2 or fft.next_fast_len(total, real=True) != total:
        total += 1
    gap = min(total - count, count)
    if gap < total - count:
        total = count + gap
    place = (np.arange(gap) + 1.0) / (gap + 1.0)
    blend = place**3 * (place * (6.0 * place - 15.0) + 10.0)
    for axis in range(2):
        values = np.moveaxis(values, axis, -1)
        behind, before = values[..., ::-1][..., :gap], values[..., :gap][..., ::-1]
        values = np.concatenate([values, behind * (1.0 - blend) + before * blend], axis=-1)
        values = np.moveaxis(values, -1, axis)
    return np.ascontiguousarray(values)


def _coefficients(values: FloatArray) -> Float64Array:
    return np.asarray(spline_filter(np.asarray(values, np.float64), mode="mirror"))


def _spline_coefficients(values: Float64Array) -> Float64Array:
    """Return spline coefficients of a periodic field with a margin all around."""
    return np.asarray(spline_filter(np.pad(values, _SPLINE_MARGIN, mode="wrap"), mode="mirror"))


def _pull_back(
    displacement_um: Float64Array, gradient: Float64Array, texel_um: float, count: int
) -> tuple[Float64Array, Float64Array]:
    """Return the neutral position X of the skin that is now at F Y, for Y on the texels.

    Rows and columns of the padded periodic grid, flat, by Newton's method.
    """
    inverse = np.linalg.inv(gradient) / texel_um
    moved = np.tensordot(inverse, displacement_um, axes=1)
    bent = 1.0 + np.gradient(moved[0], axis=1), 1.0 + np.gradient(moved[1], axis=0)
    shear = np.gradient(moved[0], axis=0) * np.gradient(moved[1], axis=1)
    if (bent[0] * bent[1] - shear).min() <= 0.0:
        raise StretchError(
            "stretch: the surface would fold over its own grooves; give a stretch nearer to 1"
        )
    along, up = _spline_coefficients(moved[0]), _spline_coefficients(moved[1])
    goal_row, goal_column = (
        m.reshape(-1).astype(np.float64) + _SPLINE_MARGIN for m in np.mgrid[0:count, 0:count]
    )
    row, column = goal_row.copy(), goal_column.copy()
    a, ar, ac, b, br, bc = (np.empty(row.size) for _ in range(6))
    for _ in range(30):
        evaluate_spline(along, row, column, True, a, ar, ac)
        evaluate_spline(up, row, column, True, b, br, bc)
        miss_c, miss_r = column + a - goal_column, row + b - goal_row
        far = max(float(np.abs(miss_c).max()), float(np.abs(miss_r).max()))
        if not far > 1e-5:
            break
        ac += 1.0
        br += 1.0
        det = ac * br - ar * bc
        column -= (br * miss_c - ar * miss_r) / det
        row -= (ac * miss_r - bc * miss_c) / det
    if not far <= 1e-4:
        raise StretchError(
            "stretch: the patch is displaced by more than its margin; give a larger patch"
        )
    return row, column


def _bilinear(values: Float32Array, row: Float64Array, column: Float64Array) -> Float64Array:
    count = values.shape[0]
    r, c = np.clip(row, 0.0, count - 1.0), np.clip(column, 0.0, count - 1.0)
    i, j = np.minimum(r.astype(np.intp), count - 2), np.minimum(c.astype(np.intp), count - 2)
    s, t = r - i, c - j
    flat = values.reshape(-1)
    first = i * count + j
    upper = (1.0 - t) * flat[first] + t * flat[first + 1]
    lower = (1.0 - t) * flat[first + count] + t * flat[first + count + 1]
    return np.asarray((1.0 - s) * upper + s * lower)


def _excess_length(
    height_um: FloatArray, texel_um: float, gradient: Float64Array, angle_deg: float
) -> float:
    """Return mean sqrt(1 + slope^2) - 1 of the slope along the jaws' axis."""
    h = height_um.astype(np.float64)
    by_y, by_x = -np.gradient(h, texel_um, axis=0), np.gradient(h, texel_um, axis=1)
    angle = math.radians(angle_deg)
    # d/ds along the axis of the stretched surface, in neutral coordinates: F^-1 times the axis.
    step = np.linalg.inv(gradient) @ np.array([math.cos(angle), math.sin(angle)])
    return float(np.mean(np.sqrt(1.0 + (by_x * step[0] + by_y * step[1]) ** 2)) - 1.0)
