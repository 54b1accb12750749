"""Neutral relief of a patch of skin with the kernels of that skin: fitted, or simulated."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from model.microstructure import FOREHEAD, KernelTable
from model.skin import SkinAppearance
from rigsim.skin_patch.microrelief import make_micro_skin
from skinrig.appearances.dynamic import MICROSTRUCTURE, parts_of
from skinrig.arrays import BoolArray, Float32Array

PATCH_PX: Final = 256
"""Side of the patch in the page: 3 to 4 mm of skin; some 80 kB."""


class MicrostructureAssetError(ValueError):
    """Relief that the page cannot show."""


@dataclass(frozen=True, slots=True, eq=False)
class MicroRelief:
    """A measured or simulated neutral relief with the kernels of that skin.

    Attributes
    ----------
    height_um : ndarray of float32, shape (h, w)
        Finite; row 0 is the top.
    pixel_um : float
        Length of skin that a pixel has.
    table : KernelTable
    source : str
        "measured" or "simulated", and from where; shown in the page.
    """

    height_um: Float32Array
    pixel_um: float
    table: KernelTable = FOREHEAD
    source: str = "simulated"


def fitted_relief(appearance: SkinAppearance) -> MicroRelief | None:
    """Return the first site's relief of `skinrig fit microstructure`; None without that part."""
    part = parts_of(appearance).get(MICROSTRUCTURE)
    if part is None:
        return None
    site, entry = sorted(part["sites"].items())[0]
    found = appearance.maps[entry["map"]]
    text = bytes(appearance.files[entry["table"]]).decode("utf-8")
    return MicroRelief(
        largest_square(np.squeeze(found.values).astype(np.float32), found.mask),
        float(entry["pixel_um"]),
        KernelTable.from_json(text),
        f"{part['source']}: {site}",
    )


def simulated_relief(seed: int, *, site: str = "forehead", pixel_um: float = 15.0) -> MicroRelief:
    """Return relief of the simulated skin of a site, `PATCH_PX` a side."""
    skin = make_micro_skin(site, seed=seed, size_mm=1e-3 * pixel_um * PATCH_PX, texel_um=pixel_um)
    return MicroRelief(skin.height_um, pixel_um, FOREHEAD, f"simulated: {site}")


def largest_square(height: Float32Array, valid: BoolArray) -> Float32Array:
    """Return the largest square without holes; the first one in reading order of several.

    Examples
    --------
    >>> holes = np.array([[0, 1, 1], [1, 1, 1]], bool)
    >>> largest_square(np.arange(6, dtype=np.float32).reshape(2, 3), holes).tolist()
    [[1.0, 2.0], [4.0, 5.0]]
    """
    good = np.asarray(valid, bool) & np.isfinite(height)
    size = np.zeros(good.shape, np.int64)
    for y in range(good.shape[0]):
        row = good[y].astype(np.int64)
        if y:
            # side of the largest square that ends at each pixel
            above = size[y - 1]
            for x in np.flatnonzero(row):
                if x:
                    row[x] = 1 + min(above[x], above[x - 1], row[x - 1])
        size[y] = row
    side = int(size.max(initial=0))
    if side == 0:
        raise MicrostructureAssetError("relief: got no valid pixel, expected some millimetres")
    bottom, right = np.argwhere(size == side)[0] + 1
    return np.ascontiguousarray(height[bottom - side : bottom, right - side : right])
