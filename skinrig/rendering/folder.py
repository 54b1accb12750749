"""Write the folder of a rendering atomically: images, sheets and record."""

import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from model import store
from skinrig.arrays import Float32Array, UInt8Array
from skinrig.atomic_file import replace_folder_atomically
from skinrig.console import to_json_value
from skinrig.drawing import png
from skinrig.rendering.camera import RenderingError

BRIGHT_SKIN_LEVEL: Final = 0.75
"""Linear display value of the brightest skin."""
BRIGHT_SKIN_PERCENTILE: Final = 99.0
"""Percentile of skin radiance that defines the brightest skin, without highlights."""
TONE_KNEE: Final = 0.8
"""Linear value up to which the tone curve is the identity; higher values are compressed below 1."""
MARGIN_PX: Final = 8
LABEL_PX: Final = 26


def choose_exposure(radiance: ArrayLike, coverage: ArrayLike) -> float:
    """Return the factor that maps the brightest skin to `BRIGHT_SKIN_LEVEL`; 1 for black images.

    Parameters
    ----------
    radiance
        Shape (H, W, 3).
    coverage
        Fraction of skin in each pixel, shape (H, W).

    Examples
    --------
    >>> choose_exposure(np.full((4, 4, 3), 0.25), np.ones((4, 4)))
    3.0
    """
    light = np.asarray(radiance, np.float64).max(axis=-1)[np.asarray(coverage) > 0.5]
    top = float(np.percentile(light, BRIGHT_SKIN_PERCENTILE)) if light.size else 0.0
    return BRIGHT_SKIN_LEVEL / top if top > 0.0 else 1.0


def apply_tone_curve(radiance: ArrayLike, exposure: float) -> UInt8Array:
    """Convert radiance to a display image: linear up to `TONE_KNEE`, compressed above.

    Parameters
    ----------
    radiance
        Linear values of any shape.
    exposure
        Factor of the values.

    Returns
    -------
    ndarray of uint8
        sRGB-encoded image; camera channels are taken as linear sRGB.
    """
    value = np.asarray(radiance, np.float64) * exposure
    room = 1.0 - TONE_KNEE
    above = TONE_KNEE + room * -np.expm1(-np.maximum(value - TONE_KNEE, 0.0) / room)
    return png.encode_srgb8(np.where(value > TONE_KNEE, above, value))


@dataclass(frozen=True, slots=True)
class Panel:
    """One labeled image of a sheet."""

    label: str
    """Text below the image, one line."""
    image: UInt8Array
    """(H, W, 3)."""


def encode_sheet(rows: Sequence[Sequence[Panel]], *, title: str = "") -> bytes:
    """Encode labeled images side by side as PNG, without resampling.

    Parameters
    ----------
    rows
        Panels of equal size.
    title
        Title above the panels.

    Raises
    ------
    ValueError
        If panels are missing, or sizes differ.
    """
    sizes = {panel.image.shape for row in rows for panel in row}
    if len(sizes) != 1:
        raise ValueError(f"panels: got sizes {sorted(sizes)}, expected one")
    height, width, _ = next(iter(sizes))
    top = LABEL_PX + MARGIN_PX if title else MARGIN_PX
    columns = max(len(row) for row in rows)
    total_width = MARGIN_PX + columns * (width + MARGIN_PX)
    total_height = top + len(rows) * (height + LABEL_PX + MARGIN_PX)
    dpi = 100
    figure = _figure(total_width / dpi, total_height / dpi, dpi)
    canvas = np.full((total_height, total_width, 3), 255, np.uint8)
    small: dict[str, Any] = {"fontsize": 9, "color": "black", "family": "DejaVu Sans"}
    small |= {"ha": "center", "va": "center"}
    for i, row in enumerate(rows):
        for k, panel in enumerate(row):
            y, x = top + i * (height + LABEL_PX + MARGIN_PX), MARGIN_PX + k * (width + MARGIN_PX)
            canvas[y : y + height, x : x + width] = panel.image
            middle = (x + 0.5 * width) / total_width
            below = 1.0 - (y + height + 0.5 * LABEL_PX) / total_height
            figure.text(middle, below, panel.label, **small)
    if title:
        figure.text(0.5, 1.0 - 0.5 * top / total_height, title, **small)
    figure.figimage(canvas, zorder=-1)
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi, metadata={"Software": None})
    return stream.getvalue()


def _figure(width_in: float, height_in: float, dpi: int) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_in, height_in), dpi=dpi)
    FigureCanvasAgg(figure)
    return figure


DOCUMENT_FILE: Final = "render.json"
SCHEMA: Final = "skinrig.render/1"


def check(out: Path) -> None:
    """Raise if a folder has other files, before anything is rendered.

    Raises
    ------
    RenderingError
        If ``out`` exists and is neither empty nor an older rendering.
    """
    if out.is_file() or (
        out.is_dir() and not (out / DOCUMENT_FILE).is_file() and any(out.iterdir())
    ):
        raise RenderingError(
            f"{out}: got other files, expected a new folder or a rendering; name another"
        )


def write(
    out: Path,
    *,
    images: Mapping[str, Float32Array],
    pictures: Mapping[str, bytes],
    document: Mapping[str, Any],
) -> dict[str, Any]:
    """Write OpenEXR and PNG images and the record; an older rendering is replaced.

    Parameters
    ----------
    out
        The folder.
    images
        Images by name without suffix, (H, W) or (H, W, 3).
    pictures
        PNG files by name without suffix.
    document
        Content of the record.

    Returns
    -------
    dict
        The record, with the names of the files.

    Raises
    ------
    RenderingError
        See `check`.
    """
    check(out)
    with replace_folder_atomically(out) as fresh:
        for name, image in images.items():
            store.write_exr(fresh / f"{name}.exr", np.asarray(image, np.float32))
        for name, data in pictures.items():
            (fresh / f"{name}.png").write_bytes(data)
        files = sorted(path.name for path in fresh.iterdir())
        record = to_json_value({"schema": SCHEMA, **document, "out": out, "files": files})
        text = json.dumps(record, indent=1, sort_keys=True, allow_nan=False)
        (fresh / DOCUMENT_FILE).write_text(text + "\n", encoding="utf-8")
    return dict(record)
