"""Render a small ball of black glass in a sphere of LEDs: the camera's image of every LED.

The ball is smooth, so that each LED's disc is mirrored in one place, which depends on where in the
lens's pupil the ray goes: spots far from the axis lie out of the plane in focus and are blurred.
Rays are traced from points of the pupil; diffraction is left to `rigsim.render.lens_blur`.
"""

import math
from typing import Final

import numpy as np
from numba import njit

from capture.rig import View
from rigsim import shading
from rigsim.arrays import Float32Array, Float64Array
from rigsim.as_built.sphere import ActualSphere
from rigsim.targets.mirror_ball import reflection_point

GLASS_BALL_RADIUS_MM: Final = 6.0
ETA: Final = 1.52
"""Of crown glass."""

NOMINAL_CENTER_MM: Final = (0.0, 0.0, -3.0)
"""Mean position of the ball's center: the spots near the axis, half a radius in front of the
center, are then in focus."""

BALL_PLACEMENT_DEVIATION_MM: Final = 0.3
"""Standard deviation of its placement, per axis."""

PUPIL_POINTS: Final = 37
RAYS_PER_SIDE: Final = 4


def draw_ball_center_mm(seed: int) -> Float64Array:
    """Return the position of the ball's center, mm, rig frame, shape (3,)."""
    rng = np.random.default_rng([seed, 12])
    return np.array(NOMINAL_CENTER_MM) + BALL_PLACEMENT_DEVIATION_MM * rng.standard_normal(3)


def render_ball_stokes(
    view: View, sphere: ActualSphere, *, extinction: float, center_mm: Float64Array
) -> Float32Array:
    """Return the Stokes image of the ball for each lighting moment, averaged over each pixel.

    Parameters
    ----------
    view
        The camera, which looks along -z and is focused on its target.
    sphere
        The LEDs.
    extinction
        Extinction ratio of the LEDs' polarizers, > 1.
    center_mm
        Middle of the ball.

    Returns
    -------
    ndarray of float32
        Shape (12, H, W): Stokes vectors of the moments in the order of
        `rigsim.as_built.sphere.MOMENT_NAMES`, radiance in the unit of `rigsim.light.lobe_moments`.
    """
    pupil = np.array(view.position_mm, np.float64) + _pupil(view)
    pitch = view.distance_mm / view.focal_px
    shape = (view.height_px, view.width_px)
    out = np.zeros((12, *shape), np.float32)
    weights = sphere.weights
    for led, place in enumerate(sphere.position_mm):
        if sphere.intensity[led] == 0.0:
            continue
        radius = float(sphere.radius_mm[led])
        distance = float(np.linalg.norm(place))
        beam = -place / distance
        box = _box(pupil, (place, beam, radius), center_mm, pitch, shape)
        if box is None:
            continue
        part = np.zeros((box[1] - box[0], box[3] - box[2]))
        ball = (center_mm, GLASS_BALL_RADIUS_MM)
        _add_spot(part, box, pitch, shape, pupil, ball, (place, beam, radius))
        stokes = _mirrored(view, place, center_mm, sphere.absorbs[led], extinction)
        # unit of rigsim.light.lobe_moments: intensity 1 gives irradiance 1 at 600 mm
        brightness = sphere.intensity[led] * 600.0**2 / (math.pi * radius**2)
        for m in range(4):
            for c in range(3):
                out[3 * m + c, box[0] : box[1], box[2] : box[3]] += (
                    weights[led, m] * brightness * stokes[c] * part
                ).astype(np.float32)
    return out


def _pupil(view: View) -> Float64Array:
    """Return points of the entrance pupil relative to its middle, even per area, (n, 3)."""
    magnification = view.focal_mm / view.distance_mm
    radius = 0.5 * view.focal_mm / (view.f_number * (1.0 + magnification))
    k = np.arange(PUPIL_POINTS) + 0.5
    r = radius * np.sqrt(k / PUPIL_POINTS)
    phi = math.pi * (1.0 + math.sqrt(5.0)) * k
    right, up, _ = (np.array(axis) for axis in view.axes)
    points = (r * np.cos(phi))[:, None] * right + (r * np.sin(phi))[:, None] * up
    # the mean of few points is not exactly the center, which would shift defocused spots
    return np.asarray(points - points.mean(axis=0))


def _mirrored(
    view: View, place: Float64Array, center: Float64Array, absorbs: Float64Array, extinction: float
) -> Float64Array:
    """Return the Stokes vector of an LED's reflection over the radiance before its polarizer."""
    eye = np.array(view.position_mm, np.float64)
    point = reflection_point(eye, place, center, GLASS_BALL_RADIUS_MM)
    to_light, to_camera = place - point, eye - point
    to_light /= np.linalg.norm(to_light)
    to_camera /= np.linalg.norm(to_camera)
    facet = to_light + to_camera
    facet /= np.linalg.norm(facet)
    # a rough facet's reflection over its lobe is Fresnel's alone
    alpha = 0.5
    cosine = float(facet @ to_light)
    shadowed = 2.0 / (1.0 + math.sqrt(1.0 + alpha**2 * (1.0 - cosine**2) / cosine**2))
    lobe = shadowed**2 / (math.pi * alpha**2) / (4.0 * cosine)
    rough = shading.specular_stokes(
        facet[None],
        to_light[None],
        to_camera[None],
        alpha,
        eta=ETA,
        light_absorbs=absorbs,
        image_right=view.axes[0],
        extinction=extinction,
    )
    return np.asarray(rough[0] / lobe, np.float64)


def _box(
    pupil: Float64Array,
    lamp: tuple[Float64Array, Float64Array, float],
    center: Float64Array,
    pitch: float,
    shape: tuple[int, int],
) -> tuple[int, int, int, int] | None:
    """Return first and past-the-last row and column of a spot, or None outside the image."""
    place, beam, lamp_radius = lamp
    side = np.cross(beam, [0.0, 1.0, 0.0] if abs(beam[1]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    across = np.cross(beam, side)
    rim = [place + 1.5 * lamp_radius * v for v in (side, -side, across, -across)]
    seen = []
    for eye in (pupil[0], *pupil[-8:]):
        for spot in rim:
            point = reflection_point(eye, spot, center, GLASS_BALL_RADIUS_MM)
            t = eye[2] / (eye[2] - point[2])
            seen.append((eye + t * (point - eye))[:2])
    low, high = np.min(seen, axis=0) / pitch, np.max(seen, axis=0) / pitch
    rows, columns = shape
    first = math.floor(0.5 * (rows - 1) - high[1]) - 1, math.floor(low[0] + 0.5 * (columns - 1)) - 1
    last = math.ceil(0.5 * (rows - 1) - low[1]) + 2, math.ceil(high[0] + 0.5 * (columns - 1)) + 2
    box = max(first[0], 0), min(last[0], rows), max(first[1], 0), min(last[1], columns)
    return box if box[0] < box[1] and box[2] < box[3] else None


@njit(cache=True, nogil=True)
def _add_spot(part, box, pitch, shape, pupil, ball, light):  # type: ignore[no-untyped-def]
    """Add the fraction of each pixel's rays, over pixel and pupil, that end on a lamp's disc."""
    center, radius = ball
    lamp, beam, lamp_radius = light
    share = 1.0 / (RAYS_PER_SIDE * RAYS_PER_SIDE * pupil.shape[0])
    ray, place = np.empty(3), np.empty(3)
    for i in range(box[0], box[1]):
        for j in range(box[2], box[3]):
            hits = 0
            for a in range(RAYS_PER_SIDE):
                for b in range(RAYS_PER_SIDE):
                    y = (0.5 * shape[0] - i - (a + 0.5) / RAYS_PER_SIDE) * pitch
                    x = (j + (b + 0.5) / RAYS_PER_SIDE - 0.5 * shape[1]) * pitch
                    for p in range(pupil.shape[0]):
                        ray[0], ray[1], ray[2] = x - pupil[p, 0], y - pupil[p, 1], -pupil[p, 2]
                        length, along, square = 0.0, 0.0, 0.0
                        for k in range(3):
                            length += ray[k] * ray[k]
                        length = math.sqrt(length)
                        for k in range(3):
                            ray[k] /= length
                            off = pupil[p, k] - center[k]
                            along += off * ray[k]
                            square += off * off
                        rest = along * along - square + radius * radius
                        if rest <= 0.0:
                            continue
                        t = -along - math.sqrt(rest)
                        facing = 0.0
                        for k in range(3):
                            place[k] = pupil[p, k] + t * ray[k]
                            facing += ray[k] * (place[k] - center[k])
                        gap, towards = 0.0, 0.0
                        for k in range(3):
                            ray[k] -= 2.0 * facing * (place[k] - center[k]) / (radius * radius)
                            towards += ray[k] * beam[k]
                            gap += (lamp[k] - place[k]) * beam[k]
                        if towards >= 0.0 or gap >= 0.0:
                            continue
                        t = gap / towards
                        miss = 0.0
                        for k in range(3):
                            off = place[k] + t * ray[k] - lamp[k]
                            miss += off * off
                        if miss < lamp_radius * lamp_radius:
                            hits += 1
            part[i - box[0], j - box[2]] += hits * share
