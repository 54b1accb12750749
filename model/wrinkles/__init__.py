"""Wrinkles as signed blends of partial-derivative normal maps."""

from model.wrinkles.expressions import CLAMPS, JIMENEZ2011, WrinkleError
from model.wrinkles.masks import Masks, mask_stack, mask_textures, zone_strength
from model.wrinkles.partial_derivatives import (
    LIMIT,
    ZONES,
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
    "CLAMPS",
    "JIMENEZ2011",
    "LIMIT",
    "ZONES",
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
