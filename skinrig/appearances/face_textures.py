"""Read a reconstructed face with its landmarks and relate its texture to a common map."""

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
"""Parameter of a TRUTH/ folder: x, y, z by landmark, mm, rig frame."""
LANDMARK_STDERR_MM: Final = 1.0
"""Standard uncertainty of a manually placed landmark, per axis."""


class FaceError(ValueError):
    """An appearance without the maps of a common map, or inconsistent landmarks."""


@dataclass(frozen=True, slots=True, eq=False)
class Face:
    """An appearance with its landmarks.

    Attributes
    ----------
    name
        Name of its folder, without "appearance-".
    path
        The folder.
    appearance
        Its maps.
    landmarks
        x, y, z by name, mm, rig frame; empty if there are none.
    marked_by
        Source of the landmarks, in words.
    """

    name: str
    path: Path
    appearance: SkinAppearance
    landmarks: Landmarks
    landmark_source: str

    @property
    def position(self) -> Float64Array:
        """Positions, (H, W, 3), mm."""
        return _map(self, "position").values.astype(np.float64)

    @property
    def surface(self) -> BoolArray:
        """Texels of the surface, (H, W)."""
        return find_valid_texels(_map(self, "position"))

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
        """Return the median distance of adjacent texels, mm."""
        position, on = self.position, self.surface
        step = np.linalg.norm(np.diff(position, axis=1), axis=-1)[on[:, 1:] & on[:, :-1]]
        return float(np.median(step)) if step.size else 1.0

    def correspondence(self, frame: CommonFrame) -> Correspondence:
        """Return the correspondence to a common map; without landmarks, only a cylindrical unwrap.

        Raises
        ------
        FaceError
            If the landmarks are inconsistent; the message names the folder.
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
        """Return the position of each texel in a common map."""
        return charts.chart_texels(self.position, self.surface, self.correspondence(frame), frame)


def read(path: Path, landmarks: Path | None = None) -> Face:
    """Read an appearance with landmarks from a table, else from its ground truth.

    Parameters
    ----------
    path
        APPEARANCE/ folder of a dome session.
    landmarks
        Table ``name,x,y`` in texels of the maps, or ``name,x,y,z`` in mm of the mesh.

    Raises
    ------
    FaceError, LandmarkError, StoreError
        If a file is invalid; the message names it.
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


def build_common_frame(faces: Sequence[Face], size: int | None = None) -> CommonFrame:
    """Build the common map of faces with landmarks."""
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
        If the file is not a table.
    FaceError
        If a landmark is outside the texture or not on the surface.
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
                    raise ValueError("expected a unique name and three numbers")
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
                f"{path}: {name!r} at ({x:g}, {y:g}) is "
                + ("not on the surface" if inside else "outside the texture")
                + f" of {face.path} ({on.shape[1]} x {on.shape[0]} texels)"
            )
        out[name] = _point(position[row, column].tolist())
    return out


def find_valid_texels(skin_map: SkinMap) -> BoolArray:
    """Return the valid texels with finite values, (H, W)."""
    finite = (
        np.isfinite(skin_map.values)
        if skin_map.values.ndim == 2
        else np.isfinite(skin_map.values).all(-1)
    )
    return np.asarray(finite if skin_map.valid is None else finite & skin_map.valid, np.bool_)


def choose_size(side_mm: float, texel_mm: float) -> int:
    """Return the width, a power of two in pixels, of a map with texels of about a given size.

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
            f"{face.path}: got maps {', '.join(sorted(have)) or 'none'}, expected {name!r}; run "
            f"`skinrig reconstruct SESSION --maps {name}` on a dome session [SR-REC-023]"
        )
    return face.appearance.maps[name]
