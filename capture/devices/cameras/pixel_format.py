"""Raw pixel formats of industrial cameras, and the conversion of their bytes to numbers.

Names and layouts are those of the Pixel Format Naming Convention (EMVA, PFNC 2.4): a bare number of
bits is one pixel in one or two bytes, ``p`` is packed without gaps from the lowest bit on,
``Packed`` is GigE Vision's older packing of two pixels in three bytes.
"""

import math
import re
from dataclasses import dataclass

import numpy as np

from capture.arrays import UInt8Array, UInt16Array

_FORMAT_NAME = re.compile(r"(Mono|Bayer(?:RG|GR|GB|BG))(8|10|12|14|16)(p|Packed|)")
_PACKED_BITS = {"p": (10, 12, 14), "Packed": (10, 12)}
_CFA_PATTERNS = {
    "BayerRG": "RGGB",
    "BayerGR": "GRBG",
    "BayerGB": "GBRG",
    "BayerBG": "BGGR",
    "Mono": "MONO",
}


@dataclass(frozen=True, slots=True)
class PixelFormat:
    """Raw format with one number per pixel.

    Attributes
    ----------
    name
        As the naming convention and the camera write it, "BayerRG12p".
    pattern
        Color filter array, "RGGB" and so on, or "MONO".
    bits
        Bits per pixel; the largest value is 2**bits - 1.
    packing
        "p", "Packed", or empty: one pixel in whole bytes.
    """

    name: str
    pattern: str
    bits: int
    packing: str

    def line_bytes(self, width_px: int) -> int:
        """Return the length of a line, bytes.

        Raises
        ------
        ValueError
            When a line of that width does not end with a whole group of packed pixels: the
            convention does not define where the next line begins.
        """
        if not self.packing:
            return width_px * (1 if self.bits == 8 else 2)
        # the older packing stores the low two bits of a 10-bit pixel in four bits
        bits = 12 if self.packing == "Packed" else self.bits
        group = 8 // math.gcd(bits, 8)
        if width_px % group:
            raise ValueError(
                f"{self.name}: got lines of {width_px} pixels, expected a multiple of {group}; set "
                "the camera's Width to one, or use a format that is not packed"
            )
        return width_px * bits // 8

    def unpack(
        self,
        data: bytes | memoryview,
        *,
        width_px: int,
        height_px: int,
        padding_bytes: int = 0,
        big_endian: bool = False,
    ) -> UInt16Array:
        """Return the sensor values of a frame's bytes.

        Parameters
        ----------
        data
            Bytes as the camera sent them; what follows the last line is ignored.
        width_px, height_px
            Size of the frame.
        padding_bytes
            Bytes after each line.
        big_endian
            Whether two-byte numbers have their high byte first.

        Returns
        -------
        (height_px, width_px) uint16
            DN, right-aligned, a copy.

        Raises
        ------
        ValueError
            When there are too few bytes, or lines end within a group of packed pixels.

        Examples
        --------
        >>> parse_pixel_format("Mono12p").unpack(bytes([0x21, 0x43, 0x65]), width_px=2,
        ...     height_px=1).tolist()
        [[801, 1620]]
        >>> [hex(value) for value in (801, 1620)]
        ['0x321', '0x654']
        """
        line = self.line_bytes(width_px)
        stride = line + padding_bytes
        needed = height_px * stride - padding_bytes
        if len(data) < needed:
            raise ValueError(
                f"{self.name}: got {len(data)} bytes, expected {needed} for {width_px} x "
                f"{height_px} pixels"
            )
        flat = np.frombuffer(data, np.uint8, count=needed)
        lines = np.lib.stride_tricks.as_strided(
            flat, (height_px, line), (stride, 1), writeable=False
        )
        out = np.empty((height_px, width_px), np.uint16)
        if not self.packing:
            wide = ">u2" if big_endian else "<u2"
            out[:] = lines if self.bits == 8 else np.ascontiguousarray(lines).view(wide)
        elif self.packing == "Packed":
            low_bits = self.bits - 8
            mask = (1 << low_bits) - 1
            middle = lines[:, 1::3]
            out[:, 0::2] = lines[:, 0::3].astype(np.uint16) << low_bits | middle & mask
            out[:, 1::2] = lines[:, 2::3].astype(np.uint16) << low_bits | (middle >> 4) & mask
        else:
            self._unpack_gapless(lines, out)
        return out

    def _unpack_gapless(self, lines: UInt8Array, out: UInt16Array) -> None:
        group_px = 8 // math.gcd(self.bits, 8)
        group_bytes = group_px * self.bits // 8
        for pixel in range(group_px):
            first, shift = divmod(pixel * self.bits, 8)
            count = -(-(shift + self.bits) // 8)
            value = np.zeros((lines.shape[0], out.shape[1] // group_px), np.uint32)
            for byte in range(count):
                value |= lines[:, first + byte :: group_bytes].astype(np.uint32) << (8 * byte)
            out[:, pixel::group_px] = (value >> shift) & ((1 << self.bits) - 1)


def parse_pixel_format(name: str) -> PixelFormat | None:
    """Return the raw format with a name, None for a name of any other format than raw 8 to 16 bits.

    Examples
    --------
    >>> parse_pixel_format("BayerGB10Packed")
    PixelFormat(name='BayerGB10Packed', pattern='GBRG', bits=10, packing='Packed')
    >>> parse_pixel_format("RGB8") is None
    True
    """
    match = _FORMAT_NAME.fullmatch(name)
    if match is None:
        return None
    kind, bits, packing = match[1], int(match[2]), match[3]
    if packing and bits not in _PACKED_BITS[packing]:
        return None
    return PixelFormat(name, _CFA_PATTERNS[kind], bits, packing)


def choose_deepest_format(names: list[str]) -> PixelFormat | None:
    """Return the raw format with the most bits, of a color filter array where the camera has one.

    A color camera offers "Mono8" too, as its own conversion. Among formats with equal bits, the
    unpacked one is returned.

    Examples
    --------
    >>> choose_deepest_format(["Mono8", "Mono16", "BayerRG8", "BayerRG12p", "BayerRG12",
    ...     "RGB8"]).name
    'BayerRG12'
    """
    found = [format_ for name in names if (format_ := parse_pixel_format(name)) is not None]
    return max(
        found, key=lambda f: (f.pattern != "MONO", f.bits, f.packing == "", f.name), default=None
    )
