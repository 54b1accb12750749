"""Format the labels of maps, strain steps and melanin bands in reports."""

import re
from collections.abc import Iterator
from typing import Final

import numpy as np

from skinrig.arrays import BoolArray, FloatArray
from skinrig.evaluating.flash import MELANIN_RANGES

MAP_WORDS: Final = {
    "r_d": "diffuse reflectance R_d",
    "melanin": "melanosome volume fraction",
    "hemoglobin": "blood volume fraction",
    "normals_refined": "normals, specular removed",
    "half_vector_normals": "half-vector normals",
    "lobe_residual": "residual of the basis BRDFs",
    "samples": "samples per point",
    "hole_stderr": "standard error in closed holes",
    "gamut_distance": "distance from the gamut of skin",
    "translucency": "diffuse mean free path",
    "tsumura_melanin": "melanin, independent components",
    "tsumura_hemoglobin": "hemoglobin, independent components",
    "lab": "CIE Lab",
    "ita": "individual typology angle",
    "monk": "Monk skin tone",
    "monk_low": "lightest likely Monk skin tone",
    "monk_high": "darkest likely Monk skin tone",
    "image": "captured image",
    "specular_image": "specular image",
}
"""Labels by the name in files; other names are labels already."""
MIN_BAND_PIXELS: Final = 20
"""Pixels below which a melanin band is omitted."""
CREDIBLE_HALF_WIDTH: Final = "68 % credible half-width"
STANDARD_UNCERTAINTY: Final = "standard uncertainty"
_STATE_NAME: Final = re.compile(r"(?P<map>[a-z_]+)_(?P<state>a\d+_[nmp]\d+)")
_NUMBERED_PREFIXES: Final = {"basis_weight_": "weight of basis BRDF "}
_PART_PREFIXES: Final = {
    "change_": "change of blood volume fraction, ",
    "hemoglobin_": "blood volume fraction, ",
    "microrelief_": "surface topography, ",
}


def map_title(name: str) -> str:
    """Return the label of a map, with its channel where one is given.

    Examples
    --------
    >>> map_title("r_d red"), map_title("basis_weight_2")
    ('diffuse reflectance R_d, red', 'weight of basis BRDF 2')
    >>> map_title("diffuse_normals_a045_m2"), map_title("hemoglobin_anger")
    ('diffuse normals, 45°, compressed 2', 'blood volume fraction, anger')
    """
    key, _, channel = name.partition(" ")
    if channel:
        return f"{map_title(key)}, {channel}"
    if key in MAP_WORDS:
        return MAP_WORDS[key]
    if found := _STATE_NAME.fullmatch(key):
        return f"{found['map'].replace('_', ' ')}, {state_title(found['state'])}"
    for head, label in (_NUMBERED_PREFIXES | _PART_PREFIXES).items():
        if key.startswith(head):
            return label + key.removeprefix(head).replace("_", " ")
    return key.replace("_", " ")


def map_heading(name: str) -> str:
    """Return the label of a map, followed by the name of its file where that differs.

    Examples
    --------
    >>> map_heading("r_d"), map_heading("shading")
    ('diffuse reflectance R_d (r_d)', 'shading')
    """
    label = map_title(name)
    return label if label == name else f"{label} ({name})"


def uncertainty_title(name: str) -> str:
    """Return the label of a map's uncertainty: chromophores have a posterior.

    Examples
    --------
    >>> uncertainty_title("melanin"), uncertainty_title("normals")
    ('68 % credible half-width', 'standard uncertainty')
    >>> uncertainty_title("melanin_index")
    'standard uncertainty'
    """
    posterior = name.startswith(("melanin", "hemoglobin")) and not name.endswith("_index")
    return CREDIBLE_HALF_WIDTH if posterior else STANDARD_UNCERTAINTY


def state_title(state: str) -> str:
    """Return the label of a strain step.

    Examples
    --------
    >>> state_title("a045_m2"), state_title("a000_n0")
    ('45°, compressed 2', '0°, neutral')
    """
    angle, step = state.split("_")
    kinds = {"n": "neutral", "m": f"compressed {step[1:]}", "p": f"stretched {step[1:]}"}
    return f"{int(angle[1:])}°, {kinds[step[0]]}"


def split_melanin_bands(levels: FloatArray, valid: BoolArray) -> Iterator[tuple[str, BoolArray]]:
    """Yield name and pixels, (H, W), of the melanin bands with enough valid pixels."""
    for low, high in MELANIN_RANGES:
        inside = valid & (levels >= low) & (levels < high)
        if np.count_nonzero(inside) >= MIN_BAND_PIXELS:
            yield melanin_band(low, high), inside


def melanin_band(low: float, high: float) -> str:
    """Return the label of a band of the melanosome volume fraction C_m.

    Examples
    --------
    >>> melanin_band(0.05, 0.1)
    'melanin 0.05–0.1'
    """
    return f"melanin {low:g}–{high:g}"
