"""Describe a simulated gradient session's scenes: relaxed skin below polarized LEDs, analyzer."""

import dataclasses
from pathlib import Path
from typing import Final

import numpy as np

from capture.rig import Rig, View
from capture.session import Session
from model.skin import SkinAppearance
from rigsim import shading
from rigsim.as_built.polarizers import Polarizers, draw_polarizers
from rigsim.as_built.sphere import (
    PATTERN_WEIGHTS,
    REFERENCE_DISTANCE_MM,
    ActualSphere,
    build_sphere,
)
from rigsim.light.led_light import lobe_exponent
from rigsim.scenes.gradient.lighting import lit_leds
from rigsim.scenes.gradient.patch import SHADOW_MARGIN_PX, PatchSurface
from rigsim.scenes.gradient.rendering import CORNER_OFFSET, RAY_OFFSET_MM, relief_grid
from rigsim.tissue.skin_layers import ETA
from skinrig.arrays import Float32Array
from skinrig.exporting.mitsuba import skin
from skinrig.exporting.mitsuba.cameras import describe_rig_camera, describe_view, record_view
from skinrig.exporting.mitsuba.dome import FACE_EFFECTS, PATH_DEFAULTS
from skinrig.exporting.mitsuba.lights import Levels, SceneLight
from skinrig.exporting.mitsuba.readme import GRADIENT_README
from skinrig.exporting.mitsuba.rig_scene import (
    POLARIZED_SCENE_FILE,
    POLARIZED_STOCK_FILE,
    RigScene,
    SceneFile,
    analyzer_angles_deg,
    describe_analyzed,
    describe_path,
)
from skinrig.exporting.mitsuba.surface_file import read_surface

OLAT_DEFAULTS: Final = {"samples": 1, "subpixels": 1}
"""One ray per pixel, at a corner of the topography, as in the session."""


def build_scene(session: Session, truth: SkinAppearance, folder: Path) -> RigScene:
    """Write topography and maps of a gradient session's skin, and describe its scenes.

    Parameters
    ----------
    session, truth
        Session with its ground truth.
    folder
        Existing folder.
    """
    surface = read_surface(truth, session.path)
    unit = float(surface.pop("unit"))
    patch = PatchSurface(**surface)  # type: ignore[arg-type]
    rig, polarizers = session.rig, draw_polarizers(session.rig)
    view = crop_view(rig.views[0], patch)
    sphere = build_sphere(rig, seed=session.seed or 0)
    leds = list_lights(sphere, polarizers, unit)
    maps = skin.write_maps(
        describe_maps(patch), relief_grid(patch), folder, specular_parts=skin.POLARIZED_PARTS
    )
    files = {}
    for name in analyzer_angles_deg(polarizers, view):
        coat = skin.describe_face(skin.describe_skin_coat(maps, is_ggx=True))
        olat = describe_analyzed(polarizers, view, name, offset_mm=RAY_OFFSET_MM)
        plugins = [olat, describe_rig_camera(aim_at_corners(view)), *coat]
        plain = skin.describe_face(skin.describe_polarized_skin(name, "normals" in maps))
        stock = [describe_path(), describe_view(view), *plain]
        files[POLARIZED_SCENE_FILE.format(name)] = SceneFile(plugins, OLAT_DEFAULTS, is_stock=False)
        files[POLARIZED_STOCK_FILE.format(name)] = SceneFile(stock, PATH_DEFAULTS, is_stock=True)
    return RigScene(
        files,
        leds,
        list_patterns(sphere),
        maps,
        [record_view(view, 1.0)],
        GRADIENT_README,
        "fraction of full scale per second at level 1",
        FACE_EFFECTS | {"polarization"},
        {
            "state": "relaxed, without drift",
            "analyzer_deg": analyzer_angles_deg(polarizers, view),
            "analyzer_leak": 1.0 / polarizers.analyzer_extinction,
        },
    )


def list_patterns(sphere: ActualSphere) -> Levels:
    """Return the level of each LED of `list_lights` in each lit pattern."""
    up = list(lit_leds(sphere, shadows=True))
    return {
        name: np.maximum(sphere.weights[up] @ np.array(weights), 0.0)
        for name, weights in PATTERN_WEIGHTS.items()
        if any(weights)
    }


def crop_view(view: View, patch: PatchSurface) -> View:
    """Return the camera whose pixels are the samples of a patch without its margin."""
    rows, columns = (n - 2 * SHADOW_MARGIN_PX for n in patch.skin.shape)
    return dataclasses.replace(view, width_px=columns, height_px=rows)


def aim_at_corners(view: View) -> View:
    """Return the camera, shifted by a thousandth of a sample off the corners of triangles."""
    right, up, _ = (np.array(axis) for axis in view.axes)
    shift = CORNER_OFFSET * view.distance_mm / view.focal_px * (right - up)
    position, target = (
        tuple((np.array(end) + shift).tolist()) for end in (view.position_mm, view.target_mm)
    )
    return dataclasses.replace(view, position_mm=position, target_mm=target)


def describe_maps(patch: PatchSurface) -> dict[str, Float32Array]:
    """Return the maps of a patch's reflection; the caliper's jaws are matt."""
    return {
        "r_d": np.float32(shading.interior_scale(ETA)) * patch.albedo,
        "roughness": patch.alpha,
        "bare": patch.skin.astype(np.float32),
    }


def list_lights(sphere: ActualSphere, polarizers: Polarizers, unit: float) -> list[SceneLight]:
    """Return the LEDs above the patch's plane; the tissue below hides the others.

    Parameters
    ----------
    sphere
        The actual LEDs.
    polarizers
        The rig's polarizers.
    unit
        Full scales per second per unit of radiance of `rigsim.light.lobe_moments`.
    """
    rig: Rig = sphere.nominal
    strength = unit * REFERENCE_DISTANCE_MM**2 * sphere.intensity
    return [
        SceneLight(
            rig.lights[k].name,
            sphere.position_mm[k],
            -sphere.position_mm[k] / np.linalg.norm(sphere.position_mm[k]),
            np.repeat(strength[k], 3),
            lobe_exponent(rig.lights[k]),
            float(sphere.radius_mm[k]),
            sphere.absorbs[k],
            1.0 / polarizers.light_extinction,
        )
        for k in lit_leds(sphere, shadows=True)
    ]
