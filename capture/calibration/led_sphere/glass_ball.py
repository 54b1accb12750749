"""Locate a ball of black glass in a sphere of lights, and measure the lights from its spots.

The ball is black on black, so that its outline is invisible. Its position follows from the pattern
of the spots in which it mirrors the lights, whose positions are known to a few millimeters. All
lights together determine the ball's position much better than one light's position is known. Each
spot then gives the direction of its own light.
"""

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, maximum_filter
from scipy.spatial import cKDTree

from capture.arrays import BoolArray, Float64Array, Int64Array
from capture.calibration.geometry import CameraPose
from capture.calibration.lights.reflection import (
    DERIVATIVE_STEP_MM,
    mirror_lights,
    reflect,
    reflection_pixels,
)
from capture.calibration.record import CalibrationError, freeze_arrays
from capture.calibration.robust import HUBER_SIGMAS, mad_sigma

_log = logging.getLogger(__name__)

SPOT_DETECTION_SIGMAS = 7.0  # of the smoothed image: none of 4 million pixels of noise reaches it
SPOT_BLUR_MM = 0.012
MIN_SPOT_SEPARATION_MM = 0.06  # two spots closer than this are one
MAX_SPOTS = 600
MAX_BALL_OFFSET_MM = 4.0  # largest distance of the ball from the rig's origin
VOTE_CELL_MM = 0.06
SPOT_GATE_MM = 0.3  # first gate about a spot's predicted position; spots are 0.4 mm apart or more
MIN_SPOTS = 12
MIN_LIGHT_FRACTION = 0.5  # of the lights: fewer do not determine the position of the ball
N_BALL_STEPS = 12
MEDIAN_CHI2_2 = 1.3863  # median of chi-square with two degrees of freedom, 2 ln 2


class BallError(CalibrationError):
    """Raised for unusable photographs of the ball; the message states the reason and the change."""


@dataclass(frozen=True, slots=True)
class GlassBall:
    """The target: a polished ball of black glass."""

    center_mm: tuple[float, float, float] = (0.0, 0.0, -3.0)
    """Approximate center, mm, rig frame: half a radius behind the origin, where the camera is
    focused, so that spots near the axis are sharp.
    """
    radius_mm: float = 6.0
    radius_stderr_mm: float = 0.02
    eta: float = 1.52
    """Refractive index, > 1."""
    eta_stderr: float = 0.002
    depth_stderr_mm: float = 1.0
    """Standard deviation of its position along the camera's axis, mm."""

    def __post_init__(self) -> None:
        """Check ranges."""
        for name in ("radius_mm", "radius_stderr_mm", "depth_stderr_mm", "eta_stderr"):
            if not 0 < getattr(self, name) < np.inf:
                raise ValueError(f"GlassBall.{name}: got {getattr(self, name)}, expected > 0")
        if not 1 < self.eta < 4:
            raise ValueError(f"GlassBall.eta: got {self.eta}, expected 1 < eta < 4")


@dataclass(frozen=True, slots=True, eq=False)
class BallPosition:
    """Position and radius of the ball.

    Attributes
    ----------
    center_mm : ndarray of float64, shape (3,)
        Rig frame.
    radius_mm : float
    covariance_mm2 : ndarray of float64, shape (4, 4)
        Covariance of center and radius.
    """

    center_mm: Float64Array
    radius_mm: float
    covariance_mm2: Float64Array

    def __post_init__(self) -> None:
        """Convert to float64 and reject invalid balls."""
        freeze_arrays(self, (3,), "center_mm")
        freeze_arrays(self, (4, 4), "covariance_mm2")
        if not 0 < self.radius_mm < np.inf:
            raise ValueError(f"Ball.radius_mm: got {self.radius_mm}, expected > 0")


@dataclass(frozen=True, slots=True, eq=False)
class BallFit:
    """Position of the ball, and the assignment of spots to lights.

    Attributes
    ----------
    ball : Ball
    spot : ndarray of int64, shape (L,)
        Index of each light's spot; -1: none.
    in_field : ndarray of bool, shape (L,)
        Whether the whole spot is expected inside the image.
    stray : ndarray of int64
        Spots that are not assigned to a light.
    light_scatter_mm : float
        Standard deviation of the lights about their nominal positions, along an axis.
    """

    ball: BallPosition
    spot: Int64Array
    in_field: BoolArray
    stray: Int64Array
    light_scatter_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class LightDirections:
    """Directions from the rig's origin to lights.

    Attributes
    ----------
    direction : ndarray of float64, shape (L, 3)
        Unit vectors; NaN for lights without a spot.
    covariance : ndarray of float64, shape (L, 3, 3)
        Covariance of each, common error of the ball's position included.
    """

    direction: Float64Array
    covariance: Float64Array

    @property
    def stderr(self) -> Float64Array:
        """Standard errors of the components, shape (L, 3)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))


def find_spots(image: NDArray, *, pixel_mm: float, noise: float | None = None) -> Float64Array:
    """Find small bright spots.

    Parameters
    ----------
    image : ndarray of float, shape (H, W)
        Linear, dark subtracted.
    pixel_mm : float
        Size of a pixel at the ball, mm, > 0.
    noise : float, optional
        Standard deviation of a dark pixel; None: from the image, most of which is dark.

    Returns
    -------
    ndarray of float64, shape (n, 2)
        Column and row of their maxima, brightest first, n <= 600.

    Examples
    --------
    >>> y, x = np.mgrid[:60, :80]
    >>> spot = np.exp(-((x - 30.0) ** 2 + (y - 20.0) ** 2) / 8.0)
    >>> find_spots(spot, pixel_mm=0.006, noise=1e-3).tolist()
    [[30.0, 20.0]]
    """
    smooth = gaussian_filter(np.asarray(image, np.float32), max(SPOT_BLUR_MM / pixel_mm, 0.5))
    usual = float(np.median(smooth))
    if noise is None:
        sigma = mad_sigma(smooth - usual)
    else:
        sigma = noise / (2 * np.sqrt(np.pi) * max(SPOT_BLUR_MM / pixel_mm, 0.5))
    apart = 2 * round(MIN_SPOT_SEPARATION_MM / pixel_mm / 2) + 1
    top = smooth == maximum_filter(smooth, max(apart, 3))
    rows, columns = np.nonzero(top & (smooth - usual > max(SPOT_DETECTION_SIGMAS * sigma, 1e-12)))
    order = np.argsort(-smooth[rows, columns], kind="stable")[:MAX_SPOTS]
    return np.stack([columns, rows], axis=1)[order].astype(np.float64)


def locate_ball(
    spots: Float64Array,
    camera: CameraPose,
    lights_mm: Float64Array,
    target: GlassBall,
    *,
    margin_mm: float = 0.1,
    noise_px: float = 0.5,
    lit: BoolArray | None = None,
) -> BallFit:
    """Locate the ball by its spots and assign the spots to lights.

    Parameters
    ----------
    spots : ndarray of float64, shape (n, 2)
        Column and row of each spot, px.
    camera : CameraPose
    lights_mm : ndarray of float64, shape (L, 3)
        Nominal positions of the lights; their common error becomes the ball's.
    target : GlassBall
        Nominal ball, with the uncertainties of position and radius.
    margin_mm : float
        Size of a spot: closer to the image's border it is cut.
    noise_px : float
        Standard error of a spot's coordinate; half a pixel for maxima.
    lit : ndarray of bool, shape (L,), optional
        Lights whose spots are expected; None: all.

    Returns
    -------
    BallFit

    Raises
    ------
    BallError
        If spots are missing, if they do not match the lights, or if the field shows too little of
        the ball.
    """
    lights = np.asarray(lights_mm, np.float64)
    found = np.asarray(spots, np.float64).reshape(-1, 2)
    shows = np.ones(len(lights), bool) if lit is None else lit
    pixel_mm = float(np.linalg.norm(camera.center_mm)) / float(camera.matrix[0, 0])
    about, radius_mm = np.array(target.center_mm, np.float64), target.radius_mm
    nominal = reflection_pixels(camera, about, radius_mm, lights)
    _require_field(nominal[shows], camera, pixel_mm, radius_mm)
    if len(found) == 0:
        raise BallError(
            "ball: no spot above the dark level; check that the lights were on, that the ball "
            "is in the middle of the field, and the exposure [SR-CAL-017]"
        )
    shift, votes = _vote(found, nominal[shows], pixel_mm)
    if votes < MIN_SPOTS:
        raise BallError(
            f"ball: {len(found)} spots, at most {votes} of which fit the lights' pattern for "
            f"one position of the ball, expected {MIN_SPOTS} or more; check the target, its "
            f"radius ({radius_mm:g} mm), the exposure, and that the ball is within "
            f"{MAX_BALL_OFFSET_MM:g} mm of the middle"
        )
    right, down = camera.rotation[0], camera.rotation[1]
    start = about + pixel_mm * (shift[0] * right + shift[1] * down)
    margin_px = margin_mm / pixel_mm
    return _refine(found, camera, lights, shows, start, target, margin_px, noise_px)


def light_directions(
    camera: CameraPose,
    ball: BallPosition,
    pixels: Float64Array,
    pixel_stderr: Float64Array,
    distance_mm: Float64Array,
) -> LightDirections:
    """Return the directions of lights from their spots.

    Parameters
    ----------
    camera : CameraPose
    ball : Ball
    pixels : ndarray of float64, shape (L, 2)
        Center of each light's spot, px; NaN: none.
    pixel_stderr : ndarray of float64, shape (L,)
        Standard error of each coordinate, px.
    distance_mm : ndarray of float64, shape (L,)
        Nominal distances of the lights from the rig's origin.
    """

    def direct(px: Float64Array, place: Float64Array) -> Float64Array:
        point, way, hit = reflect(camera, px, place[:3], float(place[3]))
        along = np.sum(point * way, axis=1)
        inside = along**2 + distance_mm**2 - np.sum(point**2, axis=1)
        far = point + (np.sqrt(np.where(hit, inside, np.nan)) - along)[:, None] * way
        return far / np.linalg.norm(far, axis=1, keepdims=True)

    place = np.append(ball.center_mm, ball.radius_mm)
    direction = direct(pixels, place)
    moved = [direct(pixels + h, place) - direct(pixels - h, place) for h in 0.01 * np.eye(2)]
    by_pixel = np.stack(moved, axis=-1) / 0.02
    moved = [direct(pixels, place + h) - direct(pixels, place - h) for h in 0.001 * np.eye(4)]
    by_place = np.stack(moved, axis=-1) / 0.002
    covariance = pixel_stderr[:, None, None] ** 2 * (by_pixel @ by_pixel.transpose(0, 2, 1))
    covariance = covariance + by_place @ ball.covariance_mm2 @ by_place.transpose(0, 2, 1)
    return LightDirections(direction, covariance)


def _require_field(
    nominal: Float64Array, camera: CameraPose, pixel_mm: float, radius_mm: float
) -> None:
    inside = _inside(nominal, camera, 0.0)
    if inside.sum() < max(MIN_LIGHT_FRACTION * len(nominal), 1):
        width, height = (side * pixel_mm for side in camera.image_size)
        raise BallError(
            f"ball: the field of {width:.1f} mm x {height:.1f} mm can show only"
            f" {int(inside.sum())} of {len(nominal)} lights in a ball of radius {radius_mm:g} mm,"
            f" expected {MIN_LIGHT_FRACTION:.0%} or more; photograph it with the whole sensor"
            " [SR-CAL-018]"
        )


def _vote(found: Float64Array, nominal: Float64Array, pixel_mm: float) -> tuple[Float64Array, int]:
    """Return the shift of the pattern, px, with the most matching spots, and their number."""
    expected = nominal[np.isfinite(nominal).all(axis=1)]
    offset = (found[:, None] - expected[None]).reshape(-1, 2)
    reach = MAX_BALL_OFFSET_MM / pixel_mm
    offset = offset[(np.abs(offset) < reach).all(axis=1)]
    cells = int(np.ceil(2 * MAX_BALL_OFFSET_MM / VOTE_CELL_MM))
    table, *_ = np.histogram2d(
        offset[:, 1], offset[:, 0], bins=cells, range=[[-reach, reach], [-reach, reach]]
    )
    around = np.pad(table, 1)
    total = sum(around[i : i + cells, j : j + cells] for i in range(3) for j in range(3))
    best = int(np.argmax(total))
    row, column = divmod(best, cells)
    size = 2 * reach / cells
    middle = (np.array([column, row]) + 0.5) * size - reach
    near = (np.abs(offset - middle) <= 1.5 * size).all(axis=1)
    if not near.any():
        return middle, 0
    return np.median(offset[near], axis=0), int(near.sum())


def _refine(
    found: Float64Array,
    camera: CameraPose,
    lights: Float64Array,
    shows: BoolArray,
    start_mm: Float64Array,
    target: GlassBall,
    margin_px: float,
    noise_px: float,
) -> BallFit:
    """Fit center and radius by Gauss-Newton, each light free about its nominal position."""
    pixel_mm = float(np.linalg.norm(camera.center_mm)) / float(camera.matrix[0, 0])
    place = np.append(start_mm, target.radius_mm)
    expected = np.append(target.center_mm, target.radius_mm)
    errors_mm = (target.depth_stderr_mm, target.radius_stderr_mm)
    prior = np.array([MAX_BALL_OFFSET_MM, MAX_BALL_OFFSET_MM, *errors_mm])
    tree = cKDTree(found)
    scatter_mm, gate_px = 2.0, SPOT_GATE_MM / pixel_mm
    spot = np.full(len(lights), -1)
    covariance = np.diag(prior**2)
    for step in range(N_BALL_STEPS):
        seen = mirror_lights(camera, place[:3], float(place[3]), lights)
        spot = _match(tree, found, np.where(shows[:, None], seen.pixels, np.nan), gate_px)
        used = np.flatnonzero(spot >= 0)
        if len(used) < MIN_SPOTS:
            raise BallError(
                f"ball: only {len(used)} spots fit the lights' pattern, expected {MIN_SPOTS} or"
                " more; check the target, its radius and the exposure"
            )
        steps = DERIVATIVE_STEP_MM * np.eye(4)
        at = np.concatenate([place + steps, place - steps])
        ends = [reflection_pixels(camera, x[:3], float(x[3]), lights[used]) for x in at]
        slope = np.stack(ends[:4], axis=-1) - np.stack(ends[4:], axis=-1)
        slope /= 2 * DERIVATIVE_STEP_MM
        miss = found[spot[used]] - seen.pixels[used]
        moved = seen.px_per_mm[used]
        noise = noise_px**2 * np.eye(2)
        spread = scatter_mm**2 * (moved @ moved.transpose(0, 2, 1)) + noise
        weight = np.linalg.inv(spread)
        distance2 = np.einsum("ki,kij,kj->k", miss, weight, miss)
        robust = np.minimum(1.0, HUBER_SIGMAS / np.sqrt(np.maximum(distance2, 1e-12)))
        weight *= robust[:, None, None]
        normal = np.einsum("kia,kij,kjb->ab", slope, weight, slope) + np.diag(prior**-2)
        right = np.einsum("kia,kij,kj->a", slope, weight, miss) + (expected - place) / prior**2
        covariance = np.linalg.inv(normal)
        change = covariance @ right
        place = place + change
        # the lights' own scatter, by the median so that a misplaced light does not widen it
        wide = float(np.median(distance2)) / MEDIAN_CHI2_2
        scatter_mm = float(np.clip(scatter_mm * np.sqrt(wide), 0.02, 20.0))
        if step >= 2:
            gate_px = np.clip(6 * scatter_mm * np.abs(moved).max(), 6.0, SPOT_GATE_MM / pixel_mm)
        if step >= 4 and float(change @ normal @ change) < 1e-6:
            break
    else:
        _log.warning("place of the ball: not converged after %d steps", N_BALL_STEPS)
    in_field = _inside(seen.pixels, camera, margin_px)
    if in_field[shows].sum() < MIN_LIGHT_FRACTION * shows.sum():
        raise BallError(
            f"ball: {place[0]:+.2f} mm, {place[1]:+.2f} mm from the middle, only "
            f"{int(in_field[shows].sum())} of {int(shows.sum())} spots are in the field, "
            f"expected {MIN_LIGHT_FRACTION:.0%} or more; center it"
        )
    stray = np.setdiff1d(np.arange(len(found)), spot)
    return BallFit(
        BallPosition(place[:3], float(place[3]), covariance), spot, in_field, stray, scatter_mm
    )


def _match(
    tree: cKDTree, found: Float64Array, expected: Float64Array, gate_px: float
) -> Int64Array:
    """Return each light's spot when both are mutual nearest neighbors within the gate, else -1."""
    spot = np.full(len(expected), -1)
    known = np.flatnonzero(np.isfinite(expected).all(axis=1))
    distance, nearest = tree.query(expected[known], distance_upper_bound=float(gate_px))
    _, back = cKDTree(expected[known]).query(found)
    near = np.isfinite(distance)
    mutual = near.copy()
    mutual[near] = back[nearest[near]] == np.flatnonzero(near)
    spot[known[mutual]] = nearest[mutual]
    return spot


def _inside(pixels: Float64Array, camera: CameraPose, margin: float) -> BoolArray:
    width, height = camera.image_size
    x, y = pixels[:, 0], pixels[:, 1]
    with np.errstate(invalid="ignore"):
        return (x > margin) & (y > margin) & (x < width - 1 - margin) & (y < height - 1 - margin)
