"""Read the orientation of the camera that took a folder of images: transforms.json and COLMAP.

Lists of lights can be in the frame of a scene rather than of the camera. These files state the
camera's axes in that frame.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from capture.arrays import Float64Array
from capture.documents import Fault, read_json
from capture.importers.light_tables import LightListError, read_text

MAX_ANGLE_DEG = 0.1
"""Angle between cameras of one list up to which they count as one."""
MAX_SKEW = 1e-3
"""Deviation of a matrix from a rotation, after a common scale."""
COLMAP_AXES = np.diag([1.0, -1.0, -1.0])
"""COLMAP's cameras look along z, with y down."""


def read_camera_axes(path: Path, images: Sequence[Path]) -> Float64Array:
    """Return the axes of the camera that took the images, in the frame of the scene.

    Parameters
    ----------
    path
        ``transforms.json`` as of NeRF and Blender (``transform_matrix``: camera to scene, z away
        from the scene), or ``images.txt`` of COLMAP (quaternion: scene to camera, z forward).
    images
        The images; entries are found by the names of files, whatever their suffix.

    Returns
    -------
    ndarray, shape (3, 3)
        Rows: right, up, and towards the camera.

    Raises
    ------
    LightListError
        If the file has another form, none of the images, or cameras that differ among them.

    Examples
    --------
    >>> import json, tempfile
    >>> file = Path(tempfile.mkdtemp()) / "transforms.json"
    >>> turned = [[0, 0, 1, 5], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]]
    >>> _ = file.write_text(json.dumps(
    ...     {"frames": [{"file_path": "./a/01", "transform_matrix": turned}]}))
    >>> (read_camera_axes(file, [Path("01.png")]) + 0.0).tolist()
    [[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    """
    if path.suffix.lower() == ".bin":
        raise LightListError(
            "is binary",
            where=str(path),
            advice="Convert it by `colmap model_converter --output_type TXT`; name images.txt.",
        )
    found = _read_transforms(path) if path.suffix.lower() == ".json" else _read_colmap(path)
    stems = {file.stem.casefold() for file in images}
    chosen = {name: axes for name, axes in found.items() if name in stems}
    if not chosen and len(found) == 1:  # one pose for all images
        chosen = found
    if not chosen:
        raise LightListError.at(
            "names no image of the folder", "cameras", ", ".join(list(found)[:3]), "its images",
            where=path,
        )  # fmt: skip
    (first, axes), *others = chosen.items()
    for name, other in others:
        cosine = (np.trace(axes @ other.T) - 1.0) / 2.0
        angle = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
        if angle > MAX_ANGLE_DEG:
            raise LightListError(
                "has several cameras",
                where=str(path),
                faults=[Fault(f"{first} and {name}", f"{angle:.1f} degrees apart", "one camera")],
                advice="Move the images of each camera to a folder of its own; import one.",
            )
    return axes


def _read_transforms(path: Path) -> dict[str, Float64Array]:
    """Return the axes of each camera of a transforms.json by the stem of its image."""
    document: Any = read_json(read_text(path).encode(), where=str(path), error=LightListError)
    frames = document.get("frames") if isinstance(document, Mapping) else None
    if not isinstance(frames, list) or not frames:
        raise LightListError.at("is not a list of cameras", "frames", "none", "a list", where=path)
    found = {}
    for number, frame in enumerate(frames, start=1):
        where = f"{path}, frame {number}"
        entry = frame if isinstance(frame, Mapping) else {}
        try:
            matrix = np.array(entry.get("transform_matrix"), np.float64)
        except (TypeError, ValueError):
            matrix = np.zeros(())
        if matrix.shape not in ((4, 4), (3, 4)) or not isinstance(entry.get("file_path"), str):
            raise LightListError.at(
                "is not a camera", "transform_matrix, file_path", str(matrix.shape),
                "4 x 4 numbers and a name", where=where,
            )  # fmt: skip
        found[_stem(entry["file_path"])] = _require_rotation(matrix[:3, :3].T, where)
    return found


def _read_colmap(path: Path) -> dict[str, Float64Array]:
    """Return the axes of each camera of COLMAP's images.txt by the stem of its image."""
    found = {}
    lines = read_text(path).splitlines()
    rows = [(k, line.split()) for k, line in enumerate(lines, start=1) if line[:1] != "#"]
    # each image has two lines: its pose, and its points, which may be none
    for number, words in rows[::2]:
        where = f"{path}, line {number}"
        try:
            w, x, y, z = (float(word) for word in words[1:5])
        except ValueError:
            w = x = y = z = 0.0
        length = np.sqrt(w * w + x * x + y * y + z * z)
        if len(words) < 10 or not 0.0 < length < np.inf:
            raise LightListError.at(
                "is not COLMAP's images.txt", "pose", " ".join(words)[:60] or "nothing",
                "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", where=where,
            )  # fmt: skip
        w, x, y, z = np.array([w, x, y, z]) / length
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        found[_stem(" ".join(words[9:]))] = COLMAP_AXES @ rotation
    if not found:
        raise LightListError.at("is not COLMAP's images.txt", "images", "0", "one", where=path)
    return found


def _stem(name: str) -> str:
    r"""Return the name of an image without folders and the suffix of a file.

    Examples
    --------
    >>> _stem("./Train/R_01.png"), _stem("a\\b")
    ('r_01', 'b')
    """
    return Path(name.replace("\\", "/")).stem.casefold()


def _require_rotation(matrix: Float64Array, where: str) -> Float64Array:
    """Return a matrix without its scale; refuse one that is not a rotation."""
    det = float(np.linalg.det(matrix)) if np.isfinite(matrix).all() else 0.0
    scaled = matrix / np.cbrt(det) if det > 0.0 else matrix
    if not (det > 0.0 and np.abs(scaled @ scaled.T - np.eye(3)).max() < MAX_SKEW):
        raise LightListError.at(
            "is not a camera", "transform_matrix", "no rotation", "a rotation and a shift",
            where=where,
        )  # fmt: skip
    return scaled
