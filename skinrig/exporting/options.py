"""Define the settings of an export: scene unit, green of normals, tiles, position on the skin."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skinrig.errors import UsageError, require_choice

METERS_PER_UNIT: Final[Mapping[str, float]] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Length of a scene unit, m."""
M_PER_MM: Final = METERS_PER_UNIT["mm"]
GREEN_SIGN_BY_NORMAL_Y: Final[Mapping[str, float]] = {"gl": 1.0, "dx": -1.0}
"""Sign of a normal map's green: +Y up (OpenGL, glTF, Blender, Maya) or down (DirectX, Unreal)."""
FIRST_TILE: Final = 1001
"""UDIM tile of texture coordinates 0 to 1, covered by the maps."""
TILE_SEPARATORS: Final[Mapping[str, str]] = {"none": "", "dot": ".", "underscore": "_"}
"""Separator between a texture's name and its tile number."""

_NAME_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,63}")


class ExportError(ValueError):
    """Invalid settings or source of an export."""


@dataclass(frozen=True, slots=True)
class SkinPosition:
    """Position on the texture whose BRDF is exported.

    Attributes
    ----------
    u, v
        Texture coordinates, 0 to 1; v = 1 at the top.
    radius_mm
        Radius of the averaged valid texels; 0: the nearest texel only.
    diffuse
        Whether subsurface scattering is included.
    """

    u: float
    v: float
    radius_mm: float = 0.0
    diffuse: bool = True

    def __post_init__(self) -> None:
        """Raise for a position off the texture."""
        if not (0.0 <= self.u <= 1.0 and 0.0 <= self.v <= 1.0 and 0.0 <= self.radius_mm < math.inf):
            raise ExportError(
                f"--at: got u {self.u}, v {self.v}, radius {self.radius_mm} mm, expected u and v "
                "in 0 to 1 and a radius of at least 0; correct them"
            )

    @staticmethod
    def parse(text: str, *, radius_mm: float, diffuse: bool) -> SkinPosition:
        """Parse a position from U,V.

        Raises
        ------
        skinrig.errors.UsageError
            If the text is not two numbers.
        """
        try:
            u, v = (float(part) for part in text.split(","))
        except ValueError as error:
            raise UsageError(f"--at: got {text!r}, expected U,V such as 0.5,0.4") from error
        return SkinPosition(u, v, radius_mm, diffuse)


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportSettings:
    """Settings of an export.

    Attributes
    ----------
    unit
        Scene unit, of `METERS_PER_UNIT`; None: the format's own.
    normal_y
        Direction of a normal map's green, a key of `GREEN_SIGN_BY_NORMAL_Y`.
    udim
        Naming of tiles, a key of `TILE_SEPARATORS`. Maps cover tile 1001; a mesh may have more.
    with_errors
        Whether standard uncertainties and masks are written, too.
    only
        Names of the maps or expressions to write; empty: all.
    mesh
        Mesh with the maps' texture coordinates, optionally with blend shapes; None: the
        appearance's own.
    target_face
        APPEARANCE/ of a dome to whose texture facial color is mapped.
    landmarks
        Tables ``name,x,y`` of the flash image and of that texture, px.
    place
        Position whose BRDF is exported; None: only basis BRDFs.
    camera
        View whose images are exported; None: the one whose axis is nearest to -z.
    calibration
        CALIBRATION/ of a session's lights, cameras and sensor; None: the nominal
        rig, with the noise recorded by the frames.
    progress
        Called with a line per step, and per frame of a session; None: nothing is called.
    """

    unit: str | None = None
    normal_y: str = "gl"
    udim: str = "none"
    with_errors: bool = False
    only: tuple[str, ...] = ()
    mesh: Path | None = None
    target_face: Path | None = None
    landmarks: tuple[Path, ...] = ()
    place: SkinPosition | None = None
    camera: str | None = None
    calibration: Path | None = None
    progress: Callable[[str], None] | None = None

    def __post_init__(self) -> None:
        """Raise for unknown values and malformed names."""
        for option, value, known in (
            ("--unit", self.unit, METERS_PER_UNIT),
            ("--normal-y", self.normal_y, GREEN_SIGN_BY_NORMAL_Y),
            ("--udim", self.udim, TILE_SEPARATORS),
        ):
            if value is not None:
                require_choice(option, value, known)
        for name in self.only:
            if not _NAME_PATTERN.fullmatch(name):
                raise UsageError(f"--only: got {name!r}, expected names separated by commas")

    def report(self, text: str) -> None:
        """Report a step that begins, or one part of it as number/count."""
        if self.progress is not None:
            self.progress(text)

    @property
    def y(self) -> float:
        """Sign of the green of normal maps: 1 for +Y up."""
        return GREEN_SIGN_BY_NORMAL_Y[self.normal_y]

    @property
    def green_direction(self) -> str:
        """Direction of increasing green of a normal map, in words."""
        return "+Y (OpenGL)" if self.y > 0 else "-Y (DirectX)"

    @property
    def scene_unit(self) -> str:
        """Scene unit; meters by default."""
        return self.unit or "m"

    @property
    def units_per_mm(self) -> float:
        """Scene units in a millimeter."""
        return M_PER_MM / METERS_PER_UNIT[self.scene_unit]

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
        """Return a texture's name with the token of all its tiles, for material files."""
        return self.format_tile_name(name, suffix, "<UDIM>")
