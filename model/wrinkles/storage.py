"""Compute the size of stored wrinkle maps and masks, and the error of their encodings.

Examples
--------
The paper's figure of 96 KB: a block-compressed 256 x 256 map and two 64 x 64 masks, times 4/3
for their mip-maps; the base map, which every face has, is not counted.

>>> paper_footprint().total_bytes / 1024
96.0

References
----------
Jimenez, Echevarria, Oat, Gutierrez 2011, Practical and Realistic Facial Wrinkles Animation,
GPU Pro 2, chapter 1 (section 1.3). ISBN 978-1-56881-718-7
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np

from model.arrays import FloatArray
from model.checks import Checks
from model.wrinkles import block_compression as blocks
from model.wrinkles import partial_derivatives as wrinkles
from model.wrinkles.expressions import WrinkleError
from model.wrinkles.masks import Masks, mask_stack, mask_textures

MapEncoding: TypeAlias = Literal["float32", "float16", "unit8", "bc5"]
MaskEncoding: TypeAlias = Literal["float32", "float16", "unit8", "bc3"]

MAP_BYTES: Mapping[str, int] = MappingProxyType({"float32": 8, "float16": 4, "unit8": 2, "bc5": 1})
"""Bytes per texel of two derivatives; "unit8" is 8 bits of [0, 1], "bc5" 16 bytes per block."""
MASK_BYTES: Mapping[str, int] = MappingProxyType(
    {"float32": 16, "float16": 8, "unit8": 4, "bc3": 1}
)
"""Bytes per texel of four zones."""
MIP_FACTOR = 4 / 3
"""Size of all mip levels over the first, in the limit of many levels."""
WRINKLE_SIDE, MASK_SIDE, BASE_SIDE = 256, 64, 2048
"""The paper's resolutions."""


@dataclass(frozen=True, slots=True)
class Footprint:
    """Bytes of a face's wrinkles without its base map.

    Attributes
    ----------
    wrinkle_bytes, mask_bytes : int
        Of the first mip levels.
    mip_factor : float
        All levels over the first; 1 without mip-maps.
    """

    wrinkle_bytes: int
    mask_bytes: int
    mip_factor: float

    @property
    def total_bytes(self) -> float:
        """Return the bytes of all textures with their mip-maps."""
        return (self.wrinkle_bytes + self.mask_bytes) * self.mip_factor


def texture_bytes(shape: tuple[int, int], bytes_per_texel: int, *, in_blocks: bool = False) -> int:
    """Return the bytes of one level; partial 4 x 4 blocks count as whole ones."""
    h, w = shape
    if in_blocks:
        rows, columns = blocks.block_grid_shape(shape)
        h, w = rows * blocks.BLOCK_SIDE, columns * blocks.BLOCK_SIDE
    return h * w * bytes_per_texel


def footprint(
    wrinkle_shape: tuple[int, int],
    mask_shape: tuple[int, int],
    *,
    maps: MapEncoding = "bc5",
    masks: MaskEncoding = "bc3",
    zones: int = 8,
    mip_maps: bool = True,
) -> Footprint:
    """Return the bytes of one wrinkle map and its masks.

    Parameters
    ----------
    wrinkle_shape, mask_shape : (int, int)
        Rows and columns.
    maps, masks : str
        Keys of `MAP_BYTES` and `MASK_BYTES`.
    zones : int
        At least 1; four per mask texture.
    mip_maps : bool

    Raises
    ------
    WrinkleError
        For an unknown encoding, or a size or number below 1.
    """
    for name, encoding, known in (("maps", maps, MAP_BYTES), ("masks", masks, MASK_BYTES)):
        Checks(WrinkleError).choice(name, encoding, known)
    sizes = (*wrinkle_shape, *mask_shape, zones)
    Checks(WrinkleError).within("wrinkle_shape, mask_shape, zones", sizes, "[1, inf)")
    textures = -(-zones // 4)
    return Footprint(
        texture_bytes(wrinkle_shape, MAP_BYTES[maps], in_blocks=maps == "bc5"),
        textures * texture_bytes(mask_shape, MASK_BYTES[masks], in_blocks=masks == "bc3"),
        MIP_FACTOR if mip_maps else 1.0,
    )


def paper_footprint() -> Footprint:
    """Return the paper's footprint: 64 KB of map and 8 KB of masks, times 4/3."""
    return footprint((WRINKLE_SIDE, WRINKLE_SIDE), (MASK_SIDE, MASK_SIDE))


def round_trip_map(derivatives: FloatArray, encoding: MapEncoding) -> FloatArray:
    """Return derivatives after encoding to a texture and decoding.

    Parameters
    ----------
    derivatives : ndarray, shape (h, w, 2)
        "unit8" and "bc5" are limited to [-1, 1]; clamp larger values with `wrinkles.encode`, or
        scale map and table.
    encoding : {"float32", "float16", "unit8", "bc5"}

    Returns
    -------
    ndarray, shape (h, w, 2), float32
    """
    Checks(WrinkleError).choice("maps", encoding, MAP_BYTES)
    d = np.asarray(derivatives)
    if encoding == "float16":
        limit = float(np.finfo(np.float16).max)
        Checks(WrinkleError).within("derivatives", d, f"[-{limit}, {limit}]")
        d = d.astype(np.float16)
    elif encoding == "unit8":
        d = wrinkles.from_unit(_eight_bits(wrinkles.to_unit(d)))
    elif encoding == "bc5":
        packed = blocks.encode_bc5(wrinkles.to_unit(d))
        d = wrinkles.from_unit(blocks.decode_bc5(packed, d.shape[:2]))
    return d.astype(np.float32)


def round_trip_masks(masks: Masks, encoding: MaskEncoding) -> FloatArray:
    """Return masks (Z, h, w), float32, after encoding to RGBA textures and decoding.

    "unit8" and "bc3" are limited to [0, 1]; the others to the range of their type.

    Raises
    ------
    WrinkleError
        For an unknown encoding, and masks outside its range.
    """
    Checks(WrinkleError).choice("masks", encoding, MASK_BYTES)
    stack = mask_stack(masks)
    some = "[0, 1]"
    if encoding in ("float16", "float32"):
        limit = float(np.finfo(encoding).max)
        some = f"[-{limit}, {limit}]"
    Checks(WrinkleError).within(f"masks as {encoding}", stack, some)
    if encoding == "float16":
        stack = stack.astype(np.float16)
    elif encoding == "unit8":
        stack = _eight_bits(stack)
    elif encoding == "bc3":
        shape = stack.shape[1:]
        textures = [
            blocks.decode_bc3(blocks.encode_bc3(texture), (shape[0], shape[1]))
            for texture in mask_textures(stack)
        ]
        stack = mask_stack(textures)[: len(stack)]
    return stack.astype(np.float32)


def _eight_bits(values: FloatArray) -> FloatArray:
    return np.rint(values * 255.0) / 255.0
