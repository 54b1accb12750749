"""Maps of a skin area, by name, each with unit, standard error and valid mask."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from model.arrays import BoolArray, Float32Array
from model.checks import Checks

_FILE_PATTERN = re.compile(r"[a-z][a-z0-9_]{0,63}\.[a-z0-9]{1,8}")

MAP_UNITS: Mapping[str, str] = MappingProxyType(
    {
        "melanin": "volume fraction of the epidermis",
        "melanin_optical_depth": "1",
        "hemoglobin": "volume fraction of blood in the dermis",
        "oxygenation": "fraction of oxygenated hemoglobin",
        "shading": "1",
        "diffuse": "1",
        "specular": "1",
        "normals": "1",
        "normals_refined": "1",
        "r_d": "1",
        "position": "mm",
        "roughness": "1",
        "residual": "1",
        "lab": "1",
        "ita": "degree",
        "monk": "1",
        "monk_low": "1",
        "monk_high": "1",
        "erythema_index": "1",
        "melanin_index": "1",
    }
)
"""Units of the maps with a fixed meaning; maps of other names have their own."""


@dataclass(frozen=True, slots=True)
class SkinMap:
    """One map of an appearance.

    Attributes
    ----------
    values
        (H, W) or (H, W, 3), float32. Row 0 is the top.
    unit
        "1" for numbers without dimension.
    stderr
        Standard error, same shape as ``values``; None only for ground truth or an image.
    valid
        (H, W) bool; None: every pixel is valid. Values outside it are undefined.
    description
        One line of text: frame, color space, assumptions.
    """

    values: Float32Array
    unit: str
    stderr: Float32Array | None = None
    valid: BoolArray | None = None
    description: str = ""

    def __post_init__(self) -> None:
        """Raise for shapes that do not fit and valid pixels that are not finite."""
        values = np.asarray(self.values, np.float32)
        Checks().shape("values", values, (None, None), (None, None, 3))
        object.__setattr__(self, "values", values)
        if not self.unit:
            raise ValueError('unit: got an empty text, expected a unit or "1"')
        if self.stderr is not None:
            stderr = np.asarray(self.stderr, np.float32)
            Checks().shape("stderr", stderr, values.shape)
            object.__setattr__(self, "stderr", stderr)
        if self.valid is not None:
            valid = np.asarray(self.valid)
            Checks().mask("valid", valid, values.shape[:2])
            object.__setattr__(self, "valid", valid)
        shown = values if self.valid is None else values[self.valid]
        Checks().within("values at valid pixels", shown)

    @property
    def mask(self) -> BoolArray:
        """Return the valid pixels, (H, W) bool; all of them where ``valid`` is None."""
        return np.ones(self.values.shape[:2], np.bool_) if self.valid is None else self.valid


@dataclass(frozen=True, slots=True)
class SkinAppearance:
    """Maps of one size class with their provenance.

    Attributes
    ----------
    maps
        By name, see :data:`MAP_UNITS` for names with a fixed unit.
    source
        "measured" or "simulated".
    parameters, inputs, versions
        JSON values: settings, hashes of the input files, versions of the software.
    left_out
        Results that were not computed, and why.
    files
        Other files by name, e.g. the mesh of the maps as ``mesh.ply``.
    seed
        Seed of the simulation; None without random numbers.

    Examples
    --------
    >>> maps = {"melanin": SkinMap(np.full((2, 2), 0.05), MAP_UNITS["melanin"])}
    >>> SkinAppearance(maps, "simulated").maps["melanin"].values.dtype
    dtype('float32')
    """

    maps: Mapping[str, SkinMap]
    source: str
    parameters: Mapping[str, object] = field(default_factory=dict)
    inputs: Mapping[str, str] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)
    left_out: tuple[tuple[str, str], ...] = ()
    files: Mapping[str, bytes] = field(default_factory=dict)
    seed: int | None = None

    def __post_init__(self) -> None:
        """Raise for an unknown source and for a unit that contradicts the map's name."""
        Checks().choice("source", self.source, ("measured", "simulated"))
        for name in self.files:
            if _FILE_PATTERN.fullmatch(name) is None or name.endswith((".exr", "appearance.json")):
                raise ValueError(
                    f"files: got name {name!r}, expected a-z 0-9 _ and an extension, not .exr"
                )
        for name, skin_map in self.maps.items():
            expected = MAP_UNITS.get(name)
            if expected is not None and skin_map.unit != expected:
                raise ValueError(f"{name}: got unit {skin_map.unit!r}, expected {expected!r}")
