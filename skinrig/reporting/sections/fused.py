"""Report section on a fused person: the rigs behind each map, and their agreement."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from model.skin import SkinAppearance
from skinrig.appearances.contents import FUSION_KEY
from skinrig.fusing.filled_normals import MEASURED_SUFFIX
from skinrig.reporting import map_images, page
from skinrig.reporting.map_names import map_title

DRAWN_OF_ONE_RIG = ("position", "normals_refined", "translucency")
"""Maps of a single rig that are drawn all the same."""


def without_copies(appearance: SkinAppearance) -> SkinAppearance:
    """Return a fused person without maps that one rig's section draws, and measured texels."""
    found: Any = appearance.parameters[FUSION_KEY]
    copies = {
        name
        for name, rigs in found["maps"].items()
        if len(rigs) == 1 and name not in DRAWN_OF_ONE_RIG and not name.startswith("patch_")
    }
    maps = {
        name: one
        for name, one in appearance.maps.items()
        if name not in copies and not name.endswith(MEASURED_SUFFIX)
    }
    return replace(appearance, maps=maps)


def section(appearance: SkinAppearance) -> Iterator[page.Block]:
    """Yield the rigs behind each map and their agreement.

    Parameters
    ----------
    appearance
        Maps of a fused person.
    """
    found: Any = appearance.parameters[FUSION_KEY]
    rigs_by_map: Mapping[str, list[str]] = found["maps"]
    names: dict[tuple[str, ...], list[str]] = {}
    for name, rigs in rigs_by_map.items():
        if not name.startswith("_"):
            names.setdefault(tuple(rigs), []).append(map_title(name))
    rows = [[", ".join(rigs), ", ".join(maps)] for rigs, maps in names.items()]
    yield page.build_table(["rigs", "maps"], rows, caption="Rigs behind each map")
    if found["checks"]:
        yield page.build_table(
            ["rig", "probability that it is faulty", "p value of its gains"],
            [[one["rig"], one["probability_faulty"], one["p_value"]] for one in found["checks"]],
            caption="Agreement of the rigs",
        )
    for name, one in appearance.maps.items():
        drawing = map_images.MapDrawing(map_title(name), "°", one.mask)
        if name.startswith("patch_normals_") and one.stderr is not None:
            spread = np.degrees(one.stderr[..., 0])
            reach = map_images.compute_percentile_reach(spread, one.mask, 98)
            yield page.Heading(map_title(name))
            yield page.Images(
                [
                    drawing.normals("normals of the patch on the face", one.values),
                    drawing.size("standard uncertainty", spread, reach),
                ]
            )
