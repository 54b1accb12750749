"""Light from a plane of even skin, lit by one LED after the other, on a camera's sensor."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from capture.rig import Light, View
from rigsim.arrays import Float64Array
from rigsim.light.led_light import lobe_exponent, white_intensity

Reflection = Callable[[Float64Array, Float64Array], Float64Array]
"""Returns f_r in 1/sr, shape (n, 3), for unit vectors to light and camera, shape (n, 3)."""


def render_plane(
    view: View, lights: Sequence[Light], normal: ArrayLike, reflection: Reflection
) -> Float64Array:
    """Return the light on the sensor per LED, without noise and vignetting.

    Parameters
    ----------
    view
        The camera.
    lights
        LEDs with a power.
    normal
        Unit normal of the plane through the rig's origin, shape (3,).
    reflection
        Reflection of the plane.

    Returns
    -------
    ndarray
        Camera RGB without white balance, fraction of full scale per second, shape (lights, H, W,
        3); 0 where light or camera is behind the plane. Each pixel has the value at its center.

    Examples
    --------
    >>> from capture.rig import load_rig
    >>> rig = load_rig("dome").resized(8)
    >>> matt = lambda light, camera: np.full(light.shape, 0.1)
    >>> render_plane(rig.view("C00"), rig.lights[:2], (0.0, 1.0, 0.0), matt).shape
    (2, 6, 8, 3)
    """
    n = np.asarray(normal, np.float64)
    points, to_camera = _plane_points(view, n)
    place = np.array([light.position_mm for light in lights], np.float64)[:, None]
    to_light = place - points
    distance = np.linalg.norm(to_light, axis=-1, keepdims=True)
    to_light /= distance
    cosine = to_light @ n
    lit = (cosine > 0.0) & (to_camera @ n > 0.0)
    axial = np.sum(to_light * place / np.linalg.norm(place, axis=-1, keepdims=True), axis=-1)
    exponent = np.array([lobe_exponent(light) for light in lights])
    strength = np.clip(axial, 0.0, None) ** exponent[:, None] * cosine
    white = np.array([white_intensity(light, view) for light in lights])[:, None]
    irradiance = np.pi * white * strength[..., None] / distance**2
    out = np.zeros(to_light.shape)
    if lit.any():
        seen = np.broadcast_to(to_camera, to_light.shape)[lit]
        out[lit] = irradiance[lit] * reflection(to_light[lit], seen)
    return out.reshape(len(lights), view.height_px, view.width_px, 3)


def _plane_points(view: View, normal: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return where the rays of pixel centers meet the plane, and unit vectors back, (n, 3)."""
    right, up, back = (np.asarray(axis, np.float64) for axis in view.axes)
    column, row = np.meshgrid(np.arange(view.width_px), np.arange(view.height_px))
    x = (column.ravel() - 0.5 * (view.width_px - 1)) / view.focal_px
    y = (row.ravel() - 0.5 * (view.height_px - 1)) / view.focal_px
    way = x[:, None] * right - y[:, None] * up - back
    way /= np.linalg.norm(way, axis=-1, keepdims=True)
    place = np.asarray(view.position_mm, np.float64)
    slope = way @ normal
    # rays along the plane or away from it see its back, which reflects nothing
    length = -(place @ normal) / np.where(slope < 0.0, slope, -1.0)
    return place + length[:, None] * way, -way
