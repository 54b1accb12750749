"""Wrinkles as signed blends of partial-derivative normal maps."""

from model.wrinkles.expressions import JIMENEZ2011_TABLE, ZONE_SUM_LIMITS, WrinkleError
from model.wrinkles.masks import Masks, mask_stack, mask_textures, zone_strength
from model.wrinkles.partial_derivatives import (
    MAX_DERIVATIVE,
    ZONE_NAMES,
    Encoding,
    Layer,
    combine,
    combine_layers,
    decode,
    encode,
    encoding_report,
    from_unit,
    to_unit,
    widened,
)

__all__ = [
    "JIMENEZ2011_TABLE",
    "MAX_DERIVATIVE",
    "ZONE_NAMES",
    "ZONE_SUM_LIMITS",
    "Encoding",
    "Layer",
    "Masks",
    "WrinkleError",
    "combine",
    "combine_layers",
    "decode",
    "encode",
    "encoding_report",
    "from_unit",
    "mask_stack",
    "mask_textures",
    "to_unit",
    "widened",
    "zone_strength",
]
