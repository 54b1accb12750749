"""Write a script that imports an export into Blender with subsurface scattering.

Blender's importers of glTF and USD ignore subsurface scattering, and USD's preview surface has no
specular weight. Blender's Principled BSDF has both. Its "Random Walk" divides radii by 4 pi to get
mean free paths, and derives the single-scattering albedo from the color much as OpenPBR does. Thus
Blender's radius is that of OpenPBR times 4 pi.

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
"""Ratio of Blender's radius to the mean free path, for the method Random Walk."""


@dataclass(frozen=True, slots=True)
class Import:
    """Settings of the import of a file into Blender.

    Attributes
    ----------
    file
        File next to the script, .glb or .usdc.
    radius_mm
        Mean free path at a texture of 1, or the longest of `channels`, mm.
    channels
        Fraction of it in red, green and blue; None: given by a texture.
    textures
        Input of the Principled BSDF, name of the texture below the folder, and factor of its
        values.
    """

    file: str
    radius_mm: float
    channels: tuple[float, float, float] | None
    textures: tuple[tuple[str, str, float], ...] = ()

    @staticmethod
    def from_channels(file: str, radius_mm: Sequence[float]) -> Import:
        """Create an import with a spatially constant radius, (3,), mm.

        Examples
        --------
        >>> Import.from_channels("skin.glb", [0.5, 0.25, 0.125]).channels
        (1.0, 0.5, 0.25)
        """
        longest = max(radius_mm)
        red, green, blue = (float(one) / longest for one in radius_mm)
        return Import(file, float(longest), (red, green, blue))

    def script(self) -> str:
        """Return the text of the script."""
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
