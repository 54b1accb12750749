"""Compare the flash rig's closed-form polarization with Mitsuba's polarizers, in time and error.

A sphere of polarizing plastic replaces the face, in front of two point flashes behind polarizers
and a camera behind an analyzer. Mitsuba traces paths through the polarizers; the closed forms
derive both images from one set of rays.
"""

import dataclasses
import math
import time
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from capture.rig import Rig, View, load_rig
from rigsim import shading
from rigsim.arrays import BoolArray, Float32Array
from rigsim.as_built.polarizers import absorbing_axis
from rigsim.geometry.mesh import Mesh, build_mesh, grid_faces
from rigsim.light.subsurface_radiance import direction_and_falloff
from rigsim.render import Caster, g_buffer, look_at, radiance
from rigsim.render.scene_radiance import perspective
from rigsim.render.variant import choose_variant

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

    closed_form_s: float
    """Seconds for both images by closed forms."""
    mitsuba_s: float
    """Seconds for both images by Mitsuba."""
    closed_form_error: dict[str, float]
    """Relative root mean square error of each image by closed forms."""
    mitsuba_error: dict[str, float]
    """The same for Mitsuba's images."""
    mean_ratio: dict[str, float]
    """Mean of Mitsuba's image over that of the reference: 1 up to noise."""

    @property
    def speed_up(self) -> float:
        """Speed-up of the closed forms."""
        return self.mitsuba_s / self.closed_form_s

    @property
    def noise_ratio(self) -> float:
        """Error of Mitsuba over that of the closed forms; the worse of both images."""
        return min(self.mitsuba_error[k] / self.closed_form_error[k] for k in ANALYZER_AXIS_DEG)


def compare_polarizer_models(
    *, width_px: int = 256, samples: int = 64, subpixels: int = 1, seed: int = 0
) -> PolarizerComparison:
    """Render both polarization images of the flash rig by both methods.

    Parameters
    ----------
    width_px
        Side of the square images.
    samples
        Samples per pixel of Mitsuba's path tracer.
    subpixels
        Rays along each side of a pixel of the closed forms.
    seed
        Seed of Mitsuba's sampler.

    Returns
    -------
    PolarizerComparison
        Best times of three alternating runs, and errors. Compilation and the construction of our
        rays' mesh are not timed; parsing of Mitsuba's scene is. Errors are evaluated where the
        sphere covers the whole pixel, against closed forms with twelve rays along each side, on
        which both methods agree up to noise (see ``mean_ratio``).
    """
    rig, view = reference_rig(width_px)
    # One variant for both, so that no time is spent on switching.
    caster = Caster(sphere_mesh(), choice=choose_variant("mono_polarized"))
    render_closed_forms(rig, view, caster, subpixels=subpixels)
    render_polarized_with_mitsuba(rig, view, "parallel", samples=samples, seed=seed)

    closed_form_s = mitsuba_s = math.inf
    for _ in range(3):
        start = time.perf_counter()
        ours = render_closed_forms(rig, view, caster, subpixels=subpixels)
        between = time.perf_counter()
        theirs = {
            name: render_polarized_with_mitsuba(rig, view, name, samples=samples, seed=seed + k)
            for k, name in enumerate(ANALYZER_AXIS_DEG)
        }
        closed_form_s = min(closed_form_s, between - start)
        mitsuba_s = min(mitsuba_s, time.perf_counter() - between)

    truth = render_closed_forms(rig, view, caster, subpixels=12)
    whole = _wholly_covered(view, caster)

    def error(image: Float32Array, name: str) -> float:
        difference = (image - truth[name])[whole].astype(np.float64)
        return float(np.sqrt(np.mean(difference**2)) / truth[name][whole].mean())

    return PolarizerComparison(
        closed_form_s=closed_form_s,
        mitsuba_s=mitsuba_s,
        closed_form_error={name: error(ours[name], name) for name in ANALYZER_AXIS_DEG},
        mitsuba_error={name: error(theirs[name], name) for name in ANALYZER_AXIS_DEG},
        mean_ratio={
            name: float(theirs[name][whole].mean() / truth[name][whole].mean())
            for name in ANALYZER_AXIS_DEG
        },
    )


def render_closed_forms(
    rig: Rig, view: View, caster: Caster, *, subpixels: int
) -> dict[str, Float32Array]:
    """Return both images by closed forms, shape (H, W), in radiance."""
    buffers = g_buffer(caster, view, subpixels=subpixels)
    inside, _, position, normal, to_camera = buffers.hit_samples()
    right, up, _ = view.axes
    leaving = shading.exit_stokes(normal, to_camera, eta=ETA, image_right=right)
    stokes = np.zeros_like(leaving)
    for light in rig.lights:
        to_light, falloff = direction_and_falloff(light, position)
        absorbs = absorbing_axis(light)
        cosine = np.maximum(np.einsum("ij,ij->i", normal, to_light), 0.0)
        entry = shading.entry_transmittance(normal, to_light, eta=ETA, light_absorbs=absorbs)
        lobe = shading.specular_stokes(
            normal,
            to_light,
            to_camera,
            SPHERE_ALPHA,
            eta=ETA,
            light_absorbs=absorbs,
            image_right=right,
        )
        inner = np.float32(SPHERE_ALBEDO / math.pi) * cosine * entry
        stokes += np.float32(FLASH_INTENSITY) * falloff[:, None] * (lobe + inner[:, None] * leaving)
    images = {}
    for name, angle in ANALYZER_AXIS_DEG.items():
        full = np.zeros(buffers.mask.size, np.float32)
        full[inside] = shading.apply_analyzer(
            stokes, to_camera, passes_deg=angle, image_right=right, image_up=up
        )
        shape = (view.height_px, subpixels, view.width_px, subpixels)
        images[name] = full.reshape(shape).mean(axis=(1, 3))
    return images


def render_polarized_with_mitsuba(
    rig: Rig, view: View, name: str, *, samples: int, seed: int
) -> Float32Array:
    """Render one image by Mitsuba's path tracer through polarizers, shape (H, W)."""
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
    place = np.asarray(view.position_mm)
    half = math.tan(0.5 * view.width_px / view.focal_px)
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 8},
        "sensor": perspective(view, "luminance", up=up),
        "analyzer": _polarizer_mesh(
            place - [0.0, 0.0, 10.0], view.target_mm, 15.0 * half, analyzer_deg
        ),
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


def reference_rig(width_px: int) -> tuple[Rig, View]:
    """Return the flash rig and its camera, cropped to a square that the sphere fills."""
    rig = load_rig("flash")
    view = rig.views[0]
    pixel_um = 2.2 * SPHERE_RADIUS_MM / width_px / view.distance_mm * view.focal_mm * 1e3
    square = dataclasses.replace(view, width_px=width_px, height_px=width_px, pixel_um=pixel_um)
    return dataclasses.replace(rig, views=(square,)), square


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


def _wholly_covered(view: View, caster: Caster) -> BoolArray:
    mask = g_buffer(caster, view, subpixels=4).mask
    return np.asarray(mask.reshape(view.height_px, 4, view.width_px, 4).all(axis=(1, 3)))
