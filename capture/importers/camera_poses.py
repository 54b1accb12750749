"""Read the orientation of the camera that took a folder of images: transforms.json and COLMAP.

Lists of lights can be in the frame of a scene rather than of the camera. These files state the
camera's axes in that frame.
"""

from collections.abc import Mapping, Sequence
from itertools import takewhile, zip_longest
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
Name = tuple[str, ...]
"""Folders and stem of an image's name, in small letters."""
Pose = tuple[Name, Float64Array]
"""Name of an image, and the axes of its camera."""
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
        The images; entries are found by the names of files, whatever their suffix. Folders in
        front of the name count where entries of one name differ.

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
    stems: dict[str, list[Pose]] = {}
    for pose in found:
        stems.setdefault(pose[0][-1], []).append(pose)
    chosen: list[Pose] = []
    for file in images:
        parts = _split_name(str(file.absolute()))
        chosen += _match_folders(stems.get(parts[-1], []), parts)
    if not chosen and len(found) == 1:  # one pose for all images
        chosen = found
    if not chosen:
        raise LightListError.at(
            "names no image of the folder", "cameras", ", ".join(list(stems)[:3]), "its images",
            where=path,
        )  # fmt: skip
    (first, axes), *others = chosen
    for name, other in others:
        angle = _measure_angle_deg(axes, other)
        if angle > MAX_ANGLE_DEG:
            pair = [one[-1] for one in (first, name)]
            if pair[0] == pair[1]:
                pair = ["/".join(one) for one in (first, name)]
            raise LightListError(
                "has several cameras",
                where=str(path),
                faults=[Fault(" and ".join(pair), f"{angle:.1f} degrees apart", "one camera")],
                advice="Move the images of each camera to a folder of its own; import one.",
            )
    return axes


def _match_folders(poses: list[Pose], parts: Name) -> list[Pose]:
    """Return the poses of an image's name; if they differ, those of most folders in common.

    Examples
    --------
    >>> first, second = (("cam01", "1"), np.eye(3)), (("cam02", "1"), np.diag([-1.0, -1.0, 1.0]))
    >>> [name for name, _ in _match_folders([first, second], ("rig", "cam02", "1"))]
    [('cam02', '1')]
    """
    if all(_measure_angle_deg(poses[0][1], axes) <= MAX_ANGLE_DEG for _, axes in poses[1:]):
        return poses
    common = []
    for name, _ in poses:
        equal = (a == b for a, b in zip(reversed(name), reversed(parts), strict=False))
        common.append(sum(1 for _ in takewhile(bool, equal)))
    return [pose for pose, count in zip(poses, common, strict=True) if count == max(common)]


def _measure_angle_deg(axes: Float64Array, other: Float64Array) -> float:
    """Return the angle of the rotation between two cameras."""
    cosine = (np.trace(axes @ other.T) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _read_transforms(path: Path) -> list[Pose]:
    """Return the cameras of a transforms.json with the names of their images."""
    document: Any = read_json(read_text(path).encode(), where=str(path), error=LightListError)
    frames = document.get("frames") if isinstance(document, Mapping) else None
    if not isinstance(frames, list) or not frames:
        raise LightListError.at("is not a list of cameras", "frames", "none", "a list", where=path)
    found = []
    for number, frame in enumerate(frames, start=1):
        where = f"{path}, frame {number}"
        entry = frame if isinstance(frame, Mapping) else {}
        try:
            matrix = np.array(entry.get("transform_matrix"), np.float64)
        except (TypeError, ValueError, OverflowError):
            matrix = np.zeros(())
        if matrix.shape not in ((4, 4), (3, 4)) or not isinstance(entry.get("file_path"), str):
            raise LightListError.at(
                "is not a camera", "transform_matrix, file_path", str(matrix.shape),
                "4 x 4 numbers and a name", where=where,
            )  # fmt: skip
        name = _split_name(entry["file_path"])
        found.append((name, _require_rotation(matrix[:3, :3].T, where)))
    return found


def _read_colmap(path: Path) -> list[Pose]:
    """Return the cameras of COLMAP's images.txt with the names of their images."""
    found: list[Pose] = []
    lines = read_text(path).rstrip().splitlines()
    rows = [(k, line.split()) for k, line in enumerate(lines, start=1) if line[:1] != "#"]
    # each image has two lines: its pose, and its points, which may be none
    for (number, words), (below, points) in zip_longest(rows[::2], rows[1::2], fillvalue=(0, [])):
        where = f"{path}, line {number}"
        quaternion = _parse_quaternion(words)
        if quaternion is None:
            raise LightListError.at(
                "is not COLMAP's images.txt", "pose", " ".join(words)[:60] or "nothing",
                "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", where=where,
            )  # fmt: skip
        if _parse_quaternion(points) is not None and not _is_points(points):
            raise LightListError.at(
                "lacks the lines of points", "points", " ".join(points)[:60],
                "X Y POINT3D_ID ..., or a blank line, below each pose",
                where=f"{path}, line {below}",
            )  # fmt: skip
        w, x, y, z = quaternion
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        found.append((_split_name(" ".join(words[9:])), COLMAP_AXES @ rotation))
    if not found:
        raise LightListError.at("is not COLMAP's images.txt", "images", "0", "one", where=path)
    return found


def _parse_quaternion(words: Sequence[str]) -> Float64Array | None:
    """Return the unit quaternion of a pose's line (w, x, y, z); None for another line."""
    try:
        values = np.array([float(word) for word in words[1:5]])
    except ValueError:
        return None
    length = float(np.linalg.norm(values))
    if len(words) < 10 or not 0.0 < length < np.inf:
        return None
    return values / length


def _is_points(words: Sequence[str]) -> bool:
    """Return whether a line has triples of numbers alone; a pose has ten words with its name."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return False
    return len(numbers) % 3 == 0


def _split_name(name: str) -> Name:
    r"""Return the folders and the name of an image, without the suffix of a file.

    Examples
    --------
    >>> _split_name("./Train/R_01.png"), _split_name("a\\b")
    (('train', 'r_01'), ('a', 'b'))
    """
    path = Path(name.casefold().replace("\\", "/"))
    return (*path.parts[:-1], path.stem)


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
