"""Textures and tables of Jimenez 2010: chromophores, the hemoglobin rig, the color of skin."""

from typing import Any, Final

import numpy as np

from model import color_table, spectra
from model.facial_color import HemoglobinRig
from model.facial_color.rig import GLOBAL_GAINS
from model.facial_color.state_maps import NEUTRAL
from model.tissue_optics.layers import ANISOTROPY_SKIN, C_HD_MAX, C_M_MAX
from rigsim.subject import SimulatedSubject
from rigsim.subject.perfusion import STATE_NAMES
from skinrig.appearances.dynamic import FACIAL_COLOR, parts_of
from skinrig.arrays import Float64Array
from skinrig.viewer.assets import camera_color
from skinrig.viewer.assets.camera_color import CameraColor
from skinrig.viewer.assets.placed_color import RIG_PX, FaceColor, placed
from skinrig.viewer.fine_skin import FineSkin
from skinrig.viewer.map_filling import filled, halved
from skinrig.viewer.scene import Assets, SceneSource, Texture

TABLE_NODES: Final = 128
"""Nodes along each axis of the color table."""
RADIUS_PER_SIZE: Final = 24.0 / 512.0
"""Radius of the local statistics' disc, as a part of the map's side."""
FINEST_STEP_WORDS: Final = 8
"""Words of the finest octave's steps, of chromophores of 2048 texels a side and more: texels below
0.2 mm hold noise."""
ALBEDO_MAP: Final = "r_d"


def assets(source: SceneSource) -> Assets:
    """Return chromophores, color table, hemoglobin rig and, where it was measured, the albedo."""
    albedo = _albedo(source)
    found = _face(source, measured=albedo is not None)
    table = color_table.build(
        spectra.LINEAR_SRGB, "D65", size=TABLE_NODES, anisotropy=ANISOTROPY_SKIN
    )
    roots = np.cbrt(np.stack([found.melanin, found.hemoglobin], axis=-1))
    textures = {
        "chromophores": Texture(
            roots.astype(np.float32), fine=FINEST_STEP_WORDS if len(roots) >= 2048 else 1
        ),
        "facial_states": Texture(np.stack(list(found.states.values())).astype(np.float32), "u8"),
    }
    names = list(found.states)
    facts: dict[str, Any] = {
        "color_table": {"c_m_max": C_M_MAX, "c_hd_max": C_HD_MAX, "size": TABLE_NODES},
        "facial_color": {
            "states": names,
            "gains": {n: g for n, g in GLOBAL_GAINS.items() if n in names},
            "global_states": list(found.global_states),
            **found.facts,
        },
    }
    left_out = dict(found.left_out)
    if albedo is not None:
        textures["albedo_map"], seen = albedo
        facts["albedo_color"] = seen.provenance
        if not seen.known:
            left_out["colors of this face"] = seen.provenance
        left_out["chromophores of this face"] = (
            "the dome measures color alone: states change it by the ratio of simulated blood"
        )
    return {
        "textures": textures,
        # 11 bits are finer than linear interpolation between the nodes, and pack twice as small
        "tables": {"skin_color": table.rgb.astype(np.float16).astype(np.float32)},
        "facts": facts,
        "params": {"weights": dict.fromkeys([*names[1:], *source.mesh.shapes], 0.0)},
        "left_out": tuple(left_out.items()),
    }


def _face(source: SceneSource, *, measured: bool) -> FaceColor:
    """Return the chromophores; beside a measured albedo, coarse: only their changes show."""
    subject, dynamic = source.subject, source.appearances.get("dynamic")
    if dynamic is not None and FACIAL_COLOR in parts_of(dynamic):
        return placed(source)
    return simulated(subject, FineSkin(subject, subject.size) if measured else source.skin)


def simulated(person: SimulatedSubject, skin: FineSkin) -> FaceColor:
    """Return the chromophores of a simulated person, with a rig of all of its states."""
    rig = HemoglobinRig.from_maps(
        person.hemoglobin(),
        {name: person.hemoglobin(name) for name in STATE_NAMES if name != NEUTRAL},
        radius_px=RADIUS_PER_SIZE * person.size,
        valid=person.atlas.covered,
        stored_size=min(RIG_PX, person.size),
    )
    return FaceColor(
        melanin=skin.melanin(),
        hemoglobin=skin.hemoglobin(),
        states=_stored_states(rig),
        global_states=rig.global_states,
        facts={"source": "simulated"},
    )


def _stored_states(rig: HemoglobinRig) -> dict[str, Float64Array]:
    """Return a rig's scale and bias maps by state, (h, w, 2), filled where they are not valid."""
    valid = {NEUTRAL: rig.neutral_mean_valid, **{name: m.valid for name, m in rig.states.items()}}
    return {
        name: filled(np.stack([rig.scale[name], rig.bias[name]], axis=-1), valid[name])
        for name in (NEUTRAL, *rig.states)
    }


def _albedo(source: SceneSource) -> tuple[Texture, CameraColor] | None:
    """Return the measured albedo, (N, N, 3), of the dome's or a fitted model's folder."""
    for appearance in source.fitted:
        if ALBEDO_MAP not in appearance.maps:
            continue
        found = appearance.maps[ALBEDO_MAP]
        values = filled(found.values, found.mask)
        seen = camera_color.of(source)
        shown = np.clip(seen.convert(halved(values, source.size)), 0.0, 1.0)
        return Texture(shown.astype(np.float32), "u8"), seen
    return None
