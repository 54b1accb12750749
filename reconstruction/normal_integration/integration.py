"""Integrate normals to heights by weighted least squares.

Works over any mask, for parallel rays or a pinhole camera. See `discontinuities` for surfaces with
jumps, `height_filters` for filters of heights and slopes, `relief_errors` for standard errors.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, ndimage

from model.checks import Checks
from model.solver_outcome import SolverOutcome
from reconstruction.arrays import BoolArray, Float64Array, FloatArray, Int32Array
from reconstruction.normal_integration import slope_fields
from reconstruction.normal_integration.height_filters import denoise_slopes
from reconstruction.normal_integration.slope_fields import Perspective, SlopeField
from reconstruction.normal_integration.weighted_poisson import (
    IntegrationError,
    MultigridHierarchy,
    solve_poisson,
)
from reconstruction.normal_maps import NormalMaps

Method = Literal["auto", "multigrid", "dct"]


class ConvergenceError(IntegrationError, ArithmeticError):
    """The equations were not solved to the tolerance within the iterations allowed."""


@dataclass(frozen=True, slots=True)
class IntegrationSettings:
    """Numerical settings of an integration.

    Attributes
    ----------
    tolerance : float
        Residual of the normal equations over their right side, in (0, 1).
    iterations : int
        Largest number of conjugate gradient iterations, >= 1.
    order : int
        Order of the quadrature between pixels: 4, or 2 for the mean of two neighbors.
    min_ray_cosine : float
        Least cosine between normal and ray of a usable pixel, in (0, 1). Steps of depth lie in
        grazing pixels: 0.002 keeps most of them, with slopes of up to 500.
    """

    tolerance: float = 1e-5
    iterations: int = 1000
    order: int = 4
    min_ray_cosine: float = slope_fields.MIN_RAY_COSINE

    def __post_init__(self) -> None:
        """Refuse settings out of range."""
        Checks(IntegrationError).settings(self, tolerance="(0, 1)", iterations="[1, inf)")
        Checks(IntegrationError).settings(self, min_ray_cosine="(0, 1)")
        Checks(IntegrationError).choice("Settings.order", self.order, (2, 4))


@dataclass(frozen=True, slots=True)
class HeightMap:
    """Height with its mask, connected parts and convergence.

    Attributes
    ----------
    height : ndarray, shape (H, W)
        Towards the camera (+z), in the unit of `pixel`; mean 0 over each connected part, whose
        constant normals do not determine; 0 where `valid` is False.
    valid : ndarray of bool, shape (H, W)
        Pixels of the mask whose normal faces the camera.
    part : ndarray of int32, shape (H, W)
        Number of the connected part (by rows and columns, not diagonally), from 1; 0 outside.
    convergence : SolverOutcome
        See `solve_poisson`.
    """

    height: FloatArray
    valid: BoolArray
    part: Int32Array
    convergence: SolverOutcome


def integrate(
    normals: FloatArray | NormalMaps,
    *,
    pixel: float = 1.0,
    valid: BoolArray | None = None,
    stderr_rad: ArrayLike | None = None,
    y_up: bool = True,
    camera: Perspective | None = None,
    method: Method = "auto",
    denoise: float = 0.0,
    settings: IntegrationSettings | None = None,
) -> FloatArray:
    """Integrate normals to the height whose slopes fit them best.

    Parameters
    ----------
    normals : ndarray, shape (..., H, W, 3), or NormalMaps of (H, W)
        Outward, any length but 0, z towards the camera. `valid` and `stderr_rad` of `NormalMaps`
        are defaults of those here (`valid` applies in addition). Maps of a stack are integrated
        separately.
    pixel : float
        Size of a pixel on the surface; its unit is that of the height. Under perspective, at the
        mean height, so that the camera's distance is `pixel * focal_px`.
    valid : ndarray of bool, shape (..., H, W), optional
        Pixels to integrate. Those whose normal is 0, not finite or more than 89.9 degrees from
        the ray (`IntegrationSettings.min_ray_cosine`) are omitted in addition.
    stderr_rad : float or ndarray, shape (..., H, W), optional
        Standard error of the normals, rad (root mean square angle). Slopes are then weighted by
        their inverse variance, which rises towards the horizon. Errors are clipped to a thousandth
        and a thousandfold of their median. None: equal weights.
    y_up : bool
        Whether n_y > 0 leans to the image's top (row 0); False: to its bottom.
    camera : Perspective, optional
        None: parallel rays.
    method : {"auto", "multigrid", "dct"}
        "dct" needs a full rectangle without standard errors, which "auto" solves that way.
    denoise : float
        Strength of `height_filters.denoise_slopes` before integration, 0: none, 1: by the
        stated noise; needs standard errors.
    settings : IntegrationSettings, optional

    Returns
    -------
    ndarray, shape (..., H, W)
        In the unit of `pixel`, float32 for normals in float32, else float64; mean 0 over each
        connected part, 0 outside.

    Raises
    ------
    IntegrationError
        For shapes or settings that do not fit, or without any usable normal.
    ConvergenceError
        Where the iterations do not suffice.

    Notes
    -----
    Minimizes sum a_e (h_q - h_p - d_e)^2 over neighbors p, q with d_e the integral of slope
    between them (Quéau, Durou and Aujol 2018, doi 10.1007/s10851-017-0773-x, for the problem
    and its variants). Fields with curl are projected: their solenoidal part is discarded.

    Examples
    --------
    A plane that falls by a tenth to the right and rises to the top, on pixels of 5 um:

    >>> import numpy as np
    >>> normals = np.broadcast_to([0.1, -0.2, 1.0], (3, 4, 3))
    >>> height = integrate(normals, pixel=5.0)
    >>> np.round(np.diff(height, axis=1)[0], 6), np.round(np.diff(height, axis=0)[:, 0], 6)
    (array([-0.5, -0.5, -0.5]), array([-1., -1.]))
    """
    one = partial(
        integrate_map,
        pixel=pixel,
        y_up=y_up,
        camera=camera,
        method=method,
        denoise=denoise,
        settings=settings,
    )
    if isinstance(normals, NormalMaps) or np.ndim(normals) <= 3:
        return _converged(one(normals, valid=valid, stderr_rad=stderr_rad))
    stack = np.asarray(normals)
    masks = _for_each("valid", valid, stack.shape[:-1])
    errors = _for_each("stderr_rad", stderr_rad, stack.shape[:-1])
    out = np.empty(stack.shape[:-1], np.float32 if stack.dtype == np.float32 else float)
    for at in np.ndindex(stack.shape[:-3]):
        out[at] = _converged(one(stack[at], valid=masks(at), stderr_rad=errors(at)))
    return out


def _converged(found: HeightMap) -> FloatArray:
    if not found.convergence.converged:
        raise ConvergenceError(
            f"iterations: residual {found.convergence.residual:.1e} after "
            f"{found.convergence.iterations}; allow more iterations, or set a larger tolerance"
        )
    return found.height


def _for_each(
    name: str, values: Any, shape: tuple[int, ...]
) -> Callable[[tuple[int, ...]], NDArray[Any] | None]:
    """Return the part of an argument for each map of a stack: None, a number, or an array."""
    if values is None:
        return lambda at: None
    given = np.asarray(values)
    if not given.ndim:
        return lambda at: given
    spread = Checks(IntegrationError).broadcast(name, given, shape)
    return lambda at: spread[at]


def integrate_map(
    normals: FloatArray | NormalMaps,
    *,
    pixel: float = 1.0,
    valid: BoolArray | None = None,
    stderr_rad: ArrayLike | None = None,
    y_up: bool = True,
    camera: Perspective | None = None,
    method: Method = "auto",
    denoise: float = 0.0,
    settings: IntegrationSettings | None = None,
) -> HeightMap:
    """Integrate one map as `integrate` does; return height, mask, parts and convergence.

    Parameters
    ----------
    normals, pixel, valid, stderr_rad, y_up, camera, method, denoise, settings
        See `integrate`.

    Returns
    -------
    HeightMap

    Raises
    ------
    IntegrationError
        See `integrate`; an unsolved system is reported by `convergence` instead.
    """
    Checks(IntegrationError).within("pixel", pixel, "(0, inf)")
    chosen = settings or IntegrationSettings()
    slopes = slope_fields.from_normals(
        normals,
        valid=valid,
        stderr_rad=stderr_rad,
        y_up=y_up,
        camera=camera,
        min_ray_cosine=chosen.min_ray_cosine,
    )
    if denoise:
        slopes = denoise_slopes(slopes, strength=denoise)
    plain = slopes.variance_x.size == 1 and bool(slopes.valid.all())
    if method == "dct" and not plain:
        raise IntegrationError(
            'method: got "dct" with a mask or standard errors, expected "multigrid"'
        )
    Checks(IntegrationError).choice("method", method, ("auto", "multigrid", "dct"))
    if plain and method != "multigrid":
        relief, convergence = _by_cosines(slopes, chosen), SolverOutcome(0, 0.0, 1.0, "tolerance")
    else:
        relief, convergence = _by_multigrid(slopes, chosen)
    part = label_parts(slopes.valid)
    kind = np.asarray(normals.normals if isinstance(normals, NormalMaps) else normals).dtype
    height = to_height(relief, part, pixel=pixel, camera=camera)
    return HeightMap(
        height.astype(np.float32) if kind == np.float32 else height, slopes.valid, part, convergence
    )


def _by_multigrid(
    slopes: SlopeField, settings: IntegrationSettings
) -> tuple[Float64Array, SolverOutcome]:
    ax, ay, dx, dy = slope_fields.edges(slopes, order=settings.order)
    x = np.zeros(dx.shape)
    convergence = solve_poisson(
        MultigridHierarchy(ax, ay),
        dx,
        dy,
        x,
        tolerance=settings.tolerance,
        iterations=settings.iterations,
    )
    return x[1:-1, 1:-1], convergence


def _by_cosines(slopes: SlopeField, settings: IntegrationSettings) -> Float64Array:
    """Solve the same equations on a full rectangle, whose eigenvectors are cosines (DCT)."""
    _, _, dx, dy = slope_fields.edges(slopes, order=settings.order)
    b = dx[1:-1, :-2] - dx[1:-1, 1:-1] + dy[:-2, 1:-1] - dy[1:-1, 1:-1]
    rows, columns = b.shape
    waves = fft.dctn(b, type=2, norm="ortho", workers=2, overwrite_x=True)
    of_row = 4.0 * np.sin(0.5 * np.pi * np.arange(rows) / rows) ** 2
    of_column = 4.0 * np.sin(0.5 * np.pi * np.arange(columns) / columns) ** 2
    of_row[0] = np.inf if rows * columns == 1 else of_row[0]
    eigenvalues = of_row[:, None] + of_column[None, :]
    eigenvalues[0, 0] = np.inf  # the constant is undetermined: 0
    waves /= eigenvalues
    return np.asarray(fft.idctn(waves, type=2, norm="ortho", workers=2, overwrite_x=True))


def label_parts(valid: BoolArray) -> Int32Array:
    """Return the number of each pixel's connected part, from 1; 0 where not valid."""
    if valid.all():
        return np.ones(valid.shape, np.int32)
    return np.asarray(ndimage.label(valid)[0], np.int32)


def to_height(
    relief: Float64Array, part: Int32Array, *, pixel: float, camera: Perspective | None
) -> Float64Array:
    """Return height from a solution in pixels: mean 0 over each part, 0 outside.

    Under perspective the solution is -f log(depth) with a free constant in each part.
    """
    relief = _centered(relief, part)
    if camera is None:
        return np.asarray(pixel * relief)
    depth = np.exp(relief / -camera.focal_px)
    away = -camera.focal_px * pixel
    return _centered(away * (depth / _means(depth, part)[part]), part)


def _means(values: Float64Array, part: Int32Array) -> Float64Array:
    count = np.bincount(part.ravel())
    total = np.bincount(part.ravel(), weights=values.ravel())
    return np.asarray(total / np.maximum(count, 1))


def _centered(values: Float64Array, part: Int32Array) -> Float64Array:
    if part[0, 0] == 1 and (part == 1).all():
        return np.asarray(values - values.mean())
    return np.asarray(np.where(part > 0, values - _means(values, part)[part], 0.0))
