"""Light from everywhere: an environment map as far lights, drawn where the map is bright.

The map is latitude and longitude: row 0 is up (+y), the middle column is where the subject looks
(+z), and columns grow to the right of somebody who stands in the middle and looks along +z, which
is towards -x. Values are radiances over that of a perfect white in the same room: under an even map
of 1 a white patch shows 1.
"""

import math
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from model import store
from skinrig.arrays import Float32Array, Float64Array
from skinrig.rendering.lights import Light, LightError

MAX_LIGHT_RADIUS_RAD: Final = 0.35
"""Largest angular radius of a light that stands for a part of the map."""
MAX_LIGHTS: Final = 65_536


def directions(height: int, width: int) -> tuple[Float64Array, Float64Array]:
    """Return unit vectors to the middles of the map's pixels, (H, W, 3), and solid angles, (H, W).

    Examples
    --------
    >>> towards, solid = directions(90, 180)
    >>> towards[44, 90].round(1).tolist(), bool(abs(solid.sum() - 4 * math.pi) < 1e-9)
    ([-0.0, 0.0, 1.0], True)
    """
    edges = np.linspace(0.0, math.pi, height + 1)
    polar = 0.5 * (edges[1:] + edges[:-1])
    turn = 2.0 * math.pi * ((np.arange(width) + 0.5) / width - 0.5)
    sine = np.sin(polar)[:, None]
    x, y, z = np.broadcast_arrays(
        -np.sin(turn) * sine, np.cos(polar)[:, None] + 0.0 * turn, np.cos(turn) * sine
    )
    towards = np.stack([x, y, z], axis=-1)
    step = np.full(width, 2.0 * math.pi / width)
    solid = (np.cos(edges[:-1]) - np.cos(edges[1:]))[:, None] * step
    return towards, solid


def environment_lights(
    radiance: ArrayLike, count: int, *, rng: np.random.Generator
) -> tuple[Light, ...]:
    """Draw far lights from a map, more where it is brighter, each at a place of its own.

    Each stands for an equal share of the map's power: stratified draws from the running sum of
    power along the map's rows, so that the sum over lights has less noise than separate draws.

    Parameters
    ----------
    radiance
        Shape (H, W, 3), at least 0, finite; see this module for its frame and unit.
    count
        Lights, at least 1.
    rng
        Where in its share each light is drawn.

    Returns
    -------
    tuple of Light
        Their angular radius is that of the solid angle that each stands for, at most
        `MAX_LIGHT_RADIUS_RAD`.

    Raises
    ------
    LightError
        The map is no such image, or dark.

    Examples
    --------
    >>> lights = environment_lights(np.ones((8, 16, 3)), 32, rng=np.random.default_rng(0))
    >>> white = sum(light.intensity[0] for light in lights)
    >>> len(lights), round(white, 6)  # over all directions, four times what comes from the front
    (32, 4.0)
    """
    image = np.asarray(radiance, np.float64)
    if image.ndim != 3 or image.shape[2] != 3 or min(image.shape[:2]) < 2:
        raise LightError(f"environment: got shape {image.shape}, expected (H, W, 3) of 2 or more")
    if not (np.isfinite(image).all() and image.min() >= 0.0):
        raise LightError("environment: got negative or non-finite values, expected radiances")
    if not 1 <= count <= MAX_LIGHTS:
        raise LightError(f"environment lights: got {count}, expected 1 to {MAX_LIGHTS}")
    towards, solid = directions(*image.shape[:2])
    power = image.mean(axis=-1) * solid
    if not power.sum() > 0.0:
        raise LightError("environment: got a map without light")
    # every second row runs backwards, so that neighbors on the way are neighbors in the map
    order = np.arange(power.size).reshape(power.shape)
    order[1::2] = order[1::2, ::-1]
    order = order.reshape(-1)
    running = np.cumsum(power.reshape(-1)[order])
    at = (np.arange(count) + rng.random(count)) / count * running[-1]
    pixel = order[np.minimum(np.searchsorted(running, at, side="right"), power.size - 1)]
    chance = power.reshape(-1)[pixel] / running[-1]
    share = solid.reshape(-1)[pixel] / (chance * count)  # solid angle that each light stands for
    color = image.reshape(-1, 3)[pixel] * (share / math.pi)[:, None]
    radius = np.minimum(np.sqrt(share / math.pi), MAX_LIGHT_RADIUS_RAD)
    return tuple(
        Light(
            name="environment",
            direction=_vector(towards.reshape(-1, 3)[pixel[k]]),
            intensity=_vector(color[k]),
            radius=float(radius[k]),
            divisible=False,
        )
        for k in range(count)
    )


def read_environment(path: str | Path) -> Float32Array:
    """Read a map from an OpenEXR file, shape (H, W, 3); a gray one has one color.

    Raises
    ------
    model.store.StoreError
        The file is missing or no such image.
    """
    image = store.read_exr(path)
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


def _vector(values: Float64Array) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z
