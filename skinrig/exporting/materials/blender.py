"""A script that brings an export into Blender together with what its importers leave out.

Blender's importers of glTF and USD read no subsurface light, and USD's preview has no weight of
reflection. Blender's Principled BSDF takes both. Its "Random Walk" divides radii by 4 pi before it
takes them for mean free paths, and finds the albedo of single scattering from the color much as
OpenPBR does: the radius that OpenPBR takes, times 4 pi, is the one for Blender.

References
----------
Blender 5.0, Cycles: bssrdf_setup_radius (the factor), Principled BSDF in the manual.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from skinrig.exporting.options import M_PER_MM

SCRIPT_FILE: Final = "skin_in_blender.py"
RADIUS_FACTOR: Final = 4.0 * math.pi
"""Blender's radius over the mean free path, for the method Random Walk."""

_SCRIPT: Final = '''"""Import {file} into Blender 4 or later, with what its importer leaves out.

Run `blender --python {script}`, or open this text in the Scripting workspace and press Run.
"""

from pathlib import Path

import bpy

RADIUS_M = {radius}
"""Subsurface radius at a texture of 1, metres: 4 pi times the mean free path, as Cycles takes it
for the method Random Walk."""
CHANNELS = {channels}
"""Of it, in red, green, blue; None: the texture says it."""
TEXTURES = {textures}
"""Input of the Principled BSDF to its texture, and the factor of its values."""

text = getattr(bpy.context.space_data, "text", None)
here = Path(bpy.path.abspath(text.filepath) if text else __file__).resolve().parent
before = set(bpy.data.materials)
bpy.ops.{operator}(filepath=str(here / "{file}"))


def texture(tree, name, factor):
    node = tree.nodes.new("ShaderNodeTexImage")
    first = here / name.replace("<UDIM>", "1001")
    node.image = bpy.data.images.load(str(first))
    if "<UDIM>" in name:
        node.image.source = "TILED"
        node.image.filepath = str(here / name)
        beside = first.parent.glob(Path(name).name.replace("<UDIM>", "[0-9][0-9][0-9][0-9]"))
        head = len(Path(name).name.split("<UDIM>")[0])
        for number in sorted(int(file.name[head : head + 4]) for file in beside):
            if number not in [tile.number for tile in node.image.tiles]:
                node.image.tiles.new(number)
    node.image.colorspace_settings.name = "Non-Color"
    node.extension = "EXTEND"
    if factor == 1.0:
        return node.outputs["Color"]
    scaled = tree.nodes.new("ShaderNodeMath")
    scaled.operation = "MULTIPLY"
    scaled.inputs[1].default_value = factor
    tree.links.new(node.outputs["Color"], scaled.inputs[0])
    return scaled.outputs["Value"]


for material in set(bpy.data.materials) - before:
    tree = material.node_tree
    for node in [one for one in tree.nodes if one.bl_idname == "ShaderNodeBsdfPrincipled"]:
        node.subsurface_method = "RANDOM_WALK"
        node.inputs["Subsurface Weight"].default_value = 1.0
        node.inputs["Subsurface Scale"].default_value = RADIUS_M
        node.inputs["Subsurface Anisotropy"].default_value = 0.0
        if CHANNELS is not None:
            node.inputs["Subsurface Radius"].default_value = CHANNELS
        for socket, (name, factor) in TEXTURES.items():
            tree.links.new(texture(tree, name, factor), node.inputs[socket])
'''


@dataclass(frozen=True, slots=True)
class Import:
    """How a file comes into Blender.

    Attributes
    ----------
    file
        Beside the script, .glb or .usdc.
    radius_mm
        Mean free path at a texture of 1, or the longest of `channels`, mm.
    channels
        Share of it in red, green and blue; None where a texture says it.
    textures
        Input of the Principled BSDF to the texture's name below the folder, and the factor of its
        values.
    """

    file: str
    radius_mm: float
    channels: tuple[float, float, float] | None
    textures: tuple[tuple[str, str, float], ...] = ()

    @staticmethod
    def of_channels(file: str, radius_mm: Sequence[float]) -> Import:
        """Return an import whose radius is the same all over, (3,), mm.

        Examples
        --------
        >>> Import.of_channels("skin.glb", [0.5, 0.25, 0.125]).channels
        (1.0, 0.5, 0.25)
        """
        longest = max(radius_mm)
        red, green, blue = (float(one) / longest for one in radius_mm)
        return Import(file, float(longest), (red, green, blue))

    def script(self) -> str:
        """Return the script that Blender runs."""
        operator = "import_scene.gltf" if self.file.endswith(".glb") else "wm.usd_import"
        channels = None if self.channels is None else tuple(round(c, 9) for c in self.channels)
        return _SCRIPT.format(
            file=self.file,
            script=SCRIPT_FILE,
            operator=operator,
            channels=channels,
            radius=f"{RADIUS_FACTOR * self.radius_mm * M_PER_MM:.9g}",
            textures={socket: (name, factor) for socket, name, factor in self.textures},
        )
