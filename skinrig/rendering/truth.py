"""Build a model of a simulated face from its ground truth, for tests and benchmarks.

The simulator's surface is tabulated at several roughnesses, with and without oil; weights between
them are linear. Nothing is fitted, so that errors of its renderings are those of the renderer.
"""

from functools import lru_cache, partial
from typing import Final

import numpy as np

from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from model.skin_reflectance import SkinReflectance
from rigsim.geometry.atlas import dilate_texture
from rigsim.light import surface_brdf
from rigsim.scenes.dome.scene import DomeScene
from rigsim.subject import SimulatedSubject
from skinrig.arrays import Float32Array, Float64Array
from skinrig.rendering.lights import Light

TRUE_ROUGHNESS_NODES: Final = np.linspace(0.12, 0.6, 9)
"""Roughness values of the tables."""
MIN_TABLE_COSINE: Final = 0.02
"""Minimum cosine of tabulated directions; lower ones get the value at 89 degrees."""
HAIR_OPTICAL_DEPTH: Final = 1e-3
"""Optical depth of the table of vellus hair."""


@lru_cache(maxsize=1)
def tabulate_true_lobes() -> BrdfBasis:
    """Tabulate facets at each roughness, without and with oil, and vellus hair."""
    materials = {}
    for roughness in TRUE_ROUGHNESS_NODES:
        for oil in (0.0, 1.0):
            materials[f"facets {roughness:.2f} oil {oil:g}"] = partial(_lobe, roughness, oil, 0.0)
    return brdf_tables.tabulate({**materials, "hair": _hair})


def build_true_model(scene: DomeScene, view: str, *, binning: int = 1) -> SkinReflectance:
    """Build a model from the ground truth of a scene.

    Parameters
    ----------
    scene
        A dome with a static face, without subsurface scattering.
    view
        Camera, for its spectral sensitivity.
    binning
        Ground truth texels along a side of a model texel.

    Returns
    -------
    SkinReflectance
        Model with brows and lashes; its translucency of 1 mm is a placeholder.
    """
    if not isinstance(scene.subject, SimulatedSubject):
        raise TypeError(f"scene: got the target {scene.subject.name!r}, expected a face")
    surface, atlas = scene.surface(scene.rig.view(view)), scene.subject.atlas
    at = (surface.roughness - TRUE_ROUGHNESS_NODES[0]) / (
        TRUE_ROUGHNESS_NODES[1] - TRUE_ROUGHNESS_NODES[0]
    )
    hat = np.maximum(1.0 - np.abs(at[..., None] - np.arange(len(TRUE_ROUGHNESS_NODES))), 0.0)
    oil, bare = surface.oil[..., None], surface.bare[..., None]
    shares = np.stack([hat * (1.0 - oil), hat * oil], axis=-1).reshape(*at.shape, -1)
    layers = [surface.r_d, surface.normal, atlas.position_mm]
    layers += [bare * shares, bare * surface.fuzz[..., None] / HAIR_OPTICAL_DEPTH]
    covered = atlas.covered
    values = np.concatenate(layers, axis=-1).astype(np.float32)
    size = at.shape[0] // binning
    count = covered.reshape(size, binning, size, binning).sum(axis=(1, 3))
    total = np.where(covered[..., None], values, 0.0).reshape(size, binning, size, binning, -1)
    mean = total.sum(axis=(1, 3)) / np.maximum(count, 1)[..., None]
    wide = dilate_texture(mean.astype(np.float32), count > 0)
    length = np.linalg.norm(wide[..., 3:6], axis=-1, keepdims=True)
    return SkinReflectance(
        r_d=wide[..., :3],
        weights=np.maximum(wide[..., 9:], 0.0),
        lobes=tabulate_true_lobes(),
        translucency_mm=np.ones((size, size, 3), np.float32),
        normals=wide[..., 3:6] / np.maximum(length, 1e-6),
        position_mm=wide[..., 6:9],
        valid=count > 0,
    )


def build_true_light(scene: DomeScene, index: int, view: str) -> Light:
    """Build one of a dome's lights, in the unit of the simulator's images."""
    led = scene.rig.lights[index]
    x, y, z = led.position_mm
    away = float(np.linalg.norm(led.position_mm))
    half = 60.0 if led.half_intensity_deg is None else led.half_intensity_deg
    red, green, blue = (scene.intensity(index, view_name=view) / away**2).tolist()
    return Light(
        name=led.name,
        position_mm=(x, y, z),
        radius=led.radius_mm,
        reference_mm=away,
        intensity=(red, green, blue),
        exponent=float(np.log(0.5) / np.log(np.cos(np.radians(half)))),
    )


def _lobe(
    roughness: float, oil: float, fuzz: float, light: Float64Array, view: Float64Array
) -> Float64Array:
    packed = np.array([0.0, 0.0, 0.0, roughness, oil, fuzz, 1.0], np.float32)
    up = np.array([0.0, 0.0, 1.0], np.float32)
    to_light, to_view = (_above_horizon(w.reshape(-1, 3)) for w in (light, view))
    found = surface_brdf.evaluate_brdf(packed, up, to_light, to_view)[1]
    return np.asarray(found.reshape(light.shape[:-1]), np.float64)


def _above_horizon(directions: Float64Array) -> Float32Array:
    """Clip directions above the horizon, where the hair's radiance would diverge."""
    up = np.maximum(directions[:, 2:], MIN_TABLE_COSINE)
    across = np.linalg.norm(directions[:, :2], axis=-1, keepdims=True)
    scale = np.sqrt(1.0 - up**2) / np.maximum(across, 1e-9)
    flat = np.where(
        across > np.sqrt(1.0 - MIN_TABLE_COSINE**2), directions[:, :2] * scale, directions[:, :2]
    )
    return np.ascontiguousarray(np.concatenate([flat, up], axis=-1), np.float32)


def _hair(light: Float64Array, view: Float64Array) -> Float64Array:
    return _lobe(0.3, 0.0, HAIR_OPTICAL_DEPTH, light, view) - _lobe(0.3, 0.0, 0.0, light, view)
