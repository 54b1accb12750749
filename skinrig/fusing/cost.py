"""Compare a fusion with one from which a rig, a map or the covariances were left out."""

import numpy as np

from model.skin import SkinAppearance, SkinMap
from skinrig.arrays import Float64Array
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
        one, other = whole.maps.get(name), part.maps.get(name)
        shown = one or other
        if shown is None:
            continue
        channels = 1 if shown.values.ndim == 2 else shown.values.shape[2]
        for c in range(channels):
            label = name if channels == 1 else f"{name} {_CHANNELS[c]}"
            rows.append((label, _width(one, c), _width(other, c), _change(one, other, c)))
    return rows


def _width(one: SkinMap | None, channel: int) -> float | None:
    """Return the median half-width of a map's 68 % intervals, in % of its values."""
    if one is None or not one.mask.any():
        return None
    values, stderr = _flat(one, channel)
    return 100.0 * float(np.median(stderr[one.mask] / values[one.mask]))


def _change(one: SkinMap | None, other: SkinMap | None, channel: int) -> float | None:
    """Return the median difference of two maps, in standard errors of the first."""
    if one is None or other is None or one.mask.shape != other.mask.shape:
        return None
    both = one.mask & other.mask
    if not both.any():
        return None
    (values, stderr), (others, _) = _flat(one, channel), _flat(other, channel)
    return float(np.median(np.abs(others - values)[both] / stderr[both]))


def _flat(one: SkinMap, channel: int) -> tuple[Float64Array, Float64Array]:
    """Return values and standard errors of a channel, (H, W)."""
    pair = one.values, np.ones_like(one.values) if one.stderr is None else one.stderr
    values, stderr = (v if v.ndim == 2 else v[..., channel] for v in pair)
    return values.astype(np.float64), stderr.astype(np.float64)
