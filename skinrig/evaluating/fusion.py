"""Evaluate fused maps, and those of single rigs on the same texels, against ground truth."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from model.skin import SkinAppearance, SkinMap
from skinrig.appearances.contents import intersect_valid
from skinrig.appearances.texel_placement import TexelPlacement
from skinrig.arrays import BoolArray, Float64Array

MAX_MATCH_DISTANCE_MM: Final = 1.5
"""Maximum distance of a texel from the surface point whose ground truth it is compared with."""
MIN_TEXELS: Final = 50
"""Fewer compared texels give no figures."""
CHROMOPHORE_MAPS: Final = ("melanin", "hemoglobin")
CHANNEL_NAMES: Final = ("red", "green", "blue")


@dataclass(frozen=True, slots=True)
class FusionAccuracy:
    """Accuracy of one quantity of a fusion and of a single rig, on the same texels.

    Attributes
    ----------
    quantity
        Map, with its channel.
    rig
        The single rig.
    texels
        Number of compared texels.
    fused, single
        Median absolute error of the logarithm.
    fused_bias, single_bias
        Median error of the logarithm.
    fused_coverage, single_coverage
        Fraction of true values in the 68 % interval.
    """

    quantity: str
    rig: str
    texels: int
    fused: float
    single: float
    fused_bias: float
    single_bias: float
    fused_coverage: float
    single_coverage: float


def compare_fused(
    fused: SkinAppearance,
    single: Mapping[str, SkinAppearance],
    truths: Mapping[str, SkinAppearance],
    placement: TexelPlacement | None,
) -> list[FusionAccuracy]:
    """Compare a fusion and its single rigs with the ground truth.

    Parameters
    ----------
    fused
        Maps on the dome's texture.
    single
        Maps of the rigs by name: dome and flash.
    truths
        Ground truth of the same rigs. Its points are matched by position.
    placement
        Places of the texels in the flash image; None: chromophores are not compared.
    """
    position = fused.maps["position"]
    rows = []
    if "dome" in single and "dome" in truths:
        truth = truths["dome"]
        values = np.concatenate([truth.maps["r_d"].values], axis=-1)
        near, true = _match(position, truth.maps["position"], truth.maps["r_d"].mask, values)
        for c, channel in enumerate(CHANNEL_NAMES):
            pair = [_flat(one.maps["r_d"], c) for one in (fused, single["dome"])]
            rows += _row(f"r_d {channel}", "dome", pair, near, true[:, c])
    if "flash" in single and "flash" in truths and placement is not None:
        truth = truths["flash"]
        known = truth.maps["melanin"].mask & (truth.maps["melanin"].values > 0.0)
        values = np.stack([truth.maps[name].values for name in CHROMOPHORE_MAPS], axis=-1)
        near, true = _match(position, truth.maps["position_mm"], known, values)
        for k, name in enumerate(CHROMOPHORE_MAPS):
            if name not in single["flash"].maps:
                continue
            one = single["flash"].maps[name]
            sampled, seen = placement.sample(one.values, one.mask)
            errors = np.zeros_like(one.values) if one.stderr is None else one.stderr
            stderr, _ = placement.sample(errors, one.mask)
            both = sampled.reshape(-1), stderr.reshape(-1), seen.reshape(-1)
            rows += _row(name, "flash", [_flat(fused.maps[name], None), both], near, true[:, k])
    return rows


_Flat = tuple[Float64Array, Float64Array, BoolArray]


def _flat(skin_map: SkinMap, channel: int | None) -> _Flat:
    """Return values, standard errors and valid texels of a map, (N,)."""
    values = skin_map.values if channel is None else skin_map.values[..., channel]
    stderr = np.zeros_like(values)
    if skin_map.stderr is not None:
        stderr = skin_map.stderr if channel is None else skin_map.stderr[..., channel]
    parts = values.reshape(-1).astype(np.float64), stderr.reshape(-1).astype(np.float64)
    return *parts, skin_map.mask.reshape(-1)


def _match(
    position: SkinMap, true_position: SkinMap, known: BoolArray, values: Float64Array
) -> tuple[BoolArray, Float64Array]:
    """Return texels with ground truth, (N,), and its values there, (N, C)."""
    usable = known & intersect_valid(true_position)
    tree = cKDTree(true_position.values[usable])
    distance, index = tree.query(position.values.reshape(-1, 3), workers=1)
    near = position.mask.reshape(-1) & (distance < MAX_MATCH_DISTANCE_MM)
    return near, values[usable][index].astype(np.float64)


def _row(
    quantity: str, rig: str, pair: list[_Flat], near: BoolArray, true: Float64Array
) -> list[FusionAccuracy]:
    """Return the accuracy of both estimates on the texels where both are valid."""
    chosen = near & (true > 0.0)
    for values, _, valid in pair:
        chosen = chosen & valid & (values > 0.0)
    count = int(chosen.sum())
    if count < MIN_TEXELS:
        return []
    figures = []
    for values, stderr, _ in pair:
        error = np.log(values[chosen] / true[chosen])
        inside = np.abs(values - true)[chosen] <= stderr[chosen]
        figures.append((np.median(np.abs(error)), np.median(error), inside.mean()))
    (fused, fused_bias, fused_held), (single, bias, held) = figures
    numbers = fused, single, fused_bias, bias, fused_held, held
    return [FusionAccuracy(quantity, rig, count, *(float(number) for number in numbers))]
