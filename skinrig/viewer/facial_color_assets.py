"""Textures and tables of Jimenez 2010: chromophores, the hemoglobin rig, the color of skin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from model import color_table, spectra
from model.coarse_maps import Cells, fitting
from model.facial_color import GLOBAL_GAINS, NEUTRAL, HemoglobinRig
from model.tissue_optics import ANISOTROPY_SKIN, C_HD_MAX, C_M_MAX
from skinrig.dynamic_appearance import FACIAL_COLOR, parts_of
from skinrig.viewer.scene import Assets, SceneSource, Texture

if TYPE_CHECKING:
    from rigsim.subject import Subject

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

TABLE_SIZE: Final = 128
"""Nodes along each axis of the color table."""
RIG_SIZE: Final = 256
"""Cells a side of the scale and bias maps (Jimenez 2010, section 6)."""
SIMULATED_SIZE: Final = 512
"""Texels a side of the simulated states that the rig is made from: it is kept smaller yet."""
RADIUS_OF_SIZE: Final = 24.0 / 512.0
"""Radius of the local statistics' disc, as a part of the map's side."""
FINE: Final = 8
"""Words of the finest octave's steps, of chromophores of 2048 texels a side and more."""
ALBEDO: Final = "r_d"


@dataclass(frozen=True, slots=True, eq=False)
class FaceColor:
    """Chromophores of a face on its texture, and its hemoglobin rig.

    Attributes
    ----------
    melanin, hemoglobin : ndarray of float64, shape (N, N)
        Volume fractions in the neutral state, known everywhere.
    states : mapping of str to ndarray of float64, shape (h, w, 2)
        Scale and bias by state, "neutral" first.
    global_states
        Those of the whole body.
    facts
        How they came to lie on the texture; JSON values.
    left_out
        What could not be placed.
    """

    melanin: Floats
    hemoglobin: Floats
    states: Mapping[str, Floats]
    global_states: tuple[str, ...]
    facts: Mapping[str, Any]
    left_out: tuple[tuple[str, str], ...] = ()


def assets(source: SceneSource) -> Assets:
    """Return chromophores, color table, hemoglobin rig and, where it was measured, the albedo."""
    found = _face(source)
    table = color_table.build(
        spectra.LINEAR_SRGB, "D65", size=TABLE_SIZE, anisotropy=ANISOTROPY_SKIN
    )
    roots = np.cbrt(np.stack([found.melanin, found.hemoglobin], axis=-1))
    textures = {
        "chromophores": Texture(roots.astype(np.float32), fine=_fine(roots.shape[0])),
        "facial_states": Texture(np.stack(list(found.states.values())).astype(np.float32), "u8"),
    }
    names = list(found.states)
    facts: dict[str, Any] = {
        "color_table": {"c_m_max": C_M_MAX, "c_hd_max": C_HD_MAX, "size": TABLE_SIZE},
        "facial_color": {
            "states": names,
            "gains": {n: g for n, g in GLOBAL_GAINS.items() if n in names},
            "global_states": list(found.global_states),
            **found.facts,
        },
    }
    left_out = list(found.left_out)
    albedo = _albedo(source)
    if albedo is not None:
        textures["albedo_map"] = albedo
        left_out.append(
            (
                "chromophores of this face",
                "the dome measures color alone: states change it by the ratio of simulated blood",
            )
        )
    return {
        "textures": textures,
        # 11 bits are finer than linear interpolation between the nodes, and pack twice as small
        "tables": {"skin_color": table.rgb.astype(np.float16).astype(np.float32)},
        "facts": facts,
        "params": {"weights": dict.fromkeys([*names[1:], *source.mesh.shapes], 0.0)},
        "left_out": tuple(left_out),
    }


def _fine(size: int) -> int:
    """Return how coarsely the finest octave is kept: texels below 0.2 mm hold noise."""
    return FINE if size >= 2048 else 1


def _face(source: SceneSource) -> FaceColor:
    subject = source.subject
    if subject is None:
        raise ValueError("source: got no subject, expected one to stand for what was not measured")
    dynamic = source.appearances.get("dynamic")
    if dynamic is not None and FACIAL_COLOR in parts_of(dynamic):
        from skinrig.viewer.placed_color import placed

        return placed(source, subject)
    return simulated(subject)


def simulated(subject: Subject) -> FaceColor:
    """Return the chromophores of a simulated person, with a rig of all of its states."""
    from rigsim.perfusion import STATES
    from rigsim.subject import make_subject

    covered = subject.atlas.covered
    small = subject
    if subject.size > SIMULATED_SIZE:
        small = make_subject(
            subject.preset, seed=subject.seed, size=SIMULATED_SIZE, mesh=subject.mesh
        )
    rig = HemoglobinRig.from_maps(
        small.hemoglobin(),
        {name: small.hemoglobin(name) for name in STATES if name != NEUTRAL},
        radius_px=RADIUS_OF_SIZE * small.size,
        valid=small.atlas.covered,
        stored_size=min(RIG_SIZE, small.size),
    )
    return FaceColor(
        melanin=filled(subject.melanin, covered),
        hemoglobin=filled(subject.hemoglobin(), covered),
        states=stored_states(rig),
        global_states=rig.global_states,
        facts={"source": "simulated"},
    )


def stored_states(rig: HemoglobinRig) -> dict[str, Floats]:
    """Return a rig's scale and bias maps by state, (h, w, 2), filled where they are not valid."""
    layers = {}
    for name in (NEUTRAL, *rig.states):
        valid = rig.neutral_mean_valid if name == NEUTRAL else rig.states[name].valid
        pair = [filled(maps[name], valid) for maps in (rig.scale, rig.bias)]
        layers[name] = np.stack(pair, axis=-1)
    return layers


def filled(values: NDArray[np.floating], valid: Mask) -> Floats:
    """Return a map whose missing texels hold what surrounds them, so that filters stay clean.

    Means over ever larger cells are interpolated back until nothing is missing.

    Parameters
    ----------
    values
        (H, W); what is not valid may be anything.
    valid
        (H, W); where nothing is, the result is 0.

    Examples
    --------
    >>> filled(np.array([[1.0, 7.0], [1.0, 1.0]]), np.array([[True, False], [True, True]])).tolist()
    [[1.0, 1.0], [1.0, 1.0]]
    """
    out = np.where(valid, values, 0.0).astype(np.float64)
    missing = ~valid
    few = (values.shape[0], values.shape[1])
    while missing.any() and valid.any():
        few = (max(1, few[0] // 2), max(1, few[1] // 2))
        cells = Cells(valid.shape, few)
        coarse, held = cells.coarsen(out, valid)
        (up,) = cells.refine(coarse, valid=held)
        known = missing & np.isfinite(up)
        out[known] = up[known]
        missing &= ~known
    return out


def halved(values: Floats, size: int) -> Floats:
    """Return means over cells, (size, size[, C]), of a larger map; a smaller one as it is."""
    if values.shape[0] <= size:
        return values
    cells = fitting((values.shape[0], values.shape[1]), size)
    everywhere = np.ones(values.shape[:2], np.bool_)
    if values.ndim == 2:
        return cells.coarsen(values, everywhere)[0]
    return np.stack([cells.coarsen(one, everywhere)[0] for one in np.moveaxis(values, -1, 0)], -1)


def _albedo(source: SceneSource) -> Texture | None:
    """Return the measured albedo, (N, N, 3), of the dome's or a fitted model's folder."""
    for kind in ("model", "dome"):
        appearance = source.appearances.get(kind)
        if appearance is None or ALBEDO not in appearance.maps:
            continue
        found = appearance.maps[ALBEDO]
        valid: Mask = np.asarray(np.isfinite(found.values).all(axis=-1), np.bool_)
        if found.valid is not None:
            valid = valid & found.valid
        values = np.stack([filled(found.values[..., c], valid) for c in range(3)], axis=-1)
        return Texture(np.clip(halved(values, source.size), 0.0, 1.0).astype(np.float32), "u8")
    return None
