"""Make ``docs/images/dome-maps.png``: maps of a simulated face and ground truth.

skinrig demo --rigs dome --out demo
python tools/make_dome_maps.py demo
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from model import store
from model.skin import SkinAppearance
from skinrig.appearances.front_view import FrontView
from skinrig.drawing import png

TARGET = Path(__file__).resolve().parents[1] / "docs/images/dome-maps.png"
GRAY = 0.5


def panels(
    maps: SkinAppearance, box: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> list[NDArray[np.uint8]]:
    """Return normals as colors, and the diffuse reflectance, seen from the front."""
    place, found = maps.maps["position"], []
    there = np.ones(place.values.shape[:2], bool) if place.valid is None else place.valid
    view = FrontView.of(place.values[there].astype(np.float64), box)
    for name in ("normals", "r_d"):
        shown = maps.maps[name]
        valid = None if shown.valid is None else shown.valid[there]
        image, seen = view.rasterize(shown.values[there], valid=valid)
        picture = 0.5 + 0.5 * image if name == "normals" else image / 0.8
        codes = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
        codes = codes if name == "normals" else png.encode_srgb8(picture)
        codes[~seen] = round(255 * GRAY)
        found.append(codes)
    return found


def main(demo: Path) -> None:
    """Draw the demo's estimated and ground-truth maps of this folder."""
    found = store.read(demo / "appearance-dome-III")
    place = found.maps["position"]
    points = place.values[place.valid].astype(np.float64)
    box = points.min(axis=0), points.max(axis=0)
    drawn = [*panels(found, box), *panels(store.read(demo / "truth-dome-III"), box)]
    TARGET.parent.mkdir(exist_ok=True)
    TARGET.write_bytes(png.encode(np.concatenate([drawn[k] for k in (0, 2, 1, 3)], axis=1)))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
