"""Render the dome by Mitsuba's own integrators, one light at a time, as a reference.

Mitsuba has no lobe for vellus hair, and supports relief only as a texture in another frame, so the
face that both sides render has neither. Everything else (diffuse term behind the boundary, Beckmann
facets and GGX oil, all from textures) is composed of Mitsuba's own materials.
"""

import dataclasses
import math
import time
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from capture.rig import Rig, View, load_rig
from rigsim.arrays import BoolArray, Float32Array, Float64Array
from rigsim.geometry.atlas import dilate_texture
from rigsim.light.surface_brdf import ETA_OIL, OIL_SMOOTHING, SkinSurface
from rigsim.needs.effects import SceneEffects
from rigsim.render import MovableLightScene, radiance
from rigsim.render.scene_radiance import (
    matte_plastic,
    perspective,
    plastic_scale,
    point_light_rig,
    rough_metal,
)
from rigsim.scenes.dome.scene import DomeScene
from rigsim.subject import SimulatedSubject, make_subject
from rigsim.tissue.skin_layers import ETA

Integrator = Literal["path", "direct"]


@dataclass(frozen=True, slots=True)
class RenderTiming:
    """Time and error of one method that renders the dome's lights one at a time."""

    seconds: float
    """Time per light, s; for ours with its fraction of the camera rays, which serve all lights."""
    error: float
    """Root mean square error over all images, relative to their mean."""
    mean_ratio: float
    """Mean of its images over that of the reference."""
    squared_by_tile: Float64Array
    """Squared relative error per tile of 16 x 16 pixels that shows skin, for its standard error."""


@dataclass(frozen=True, slots=True)
class IntegratorComparison:
    """Three methods for one view of the dome, with the same number of rays per pixel."""

    ours: RenderTiming
    path: RenderTiming
    """Mitsuba's path tracer, direct light only."""
    direct: RenderTiming
    """Mitsuba's direct integrator, which samples the light only."""

    def speed_up(self, timing: RenderTiming) -> float:
        """Speed-up of ours at equal noise; the square of the noise ratio counts as time."""
        return timing.seconds / self.ours.seconds * min(1.0, (timing.error / self.ours.error) ** 2)


def plain_face(preset: str = "III", *, size: int = 512) -> SimulatedSubject:
    """Return a face whose normals are those of its mesh, without pores and wrinkles."""
    face = make_subject(preset, size=size)
    return dataclasses.replace(face, normal=face.atlas.normal)


DIRECT_LIGHT_EFFECTS: Final = SceneEffects(lateral=False, interreflections=False)


class DirectScene(DomeScene):
    """A dome with direct light only, unless requested otherwise."""

    def __init__(self, rig: Rig, subject: SimulatedSubject, **settings: Any) -> None:
        super().__init__(rig, subject, **({"effects": DIRECT_LIGHT_EFFECTS} | settings))


class PlainScene(DirectScene):
    """A dome whose skin has neither vellus hair nor brows."""

    def _surface(self, camera: str) -> SkinSurface:
        surface = super()._surface(camera)
        none = np.zeros_like(surface.fuzz)
        return dataclasses.replace(surface, fuzz=none, bare=np.ones_like(none))


def compare_integrators(
    *,
    width_px: int,
    lights: int,
    subpixels: int = 2,
    reference_subpixels: int = 6,
    rounds: int = 2,
    sampler: str = "stratified",
) -> IntegratorComparison:
    """Render one view of the dome by three methods, one light at a time.

    Parameters
    ----------
    width_px
        Width of the images.
    lights
        Number of rendered lights, distributed over the dome.
    subpixels
        Rays along each side of our pixels; Mitsuba gets as many samples.
    reference_subpixels
        Rays along each side of the reference's pixels.
    rounds
        Number of repetitions; the fastest counts.
    sampler
        Mitsuba's; "stratified" is its least noisy one here, "independent" its default.

    Returns
    -------
    IntegratorComparison
        The three methods alternate at each light. Compilation, parsing and the construction of
        meshes are not timed; tracing our camera rays is.
    """
    rig = point_light_rig(load_rig("dome").resized(width_px).subset(views=["C02"]))
    view, face = rig.views[0], plain_face()
    chosen = [int(k) for k in np.linspace(0, len(rig.lights) - 1, lights).round()]
    fine_scene = PlainScene(rig, face, subpixels=reference_subpixels)
    reference = np.stack([_per_steradian(fine_scene, k) for k in chosen])
    theirs = {
        name: MovableLightScene(describe_dome(fine_scene, view, name, sampler=sampler), kind="rgb")
        for name in _INTEGRATOR_SETTINGS
    }
    del fine_scene
    samples = subpixels**2
    for renderer in theirs.values():
        renderer.radiance((0.0, 0.0, 700.0), samples=samples)
    _per_steradian(PlainScene(rig, face, subpixels=subpixels), 0)
    best = {"ours": math.inf, "path": math.inf, "direct": math.inf}
    images: dict[str, list[Float32Array]] = {}
    for _ in range(rounds):
        spent = dict.fromkeys(best, 0.0)
        images = {name: [] for name in best}
        scene = PlainScene(rig, face, subpixels=subpixels)
        scene.surface(view)
        start = time.perf_counter()
        scene.radiance(view.name, [chosen[0]])
        first = time.perf_counter() - start
        for n, k in enumerate(chosen):
            start = time.perf_counter()
            scene.radiance(view.name, [k])
            spent["ours"] += time.perf_counter() - start
            images["ours"].append(_per_steradian(scene, k))
            for name, renderer in theirs.items():
                start = time.perf_counter()
                image = renderer.radiance(rig.lights[k].position_mm, samples=samples, seed=n)
                spent[name] += time.perf_counter() - start
                images[name].append(2.0 * image[..., :3])
        look = max(first - spent["ours"] / lights, 0.0)
        spent["ours"] += look * lights / len(rig.lights)
        best = {name: min(best[name], spent[name] / lights) for name in best}

    def way(name: str) -> RenderTiming:
        found = np.stack(images[name])
        difference = (found - reference).astype(np.float64)
        error = float(np.sqrt(np.mean(difference**2)) / reference.mean())
        squared = _mean_square_by_tile(difference / reference.mean(), reference > 0.0)
        return RenderTiming(best[name], error, float(found.mean() / reference.mean()), squared)

    return IntegratorComparison(way("ours"), way("path"), way("direct"))


def _mean_square_by_tile(
    difference: Float64Array, shown: BoolArray, side: int = 16
) -> Float64Array:
    """Return the mean square per tile of images (L, H, W, 3), without tiles that show no skin."""
    squared = np.mean(difference**2, axis=(0, 3))
    seen = np.asarray(shown.any(axis=(0, 3)))
    rows, columns = (n // side * side for n in squared.shape)
    tiles = (rows // side, side, columns // side, side)
    mean = squared[:rows, :columns].reshape(tiles).mean(axis=(1, 3))
    return np.asarray(mean[seen[:rows, :columns].reshape(tiles).any(axis=(1, 3))])


def _per_steradian(scene: PlainScene, light: int) -> Float32Array:
    """Return an image of the first view under a light of intensity 1 per steradian."""
    image = scene.radiance(scene.rig.views[0].name, [light])[0]
    return np.asarray(image / scene.intensity(light) / np.float32(math.pi), np.float32)


def render_with_mitsuba(
    scene: PlainScene, view: View, light: dict[str, Any], *, samples: int, seed: int
) -> Float32Array:
    """Render one image by Mitsuba's path tracer, shape (H, W, 3), for any described light."""
    description = describe_dome(scene, view, "path") | {"light": light}
    return radiance(description, kind="rgb", samples=samples, seed=seed)[..., :3]


_INTEGRATOR_SETTINGS: dict[Integrator, dict[str, Any]] = {
    "path": {"type": "path", "max_depth": 2},
    "direct": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
}


def describe_dome(
    scene: PlainScene, view: View, integrator: Integrator, *, sampler: str = "independent"
) -> dict[str, Any]:
    """Return Mitsuba's scene of a face in the dome, lit by a point of intensity 1 per steradian."""
    subject = _face(scene)
    return _camera_and_light(view, sampler) | {
        "integrator": _INTEGRATOR_SETTINGS[integrator],
        "face": {"type": "mesh", "mesh": subject.mesh, "bsdf": _skin(scene.surface(view), subject)},
    }


def _camera_and_light(view: View, sampler: str = "independent") -> dict[str, Any]:
    """Return a scene with a camera and a point of intensity 1 per steradian."""
    return {
        "type": "scene",
        "sensor": perspective(view, "rgb", sampler=sampler),
        "light": {
            "type": "point",
            "position": [0.0, 0.0, 700.0],
            "intensity": {"type": "rgb", "value": [1.0, 1.0, 1.0]},
        },
    }


def _face(scene: DomeScene) -> SimulatedSubject:
    if not isinstance(scene.subject, SimulatedSubject):
        raise TypeError(f"subject: got the target {scene.subject.name!r}, expected a face")
    return scene.subject


def _skin(surface: SkinSurface, subject: SimulatedSubject) -> dict[str, Any]:
    """Return our reflection as a blend of Mitsuba's materials, at half its strength.

    Mitsuba's ``plastic`` divides by 1 minus the inner diffuse reflectance and by the index squared.
    The R_d of the rendered face is twice ours times that factor, since a blend averages.
    """
    covered = subject.atlas.covered
    rough = surface.roughness
    smoothed = np.float32(OIL_SMOOTHING) * rough
    return {
        "type": "blendbsdf",
        "weight": 0.5,
        "inside": _matte_material(surface, subject),
        "outside": {
            "type": "blendbsdf",
            "weight": _texture(surface.oil, covered),
            "skin": rough_metal("beckmann", ETA, _texture(rough, covered)),
            "oil": rough_metal("ggx", ETA_OIL, _texture(smoothed, covered)),
        },
    }


def _matte_material(surface: SkinSurface, subject: SimulatedSubject) -> dict[str, Any]:
    """Return the diffuse term behind the boundary, without the specular lobe above it."""
    r_d = surface.r_d * np.float32(plastic_scale(ETA))
    return matte_plastic(ETA, _texture(r_d, subject.atlas.covered))


def _texture(values: Float32Array, covered: BoolArray) -> dict[str, Any]:
    filled = np.flipud(dilate_texture(values, covered))  # Mitsuba's v runs down the rows
    return {
        "type": "bitmap",
        "bitmap": filled if filled.ndim == 3 else filled[..., None],
        "raw": True,
        "filter_type": "bilinear",
        "wrap_mode": "clamp",
    }
