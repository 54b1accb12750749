"""Render the dome by Mitsuba's own integrators, one light at a time, as a reference.

Mitsuba has no lobe for vellus hair, and supports relief only as a texture in another frame, so the
face that both sides render has neither. Everything else (diffuse term behind the boundary, Beckmann
facets and GGX oil, all from textures) is composed of Mitsuba's own materials.
"""

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Literal, get_args

import numpy as np

from capture.rig import Rig, View, load_rig
from rigsim.arrays import BoolArray, Float32Array, Float64Array
from rigsim.geometry.atlas import dilate_texture
from rigsim.light.skin_material import describe_skin
from rigsim.light.surface_brdf import ETA_OIL, OIL_SMOOTHING, SkinSurface
from rigsim.mitsuba.led_array import led_table
from rigsim.mitsuba.rig_camera import describe_camera
from rigsim.mitsuba.scene_radiance import (
    MovableLightScene,
    load_description,
    matte_plastic,
    perspective,
    plastic_scale,
    point_light_rig,
    radiance,
    rough_metal,
)
from rigsim.mitsuba.startup import load_mitsuba
from rigsim.mitsuba.variant import Renderer, choose_renderer, choose_variant
from rigsim.needs.effects import SceneEffects
from rigsim.scenes.dome.scene import DomeScene
from rigsim.subject import SimulatedSubject, make_subject
from rigsim.tissue.skin_layers import ETA

Integrator = Literal["path", "direct"]


@dataclass(frozen=True, slots=True)
class RenderTiming:
    """Time and error of one method that renders the dome's lights one at a time."""

    seconds: float
    """Processor seconds per light; ours include their fraction of the camera rays, which serve all
    lights."""
    error: float
    """Root mean square error over all images, relative to their mean."""
    mean_ratio: float
    """Mean of its images over that of the reference."""
    squared_by_tile: Float64Array
    """Squared relative error per tile of 16 x 16 pixels that shows skin, for its standard error."""

    def cost_over(self, other: "RenderTiming") -> float:
        """Return the cost over another method's at equal noise: its square counts as time."""
        return self.seconds / other.seconds * (self.error / other.error) ** 2


Method = Literal["olat", "fast", "path", "direct"]
"""Ours by Mitsuba's scene and by compiled loops; Mitsuba's path tracer and direct integrator, which
samples the light only, both with direct light only."""


def plain_face(preset: str = "III", *, size: int = 512) -> SimulatedSubject:
    """Return a face whose normals are those of its mesh, without pores and wrinkles."""
    face = make_subject(preset, size=size)
    level = np.zeros_like(face.height_um)
    return dataclasses.replace(face, normal=face.atlas.normal, height_um=level)


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


class MattScene(DirectScene):
    """A dome whose skin does not shine: the diffuse term behind the boundary alone."""

    def _surface(self, camera: str) -> SkinSurface:
        surface = super()._surface(camera)
        return dataclasses.replace(surface, bare=np.zeros_like(surface.bare))


def compare_integrators(
    *,
    width_px: int,
    lights: int,
    subpixels: int = 2,
    reference_subpixels: int = 6,
    rounds: int = 2,
    sampler: str = "stratified",
    texels: int = 512,
) -> dict[Method, RenderTiming]:
    """Render one view of the dome by several methods, one light at a time.

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
    texels
        Texels along each side of the face's maps.

    Returns
    -------
    dict
        The methods alternate at each light. Compilation, parsing and the construction of meshes
        are not timed; tracing our camera rays is.
    """
    rig = point_light_rig(load_rig("dome").resized(width_px).subset(views=["C02"]))
    view, face = rig.views[0], plain_face(size=texels)
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
    best: dict[Method, float] = {}
    images: dict[Method, list[Float32Array]] = {}
    for _ in range(1 + rounds):  # the first compiles
        spent: dict[Method, float] = dict.fromkeys(get_args(Method), 0.0)
        images = {name: [] for name in spent}
        ours: dict[Method, PlainScene] = {}
        for name in _OWN_RENDERERS:
            choice = choose_renderer(_OWN_RENDERERS[name])
            scene = PlainScene(rig, face, subpixels=subpixels, choice=choice)
            scene.surface(view)
            once = partial(scene.radiance, view.name, [chosen[0]])
            first, again = _processor_seconds(once), _processor_seconds(once)
            spent[name] += max(first - again, 0.0) * lights / len(rig.lights)
            ours[name] = scene
        for n, k in enumerate(chosen):
            for name, scene in ours.items():
                spent[name] += _processor_seconds(partial(scene.radiance, view.name, [k]))
                images[name].append(_per_steradian(scene, k))
            for name, renderer in theirs.items():
                begin = time.process_time()
                image = renderer.radiance(rig.lights[k].position_mm, samples=samples, seed=n)
                spent[name] += time.process_time() - begin
                images[name].append(2.0 * image[..., :3])
        best = {k: min(best.get(k, math.inf), s / lights) for k, s in spent.items() if images[k]}

    def timing(name: Method) -> RenderTiming:
        found = np.stack(images[name])
        difference = (found - reference).astype(np.float64)
        error = float(np.sqrt(np.mean(difference**2)) / reference.mean())
        squared = _mean_square_by_tile(difference / reference.mean(), reference > 0.0)
        return RenderTiming(best[name], error, float(found.mean() / reference.mean()), squared)

    return {name: timing(name) for name in best}


_OWN_RENDERERS: Final[dict[Method, Renderer]] = {"olat": "mitsuba", "fast": "fast"}


def _processor_seconds(call: Callable[[], object]) -> float:
    begin = time.process_time()
    call()
    return time.process_time() - begin


OLAT_ROUNDING: Final = 2e-4
"""Relative error of `olat` by its 16-bit stored normals and reflectances."""


def measure_agreement_with_path(
    *,
    width_px: int = 48,
    runs: int = 25,
    samples: int = 4096,
    subpixels: int = 64,
    texels: int = 512,
) -> float:
    """Return the fraction of pixels where `olat` is within 3 standard errors of Mitsuba's `path`.

    Both render one scene: a face with relief, oil and vellus hair in front of a small LED.

    Parameters
    ----------
    width_px
        Width of the image.
    runs, samples
        Runs of the path tracer with different seeds, for its standard error, and samples per pixel
        of each.
    subpixels
        Rays of `olat` along each side of a pixel.
    texels
        Texels along each side of the face's maps.
    """
    rig = point_light_rig(load_rig("dome").resized(width_px).subset(views=["C02"]))
    scene, light = DirectScene(rig, make_subject("III", size=texels)), rig.lights[45]
    place = np.array(light.position_mm)
    mi = load_mitsuba(choose_variant("rgb"))
    described = load_description(
        mi,
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 2},
            "sensor": describe_camera(rig.views[0]),
            "skin": {
                "type": "mesh",
                "mesh": _face(scene).mesh,
                "bsdf": describe_skin(scene.texture(rig.views[0])),
            },
            "led": {"type": "ledarray", "table": led_table(place, -place / np.linalg.norm(place))},
        },
    )
    images = np.stack([mi.render(described, spp=samples, seed=k).numpy() for k in range(runs)])
    mean, error = images.mean(axis=0), images.std(axis=0, ddof=1) / math.sqrt(runs)
    olat = mi.load_dict({"type": "olat", "subpixels": subpixels})
    difference = np.abs(mi.render(described, integrator=olat).numpy() - mean)
    lit = mean > 1e-3 * mean.max()
    return float((difference < 3.0 * np.hypot(error, OLAT_ROUNDING * mean))[lit].mean())


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
