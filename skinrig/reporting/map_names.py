"""What maps, states of skin and bands are called where people read of them."""

import re
from collections.abc import Iterator
from typing import Final

import numpy as np

from skinrig.arrays import BoolArray, FloatArray
from skinrig.evaluating.flash import MELANIN_RANGES

MAP_WORDS: Final = {
    "r_d": "diffuse reflectance R_d",
    "normals_refined": "normals without gloss",
    "half_vector_normals": "normals by half vectors",
    "lobe_residual": "residual of the lobes",
    "samples": "samples of a point",
    "gamut_distance": "distance from colors of skin",
    "tsumura_melanin": "melanin by independent components",
    "tsumura_hemoglobin": "hemoglobin by independent components",
    "specular_picture": "picture of gloss",
}
"""Names in files to words; what is not here is a word already."""
MIN_BAND_PIXELS: Final = 20
"""Of a melanin band that is told."""
_STATE_NAME: Final = re.compile(r"(?P<map>[a-z_]+)_(?P<state>a\d+_[nmp]\d+)")
_NUMBERED_PREFIXES: Final = {"basis_weight_": "share of lobe "}
_PART_PREFIXES: Final = {
    "change_": "change of hemoglobin, ",
    "hemoglobin_": "hemoglobin, ",
    "microrelief_": "microrelief, ",
}


def map_title(name: str) -> str:
    """Return a map's name, with or without a channel, as people read it.

    Examples
    --------
    >>> map_title("r_d"), map_title("r_d red"), map_title("basis_weight_2"), map_title("melanin")
    ('diffuse reflectance R_d', 'diffuse reflectance R_d, red', 'share of lobe 2', 'melanin')
    >>> map_title("diffuse_normals_a045_m2"), map_title("hemoglobin_anger")
    ('diffuse normals, 45°, compressed 2', 'hemoglobin, anger')
    """
    key, _, channel = name.partition(" ")
    if channel:
        return f"{map_title(key)}, {channel}"
    if key in MAP_WORDS:
        return MAP_WORDS[key]
    if found := _STATE_NAME.fullmatch(key):
        return f"{found['map'].replace('_', ' ')}, {state_title(found['state'])}"
    for head, told in (_NUMBERED_PREFIXES | _PART_PREFIXES).items():
        if key.startswith(head):
            return told + key.removeprefix(head).replace("_", " ")
    return key.replace("_", " ")


def map_heading(name: str) -> str:
    """Return a map's name in words, with the name of its file where that is another.

    Examples
    --------
    >>> map_heading("r_d"), map_heading("melanin")
    ('diffuse reflectance R_d (r_d)', 'melanin')
    """
    told = map_title(name)
    return told if told == name else f"{told} ({name})"


def state_title(state: str) -> str:
    """Return a state's name in words.

    Examples
    --------
    >>> state_title("a045_m2"), state_title("a000_n0")
    ('45°, compressed 2', '0°, neutral')
    """
    angle, step = state.split("_")
    kinds = {"n": "neutral", "m": f"compressed {step[1:]}", "p": f"stretched {step[1:]}"}
    return f"{int(angle[1:])}°, {kinds[step[0]]}"


def split_melanin_bands(levels: FloatArray, valid: BoolArray) -> Iterator[tuple[str, BoolArray]]:
    """Yield the bands of melanin that hold enough good pixels: name, and pixels, (H, W)."""
    for low, high in MELANIN_RANGES:
        inside = valid & (levels >= low) & (levels < high)
        if np.count_nonzero(inside) >= MIN_BAND_PIXELS:
            yield melanin_band(low, high), inside


def melanin_band(low: float, high: float) -> str:
    """Return a band of the melanin fraction C_m, the volume fraction of the epidermis.

    Examples
    --------
    >>> melanin_band(0.05, 0.1)
    'melanin 0.05–0.1'
    """
    return f"melanin {low:g}–{high:g}"
