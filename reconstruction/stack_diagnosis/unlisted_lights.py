"""Light directions from images without a list of lights.

The lit samples of a matte surface give lights and normals up to a linear map of nine numbers
(`shading_space`). That the normals are those of a surface z(x, y) fixes six of them (Yuille and
Snow 1997); the rest is the bas-relief ambiguity (Belhumeur, Kriegman and Yuille 1999): a flatter
surface under lower lights has the same images. Lights of equal strength fix it (Hayakawa 1994),
except for one sign: a hollow surface under opposite lights has the same images, too.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion, gaussian_filter, map_coordinates
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from model.checks import Checks
from model.solver_outcome import outcome_from_scipy
from model.vectors import unit_vectors
from reconstruction.arrays import BoolArray, Float64Array, FloatArray
from reconstruction.normal_integration.integration import integrate_map
from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.stack_diagnosis.reduced_stack import ReducedStack, reduce_stack
from reconstruction.stack_diagnosis.shading_space import (
    BRIGHT_QUANTILE,
    HIGHLIGHT_FACTOR,
    SHADOW_FRACTION,
    choose_points,
    fit_shading_space,
)

_LOG = logging.getLogger(__name__)

MIN_FRAMES = 8
"""Equal strengths leave N - 4 residuals, from which the error is estimated."""
MIN_POINTS = 200
MIN_LIT_SAMPLES = 5
MAX_POINT_MISFIT = 0.05
"""Median residual of a pixel's lit samples, over its bright sample, of a matte point."""
MIN_SINGULAR_RATIO = 0.03
"""Ratio of extreme singular values of the light vectors below which the third is noise."""
SMOOTHING_PX = 1.0
N_STEPS = 20
SOFT_STRENGTH = 0.05
"""Deviation from equal strength up to which a light counts fully."""
MIN_STRENGTH_SPREAD = 0.05
"""Of the logarithm: a bas-relief map hides larger differences of real lamps (6 % of a gray ball's).
"""
MIN_INFORMATION = 1e-9
"""Of a parameter of the bas-relief map, where the strengths do not depend on it."""
PROFILE_FACTORS = (0.25, 0.35, 0.5, 0.7, 0.85, 1.2, 1.4, 2.0, 2.8, 4.0)
"""Of the factor on z, at which fits are compared with the best."""
MIN_TILT_DEG = 5.0
"""Lower median angles are the limit in which all strengths are equal whatever the lights."""
START_HEIGHTS = (0.3, 1.0, 3.0)
"""Of the lights over their distance from the axis, from which the fit starts."""
HOLLOW_FACTORS = np.array([-1.0, -1.0, 1.0])
"""Factors on normals and lights that leave all shading as it is."""
DARK_FRACTION = 0.06
"""Of a point's bright sample: darker samples that face the light are in a cast shadow."""
MIN_FACING = 0.2
MIN_DARK_SAMPLES = 100
MIN_SHADOW_EVIDENCE = 0.1
REACH_PX = 60
MAX_STDERR_DEG = 15.0
"""Directions less certain than this are refused."""


@dataclass(frozen=True, slots=True)
class UnlistedLights:
    """Lights that images show without a list.

    Attributes
    ----------
    directions
        (N, 3), unit vectors towards the lights: x right, y up, z towards the camera.
    strength
        (N,), over the median.
    stderr_deg
        (N,), standard error of each direction by the spread of the strengths. It leaves out the
        error that highlights, lateral scattering and near lights cause.
    sign
        What decided between the object and its hollow twin: ``"cast shadows"`` or ``"outline"``.
    sign_evidence
        Difference of the two: in the fraction of cast shadows that the surface explains, or twice
        the mean cosine of the normals at the outline with the way out; 0 to 2. Below 0.1 the object
        may as well be hollow.
    """

    directions: Float64Array
    strength: Float64Array
    stderr_deg: Float64Array
    sign: Literal["cast shadows", "outline"]
    sign_evidence: float


def estimate_lights(
    gray: FloatArray,
    *,
    usable: BoolArray | None = None,
    inside: BoolArray | None = None,
    rng: np.random.Generator,
) -> UnlistedLights:
    """Estimate the directions of distant lights of about equal strength from images alone.

    Parameters
    ----------
    gray
        (N, H, W), linear samples of one static object under one light each, in any unit.
    usable
        (N, H, W), False for saturated samples; None: all are usable.
    inside
        (H, W), the object; None: all pixels.
    rng
        Draws points.

    Returns
    -------
    UnlistedLights

    Raises
    ------
    PhotometricStereoError
        For fewer than 8 images, too small an object, or lights that the images leave undetermined:
        all on one ring, or a flat object.
    """
    images = np.asanyarray(gray)
    checks = Checks(PhotometricStereoError)
    checks.require(len(images) >= MIN_FRAMES, "gray", f"{len(images)} images", f"{MIN_FRAMES}")
    mask = np.ones(images.shape[1:], bool) if inside is None else np.asarray(inside, bool)
    stack, _ = reduce_stack(images, usable, mask)
    with threadpool_limits(1):  # sums of one order, so that bytes do not depend on threads
        return _estimate(stack, checks, rng)


def _estimate(stack: ReducedStack, checks: Checks, rng: np.random.Generator) -> UnlistedLights:
    """Estimate the lights of reduced images; see `estimate_lights`."""
    samples, clear = choose_points(stack.gray, stack.usable, stack.inside, rng)
    got = f"{samples.shape[1]} bright points"
    checks.require(samples.shape[1] >= MIN_POINTS, "gray", got, f"{MIN_POINTS}; check mask")
    space = fit_shading_space(samples, clear)
    ratio = space.singular_ratio
    got = f"images that differ by {ratio:.1%} of their light in the third direction"
    wanted = f"{MIN_SINGULAR_RATIO:.0%}, from a curved object; give a list of the lights"
    checks.require(ratio >= MIN_SINGULAR_RATIO, "gray", got, wanted)
    field, good = _fit_points(stack.gray, stack.usable & stack.inside, space.lights)
    xy = space.lights @ _make_integrable(field, good)
    # most lights are before the object: a height common to all of them is near the truth
    height = space.lights @ np.linalg.lstsq(space.lights, np.ones(len(stack.gray)), rcond=None)[0]
    lights, error_rad = _equalize_strengths(np.concatenate([xy, height[:, None]], axis=1))
    # a light is n . l: normals transform by the inverse transpose of the lights' map
    to_lights = np.linalg.lstsq(space.lights, lights, rcond=None)[0]
    normals = unit_vectors(field @ np.linalg.inv(to_lights).T, min_length=1e-12)
    if np.median(normals[good][:, 2]) < 0.0:
        lights, normals = lights * (1.0, 1.0, -1.0), normals * (1.0, 1.0, -1.0)
    sign, evidence = _compare_with_hollow(stack, normals, lights, good)
    if evidence < 0.0:
        lights = lights * HOLLOW_FACTORS
    strength = np.linalg.norm(lights, axis=1)
    stderr_deg = np.degrees(error_rad)
    tilt_deg = float(np.degrees(np.median(np.arccos(lights[:, 2] / strength))))
    got = f"strengths that are equal only for lights {tilt_deg:.1f} degrees from the camera's axis"
    expected = f"{MIN_TILT_DEG:.0f} degrees; give a list of the lights"
    checks.require(tilt_deg >= MIN_TILT_DEG, "gray", got, expected)
    worst = float(np.median(stderr_deg))
    checks.require(
        worst <= MAX_STDERR_DEG,
        "gray",
        f"directions with a standard error of {worst:.0f} degrees",
        f"at most {MAX_STDERR_DEG:.0f}; give a list of the lights",
    )
    return UnlistedLights(
        lights / strength[:, None], strength / np.median(strength), stderr_deg, sign, abs(evidence)
    )


def _fit_points(
    gray: Float64Array, usable: BoolArray, lights: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Return vectors (H, W, 3) of which ``gray`` is the product with the lights, and which fit."""
    n, (height, width) = len(gray), gray.shape[1:]
    scaled = _over_bright_sample(gray).reshape(n, -1).T
    lit = usable.reshape(n, -1).T & (scaled > SHADOW_FRACTION) & (scaled < HIGHLIGHT_FACTOR)
    weights: FloatArray = lit.astype(np.float64)
    products = (lights[:, :, None] * lights[:, None, :]).reshape(n, -1)
    ridge = 1e-9 * np.mean(lights**2) * np.eye(3)
    points: FloatArray = np.zeros((len(scaled), 3))
    for _ in range(8):
        normal = (weights @ products).reshape(-1, 3, 3) + ridge
        points = np.linalg.solve(normal, ((weights * scaled) @ lights)[..., None])[..., 0]
        rest = np.abs(scaled - points @ lights.T)
        weights = lit / np.maximum(rest, 0.01)
    good = lit.sum(axis=1) >= MIN_LIT_SAMPLES
    misfit = np.nanmedian(np.where(lit[good], rest[good], np.nan), axis=1)
    good[good] = misfit < MAX_POINT_MISFIT
    field = unit_vectors(points, min_length=1e-12)
    return field.reshape(height, width, 3), good.reshape(height, width)


def _make_integrable(field: Float64Array, good: BoolArray) -> Float64Array:
    """Return the map to the lights' x and y, (3, 2), under which the normals are a surface's.

    For normals n of any length the curl of the slopes vanishes where
    ``(n x dn/dx)_x + (n x dn/dy)_y = 0``. Under n = M b the cross products transform by the
    cofactors of M, so that the condition is linear in two rows of M's inverse transpose: these
    take the vectors of the lights to their x and y.
    """
    weight = gaussian_filter(good.astype(np.float64), SMOOTHING_PX)
    smooth = np.stack(
        [
            gaussian_filter(np.where(good, field[..., k], 0.0), SMOOTHING_PX)
            / np.maximum(weight, 1e-9)
            for k in range(3)
        ],
        axis=-1,
    )
    along_x = np.gradient(smooth, axis=1)
    along_y = -np.gradient(smooth, axis=0)
    inner = binary_erosion(good, iterations=2)
    rows = np.concatenate([np.cross(smooth, along_x), np.cross(smooth, along_y)], axis=-1)[inner]
    if len(rows) < MIN_POINTS:
        raise PhotometricStereoError(
            f"gray: got {len(rows)} pixels that a matte surface explains, expected {MIN_POINTS}"
        )
    weights = np.ones(len(rows))
    found = np.zeros(6)
    for _ in range(N_STEPS):
        found = np.linalg.eigh((rows * weights[:, None]).T @ rows)[1][:, 0]
        rest = np.abs(rows @ found)
        weights = 1.0 / np.maximum(rest, 0.5 * np.median(rest) + 1e-12)
    return np.asarray(found.reshape(2, 3).T)


def _equalize_strengths(lights: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return lights (N, 3) of nearly one strength by a bas-relief map, and standard errors, rad.

    The map replaces z by ``a x + b y + c z``, and the strength is unknown. The error of c is that
    of its profile: the directions move as far as a fit with another c stays as good.
    """
    lights = lights / float(np.quantile(np.linalg.norm(lights[:, :2], axis=1), 0.9))

    def mapped(a: float, b: float, c: float) -> Float64Array:
        height = lights @ np.array([a, b, c])
        return np.stack([lights[:, 0], lights[:, 1], height], axis=1)

    def residuals(parameters: Float64Array) -> Float64Array:
        size = np.linalg.norm(mapped(*parameters[:3]), axis=1)
        return np.asarray(np.log(np.maximum(size, 1e-12)) - parameters[3])

    fit = partial(least_squares, loss="soft_l1", f_scale=SOFT_STRENGTH)
    fits = [fit(residuals, (0.0, 0.0, height, 0.2)) for height in START_HEIGHTS]
    best = min(fits, key=lambda one: float(one.cost))
    found = mapped(*best.x[:3])
    unit = unit_vectors(found, min_length=1e-12)
    variance = max(2.0 * float(best.cost) / (len(lights) - 4), MIN_STRENGTH_SPREAD**2)
    error = _linear_error(found, lights, np.sqrt(variance))
    outcome_from_scipy(best, float(best.optimality)).warn_unless_converged("lights", _LOG)
    for factor in PROFILE_FACTORS:
        c = factor * best.x[2]
        one = fit(
            lambda free, c=c: residuals(np.array([free[0], free[1], c, free[2]])), best.x[[0, 1, 3]]
        )
        if 2.0 * (one.cost - best.cost) < 4.0 * variance:  # within two standard errors
            other = unit_vectors(mapped(one.x[0], one.x[1], c), min_length=1e-12)
            angle = np.arccos(np.clip(np.sum(unit * other, axis=1), -1.0, 1.0))
            open_ended = factor in (PROFILE_FACTORS[0], PROFILE_FACTORS[-1])
            error = np.maximum(error, np.inf if open_ended else 0.5 * angle)
    return found, error


def _linear_error(found: Float64Array, lights: Float64Array, sigma: float) -> Float64Array:
    """Return the standard error of directions, (N,), rad, by the spread of the strengths."""
    strength = np.linalg.norm(found, axis=1)
    unit = found / strength[:, None]
    by_height = unit[:, 2:] * lights / strength[:, None]  # of the log strength, by a, b and c
    rows = np.concatenate([by_height, -np.ones((len(lights), 1))], axis=1)
    # what no strength depends on stays open: its variance is then large, not left out
    information = rows.T @ rows + MIN_INFORMATION * np.eye(4)
    covariance = sigma**2 * np.linalg.inv(information)[:3, :3]
    height_error = np.sqrt(np.maximum(np.einsum("nk,kl,nl->n", lights, covariance, lights), 0.0))
    return np.asarray(height_error * np.hypot(unit[:, 0], unit[:, 1]) / strength)


def _over_bright_sample(gray: Float64Array) -> Float64Array:
    """Return samples over the bright sample of their pixel, 0 where a pixel has no light."""
    bright = np.quantile(gray, BRIGHT_QUANTILE, axis=0)
    return np.asarray(gray / np.where(bright > 0.0, bright, np.inf))


def _compare_with_hollow(
    stack: ReducedStack, normals: Float64Array, lights: Float64Array, good: BoolArray
) -> tuple[Literal["cast shadows", "outline"], float]:
    """Return what speaks for the object, and how much; negative: for its hollow twin."""
    dark = (_over_bright_sample(stack.gray) < DARK_FRACTION) & good & stack.usable
    explained = [
        _explained_shadows(dark, normals * sign, lights * sign, good)
        for sign in (1.0, HOLLOW_FACTORS)
    ]
    evidence = explained[0] - explained[1]
    if abs(evidence) >= MIN_SHADOW_EVIDENCE:
        return "cast shadows", evidence
    return "outline", 2.0 * _measure_outward(normals, good, stack.inside)


def _explained_shadows(
    dark: BoolArray, normals: Float64Array, lights: Float64Array, good: BoolArray
) -> float:
    """Return the overlap of dark samples with shadows that the surface casts, over their union."""
    height = integrate_map(normals, valid=good)
    if not height.convergence.converged:
        return 0.0
    heights = np.where(height.valid, height.height, -np.inf).astype(np.float64)
    floor = float(heights[height.valid].min()) if height.valid.any() else 0.0
    heights = np.maximum(heights, floor - 1.0)
    rows, columns = np.nonzero(height.valid)
    both, either = 0, 0
    for image, light in zip(dark, lights, strict=True):
        facing = normals[rows, columns] @ light > MIN_FACING * np.linalg.norm(light)
        r, c = rows[facing], columns[facing]
        seen = image[r, c]
        cast = _is_cast_shadow(heights, r, c, light)
        both += int(np.count_nonzero(seen & cast))
        either += int(np.count_nonzero(seen | cast))
    return both / either if either >= MIN_DARK_SAMPLES else 0.0


def _is_cast_shadow(
    heights: Float64Array, rows: NDArray[np.intp], columns: NDArray[np.intp], light: Float64Array
) -> BoolArray:
    """Return which pixels have the surface between them and a light; heights in pixels."""
    across = float(np.hypot(light[0], light[1]))
    hit = np.zeros(len(rows), bool)
    if across < 1e-3 * abs(light[2]):
        return hit
    rise = light[2] / across
    start, top = heights[rows, columns], float(heights.max())
    for step in range(2, REACH_PX):
        ray = start + rise * step
        if (ray > top).all():
            break
        at = (rows - step * light[1] / across, columns + step * light[0] / across)
        hit |= map_coordinates(heights, at, order=1, cval=float(heights.min())) > ray + 0.5
    return hit


def _measure_outward(normals: Float64Array, good: BoolArray, inside: BoolArray) -> float:
    """Return the mean cosine of normals near the object's outline with the way out of it."""
    y, x = np.nonzero(inside)
    middle_x, middle_y = x.mean(), y.mean()
    rows, columns = np.nonzero(good)
    out = np.stack([columns - middle_x, middle_y - rows], axis=1)
    distance = np.linalg.norm(out, axis=1)
    far = distance > np.median(distance)
    across = normals[rows[far], columns[far], :2]
    return float(np.mean(np.sum(across * out[far], axis=1) / np.maximum(distance[far], 1.0)))
