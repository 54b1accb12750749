"""Build the scene of a face: captured, the procedural head, or another mesh with simulated skin."""

import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from importlib import resources
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from model import skin_reflectance, store
from model.skin import SkinAppearance
from rigsim.geometry.mesh import Mesh, build_mesh, center_face
from rigsim.subject import PRESET_NAMES, SimulatedSubject, make_subject
from skinrig import consent
from skinrig.appearances import dynamic as dynamic_appearance
from skinrig.appearances.contents import is_fused
from skinrig.blend_shapes import meshes as blend_shapes
from skinrig.rendering.geometry import read_own_mesh
from skinrig.rendering.hole_patches import ClosedMesh, close_holes
from skinrig.unmeasured.person import HEAD_FILE, DisplayedPerson, assemble_person
from skinrig.viewer.assets import face_parts as face_part_assets
from skinrig.viewer.assets import facial_color as facial_color_assets
from skinrig.viewer.assets import fitted as fitted_assets
from skinrig.viewer.assets import reflectance as reflectance_assets
from skinrig.viewer.assets import surface as wrinkle_assets
from skinrig.viewer.assets.placed_color import read_image_landmarks
from skinrig.viewer.fine_skin import PERSON_PX, FineSkin
from skinrig.viewer.microstructure import assets as microstructure_assets
from skinrig.viewer.pictures import PICTURE_PX, build_picture_scene, find_states
from skinrig.viewer.scene import MAX_TEXTURE_PX, Assets, Kind, SceneError, SceneSource, ViewerScene

Weights = Mapping[str, float]

MEASURED_TEXTURES: Final = ("albedo_map", "lobe_shares", "translucency", "albedo_traits")
"""Textures that are not functions of the surface point."""
EMOTION_STATES: Final = ("happiness", "sadness", "surprise", "fear", "anger", "disgust")
"""The six basic emotions of Ekman."""

COMBINED_STATES: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "sad smile": ("sadness", "smile"),
        "anger and surprise": ("anger", "surprise"),
        "after exercise": ("anger", "surprise", "exercise"),
    }
)
"""Combinations of Jimenez et al., each part at weight 1: figure 1 (sad smile) and figure 11."""

GLOBAL_STATES: Final = ("exercise", "alcohol")
"""Conditions of the whole face without muscle action."""

ACTION_UNITS: Final[Mapping[str, Mapping[str, float]]] = tomllib.loads(
    resources.files("skinrig").joinpath("data/action_units.toml").read_text(encoding="utf-8")
)
"""Weights of ARKit shapes, without side, by expression."""


def _ignore(_content: str) -> None:
    """Report no progress."""


def build_presets(names: Iterable[str]) -> dict[str, dict[str, float]]:
    """Build blend-shape weights by preset, in display order.

    Parameters
    ----------
    names
        Names of blend shapes and expressions.

    Examples
    --------
    >>> build_presets(["anger", "surprise"])["anger and surprise"]
    {'anger': 1.0, 'surprise': 1.0}
    >>> build_presets(["mouthSmile_L", "mouthSmile_R"])["smile"]
    {'mouthSmile_L': 1.0, 'mouthSmile_R': 1.0}
    """
    known = tuple(dict.fromkeys(names))
    basic = {name: _weights(name, known) for name in (*EMOTION_STATES, "smile", *GLOBAL_STATES)}
    # combinations with a missing part are omitted, as they would be another expression
    combined = {
        name: _add_weights(basic[part] for part in parts)
        for name, parts in COMBINED_STATES.items()
        if all(basic[part] for part in parts)
    }
    first = {name: basic[name] for name in (*EMOTION_STATES, "smile") if basic[name]}
    last = {name: basic[name] for name in GLOBAL_STATES if basic[name]}
    return {"neutral": {}, **first, **combined, **last}


def _weights(name: str, shape_names: tuple[str, ...]) -> dict[str, float]:
    """Return the weights of an expression: the shape of that name, else its action units."""
    found = {name: 1.0} if name in shape_names else {}
    units = {
        shape: weight
        for unit, weight in ACTION_UNITS.get(name, {}).items()
        for shape in shape_names
        if shape in (unit, f"{unit}_L", f"{unit}_R", f"{unit}Left", f"{unit}Right")
    }
    return {**found, **units}


def _add_weights(parts: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Add weights, each clipped at 1."""
    total: dict[str, float] = {}
    for part in parts:
        for name, weight in part.items():
            total[name] = min(total.get(name, 0.0) + weight, 1.0)
    return total


ASSET_BUILDERS: Final[Mapping[str, Callable[[SceneSource], Assets]]] = MappingProxyType(
    {
        "blood, melanin and their colors": facial_color_assets.build_assets,
        "scattering": reflectance_assets.build_default_scattering,
        "surface topography": wrinkle_assets.build_surface_assets,
        "basis BRDFs and traits": fitted_assets.build_assets,
        "wrinkles": wrinkle_assets.build_assets,
        "microstructure": microstructure_assets.build_assets,
        "eyes and hair": face_part_assets.build_assets,
    }
)
"""Builders of the page's assets by content, in the order of its parts; they are independent."""


def assemble_scene(
    source: SceneSource, provenance: Mapping[str, Any], progress: Callable[[str], None] = _ignore
) -> ViewerScene:
    """Assemble the scene of a source from all asset builders; ``progress`` gets each content."""
    scene = ViewerScene(mesh=source.mesh, provenance=provenance)
    for number, (content, build) in enumerate(ASSET_BUILDERS.items()):
        progress(f"content {number}/{len(ASSET_BUILDERS)}: {content}")
        scene = scene.with_assets(build(source))
    names = (*scene.mesh.shapes, *scene.params.get("weights", {}))
    return scene.with_assets(
        {"presets": {n: {"weights": w} for n, w in build_presets(names).items()}}
    )


DEFAULT_PRESET = "III"
"""Skin type of faces without measured skin."""
MAX_PEOPLE = 6
"""Largest number of people of one page, for the size of the page."""
MESH_FILE: Final = "mesh.obj"
ALBEDO_MAP: Final = "r_d"
TRANSLUCENCY_MAP: Final = "translucency"
POSITION_MAP: Final = "position"
"""Map of points on a mesh, whose normals are not those of an image."""
CAPTURED_KINDS: Final[tuple[Kind, ...]] = ("model", "dome", "dynamic", "flash", "probe")
"""Kinds of folders in order of preference for the geometry."""
PICTURE_KIND: Final = "picture"
"""Kind of a folder whose normals lie in a camera's image."""
FACE_PX, PEOPLE_PX = 2048, 1024
"""Default side of the textures of one face and of several, texels; pages of three have 5 MB."""
MIN_TEXTURE_PX = 64
POSITION_STEPS_PER_MM = np.float32(1024.0)
"""Quantization of positions; strain is computed from the rounded mesh."""


def build_scene(
    paths: Sequence[Path] = (),
    *,
    mesh: Path | None = None,
    landmarks: Path | None = None,
    calibration: Path | None = None,
    preset: str = DEFAULT_PRESET,
    seed: int = 0,
    size: int | None = None,
    people: Sequence[str] = (),
    progress: Callable[[str], None] = _ignore,
) -> ViewerScene:
    """Build the scene of folders of maps, or of a simulated person without any.

    Parameters
    ----------
    paths
        Folders of `skinrig reconstruct` or `skinrig fit`, one per kind; or one folder with
        `normals` in a camera's image, which is shown as a picture under a light.
    mesh
        Mesh of the face, or to be covered with simulated skin, see `load_mesh`; None: the mesh of
        a folder, else the procedural head.
    landmarks
        Table ``name,x,y`` of the neutral image of the flash rig's maps; None: that of a
        simulation, from its TRUTH/ folder next to the maps.
    calibration
        Folder with the color calibration of the dome's cameras; None: the one of the maps, if it
        is next to them and has color, else the tabulated sensor.
    preset, seed
        Simulated person, one of `rigsim.subject.PRESET_NAMES`, and its seed; folders have their
        own seed.
    size
        Side of the large textures, 64 to 4096 texels; None: `FACE_PX`, of several people
        `PEOPLE_PX`, of a picture `skinrig.viewer.pictures.PICTURE_PX`.
    people
        Skin types of several simulated people in place of ``preset``, on the same head.
    progress
        Called with each content before it is made.

    Raises
    ------
    SceneError
        If the size is out of range, people are given with folders, a folder cannot be displayed,
        two are of one kind, landmarks are missing, or landmarks or a calibration are not
        applicable.
    model.store.StoreError
        If a folder is not readable.
    rigsim.subject.SubjectError, rigsim.geometry.mesh.MeshError,
    rigsim.geometry.mesh.MeshError
        If preset, seed or mesh are invalid.
    """
    if size is not None and not MIN_TEXTURE_PX <= size <= MAX_TEXTURE_PX:
        raise SceneError(
            f"--size-px: got {size}, expected {MIN_TEXTURE_PX} to {MAX_TEXTURE_PX}; enter another"
        )
    if landmarks is not None and not paths:
        raise SceneError(
            "--landmarks: got a table without the appearance of its image; give the folder, too"
        )
    if calibration is not None and not paths:
        raise SceneError(
            "--calibration: got a folder without a dome's appearance; give the appearance, too"
        )
    _check_people(people, paths)
    preset = people[0] if people else preset
    folders, appearances = _read(paths)
    if PICTURE_KIND in folders:
        if len(paths) > 1 or (mesh, landmarks, calibration) != (None, None, None):
            raise SceneError(
                f"{folders[PICTURE_KIND]}: a picture has its own page; show it without "
                "other folders, --mesh, --landmarks and --calibration"
            )
        side = PICTURE_PX if size is None else size
        return build_picture_scene(
            folders[PICTURE_KIND], appearances[PICTURE_KIND], size=side, progress=progress
        )
    if "flash" in folders:  # refuse an image without landmarks before anything is computed
        truth = appearances["flash"].parameters.get("truth")
        read_image_landmarks(folders["flash"], truth, landmarks)
    if size is None:
        size = PEOPLE_PX if people else FACE_PX
    whole, mesh_origin = _mesh(appearances, mesh)
    parts = whole.parts if isinstance(whole, DisplayedPerson) else None
    kind: Kind = "procedural" if mesh is None else "mesh"
    if paths:
        first = next(iter(appearances.values())).seed
        preset, seed = DEFAULT_PRESET, first if isinstance(first, int) and first >= 0 else 0
        kind = next(name for name in CAPTURED_KINDS if name in appearances)
    surface = None if whole is None else whole.mesh
    subject = make_subject(preset, seed=seed, size=min(size, PERSON_PX), mesh=surface)
    progress("fine skin")
    skin = FineSkin(subject, size)
    of = build_viewer_mesh(subject), size, seed, subject, skin, appearances, folders
    source = SceneSource(kind, *of, landmarks, calibration, whole is not None, parts)
    if not paths:
        provenance = {"source": "simulated", "kind": kind, "preset": preset, "seed": seed}
        provenance |= {} if mesh is None else {"mesh": mesh.name}
        if len(people) < 2:
            return assemble_scene(source, provenance, progress)
        scene = assemble_scene(source, provenance | {"preset": ", ".join(people)}, progress)
        progress(f"people {', '.join(people[1:])}")
        scene = scene.with_assets(_build_people(people, seed, size, surface))
        if "face_parts" not in scene.facts:
            return scene
        colors = [face_part_assets.build_colors(source.mesh, one, seed) for one in people]
        return scene.with_assets({"facts": {"people_parts": colors}})
    found = assemble_scene(source, _provenance(source, paths, whole, mesh_origin), progress)
    movement = "movement was not captured; blend shapes are from the file or simulated"
    left_out = [*(() if whole is None else whole.omitted()), ("expressions of this face", movement)]
    if whole is None:
        left_out.insert(
            0, ("geometry of this face", f"{mesh_origin}; display another with --mesh FILE")
        )
    added = () if whole is None else whole.added()
    found = found.with_assets({"left_out": tuple(left_out), "added": added})
    return found if whole is None else _paint_patches(found, whole)


def _check_people(people: Sequence[str], paths: Sequence[Path]) -> None:
    """Raise for people together with an appearance, unknown ones, or too many."""
    if people and paths:
        raise SceneError(
            "--people: got simulated people and an appearance; show one of both, or a page each"
        )
    unknown = [one for one in people if one not in PRESET_NAMES]
    if unknown:
        raise SceneError(
            f"--people: got {unknown[0]!r}, expected {', '.join(PRESET_NAMES)}; correct it"
        )
    if len(people) > MAX_PEOPLE:
        raise SceneError(f"--people: got {len(people)} types, expected at most {MAX_PEOPLE}")


def _build_people(people: Sequence[str], seed: int, size: int, surface: Mesh | None) -> Assets:
    """Build the chromophores of all people but the first, as textures of their own."""
    textures = {}
    for number, preset in enumerate(people[1:], start=1):
        subject = make_subject(preset, seed=seed, size=min(size, PERSON_PX), mesh=surface)
        found = facial_color_assets.simulate_chromophores(subject, FineSkin(subject, size))
        for name, texture in facial_color_assets.build_textures(found).items():
            textures[f"{name}_person_{number}"] = texture
    return {"textures": textures, "facts": {"people": list(people)}}


def _read(paths: Sequence[Path]) -> tuple[dict[str, Path], dict[str, SkinAppearance]]:
    """Read the folders; return paths and appearances by kind."""
    folders: dict[str, Path] = {}
    appearances: dict[str, SkinAppearance] = {}
    for path in paths:
        appearance = store.read(path)
        kinds = [detect_kind(path, appearance)]
        if is_fused(appearance) and dynamic_appearance.describe_parts(appearance):
            kinds.append("dynamic")  # the microstructure of a fused person
        for kind in kinds:
            if kind in folders:
                raise SceneError(f"{path}: {folders[kind]} is of the same kind ({kind}); show one")
            appearances[kind], folders[kind] = appearance, path
    colored = [
        path
        for kind, path in folders.items()
        if kind in ("dome", "model")
        or (
            kind == "dynamic"
            and dynamic_appearance.FACIAL_COLOR
            in dynamic_appearance.describe_parts(appearances[kind])
        )
    ]
    if "flash" in folders and colored:
        raise SceneError(
            f"{folders['flash']}: got chromophores and {colored[0]}, which has the color of the "
            "face; show one of both, or `skinrig fuse` the maps of all rigs"
        )
    return folders, appearances


def _paint_patches(scene: ViewerScene, whole: ClosedMesh | DisplayedPerson) -> ViewerScene:
    textures = {
        name: replace(one, values=whole.paint(one.values)) if name in MEASURED_TEXTURES else one
        for name, one in scene.textures.items()
    }
    return replace(scene, textures=textures)


def _provenance(
    source: SceneSource,
    paths: Sequence[Path],
    whole: ClosedMesh | DisplayedPerson | None,
    mesh: str,
) -> dict[str, Any]:
    """Return the provenance of a captured scene, with the consent of its subjects."""
    found: dict[str, Any] = {
        "source": " and ".join(sorted({one.source for one in source.appearances.values()})),
        "kind": source.kind,
        "appearances": [path.name for path in paths],
        "mesh": mesh,
    }
    if whole is not None and whole.charts:
        found["closed_holes"] = len(whole.charts)
    if isinstance(whole, DisplayedPerson) and whole.names:
        found["not_measured"] = list(whole.names)
    agreed = consent.merge_consent(*source.appearances.values())
    return found | ({consent.CONSENT_KEY: consent.format_consent(agreed)} if agreed else {})


def load_mesh(path: Path) -> Mesh:
    """Load a face mesh with or without blend shapes, in place of the procedural head.

    Parameters
    ----------
    path
        .npz, .obj (or a folder of them), .gltf or .glb, see `skinrig.blend_shapes.meshes.load`. The
        face is oriented towards +z, and its foremost vertex is the tip of the nose.
    """
    loaded = blend_shapes.load(path)
    if loaded.uv.min() < 0.0 or loaded.uv.max() > 1.0:
        raise SceneError(
            f"{path}: got texture coordinates {loaded.uv.min():g} to {loaded.uv.max():g}, "
            "expected 0 to 1; export only the tile of the face"
        )
    return center_face(
        build_mesh(loaded.vertices_mm, loaded.faces, loaded.uv, shapes=loaded.shapes)
    )


def build_viewer_mesh(subject: SimulatedSubject) -> Mesh:
    """Build a person's mesh with blend shapes: those of the expressions, then its own."""
    rounded = np.round(subject.mesh.vertices_mm * POSITION_STEPS_PER_MM) / POSITION_STEPS_PER_MM
    own = {n: d for n, d in subject.mesh.shapes.items() if np.any(d)}
    shapes = {**subject.blend_shapes(), **own}
    return replace(subject.mesh, vertices_mm=rounded.astype(np.float32), shapes=shapes)


def detect_kind(path: Path, appearance: SkinAppearance) -> str:
    """Return "dynamic", "dome", "model", "flash", "probe" or "picture".

    Raises
    ------
    SceneError
        If it has nothing to display on a face.
    """
    if dynamic_appearance.describe_parts(appearance) and not is_fused(appearance):
        return "dynamic"
    if skin_reflectance.BASIS_FILE in appearance.files and "reflectance_model" in (
        appearance.parameters
    ):
        return "model"
    if MESH_FILE in appearance.files and ALBEDO_MAP in appearance.maps:
        return "dome"
    if appearance.maps.keys() >= set(facial_color_assets.CHROMOPHORE_MAPS):
        return "flash"
    if TRANSLUCENCY_MAP in appearance.maps:
        return "probe"
    of_image = MESH_FILE not in appearance.files and POSITION_MAP not in appearance.maps
    if of_image and find_states(appearance):
        return PICTURE_KIND
    raise SceneError(
        f"{path}: got {', '.join(sorted(appearance.maps)) or 'no maps'}, expected a moving face "
        "(`skinrig fit facial-color`, `wrinkles` or `microstructure`), a dome's maps with "
        f"{ALBEDO_MAP} and {MESH_FILE}, melanin and hemoglobin of a flash session, "
        f"{TRANSLUCENCY_MAP} of a probe's, or normals of an image"
    )


def _mesh(
    appearances: dict[str, SkinAppearance], path: Path | None
) -> tuple[ClosedMesh | DisplayedPerson | None, str]:
    """Return the displayed mesh, None for the procedural head, and its description.

    Holes of a scan are closed; those of another mesh may be intended. A fused person has parts
    that no rig measured, unless they were left out.
    """
    if path is not None:
        return ClosedMesh(load_mesh(path), (), ()), path.name
    for kind in ("model", "dome"):
        appearance = appearances.get(kind)
        if appearance is not None and MESH_FILE in appearance.files:
            closed, origin = close_holes(read_own_mesh(appearance)), f"{MESH_FILE} of the {kind}"
            if HEAD_FILE not in appearance.files:
                return closed, origin
            seed = appearance.seed if isinstance(appearance.seed, int) else 0
            return assemble_person(appearance, closed, max(seed, 0)), origin
    return None, "the procedural head replaces the face"
