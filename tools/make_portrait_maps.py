"""Make ``docs/images/portrait-maps.png``: chromophores of a real photograph, uncalibrated.

    python tools/make_portrait_maps.py

The photograph is NASA's portrait of the astronaut Eileen Collins, in the public domain, as
scikit-image ships it. Camera and light are unknown; the assumptions are printed.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import skimage.data

from capture.importers import import_photos
from model import store
from reconstruction.pipeline import recipes as pipeline
from skinrig.drawing import png

TARGET = Path(__file__).resolve().parents[1] / "docs/images/portrait-maps.png"
FACE = (slice(60, 196), slice(160, 288))
SCALES = {"melanin": 0.06, "hemoglobin": 0.06}


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "portrait.png").write_bytes(png.encode(skimage.data.astronaut()))
        done = import_photos(folder / "portrait.png", out=folder / "session")
        outcome = pipeline.reconstruct(
            folder / "session", want=["melanin", "hemoglobin", "image"], out=folder / "maps"
        )
        maps = store.read(folder / "maps").maps
    for text in dict.fromkeys((*done.assumed, *outcome.assumed)):
        print(f"assumed: {text}", file=sys.stderr)
    picture = maps["image"].values[FACE]
    panels = [png.encode_srgb8(picture / np.percentile(picture, 99))]
    for name, high in SCALES.items():
        part = maps[name]
        mask = None if part.valid is None else part.valid[FACE]
        panels.append(png.Scale(0.0, high).colors(part.values[FACE], mask))
        inside = part.values[FACE][mask] if mask is not None else part.values[FACE]
        print(f"{name}: median {np.median(inside):.4f}", file=sys.stderr)
    joined = np.concatenate(panels, axis=1).repeat(3, axis=0).repeat(3, axis=1)
    TARGET.parent.mkdir(exist_ok=True)
    TARGET.write_bytes(png.encode(joined))


if __name__ == "__main__":
    main()
