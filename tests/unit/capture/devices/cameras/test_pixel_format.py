"""Bytes of raw pixel formats against values written out by the naming convention, bit by bit."""

import numpy as np
import pytest

from capture.devices.cameras import pixel_format

BAYER = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}
PACKED = ["Mono10p", "Mono12p", "Mono14p", "Mono10Packed", "Mono12Packed"]


def packed(values, bits, packing):
    """Return the bytes of values, written bit by bit as the convention draws them."""
    if packing == "Packed":
        out = []
        low = bits - 8
        for first, second in zip(values[::2], values[1::2], strict=True):
            middle = (int(first) % 2**low) | (int(second) % 2**low) << 4
            out += [int(first) >> low, middle, int(second) >> low]
        return bytes(out)
    if packing == "p":
        whole = sum(int(value) << (bits * place) for place, value in enumerate(values))
        return whole.to_bytes(len(values) * bits // 8, "little")
    return b"".join(int(value).to_bytes(1 if bits == 8 else 2, "little") for value in values)


@pytest.mark.parametrize("padding", [0, 3])
@pytest.mark.parametrize(
    "name", ["Mono8", "BayerRG8", "Mono10", "Mono12", "Mono14", "BayerGB16", *PACKED]
)
def test_every_value_comes_back_from_its_bytes(name, padding):
    format_ = pixel_format.parse_pixel_format(name)
    rng = np.random.default_rng(3)
    values = rng.integers(0, 2**format_.bits, (6, 8)).astype(np.uint16)
    values[0, :2] = 0, 2**format_.bits - 1
    data = b"".join(
        packed(line, format_.bits, format_.packing) + bytes([0xA5]) * padding for line in values
    )
    got = format_.unpack(data, width_px=8, height_px=6, padding_bytes=padding)
    assert got.dtype == np.uint16
    np.testing.assert_array_equal(got, values)
    # what follows the last line, and padding that it lacks, are no matter
    end = len(data) - padding
    np.testing.assert_array_equal(
        format_.unpack(data[:end], width_px=8, height_px=6, padding_bytes=padding), values
    )
    with pytest.raises(ValueError, match="bytes, expected"):
        format_.unpack(data[: end - 1], width_px=8, height_px=6, padding_bytes=padding)


# not Mono14p, for which harvesters 1.4.3 gives numpy.bitwise_or its third operand as the output
@pytest.mark.parametrize("name", [name for name in PACKED if name != "Mono14p"])
def test_packed_values_are_those_that_the_library_unpacks(name):
    pfnc = pytest.importorskip("harvesters.util.pfnc")
    data = np.random.default_rng(5).integers(0, 256, 840, dtype=np.uint8)
    format_ = pixel_format.parse_pixel_format(name)
    pixels = 840 * 8 // (12 if format_.packing == "Packed" else format_.bits)
    theirs = getattr(pfnc, name)().expand(data)
    np.testing.assert_array_equal(
        format_.unpack(data.tobytes(), width_px=pixels, height_px=1)[0], theirs
    )


def test_two_byte_numbers_may_be_big_endian():
    got = pixel_format.parse_pixel_format("Mono12").unpack(
        bytes([0x0A, 0xBC, 0x01, 0x02]), width_px=2, height_px=1, big_endian=True
    )
    assert got.tolist() == [[0xABC, 0x102]]


@pytest.mark.parametrize(("width", "name"), [(6, "Mono10p"), (3, "Mono12p"), (5, "Mono12Packed")])
def test_lines_that_end_within_a_group_are_refused(width, name):
    with pytest.raises(ValueError, match="multiple of"):
        pixel_format.parse_pixel_format(name).unpack(bytes(100), width_px=width, height_px=2)


@pytest.mark.parametrize("corner", BAYER)
def test_the_filter_array_is_that_of_the_name(corner):
    assert pixel_format.parse_pixel_format(f"Bayer{corner}12p").pattern == BAYER[corner]


@pytest.mark.parametrize(
    "name",
    [
        "",
        "RGB8",
        "YUV422_8",
        "Mono8s",
        "Mono9",
        "BayerRG8p",
        "Mono16p",
        "Mono14Packed",
        "BayerXX8",
        "Mono12c3p",
        "bayerrg12",
    ],
)
def test_other_formats_are_not_raw(name):
    assert pixel_format.parse_pixel_format(name) is None


def test_deepest_raw_format_is_chosen_gray_conversion_never():
    assert (
        pixel_format.choose_deepest_format(["Mono16", "BayerRG8", "BayerRG10p"]).name
        == "BayerRG10p"
    )
    assert (
        pixel_format.choose_deepest_format(["Mono12p", "Mono12", "Mono12Packed"]).name == "Mono12"
    )
    assert pixel_format.choose_deepest_format(["RGB8", "YUV422_8"]) is None
