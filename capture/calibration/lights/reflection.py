"""Reflection in a sphere: reflected rays of pixels, and mirror points of lights."""

from dataclasses import dataclass

import numpy as np

from capture.arrays import BoolArray, Float64Array
from capture.calibration.geometry import CameraPose

REFLECTION_TOL_RAD = 1e-12


def reflect(
    camera: CameraPose, pixels: Float64Array, center_mm: Float64Array, radius_mm: float
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return where rays of pixels meet a sphere, and their reflected directions.

    Parameters
    ----------
    camera : CameraPose
    pixels : ndarray, shape (n, 2)
    center_mm, radius_mm
        The sphere.

    Returns
    -------
    point_mm, direction : ndarray of float64, shape (n, 3)
        Rig frame; the directions are unit vectors away from the sphere. NaN where not `hit`.
    hit : ndarray of bool, shape (n,)
    """
    rays = camera.rays(pixels)
    offset = camera.center_mm - center_mm
    along = rays @ offset
    square = along**2 - (offset @ offset - radius_mm**2)
    hit = square > 0
    t = np.where(hit, -along - np.sqrt(np.where(hit, square, 0.0)), np.nan)
    point = camera.center_mm + t[:, None] * rays
    normal = (point - center_mm) / radius_mm
    return point, rays - 2 * np.sum(rays * normal, axis=1, keepdims=True) * normal, hit


def reflection_points(
    eyes_mm: Float64Array, centers_mm: Float64Array, radius_mm: float, lights_mm: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Return the mirror points of lights on spheres.

    Parameters
    ----------
    eyes_mm, centers_mm, lights_mm : ndarray, shape (n, 3)
        Centers of projection, of the spheres, and points outside the spheres.
    radius_mm : float
        Radius of the spheres.

    Returns
    -------
    point_mm : ndarray of float64, shape (n, 3)
    seen : ndarray of bool, shape (n,)
        False where the point faces away from the eye or the light.

    Notes
    -----
    Alhazen's problem, solved by Newton's method, safeguarded by bisection, for the angle between
    the normal and the direction to the eye.
    """
    r = radius_mm
    to_eye, to_light = eyes_mm - centers_mm, lights_mm - centers_mm
    # In the plane of eye, center and light, with e towards the eye: the eye is at (D, 0), the light
    # at (x, y), and the mirror point r (cos a, sin a) has a between 0 and the light's azimuth.
    D = np.linalg.norm(to_eye, axis=-1)
    e = to_eye / D[:, None]
    x = np.sum(to_light * e, axis=-1)
    across = to_light - x[:, None] * e
    y = np.linalg.norm(across, axis=-1)
    across /= np.where(y > 0, y, 1.0)[:, None]
    square = x**2 + y**2
    low, high = np.zeros_like(D), np.arctan2(y, x)
    angle = 0.5 * high
    for _ in range(60):
        # reflection: the angle at the normal to the eye equals that to the light
        s, c = np.sin(angle), np.cos(angle)
        eye_n, eye_t = D * c - r, D * s
        light_n, light_t = x * c + y * s - r, y * c - x * s
        miss = np.arctan2(eye_t, eye_n) - np.arctan2(light_t, light_n)
        low, high = np.where(miss < 0, angle, low), np.where(miss < 0, high, angle)
        slope = D * (D - r * c) / (eye_n**2 + eye_t**2)
        slope += (square - r * (light_n + r)) / (light_n**2 + light_t**2)
        newton = angle - miss / slope
        new = np.where((newton >= low) & (newton <= high), newton, 0.5 * (low + high))
        done = np.abs(new - angle).max(initial=0.0) < REFLECTION_TOL_RAD
        angle = new
        if done:
            break
    normal = np.cos(angle)[:, None] * e + np.sin(angle)[:, None] * across
    seen = (D * np.cos(angle) > r) & (np.sum(normal * to_light, axis=-1) > r)
    return centers_mm + r * normal, seen


def reflection_pixels(
    camera: CameraPose, center_mm: Float64Array, radius_mm: float, lights_mm: Float64Array
) -> Float64Array:
    """Return the pixels of lights mirrored in a sphere, shape (n, 2); NaN where invisible.

    Parameters
    ----------
    camera : CameraPose
    center_mm, radius_mm
        The sphere.
    lights_mm : ndarray, shape (n, 3)
        Points outside the sphere.
    """
    eyes = np.broadcast_to(camera.center_mm, lights_mm.shape)
    centers = np.broadcast_to(center_mm, lights_mm.shape)
    point, seen = reflection_points(eyes, centers, radius_mm, lights_mm)
    return np.where(seen[:, None], camera.project(point), np.nan)


DERIVATIVE_STEP_MM = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class MirroredLights:
    """Mirror images of lights in a ball.

    Attributes
    ----------
    pixels : ndarray of float64, shape (L, 2)
        Column and row, px; NaN where the ball does not show the light.
    to_light, to_camera, normal : ndarray of float64, shape (L, 3)
        Unit vectors at the mirroring point of the ball.
    px_per_mm : ndarray of float64, shape (L, 2, 2)
        Derivative of the spot by the light's position, along two directions across the line to it.
    across : ndarray of float64, shape (L, 2, 3)
        These directions, unit vectors.
    """

    pixels: Float64Array
    to_light: Float64Array
    to_camera: Float64Array
    normal: Float64Array
    px_per_mm: Float64Array
    across: Float64Array

    @property
    def magnification_px2(self) -> Float64Array:
        """Area of the image of 1 mm^2 of a light that faces the ball, px^2, shape (L,)."""
        return np.abs(np.linalg.det(self.px_per_mm))


def mirror_lights(
    camera: CameraPose, center_mm: Float64Array, radius_mm: float, lights_mm: Float64Array
) -> MirroredLights:
    """Return positions and derivatives of the lights' mirror images in a ball.

    Parameters
    ----------
    camera : CameraPose
    center_mm, radius_mm
        The ball.
    lights_mm : ndarray of float64, shape (L, 3)
        Positions of the lights, outside the ball.
    """
    lights = np.asarray(lights_mm, np.float64)
    eyes = np.broadcast_to(camera.center_mm, lights.shape)
    centers = np.broadcast_to(np.asarray(center_mm, np.float64), lights.shape)
    point, seen = reflection_points(eyes, centers, radius_mm, lights)
    to_light, to_camera = _unit(lights - point), _unit(eyes - point)
    first = np.cross(to_light, _smallest_axis(to_light))
    first = _unit(first)
    across = np.stack([first, np.cross(to_light, first)], axis=1)
    columns = []
    for j in range(2):
        step = DERIVATIVE_STEP_MM * across[:, j]
        ends = [reflection_pixels(camera, center_mm, radius_mm, lights + s * step) for s in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * DERIVATIVE_STEP_MM))
    pixels = np.where(seen[:, None], camera.project(point), np.nan)
    normal, by_mm = (point - centers) / radius_mm, np.stack(columns, axis=-1)
    return MirroredLights(pixels, to_light, to_camera, normal, by_mm, across)


def _unit(vectors: Float64Array) -> Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _smallest_axis(vectors: Float64Array) -> Float64Array:
    """Return the coordinate axis that each vector is least along."""
    return np.eye(3)[np.argmin(np.abs(vectors), axis=-1)]
