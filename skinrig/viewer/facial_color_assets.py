"""Textures and tables of Jimenez 2010: chromophores, the hemoglobin rig, the color of skin."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from model import color_table, spectra
from model.coarse_maps import Cells
from model.facial_color import GLOBAL_GAINS, NEUTRAL, HemoglobinRig
from model.tissue_optics import C_HD_MAX, C_M_MAX
from skinrig.viewer.scene import Assets, SceneSource, Texture

Float32 = NDArray[np.float32]
Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

TABLE_SIZE: Final = 128
"""Nodes along each axis of the color table."""
RIG_SIZE: Final = 256
"""Cells a side of the scale and bias maps (Jimenez 2010, section 6)."""
RADIUS_OF_SIZE: Final = 24.0 / 512.0
"""Radius of the local statistics' disc, as a part of the map's side."""
ANISOTROPY: Final = 0.8
"""Mean cosine of scattering behind the color table; one that `model.color_table` stores."""


def assets(source: SceneSource) -> Assets:
    """Return chromophores, color table and, where the face has states, its hemoglobin rig."""
    if source.subject is None:
        raise NotImplementedError
    subject = source.subject
    states = [name for name in _state_names() if name != NEUTRAL]
    rig = HemoglobinRig.from_maps(
        subject.hemoglobin(),
        {name: subject.hemoglobin(name) for name in states},
        radius_px=RADIUS_OF_SIZE * subject.size,
        valid=subject.atlas.covered,
        stored_size=min(RIG_SIZE, subject.size),
    )
    return color_assets(subject.melanin, rig, melanin_valid=subject.atlas.covered)


def color_assets(melanin: Float32, rig: HemoglobinRig, *, melanin_valid: Mask) -> Assets:
    """Return the assets of a melanin map and a rig of the same size.

    Parameters
    ----------
    melanin
        Volume fraction, (H, W).
    rig
        Its neutral map has the same shape.
    melanin_valid
        (H, W) bool.
    """
    roots = np.stack(
        [
            filled(np.cbrt(np.where(melanin_valid, melanin, 0.0)), melanin_valid),
            filled(np.cbrt(np.where(rig.valid, rig.neutral, 0.0)), rig.valid),
        ],
        axis=-1,
    )
    table = color_table.build(spectra.LINEAR_SRGB, "D65", size=TABLE_SIZE, anisotropy=ANISOTROPY)
    names = [NEUTRAL, *rig.states]
    layers = []
    for name in names:
        valid = rig.neutral_mean_valid if name == NEUTRAL else rig.states[name].valid
        pair = [filled(maps[name], valid) for maps in (rig.scale, rig.bias)]
        layers.append(np.stack(pair, axis=-1))
    return {
        "textures": {
            "chromophores": Texture(roots.astype(np.float32), "u8"),
            "facial_states": Texture(np.stack(layers).astype(np.float32), "u8"),
        },
        "tables": {"skin_color": table.rgb.astype(np.float32)},
        "facts": {
            "color_table": {"c_m_max": C_M_MAX, "c_hd_max": C_HD_MAX, "size": TABLE_SIZE},
            "facial_color": {
                "states": names,
                "gains": {n: g for n, g in GLOBAL_GAINS.items() if n in rig.states},
                "global_states": list(rig.global_states),
            },
        },
        "params": {"weights": {name: 0.0 for name in rig.states}},
    }


def filled(values: Float32 | Floats, valid: Mask) -> Floats:
    """Return a map whose missing texels hold what surrounds them, so that filters stay clean.

    Means of ever larger cells (push) are interpolated back (pull).
    """
    out = np.where(valid, values, 0.0).astype(np.float64)
    if valid.all() or not valid.any():
        return out
    shape = (values.shape[0], values.shape[1])
    missing = ~valid
    few = shape
    while missing.any() and min(few) > 1:
        few = (max(1, few[0] // 2), max(1, few[1] // 2))
        cells = Cells(shape, few)
        coarse, held = cells.coarsen(out, valid)
        (up,) = cells.refine(coarse, valid=held)
        known = missing & np.isfinite(up)
        out[known] = up[known]
        missing &= ~known
    if missing.any():
        out[missing] = float(out[valid].mean())
    return out


def _state_names() -> Mapping[str, object] | tuple[str, ...]:
    from rigsim.perfusion import STATES

    return STATES
