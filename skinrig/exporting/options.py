"""Settings of an export: scene unit, green of normal maps, tiles, position on the skin."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skinrig.errors import UsageError, one_of

UNITS_M: Final[Mapping[str, float]] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Length of a scene unit, m."""
M_PER_MM: Final = UNITS_M["mm"]
NORMAL_Y: Final[Mapping[str, float]] = {"gl": 1.0, "dx": -1.0}
"""Sign of a normal map's green: +Y up (OpenGL, glTF, Blender, Maya) or down (DirectX, Unreal)."""
FIRST_TILE: Final = 1001
"""UDIM tile of texture coordinates 0 to 1, which maps are of."""
TILE_SEPARATORS: Final[Mapping[str, str]] = {"none": "", "dot": ".", "underscore": "_"}
"""Separator of a texture's name and the number of its tile."""

_NAME_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,63}")


class ExportError(ValueError):
    """An export that cannot be made as asked."""


@dataclass(frozen=True, slots=True)
class SkinPosition:
    """Where on the texture the skin is looked at.

    Attributes
    ----------
    u, v
        Texture coordinates, 0 to 1; v = 1 at the top.
    radius_mm
        The BRDFs of all valid texels as near as this are averaged; 0: the nearest alone.
    diffuse
        Whether light from inside the skin is included.
    """

    u: float
    v: float
    radius_mm: float = 0.0
    diffuse: bool = True

    def __post_init__(self) -> None:
        """Refuse a place off the texture."""
        if not (0.0 <= self.u <= 1.0 and 0.0 <= self.v <= 1.0 and 0.0 <= self.radius_mm < math.inf):
            raise ExportError(
                f"place: got u {self.u}, v {self.v}, radius {self.radius_mm} mm, expected u and v "
                "in 0 to 1 and a radius of at least 0"
            )

    @staticmethod
    def parse(text: str, *, radius_mm: float, diffuse: bool) -> SkinPosition:
        """Return the place that a command line names as U,V.

        Raises
        ------
        skinrig.errors.UsageError
            When it is not two numbers.
        """
        try:
            u, v = (float(part) for part in text.split(","))
        except ValueError as error:
            raise UsageError(f"--at: got {text!r}, expected U,V such as 0.5,0.4") from error
        return SkinPosition(u, v, radius_mm, diffuse)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportSettings:
    """How an appearance or a session is to be delivered.

    Attributes
    ----------
    unit
        Scene unit, of `UNITS_M`; None: the format's own.
    normal_y
        Of `NORMAL_Y`.
    udim
        Of `TILE_SEPARATORS`. Maps are those of tile 1001; a mesh may reach over more.
    with_errors
        Whether standard uncertainties and masks are written, too.
    only
        Names of the maps, or of the states, to write; empty: all that there are.
    mesh
        A mesh with the maps' texture coordinates, perhaps with blend shapes, instead of the
        appearance's own.
    onto
        APPEARANCE/ of a dome whose texture facial color is put on.
    landmarks
        Tables ``name,x,y`` of the flash picture and of that texture, px.
    place
        Where on the skin its BRDF is exported, too; None: lobes alone.
    camera
        Name of the view whose images are exported; None: the one that looks most along -z.
    calibration
        CALIBRATION/ of a session's lights, cameras and sensor; None: the nominal
        rig, with the noise recorded by the frames.
    """

    unit: str | None = None
    normal_y: str = "gl"
    udim: str = "none"
    with_errors: bool = False
    only: tuple[str, ...] = ()
    mesh: Path | None = None
    onto: Path | None = None
    landmarks: tuple[Path, ...] = ()
    place: SkinPosition | None = None
    camera: str | None = None
    calibration: Path | None = None

    def __post_init__(self) -> None:
        """Refuse words that mean nothing."""
        for option, value, known in (
            ("--unit", self.unit, UNITS_M),
            ("--normal-y", self.normal_y, NORMAL_Y),
            ("--udim", self.udim, TILE_SEPARATORS),
        ):
            if value is not None:
                one_of(option, value, known)
        for name in self.only:
            if not _NAME_PATTERN.fullmatch(name):
                raise UsageError(f"--only: got {name!r}, expected names joined by commas")

    @property
    def y(self) -> float:
        """Sign of the green of normal maps: 1 for +Y up."""
        return NORMAL_Y[self.normal_y]

    @property
    def green_direction(self) -> str:
        """What growing green of a normal map means, for people."""
        return "+Y (OpenGL)" if self.y > 0 else "-Y (DirectX)"

    @property
    def scene_unit(self) -> str:
        """Scene unit; meters where none is asked for."""
        return self.unit or "m"

    @property
    def units_per_mm(self) -> float:
        """Scene units in a millimeter."""
        return M_PER_MM / UNITS_M[self.scene_unit]

    def format_tile_name(self, name: str, suffix: str, tile: int | str = FIRST_TILE) -> str:
        """Return the file name of a texture's tile.

        Examples
        --------
        >>> ExportSettings(udim="underscore").format_tile_name("normal", "png")
        'normal_1001.png'
        """
        number = "" if self.udim == "none" else tile
        return f"{name}{TILE_SEPARATORS[self.udim]}{number}.{suffix}"

    def format_reference(self, name: str, suffix: str) -> str:
        """Return a texture's name as a material file refers to all its tiles."""
        return self.format_tile_name(name, suffix, "<UDIM>")
