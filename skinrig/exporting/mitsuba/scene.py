"""Write a simulated dome session's scene for Mitsuba: face, LEDs and cameras as they were built."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from capture.rig import View
from capture.session import Session
from model import store
from model.skin import SkinAppearance
from rigsim.as_built.dome import ActualDome, build_dome
from rigsim.mitsuba.scene_radiance import perspective
from skinrig.exporting.mitsuba import lights, skin
from skinrig.exporting.mitsuba.elements import (
    Element,
    build_plugin,
    build_pose,
    build_property,
    write_scene,
)
from skinrig.exporting.mitsuba.lights import SceneLight
from skinrig.exporting.mitsuba.readme import format_readme
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.sealing import describe_provenance, write_json
from skinrig.rendering.geometry import read_own_mesh
from skinrig.simulating.orders import truth_folder

DOCUMENT_FILE: Final = "mitsuba.json"
README_FILE: Final = "README.txt"
SCENE_FILE: Final = "scene.xml"
STOCK_SCENE_FILE: Final = "scene-stock.xml"
SCHEMA: Final = "skinrig.export.mitsuba/1"
DEFAULT_SAMPLES: Final = 64
DIRECT_DEPTH: Final = 2
"""Path length of light that one reflection turns to the camera."""
BUILT_EFFECTS: Final = frozenset(
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
        "movement of the face with the state",
    }
)
"""Effects of a session that the scene has, too: in its maps and its mesh."""


def write(session: Session, folder: Path, delivery: ExportSettings) -> list[tuple[str, str]]:
    """Write the scene of a simulated dome session, from its ground truth.

    Parameters
    ----------
    session
        Simulated session of a face in the dome; its ground truth is next to it.
    folder
        Existing folder.
    delivery
        Not used.

    Returns
    -------
    list of (str, str)
        Effects of the session that the scene lacks, with reasons.

    Raises
    ------
    ExportError
        If the session was measured, is of another rig, or has no ground truth.
    """
    truth = read_truth(session)
    dome = build_dome(session.rig, seed=session.seed or 0)
    leds = lights.list_lights(dome)
    maps = skin.write_skin(truth, read_own_mesh(truth), folder)
    lights.write_light_tables(leds, folder)
    lights.write_stock_lights(leds, folder)
    views = [describe_view(view) for view in dome.rig.views]
    _write_scene(
        folder / SCENE_FILE,
        [*views, *skin.describe_face(skin.describe_skin_coat(maps)), lights.describe_led_array()],
        "needs `import rigsim.mitsuba` of skinrig before it is loaded",
    )
    spots = Element("include", {"filename": f"{lights.STOCK_FOLDER}/$light.xml"})
    _write_scene(
        folder / STOCK_SCENE_FILE,
        [*views, *skin.describe_face(skin.describe_stock_skin()), spots],
        f"loads in Mitsuba 3 without plugins; {README_FILE} lists the differences",
    )
    left_out = _list_lacking(session)
    (folder / README_FILE).write_text(
        format_readme([view.name for view in dome.rig.views], leds[0].name, left_out),
        encoding="utf-8",
    )
    document = {
        **describe_provenance(truth),
        "schema": SCHEMA,
        "session": session.content_hash,
        "unit": "mm; rig frame: +x right, +y up, +z towards the main camera",
        "radiance": "camera RGB, fraction of full scale per second of on-time at level 1, before "
        "a camera's gain",
        "textures": [f"{skin.TEXTURES_FOLDER}/{name}.exr" for name in maps],
        "lights": [_record_light(led) for led in leds],
        "views": [_record_view(view, dome) for view in dome.rig.views],
        "left_out": [list(row) for row in left_out],
    }
    write_json(folder / DOCUMENT_FILE, document)
    return left_out


def read_truth(session: Session) -> SkinAppearance:
    """Return the ground truth of a simulated dome session.

    Raises
    ------
    ExportError
        If the session was measured, is of another rig, or its ground truth is missing or that of
        another session.
    """
    if session.source != "simulated":
        raise ExportError(
            f"{session.path}: is measured, expected a simulated session, whose skin is known; "
            "export maps of its reconstruction instead [SR-EXP-006]"
        )
    if session.rig.name != "dome":
        raise ExportError(
            f"{session.path}: got the rig {session.rig.name}, expected the dome; give a session "
            "of `skinrig simulate dome` [SR-EXP-007]"
        )
    folder = truth_folder(session.path)
    if not folder.is_dir():
        raise ExportError(
            f"{folder}: not found, expected the ground truth of {session.path}; simulate a face, "
            "and keep both folders next to each other [SR-EXP-008]"
        )
    truth = store.read(folder)
    if truth.inputs.get("session") != session.content_hash:
        raise ExportError(
            f"{folder}: is the ground truth of another session than {session.path}; simulate "
            "again, or restore the folder [SR-EXP-009]"
        )
    return truth


def describe_view(view: View) -> Element:
    """Return a pinhole camera with square pixels, its principal point in the image's center."""
    about = perspective(view, "rgb")
    film = about["film"]
    sampler = build_plugin("sampler", "independent")
    sampler.append(Element("integer", {"name": "sample_count", "value": "$samples"}))
    return build_plugin(
        "sensor",
        about["type"],
        *(build_property(name, about[name]) for name in ("fov", "fov_axis", "near_clip")),
        build_property("far_clip", about["far_clip"]),
        build_pose(view.position_mm, view.target_mm, view.up),
        sampler,
        build_plugin(
            "film",
            film["type"],
            *(build_property(name, film[name]) for name in ("width", "height", "pixel_format")),
            build_plugin("rfilter", film["rfilter"]["type"]),
        ),
        id=view.name,
    )


def _write_scene(path: Path, content: Sequence[Element], comment: str) -> None:
    """Write a scene with the parameters light, samples and depth."""
    integrator = build_plugin("integrator", "path")
    integrator.append(Element("integer", {"name": "max_depth", "value": "$depth"}))
    values = {"light": lights.ALL_LIGHTS, "samples": DEFAULT_SAMPLES, "depth": DIRECT_DEPTH}
    defaults = [Element("default", {"name": k, "value": str(v)}) for k, v in values.items()]
    write_scene(path, [*defaults, integrator, *content], comment)


def _list_lacking(session: Session) -> list[tuple[str, str]]:
    """Return the built effects of a session that the scene lacks."""
    reason = "in the session's images; the scene has pinhole cameras and local reflection"
    return [
        (str(effect["name"]), reason)
        for effect in session.manifest.extra.get("effects", ())
        if effect["verdict"] == "built" and effect["name"] not in BUILT_EFFECTS
    ]


def _record_light(led: SceneLight) -> dict[str, Any]:
    return {
        "name": led.name,
        "position_mm": led.position_mm.tolist(),
        "axis": led.axis.tolist(),
        "intensity": led.intensity.tolist(),
        "exponent": led.exponent,
        "radius_mm": led.radius_mm,
    }


def _record_view(view: View, dome: ActualDome) -> dict[str, Any]:
    return {
        "name": view.name,
        "position_mm": list(view.position_mm),
        "target_mm": list(view.target_mm),
        "up": list(view.up),
        "focal_px": view.focal_px,
        "size_px": [view.width_px, view.height_px],
        "gain": dome.gain.get(view.name, 1.0),
    }
