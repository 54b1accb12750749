"""Read blend shapes from glTF 2.0: the morph targets of one mesh of a .gltf or .glb file.

JSON and buffers are decoded here: a mesh with targets needs only accessors (also sparse and
quantized ones), which glTF libraries leave to the caller.

Positions are transformed by the node that instantiates the mesh. A skinned mesh is read in its bind
pose, as the standard requires. Texture coordinates are flipped to v up. Compressed geometry is
refused with the name of its extension.

References
----------
glTF 2.0 specification, ISO/IEC 12113:2022.
"""

import base64
import binascii
import struct
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from model.checks.files import decode_json
from rigsim.geometry.mesh import MeshFileError
from skinrig.arrays import Float64Array
from skinrig.blend_shapes.obj import MeshArrays

GLB_MAGIC, GLB_JSON, GLB_BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
COMPONENT_DTYPES: Final[dict[int, np.dtype[Any]]] = {
    5120: np.dtype("<i1"),
    5121: np.dtype("<u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
"""Component types of buffers by the standard's codes."""
ACCESSOR_WIDTHS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
COMPRESSION_EXTENSIONS: Final = (
    "KHR_draco_mesh_compression",
    "EXT_meshopt_compression",
    "KHR_meshopt_compression",
)
TRIANGLES_MODE: Final = 4
MAX_ZERO_ROWS: Final = 2**22
"""Maximum length of an accessor without a buffer, which only sparse values fill."""
MAX_NODE_DEPTH: Final = 1000
"""Maximum depth of a mesh in the scene graph; a deeper one is assumed to be cyclic."""


class _Gltf:
    """A glTF file: its document, and its accessors as arrays."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.binary: bytes | None = None
        try:
            data = path.read_bytes()
        except OSError as error:
            raise self.build_error(f"cannot be read: {error.strerror}") from error
        text = self._unpacked(data) if path.suffix.lower() == ".glb" else data
        try:
            document = decode_json(text)
        except ValueError as error:
            raise self.build_error(f"not JSON: {error}") from error
        if not isinstance(document, dict):
            raise self.build_error("got no JSON object")
        asset, required = document.get("asset"), document.get("extensionsRequired")
        version = asset.get("version", "none") if isinstance(asset, dict) else "none"
        if not str(version).startswith("2."):
            raise self.build_error(f"got glTF version {version}, expected 2")
        for name in required if isinstance(required, list) else []:
            if name in COMPRESSION_EXTENSIONS:
                raise self.build_error(f"geometry is compressed by {name}; export it uncompressed")
        self.document: dict[str, Any] = document
        self.buffers: dict[int, bytes] = {}

    def build_error(self, message: str) -> MeshFileError:
        return MeshFileError(f"{self.path}: {message}")

    def _unpacked(self, data: bytes) -> bytes:
        if len(data) < 20 or struct.unpack_from("<I", data)[0] != GLB_MAGIC:
            raise self.build_error("not a GLB file")
        length = struct.unpack_from("<I", data, 8)[0]
        if length != len(data):
            raise self.build_error(f"got {len(data)} bytes, expected {length}; copy it again")
        at, text = 12, None
        while at + 8 <= len(data):
            size, kind = struct.unpack_from("<II", data, at)
            chunk = data[at + 8 : at + 8 + size]
            if len(chunk) != size:
                raise self.build_error("a chunk is truncated; copy the file again")
            if kind == GLB_JSON and text is None:
                text = chunk
            elif kind == GLB_BIN and self.binary is None:
                self.binary = chunk
            at += 8 + size
        if text is None:
            raise self.build_error("JSON chunk is missing; export it again")
        return text

    def buffer(self, number: int) -> bytes:
        if number not in self.buffers:
            entry = self.document["buffers"][number]
            uri = entry.get("uri")
            if uri is None:
                if self.binary is None or number != 0:
                    raise self.build_error(f"buffer {number} has no data")
                data = self.binary
            elif uri.startswith("data:"):
                try:
                    data = base64.b64decode(uri.split(",", 1)[1], validate=True)
                except (IndexError, binascii.Error) as error:
                    raise self.build_error(f"buffer {number}: its data URI is damaged") from error
            else:
                file = self.path.parent / unquote(uri)
                here = self.path.parent.resolve()
                if not file.resolve().is_relative_to(here):  # also by a link
                    raise self.build_error(
                        f"buffer {number}: got {uri!r}, expected a file next to it"
                    )
                try:
                    data = file.read_bytes()
                except OSError as error:
                    raise self.build_error(
                        f"buffer {number}: {uri!r} is not readable; check the file"
                    ) from error
            if len(data) < int(entry["byteLength"]):
                raise self.build_error(f"buffer {number} is truncated; copy the file again")
            self.buffers[number] = data
        return self.buffers[number]

    def _rows(self, entry: dict[str, Any], count: int, component: int, width: int) -> NDArray[Any]:
        """Return the numbers of an entry's buffer view, (count, width)."""
        view_number, offset = int(entry["bufferView"]), int(entry.get("byteOffset", 0))
        kind = COMPONENT_DTYPES[component]
        view = self.document["bufferViews"][view_number]
        stride = int(view.get("byteStride", 0)) or kind.itemsize * width
        start = int(view.get("byteOffset", 0)) + offset
        end = start + (count - 1) * stride + kind.itemsize * width if count else start
        data = self.buffer(int(view["buffer"]))
        last = int(view.get("byteOffset", 0)) + int(view["byteLength"])
        if start < 0 or stride < kind.itemsize * width or end > min(last, len(data)):
            raise self.build_error(
                f"buffer view {view_number} is shorter than what is stored there"
            )
        return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize)).copy()

    def accessor(self, number: int, kind: str) -> NDArray[Any]:
        """Return an accessor's numbers, shape (N, width); normalized integers as floats."""
        entry = self.document["accessors"][number]
        if entry["type"] != kind:
            raise self.build_error(f"accessor {number}: got {entry['type']}, expected {kind}")
        component, count = int(entry["componentType"]), int(entry["count"])
        width = ACCESSOR_WIDTHS[kind]
        if component not in COMPONENT_DTYPES:
            raise self.build_error(f"accessor {number}: got component type {component}")
        if "bufferView" in entry:
            values = self._rows(entry, count, component, width)
        else:
            if not 0 <= count <= MAX_ZERO_ROWS:
                raise self.build_error(
                    f"accessor {number}: got {count} rows without data, expected at most "
                    f"{MAX_ZERO_ROWS}"
                )
            values = np.zeros((count, width), COMPONENT_DTYPES[component])
        if "sparse" in entry:
            sparse = entry["sparse"]
            n, at, new = int(sparse["count"]), sparse["indices"], sparse["values"]
            places = self._rows(at, n, int(at["componentType"]), 1)[:, 0]
            if n and int(places.max()) >= count:
                raise self.build_error(f"accessor {number}: a sparse index is beyond {count - 1}")
            values[places] = self._rows(new, n, component, width)
        if entry.get("normalized") and values.dtype.kind in "iu":
            top = float(np.iinfo(values.dtype).max)
            return np.asarray(np.maximum(values.astype(np.float64) / top, -1.0))
        return values


def read(path: Path) -> MeshArrays:
    """Read the mesh with morph targets of a glTF file.

    Parameters
    ----------
    path
        .gltf or .glb.

    Returns
    -------
    vertices, uv, faces, deltas
        Shapes (V, 3), (V, 2), (F, 3), and (V, 3) each; meters, v up.

    Raises
    ------
    MeshFileError
        If the file is damaged, compressed, or without such a mesh.
    """
    gltf = _Gltf(path)
    try:
        return _read(gltf)
    except MeshFileError:
        raise
    except (
        *(KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError),
        *(MemoryError, RecursionError),
    ) as error:
        raise gltf.build_error(
            f"an entry is missing or of a wrong type ({error!r}); export it again"
        ) from error


def _read(gltf: _Gltf) -> MeshArrays:
    number = _select_mesh(gltf)
    mesh = gltf.document["meshes"][number]
    matrix = _transform(gltf, number)
    vertices, texture, faces, moved = [], [], [], []
    count = 0
    for index, primitive in enumerate(mesh["primitives"]):
        where = f"mesh {mesh.get('name', number)!r}, primitive {index}"
        if primitive.get("mode", TRIANGLES_MODE) != TRIANGLES_MODE:
            raise gltf.build_error(f"{where}: got mode {primitive['mode']}, expected triangles")
        attributes = primitive["attributes"]
        for name in ("POSITION", "TEXCOORD_0"):
            if name not in attributes:
                raise gltf.build_error(f"{where}: lacks {name}")
        points = gltf.accessor(attributes["POSITION"], "VEC3").astype(np.float64)
        uv = gltf.accessor(attributes["TEXCOORD_0"], "VEC2").astype(np.float64)
        if "indices" in primitive:
            corners = gltf.accessor(primitive["indices"], "SCALAR")[:, 0].astype(np.int64)
        else:
            corners = np.arange(len(points), dtype=np.int64)
        if corners.size % 3 or (corners.size and corners.max() >= len(points)):
            raise gltf.build_error(
                f"{where}: indices are not those of triangles of {len(points)} vertices"
            )
        targets = []
        for target in primitive.get("targets", []):
            deltas = np.zeros_like(points)
            if "POSITION" in target:
                deltas = gltf.accessor(target["POSITION"], "VEC3").astype(np.float64)
            targets.append(deltas @ matrix[:3, :3].T)
        if any(len(values) != len(points) for values in (uv, *targets)):
            raise gltf.build_error(
                f"{where}: attributes and targets differ in length; export it again"
            )
        vertices.append(points @ matrix[:3, :3].T + matrix[:3, 3])
        texture.append(np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1))
        faces.append(corners.reshape(-1, 3) + count)
        moved.append(targets)
        count += len(points)
    if len({len(targets) for targets in moved}) != 1:
        raise gltf.build_error("primitives of the mesh differ in their number of targets")
    unnamed = [f"shape_{i}" for i in range(len(moved[0]))]
    names = mesh.get("extras", {}).get("targetNames") or unnamed
    if len(names) != len(moved[0]) or len(set(names)) != len(names):
        raise gltf.build_error(
            f"got {len(names)} names of targets, expected {len(moved[0])} distinct"
        )
    shapes = {
        str(name): np.concatenate([targets[i] for targets in moved]) for i, name in enumerate(names)
    }
    return np.concatenate(vertices), np.concatenate(texture), np.concatenate(faces), shapes


def _select_mesh(gltf: _Gltf) -> int:
    meshes = gltf.document.get("meshes", [])
    able = {
        number: str(mesh.get("name", number))
        for number, mesh in enumerate(meshes)
        if any(p.get("targets") for p in mesh["primitives"])
    }
    if len(able) != 1:
        listed = ", ".join(able.values()) or "none"
        raise gltf.build_error(
            f"got {len(able)} meshes with morph targets ({listed}), expected one; export one mesh"
        )
    return next(iter(able))


def _transform(gltf: _Gltf, mesh: int) -> Float64Array:
    """Return the 4 x 4 matrix from mesh to scene; identity if no node instantiates the mesh."""
    nodes = gltf.document.get("nodes", [])
    shown = [number for number, node in enumerate(nodes) if node.get("mesh") == mesh]
    if not shown or "skin" in nodes[shown[0]]:
        return np.eye(4)
    parent = {
        child: number for number, node in enumerate(nodes) for child in node.get("children", [])
    }
    matrix, here = _local(nodes[shown[0]]), shown[0]
    for _ in range(MAX_NODE_DEPTH):
        if here not in parent:
            return matrix
        here = parent[here]
        matrix = _local(nodes[here]) @ matrix
    raise gltf.build_error("its nodes are cyclic; export it again")


def _local(node: dict[str, Any]) -> Float64Array:
    if "matrix" in node:
        return np.asarray(node["matrix"], np.float64).reshape(4, 4).T  # stored by columns
    x, y, z, w = np.asarray(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), np.float64)
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = turn * np.asarray(node.get("scale", (1.0, 1.0, 1.0)), np.float64)
    matrix[:3, 3] = np.asarray(node.get("translation", (0.0, 0.0, 0.0)), np.float64)
    return matrix
