"""Render a polished ball in front of the dome's cloth, with the reflection of every lit LED.

The cloth is a sphere around the rig; it is lit directly by the LEDs, without interreflection, and
is visible in the ball and around it. An LED is a flat disc of uniform radiance.
"""

from typing import Final, TypeAlias

import numpy as np
from numba import njit

from rigsim.arrays import Float32Array, Float64Array

CHROMIUM_REFLECTANCE: Final = 0.62
"""Reflectance of polished chromium in the visible, at all angles (without the Fresnel increase near
the rim)."""

CLOTH_MM: Final = 1200.0
"""Radius of the cloth around the rig's origin."""
CLOTH_REFLECTANCE: Final = 0.06
CLOTH_ROWS: Final = 48
"""Rows of the map of light on the cloth; it has twice as many columns."""


LampArrays: TypeAlias = tuple[Float64Array, Float64Array, Float64Array, Float64Array]
"""Lights that are on: positions in mm (L, 3), axes (L, 3), exponents (L,) and strengths (L,)."""

BallArrays: TypeAlias = tuple[Float64Array, float, float]
"""Middle in mm, shape (3,), radius in mm and reflectance of a ball."""

LedArrays: TypeAlias = tuple[Float64Array, Float64Array, float, float, float]
"""Position in mm, axis, exponent, radius in mm and strength of one of the lights."""


@njit(cache=True, nogil=True)
def cloth_radiance(lamps: LampArrays) -> Float64Array:
    """Return the radiance of the cloth, shape (`CLOTH_ROWS`, 2 `CLOTH_ROWS`).

    In the unit of a white's signal; rows by elevation from +y down, columns by azimuth
    atan2(x, z) from -pi.
    """
    lamp_mm, lamp_axis, lamp_exponent, strength = lamps
    out = np.zeros((CLOTH_ROWS, 2 * CLOTH_ROWS))
    for row in range(CLOTH_ROWS):
        elevation = np.pi / 2 - (row + 0.5) * np.pi / CLOTH_ROWS
        for column in range(2 * CLOTH_ROWS):
            azimuth = (column + 0.5) * np.pi / CLOTH_ROWS - np.pi
            x = np.cos(elevation) * np.sin(azimuth)
            y = np.sin(elevation)
            z = np.cos(elevation) * np.cos(azimuth)
            total = 0.0
            for m in range(lamp_mm.shape[0]):
                dx = CLOTH_MM * x - lamp_mm[m, 0]
                dy = CLOTH_MM * y - lamp_mm[m, 1]
                dz = CLOTH_MM * z - lamp_mm[m, 2]
                square = dx * dx + dy * dy + dz * dz
                d = square**0.5
                off = (dx * lamp_axis[m, 0] + dy * lamp_axis[m, 1] + dz * lamp_axis[m, 2]) / d
                cosine = (dx * x + dy * y + dz * z) / d
                if off > 0.0 and cosine > 0.0:
                    total += strength[m] * off ** lamp_exponent[m] * cosine / square
            out[row, column] = CLOTH_REFLECTANCE * total
    return out


@njit(cache=True, nogil=True)
def reflection_point(
    eye_mm: Float64Array, lamp_mm: Float64Array, ball_mm: Float64Array, radius_mm: float
) -> Float64Array:
    """Return the reflection point of a lamp on a ball by bisection (Alhazen's problem)."""
    to_eye, to_lamp = eye_mm - ball_mm, lamp_mm - ball_mm
    e = to_eye / np.sqrt(np.sum(to_eye**2))
    across = to_lamp - np.sum(to_lamp * e) * e
    length = np.sqrt(np.sum(across**2))
    if length < 1e-9:
        return ball_mm + radius_mm * e
    across = across / length
    low, high = 0.0, np.pi
    for _ in range(50):
        middle = 0.5 * (low + high)
        normal = np.cos(middle) * e + np.sin(middle) * across
        tangent = -np.sin(middle) * e + np.cos(middle) * across
        out = to_lamp - radius_mm * normal
        back = to_eye - radius_mm * normal
        miss = np.sum(out * tangent) / np.sqrt(np.sum(out**2))
        miss += np.sum(back * tangent) / np.sqrt(np.sum(back**2))
        if miss > 0.0:
            low = middle
        else:
            high = middle
    return ball_mm + radius_mm * (np.cos(low) * e + np.sin(low) * across)


@njit(cache=True, nogil=True)
def _cloth_at(place: Float64Array, direction: Float64Array, cloth: Float64Array) -> float:
    """Return the cloth's radiance at the end of a ray from inside it, bilinear."""
    length = np.sqrt(np.sum(direction * direction))
    along = np.sum(place * direction) / length
    t = -along + np.sqrt(max(along * along - np.sum(place * place) + CLOTH_MM * CLOTH_MM, 0.0))
    x = place[0] + t * direction[0] / length
    y = place[1] + t * direction[1] / length
    z = place[2] + t * direction[2] / length
    rows, columns = cloth.shape
    row = (0.5 - np.arcsin(min(max(y / CLOTH_MM, -1.0), 1.0)) / np.pi) * rows - 0.5
    column = (np.arctan2(x, z) / (2 * np.pi) + 0.5) * columns - 0.5
    i, j = int(np.floor(row)), int(np.floor(column))
    a, b = row - i, column - j
    top, bottom = min(max(i, 0), rows - 1), min(max(i + 1, 0), rows - 1)
    left, right = j % columns, (j + 1) % columns
    return (1 - a) * ((1 - b) * cloth[top, left] + b * cloth[top, right]) + a * (
        (1 - b) * cloth[bottom, left] + b * cloth[bottom, right]
    )


@njit(cache=True, nogil=True)
def _ball_distance(eye, ray, ball, radius):  # type: ignore[no-untyped-def]
    """Return the distance in lengths of ``ray`` to the ball; negative: the ray misses it."""
    ox, oy, oz = eye[0] - ball[0], eye[1] - ball[1], eye[2] - ball[2]
    a = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
    b = ox * ray[0] + oy * ray[1] + oz * ray[2]
    c = ox * ox + oy * oy + oz * oz - radius * radius
    square = b * b - a * c
    if square <= 0.0:
        return -1.0
    return (-b - np.sqrt(square)) / a


@njit(cache=True, nogil=True)
def _bounce(eye, ray, t, ball, place, out):  # type: ignore[no-untyped-def]
    """Write the intersection of a ray with the ball and the reflected direction."""
    n0, n1, n2 = 0.0, 0.0, 0.0
    for k in range(3):
        place[k] = eye[k] + t * ray[k]
    n0, n1, n2 = place[0] - ball[0], place[1] - ball[1], place[2] - ball[2]
    square = n0 * n0 + n1 * n1 + n2 * n2
    twice = 2.0 * (ray[0] * n0 + ray[1] * n1 + ray[2] * n2) / square
    out[0] = ray[0] - twice * n0
    out[1] = ray[1] - twice * n1
    out[2] = ray[2] - twice * n2


@njit(cache=True, nogil=True)
def _inside(rays, i, j, y, x, ray):  # type: ignore[no-untyped-def]
    """Write the ray at a place in a pixel, between those of its corners."""
    for k in range(3):
        ray[k] = (1 - y) * ((1 - x) * rays[i, j, k] + x * rays[i, j + 1, k]) + y * (
            (1 - x) * rays[i + 1, j, k] + x * rays[i + 1, j + 1, k]
        )


@njit(cache=True, nogil=True)
def render_cloth(
    rays: Float64Array, eye_mm: Float64Array, ball: BallArrays, cloth: Float64Array, subpixels: int
) -> Float32Array:
    """Return each pixel's view of the cloth, direct and in the ball, without the LEDs.

    Parameters
    ----------
    rays
        Directions through the corners of pixels, shape (H + 1, W + 1, 3).
    eye_mm
        Center of projection, shape (3,).
    ball
        The ball; a radius of 0 shows the cloth alone.
    cloth
        From `cloth_radiance`.
    subpixels
        Rays along each side of pixels on the ball's outline.
    """
    ball_mm, radius_mm, reflectance = ball
    height, width = rays.shape[0] - 1, rays.shape[1] - 1
    out = np.zeros((height, width), np.float32)
    place, away, ray = np.empty(3), np.empty(3), np.empty(3)
    inside = np.zeros((height + 1, width + 1), np.bool_)
    for i in range(height + 1):
        for j in range(width + 1):
            inside[i, j] = _ball_distance(eye_mm, rays[i, j], ball_mm, radius_mm) > 0.0
    for i in range(height):
        for j in range(width):
            count = int(inside[i, j]) + int(inside[i, j + 1])
            count += int(inside[i + 1, j]) + int(inside[i + 1, j + 1])
            fine = 1 if count == 0 or count == 4 else subpixels
            total = 0.0
            for a in range(fine):
                for b in range(fine):
                    y, x = (a + 0.5) / fine, (b + 0.5) / fine
                    _inside(rays, i, j, y, x, ray)
                    t = _ball_distance(eye_mm, ray, ball_mm, radius_mm)
                    if t > 0.0:
                        _bounce(eye_mm, ray, t, ball_mm, place, away)
                        total += reflectance * _cloth_at(place, away, cloth)
                    else:
                        total += _cloth_at(eye_mm, ray, cloth)
            out[i, j] = total / (fine * fine)
    return out


@njit(cache=True, nogil=True)
def add_lamp(  # type: ignore[no-untyped-def]
    image, rays, box, eye_mm, ball, led, reflected, subpixels
):
    """Add one LED to an image, in place: its reflection in the ball, or the LED itself.

    Parameters
    ----------
    image
        Shape (H, W).
    rays
        As of `render_cloth`.
    box
        First and past-the-last row and column that the LED can cover, shape (4,).
    eye_mm, ball
        As of `render_cloth`.
    led
        Place in mm, axis, exponent of the lobe, radius in mm, and intensity on the axis in the unit
        of a white's signal x mm^2.
    reflected
        True for the reflection, False for the LED past the ball.
    subpixels
        Rays along each side of a pixel.
    """
    place, away, ray = np.empty(3), np.empty(3), np.empty(3)
    ball_mm, radius_mm, reflectance = ball
    lamp_mm, lamp_axis, lamp_exponent, lamp_radius_mm, strength = led
    area = lamp_radius_mm * lamp_radius_mm  # of the disc over pi: a white's signal is E, not E/pi
    for i in range(box[0], box[1]):
        for j in range(box[2], box[3]):
            total = 0.0
            for a in range(subpixels):
                for b in range(subpixels):
                    y, x = (a + 0.5) / subpixels, (b + 0.5) / subpixels
                    _inside(rays, i, j, y, x, ray)
                    t = _ball_distance(eye_mm, ray, ball_mm, radius_mm)
                    if (t > 0.0) != reflected:
                        continue
                    if reflected:
                        _bounce(eye_mm, ray, t, ball_mm, place, away)
                    else:
                        place[:] = eye_mm
                        away[:] = ray
                    facing, gap, length = 0.0, 0.0, 0.0
                    for k in range(3):
                        facing -= away[k] * lamp_axis[k]
                        gap -= (lamp_mm[k] - place[k]) * lamp_axis[k]
                        length += away[k] * away[k]
                    if facing <= 0.0 or gap <= 0.0:
                        continue
                    square = 0.0
                    for k in range(3):
                        lateral = place[k] + gap / facing * away[k] - lamp_mm[k]
                        square += lateral * lateral
                    if square < lamp_radius_mm * lamp_radius_mm:
                        # radiance of a flat disc: intensity over its area seen from there
                        total += (facing / np.sqrt(length)) ** (lamp_exponent - 1.0)
            if total > 0.0:
                share = reflectance if reflected else 1.0
                image[i, j] += share * strength / area * total / (subpixels * subpixels)
