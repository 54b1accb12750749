"""Check `GradientScene` by independent means: traced shadow rays, and Mitsuba's own materials.

The rays judge both renderers with their own relief and closed forms. Mitsuba's path tracer adds
reflection by other equations, and interreflection. It does not support a polarizer on each of many
lights here, so the comparison uses the sum of both analyzer stops under unpolarized LEDs. The patch
is uniform in pigment and roughness, its LEDs are points, and light leaves where it entered.
"""

import dataclasses
import math
import time
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from capture.rig import load_rig
from rigsim import shading
from rigsim.arrays import Float32Array, Float64Array
from rigsim.as_built.polarizers import Polarizers
from rigsim.as_built.sphere import PATTERN_WEIGHTS, REFERENCE_DISTANCE_MM
from rigsim.geometry.mesh import Mesh, build_mesh, grid_faces
from rigsim.light.lobe_moments import led_moments
from rigsim.mitsuba.scene_radiance import (
    MovableLightScene,
    matte_plastic,
    perspective,
    plastic_scale,
    point_light_rig,
    rough_metal,
)
from rigsim.mitsuba.variant import Renderer, choose_renderer
from rigsim.needs.effects import SceneEffects
from rigsim.render import Caster
from rigsim.scenes.gradient.scene import GradientScene
from rigsim.skin_patch.microrelief import MicroSkin, make_micro_skin
from rigsim.tissue.skin_layers import ETA
from rigsim.world.taped_skin import GripState

NEUTRAL_GRIP: Final = GripState(0.0, 0, 8.0, 1.0, True, False)
NO_POLARIZERS: Final = Polarizers(1.0 + 1e-9, math.inf, 0.0)
"""Polarizers that transmit everything; the analyzer's other half is in the other stop."""

PATCH_ALBEDO: Final = 0.2
MESH_MARGIN_PX: Final = 64
SHADOW_RAY_OFFSET_MM: Final = 1e-4
"""Offset of shadow rays above the surface, since they start at corners of its triangles."""


@dataclass(frozen=True, slots=True)
class ReferenceComparison:
    """Time and error of one method."""

    seconds: float
    """Processor time of all conditions of a state, s."""
    error: float
    """Root mean square error over the mean."""
    mean_ratio: float
    """Mean over that of the reference."""
    mean_ratio_stderr: float
    """Its standard error, from blocks of pixels."""


def plain_skin(size_mm: float, *, alpha: float = 0.25, seed: int = 0) -> MicroSkin:
    """Return a patch of cheek, uniform in pigment and roughness."""
    skin = make_micro_skin("cheek", size_mm=size_mm, seed=seed)
    even = np.ones_like(skin.height_um)
    return dataclasses.replace(
        skin, albedo=np.float32(PATCH_ALBEDO) * even, alpha=np.float32(alpha) * even
    )


def plain_scene(
    skin: MicroSkin,
    *,
    width_px: int,
    subpixels: int = 2,
    sectors: int | None = None,
    table_size: int | None = None,
    shadows: bool = True,
    interreflections: bool = False,
    renderer: Renderer = "fast",
) -> GradientScene:
    """Return the patch under unpolarized point LEDs, without lens and lateral scattering."""
    return GradientScene(
        point_light_rig(load_rig("gradient").cropped(width_px)),
        skin,
        films=NO_POLARIZERS,
        effects=SceneEffects(
            optics=False, lateral=False, relief_shadows=shadows, interreflections=interreflections
        ),
        subpixels=subpixels,
        sectors=sectors,
        table_size=table_size,
        choice=choose_renderer(renderer),
    )


def relief_mesh(scene: GradientScene, *, subpixels: int = 2) -> Mesh:
    """Return the patch as triangles between its samples, mm, with its own normals."""
    patch = scene.surface(NEUTRAL_GRIP, subpixels=subpixels, border_px=MESH_MARGIN_PX)
    rows, columns = patch.skin.shape
    vertices = np.stack([patch.x_mm, patch.y_mm, patch.height_mm], axis=-1).reshape(-1, 3)
    v, u = np.mgrid[0:rows, 0:columns] / max(rows, columns)
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    return build_mesh(vertices, grid_faces(rows, columns), uv, patch.normals.reshape(-1, 3))


def trace_pixels(
    scene: GradientScene, pixels: NDArray[np.intp], *, subpixels: int = 4
) -> tuple[Float64Array, Float64Array]:
    """Sum over single LEDs, with a shadow ray to each, in some pixels.

    Parameters
    ----------
    scene
        A plain scene.
    pixels
        Flat indices, shape (n,).
    subpixels
        Samples along each side of a pixel.

    Returns
    -------
    light : ndarray
        Shape (n, 4): S0 of each moment, in the unit of `GradientScene.stokes`.
    hidden : ndarray
        Hidden fraction of the LEDs' light, of moment 1, shape (n,).
    """
    view = scene.rig.views[0]
    patch = scene.surface(NEUTRAL_GRIP, subpixels=subpixels)
    row, column = np.divmod(pixels, view.width_px)
    inside = np.arange(subpixels)
    rows = (subpixels * row)[:, None, None] + inside[:, None]
    columns = (subpixels * column)[:, None, None] + inside
    at = np.broadcast_arrays(rows, columns)
    points = np.stack([patch.x_mm[*at], patch.y_mm[*at], patch.height_mm[*at]], -1).reshape(-1, 3)
    normals = patch.normals[*at].reshape(-1, 3)
    caster = Caster(relief_mesh(scene, subpixels=subpixels))
    surface = scene.optical_surface(float(np.median(scene.skin.alpha)))
    eye = np.asarray(surface.eye_mm)
    to_camera = eye - points
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    leaves = shading.exit_stokes(normals, to_camera, eta=ETA, image_right=surface.image_right)
    leaves = leaves[:, 0] * PATCH_ALBEDO * shading.interior_scale(ETA) / math.pi
    start = points + SHADOW_RAY_OFFSET_MM * normals
    total, lost = np.zeros((len(points), 4)), np.zeros(len(points))
    flat = np.column_stack([points[:, :2], np.zeros(len(points))])
    for led, place in enumerate(scene.sphere.position_mm):
        if place[2] <= 0.0:
            continue
        stokes, entry = led_moments(normals, flat, scene.sphere, led, surface)
        light = stokes[:, 0] + leaves * entry
        way = place - points
        length = np.linalg.norm(way, axis=1)
        lit = np.flatnonzero(light > 0.0)
        dark = caster.is_blocked(start[lit], way[lit] / length[lit, None], length[lit])
        lost[lit] += dark * light[lit]
        light[lit[dark]] = 0.0
        total += light[:, None] * scene.sphere.weights[led]
    shape = (len(pixels), subpixels**2)
    mean = total.reshape(*shape, 4).mean(axis=1) * scene.unit
    gone = lost.reshape(shape).mean(axis=1) * scene.unit
    return mean, gone / (mean[:, 0] + gone)


def scene_pixels(scene: GradientScene, pixels: NDArray[np.intp]) -> Float64Array:
    """Return `GradientScene`'s own light in some pixels, in the format of `trace_pixels`."""
    light = scene.stokes(NEUTRAL_GRIP)[:, 0]
    return np.asarray(light.reshape(4, -1)[:, pixels].T, np.float64)


def describe_patch(
    scene: GradientScene, pattern: str, *, depth: int = 2, specular: bool = True
) -> dict[str, Any]:
    """Return Mitsuba's scene of the patch under a pattern, at half the skin's strength.

    Its blend averages the two parts of the reflection. Without specular reflection all light is
    subsurface light at full strength, also over many bounces; a depth of 2 is direct light.
    """
    view = scene.rig.views[0]
    r_d = PATCH_ALBEDO * shading.interior_scale(ETA) * plastic_scale(ETA)
    inside = matte_plastic(ETA, {"type": "rgb", "value": [float(r_d)] * 3})
    facets = rough_metal("ggx", ETA, float(np.median(scene.skin.alpha)))
    glossy = {"type": "blendbsdf", "weight": 0.5, "inside": inside, "surface": facets}
    description: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth, "rr_depth": depth + 1},
        "sensor": perspective(view, "luminance", sampler="stratified"),
        "patch": {
            "type": "mesh",
            "mesh": relief_mesh(scene),
            "bsdf": glossy if specular else inside,
        },
    }
    shares = scene.sphere.weights @ np.array(PATTERN_WEIGHTS[pattern])
    name = "light"  # the entry that `MovableLightScene` moves; here it stays in place
    for place, power, share in zip(
        scene.sphere.position_mm, scene.sphere.intensity, shares, strict=True
    ):
        if place[2] <= 0.0 or share <= 0.0:
            continue
        strength = float(power * share * REFERENCE_DISTANCE_MM**2)
        description[name] = {
            "type": "point",
            "position": [float(x) for x in place],
            "intensity": {"type": "rgb", "value": [strength] * 3},
        }
        name = f"led{len(description)}"
    return description


def render_pattern(
    scene: GradientScene,
    pattern: str,
    *,
    samples: int,
    seed: int = 0,
    depth: int = 2,
    specular: bool = True,
) -> tuple[Float32Array, float]:
    """Render a pattern by Mitsuba's path tracer.

    Parameters
    ----------
    scene
        A plain scene.
    pattern
        A lit pattern.
    samples, seed
        Mitsuba's settings.
    depth, specular
        See `describe_patch`.

    Returns
    -------
    image : ndarray of float32
        Shape (H, W), in the unit of `trace_pixels`.
    seconds : float
        Processor time of the second rendering, without construction and compilation.
    """
    description = describe_patch(scene, pattern, depth=depth, specular=specular)
    light_mm = description["light"]["position"]
    renderer = MovableLightScene(description, kind="rgb")
    renderer.radiance(light_mm, samples=samples, seed=seed + 1)
    begin = time.process_time()
    image = renderer.radiance(light_mm, samples=samples, seed=seed)
    spent = time.process_time() - begin
    strength = 2.0 if specular else 1.0
    return np.asarray(strength * scene.unit * image[..., 0], np.float32), spent


def compare_with_reference(
    image: Float64Array, reference: Float64Array, seconds: float, *, blocks: int = 40
) -> ReferenceComparison:
    """Compare an image with the reference, both of shape (n,) or (n, k)."""
    difference = image - reference
    error = float(np.sqrt(np.mean(difference**2)) / reference.mean())
    parts = [
        (a.mean(), b.mean())
        for a, b in zip(
            np.array_split(image.reshape(len(image), -1)[:, 0], blocks),
            np.array_split(reference.reshape(len(reference), -1)[:, 0], blocks),
            strict=True,
        )
    ]
    ratios = np.array([a / b for a, b in parts])
    return ReferenceComparison(
        seconds, error, float(ratios.mean()), float(ratios.std(ddof=1) / math.sqrt(blocks))
    )
