"""The folder that a rendering is written to: whole or not at all."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from model import store
from skinrig.arrays import Float32Array
from skinrig.console import plain
from skinrig.rendering.camera import RenderingError
from skinrig.workspace import whole_folder

DOCUMENT_FILE: Final = "render.json"
SCHEMA: Final = "skinrig.render/1"


def check(out: Path) -> None:
    """Refuse a folder that holds something else, before anything is rendered.

    Raises
    ------
    RenderingError
        ``out`` exists and is neither empty nor an older rendering.
    """
    if out.is_file() or (
        out.is_dir() and not (out / DOCUMENT_FILE).is_file() and any(out.iterdir())
    ):
        raise RenderingError(
            f"{out}: exists and is no rendering; nothing was written: name another folder"
        )


def write(
    out: Path,
    *,
    images: Mapping[str, Float32Array],
    pictures: Mapping[str, bytes],
    document: Mapping[str, Any],
) -> dict[str, Any]:
    """Write images as OpenEXR, pictures as PNG and the record; an older rendering is replaced.

    Parameters
    ----------
    out
        The folder.
    images
        By name without extension, (H, W) or (H, W, 3).
    pictures
        PNG files by name without extension.
    document
        What the record says.

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
    with whole_folder(out) as fresh:
        for name, image in images.items():
            store.write_exr(fresh / f"{name}.exr", np.asarray(image, np.float32))
        for name, data in pictures.items():
            (fresh / f"{name}.png").write_bytes(data)
        files = sorted(path.name for path in fresh.iterdir())
        record = plain({"schema": SCHEMA, **document, "out": out, "files": files})
        text = json.dumps(record, indent=1, sort_keys=True, allow_nan=False)
        (fresh / DOCUMENT_FILE).write_text(text + "\n", encoding="utf-8")
    return dict(record)
