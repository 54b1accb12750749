"""Irradiance of each LED at the subject's eyes, by a cosine model.

An eye is a small plane at its position in the nominal head, facing +z. It receives an LED's
intensity in its direction times the cosine to +z over the distance squared; light from behind does
not reach it. Lids, pupil and gaze are omitted: eyes are taken as open and looking straight ahead.

In the gradient sphere a patch of skin is at the origin and the eyes are near it, within a sixth of
the distance to the lights: they are taken at the patch.
"""

import math
from collections.abc import Sequence

import numpy as np

from capture.arrays import Float64Array
from capture.rig import Light, Rig, Vector

EYES_MM: tuple[Vector, Vector] = ((-31.0, 25.0, 80.0), (31.0, 25.0, 80.0))
"""Corneas of a nominal adult head in the rig frame, mm."""

PATCH_MM: tuple[Vector, ...] = ((0.0, 0.0, 0.0),)
"""Assumed position of the eyes when a patch of skin is at the origin."""


def radiant_intensity(light: Light) -> float:
    """Return an LED's intensity on its axis at level 1, W/sr.

    Its power is distributed over a hemisphere as a power of the cosine off the axis, or over the
    whole sphere when it emits equally in all directions.

    Examples
    --------
    >>> led = Light(name="a", position_mm=(0, 0, 700), radius_mm=3, power_w=1.0,
    ...             half_intensity_deg=60)
    >>> round(radiant_intensity(led) * math.pi, 9)
    1.0
    """
    power_w = light.power_w or 0.0
    if light.half_intensity_deg is None:
        return power_w / (4.0 * math.pi)
    # The integral of cos^n over the hemisphere is 2 pi / (n + 1).
    return power_w * (light.lobe_exponent + 1.0) / (2.0 * math.pi)


def eye_irradiance(
    rig: Rig, *, eyes_mm: Sequence[Vector] | None = None, facing: Vector = (0.0, 0.0, 1.0)
) -> Float64Array:
    """Return each light's irradiance at the eyes at level 1, mean of both, W/m^2.

    Parameters
    ----------
    rig : Rig
    eyes_mm : sequence of 3-vectors, optional
        Positions of the eyes, mm, rig frame; by default those of a nominal head, or, in front of a
        caliper, the patch itself.
    facing : 3-vector
        Viewing direction, unit length.

    Returns
    -------
    ndarray
        (L,), in the order of ``rig.lights``; 0 for lights behind the eyes.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> dome = load_rig("dome")
    >>> light = eye_irradiance(dome)
    >>> front = max(range(150), key=lambda k: dome.lights[k].position_mm[2])
    >>> bool(light[front] == light.max()), int((light == 0).sum())
    (True, 81)
    """
    places = np.array([light.position_mm for light in rig.lights], np.float64)
    axes = -places / np.linalg.norm(places, axis=1)[:, None]
    on_axis = np.array([radiant_intensity(light) for light in rig.lights])
    total = np.zeros(len(places))
    if eyes_mm is None:
        eyes_mm = EYES_MM if rig.caliper is None else PATCH_MM
    for eye in eyes_mm:
        towards = np.asarray(eye, np.float64) - places
        distance_mm = np.linalg.norm(towards, axis=1)
        towards /= distance_mm[:, None]
        off_axis_rad = np.arccos(np.clip((towards * axes).sum(axis=1), -1.0, 1.0))
        pairs = zip(rig.lights, off_axis_rad, strict=True)
        lobe = np.array([light.intensity(float(angle)) for light, angle in pairs])
        cosine = np.clip(-(towards @ np.asarray(facing, np.float64)), 0.0, None)
        total += on_axis * lobe * cosine / (distance_mm * 1e-3) ** 2
    return total / len(eyes_mm)
