"""Write a mesh with its material and blend shapes as a binary glTF 2.0 file.

As the standard requires, lengths are in meters and v increases downwards. glTF has no subsurface
scattering; sigma_tr is written to ``extras``, and a variant of the material transmits light through
the body. The other materials, whose base color is complete, show unless somebody selects it. A
program with variants but without diffuse transmission then shows its base color, too bright.

References
----------
glTF 2.0 specification, ISO/IEC 12113:2022; KHR_materials_ior, KHR_materials_specular,
KHR_materials_variants; see `skinrig.exporting.materials.diffuse_transmission` for the variant.
"""

import copy
import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np
import pygltflib
from numpy.typing import NDArray

from model.skin import SkinAppearance
from skinrig.arrays import Float32Array
from skinrig.drawing import png
from skinrig.errors import UnusableError, UsageError
from skinrig.exporting.images import ImageFolder, encode_png_codes
from skinrig.exporting.materials import blender
from skinrig.exporting.materials.diffuse_transmission import (
    TRANSMISSION_EXTENSIONS,
    DiffuseTransmission,
    amplitude,
)
from skinrig.exporting.materials.expression_normals import (
    NEUTRAL_VARIANT,
    VARIANT_NOTE,
    expression_normals,
)
from skinrig.exporting.materials.material import Material
from skinrig.exporting.options import M_PER_MM, ExportSettings
from skinrig.exporting.sealing import describe_provenance

GLB_FILE, DOCUMENT_FILE = "skin.glb", "glb.json"
SCHEMA: Final = "skinrig.export.glb/1"
VARIANTS_EXTENSION: Final = "KHR_materials_variants"
N_NEUTRAL_TEXTURES: Final = 4
"""Textures of the neutral material; the base color of the translucent variant follows, then the
normals of expressions."""
TRANSLUCENT_VARIANT: Final = "translucent"
BRIGHT_QUANTILE: Final = 0.999
"""Texels up to this quantile keep their reflectance in the translucent variant."""


@dataclass(slots=True)
class _Binary:
    """The binary chunk of a file under construction."""

    file: pygltflib.GLTF2
    data: bytearray = field(default_factory=bytearray)

    def view(self, content: bytes, target: int | None = None) -> int:
        self.data += b"\0" * (-len(self.data) % 4)
        self.file.bufferViews.append(
            pygltflib.BufferView(
                buffer=0, byteOffset=len(self.data), byteLength=len(content), target=target
            )
        )
        self.data += content
        return len(self.file.bufferViews) - 1

    def accessor(self, values: NDArray[Any], *, bounds: bool = False) -> int:
        """Add vectors as floats, or integers as indices; return the accessor's index."""
        vectors = values.ndim == 2
        rows = np.ascontiguousarray(values, "<f4" if vectors else "<u4")
        self.file.accessors.append(
            pygltflib.Accessor(
                bufferView=self.view(
                    rows.tobytes(),
                    pygltflib.ARRAY_BUFFER if vectors else pygltflib.ELEMENT_ARRAY_BUFFER,
                ),
                componentType=pygltflib.FLOAT if vectors else pygltflib.UNSIGNED_INT,
                count=len(rows),
                type=f"VEC{rows.shape[1]}" if vectors else pygltflib.SCALAR,
                min=rows.min(axis=0).tolist() if bounds else None,
                max=rows.max(axis=0).tolist() if bounds else None,
            )
        )
        return len(self.file.accessors) - 1


def write(
    appearance: SkinAppearance, folder: Path, delivery: ExportSettings
) -> list[tuple[str, str]]:
    """Write skin.glb and a document of its contents.

    Parameters
    ----------
    appearance
        Appearance of a dome, or a fitted model.
    folder
        Existing, empty folder.
    delivery
        Another mesh, with optional blend shapes. glTF is in meters and +Y, and has no tiles.

    Returns
    -------
    list of (str, str)
        Omissions with reasons.

    Raises
    ------
    skinrig.errors.UsageError
        If unit or direction of green are not those of glTF.
    ValueError
        See :meth:`skinrig.exporting.materials.material.Material.of`.
    """
    for option, value, only in (
        ("--unit", delivery.scene_unit, "m"),
        ("--normal-y", delivery.normal_y, "gl"),
        ("--udim", delivery.udim, "none"),
    ):
        if value != only:
            raise UsageError(
                f"{option}: got {value}, expected {only}, the only one of glTF; remove it"
            )
    material = Material.of(appearance, delivery.mesh)
    if material.tiles[1:]:
        raise UnusableError(
            f"--mesh: got tiles {', '.join(map(str, material.tiles))}, expected tile 1001, as glTF "
            "has one; export to mtlx or usd, or give another mesh"
        )
    variants = expression_normals(appearance, material)
    (folder / GLB_FILE).write_bytes(encode_glb(material, describe_provenance(appearance), variants))
    script = blender.Import.from_channels(GLB_FILE, material.median_radius_mm()).script()
    (folder / blender.SCRIPT_FILE).write_text(script, encoding="utf-8")
    out = ImageFolder(folder, delivery, appearance)
    out.errors(material.error_images())
    facts = material.facts(appearance)
    out.document(
        DOCUMENT_FILE,
        {
            **facts,
            "schema": SCHEMA,
            "scene_unit": "m",
            "frame": "+x right, +y up, +z towards the main camera (the front of glTF)",
            "base_color": f"{facts['base_color']}; 8 bits, sRGB curve",
            "normal": "tangent space of the TANGENT attribute, +Y, 8 bits; the maps and mtlx "
            "exports have 16",
            "morph_targets": list(material.shapes),
            "variants": {TRANSLUCENT_VARIANT: TRANSLUCENT_NOTE}
            | dict.fromkeys(variants, VARIANT_NOTE),
            "transmission": describe_transmission(material),
        },
    )
    in_blender = f"see extras; {blender.SCRIPT_FILE} sets it in Blender"
    left_out = material.list_mesh_omissions(delivery)
    why = f"glTF spreads no light sideways; the variant {TRANSLUCENT_VARIANT} transmits it"
    left_out.append(("subsurface light", f"{why}: {in_blender}"))
    if not material.shapes:
        left_out.append(
            ("morph targets", "the mesh has no blend shapes; give one that has with --mesh")
        )
    return left_out


TRANSLUCENT_NOTE: Final = (
    "light through the body by KHR_materials_diffuse_transmission; the base color is divided by "
    "the part that is not transmitted, so that programs without this extension show it too bright: "
    "select another variant in them"
)


def find_transmission(material: Material) -> DiffuseTransmission:
    """Return the transmission of the median medium of a material's valid texels."""
    on = material.valid if material.valid.any() else np.ones_like(material.valid)
    brightest = float(np.quantile(material.base_color[on].max(axis=-1), BRIGHT_QUANTILE))
    return DiffuseTransmission.of(
        np.median(material.translucency_mm[on], axis=0),
        np.median(material.deficit[on], axis=0),
        eta=material.eta,
        max_factor=float(np.clip(1.0 - brightest, 0.0, 1.0)),
        thickness_m=float(np.ptp(material.mesh.vertices_mm[:, 2])) * M_PER_MM,
    )


def describe_transmission(material: Material) -> dict[str, Any]:
    """Return the transmission as JSON values, with the part of the light that it keeps."""
    made = find_transmission(material)
    on = material.valid if material.valid.any() else np.ones_like(material.valid)
    whole = amplitude(np.median(material.deficit[on], axis=0), material.eta)
    return {
        "extensions": made.extensions(),
        "kept_fraction": (made.factor * made.color / whole).tolist(),
        "translucency_mm": made.translucency_mm.tolist(),
        "channels": "red, green, blue; medium of the median over the valid texels",
    }


def encode_glb(
    material: Material,
    provenance: Mapping[str, Any],
    variants: Mapping[str, Float32Array] = MappingProxyType({}),
) -> bytes:
    """Encode a material with its mesh as the bytes of a .glb file.

    Parameters
    ----------
    material
        Material with lengths in mm.
    provenance
        Source, inputs, versions, assumptions and consent, for the file's ``asset.extras``.
    variants
        Tangent-space normals by expression, as variants of the material; one more is translucent.
    """
    mesh = material.mesh
    skeleton = resources.files("skinrig.exporting").joinpath("templates/skin.gltf")
    file = pygltflib.GLTF2.from_json(skeleton.read_text(encoding="utf-8"))
    file.asset = pygltflib.Asset(
        generator=f"skinrig {version('skinrig')}", extras={"provenance": dict(provenance)}
    )
    (surface_material,) = file.materials
    extensions = surface_material.extensions
    surface_material.extensions = {"KHR_materials_ior": {"ior": float(material.eta)}, **extensions}
    surface_material.extras = {"subsurface": material.sigma_tr()}
    binary = _Binary(file)
    attributes = pygltflib.Attributes(
        POSITION=binary.accessor(mesh.vertices_mm * M_PER_MM, bounds=True),
        NORMAL=binary.accessor(mesh.normals),
        # v increases downwards in glTF; the bitangent remains along decreasing v, as required
        TANGENT=binary.accessor(mesh.tangents),
        TEXCOORD_0=binary.accessor(np.column_stack([mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]])),
    )
    targets = [
        pygltflib.Attributes(POSITION=binary.accessor(moved * M_PER_MM, bounds=True))
        for moved in material.shapes.values()
    ]
    indices = binary.accessor(mesh.faces.reshape(-1))
    surface = pygltflib.Primitive(
        attributes=attributes, indices=indices, material=0, targets=targets
    )
    transmission = find_transmission(material)
    _add_variants(file, surface, list(variants), transmission)
    extras = {"targetNames": list(material.shapes)} if targets else {}
    named: dict[str, Any] = {"name": "skin", "extras": extras}
    file.meshes = [pygltflib.Mesh(primitives=[surface], weights=[0.0] * len(targets), **named)]
    for source, (name, data) in enumerate(_pictures(material, variants, transmission)):
        file.images.append(
            pygltflib.Image(mimeType="image/png", bufferView=binary.view(data), name=name)
        )
        file.textures.append(pygltflib.Texture(sampler=0, source=source))
    binary.data += b"\0" * (-len(binary.data) % 4)
    file.buffers = [pygltflib.Buffer(byteLength=len(binary.data))]
    file.set_binary_blob(bytes(binary.data))
    return b"".join(file.save_to_bytes())


def _add_variants(
    file: pygltflib.GLTF2,
    surface: pygltflib.Primitive,
    expressions: list[str],
    transmission: DiffuseTransmission,
) -> None:
    """Add the translucent material, and one per expression with its own normal texture."""
    neutral = file.materials[0]
    clear = copy.deepcopy(neutral)
    clear.name = f"{neutral.name}, {TRANSLUCENT_VARIANT}"
    clear.pbrMetallicRoughness.baseColorTexture.index = N_NEUTRAL_TEXTURES
    clear.extensions |= transmission.extensions()
    file.materials.append(clear)
    for number, name in enumerate(expressions, N_NEUTRAL_TEXTURES + 1):
        own = copy.deepcopy(neutral)
        own.name = f"{neutral.name}, {name}"
        own.normalTexture.index = number
        file.materials.append(own)
    every = [NEUTRAL_VARIANT, TRANSLUCENT_VARIANT, *expressions]
    mappings = [{"material": k, "variants": [k]} for k in range(len(every))]
    surface.extensions = {VARIANTS_EXTENSION: {"mappings": mappings}}
    file.extensions = {VARIANTS_EXTENSION: {"variants": [{"name": name} for name in every]}}
    file.extensionsUsed = [*file.extensionsUsed, VARIANTS_EXTENSION, *TRANSMISSION_EXTENSIONS]


def _pictures(
    material: Material, variants: Mapping[str, Float32Array], transmission: DiffuseTransmission
) -> list[tuple[str, bytes]]:
    """Return names and 8-bit PNG files of the textures, in the order of their indices."""

    def codes(name: str) -> NDArray[Any]:
        return encode_png_codes(material.image(name, ExportSettings()), depth=8)[0]

    rough, weight = codes("specular_roughness"), codes("specular_weight")
    zero, white = np.zeros_like(rough), np.full_like(weight, 255)
    pictures = {
        "base_color": codes("base_color"),
        "roughness in G, metallic 0 in B": np.stack([zero, rough, zero], axis=-1),
        "normal": codes("normal"),
        "specular in A": np.stack([white, white, white, weight], axis=-1),
    }
    brighter = material.base_color / np.float32(1.0 - transmission.factor)
    image = dataclasses.replace(material.image("base_color", ExportSettings()), values=brighter)
    pictures[f"base_color, {TRANSLUCENT_VARIANT}"] = encode_png_codes(image, depth=8)[0]
    for name, normals in variants.items():
        one = material.normal_image("normal", normals, ExportSettings())
        pictures[f"normal, {name}"] = encode_png_codes(one, depth=8)[0]
    return [(name, png.encode(image, quick=True)) for name, image in pictures.items()]
