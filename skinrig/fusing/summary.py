"""Summarize the maps of a fusion."""

from typing import Final

import numpy as np

from skinrig.fusing.double import FusedDouble
from skinrig.fusing.maps import FUSED_MAPS, OWN_SUFFIX

SummaryRow = tuple[str, float, float, float | None]
"""Map, median, median relative standard error in %, and its part common to the face in %."""
_CHANNELS: Final = ("red", "green", "blue")


def summarize(found: FusedDouble) -> list[SummaryRow]:
    """Return the medians of the fused maps over their valid texels.

    Parameters
    ----------
    found
        A fusion.
    """
    rows: list[SummaryRow] = []
    maps = found.appearance.maps
    for name in FUSED_MAPS:
        if name not in maps or maps[name].stderr is None or not maps[name].mask.any():
            continue
        good, one = maps[name].mask, maps[name]
        values = one.values[good].reshape(int(good.sum()), -1).astype(np.float64)
        stderr = np.asarray(one.stderr)[good].reshape(values.shape)
        relative = np.median(stderr / values, axis=0)
        for k, value in enumerate(np.median(values, axis=0)):
            common = None
            if name + OWN_SUFFIX in maps:
                apart = maps[name + OWN_SUFFIX].values[good].reshape(values.shape)
                own = float(np.median(apart[:, k] / values[:, k]))
                common = 100.0 * float(np.sqrt(max(relative[k] ** 2 - own**2, 0.0)))
            label = name if values.shape[1] == 1 else f"{name} {_CHANNELS[k]}"
            rows.append((label, float(value), 100.0 * float(relative[k]), common))
    return rows
