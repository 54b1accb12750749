"""Render a fused person's face under several lights, from rest to an expression.

Color, normals, reflection and blood are measured. The movement of the mesh is the simulator's:
no rig measures it in the demo. Crown and neck are those of the fitted mean head.
"""

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from threadpoolctl import threadpool_limits

from model import color_table, spectra
from model.facial_color.state_maps import NEUTRAL
from model.skin import SkinAppearance
from model.skin_reflectance import SkinReflectance, assemble
from model.tissue_optics.layers import ANISOTROPY_SKIN, C_HD_MAX
from rigsim.geometry.atlas import unwrap
from rigsim.geometry.mesh import Mesh, build_mesh
from rigsim.render import Caster
from rigsim.subject import expressions
from skinrig import consent
from skinrig.appearances.contents import hash_document
from skinrig.applying.expression import read_hemoglobin_rig
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray, UInt8Array
from skinrig.atomic_file import replace_folder_atomically
from skinrig.capturing.camera_colors import fit_skin_colors
from skinrig.console import to_json_value
from skinrig.drawing.frame_sheet import FRAME_PX, N_LIGHTS, N_STEPS, encode_sheet
from skinrig.errors import require_choice
from skinrig.fusing.double import FusedDouble
from skinrig.fusing.finished_face_file import DOCUMENT_FILE, SCHEMA, SHEET_FILE
from skinrig.fusing.sources import FusionInputError
from skinrig.rendering.camera import Camera, look_at
from skinrig.rendering.folder import apply_tone_curve, choose_exposure
from skinrig.rendering.geometry import FittedSurface, read_own_mesh
from skinrig.rendering.hole_patches import ClosedMesh, close_holes, smooth_folds
from skinrig.rendering.lights import Light
from skinrig.rendering.render import render_light_groups
from skinrig.unmeasured.drawing import PartsLayer, PartsView, open_lids, paint_undercoat
from skinrig.unmeasured.person import HEAD_FILE, DisplayedPerson, FaceParts, assemble_person
from skinrig.viewer.assets.face_parts import EXPRESSION_OPENING
from skinrig.viewer.map_filling import fill_holes

LIGHT_AZIMUTHS_DEG: Final = {
    "left": -75.0,
    "half left": -40.0,
    "front": 0.0,
    "half right": 40.0,
    "right": 75.0,
}
"""Azimuth of each light, degrees, positive to the right of the image."""
LIGHT_ELEVATION_DEG: Final = 25.0
LIGHT_RADIUS_RAD: Final = 0.035
"""Angular radius of a light; its shadows have soft borders."""
SHADOW_SAMPLES: Final = 2
HAIR_SUBPIXELS: Final = 2
EYE_SUBPIXELS: Final = 3
"""Rays along each side of a pixel on hair of the scalp, and on eyes, brows and lashes."""
FILL_WEIGHT: Final = 0.3
"""Weight of the mean over all lights, which fills the shadows."""
CAMERA_MM: Final = (0.0, 0.0, 700.0)
TARGET_MM: Final = (0.0, 15.0, 0.0)
FIELD_OF_VIEW_DEG: Final = 17.8
"""Of the longer side: 219 mm at the origin of the rig, from the crown to the neck."""
MIN_NORMAL_COSINE: Final = 0.5
"""Least cosine between a drawn measured normal and that of the mesh."""
BACKGROUND_CODES: Final = np.array([40.0, 42.0, 45.0])
"""8-bit sRGB."""


@dataclass(frozen=True, slots=True, eq=False)
class FinishedFace:
    """Frames of a face and their description.

    Attributes
    ----------
    frames : ndarray of uint8, shape (L, S, H, W, 3)
        sRGB, by light and step.
    expression
        State at the last step.
    weights
        Weight of the expression at each step.
    blood_fraction
        Fraction of the texels with a measured change of blood; the rest has it from around.
    seed
        Seed of the movement and of the parts that no rig measured.
    left_out
        Omissions with reasons.
    """

    frames: UInt8Array
    expression: str
    weights: tuple[float, ...]
    blood_fraction: float
    seed: int
    left_out: tuple[tuple[str, str], ...]


def render_finished_face(
    double: FusedDouble, moving: SkinAppearance, *, expression: str, seed: int
) -> FinishedFace:
    """Render a fused person in `N_LIGHTS` directions of light and `N_STEPS` steps.

    Parameters
    ----------
    double
        Person fused from a dome and a flash rig.
    moving
        Hemoglobin rig in the flash rig's image, of the same pose as the fused maps.
    expression
        One of its states, which is also an expression of `rigsim.subject.expressions`.
    seed
        Seed of the movement, which is simulated.

    Raises
    ------
    FusionInputError
        If the person lacks a dome or a flash rig, or the expression is unknown.
    """
    require_choice(
        "expression", expression, tuple(expressions.EXPRESSION_STRENGTHS), FusionInputError
    )
    # many small systems of equations: threads of BLAS wait for each other
    with threadpool_limits(1, "blas"):
        return _render_frames(double, moving, expression, seed)


def _render_frames(
    double: FusedDouble, moving: SkinAppearance, expression: str, seed: int
) -> FinishedFace:
    """Render the frames, see `render_finished_face`."""
    whole = complete_skin(double.appearance, assemble(double.appearance), seed=seed)
    mesh = whole.person.mesh
    moved_mm = expressions.displacement_mm(mesh, expression, seed=seed)
    skin = _MovingColor.of(double, whole, moving, expression)
    view = scalp = None
    if (parts := _find_parts(whole.person)) is not None:
        lights = build_lights(LIGHT_AZIMUTHS_DEG)
        view = PartsView(parts, mesh, aim_camera(FRAME_PX), lights)
        scalp = view.draw(mesh, Caster(mesh), ("scalp",), 0.0, HAIR_SUBPIXELS)
    gain = EXPRESSION_OPENING.get(expression, 0.0)
    weights = np.linspace(0.0, 1.0, N_STEPS)
    steps = [
        _render_step(skin.at(w), mesh, w * moved_mm, view, scalp, 1.0 + w * gain)
        for w in weights.tolist()
    ]
    left_out = (
        *whole.person.added(),
        *whole.person.omitted(),
        ("movement of this face", "no rig measures it here; the blend shapes are simulated"),
        ("fine wrinkles", "the fused maps have none"),
        ("folded triangles of the scan", "smoothed; their color and normals are the maps'"),
    )
    return FinishedFace(
        _develop(steps), expression, tuple(weights.tolist()), skin.known_fraction, seed, left_out
    )


def _find_parts(person: DisplayedPerson | ClosedMesh) -> FaceParts | None:
    return person.parts if isinstance(person, DisplayedPerson) else None


@dataclass(frozen=True, slots=True, eq=False)
class CompletedSkin:
    """A person's mesh without holes, and the reflectance on it.

    Attributes
    ----------
    person
        Mesh with closed holes, and with crown and neck if the mean head is fitted to it.
    model
        Fitted model, valid on the whole mesh. Texels without a measurement have values of their
        surroundings, and normals of the mesh: means of steep normals can face away from the
        camera, which renders black.
    """

    person: DisplayedPerson | ClosedMesh
    model: SkinReflectance


def complete_skin(
    appearance: SkinAppearance, model: SkinReflectance, *, seed: int
) -> CompletedSkin:
    """Close the holes of a person's mesh, complete its crown and neck, and continue the maps there.

    Parameters
    ----------
    appearance
        Maps with their mesh; the fitted mean head is used where it is among the files.
    model
        Model of these maps.
    seed
        Seed of the person's parts that no rig measured.
    """
    closed = close_holes(read_own_mesh(appearance))
    closed = dataclasses.replace(closed, mesh=smooth_folds(closed.mesh))
    has_head = HEAD_FILE in appearance.files
    person = assemble_person(appearance, closed, seed) if has_head else closed
    atlas = unwrap(person.mesh, model.valid.shape[0])
    missing = atlas.covered & ~model.valid
    # false at the rim of a scan: they face away from a camera in front of the skin
    turned = np.einsum("hwk,hwk->hw", atlas.normal, model.normals) < MIN_NORMAL_COSINE
    to_camera = np.array(CAMERA_MM) - atlas.position_mm
    mesh_cosine, cosine = (
        np.einsum("hwk,hwk->hw", one, to_camera) for one in (atlas.normal, model.normals)
    )
    turned = (turned & (mesh_cosine > cosine)) | ((mesh_cosine > 0.0) & (cosine <= 0.0))
    smooth = (missing | (atlas.covered & turned))[..., None]
    count = model.r_d.shape[-1]
    values = np.concatenate([model.r_d, model.weights], axis=-1)
    painted = person.paint(fill_holes(values, model.valid))
    whole = dataclasses.replace(
        model,
        r_d=painted[..., :count],
        weights=np.maximum(painted[..., count:], 0.0),
        normals=np.where(smooth, atlas.normal, model.normals).astype(np.float32),
        position_mm=np.where(missing[..., None], atlas.position_mm, model.position_mm),
        valid=model.valid | atlas.covered,
    )
    return CompletedSkin(person, whole)


@dataclass(frozen=True, slots=True, eq=False)
class _MovingColor:
    """Reflectance of the skin, linear sRGB, by the weight of an expression."""

    model: SkinReflectance
    """Fitted model with R_d in linear sRGB, at rest."""
    melanin: Float64Array
    """Volume fraction of the chosen texels, shape (n,)."""
    blood: Float64Array
    """Volume fraction at rest, shape (n,)."""
    change: Float64Array
    """Its measured change to the full expression, shape (n,)."""
    texels: BoolArray
    """(H, W): texels of the mesh."""
    known_fraction: float
    table: color_table.ColorTable

    @staticmethod
    def of(
        double: FusedDouble, whole: CompletedSkin, moving: SkinAppearance, expression: str
    ) -> "_MovingColor":
        """Place the measured change of blood on the texels of the fused maps."""
        placement, maps = double.measured.placement, double.appearance.maps
        bands = next((one.bands for one in double.measured.colors if one.bands.rig == "dome"), None)
        if placement is None or bands is None:
            raise FusionInputError("finished face: got a person without dome and flash rig")
        rig = read_hemoglobin_rig(moving)
        require_choice("expression", expression, tuple(rig.states), FusionInputError)
        rest, full = (rig.evaluate({name: 1.0}) for name in (NEUTRAL, expression))
        both = rest.valid & full.valid
        change, known = placement.sample(full.hemoglobin - rest.hemoglobin, both)
        melanin, blood = maps["melanin"], maps["hemoglobin"]
        good = melanin.mask & blood.mask
        rgb, _ = fit_skin_colors(bands.camera, bands.illuminant)
        shown = np.clip(np.asarray(whole.model.r_d, np.float64) @ rgb, 0.0, 1.0)
        model = dataclasses.replace(whole.model, r_d=shown.astype(np.float32))
        if (parts := _find_parts(whole.person)) is not None:
            model = paint_undercoat(model, whole.person.mesh, parts)
        layers = [fill_holes(one.values, good) for one in (melanin, blood)]
        layers.append(fill_holes(change, known))
        texels = whole.model.valid
        painted = whole.person.paint(np.stack(layers, axis=-1))[texels].astype(np.float64)
        melanin_there, blood_there, change_there = np.moveaxis(painted, -1, 0)
        return _MovingColor(
            model,
            melanin_there,
            blood_there,
            change_there,
            texels,
            float((known & good).sum() / max(good.sum(), 1)),
            color_table.build(spectra.LINEAR_SRGB, "D65", size=24, anisotropy=ANISOTROPY_SKIN),
        )

    def at(self, weight: float) -> SkinReflectance:
        """Return the model with the blood of a weight; its ratio of colors acts on R_d."""
        moved = np.clip(self.blood + weight * self.change, 0.0, C_HD_MAX)
        ratio = self.table.lookup(self.melanin, moved)
        ratio = ratio / self.table.lookup(self.melanin, self.blood)
        r_d = np.array(self.model.r_d)
        r_d[self.texels] *= ratio.astype(np.float32)
        return dataclasses.replace(self.model, r_d=r_d)


def aim_camera(size_px: tuple[int, int]) -> Camera:
    """Return the camera in front of a face in a dome's frame; `size_px` is width and height."""
    return look_at(
        CAMERA_MM, target_mm=TARGET_MM, fov_deg=FIELD_OF_VIEW_DEG, size_px=size_px, name="front"
    )


def build_lights(azimuths_deg: Mapping[str, float]) -> tuple[Light, ...]:
    """Return distant lights at one elevation, by name and azimuth, degrees, positive to the right.

    Examples
    --------
    >>> right, = build_lights({"right": 90.0})
    >>> [round(x, 2) for x in right.direction]
    [0.91, 0.42, 0.0]
    """
    elevation = np.radians(LIGHT_ELEVATION_DEG)
    across, up = float(np.cos(elevation)), float(np.sin(elevation))
    lights = []
    for name, azimuth_deg in azimuths_deg.items():
        turn = np.radians(azimuth_deg)
        towards = float(np.sin(turn)) * across, up, float(np.cos(turn)) * across
        lights.append(Light(name=name, direction=towards, radius=LIGHT_RADIUS_RAD))
    return tuple(lights)


def _render_step(
    model: SkinReflectance,
    rest: Mesh,
    moved_mm: Float32Array,
    view: PartsView | None,
    scalp: PartsLayer | None,
    opening: float,
) -> tuple[FloatArray, FloatArray]:
    """Return the radiance of a moved face by light, (L, H, W, 3), and its coverage, (H, W)."""
    vertices = rest.vertices_mm + moved_mm
    if view is not None:
        vertices = open_lids(vertices, view.parts.lids, opening)
    mesh = build_mesh(vertices, rest.faces, rest.uv)
    caster = Caster(mesh)
    found = render_light_groups(
        FittedSurface.of(model, mesh, rest=rest),
        aim_camera(FRAME_PX),
        [[light] for light in build_lights(LIGHT_AZIMUTHS_DEG)],
        subpixels=1,
        shadow_samples=SHADOW_SAMPLES,
        caster=caster,
    )
    image = np.stack([one.radiance for one in found]), found[0].coverage
    if view is None or scalp is None:
        return image
    front = view.draw(mesh, caster, ("brow", "lash"), opening, EYE_SUBPIXELS)
    return scalp.draw_over(*front.draw_over(*image))


def _develop(steps: list[tuple[FloatArray, FloatArray]]) -> UInt8Array:
    """Return display images, (L, S, H, W, 3), of one exposure, with filled shadows."""
    radiance = np.stack([one for one, _ in steps], axis=1)
    radiance = radiance + FILL_WEIGHT * radiance.mean(axis=0)
    coverage = np.stack([one for _, one in steps])[..., None]
    front = list(LIGHT_AZIMUTHS_DEG).index("front")
    exposure = choose_exposure(radiance[front, 0], coverage[0, ..., 0])
    skin = apply_tone_curve(radiance / np.maximum(coverage, 1e-3), exposure)
    mixed = skin * coverage + BACKGROUND_CODES * (1.0 - coverage)
    return np.rint(mixed).astype(np.uint8).reshape(N_LIGHTS, N_STEPS, *FRAME_PX[::-1], 3)


def write_finished_face(
    out: Path,
    face: FinishedFace,
    double: FusedDouble,
    moving: SkinAppearance,
    *,
    errors: dict[str, str],
    folders: tuple[Path, Path],
) -> None:
    """Write the frames and their record into a folder, which is replaced.

    The record has the consent of the subjects of both inputs; the frames are simulated if one of
    them is.

    Parameters
    ----------
    out
        The folder.
    face
        Frames of the person.
    double
        The person.
    moving
        Hemoglobin rig of the frames.
    errors
        Errors of what is shown, in words, by quantity.
    folders
        Folders of the maps of `double` and of `moving`, next to `out`. Their digests show whether
        the frames are older than the maps.
    """
    inputs = double.appearance, moving
    document = {
        "schema": SCHEMA,
        "person": folders[0].name,
        "expression": face.expression,
        "weights": face.weights,
        "lights": LIGHT_AZIMUTHS_DEG,
        "blood_fraction": face.blood_fraction,
        "errors": errors,
        "left_out": face.left_out,
        "seed": face.seed,
        "inputs": {folder.name: hash_document(folder) for folder in folders},
        "source": "simulated" if "simulated" in {one.source for one in inputs} else "measured",
        consent.CONSENT_KEY: consent.merge_consent(*inputs),
    }
    with replace_folder_atomically(out) as fresh:
        (fresh / SHEET_FILE).write_bytes(encode_sheet(face.frames))
        text = json.dumps(to_json_value(document), indent=1, allow_nan=False)
        (fresh / DOCUMENT_FILE).write_text(text + "\n", encoding="utf-8")
