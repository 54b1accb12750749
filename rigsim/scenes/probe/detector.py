"""Render the probe's detector image: lit fiber ends in front of the camera, as a Mitsuba scene.

Each fiber's end is a disc whose radiance varies over it; a session adds the rendered images with
the light of its photon walk as weights, so that no exposure renders. The lens adds its blur, wings
and veiling glare.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from scipy.ndimage import gaussian_filter

from capture.rig import View
from rigsim.arrays import Float32Array, Float64Array
from rigsim.as_built.probe import SPOT_RADIUS_PX, ActualProbe
from rigsim.mitsuba.scene_radiance import perspective, radiance

SAMPLES_PER_PIXEL: Final = 64
"""Samples per pixel, multi-jittered: after the lens, 0.2 % of error of a pixel (rms), and 0.003 px
of a spot's position. Mitsuba rounds them up to a grid, and adds other counts than powers of two in
the order of its threads: 64 is a grid of 8 x 8."""
RADIAL_TEXELS, ANGULAR_TEXELS = 32, 128
"""Texels of a fiber end's light, in polar coordinates."""
BLUR_SIGMAS: Final = 5.0
"""Reach of the lens's blur, standard deviations."""


@functools.lru_cache(maxsize=2)
def render_fiber_images(build: ActualProbe, view: View) -> Float32Array:
    """Render the image of each fiber's light, wings and veil included; once per probe.

    All images have the same flux, up to losses of the wings outside the sensor: that of a uniform
    spot of nominal radius and height 1, pi radius^2.

    Parameters
    ----------
    build
        The probe.
    view
        The camera.

    Returns
    -------
    ndarray of float32
        Shape (F, H, W), >= 0, read-only, for light that comes out of one fiber each.
    """
    y = np.arange(view.height_px, dtype=np.float64)[:, None]
    x = np.arange(view.width_px, dtype=np.float64)[None, :]
    out = np.empty((len(build.spot_px), view.height_px, view.width_px), np.float32)
    nominal = math.pi * SPOT_RADIUS_PX**2
    for image, place, radius in zip(out, build.spot_px, build.radius_px, strict=True):
        square = (x - place[0]) ** 2 + (y - place[1]) ** 2 + radius**2
        wing = build.wings * nominal * radius / (2.0 * math.pi)
        image[:] = wing / (square * np.sqrt(square)) + build.veil
    reach = math.ceil(float(build.radius_px.max()) + BLUR_SIGMAS * build.edge_px)
    for group in _separate_spots(build.spot_px, reach):
        rows = _window(build.spot_px[group, 1], reach, view.height_px)
        scene = _describe_fiber_ends(build, view, group, rows)
        sharp = radiance(scene, kind="rgb", samples=SAMPLES_PER_PIXEL)[..., 0].astype(np.float64)
        blurred = gaussian_filter(sharp, build.edge_px, mode="constant")
        for fiber in group:
            columns = _window(build.spot_px[fiber, :1], reach, view.width_px)
            disc = blurred[:, columns]
            out[fiber, rows, columns] += (1.0 - build.wings) * nominal / disc.sum() * disc
    out.setflags(write=False)
    return out


def _window(center_px: Float64Array, reach_px: int, size_px: int) -> slice:
    """Return the pixels within reach of some positions along one side of an image."""
    first = max(math.floor(center_px.min()) - reach_px, 0)
    return slice(first, min(math.ceil(center_px.max()) + reach_px + 1, size_px))


def _separate_spots(spot_px: Float64Array, reach_px: int) -> list[list[int]]:
    """Return groups of spots that do not touch: one image has those of a group."""
    groups: list[list[int]] = []
    for fiber, place in enumerate(spot_px):
        for group in groups:
            apart = np.abs(spot_px[group, 0] - place[0])  # windows have all rows of a group
            if apart.min() > 2 * reach_px + 1:
                group.append(fiber)
                break
        else:
            groups.append([fiber])
    return groups


def _describe_fiber_ends(
    build: ActualProbe, view: View, fibers: Sequence[int], rows: slice
) -> dict[str, Any]:
    """Return the scene of some fibers' ends, in the plane of the camera's target."""
    mm_per_px = view.distance_mm / view.focal_px
    right, up, back = (np.array(axis) for axis in view.axes)
    middle = 0.5 * np.array([view.width_px - 1.0, view.height_px - 1.0])
    camera = perspective(view, "luminance", sampler="multijitter")
    camera["film"] |= {
        "crop_offset_x": 0,
        "crop_offset_y": rows.start,
        "crop_width": view.width_px,
        "crop_height": rows.stop - rows.start,
    }
    scene: dict[str, Any] = {"type": "scene", "integrator": {"type": "direct"}, "sensor": camera}
    for fiber in fibers:
        x, y = mm_per_px * (build.spot_px[fiber] - middle)
        radius = mm_per_px * build.radius_px[fiber]
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([radius * right, radius * up, back])
        pose[:3, 3] = np.array(view.target_mm) + x * right - y * up
        light = {
            "type": "bitmap",
            "bitmap": _fiber_end_light(build.unevenness[fiber]),
            "raw": True,
            "wrap_mode": "clamp",
        }
        scene[f"fiber_{fiber}"] = {
            "type": "disk",
            "to_world": pose,
            "emitter": {"type": "area", "radiance": light},
        }
    return scene


def _fiber_end_light(unevenness: Float64Array) -> Float32Array:
    """Return the light over a fiber's end, angle by radius: a disk's texture coordinates."""
    radius = (np.arange(RADIAL_TEXELS) + 0.5) / RADIAL_TEXELS
    angle = 2.0 * math.pi * (np.arange(ANGULAR_TEXELS)[:, None] + 0.5) / ANGULAR_TEXELS
    u, v = radius * np.cos(angle), -radius * np.sin(angle)  # v of an image points down
    a, b, c = unevenness
    light = 1.0 + a * u + b * v + c * (2.0 * radius**2 - 1.0)
    return np.repeat(np.maximum(light, 0.0).astype(np.float32)[..., None], 3, axis=-1)
