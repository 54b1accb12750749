"""Make ``docs/images/gallery-voxels*.png``: voxel skin before all four rigs.

    python tools/make_reference_images.py [RIG ...]

Each image has three panels: voxels, the fast renderer's equations, and the ratio of both.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from capture.rig import load_rig
from rigsim import shading
from rigsim.as_built.sphere import PATTERN_WEIGHTS, nominal_sphere
from rigsim.population.files import load_subject
from rigsim.render import Caster, g_buffer, visibility
from rigsim.scenes.reference.directions import (
    DirectionalReflectance,
    normal_reflectance,
    render_directions,
)
from rigsim.scenes.reference.patch import draw_patch, predict_patch, render_patch
from rigsim.scenes.reference.placed_paths import HeadPlace
from rigsim.scenes.reference.probe_skin import read_person
from rigsim.subject.person_skin import PersonSkin
from rigsim.tissue.skin_layers import ETA
from skinrig.drawing import png

IMAGES = Path(__file__).resolve().parents[1] / "docs/images"
PANEL_PX = 256
FLASH_PX, DOME_PX, GRADIENT_PX = 32, 320, 256
PERSON_SEED, PROBE_SEED = 11, 3
PROBE_ANGLES = 24
BALL_TILT_DEG = 75.0
GRADIENT_PATTERN = "x"
LIGHT_NUMBER = 45


def show_ratio(ratio: NDArray[np.float64], span: float) -> NDArray[np.uint8]:
    """Return codes of a ratio: gray is 1, black and white are 1 - span and 1 + span."""
    codes = np.rint(255 * np.clip(0.5 + 0.5 * (ratio - 1.0) / span, 0.0, 1.0)).astype(np.uint8)
    return codes if codes.ndim == 3 else np.repeat(codes[..., None], 3, axis=2)


def show_light(image: NDArray[np.float64], white: float) -> NDArray[np.uint8]:
    """Return sRGB codes of linear light; one channel is gray."""
    rgb = image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
    return png.encode_srgb8(np.clip(rgb / white, 0.0, 1.0))


def write(name: str, panels: list[NDArray[np.uint8]]) -> None:
    """Write panels of one size side by side, 4 white pixels apart."""
    scale = max(PANEL_PX // panels[0].shape[0], 1)
    large = [panel.repeat(scale, axis=0).repeat(scale, axis=1) for panel in panels]
    gap = np.full((large[0].shape[0], 4, 3), 255, np.uint8)
    row = np.concatenate([part for panel in large for part in (gap, panel)][1:], axis=1)
    (IMAGES / name).write_bytes(png.encode(row))
    print(f"{name}: {(IMAGES / name).stat().st_size / 1000:.0f} kB", file=sys.stderr)


def flash() -> None:
    """Draw freckled skin under crossed polarizers."""
    patch = draw_patch(PersonSkin.of_preset("II"), "cheek", field_mm=24.0, voxel_mm=0.375)
    rig = load_rig("flash")
    voxels = render_patch(patch, rig, width_px=FLASH_PX, samples=1024, seed=0).rgb
    fast = predict_patch(patch, rig, width_px=FLASH_PX)
    shown = [show_light(image, fast.max()) for image in (voxels, fast)]
    write("gallery-voxels.png", [*shown, show_ratio(voxels / fast, 0.1)])


def dome() -> None:
    """Draw the light from below the surface of a dark face under one LED of the dome."""
    rig = load_rig("dome").resized(DOME_PX)
    view, light = rig.view("C02"), np.array(rig.lights[LIGHT_NUMBER].position_mm)
    below, truth = render_skin("VI", view.spectral_sensitivity, rig.lights[0].illuminant)
    caster = Caster(load_subject("VI").face(seed=PERSON_SEED, size=128).mesh)
    hits = g_buffer(caster, view)
    on, _, *points = hits.hit_samples()
    place, normal, to_camera = (part.astype(np.float64) for part in points)
    way = light - place
    strength = visibility(caster, points[0], points[1], light) / np.sum(way**2, axis=1)
    ways = way / np.linalg.norm(way, axis=1, keepdims=True), to_camera
    images = np.zeros((2, hits.mask.size, 3))
    images[:, on] = strength[:, None] * reflect(below, truth, normal, *ways)
    shape = (view.height_px, view.width_px, 3)
    side = min(shape[:2])
    cut = np.s_[:side, (shape[1] - side) // 2 : (shape[1] + side) // 2]
    voxels, fast = (image.reshape(shape)[cut] for image in images)
    white = float(np.percentile(fast[fast > 0.0], 99.5))
    shown = [show_light(image, white) for image in (voxels, fast)]
    write("gallery-voxels-dome.png", [*shown, show_ratio(divide(voxels, fast), 0.5)])


def gradient() -> None:
    """Draw a ball of skin under crossed polarizers and a pattern of the gradient rig."""
    rig = load_rig("gradient")
    view, sphere = rig.views[0], nominal_sphere(rig)
    below, truth = render_skin("V", view.spectral_sensitivity, rig.lights[0].illuminant)
    x = (np.arange(GRADIENT_PX) + 0.5) / GRADIENT_PX * 2.0 - 1.0
    normal = np.stack(np.broadcast_arrays(x, -x[:, None], np.zeros((1, 1))), axis=-1)
    flat = np.sum(normal**2, axis=-1)
    normal[..., 2] = np.sqrt(np.clip(1.0 - flat, 0.0, None))
    inside = flat < np.sin(np.radians(BALL_TILT_DEG)) ** 2
    weights = sphere.intensity * (sphere.weights @ np.array(PATTERN_WEIGHTS[GRADIENT_PATTERN]))
    images = np.zeros((2, GRADIENT_PX, GRADIENT_PX))
    for place, weight in zip(sphere.position_mm, weights, strict=True):
        ways = place / np.linalg.norm(place), np.array([0.0, 0.0, 1.0])
        light = reflect(below, truth, normal[inside], *ways)
        images[:, inside] += weight * light.mean(axis=-1)
    voxels, fast = images
    shown = [show_light(image, 1.1 * fast.max()) for image in (voxels, fast)]
    write("gallery-voxels-gradient.png", [*shown, show_ratio(divide(voxels, fast), 0.2)])


def render_skin(
    preset: str, camera: str, illuminant: str
) -> tuple[DirectionalReflectance, NDArray[np.float64]]:
    """Return directional reflection of a person's cheek as voxels, and its R_d by photons."""
    skin = load_subject(preset).skin(seed=PERSON_SEED).at("cheek")
    below = render_directions(skin, camera, illuminant, samples=64, seed=PERSON_SEED)
    return below, normal_reflectance(skin, camera, illuminant)


def reflect(
    below: DirectionalReflectance,
    r_d: NDArray[np.float64],
    normal: NDArray[np.float64],
    to_light: NDArray[np.float64],
    to_camera: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return f_r times cosine of voxels and of a Lambertian interior, shape (2, n, 3)."""
    cosines = [np.sum(normal * way, axis=-1).clip(0.0) for way in (to_light, to_camera)]
    passed = [
        1.0 - 0.5 * sum(a**2 for a in shading.fresnel_amplitudes(cosine, ETA)) for cosine in cosines
    ]
    fast = (passed[0] * passed[1] / np.pi)[:, None] * r_d
    return cosines[0][:, None] * np.stack([below.evaluate(normal, to_light, to_camera), fast])


def divide(image: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ratio of two images, 1 where the second is dark."""
    lit = other > 1e-3 * other.max()
    return np.where(lit, image / np.where(lit, other, 1.0), 1.0)


def probe() -> None:
    """Draw readings of the probe in all directions around a site, up to its farthest fiber."""
    rig = load_rig("probe")
    places = tuple(HeadPlace(angle_deg=360.0 * k / PROBE_ANGLES) for k in range(PROBE_ANGLES))
    person = PersonSkin.of_preset("II", seed=PROBE_SEED)
    options = {"photons": 2000, "laid_paths": 60, "seed": 0}
    read = read_person(person, "cheek", rig, places, **options)
    radius = np.array(rig.probe.radius_mm)
    x = (np.arange(PANEL_PX) + 0.5) / PANEL_PX * 2.0 - 1.0
    far = radius[-1] + 0.5 * (radius[1] - radius[0])
    distance = far * np.hypot(x, x[:, None])
    angle = np.arctan2(-x[:, None], x) / (2.0 * np.pi) % 1.0
    ring = np.abs(distance[..., None] - radius).argmin(axis=-1)
    sector = np.rint(angle * PROBE_ANGLES).astype(int) % PROBE_ANGLES
    inside = (distance < far) & (distance > radius[0] - 0.5 * (radius[1] - radius[0]))
    voxels, flat = read.reflectance_per_mm2[sector, ring], read.even_per_mm2[ring]
    low, high = np.log10(read.even_per_mm2.min()), np.log10(read.even_per_mm2.max())
    shown = [
        np.rint(255 * np.clip((np.log10(part) - low) / (high - low), 0.0, 1.0)).astype(np.uint8)
        for part in (voxels, flat)
    ]
    panels = [*shown, show_ratio(voxels / flat, 0.3)]
    gray = np.uint8(png.INVALID_GRAY)
    write("gallery-voxels-probe.png", [np.where(inside[..., None], p, gray) for p in panels])


def main(only: Sequence[str] = ()) -> None:
    """Make all images, or those of some rigs."""
    began = time.perf_counter()
    IMAGES.mkdir(exist_ok=True)
    for draw in (flash, dome, gradient, probe):
        if not only or draw.__name__ in only:
            draw()
    print(f"{time.perf_counter() - began:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1:])
