"""Map the flash rig's facial color from its image to the texture of a mesh."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy import ndimage

from model import store
from model.facial_color.coarse_maps import coarse_grid
from model.facial_color.document import RIG_DOCUMENT, from_maps_and_document
from model.facial_color.state_maps import NEUTRAL
from reconstruction.correspondence import landmark_field, landmark_table
from rigsim.geometry.atlas import unwrap
from skinrig.appearances.dynamic import FACIAL_COLOR, describe_parts
from skinrig.arrays import BoolArray, Float64Array, FloatArray
from skinrig.viewer.fine_skin import FineSkin
from skinrig.viewer.map_filling import fill_holes
from skinrig.viewer.scene import SceneError, SceneSource

Points2 = Mapping[str, tuple[float, float]]
Points3 = Mapping[str, tuple[float, float, float]]

MIN_LANDMARKS: Final = 7
"""Minimum number of landmarks: a projective camera has 11 unknowns, a landmark two equations."""
MIN_VIEW_COSINE: Final = 0.3
"""Minimum cosine of normal and view; more oblique texels are not sampled from the image."""
LANDMARK_STDERR_PX: Final = 1.0
"""Standard uncertainty of a landmark per axis."""


@dataclass(frozen=True, slots=True, eq=False)
class TexelPlacement:
    """Positions of a mesh's texels in an image.

    Attributes
    ----------
    pixel : ndarray of float64, shape (N, N, 2)
        Column and row.
    visible : ndarray of bool, shape (N, N)
        Texels visible from the camera.
    leave_one_out_px : float
        Median distance of a landmark from its prediction by the others.
    landmarks : int
        Number of landmarks used.
    """

    pixel: Float64Array
    visible: BoolArray
    leave_one_out_px: float
    landmarks: int

    def sample(self, values: FloatArray, valid: BoolArray) -> tuple[Float64Array, BoolArray]:
        """Resample a map of the image to the texture, (N, N), with its valid texels.

        Parameters
        ----------
        values
            (H, W).
        valid
            (H, W).
        """
        at = np.stack([self.pixel[..., 1], self.pixel[..., 0]])
        share = ndimage.map_coordinates(valid.astype(np.float64), at, order=1, cval=0.0)
        held = np.where(valid, values, 0.0).astype(np.float64)
        total = ndimage.map_coordinates(held, at, order=1, cval=0.0)
        known = self.visible & (share > 0.5)
        return np.where(known, total / np.maximum(share, 1e-9), 0.0), known


def place_texels(
    position_mm: FloatArray,
    normal: FloatArray,
    covered: BoolArray,
    *,
    landmarks_mm: Points3,
    landmarks_px: Points2,
) -> TexelPlacement:
    """Find the positions of a mesh's texels in an image.

    Parameters
    ----------
    position_mm, normal
        Surface point and unit normal of each texel, (N, N, 3).
    covered
        Texels of the surface, (N, N).
    landmarks_mm, landmarks_px
        Named points of the mesh and of the image; those of equal names are used.

    Raises
    ------
    SceneError
        If fewer than `MIN_LANDMARKS` names are in both, or points are coplanar or collinear.
    """
    names = sorted(set(landmarks_mm) & set(landmarks_px))
    if len(names) < MIN_LANDMARKS:
        raise SceneError(
            f"--landmarks: got {len(names)} names of both the image's table and the mesh, "
            f"expected at least {MIN_LANDMARKS}; the mesh has {', '.join(sorted(landmarks_mm))}"
        )
    solid = np.array([landmarks_mm[name] for name in names], np.float64)
    flat = np.array([landmarks_px[name] for name in names], np.float64)
    camera = _camera(solid, flat)
    try:
        field = landmark_field.fit_landmark_field(
            _project(camera, solid), flat, stderr_px=LANDMARK_STDERR_PX
        )
    except landmark_field.LandmarkFieldError as error:
        raise SceneError(f"landmarks: {error}") from error
    pixel = np.zeros((*covered.shape, 2))
    direct = _project(camera, position_mm[covered].astype(np.float64))
    low = np.floor(direct.min(axis=0))
    # the deformation is smooth: it is evaluated at nodes some pixels apart
    shape = np.ceil(direct.max(axis=0) - low).astype(int) + 1
    nodes = landmark_field.fit_landmark_field(
        field.points_px - low, field.moved_px - low, stderr_px=field.stderr_px
    )
    moved, _ = nodes.evaluate_grid((int(shape[1]), int(shape[0])))
    at = (direct - low).T[::-1]
    shift = np.stack([ndimage.map_coordinates(moved[..., k], at, order=1) for k in range(2)], -1)
    pixel[covered] = direct + shift
    far = np.linalg.svd(camera)[2][-1]  # the projection center is the null space of the camera
    eye = far[:3] / far[3]
    way = eye - position_mm
    way /= np.maximum(np.linalg.norm(way, axis=-1, keepdims=True), 1e-12)
    facing = np.sum(way * normal, axis=-1)
    return TexelPlacement(
        pixel,
        covered & (facing > MIN_VIEW_COSINE),
        float(np.median(field.leave_one_out_px)),
        len(names),
    )


def _camera(solid: Float64Array, flat: Float64Array) -> Float64Array:
    """Fit a projective camera, (3, 4), to points by the normalized direct linear transform."""
    middle, size = solid.mean(axis=0), float(np.sqrt(solid.var(axis=0).sum()))
    center, spread = flat.mean(axis=0), float(np.sqrt(flat.var(axis=0).sum()))
    if size == 0.0 or spread == 0.0:
        raise SceneError(
            "--landmarks: got coincident points, expected points all over the face; correct them"
        )
    X = np.column_stack([(solid - middle) / size, np.ones(len(solid))])
    x = (flat - center) / spread
    zero = np.zeros_like(X)
    rows = np.vstack([np.hstack([X, zero, -x[:, :1] * X]), np.hstack([zero, X, -x[:, 1:] * X])])
    _, values, vectors = np.linalg.svd(rows)
    if values[-2] < 1e-4 * values[0]:
        raise SceneError("--landmarks: got coplanar points, expected also nose and ears; add them")
    P = vectors[-1].reshape(3, 4)
    from_solid = np.eye(4)
    from_solid[:3, :3] /= size
    from_solid[:3, 3] = -middle / size
    to_flat = np.array([[spread, 0.0, center[0]], [0.0, spread, center[1]], [0.0, 0.0, 1.0]])
    full = to_flat @ P @ from_solid
    front = (full @ np.append(middle, 1.0))[2]
    return np.asarray(full * np.sign(front))


def _project(camera: Float64Array, points: Float64Array) -> Float64Array:
    seen = np.column_stack([points, np.ones(len(points))]) @ camera.T
    return np.asarray(seen[:, :2] / np.where(seen[:, 2:] > 1e-12, seen[:, 2:], np.inf))


MELANIN_MAP = "melanin"
RIG_PX: Final = 256
"""Side of the scale and bias maps, cells (Jimenez 2010, section 6)."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceColor:
    """Chromophores and hemoglobin rig of a face on its texture.

    Attributes
    ----------
    melanin, hemoglobin : ndarray of float64, shape (N, N)
        Volume fractions of the neutral expression, without gaps.
    states : mapping of str to ndarray of float64, shape (h, w, 2)
        Scale and bias by expression, "neutral" first.
    global_states
        Conditions of the whole body.
    facts
        Record of the mapping, JSON values.
    left_out
        Omissions with reasons.
    """

    melanin: Float64Array
    hemoglobin: Float64Array
    states: Mapping[str, Float64Array]
    global_states: tuple[str, ...]
    facts: Mapping[str, Any]
    left_out: tuple[tuple[str, str], ...] = ()


def place_facial_color(source: SceneSource) -> FaceColor:
    """Map the measured chromophores and rig to the texture of the scene's mesh.

    Parameters
    ----------
    source
        Source with a dynamic appearance that has facial color.

    Raises
    ------
    SceneError
        If landmarks of the image are missing or unusable.
    """
    appearance, subject = source.appearances["dynamic"], source.subject
    rig = from_maps_and_document(appearance.maps, appearance.files[RIG_DOCUMENT])
    marks = read_image_landmarks(source, describe_parts(appearance)[FACIAL_COLOR])
    surface = subject.surface_landmarks()
    points = {
        name: (float(p[0]), float(p[1]), float(p[2]))
        for name, p in zip(surface.names, surface.positions_on(subject.mesh), strict=True)
    }
    size = min(source.size, 1 << (2 * max(rig.neutral.shape) - 1).bit_length())
    atlas = unwrap(subject.mesh, size)
    where = place_texels(
        atlas.position_mm, atlas.normal, atlas.covered, landmarks_mm=points, landmarks_px=marks
    )
    neutral, known = where.sample(rig.neutral, rig.valid)
    aside = float((atlas.covered & ~known).mean() / atlas.covered.mean())
    left_out = {
        "color outside the image": f"{100 * aside:.0f} % of the skin was not visible; "
        "its color is extrapolated"
    }
    if MELANIN_MAP in appearance.maps:
        found = appearance.maps[MELANIN_MAP]
        valid = rig.valid if found.valid is None else found.valid
        melanin, melanin_known = where.sample(found.values, valid)
        melanin = fill_holes(melanin, melanin_known)
    else:
        left_out["melanin of this face"] = "the folder has no melanin map; it is simulated"
        melanin = FineSkin(subject, size).melanin()
    cells = coarse_grid((size, size), RIG_PX)

    def stored(kept: Float64Array, held: BoolArray) -> Float64Array:
        (fine,) = rig.cells.refine(kept, valid=held)
        texels, seen = where.sample(np.nan_to_num(fine), np.isfinite(fine) & rig.valid)
        return fill_holes(*cells.coarsen(texels, seen))

    states: dict[str, Float64Array] = {}
    for name in (NEUTRAL, *rig.states):
        held = rig.neutral_mean_valid if name == NEUTRAL else rig.states[name].valid
        pair = [stored(maps[name], held) for maps in (rig.scale, rig.bias)]
        states[name] = np.stack(pair, axis=-1)
    return FaceColor(
        melanin=melanin,
        hemoglobin=fill_holes(neutral, known),
        states=states,
        global_states=rig.global_states,
        facts={
            "source": appearance.source,
            "placed_by_landmarks": where.landmarks,
            "leave_one_out_px": where.leave_one_out_px,
        },
        left_out=tuple(left_out.items()),
    )


def read_image_landmarks(
    source: SceneSource, part: dict[str, Any]
) -> dict[str, tuple[float, float]]:
    """Read the landmarks of the flash rig's neutral image, px.

    Raises
    ------
    SceneError
        If there is neither a table nor a simulation's ground truth next to the folder.
    """
    if source.landmarks is not None:
        return landmark_table.read_landmark_table(source.landmarks)
    name = (part.get("truth") or {}).get("neutral")
    if isinstance(name, str):
        folder = source.paths["dynamic"].resolve().parent / Path(name).name
        if (folder / store.DOCUMENT_FILE).is_file():
            points: Any = store.read_document(folder).parameters.get("landmarks_px")
            if isinstance(points, dict):
                return {key: (float(x), float(y)) for key, (x, y) in points.items()}
    raise SceneError(
        f"{source.paths['dynamic']}: got maps of an image without landmarks, expected some to map "
        "them to the mesh; give --landmarks FILE, a table name,x,y of the neutral image"
    )
