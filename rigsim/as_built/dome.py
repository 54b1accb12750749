"""Draw an actual dome: nominal geometry with manufacturing tolerances."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import Rig, View
from rigsim.arrays import Float64Array

UNDISTORT_TOL: Final = 1e-14
"""Largest remaining difference of slopes."""
UNDISTORT_STEPS: Final = 12
"""Newton steps from image to ray; each doubles the number of correct digits."""


@dataclass(frozen=True, slots=True)
class DomeTolerances:
    """Standard deviations of manufacturing errors; 0 gives the nominal rig."""

    camera_mm: float = 1.5
    """Camera's center of projection, mm, per axis."""
    camera_deg: float = 0.3
    """Rotation of a camera about each of its axes, degrees."""
    focal: float = 0.003
    """Relative, of the focal length."""
    distortion: float = 0.0
    """Of the lens: k1 of this size below zero, k2 as large, p1 and p2 a hundredth."""
    gain: float = 0.01
    """Relative, of a camera's response."""
    light_mm: float = 2.5
    """Position of a light, mm, per axis."""
    light_deg: float = 1.0
    """Rotation of a light's axis, degrees, per axis."""
    power: float = 0.05
    """Relative, of a light's power."""
    lobe_deg: float = 1.0
    """Of the angle where a light's intensity has halved, degrees."""

    def __post_init__(self) -> None:
        """Check signs."""
        for name, value in dataclasses.asdict(self).items():
            if not 0.0 <= value < math.inf:
                raise ValueError(f"Tolerances.{name}: got {value}, expected >= 0")


@dataclass(frozen=True, slots=True, eq=False)
class ActualDome:
    """Ground truth of a rig; the values of its file are ``nominal``."""

    nominal: Rig
    """As drawn."""
    rig: Rig
    """The actual rig: positions, focal lengths, powers and lobes; names are the nominal ones."""
    axis: Float64Array
    """Unit vectors in which the lights shine, shape (L, 3)."""
    distortion: Mapping[str, Float64Array] = field(default_factory=dict)
    """k1, k2, p1, p2, k3 by view, on coordinates over depth, x right and y down."""
    gain: Mapping[str, float] = field(default_factory=dict)
    """Response by view; 1 where not named."""
    dead: frozenset[str] = frozenset()
    """Lights that are dead."""
    wiring: tuple[int, ...] = ()
    """Light driven by each channel of the controller; empty: each channel drives its own."""

    def light_of_channel(self, channel: int) -> int:
        """Return the light that a channel of the controller drives."""
        return self.wiring[channel] if self.wiring else channel


def build_dome(rig: Rig, *, seed: int, tolerances: DomeTolerances | None = None) -> ActualDome:
    """Draw an actual dome; with the same seed each named part is the same in any subset.

    Parameters
    ----------
    rig
        As drawn.
    seed
        Seed of the manufacturing errors.
    tolerances
        Standard deviations; None: the defaults.
    """
    size = tolerances or DomeTolerances()
    views, distortion, gain = [], {}, {}
    for view in rig.views:
        rng = np.random.default_rng([seed, *view.serial.encode()])
        views.append(perturb_view(view, size, rng))
        distortion[view.name] = draw_distortion(size, rng)
        gain[view.name] = float(np.exp(size.gain * rng.standard_normal()))
    lights, axes = [], []
    for light in rig.lights:
        rng = np.random.default_rng([seed, *light.name.encode()])
        place = np.array(light.position_mm) + size.light_mm * rng.standard_normal(3)
        half = light.half_intensity_deg
        power = light.power_w
        lights.append(
            dataclasses.replace(
                light,
                position_mm=tuple(place.tolist()),
                power_w=None if power is None else power * math.exp(size.power * rng.normal()),
                half_intensity_deg=None if half is None else half + size.lobe_deg * rng.normal(),
            )
        )
        turn = math.radians(size.light_deg) * rng.standard_normal(3)
        axis = -place / np.linalg.norm(place)
        axis = axis + np.cross(turn, axis)
        axes.append(axis / np.linalg.norm(axis))
    built = dataclasses.replace(rig, views=tuple(views), lights=tuple(lights))
    return ActualDome(rig, built, np.array(axes), distortion, gain)


def draw_distortion(size: DomeTolerances, rng: np.random.Generator) -> Float64Array:
    """Draw k1, k2, p1, p2, k3 of a lens as built."""
    k = np.array([-1.0 + 0.2 * rng.standard_normal(), *rng.standard_normal(3), 0.0])
    return np.asarray(size.distortion * k * [1.0, 1.0, 0.01, 0.01, 0.0])


def perturb_view(view: View, size: DomeTolerances, rng: np.random.Generator) -> View:
    """Return a view as built: position, direction and focal length with manufacturing errors."""
    place = np.array(view.position_mm) + size.camera_mm * rng.standard_normal(3)
    right, up, back = (np.array(axis) for axis in view.axes)
    turn = math.radians(size.camera_deg) * rng.standard_normal(3)
    turn_mm = turn[0] * right + turn[1] * up + turn[2] * back
    forward = -back + np.cross(turn_mm, -back)
    target = place + forward / np.linalg.norm(forward) * view.distance_mm
    upward = up + np.cross(turn_mm, up)
    return dataclasses.replace(
        view,
        position_mm=tuple(place.tolist()),
        target_mm=tuple(target.tolist()),
        up=tuple(upward.tolist()),
        focal_mm=view.focal_mm * (1.0 + size.focal * float(rng.standard_normal())),
    )


def distort(xy: ArrayLike, distortion: ArrayLike) -> Float64Array:
    """Return the distorted image slopes of rays given by their undistorted slopes, (..., 2)."""
    slopes = np.asarray(xy, np.float64)
    k1, k2, p1, p2, k3 = np.asarray(distortion, np.float64)
    square = np.sum(slopes * slopes, axis=-1, keepdims=True)
    product = slopes[..., :1] * slopes[..., 1:]
    tangential = np.concatenate(
        [
            2 * p1 * product + p2 * (square + 2 * slopes[..., :1] ** 2),
            2 * p2 * product + p1 * (square + 2 * slopes[..., 1:] ** 2),
        ],
        axis=-1,
    )
    return slopes * (1 + k1 * square + k2 * square**2 + k3 * square**3) + tangential


def undistort(xy: ArrayLike, distortion: ArrayLike) -> Float64Array:
    """Return the ray of an image position ``xy``: the inverse of `distort`, by Newton's method."""
    wanted = np.asarray(xy, np.float64)
    if not np.any(distortion):
        return wanted.copy()
    k1, k2, p1, p2, k3 = np.asarray(distortion, np.float64)
    # one array per axis: a trailing axis of two is several times slower
    wanted_x, wanted_y = (np.ascontiguousarray(wanted[..., axis]) for axis in (0, 1))
    x, y = wanted_x.copy(), wanted_y.copy()
    for _ in range(UNDISTORT_STEPS):
        square, product = x * x + y * y, x * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        miss_x = x * radial + 2 * p1 * product + p2 * (square + 2 * x * x) - wanted_x
        miss_y = y * radial + 2 * p2 * product + p1 * (square + 2 * y * y) - wanted_y
        if max(np.abs(miss).max(initial=0.0) for miss in (miss_x, miss_y)) < UNDISTORT_TOL:
            break
        growth = 2 * (k1 + square * (2 * k2 + 3 * k3 * square))
        xx = radial + growth * x * x + 2 * p1 * y + 6 * p2 * x
        yy = radial + growth * y * y + 2 * p2 * x + 6 * p1 * y
        mixed = growth * product + 2 * p1 * x + 2 * p2 * y
        det = xx * yy - mixed * mixed
        x -= (yy * miss_x - mixed * miss_y) / det
        y -= (xx * miss_y - mixed * miss_x) / det
    return np.stack([x, y], axis=-1)


def pixel_corner_rays(view: View, distortion: ArrayLike) -> Float64Array:
    """Return the directions through the corners of all pixels, shape (H + 1, W + 1, 3).

    Rig frame; lengths are such that the component along the optical axis is 1.
    """
    columns = (
        np.arange(view.width_px + 1) - view.width_px / 2
    )  # corners are half a pixel off the centers
    rows = np.arange(view.height_px + 1) - view.height_px / 2
    x, y = np.meshgrid(columns / view.focal_px, rows / view.focal_px)
    slopes = undistort(np.stack([x, y], axis=-1), distortion)
    right, up, back = (np.array(axis) for axis in view.axes)
    return np.asarray(slopes[..., :1] * right - slopes[..., 1:] * up - back)


def project_points(view: View, distortion: ArrayLike, points_mm: ArrayLike) -> Float64Array:
    """Return column and row of points in the image, shape (..., 2); NaN behind the camera."""
    offset = np.asarray(points_mm, np.float64) - view.position_mm
    right, up, back = (np.array(axis) for axis in view.axes)
    depth = -(offset @ back)
    depth = np.where(depth > 0.0, depth, np.nan)
    slopes = np.stack([offset @ right / depth, -(offset @ up) / depth], axis=-1)
    middle = np.array([(view.width_px - 1) / 2, (view.height_px - 1) / 2])
    return distort(slopes, distortion) * view.focal_px + middle
