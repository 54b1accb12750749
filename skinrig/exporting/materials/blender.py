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
from importlib import resources
from typing import Final

from skinrig.exporting.options import M_PER_MM

SCRIPT_FILE: Final = "skin_in_blender.py"
RADIUS_FACTOR: Final = 4.0 * math.pi
"""Blender's radius over the mean free path, for the method Random Walk."""


@dataclass(frozen=True, slots=True)
class Import:
    """How a file comes into Blender.

    Attributes
    ----------
    file
        File next to the script, .glb or .usdc.
    radius_mm
        Mean free path at a texture of 1, or the longest of `channels`, mm.
    channels
        Fraction of it in red, green and blue; None: a texture has it.
    textures
        Input of the Principled BSDF to the texture's name below the folder, and the factor of its
        values.
    """

    file: str
    radius_mm: float
    channels: tuple[float, float, float] | None
    textures: tuple[tuple[str, str, float], ...] = ()

    @staticmethod
    def from_channels(file: str, radius_mm: Sequence[float]) -> Import:
        """Return an import whose radius is the same all over, (3,), mm.

        Examples
        --------
        >>> Import.from_channels("skin.glb", [0.5, 0.25, 0.125]).channels
        (1.0, 0.5, 0.25)
        """
        longest = max(radius_mm)
        red, green, blue = (float(one) / longest for one in radius_mm)
        return Import(file, float(longest), (red, green, blue))

    def script(self) -> str:
        """Return the script that Blender runs."""
        operator = "import_scene.gltf" if self.file.endswith(".glb") else "wm.usd_import"
        channels = None if self.channels is None else tuple(round(c, 9) for c in self.channels)
        script = resources.files("skinrig.exporting").joinpath("templates/skin_in_blender.py.txt")
        return script.read_text(encoding="utf-8").format(
            file=self.file,
            script=SCRIPT_FILE,
            operator=operator,
            channels=channels,
            radius=f"{RADIUS_FACTOR * self.radius_mm * M_PER_MM:.9g}",
            textures={socket: (name, factor) for socket, name, factor in self.textures},
        )
