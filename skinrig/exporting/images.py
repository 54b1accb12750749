"""Write images as float EXR and 16-bit PNG, each with a record of its encoding.

The header of an EXR has its unit and color space. A PNG cannot store numbers below 0 or above 1:
its record has the decoding of codes to values, and the fraction of clipped pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from model.skin import SkinAppearance
from skinrig.appearances.contents import hash_file
from skinrig.arrays import BoolArray, FloatArray
from skinrig.drawing import png
from skinrig.exporting.options import FIRST_TILE, ExportSettings
from skinrig.exporting.sealing import (
    PROVENANCE_KEY,
    describe_provenance,
    format_provenance,
    write_json,
)

SRGB_SPACE: Final = "linear sRGB"
CAMERA_SPACE: Final = "camera RGB, linear, white balanced"
DATA_SPACE: Final = "data"
REC709_CHROMATICITIES: Final = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities of sRGB's primaries and D65, for headers."""
EMPTY_TILE_PX: Final = 8
"""Width and height of a tile without measurements, texels."""
PNG_RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "melanin": (0.0, 0.5),
    "hemoglobin": (0.0, 0.25),
    "normals": (-1.0, 1.0),
    "translucency": (0.0, 16.0),
    "basis_weight": (0.0, 2.0),
}
"""Ranges of PNG codes by prefix of the map's name, equal for all subjects."""


@dataclass(frozen=True, slots=True)
class ExportImage:
    """One image to write.

    Attributes
    ----------
    name
        Name of the files, without suffix.
    values
        (H, W) or (H, W, 3), row 0 at the top (v = 1).
    unit
        Unit; "1": dimensionless.
    space
        `SRGB_SPACE`, `CAMERA_SPACE` or `DATA_SPACE`.
    what
        Description, one line.
    low, high
        Values of PNG codes 0 and 65535; None: minimum and maximum valid value.
    valid
        (H, W) valid pixels; None: all.
    filler
        Value on tiles without measurements; None: median of the valid pixels.
    """

    name: str
    values: FloatArray
    unit: str = "1"
    space: str = DATA_SPACE
    what: str = ""
    low: float | None = None
    high: float | None = None
    valid: BoolArray | None = None
    filler: tuple[float, ...] | None = None

    @staticmethod
    def from_normals(
        name: str, normals: FloatArray, delivery: ExportSettings, description: str, **more: Any
    ) -> ExportImage:
        """Create an image of normals, given +Y up, with the requested green."""
        turned = normals * np.array([1.0, delivery.y, 1.0], np.float32)
        return ExportImage(name, turned, "1", DATA_SPACE, description, -1.0, 1.0, **more)

    def fill_empty_tile(self) -> ExportImage:
        """Return a constant image for tiles without measurements."""
        layers = self.values if self.values.ndim == 3 else self.values[..., None]
        rows = layers[self.valid] if self.valid is not None else layers.reshape(-1, layers.shape[2])
        known = rows[np.isfinite(rows).all(axis=-1)]
        usual = np.median(known, axis=0) if len(known) else np.zeros(layers.shape[2])
        value = usual if self.filler is None else np.array(self.filler)
        values = np.empty((EMPTY_TILE_PX, EMPTY_TILE_PX, *self.values.shape[2:]), np.float32)
        values[...] = value if self.values.ndim == 3 else value[0]
        what = f"tile without measurements, constant; {self.what}"
        return replace(self, values=values, valid=np.zeros(values.shape[:2], np.bool_), what=what)


@dataclass(slots=True)
class ImageFolder:
    """Writes images below a folder and keeps a record of each.

    Attributes
    ----------
    root
        Existing folder.
    delivery
        Names of tiles.
    appearance
        Source of the images; its provenance is in each file.
    records
        Record of each file by name, JSON values.
    tiles
        UDIM tiles of the mesh; images cover the first.
    left_out
        Omissions with reasons.
    """

    root: Path
    delivery: ExportSettings
    appearance: SkinAppearance
    records: dict[str, dict[str, Any]] = field(default_factory=dict)
    tiles: tuple[int, ...] = (FIRST_TILE,)
    left_out: list[tuple[str, str]] = field(default_factory=list)

    def record_omission(self, item: str, why: str) -> None:
        """Record an omission with its reason."""
        self.left_out.append((item, why))

    def write_exr(self, image: ExportImage, folder: str = "exr") -> str:
        """Write a float32 EXR per tile; return the first one's name below the root."""

        def put(path: Path, one: ExportImage) -> dict[str, Any]:
            channels = {"Y" if one.values.ndim == 2 else "RGB": one.values}
            header = {"unit": one.unit, "colorSpace": one.space, "comments": one.what}
            header[PROVENANCE_KEY] = format_provenance(self.appearance)
            write_channels(path, channels, header, rec709=one.space == SRGB_SPACE)
            return {"encoding": "32-bit float, the value itself"}

        return self._tiled(image, folder, "exr", put)

    def write_png(self, image: ExportImage, folder: str = "png") -> str:
        """Write a 16-bit PNG per tile; return the first one's name below the root.

        Colors in `SRGB_SPACE` are encoded by the sRGB curve, others linearly.
        """

        def put(path: Path, one: ExportImage) -> dict[str, Any]:
            codes, record = encode_png_codes(one)
            text = format_provenance(self.appearance)
            path.write_bytes(png.insert_text(png.encode(codes, quick=True), PROVENANCE_KEY, text))
            return record

        low, high = png_code_range(image)
        return self._tiled(replace(image, low=low, high=high), folder, "png", put)

    def write_exr_and_png(self, image: ExportImage) -> str:
        """Write a float EXR and a 16-bit PNG per tile; return the first PNG's name."""
        self.write_exr(image)
        return self.write_png(image)

    def errors(self, images: Iterable[ExportImage], folder: str = "exr") -> None:
        """Write images of uncertainties if they were requested."""
        if self.delivery.with_errors:
            for image in images:
                self.write_exr(image, folder)

    def document(self, file: str, content: Mapping[str, Any]) -> None:
        """Write the document of an export: provenance and the record of each file."""
        files = dict(sorted(self.records.items()))
        provenance = describe_provenance(self.appearance)
        write_json(self.root / file, {**provenance, **content, "files": files})

    def _tiled(
        self,
        image: ExportImage,
        folder: str,
        suffix: str,
        put: Callable[[Path, ExportImage], dict[str, Any]],
    ) -> str:
        """Write one image per tile with its record; return the first one's name."""
        (self.root / folder).mkdir(exist_ok=True)
        names = []
        for tile in self.tiles:
            one = image if tile == self.tiles[0] else image.fill_empty_tile()
            names.append(f"{folder}/{self.delivery.format_tile_name(image.name, suffix, tile)}")
            self.records[names[-1]] = {
                "what": one.what,
                "unit": one.unit,
                "color_space": one.space,
                "shape": list(one.values.shape),
                "valid_share": 1.0 if one.valid is None else float(one.valid.mean()),
                **put(self.root / names[-1], one),
                "sha256": hash_file(self.root / names[-1]),
            }
        return names[0]


def encode_png_codes(image: ExportImage, *, depth: int = 16) -> tuple[NDArray[Any], dict[str, Any]]:
    """Encode an image as PNG codes; also return the record that decodes them.

    Parameters
    ----------
    image
        The image.
    depth
        8 or 16 bits.

    Returns
    -------
    codes : ndarray of uint8 or uint16, shape of the values
    record : dict
        JSON values: encoding, range, fraction of valid values that were clipped.

    Examples
    --------
    >>> ramp = ExportImage(name="a", values=np.array([[0.0, 1.0, 3.0]]), unit="mm", low=0.0,
    ...     high=2.0)
    >>> codes, record = encode_png_codes(ramp)
    >>> codes.tolist(), record["clipped_share"] > 0.3
    ([[0, 32768, 65535]], True)
    """
    dtype: Any = {8: np.uint8, 16: np.uint16}[depth]
    top = 2**depth - 1
    values = np.nan_to_num(np.asarray(image.values, np.float64))
    shown = values if image.valid is None else values[image.valid]
    low, high = png_code_range(image)
    if image.space == SRGB_SPACE:
        position = png.srgb_curve(np.clip(values, 0.0, 1.0))
        encoding = f"sRGB curve (IEC 61966-2-1): value = inverse curve of code / {top}"
    else:
        position = np.clip((values - low) / (high - low), 0.0, 1.0)
        encoding = f"value = low + (high - low) * code / {top}; import as raw, Non-Color"
    slack = 0.5 / top * (high - low)
    clipped = (shown < low - slack) | (shown > high + slack)
    record = {
        "encoding": encoding,
        "low": low,
        "high": high,
        "step": (high - low) / top,
        "clipped_share": float(clipped.mean()) if clipped.size else 0.0,
    }
    return np.round(position * top).astype(dtype), record


def png_code_range(image: ExportImage) -> tuple[float, float]:
    """Return the values of the minimum and maximum PNG code, see `encode_png_codes`.

    Examples
    --------
    >>> png_code_range(ExportImage(name="a", values=np.array([[1.0, 3.0]]), unit="mm", low=0.0))
    (0.0, 3.0)
    """
    if image.space == SRGB_SPACE:
        return 0.0, 1.0
    values = np.nan_to_num(np.asarray(image.values, np.float64))
    shown = values if image.valid is None else values[image.valid]
    low = float(shown.min(initial=np.inf)) if image.low is None else image.low
    high = float(shown.max(initial=-np.inf)) if image.high is None else image.high
    if not np.isfinite(low) or not np.isfinite(high):
        low, high = 0.0, 1.0  # without valid pixels
    return low, high if high > low else low + 1.0


def png_range(name: str) -> tuple[float | None, float | None]:
    """Return the fixed range of a map's PNG; None and None: that of the values."""
    for start, (low, high) in PNG_RANGES.items():
        if name.startswith(start):
            return low, high
    return None, None


def write_channels(
    path: Path,
    channels: Mapping[str, FloatArray],
    attributes: Mapping[str, str],
    *,
    rec709: bool = False,
) -> None:
    """Write named channels of one size as losslessly compressed float32 EXR.

    Parameters
    ----------
    path
        File.
    channels
        (H, W) by name; or (H, W, 3) as ``"RGB"``.
    attributes
        Texts of the header; empty ones are omitted.
    rec709
        Whether R, G, B are linear sRGB.
    """
    import OpenEXR

    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **{name: text for name, text in attributes.items() if text},
    }
    if rec709:
        header["chromaticities"] = REC709_CHROMATICITIES
    pixels = {name: np.ascontiguousarray(v, np.float32) for name, v in channels.items()}
    with OpenEXR.File(header, pixels) as file:
        file.write(str(path))
