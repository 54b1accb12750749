"""Build the page's eyes and hair, which are not skin, on the simulated head."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rigsim.face_parts import eyelids
from rigsim.face_parts.hair import HAIR_KINDS, WIDTH_MM, Hair, draw_hair
from rigsim.geometry.mesh import Mesh
from skinrig.arrays import FloatArray
from skinrig.viewer.scene import Assets, SceneSource

LID_STEPS_PER_MM: Final = 512.0
HAIR_STEPS_PER_MM: Final = 64.0
"""Quantization of displacements of the lids, and of curves relative to their roots."""

EXPRESSION_OPENING: Final = {
    "surprise": 0.14,
    "fear": 0.12,
    "anger": -0.1,
    "disgust": -0.25,
    "happiness": -0.18,
    "smile": -0.1,
    "sadness": -0.15,
}
"""Change of the lids' opening in each expression: action units 5, 6 and 7 of the facial action
coding system (Ekman and Friesen 1978)."""

SIMULATED_LABEL: Final = "Parts of the simulated head that are not skin."
UNMEASURED_LABEL: Final = "Not measured: from a mean head, fitted to the scan."
"""Descriptions of the parts on the page."""

_IRIS_COLORS: Final = ((0.095, 0.14, 0.17), (0.10, 0.07, 0.032), (0.03, 0.015, 0.008))
"""Linear sRGB albedo of blue, hazel and dark brown irises."""
_AZIMUTHAL_ROUGHNESS: Final = 0.3
"""Azimuthal roughness of hair, Chiang et al. 2016."""


def build_assets(source: SceneSource) -> Assets:
    """Build eyes behind lids that open, brows, lashes and hair.

    The simulated head has its own, a fused person those that were fitted to its scan. Other scans
    and the mesh of a file have none.
    """
    rest = source.subject if source.subject.rest is None else source.subject.rest
    if source.parts is not None:
        both, hair, label = source.parts.lids, source.parts.hair, UNMEASURED_LABEL
    elif source.own_mesh or eyelids.grid_shape(source.mesh) is None:
        return Assets(left_out=(("eyes and hair", "only the simulated head has them"),))
    else:
        both = eyelids.build_eyelids(source.mesh)
        hair, label = draw_hair(source.mesh, rest.preset, seed=source.seed), SIMULATED_LABEL
    tables: dict[str, NDArray[Any]] = {}
    eyes = []
    for name, lids in zip(("right", "left"), both, strict=True):
        moves = np.concatenate([lids.opening_mm, lids.arc_mm], axis=1)
        tables |= {
            f"lid_vertices_{name}": lids.vertices.astype(np.uint32)[:, None],
            f"lid_moves_{name}": _quantized(moves, LID_STEPS_PER_MM),
            f"lid_margins_{name}": np.stack([lids.upper, lids.lower], axis=1).astype(np.uint32),
            f"lid_faces_{name}": lids.faces.astype(np.uint32)[:, None],
            f"lid_edges_{name}": lids.edges.astype(np.uint32),
        }
        eyes.append({"name": name, "center_mm": lids.center_mm.tolist()})
    at = source.mesh.vertices_mm[hair.roots].astype(np.float64)
    curves = hair.points_mm - at[:, None]
    tables |= {
        "hair_points": _quantized(curves.reshape(len(curves), -1), HAIR_STEPS_PER_MM),
        "hair_opening": _quantized(
            hair.opening_mm.reshape(len(hair.opening_mm), -1), HAIR_STEPS_PER_MM
        ),
        "hair_roots": hair.roots.astype(np.uint32)[:, None],
        "hair_coverage": np.rint(255.0 * hair.coverage).astype(np.uint8),
    }
    facts = {
        "lid_steps_per_mm": LID_STEPS_PER_MM,
        "hair_steps_per_mm": HAIR_STEPS_PER_MM,
        "counts": dict(zip(HAIR_KINDS, hair.counts, strict=True)),
        "width_mm": WIDTH_MM,
        **describe_colors(hair),
        "eyes": eyes,
        "label": label,
        "opening": EXPRESSION_OPENING,
        "sclera_radius_mm": eyelids.SCLERA_RADIUS_MM,
        "cornea_radius_mm": eyelids.CORNEA_RADIUS_MM,
        "cornea_center_mm": eyelids.CORNEA_CENTER_MM,
        "limbus_mm": eyelids.LIMBUS_MM,
        "iris_mm": eyelids.APEX_MM - eyelids.CHAMBER_DEPTH_MM,
        "apex_mm": eyelids.APEX_MM,
    }
    params = {"eyes_open": 1, "eyes_follow": 1, "brows": 1, "hair": 1}
    return Assets(tables=tables, facts={"face_parts": facts}, params=params)


def build_colors(mesh: Mesh, preset: str, seed: int) -> dict[str, list[float]]:
    """Build the colors of hair and iris of another person on the same head.

    Parameters
    ----------
    mesh
        Simulated head.
    preset, seed
        Person, see `rigsim.face_parts.hair.draw_hair`.

    Returns
    -------
    dict
        Absorption per radius, albedo of multiple scattering, and linear sRGB of the iris.
    """
    return describe_colors(draw_hair(mesh, preset, seed=seed))


def describe_colors(hair: Hair) -> dict[str, list[float]]:
    """Return absorption per radius and multiple scattering of hair, and linear sRGB of the iris."""
    return {
        "absorption": hair.absorption_per_radius().tolist(),
        "multiple_scattering": _multiple_scattering(hair).tolist(),
        "iris": _iris_color(hair.iris_melanin),
    }


def _quantized(values_mm: FloatArray, steps_per_mm: float) -> NDArray[np.int16]:
    return np.rint(values_mm * steps_per_mm).astype(np.int16)


def _multiple_scattering(hair: Hair) -> NDArray[np.float64]:
    """Return the albedo of multiple scattering, the inverse of Chiang et al. 2016, eq. (9)."""
    b = _AZIMUTHAL_ROUGHNESS
    scale = 5.969 - 0.215 * b + 2.532 * b**2 - 10.73 * b**3 + 5.574 * b**4 + 0.245 * b**5
    return np.asarray(np.exp(-scale * np.sqrt(hair.absorption_per_radius())))


def _iris_color(melanin: float) -> list[float]:
    colors = np.array(_IRIS_COLORS)
    return [float(np.interp(2.0 * melanin, (0.0, 1.0, 2.0), colors[:, k])) for k in range(3)]
