"""A mesh with its material and blend shapes as one binary glTF 2.0 file.

Written by hand: JSON, and a binary chunk of accessors and PNG images. Lengths are metres and
texture coordinates grow downwards, as the standard has it. glTF has no place for subsurface light:
sigma_tr goes into ``extras``.

References
----------
glTF 2.0 specification, ISO/IEC 12113:2022; KHR_materials_ior, KHR_materials_specular.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from model.skin import SkinAppearance
from skinrig.drawing import png
from skinrig.errors import UnusableError, UsageError
from skinrig.exporting.images import Image, ImageFolder, coded
from skinrig.exporting.materials import blender
from skinrig.exporting.materials.material import COLOR_NOTE, MAP_NOTES, Material
from skinrig.exporting.options import M_PER_MM, Delivery
from skinrig.exporting.provenance import provenance
from skinrig.exporting.sealing import write_json

GLB_FILE, DOCUMENT_FILE = "skin.glb", "glb.json"
SCHEMA: Final = "skinrig.export.glb/1"
MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
FLOAT, UNSIGNED_INT = 5126, 5125
VERTICES, INDICES = 34962, 34963
"""What a view of the buffer is for."""


@dataclass(slots=True)
class _Buffer:
    """The binary chunk while it grows, and what refers to it."""

    data: bytearray = field(default_factory=bytearray)
    views: list[dict[str, Any]] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)

    def view(self, content: bytes, target: int | None = None) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        entry: dict[str, Any] = {
            "buffer": 0,
            "byteOffset": len(self.data),
            "byteLength": len(content),
        }
        if target is not None:
            entry["target"] = target
        self.data += content
        self.views.append(entry)
        return len(self.views) - 1

    def vectors(self, values: NDArray[Any], *, bounds: bool = False) -> int:
        rows = np.ascontiguousarray(values, "<f4")
        entry: dict[str, Any] = {
            "bufferView": self.view(rows.tobytes(), VERTICES),
            "componentType": FLOAT,
            "count": len(rows),
            "type": f"VEC{rows.shape[1]}",
        }
        if bounds:
            entry["min"], entry["max"] = rows.min(axis=0).tolist(), rows.max(axis=0).tolist()
        self.accessors.append(entry)
        return len(self.accessors) - 1

    def indices(self, faces: NDArray[Any]) -> int:
        flat = np.ascontiguousarray(faces.reshape(-1), "<u4")
        self.accessors.append(
            {
                "bufferView": self.view(flat.tobytes(), INDICES),
                "componentType": UNSIGNED_INT,
                "count": len(flat),
                "type": "SCALAR",
            }
        )
        return len(self.accessors) - 1


def write(appearance: SkinAppearance, folder: Path, delivery: Delivery) -> list[tuple[str, str]]:
    """Write skin.glb and a document of what it holds.

    Parameters
    ----------
    appearance
        Of a dome, or a fitted model.
    folder
        Existing, empty.
    delivery
        Another mesh; blend shapes come from it. glTF is in metres and +Y, and has no tiles.

    Returns
    -------
    list of (str, str)
        What was left out, and why.

    Raises
    ------
    skinrig.errors.UsageError
        For another unit or direction of green than glTF's.
    ValueError
        See :meth:`skinrig.exporting.materials.material.Material.of`.
    """
    for option, value, only in (
        ("--unit", delivery.unit_or("m"), "m"),
        ("--normal-y", delivery.normal_y, "gl"),
        ("--udim", delivery.udim, "none"),
    ):
        if value != only:
            raise UsageError(f"{option}: got {value}, but glTF knows {only} alone; leave it out")
    material = Material.of(appearance, delivery.mesh)
    if material.tiles[1:]:
        raise UnusableError(
            f"--mesh: reaches over tiles {', '.join(map(str, material.tiles))}, but glTF knows one "
            "alone; take mtlx or usd, or a mesh of tile 1001"
        )
    (folder / GLB_FILE).write_bytes(content(material))
    script = blender.Import.of_channels(GLB_FILE, material.usual_radius_mm()).script()
    (folder / blender.SCRIPT_FILE).write_text(script, encoding="utf-8")
    out = ImageFolder(folder, delivery)
    if delivery.with_errors:
        for image in material.error_images():
            out.exr(image)
    write_json(
        folder / DOCUMENT_FILE,
        {
            **provenance(appearance),
            "schema": SCHEMA,
            "scene_unit": "m",
            "frame": "+x right, +y up, +z towards the main camera (the front of glTF)",
            "base_color": f"{MAP_NOTES['base_color']}; {COLOR_NOTE}; 8 bits, sRGB curve",
            "normal": "tangent space of the TANGENT attribute, +Y, 8 bits; the maps and mtlx "
            "exports hold 16",
            "subsurface": {**material.sigma_tr(), "mapping": MAP_NOTES["subsurface_radius"]},
            "specular_ior": material.eta,
            "morph_targets": list(material.shapes),
            "figures": material.figures(),
            "assumed": material.all_assumed(appearance),
            "files": dict(sorted(out.records.items())),
        },
    )
    left_out = [
        *material.left_out_of_mesh(delivery),
        (
            "subsurface light",
            f"glTF has no place for it: see extras; {blender.SCRIPT_FILE} sets it in Blender",
        ),
    ]
    if not material.shapes:
        left_out.append(("morph targets", "the mesh has no blend shapes; name one with --mesh"))
    return left_out


def content(material: Material) -> bytes:
    """Return a .glb file.

    Parameters
    ----------
    material
        In mm.
    """
    mesh, buffer = material.mesh, _Buffer()
    attributes = {
        "POSITION": buffer.vectors(mesh.vertices_mm * M_PER_MM, bounds=True),
        "NORMAL": buffer.vectors(mesh.normals),
        # v grows downwards here: the third axis keeps its meaning, along falling v
        "TANGENT": buffer.vectors(mesh.tangents),
        "TEXCOORD_0": buffer.vectors(np.column_stack([mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]])),
    }
    targets = [
        {"POSITION": buffer.vectors(moved * M_PER_MM, bounds=True)}
        for moved in material.shapes.values()
    ]
    primitive: dict[str, Any] = {
        "attributes": attributes,
        "indices": buffer.indices(mesh.faces),
        "material": 0,
        "mode": 4,
    }
    shape: dict[str, Any] = {"name": "skin", "primitives": [primitive]}
    if targets:
        primitive["targets"] = targets
        shape["weights"] = [0.0] * len(targets)
        shape["extras"] = {"targetNames": list(material.shapes)}
    images = [
        {"name": name, "mimeType": "image/png", "bufferView": buffer.view(data)}
        for name, data in _pictures(material)
    ]
    document = {
        "asset": {"version": "2.0", "generator": f"skinrig {version('skinrig')}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "skin", "mesh": 0}],
        "meshes": [shape],
        "materials": [_material(material)],
        "textures": [{"source": k, "sampler": 0} for k in range(len(images))],
        "samplers": [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}],
        "images": images,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data) + -len(buffer.data) % 4}],
        "extensionsUsed": ["KHR_materials_ior", "KHR_materials_specular"],
    }
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    binary = bytes(buffer.data) + b"\0" * (-len(buffer.data) % 4)
    total = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join(
        [
            struct.pack("<III", MAGIC, 2, total),
            struct.pack("<II", len(text), JSON_CHUNK),
            text,
            struct.pack("<II", len(binary), BINARY_CHUNK),
            binary,
        ]
    )


def _material(material: Material) -> dict[str, Any]:
    return {
        "name": "Skin",
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "metallicFactor": 0.0,
            "roughnessFactor": 1.0,
            "metallicRoughnessTexture": {"index": 1},
        },
        "normalTexture": {"index": 2, "scale": 1.0},
        "extensions": {
            "KHR_materials_ior": {"ior": float(material.eta)},
            "KHR_materials_specular": {"specularFactor": 1.0, "specularTexture": {"index": 3}},
        },
        "extras": {"subsurface": material.sigma_tr()},
    }


def _pictures(material: Material) -> list[tuple[str, bytes]]:
    """Return the textures' names and PNG files of 8 bits, in the order of their indices."""
    delivery = Delivery()

    def codes(image: Image) -> NDArray[Any]:
        return coded(image, depth=8)[0]

    rough = codes(material.image("specular_roughness", delivery))
    zero = np.zeros_like(rough)
    weight = codes(material.image("specular_weight", delivery))
    white = np.full_like(weight, 255)
    pictures = {
        "base_color": codes(material.image("base_color", delivery)),
        "roughness in G, metallic 0 in B": np.stack([zero, rough, zero], axis=-1),
        "normal": codes(material.image("normal", delivery)),
        "specular in A": np.stack([white, white, white, weight], axis=-1),
    }
    return [(name, png.encode(image, quick=True)) for name, image in pictures.items()]
