"""Describe a simulated dome session's scene: face, LEDs and cameras as they were built."""

import math
from pathlib import Path
from typing import Final

import numpy as np

from capture.session import Session
from model.skin import SkinAppearance
from rigsim.as_built.dome import ActualDome, build_dome
from rigsim.light.led_light import lobe_exponent, white_intensity
from skinrig.exporting.mitsuba import skin
from skinrig.exporting.mitsuba.cameras import describe_rig_camera, describe_view, record_view
from skinrig.exporting.mitsuba.lights import SceneLight, single_lights
from skinrig.exporting.mitsuba.readme import DOME_README
from skinrig.exporting.mitsuba.rig_scene import (
    SCENE_FILE,
    STOCK_SCENE_FILE,
    RigScene,
    SceneFile,
    describe_path,
)
from skinrig.rendering.geometry import read_own_mesh

PATH_DEFAULTS: Final = {"samples": 64, "depth": 2}
"""Samples per pixel, and the path length of light that one reflection turns to the camera."""
FACE_EFFECTS: Final = frozenset(
    {
        "bands of the camera",
        "relief of the skin",
        "pattern of pigment",
        "thickness of the epidermis",
        "depth of melanin",
        "oxygenation of blood",
        "scattering of skin",
        "other absorption of skin",
        "shadows",
    }
)
"""Effects in the maps and the mesh of every face."""


def build_scene(session: Session, truth: SkinAppearance, folder: Path) -> RigScene:
    """Write mesh and maps of a dome's face, and describe its scene.

    Parameters
    ----------
    session, truth
        Session with its ground truth.
    folder
        Existing folder.
    """
    dome = build_dome(session.rig, seed=session.seed or 0)
    leds = list_lights(dome)
    maps = skin.write_skin(truth, read_own_mesh(truth), folder)
    views, lenses = dome.rig.views, dome.distortion
    plugins = [describe_path(), *(describe_rig_camera(v, lenses.get(v.name)) for v in views)]
    stock = [describe_path(), *(describe_view(view) for view in views)]
    plugins += skin.describe_face(skin.describe_skin_coat(maps))
    stock += skin.describe_face(skin.describe_stock_skin())
    return RigScene(
        {
            SCENE_FILE: SceneFile(plugins, PATH_DEFAULTS, is_stock=False),
            STOCK_SCENE_FILE: SceneFile(stock, PATH_DEFAULTS, is_stock=True),
        },
        leds,
        single_lights(leds),
        maps,
        [record_view(v, dome.gain.get(v.name, 1.0), lenses.get(v.name)) for v in views],
        DOME_README,
        "camera RGB, fraction of full scale per second of on-time at level 1, before a camera's "
        "gain",
        FACE_EFFECTS | {"movement of the face with the state"},
    )


def list_lights(dome: ActualDome) -> list[SceneLight]:
    """Return the LEDs of an actual dome, in the order of the rig, for its first camera's colors."""
    view = dome.rig.views[0]
    return [
        SceneLight(
            light.name,
            np.asarray(light.position_mm, np.float64),
            np.asarray(axis, np.float64),
            math.pi * white_intensity(light, view) * float(light.name not in dome.dead),
            lobe_exponent(light),
            light.radius_mm,
        )
        for light, axis in zip(dome.rig.lights, dome.axis, strict=True)
    ]
