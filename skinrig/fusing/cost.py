"""Compare a fusion with one from which a rig, a map or the covariances were left out."""

import numpy as np

from model.skin import SkinAppearance
from skinrig.arrays import Float64Array, FloatArray
from skinrig.fusing.maps import FUSED_MAPS

CostRow = tuple[str, float | None, float | None, float | None]
"""Map, median 68 % half-widths in % of the fusion and without the part, median change of the
estimate in standard errors of the fusion; None for a map that one of them lacks."""
_CHANNELS = ("red", "green", "blue")


def compare_without(whole: SkinAppearance, part: SkinAppearance) -> list[CostRow]:
    """Return what leaving out a part of the measurements costs, per fused map and channel.

    Parameters
    ----------
    whole
        Fused maps of all measurements.
    part
        Fused maps without some of them.
    """
    rows: list[CostRow] = []
    for name in FUSED_MAPS:
        maps = [one.maps.get(name) for one in (whole, part)]
        found = [None if one is None else _flat(one.values, one.stderr) for one in maps]
        if found[0] is None and found[1] is None:
            continue
        valid = [None if one is None else one.mask.reshape(-1) for one in maps]
        first = next(pair for pair in found if pair is not None)
        channels = first[0].shape[1]
        for c in range(channels):
            widths: list[float | None] = []
            for pair, good in zip(found, valid, strict=True):
                if pair is None or good is None or not good.any():
                    widths.append(None)
                    continue
                values, stderr = pair
                widths.append(100.0 * float(np.median(stderr[good, c] / values[good, c])))
            change = None
            if (
                found[0] is not None
                and found[1] is not None
                and len(found[0][0]) == len(found[1][0])
            ):
                both = np.logical_and(*valid)
                if both.any():
                    off = np.abs(found[1][0] - found[0][0])[both, c] / found[0][1][both, c]
                    change = float(np.median(off))
            label = name if channels == 1 else f"{name} {_CHANNELS[c]}"
            rows.append((label, widths[0], widths[1], change))
    return rows


def _flat(values: FloatArray, stderr: FloatArray | None) -> tuple[Float64Array, Float64Array]:
    """Return values and standard errors of a map by texel and channel."""
    height, width = values.shape[:2]
    flat = values.reshape(height * width, -1).astype(np.float64)
    error = np.ones_like(flat) if stderr is None else stderr.reshape(flat.shape).astype(np.float64)
    return flat, error
