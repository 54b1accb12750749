"""Compare the flash rig's renderer with Mitsuba's polarizers, in time and error.

A sphere of polarizing plastic replaces the face, in front of two point flashes behind polarizers
and a camera behind an analyzer. Mitsuba's `volpath` traces paths through the polarizers; `olat`
derives both images from one set of rays.
"""

import dataclasses
import math
import time
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from capture.rig import Rig, View, load_rig
from rigsim import shading
from rigsim.arrays import Float32Array
from rigsim.as_built.polarizers import IDEAL_POLARIZERS, Polarizers
from rigsim.geometry.mesh import Mesh, build_mesh, grid_faces
from rigsim.mitsuba.scene_radiance import look_at, perspective, radiance
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import choose_variant
from rigsim.scenes.flash.surfaces import FlashLights, MitsubaSurface

SPHERE_RADIUS_MM: Final = 80.0
ETA: Final = 1.4
SPHERE_ALPHA: Final = 0.25
SPHERE_ALBEDO: Final = 0.5
FLASH_INTENSITY: Final = 1e6
"""Radiant intensity of each flash per steradian before its polarizer."""

ANALYZER_AXIS_DEG: Final = {"parallel": 90.0, "crossed": 0.0}
"""Transmission axis of the analyzer; both flashes emit vertically polarized light."""


@dataclass(frozen=True, slots=True)
class PolarizerComparison:
    """Time and error of both methods, for the parallel and the crossed image together."""

    olat_s: float
    """Seconds for both images by `olat`."""
    volpath_s: float
    """Seconds for both images by `volpath`."""
    olat_error: dict[str, float]
    """Relative root mean square error of each image by `olat`."""
    volpath_error: dict[str, float]
    """The same by `volpath`."""
    mean_ratio: dict[str, float]
    """Mean of `volpath`'s image over that of the reference: 1 up to noise."""

    @property
    def speed_up(self) -> float:
        """Speed-up of `olat`."""
        return self.volpath_s / self.olat_s

    @property
    def noise_ratio(self) -> float:
        """Error of `volpath` over that of `olat`; the worse of both images."""
        return min(self.volpath_error[k] / self.olat_error[k] for k in ANALYZER_AXIS_DEG)


def compare_polarizer_models(
    *, width_px: int = 256, samples: int = 64, subpixels: int = 1, seed: int = 0
) -> PolarizerComparison:
    """Render both polarization images of the flash rig by both methods.

    Parameters
    ----------
    width_px
        Side of the square images.
    samples
        Samples per pixel of `volpath`.
    subpixels
        Rays along each side of a pixel of `olat`.
    seed
        Seed of the sampler of `volpath`.

    Returns
    -------
    PolarizerComparison
        Best times of three alternating runs, and errors. Compilation and the construction of the
        sphere's mesh are not timed; parsing of the other scene is. Errors are evaluated where the
        sphere covers the whole pixel, against `olat` with twelve rays along each side, on which
        both methods agree up to noise (see ``mean_ratio``).
    """
    rig, view = reference_rig(width_px)
    sphere = plastic_sphere(rig)
    render_by_olat(sphere, view, subpixels=subpixels)
    render_polarized_with_mitsuba(rig, view, "parallel", samples=samples, seed=seed)

    olat_s = volpath_s = math.inf
    for _ in range(3):
        load_mitsuba(choose_variant("rgb"))
        start = time.perf_counter()
        ours = render_by_olat(sphere, view, subpixels=subpixels)
        olat_s = min(olat_s, time.perf_counter() - start)
        load_mitsuba(choose_variant("mono_polarized"))
        start = time.perf_counter()
        theirs = {
            name: render_polarized_with_mitsuba(rig, view, name, samples=samples, seed=seed + k)
            for k, name in enumerate(ANALYZER_AXIS_DEG)
        }
        volpath_s = min(volpath_s, time.perf_counter() - start)

    truth = render_by_olat(sphere, view, subpixels=12)
    whole = sphere.trace(view, 4, (0, view.height_px)).coverage() == 1.0

    def error(image: Float32Array, name: str) -> float:
        difference = (image - truth[name])[whole].astype(np.float64)
        return float(np.sqrt(np.mean(difference**2)) / truth[name][whole].mean())

    return PolarizerComparison(
        olat_s=olat_s,
        volpath_s=volpath_s,
        olat_error={name: error(ours[name], name) for name in ANALYZER_AXIS_DEG},
        volpath_error={name: error(theirs[name], name) for name in ANALYZER_AXIS_DEG},
        mean_ratio={
            name: float(theirs[name][whole].mean() / truth[name][whole].mean())
            for name in ANALYZER_AXIS_DEG
        },
    )


def plastic_sphere(rig: Rig, polarizers: Polarizers = IDEAL_POLARIZERS) -> MitsubaSurface:
    """Return the sphere as a `skincoat` in front of the rig's flashes behind their polarizers."""
    plastic = {
        "type": "skincoat",
        "distribution": "ggx",
        "int_ior": ETA,
        "r_d": SPHERE_ALBEDO,
        "alpha": SPHERE_ALPHA,
    }
    weights = np.full(len(rig.lights), FLASH_INTENSITY)
    flashes = FlashLights(rig.lights, polarizers, weights)
    return MitsubaSurface(sphere_mesh(), plastic, flashes, choose_variant("rgb"))


def render_by_olat(
    sphere: MitsubaSurface, view: View, *, subpixels: int
) -> dict[str, Float32Array]:
    """Return both images by `olat`, shape (H, W), in radiance."""
    hits = sphere.trace(view, subpixels, (0, view.height_px))
    inside, facets = sphere.reflected(hits, view)
    stokes = (facets + inside[:, :1] * sphere.leaving(hits, view)) / np.float32(np.pi)
    way = np.asarray(view.position_mm, np.float32) - hits.position_mm
    to_camera = way / np.linalg.norm(way, axis=1, keepdims=True)
    right, up, _ = view.axes
    images = {}
    for name, angle in ANALYZER_AXIS_DEG.items():
        light = shading.apply_analyzer(
            stokes, to_camera, passes_deg=angle, image_right=right, image_up=up
        )
        images[name] = hits.average(light[:, None])[..., 0] * hits.coverage()
    return images


def render_polarized_with_mitsuba(
    rig: Rig, view: View, name: str, *, samples: int, seed: int
) -> Float32Array:
    """Render one image by Mitsuba's `volpath` through polarizers, shape (H, W)."""
    image = radiance(
        describe_polarized_rig(rig, view, ANALYZER_AXIS_DEG[name]),
        kind="mono_polarized",
        samples=samples,
        seed=seed,
    )
    return np.asarray(image[..., 0], np.float32)


def describe_polarized_rig(rig: Rig, view: View, analyzer_deg: float) -> dict[str, Any]:
    """Return Mitsuba's scene of the rig with polarizers on the lights and the camera."""
    up = (0.0, 1.0, 0.0)
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 8},
        "sensor": perspective(view, "luminance", up=up),
        "analyzer": describe_analyzer(view, analyzer_deg),
        "ball": {
            "type": "sphere",
            "radius": SPHERE_RADIUS_MM,
            "bsdf": {
                "type": "pplastic",
                "diffuse_reflectance": {"type": "uniform", "value": SPHERE_ALBEDO},
                "int_ior": ETA,
                "ext_ior": 1.0,
                "alpha": SPHERE_ALPHA,
                "distribution": "ggx",
            },
        },
    }
    for light in rig.lights:
        where = np.asarray(light.position_mm)
        scene[f"light {light.name}"] = {
            "type": "point",
            "position": where.tolist(),
            "intensity": {"type": "uniform", "value": FLASH_INTENSITY},
        }
        before = where * (1.0 - 2.0 / float(np.linalg.norm(where)))
        axis_deg = light.polarizer_axis_deg
        if axis_deg is not None:
            scene[f"film {light.name}"] = _polarizer_mesh(before, (0.0, 0.0, 0.0), 2.0, axis_deg)
    return scene


def describe_analyzer(view: View, passes_deg: float) -> dict[str, Any]:
    """Return Mitsuba's description of a polarizer in front of a camera."""
    before = np.asarray(view.position_mm) - [0.0, 0.0, 10.0]
    half = math.tan(0.5 * view.width_px / view.focal_px)
    return _polarizer_mesh(before, view.target_mm, 15.0 * half, passes_deg)


def reference_rig(width_px: int) -> tuple[Rig, View]:
    """Return the flash rig with point flashes, its camera cropped to a square around the sphere."""
    rig = load_rig("flash")
    view = rig.views[0]
    pixel_um = 2.2 * SPHERE_RADIUS_MM / width_px / view.distance_mm * view.focal_mm * 1e3
    square = dataclasses.replace(view, width_px=width_px, height_px=width_px, pixel_um=pixel_um)
    points = tuple(dataclasses.replace(light, radius_mm=1e-3) for light in rig.lights)
    return dataclasses.replace(rig, views=(square,), lights=points), square


def sphere_mesh(*, columns: int = 480, rows: int = 240) -> Mesh:
    """Return a fine sphere with exact normals; its pole is at the top."""
    theta = np.pi * np.arange(rows + 1) / rows
    phi = 2.0 * np.pi * np.arange(columns + 1) / columns
    t, p = np.meshgrid(theta, phi, indexing="ij")
    unit = np.stack([-np.sin(t) * np.sin(p), np.cos(t), -np.sin(t) * np.cos(p)], axis=-1)
    uv = np.stack([p / (2.0 * np.pi), 1.0 - t / np.pi], axis=-1).reshape(-1, 2)
    flat, faces = unit.reshape(-1, 3), grid_faces(rows + 1, columns + 1)
    return build_mesh(SPHERE_RADIUS_MM * flat, faces, np.clip(uv, 0.0, 1.0), flat)


def _polarizer_mesh(position: Any, faces: Any, half_mm: float, passes_deg: float) -> dict[str, Any]:
    matrix = look_at(position, faces, (0.0, 1.0, 0.0))
    matrix[:3, :3] *= half_mm
    return {
        "type": "rectangle",
        "to_world": matrix,
        "bsdf": {"type": "polarizer", "theta": {"type": "spectrum", "value": passes_deg}},
    }
