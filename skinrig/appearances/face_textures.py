"""A reconstructed face laid out in a common map: its landmarks, positions and albedo."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from model import store
from model.skin import SkinAppearance, SkinMap
from reconstruction.correspondence import charts, common_parameterization, landmark_table
from reconstruction.correspondence.charts import TexelChart
from reconstruction.correspondence.common_parameterization import (
    CommonFrame,
    Correspondence,
    ParameterizationError,
)
from skinrig.arrays import BoolArray, Float64Array

Point = tuple[float, float, float]
Landmarks = dict[str, Point]

TRUE_LANDMARKS_KEY: Final = "landmarks_mm"
"""Parameter of a TRUTH/ folder: name to x, y, z, mm, rig frame."""
LANDMARK_STDERR_MM: Final = 1.0
"""Standard error of a landmark that a person places, along each axis."""


class FaceError(ValueError):
    """An appearance that lacks what the common map needs, or landmarks that do not fit it."""


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """One appearance and where its landmarks are.

    Attributes
    ----------
    name
        Of its folder, without "appearance-".
    path
        The folder.
    appearance
        Its maps.
    landmarks
        Name to x, y, z, mm, rig frame; empty where there are none.
    marked_by
        Where they come from, for people.
    """

    name: str
    path: Path
    appearance: SkinAppearance
    landmarks: Landmarks
    marked_by: str

    @property
    def position(self) -> Float64Array:
        """Positions, (H, W, 3), mm."""
        return _map(self, "position").values.astype(np.float64)

    @property
    def surface(self) -> BoolArray:
        """Texels that show the surface, (H, W)."""
        return valid_texels(_map(self, "position"))

    @property
    def r_d(self) -> SkinMap:
        """The albedo map."""
        found = _map(self, "r_d")
        if found.values.ndim != 3:
            raise FaceError(f"{self.path}: r_d has shape {found.values.shape}, expected (H, W, 3)")
        if found.values.shape[:2] != _map(self, "position").values.shape[:2]:
            raise FaceError(f"{self.path}: r_d and position are of different sizes")
        return found

    def texel_mm(self) -> float:
        """Return the usual distance of two texels."""
        position, on = self.position, self.surface
        step = np.linalg.norm(np.diff(position, axis=1), axis=-1)[on[:, 1:] & on[:, :-1]]
        return float(np.median(step)) if step.size else 1.0

    def correspondence(self, frame: CommonFrame) -> Correspondence:
        """Return how the face lies in a common map; without landmarks it is unrolled and no more.

        Raises
        ------
        FaceError
            Naming the folder, where its landmarks do not fit.
        """
        if not self.landmarks:
            cylinder = common_parameterization.find_cylinder(self.position, self.surface)
            return Correspondence(cylinder)
        try:
            return common_parameterization.fit_correspondence(
                self.landmarks, frame, stderr_mm=LANDMARK_STDERR_MM
            )
        except ParameterizationError as error:
            raise FaceError(f"{self.path}: {error}") from error

    def chart(self, frame: CommonFrame) -> TexelChart:
        """Return where each texel lies in a common map."""
        return charts.chart_texels(self.position, self.surface, self.correspondence(frame), frame)


def read(path: Path, landmarks: Path | None = None) -> Face:
    """Read an appearance with its landmarks: of a table, else of its ground truth.

    Parameters
    ----------
    path
        APPEARANCE/ folder of a dome session.
    landmarks
        Table ``name,x,y`` in texels of the maps, or ``name,x,y,z`` in mm of the mesh.

    Raises
    ------
    FaceError, LandmarkError, StoreError
        Naming the file.
    """
    found = store.read(path)
    name = path.resolve().name.removeprefix("appearance-")
    face = Face(name, path, found, {}, "none")
    if landmarks is not None:
        return Face(name, path, found, read_landmarks(landmarks, face), landmarks.name)
    truth = _truth(path, found)
    known = truth and store.read_document(truth).parameters.get(TRUE_LANDMARKS_KEY)
    if not isinstance(known, dict):
        return face
    try:
        points = {str(n): _point([float(x) for x in place]) for n, place in known.items()}  # type: ignore[arg-type,union-attr]
    except (TypeError, ValueError) as error:
        raise FaceError(
            f"{truth}: {TRUE_LANDMARKS_KEY}: {json.dumps(known)[:80]}: {error}"
        ) from error
    return Face(name, path, found, points, "the simulation's own")


def common_frame(faces: Sequence[Face], size: int | None = None) -> CommonFrame:
    """Return the common map of some faces with landmarks."""
    names, places = common_parameterization.average_landmarks([face.landmarks for face in faces])
    cylinders = [common_parameterization.Cylinder(face.landmarks["nose tip"]) for face in faces]
    unrolled = [
        cylinder.unroll(face.position[face.surface])
        for cylinder, face in zip(cylinders, faces, strict=True)
    ]
    if size is None:
        coarse = common_parameterization.fit_common_frame(names, places, unrolled, size=64)
        size = choose_size(coarse.side_mm, max(face.texel_mm() for face in faces))
    return common_parameterization.fit_common_frame(names, places, unrolled, size=size)


def read_landmarks(path: Path, face: Face) -> Landmarks:
    """Read a table of landmarks, in texels or in mm.

    Raises
    ------
    landmark_table.LandmarkError
        For a file that is not a table.
    FaceError
        For a landmark outside the texture, or where it shows no surface.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise landmark_table.LandmarkError(f"{path}: expected UTF-8 text") from error
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if lines and [c.strip() for c in lines[0].split(",")] == ["name", "x", "y", "z"]:
        found: Landmarks = {}
        for number, line in enumerate(lines[1:], start=2):
            cells = [c.strip() for c in line.split(",")]
            try:
                if len(cells) != 4 or not cells[0] or cells[0] in found:
                    raise ValueError("expected a name of its own and three numbers")
                found[cells[0]] = _point([float(c) for c in cells[1:]])
            except ValueError as error:
                raise landmark_table.LandmarkError(f"{path}, row {number}: {error}") from error
        return found
    position, on = face.position, face.surface
    out: Landmarks = {}
    for name, (x, y) in landmark_table.read_landmark_table(path).items():
        column, row = round(x), round(y)
        inside = 0 <= row < on.shape[0] and 0 <= column < on.shape[1]
        if not inside or not on[row, column]:
            raise FaceError(
                f"{path}: {name!r} at ({x:g}, {y:g}) lies "
                + ("where the texture shows no surface" if inside else "outside the texture")
                + f" of {face.path} ({on.shape[1]} x {on.shape[0]} texels)"
            )
        out[name] = _point(position[row, column].tolist())
    return out


def valid_texels(skin_map: SkinMap) -> BoolArray:
    """Return the texels of a map that mean something, (H, W)."""
    finite = (
        np.isfinite(skin_map.values)
        if skin_map.values.ndim == 2
        else np.isfinite(skin_map.values).all(-1)
    )
    return np.asarray(finite if skin_map.valid is None else finite & skin_map.valid, np.bool_)


def choose_size(side_mm: float, texel_mm: float) -> int:
    """Return the width in pixels, a power of two, of a map with texels of a given size.

    Examples
    --------
    >>> choose_size(240.0, 1.0)
    128
    """
    return int(2 ** np.clip(math.floor(math.log2(max(side_mm / texel_mm, 1.0))), 6, 10))


def _truth(path: Path, found: SkinAppearance) -> Path | None:
    name = found.parameters.get("truth")
    if not isinstance(name, str) or not name or Path(name).name != name:
        return None
    folder = path.resolve().parent / name
    return folder if (folder / store.DOCUMENT_FILE).is_file() else None


def _point(values: list[float]) -> Point:
    if len(values) != 3 or not all(math.isfinite(v) for v in values):
        raise ValueError(f"got {values}, expected three finite numbers")
    return values[0], values[1], values[2]


def _map(face: Face, name: str) -> SkinMap:
    if name not in face.appearance.maps:
        have: Mapping[str, SkinMap] = face.appearance.maps
        raise FaceError(
            f"{face.path}: has no map {name!r} (it has {', '.join(sorted(have)) or 'none'}); "
            f"`skinrig reconstruct SESSION --maps {name}` of a dome session makes it [SR-REC-023]"
        )
    return face.appearance.maps[name]
