"""Describe a simulated flash session's scenes: face, flashes with polarizers, camera, analyzer."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from capture.rig import Rig
from capture.session import Session
from model.skin import SkinAppearance
from rigsim.as_built.polarizers import Polarizers, absorbing_axis, draw_polarizers
from rigsim.geometry.mesh import build_mesh
from rigsim.scenes.flash.image import WHITE_SCALE
from rigsim.scenes.flash.surfaces import flash_lights
from skinrig.arrays import Float64Array
from skinrig.exporting.mitsuba import skin
from skinrig.exporting.mitsuba.cameras import describe_rig_camera, describe_view, record_view
from skinrig.exporting.mitsuba.dome import FACE_EFFECTS, PATH_DEFAULTS
from skinrig.exporting.mitsuba.lights import SceneLight, single_lights
from skinrig.exporting.mitsuba.readme import FLASH_README
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

FLASH_MAPS: Final = ("r_d", "roughness", "bare", "normals")
OLAT_DEFAULTS: Final = {"samples": 1, "subpixels": 2}
"""Rays along each side of a pixel, as in the session; samples per pixel have no effect."""


def build_scene(session: Session, truth: SkinAppearance, folder: Path) -> RigScene:
    """Write mesh and maps of a flash session's face, and describe its scenes.

    Parameters
    ----------
    session, truth
        Session with the ground truth of its first state.
    folder
        Existing folder.
    """
    surface = read_surface(truth, session.path)
    rig, view = session.rig, session.rig.views[0]
    polarizers = draw_polarizers(rig)
    flashes = list_lights(rig, polarizers, surface["white_rgb"])
    maps = write_face(surface, folder)
    files = {}
    for name in analyzer_angles_deg(polarizers, view):
        coat = skin.describe_face(skin.describe_skin_coat(maps, is_ggx=True))
        olat = describe_analyzed(polarizers, view, name)
        plugins = [olat, describe_rig_camera(view), *coat]
        plain = skin.describe_face(skin.describe_polarized_skin(name, "normals" in maps))
        stock = [describe_path(), describe_view(view), *plain]
        files[POLARIZED_SCENE_FILE.format(name)] = SceneFile(plugins, OLAT_DEFAULTS, is_stock=False)
        files[POLARIZED_STOCK_FILE.format(name)] = SceneFile(stock, PATH_DEFAULTS, is_stock=True)
    return RigScene(
        files,
        flashes,
        single_lights(flashes),
        maps,
        [record_view(view, 1.0)],
        FLASH_README,
        "camera RGB, fraction of full scale at power 1",
        FACE_EFFECTS | {"polarization", "movement of the face with the states"},
        {
            "state": truth.parameters["state"],
            "analyzer_deg": analyzer_angles_deg(polarizers, view),
            "analyzer_leak": 1.0 / polarizers.analyzer_extinction,
        },
    )


def write_face(surface: Mapping[str, NDArray[np.generic]], folder: Path) -> tuple[str, ...]:
    """Write the face of the arrays of `rigsim.scenes.flash.truth.face_surface`."""
    mesh = build_mesh(surface["vertices_mm"], surface["faces"], surface["uv"])
    maps = {name: np.asarray(surface[name], np.float32) for name in FLASH_MAPS}
    return skin.write_maps(maps, mesh, folder, specular_parts=skin.POLARIZED_PARTS)


def list_lights(
    rig: Rig, polarizers: Polarizers, white_rgb: NDArray[np.generic]
) -> list[SceneLight]:
    """Return the flashes of a rig, in its order.

    Parameters
    ----------
    rig
        The rig.
    polarizers
        Its polarizers.
    white_rgb
        Camera RGB of the white reference at power 1, shape (3,).
    """
    white: Float64Array = math.pi * float(WHITE_SCALE) * np.asarray(white_rgb, np.float64)
    places = [np.asarray(light.position_mm, np.float64) for light in rig.lights]
    return [
        SceneLight(
            light.name,
            place,
            -place / np.linalg.norm(place),
            weight * white,
            0.0,
            light.radius_mm,
            absorbing_axis(light),
            1.0 / polarizers.light_extinction,
        )
        for light, place, weight in zip(
            rig.lights, places, flash_lights(rig, polarizers).weights, strict=True
        )
    ]
