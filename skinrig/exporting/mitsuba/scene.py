"""Write a simulated session's scene for Mitsuba, from its ground truth."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from capture.session import Session
from model import store
from model.skin import SkinAppearance
from skinrig.exporting.mitsuba import dome, flash, gradient, lights
from skinrig.exporting.mitsuba.elements import Element, build_property, write_scene
from skinrig.exporting.mitsuba.readme import format_readme
from skinrig.exporting.mitsuba.rig_scene import RigScene, SceneFile
from skinrig.exporting.options import ExportError, ExportSettings
from skinrig.exporting.sealing import describe_provenance, write_json
from skinrig.simulating.orders import truth_folder

DOCUMENT_FILE: Final = "mitsuba.json"
README_FILE: Final = "README.txt"
SCHEMA: Final = "skinrig.export.mitsuba/1"
SCENE_BUILDERS: Final[Mapping[str, Callable[[Session, SkinAppearance, Path], RigScene]]] = {
    "dome": dome.build_scene,
    "flash": flash.build_scene,
    "gradient": gradient.build_scene,
}
"""Writers of mesh and maps by rig."""


def write(session: Session, folder: Path, delivery: ExportSettings) -> list[tuple[str, str]]:
    """Write the scene of a simulated session, from its ground truth.

    Parameters
    ----------
    session
        Simulated session of a face, or of a patch of skin; its ground truth is next to it.
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
        If the session was measured, is of another rig, or lacks its ground truth.
    """
    truth = read_truth(session)
    built = SCENE_BUILDERS[session.rig.name](session, truth, folder)
    lights.write_light_tables(built.lights, built.levels, folder)
    lights.write_stock_lights(built.lights, built.levels, folder)
    for name, file in built.files.items():
        _write_scene(folder / name, file, next(iter(built.levels)))
    left_out = _list_lacking(session, built)
    names = [view["name"] for view in built.views]
    text = format_readme(built.readme, names, list(built.levels)[1], left_out)
    (folder / README_FILE).write_text(text, encoding="utf-8")
    document = {
        **describe_provenance(truth),
        "schema": SCHEMA,
        "session": session.content_hash,
        "unit": "mm; rig frame: +x right, +y up, +z towards the main camera",
        "radiance": built.unit,
        "textures": [f"textures/{name}.exr" for name in built.textures],
        "patterns": {name: row.tolist() for name, row in built.levels.items()},
        "lights": [lights.record_light(led) for led in built.lights],
        "views": list(built.views),
        **built.record,
        "left_out": [list(row) for row in left_out],
    }
    write_json(folder / DOCUMENT_FILE, document)
    return left_out


def read_truth(session: Session) -> SkinAppearance:
    """Return the ground truth of a simulated session.

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
    if session.rig.name not in SCENE_BUILDERS:
        raise ExportError(
            f"{session.path}: got the rig {session.rig.name}, expected one of "
            f"{', '.join(SCENE_BUILDERS)}; give a simulated session of it [SR-EXP-007]"
        )
    folder = truth_folder(session.path)
    if not folder.is_dir():
        raise ExportError(
            f"{folder}: not found, expected the ground truth of {session.path}; simulate skin, "
            "and keep both folders next to each other [SR-EXP-008]"
        )
    truth = store.read(folder)
    if truth.inputs.get("session") != session.content_hash:
        raise ExportError(
            f"{folder}: is the ground truth of another session than {session.path}; simulate "
            "again, or restore the folder [SR-EXP-009]"
        )
    return truth


def _write_scene(path: Path, file: SceneFile, pattern: str) -> None:
    """Write a scene with its parameters and the lights of its parameter ``light``."""
    values = {"light": pattern, **file.defaults}
    defaults = [Element("default", {"name": k, "value": str(v)}) for k, v in values.items()]
    if file.is_stock:
        emitters = Element("include", {"filename": f"{lights.STOCK_FOLDER}/$light.xml"})
        comment = f"loads in Mitsuba 3 without plugins; {README_FILE} lists the differences"
    else:
        emitters = lights.describe_led_array()
        comment = "needs `import rigsim.mitsuba` of skinrig before it is loaded"
    robust = build_property("embree_use_robust_intersections", True)
    write_scene(path, [*defaults, robust, *file.elements, emitters], comment)


def _list_lacking(session: Session, built: RigScene) -> list[tuple[str, str]]:
    """Return the built effects of a session that the scene lacks."""
    reason = "in the session's images; the scene has pinhole cameras and local reflection"
    return [
        (str(effect["name"]), reason)
        for effect in session.manifest.extra.get("effects", ())
        if effect["verdict"] == "built" and effect["name"] not in built.built_effects
    ]
