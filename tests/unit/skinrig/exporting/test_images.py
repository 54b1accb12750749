"""Images as independent readers see them: orientation, values, ranges, color spaces."""

import hashlib

import cv2
import numpy as np
import OpenEXR
import pytest

from model.skin import SkinAppearance
from skinrig.errors import UnusableError
from skinrig.exporting.images import (
    CAMERA_SPACE,
    SRGB_SPACE,
    ExportImage,
    ImageFolder,
    encode_png_codes,
)
from skinrig.exporting.options import ExportSettings

SOURCE = SkinAppearance({}, "simulated")


@pytest.fixture
def ramp(rng):
    values = rng.uniform(-0.2, 3.0, (5, 7, 3)).astype(np.float32)
    values[0, 0] = (1.0, 2.0, 2.5)  # top left tells itself from the other corners
    return values


def test_exr_stores_values_exactly_with_unit(tmp_path, ramp):
    out = ImageFolder(tmp_path, ExportSettings(udim="dot"), SOURCE)
    name = out.write_exr(ExportImage(name="depth", values=ramp, unit="mm", what="of the patch"))
    assert name == "exr/depth.1001.exr"
    with OpenEXR.File(str(tmp_path / name)) as file:
        header = dict(file.header())
        pixels = file.channels()["RGB"].pixels.copy()
    assert (header["unit"], header["colorSpace"], header["comments"]) == (
        "mm",
        "data",
        "of the patch",
    )
    assert np.array_equal(pixels, ramp)
    assert "chromaticities" not in header


def test_only_linear_srgb_claims_srgb_primaries(tmp_path, ramp):
    out = ImageFolder(tmp_path, ExportSettings(), SOURCE)
    claims = {}
    for space in (SRGB_SPACE, CAMERA_SPACE):
        name = out.write_exr(
            ExportImage(name=space[:3].lower(), values=ramp, unit="1", space=space)
        )
        with OpenEXR.File(str(tmp_path / name)) as file:
            claims[space] = "chromaticities" in file.header()
    assert claims == {SRGB_SPACE: True, CAMERA_SPACE: False}


def test_16_bit_png_decodes_to_values_by_record(tmp_path, ramp):
    out = ImageFolder(tmp_path, ExportSettings(), SOURCE)
    name = out.write_png(ExportImage(name="depth", values=ramp, unit="mm", low=-0.5, high=3.5))
    told = out.records[name]
    codes = cv2.imread(str(tmp_path / name), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert codes.dtype == np.uint16
    decoded = told["low"] + (told["high"] - told["low"]) * codes / 65535.0
    assert np.abs(decoded - ramp).max() <= 0.5001 * told["step"]
    assert told["step"] == pytest.approx(4.0 / 65535)
    assert told["clipped_share"] == 0.0
    assert hashlib.sha256((tmp_path / name).read_bytes()).hexdigest() == told["sha256"]


def test_color_png_uses_srgb_curve_and_counts_clipping(tmp_path, ramp):
    out = ImageFolder(tmp_path, ExportSettings(), SOURCE)
    name = out.write_png(ExportImage(name="color", values=ramp, unit="1", space=SRGB_SPACE))
    codes = cv2.imread(str(tmp_path / name), cv2.IMREAD_UNCHANGED)[..., ::-1] / 65535.0
    linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    inside = (ramp >= 0.0) & (ramp <= 1.0)
    assert np.abs(linear - ramp)[inside].max() < 3e-5
    share = float(np.mean(~inside))
    assert share > 0.3
    assert out.records[name]["clipped_share"] == pytest.approx(share, abs=1e-3)


def test_value_range_uses_valid_values_only():
    values = np.array([[1.0, 2.0], [3.0, 1e6]])
    valid = np.array([[True, True], [True, False]])
    codes, told = encode_png_codes(ExportImage(name="a", values=values, unit="1", valid=valid))
    assert (told["low"], told["high"]) == (1.0, 3.0)
    assert codes.tolist() == [[0, 32768], [65535, 65535]]


def test_constant_or_invalid_map_is_coded_without_division():
    constant, told = encode_png_codes(ExportImage(name="a", values=np.full((2, 2), 4.0), unit="1"))
    assert (constant.tolist(), told["low"]) == ([[0, 0], [0, 0]], 4.0)
    nothing = ExportImage(
        name="a", values=np.full((2, 2), np.nan), unit="1", valid=np.zeros((2, 2), bool)
    )
    assert encode_png_codes(nothing)[1]["clipped_share"] == 0.0


@pytest.mark.parametrize(
    ("field", "value"), [("unit", "inch"), ("normal_y", "up"), ("udim", "1001")]
)
def test_invalid_option_value_is_refused_by_option_name(field, value):
    with pytest.raises(
        UnusableError, match=f"--{field.replace('_', '-')}: got '{value}', expected"
    ):
        ExportSettings(**{field: value})
