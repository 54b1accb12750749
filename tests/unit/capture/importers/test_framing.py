"""Crops and reduced photographs: the right pixels, their mean, and its noise."""

import cv2
import numpy as np
import pytest

from capture import raw
from capture.importers import PhotoError, import_photos, read_photo
from capture.importers.framing import Framing
from capture.importers.images import Photo
from capture.session import Session

WHITE, BLACK, GAIN_E_PER_DN, READ_E = 4000, 100.0, 2.0, 3.0
LEVELS = {"R": 900.0, "G": 2000.0, "B": 500.0}


def noisy_mosaic(rng, shape, pattern="GRBG"):
    """Return a raw photograph of one color with shot and read noise."""
    cell = np.reshape([LEVELS[c] for c in pattern], (2, 2))
    light = np.tile(cell, (shape[0] // 2, shape[1] // 2))
    electrons = rng.poisson(light * GAIN_E_PER_DN) + READ_E * rng.standard_normal(shape)
    frame = raw.RawFrame(
        cfa=np.rint(BLACK + electrons / GAIN_E_PER_DN).astype(np.uint16),
        pattern=pattern,
        black=(BLACK,) * 4,
        white=WHITE,
        neutral=(1.0, 1.0, 1.0),
        noise_profile=raw.noise_profile(GAIN_E_PER_DN, READ_E, black=BLACK, white=WHITE),
    )
    return Photo(frame, "raw")


def test_mean_of_blocks_has_stated_variance(rng):
    """Chi-square of 10,800 pixels: standard error 1.4 % of the variance, 4 of them 6 %."""
    photo = noisy_mosaic(rng, (720, 720))
    small = Framing(max_width_px=120).apply(photo, where="a").frame
    assert small.cfa.shape == (120, 120)
    image = raw.linear_rgb(small)
    for channel, color in enumerate("RGB"):
        values = image.rgb[..., channel] * (WHITE - BLACK)
        assert values.mean() == pytest.approx(LEVELS[color], rel=2e-3)
    ratio = np.mean((image.rgb - image.rgb.mean(axis=(0, 1))) ** 2) / np.mean(image.variance)
    assert ratio == pytest.approx(1.0, abs=0.06)
    large = raw.linear_rgb(photo.frame)  # without the factor 36 the same test fails
    assert np.mean(image.variance) * 36 == pytest.approx(np.mean(large.variance), rel=0.01)


def test_crop_selects_pixels_of_developed_image(tmp_path, rng):
    codes = rng.integers(0, 250, (60, 80, 3), dtype=np.uint8)
    assert cv2.imwrite(str(tmp_path / "a.png"), codes[..., ::-1])
    photo = read_photo(tmp_path / "a.png")
    part = Framing.parse("11,7,40,33", None).apply(photo, where="a")
    whole = raw.linear_rgb(photo.frame).rgb
    np.testing.assert_array_equal(raw.linear_rgb(part.frame).rgb, whole[7:40, 11:51])
    small = raw.linear_rgb(Framing.parse("11,7,40,33", 20).apply(photo, where="a").frame).rgb
    mean = whole[7:39, 11:51].reshape(16, 2, 20, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(small, mean, atol=1.0 / 65535)


def test_crop_of_raw_photograph_keeps_its_pattern(rng):
    photo = noisy_mosaic(rng, (64, 96))
    framed = Framing.parse("31,15,33,32", None).apply(photo, where="a")
    part = framed.frame
    assert framed.notes == ("cropped to 32 x 32 pixels at 30, 14",)
    np.testing.assert_array_equal(part.cfa, photo.frame.cfa[14:46, 30:62])
    assert part.pattern == "GRBG"


def test_saturated_photosite_saturates_its_block(rng):
    photo = noisy_mosaic(rng, (128, 128))
    photo.frame.cfa[4, 4] = WHITE
    image = raw.linear_rgb(Framing(max_width_px=32).apply(photo, where="a").frame)
    assert np.argwhere(~image.valid).tolist() == [[0, 0]]


def test_imported_session_has_framed_photograph(tmp_path, rng):
    codes = rng.integers(0, 250, (90, 120, 3), dtype=np.uint8)
    assert cv2.imwrite(str(tmp_path / "a.png"), codes[..., ::-1])
    done = import_photos(
        tmp_path / "a.png", out=tmp_path / "s", framing=Framing.parse("0,0,100,80", 50)
    )
    session = Session.open(tmp_path / "s")
    (record,) = session.frames()
    assert session.read(record).cfa.shape == (80, 100)
    assert {"cropped to 100 x 80 pixels at 0, 0", "each pixel is the mean of 2 x 2"} <= set(
        done.assumed
    )


@pytest.mark.parametrize(
    ("crop", "width", "expected"),
    [
        ("1,2,3", None, "expected X,Y,WIDTH,HEIGHT"),
        ("0,0,8,100", None, "sides of 16 or more"),
        ("-1,0,20,20", None, "got '-1,0,20,20'"),
        (None, 3, "width: got 3"),
    ],
)
def test_unreadable_framing_names_what_is_expected(crop, width, expected):
    with pytest.raises(PhotoError, match=expected):
        Framing.parse(crop, width)


@pytest.mark.parametrize(
    ("crop", "width", "expected"),
    [("100,0,40,40", None, "100,0,40,40"), ("0,0,100,20", 25, "25 x 5 px")],
)
def test_framing_outside_photograph_writes_nothing(tmp_path, rng, crop, width, expected):
    codes = rng.integers(0, 250, (90, 120, 3), dtype=np.uint8)
    assert cv2.imwrite(str(tmp_path / "a.png"), codes[..., ::-1])
    with pytest.raises(PhotoError, match=expected):
        import_photos(tmp_path / "a.png", out=tmp_path / "s", framing=Framing.parse(crop, width))
    assert not (tmp_path / "s").exists()
