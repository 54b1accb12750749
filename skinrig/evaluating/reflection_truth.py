"""Sample the true reflection of a simulated face in held-out directions, and on spheres."""

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from model.skin import SkinAppearance
from skinrig.appearances.contents import intersect_valid
from skinrig.arrays import BoolArray, Float32Array, Float64Array

TEST_FILE: Final = "reflection_test.npz"
MIN_TEST_COSINE: Final = 0.3
"""Minimum cosine of the sampled directions: at most 73 degrees from the normal."""
SPHERE_PX: Final = 96


class TrueReflection(Protocol):
    """Reflection of a simulated face."""

    def brdf(
        self, uv: ArrayLike, to_light: ArrayLike, to_camera: ArrayLike
    ) -> tuple[Float32Array, Float32Array]:
        """Return f_r, shape (n, 3), and its surface part, shape (n,), 1/sr."""


def make_test(
    scene: TrueReflection,
    truth: SkinAppearance,
    *,
    rng: np.random.Generator,
    sites: Mapping[str, Sequence[float]] | None = None,
    points: int = 600,
    directions: int = 24,
) -> bytes:
    """Sample points and directions, and evaluate the simulated face's reflection there.

    Parameters
    ----------
    scene
        The simulated face.
    truth
        Its maps "position" and "normals".
    rng
        Generator of texels and directions, uniform in solid angle down to `MIN_TEST_COSINE`.
    sites
        Positions on the face, mm, whose reflection is rendered on spheres.
    points, directions
        Number of points S and of directions K.

    Returns
    -------
    bytes
        An .npz with texel (S,), light and view (S, K, 3), f_r (S, K, 3) and surface (S, K); of
        the sites "site" (names), "site_texel" and "sphere" (n, SPHERE_PX, SPHERE_PX, 3).
    """
    place = truth.maps["position"]
    size = place.values.shape[0]
    valid = intersect_valid(place)
    chosen = rng.permutation(np.flatnonzero(valid))[:points]
    all_normals = truth.maps["normals"].values.reshape(-1, 3).astype(np.float64)

    def uv_of(texel: NDArray[np.integer]) -> Float64Array:
        rows, columns = np.divmod(texel, size)
        return np.stack([(columns + 0.5) / size, 1.0 - (rows + 0.5) / size], axis=-1)

    uv, normals = uv_of(chosen), all_normals[chosen]
    light = _sample_directions(normals, directions, rng)
    view = _sample_directions(normals, directions, rng)
    flat = np.repeat(uv, directions, axis=0)
    total, surface = scene.brdf(flat, light.reshape(-1, 3), view.reshape(-1, 3))
    spheres, at = [], []
    for place_mm in (sites or {}).values():
        apart = np.linalg.norm(place.values.reshape(-1, 3) - np.asarray(place_mm), axis=-1)
        texel = int(np.argmin(np.where(valid.reshape(-1), apart, np.inf)))
        spot = uv_of(np.array([texel]))

        def reflect(
            to_light: Float64Array, to_camera: Float64Array, spot: Float64Array = spot
        ) -> Float64Array:
            return np.asarray(scene.brdf(spot.repeat(len(to_light), 0), to_light, to_camera)[0])

        spheres.append(render_sphere(reflect, all_normals[texel])[0])
        at.append(texel)
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        texel=chosen,
        light=light.astype(np.float32),
        view=view.astype(np.float32),
        f_r=np.asarray(total).reshape(len(chosen), directions, 3),
        surface=np.asarray(surface).reshape(len(chosen), directions),
        site=np.array(list(sites or {})),
        site_texel=np.array(at, np.int64),
        sphere=np.array(spheres, np.float32),
    )
    return stream.getvalue()


def render_sphere(
    reflect: Callable[[Float64Array, Float64Array], Float64Array],
    normal: Float64Array,
    *,
    light_dir: tuple[float, float, float] = (0.5, 0.5, 0.70710678),
) -> tuple[Float64Array, BoolArray]:
    """Render the reflection of one spot on a sphere viewed from +z at infinity.

    Parameters
    ----------
    reflect
        f_r of the spot, (N, 3), by unit vectors to light and camera, (N, 3) each.
    normal
        Normal of the spot, in the frame of those vectors.
    light_dir
        Unit vector to the sphere's light; +x right, +y up.

    Returns
    -------
    image : ndarray, shape (SPHERE_PX, SPHERE_PX, 3)
        f_r times the cosine of the light, 1/sr.
    inside : ndarray of bool
    """
    at = (np.arange(SPHERE_PX) + 0.5) / SPHERE_PX * 2.0 - 1.0
    x, y = np.meshgrid(at, -at)
    inside = x**2 + y**2 < 1.0
    outward = np.stack([x, y, np.sqrt(np.where(inside, 1.0 - x**2 - y**2, 0.0))], -1)[inside]
    shade = np.maximum(outward @ np.asarray(light_dir), 0.0)
    to_light = _rotate_direction(np.asarray(light_dir), outward, normal)
    to_camera = _rotate_direction(np.array([0.0, 0.0, 1.0]), outward, normal)
    image = np.zeros((SPHERE_PX, SPHERE_PX, 3))
    lit = shade > 0
    seen = np.nan_to_num(reflect(to_light[lit], to_camera[lit])) * shade[lit, None]
    image.reshape(-1, 3)[np.flatnonzero(inside)[lit]] = seen
    return image, inside


def _rotate_direction(
    direction: Float64Array, outward: Float64Array, normal: Float64Array
) -> Float64Array:
    """Rotate a direction by the shortest rotation from a sphere's outward normals to the spot's.

    With unit vectors a, b, v = a x b and c = a . b, Rodrigues' formula is
    R d = c d + v x d + v (v . d) / (1 + c).
    """
    cosine = outward @ normal
    axis = np.cross(outward, normal)
    across = np.cross(axis, direction)
    along = axis * (axis @ direction)[:, None]
    return np.asarray(
        cosine[:, None] * direction + across + along / (1.0 + np.maximum(cosine, -0.999))[:, None]
    )


def _sample_directions(normals: Float64Array, count: int, rng: np.random.Generator) -> Float64Array:
    """Sample directions about normals, uniform in solid angle to `MIN_TEST_COSINE`, (S, K, 3)."""
    shape = (len(normals), count)
    z = rng.uniform(MIN_TEST_COSINE, 1.0, shape)
    turn = rng.uniform(0.0, 2.0 * np.pi, shape)
    helper = np.where(np.abs(normals[:, :1]) < 0.9, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    side = np.cross(normals, helper)
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    other = np.cross(normals, side)
    r = np.sqrt(1.0 - z**2)
    return np.asarray(
        z[..., None] * normals[:, None]
        + (r * np.cos(turn))[..., None] * side[:, None]
        + (r * np.sin(turn))[..., None] * other[:, None]
    )
