"""Evaluate fused maps, and those of single rigs on the same texels, against ground truth."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from model.skin import SkinAppearance, SkinMap
from skinrig.appearances.contents import intersect_valid
from skinrig.appearances.texel_placement import TexelPlacement
from skinrig.arrays import BoolArray, Float64Array
from skinrig.fusing.filled_normals import MEASURED_SUFFIX
from skinrig.fusing.maps import OWN_SUFFIX

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
    own_coverage
        Fraction of the fusion's errors less their median over the face within the standard errors
        of texels alone; NaN without such a map.
    common_sigmas
        Median error of the fusion over its standard error common to the face; NaN likewise.
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
    own_coverage: float = math.nan
    common_sigmas: float = math.nan


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
            own = _own_stderr(fused, "r_d", c)
            rows += _row(f"r_d {channel}", "dome", pair, near, true[:, c], own)
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
            pair = [_flat(fused.maps[name], None), both]
            rows += _row(name, "flash", pair, near, true[:, k], _own_stderr(fused, name, None))
    return rows


@dataclass(frozen=True, slots=True)
class FilledAccuracy:
    """Accuracy of a quantity on texels without a measurement, which the fusion filled.

    Attributes
    ----------
    quantity
        Map, with its channel.
    share
        Filled texels over all of the map.
    texels
        Number of filled texels with a ground truth.
    error
        Median absolute error of the logarithm.
    coverage
        Fraction of true values in the 68 % interval.
    """

    quantity: str
    share: float
    texels: int
    error: float
    coverage: float


def compare_filled(
    fused: SkinAppearance, truths: Mapping[str, SkinAppearance]
) -> list[FilledAccuracy]:
    """Compare filled texels of R_d, melanin and blood with the ground truth.

    Parameters
    ----------
    fused, truths
        As of `compare_fused`.
    """
    rows = []
    for name in ("r_d", *CHROMOPHORE_MAPS):
        measured = fused.maps.get(f"{name}{MEASURED_SUFFIX}")
        if measured is None:
            continue
        truth = truths["dome" if name == "r_d" else "flash"]
        place = truth.maps["position" if name == "r_d" else "position_mm"]
        true_map = truth.maps[name]
        flat = true_map.values.reshape(*true_map.mask.shape, -1).astype(np.float64)
        known = true_map.mask & (flat > 0.0).all(axis=-1)
        near, true = _match(fused.maps["position"], place, known, flat)
        filled = near & (measured.values.reshape(-1) == 0.0) & measured.mask.reshape(-1)
        if (count := int(filled.sum())) < MIN_TEXELS:
            continue
        share = float(np.mean(measured.values[measured.mask] == 0.0))
        for c in range(true.shape[1]):
            values, stderr, _ = _flat(fused.maps[name], c if true.shape[1] > 1 else None)
            off = np.abs(values - true[:, c])[filled]
            error = float(np.median(np.abs(np.log(values[filled] / true[filled, c]))))
            held = float(np.mean(off <= stderr[filled]))
            label = f"{name} {CHANNEL_NAMES[c]}" if true.shape[1] > 1 else name
            rows.append(FilledAccuracy(label, share, count, error, held))
    return rows


def _own_stderr(fused: SkinAppearance, name: str, channel: int | None) -> Float64Array | None:
    """Return standard errors of texels alone, (N,); None without a map of them."""
    found = fused.maps.get(f"{name}{OWN_SUFFIX}")
    return None if found is None else _flat(found, channel)[0]


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
    near = position.mask.reshape(-1).copy()
    # without the bound, the search for points far from the face visits most of the tree
    bound = {"distance_upper_bound": MAX_MATCH_DISTANCE_MM}
    distance, index = tree.query(position.values.reshape(-1, 3)[near], workers=1, **bound)
    found = distance < MAX_MATCH_DISTANCE_MM
    near[near] = found
    true = np.zeros((near.size, values.shape[-1]))
    true[near] = values[usable][index[found]]
    return near, true


def _row(
    quantity: str,
    rig: str,
    pair: list[_Flat],
    near: BoolArray,
    true: Float64Array,
    own_stderr: Float64Array | None,
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
    numbers = [fused, single, fused_bias, bias, fused_held, held]
    if own_stderr is not None:
        values, stderr, _ = pair[0]
        own = own_stderr[chosen] / values[chosen]
        error = np.log(values[chosen] / true[chosen])
        common = np.square(stderr[chosen] / values[chosen]) - np.square(own)
        typical = math.sqrt(max(float(np.median(common)), 1e-12))
        contrast = np.abs(error - np.median(error)) <= own
        numbers += [float(contrast.mean()), float(np.median(error)) / typical]
    return [FusionAccuracy(quantity, rig, count, *(float(number) for number in numbers))]
