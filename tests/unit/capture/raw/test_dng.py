"""Raw frames: bits kept through independent readers, damage named, noise propagated."""

from datetime import UTC, datetime

import numpy as np
import pytest
import rawpy
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from capture import raw
from capture.raw import RawError, RawFrame
from capture.raw.thumbnail import draw_thumbnail

BAYER = ("RGGB", "BGGR", "GRBG", "GBRG")
MATRIX = np.array([[0.7123, -0.1019, -0.0547], [-0.4321, 1.2345678, 0.2109], [-0.1, 0.23, 0.61]])
BLACK = {"R": 256.0, "G": 257.5, "B": 259.0}


@pytest.fixture
def cfa(rng):
    """All 16 bits, both extremes included."""
    values = rng.integers(0, 65536, (96, 128), dtype=np.uint16)
    values[0, 0], values[-1, -1], values[0, -1] = 0, 65535, 65535
    return values


def encode(cfa, pattern, **changes):
    mono = pattern == "MONO"
    description = {
        "pattern": pattern,
        "black": (256.0,) if mono else tuple(BLACK.get(c, 0.0) for c in pattern),
        "white": 3900,
        "exposure_s": 1 / 125,
        "iso": 100,
        "camera_model": "skinrig reference camera",
        "camera_serial": "SR-0001",
        "color_matrix": None if mono else MATRIX,
        "color_illuminant": "D50",
        "neutral": None if mono else (0.5, 1.0, 0.625),
        "noise_profile": (1.25e-5, 3.5e-8),
        "f_number": 11.0,
        "focal_mm": 87.0,
        "captured_at": datetime(2026, 11, 21, 3, 4, 5, 678, tzinfo=UTC),
        "step_id": "S001",
        "session_id": "b1946ac9",
        "light": {"polarizer": "crossed", "power": 0.5, "token": 7, "analyzer_deg": 90.0},
    }
    return raw.encode_dng(cfa, **(description | changes))


@pytest.fixture
def dng(tmp_path, cfa):
    def write(pattern="RGGB", cfa=cfa, **changes):
        file = tmp_path / "frame.dng"
        file.write_bytes(encode(cfa, pattern, **changes))
        return file

    return write


# --- written bits ---------------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", [*BAYER, "MONO"])
def test_libraw_reads_every_bit_pattern_and_level(dng, cfa, pattern):
    with rawpy.imread(str(dng(pattern, black=256.0))) as frame:
        np.testing.assert_array_equal(frame.raw_image_visible, cfa)
        assert frame.white_level == 3900
        assert set(frame.black_level_per_channel) == {256}
        if pattern != "MONO":
            codes = frame.raw_colors_visible[:2, :2].ravel()
            assert "".join("RGBG"[c] for c in codes) == pattern
            np.testing.assert_allclose(frame.camera_whitebalance[:3], (2.0, 1.0, 1.6), rtol=1e-6)


@pytest.mark.parametrize("pattern", [*BAYER, "MONO"])
def test_tifffile_reads_every_bit(dng, cfa, pattern):
    np.testing.assert_array_equal(tifffile.imread(dng(pattern)), cfa)


@pytest.mark.parametrize("pattern", [*BAYER, "MONO"])
def test_adobe_sdk_reads_every_bit_and_settings(dng, cfa, pattern):
    dngpy = pytest.importorskip("dngpy", reason="the Adobe SDK reader comes with the dev extra")
    frame = dngpy.Dng(str(dng(pattern)))
    np.testing.assert_array_equal(frame.raw_pixels.squeeze(), cfa)
    metadata = frame.metadata
    assert (metadata.iso, metadata.exposure_time, metadata.f_number) == (100, 0.008, 11.0)
    assert metadata.date_time_original.startswith("2026-11-21T03:04:05")
    assert metadata.is_monochrome == (pattern == "MONO")
    if pattern != "MONO":
        assert frame.get_bayer_pattern() == pattern
        np.testing.assert_allclose(frame.get_white_balance(), (0.5, 1.0, 0.625))


@pytest.mark.parametrize("pattern", [*BAYER, "MONO"])
def test_libraw_extracts_thumbnail_of_every_pattern(dng, pattern):
    """A red surface with a darker lower right quarter, in light whose neutral is (.5, 1, .625)."""
    levels = {"R": 0.4, "G": 0.1, "B": 0.05}
    if pattern == "MONO":
        cell = np.full((2, 2), 0.4)
    else:
        cell = np.reshape([levels[c] for c in pattern], (2, 2))
    share = np.tile(cell, (48, 64))
    share[48:, 64:] /= 4.0
    file = dng(pattern, cfa=np.round(256 + share * 3000).astype(np.uint16), black=256.0, white=3256)
    with rawpy.imread(str(file)) as frame:
        found = frame.extract_thumb().data / 255.0
    assert found.shape == (12, 16, 3)
    wanted = (0.4, 0.4, 0.4) if pattern == "MONO" else (0.8, 0.1, 0.08)
    np.testing.assert_allclose(found[3, 4] ** 2.2, wanted, atol=0.01)
    np.testing.assert_allclose(found[9, 12] ** 2.2, np.divide(wanted, 4.0), atol=0.005)
    np.testing.assert_array_equal(found[9, 4], found[3, 4])


def test_thumbnail_grows_file_by_few_percent(dng, cfa):
    plain = cfa[:63, :].nbytes
    assert dng("MONO", cfa=cfa[:63]).stat().st_size - plain < 2000
    with (
        rawpy.imread(str(dng("MONO", cfa=cfa[:63]))) as frame,
        pytest.raises(rawpy.LibRawNoThumbnailError),
    ):
        frame.extract_thumb()
    large = np.zeros((2000, 3000), np.uint16)
    assert dng(cfa=large).stat().st_size < 1.006 * large.nbytes


def test_very_long_frame_has_no_thumbnail(dng):
    """A block of 76 photosites is wider than the 64 of the frame."""
    long = np.zeros((64, 12000), np.uint16)
    frame = RawFrame(cfa=long, pattern="MONO", black=(100.0,), white=1100)
    assert draw_thumbnail(frame) is None
    with (
        rawpy.imread(str(dng("MONO", cfa=long))) as frame,
        pytest.raises(rawpy.LibRawNoThumbnailError),
    ):
        frame.extract_thumb()


@pytest.mark.parametrize("pattern", [*BAYER, "MONO"])
def test_our_reader_returns_everything_that_was_written(dng, cfa, pattern):
    file = dng(pattern)
    frame = raw.read(file)
    np.testing.assert_array_equal(frame.cfa, cfa)
    mono = pattern == "MONO"
    assert frame.pattern == pattern
    assert frame.black == ((256.0,) if mono else tuple(BLACK[c] for c in pattern))
    assert (frame.white, frame.iso, frame.exposure_s) == (3900, 100, 0.008)
    assert (frame.f_number, frame.focal_mm) == (11.0, 87.0)
    assert (frame.camera_model, frame.camera_serial) == ("skinrig reference camera", "SR-0001")
    assert frame.noise_profile == (1.25e-5, 3.5e-8)
    assert frame.captured_at == datetime(2026, 11, 21, 3, 4, 5, 678, tzinfo=UTC)
    assert (frame.step_id, frame.session_id) == ("S001", "b1946ac9")
    assert frame.light == {"polarizer": "crossed", "power": 0.5, "token": 7, "analyzer_deg": 90.0}
    assert frame.color_illuminant == "D50" or mono
    assert frame.path == str(file)


def test_tags_contain_color_matrix_noise_and_serial(dng):
    with tifffile.TiffFile(dng()) as file:
        tags = file.pages[0].tags
        pairs = np.reshape(tags["ColorMatrix1"].value, (-1, 2))
        np.testing.assert_allclose(pairs[:, 0] / pairs[:, 1], MATRIX.ravel(), rtol=1e-15)
        assert tags["CalibrationIlluminant1"].value == 23  # D50, EXIF LightSource
        assert tags["NoiseProfile"].value == (1.25e-5, 3.5e-8)
        assert tags["CameraSerialNumber"].value == "SR-0001"
        assert "GPSTag" not in tags


def test_a_matrix_read_back_is_the_matrix_written(dng):
    np.testing.assert_allclose(raw.read(dng()).color_matrix, MATRIX, rtol=1e-15)


def test_unknown_fields_read_back_as_unknown(dng):
    unknown = {
        "color_matrix": None,
        "neutral": None,
        "noise_profile": None,
        "exposure_s": None,
        "iso": None,
        "captured_at": None,
        "camera_model": "",
        "camera_serial": "",
    }
    frame = raw.read(dng(**unknown))
    assert {key: getattr(frame, key) for key in unknown} == unknown


def test_equal_frames_have_equal_bytes_unequal_light_differs(cfa):
    assert encode(cfa, "RGGB") == encode(cfa.copy(), "RGGB")
    assert encode(cfa, "RGGB") != encode(cfa, "RGGB", light={"polarizer": "parallel"})


def test_encoding_leaves_the_frame_alone(cfa):
    before = cfa.copy()
    encode(cfa[:, ::-1], "RGGB")
    np.testing.assert_array_equal(cfa, before)


@pytest.mark.parametrize("shape", [(2, 2), (2, 64), (130, 66)])
def test_small_and_unusually_shaped_frames_round_trip(tmp_path, rng, shape):
    values = rng.integers(0, 65536, shape, dtype=np.uint16)
    raw.write_dng(tmp_path / "a.dng", values, pattern="GRBG", black=0, white=65535)
    np.testing.assert_array_equal(raw.read(tmp_path / "a.dng").cfa, values)
    assert [file.name for file in tmp_path.iterdir()] == ["a.dng"]


@settings(max_examples=60, deadline=None)
@given(
    st.dictionaries(
        st.text(max_size=8), st.none() | st.booleans() | st.floats(allow_nan=False) | st.text()
    )
)
def test_any_description_of_the_light_survives_the_xmp(light):
    values = np.zeros((4, 4), np.uint16)
    if any(isinstance(v, float) and not np.isfinite(v) for v in light.values()):
        with pytest.raises(RawError, match="light"):
            raw.encode_dng(values, pattern="RGGB", black=0, white=9, light=light)
        return
    blob = raw.encode_dng(values, pattern="RGGB", black=0, white=9, light=light)
    assert raw.decode(memoryview(blob)).light == light


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"pattern": "RGBG"}, "pattern"),
        ({"pattern": "XTRANS"}, "pattern"),
        ({"black": (1.0, 2.0)}, "black"),
        ({"black": float("nan")}, "black"),
        ({"black": 4000.0}, "black"),
        ({"white": 70_000}, "white"),
        ({"exposure_s": 0.0}, "exposure_s"),
        ({"exposure_s": float("inf")}, "exposure_s"),
        ({"iso": -1}, "iso"),
        ({"color_matrix": np.full((3, 3), np.nan)}, "color_matrix"),
        ({"color_illuminant": "F2"}, "color_illuminant"),
        ({"noise_profile": (-1.0, 0.0)}, "noise_profile"),
        ({"captured_at": datetime(2026, 1, 1)}, "captured_at"),
        ({"camera_serial": "SR\n1"}, "camera_serial"),
        ({"light": {"power": float("nan")}}, "light"),
        ({"light": {"a": "x" * 20_000}}, "light"),
    ],
)
def test_unwritable_dng_is_refused_by_field_name(cfa, changes, field):
    with pytest.raises(RawError) as caught:
        encode(cfa, **({"pattern": "RGGB"} | changes))
    assert field in {fault.path for fault in caught.value.faults}


@pytest.mark.parametrize("bad", [np.zeros((3, 4), np.uint16), np.zeros((4, 4)), np.zeros(4, "u2")])
def test_frame_that_is_not_mosaic_is_refused(bad):
    with pytest.raises(RawError, match="cfa"):
        raw.encode_dng(bad, pattern="RGGB", black=0, white=9)


# --- broken files ---------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.001, 0.01, 0.05, 0.5, 0.999, 1 - 1e-4])
def test_a_truncated_dng_is_named_with_its_sizes(dng, share):
    file = dng()
    blob = file.read_bytes()
    file.write_bytes(blob[: int(len(blob) * share)])
    with pytest.raises(RawError) as caught:
        raw.read(file)
    assert str(file) in str(caught.value)
    assert "got" in str(caught.value)
    assert "expected" in str(caught.value)


def test_every_flipped_pixel_bit_is_found(dng, rng):
    file = dng()
    blob = file.read_bytes()
    first = len(blob) - 96 * 128 * 2
    for _ in range(50):
        broken = bytearray(blob)
        broken[rng.integers(first, len(blob))] ^= 1 << int(rng.integers(8))
        with pytest.raises(RawError, match="damaged pixels"):
            raw.decode(memoryview(bytes(broken)), where="a.dng")


def test_flipped_header_bit_never_gives_wrong_pixel(dng, cfa, rng):
    blob = dng().read_bytes()
    head = len(blob) - 96 * 128 * 2
    for _ in range(300):
        broken = bytearray(blob)
        broken[rng.integers(0, head)] ^= 1 << int(rng.integers(8))
        try:
            frame = raw.decode(memoryview(bytes(broken)), where="a.dng")
        except RawError:
            continue
        assert frame.cfa.tobytes() == cfa.tobytes()


def patched(blob, tag, value):
    """Return the file with the 32-bit value of a tag of the first directory replaced."""
    count = int.from_bytes(blob[8:10], "little")
    broken = bytearray(blob)
    for at in range(10, 10 + 12 * count, 12):
        if int.from_bytes(blob[at : at + 2], "little") == tag:
            broken[at + 8 : at + 12] = value.to_bytes(4, "little")
    assert bytes(broken) != blob
    return bytes(broken)


@pytest.mark.parametrize(
    ("tag", "value", "reason"),
    [
        (256, 2**32 - 1, "size"),
        (257, 10**9, "size"),
        (279, 12, "pixel bytes"),
        (273, 2**31, "size"),
        (258, 12, "bits"),
        (259, 7, "bits, compression"),
        (34665, 2**31, "directory"),
    ],
)
def test_absurd_header_numbers_are_refused_before_allocation(dng, tag, value, reason):
    file = dng()
    file.write_bytes(patched(file.read_bytes(), tag, value))
    with pytest.raises(RawError, match=reason):
        raw.read(file)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"II*\0",
        b"II*\0\x08\0\0\0",
        b"II*\0\xff\xff\xff\xff",
        b"MM\0*\0\0\0\x08\0\0",
        b"\x89PNG\r\n\x1a\n" + bytes(200),
        b"\xff\xd8\xff\xe0" + bytes(500),
        b"not a picture",
        bytes(4096),
    ],
)
@pytest.mark.parametrize("name", ["a.dng", "a.nef"])
def test_file_that_is_not_raw_gives_single_error(tmp_path, name, content):
    file = tmp_path / name
    file.write_bytes(content)
    with pytest.raises(RawError) as caught:
        raw.read(file)
    assert str(file) in str(caught.value)


def test_missing_file_and_folder_give_single_error(tmp_path):
    with pytest.raises(RawError, match="is missing"):
        raw.read(tmp_path / "none.dng")
    with pytest.raises(RawError, match="cannot be read"):
        raw.read(tmp_path)


def test_an_entity_in_the_xmp_is_not_expanded(dng):
    file = dng()
    blob = file.read_bytes()
    start = blob.index(b"<x:xmpmeta")
    bomb = b'<!DOCTYPE a [<!ENTITY a "b">]>'
    file.write_bytes(blob[:start] + bomb + blob[start + len(bomb) :])
    with pytest.raises(RawError, match="XMP"):
        raw.read(file)


# --- foreign files --------------------------------------------------------------------------------


def test_foreign_dng_reads_known_values(test_data):
    frame = raw.read(test_data / "raw" / "synth_pidng.dng")
    row, column = np.mgrid[:256, :320]
    np.testing.assert_array_equal(frame.cfa, 512 + 20 * row + 10 * column)
    assert (frame.pattern, frame.black, frame.white) == ("RGGB", (512.0,) * 4, 16383)
    np.testing.assert_allclose(frame.neutral, (0.5, 1.0, 2 / 3), rtol=1e-6)
    # LibRaw's own matrix of a DNG is zero; the one in the tags is the identity
    np.testing.assert_array_equal(frame.color_matrix, np.eye(3))
    assert frame.step_id == ""


def test_a_camera_raw_file_is_read(test_data):
    frame = raw.read(test_data / "raw" / "RAW_KODAK_DC50.KDC")
    assert frame.cfa.shape == (512, 768)
    assert frame.pattern == "GRBG"
    assert frame.camera_model.endswith("DC50 Zoom Camera")
    assert frame.color_matrix is None
    assert frame.noise_profile is None
    assert raw.linear_rgb(frame, gain=1.0, read_noise=1.0).rgb.shape == (256, 384, 3)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_truncated_camera_raw_file_gives_single_error(test_data, tmp_path, share):
    blob = (test_data / "raw" / "RAW_KODAK_DC50.KDC").read_bytes()
    file = tmp_path / "cut.kdc"
    file.write_bytes(blob[: int(len(blob) * share)])
    with pytest.raises(RawError):
        raw.read(file)


def test_a_floating_point_dng_is_refused(tmp_path):
    file = tmp_path / "float.dng"
    extra = [
        (50706, "B", 4, (1, 4, 0, 0), True),
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, (0, 1, 1, 2), True),
        (50708, "s", 0, "x", True),
    ]
    image = np.linspace(0, 1, 64 * 64, dtype=np.float32).reshape(64, 64)
    tifffile.imwrite(file, image, photometric=32803, extratags=extra, metadata=None)
    with pytest.raises(RawError):
        raw.read(file)


# --- linear values --------------------------------------------------------------------------------

GAIN, READ_NOISE, FULL_SCALE_DN = 2.0, 6.0, 15_000


def noisy(mean_fraction, pattern, rng):
    """Expose sensor pixels to given fractions of full scale: shot and read noise, rounding."""
    electrons = rng.poisson(mean_fraction * FULL_SCALE_DN * GAIN)
    electrons = electrons + rng.normal(0, READ_NOISE, electrons.shape)
    values = np.rint(512 + electrons / GAIN).clip(0, 65535).astype(np.uint16)
    # rounding adds a variance of 1/12 DN squared
    read_noise = np.hypot(READ_NOISE, GAIN / np.sqrt(12))
    profile = raw.noise_profile(GAIN, read_noise, black=512, white=512 + FULL_SCALE_DN)
    return RawFrame(
        cfa=values,
        pattern=pattern,
        black=(512.0,) * 4,
        white=512 + FULL_SCALE_DN,
        noise_profile=profile,
    )


@pytest.mark.parametrize("pattern", BAYER)
@pytest.mark.parametrize("demosaic", ["superpixel", "centered", "bilinear"])
def test_colors_come_from_their_own_pixels(pattern, demosaic):
    values = np.empty((8, 12), np.uint16)
    for cell, letter in enumerate(pattern):
        values[cell // 2 :: 2, cell % 2 :: 2] = {"R": 2512, "G": 4512, "B": 8512}[letter]
    frame = RawFrame(cfa=values, pattern=pattern, black=(512.0,) * 4, white=10_512)
    image = raw.linear_rgb(frame, demosaic=demosaic, gain=1.0, read_noise=0.0)
    np.testing.assert_allclose(image.rgb, np.broadcast_to((0.2, 0.4, 0.8), image.rgb.shape), 1e-6)
    assert image.rgb.shape[:2] == ((8, 12) if demosaic == "bilinear" else (4, 6))


@pytest.mark.parametrize("demosaic", ["superpixel", "centered", "bilinear"])
def test_mean_is_unbiased_and_propagated_variance_correct(rng, demosaic):
    """False-alarm rate 1e-3 over all pixels and channels, Sidak-corrected.

    Every output value is repeated over many exposures; its sample mean is compared by a z-test
    and its sample variance by a chi-square test (nearly normal noise: hundreds of electrons).
    """
    shape, repeats = (6, 8), 1500
    level = rng.uniform(0.02, 0.9, (2, 2))
    truth = np.tile(level, (shape[0] // 2, shape[1] // 2))
    images = [raw.linear_rgb(noisy(truth, "RGGB", rng), demosaic=demosaic) for _ in range(repeats)]
    rgb = np.stack([image.rgb for image in images]).astype(np.float64)
    variance = np.stack([image.variance for image in images]).astype(np.float64).mean(axis=0)
    expected = np.array([level[0, 0], (level[0, 1] + level[1, 0]) / 2, level[1, 1]])
    if demosaic == "bilinear":
        # at a green site the value is that site's own level; compare there with its level
        target = np.broadcast_to(expected, rgb.shape[1:]).copy()
        target[..., 1] = raw.linear_rgb(
            noiseless(truth), demosaic="bilinear", gain=1e12, read_noise=0.0
        ).rgb[..., 1]
    else:
        target = np.broadcast_to(expected, rgb.shape[1:])
    tests = 2 * target.size
    alpha = 1 - (1 - 1e-3) ** (1 / tests)
    z = (rgb.mean(axis=0) - target) / np.sqrt(variance / repeats)
    assert np.abs(z).max() < stats.norm.isf(alpha / 2)
    ratio = rgb.var(axis=0, ddof=1) / variance * (repeats - 1)
    low, high = stats.chi2.ppf([alpha / 2, 1 - alpha / 2], repeats - 1)
    assert low < ratio.min()
    assert ratio.max() < high


def noiseless(truth):
    values = np.rint(512 + truth * FULL_SCALE_DN).astype(np.uint16)
    return RawFrame(cfa=values, pattern="RGGB", black=(512.0,) * 4, white=512 + FULL_SCALE_DN)


def test_bilinear_keeps_a_ramp_inside_the_image():
    row, column = np.mgrid[:16, :20]
    frame = RawFrame(
        cfa=(600 + 10 * row + 30 * column).astype(np.uint16),
        pattern="GBRG",
        black=(100.0,) * 4,
        white=1100,
    )
    image = raw.linear_rgb(frame, demosaic="bilinear", gain=1.0, read_noise=1.0)
    ramp = (500 + 10 * row + 30 * column)[1:-1, 1:-1, None] / 1000
    np.testing.assert_allclose(image.rgb[1:-1, 1:-1], np.repeat(ramp, 3, axis=2), rtol=1e-5)


def test_below_black_stays_negative_with_read_noise_variance():
    frame = RawFrame(
        cfa=np.full((4, 4), 500, np.uint16),
        pattern="RGGB",
        black=(512.0,) * 4,
        white=1512,
        noise_profile=(1e-3, 4e-6),
    )
    image = raw.linear_rgb(frame)
    np.testing.assert_allclose(image.rgb, -0.012, rtol=1e-5)
    np.testing.assert_allclose(image.variance[..., 0], 4e-6, rtol=1e-5)
    np.testing.assert_allclose(image.variance[..., 1], 2e-6, rtol=1e-5)


def test_black_is_subtracted_by_position():
    cfa = np.tile(np.array([[10, 20], [30, 40]], np.uint16), (3, 3))
    frame = RawFrame(cfa=cfa, pattern="RGGB", black=(10.0, 20.0, 30.0, 40.0), white=100)
    assert not raw.linear_rgb(frame, gain=1.0, read_noise=1.0).rgb.any()


def test_saturated_pixel_invalidates_exactly_its_contributions():
    values = np.full((8, 8), 600, np.uint16)
    values[2, 2] = 1512  # a red site
    frame = RawFrame(cfa=values, pattern="RGGB", black=(512.0,) * 4, white=1512)
    cells = raw.linear_rgb(frame, gain=1.0, read_noise=1.0).valid
    assert np.argwhere(~cells).tolist() == [[1, 1]]
    full = raw.linear_rgb(frame, gain=1.0, read_noise=1.0, demosaic="bilinear").valid
    spoiled = np.zeros((8, 8), bool)
    spoiled[1:4, 1:4] = True
    np.testing.assert_array_equal(~full, spoiled)


def test_unknown_noise_is_an_error_not_a_guess(cfa):
    frame = RawFrame(cfa=cfa, pattern="RGGB", black=(0.0,) * 4, white=65535)
    with pytest.raises(RawError, match="noise profile"):
        raw.linear_rgb(frame)
    with pytest.raises(RawError, match="both or neither"):
        raw.linear_rgb(frame, gain=1.0)


def test_a_monochrome_frame_has_no_color(cfa):
    frame = RawFrame(cfa=cfa, pattern="MONO", black=(0.0,), white=65535)
    with pytest.raises(RawError, match="no color"):
        raw.linear_rgb(frame, gain=1.0, read_noise=1.0)


def test_linear_values_leave_the_frame_alone(cfa):
    before = cfa.copy()
    frame = RawFrame(cfa=cfa, pattern="RGGB", black=(0.0,) * 4, white=65535)
    raw.linear_rgb(frame, gain=1.0, read_noise=1.0, demosaic="bilinear")
    np.testing.assert_array_equal(cfa, before)


@pytest.mark.parametrize("pattern", BAYER)
def test_brightness_gradient_is_untinted_when_colors_are_centered(pattern):
    """Superpixels show the tint: their colors stand a sensor pixel apart."""
    y, x = np.mgrid[0:16, 0:20]
    values = (1000 + 40 * x + 60 * y).astype(np.uint16)
    frame = RawFrame(cfa=values, pattern=pattern, black=(512.0,) * 4, white=10_512)

    def tint(demosaic):
        rgb = raw.linear_rgb(frame, demosaic=demosaic, gain=1.0, read_noise=0.0).rgb[2:-2, 2:-2]
        return float(np.ptp(rgb, axis=-1).max())

    assert tint("centered") < 1e-6
    assert tint("superpixel") > 1e-3


def test_saturated_site_invalidates_every_reached_cell():
    values = np.full((8, 8), 1000, np.uint16)
    values[2, 2] = 10_512  # red of RGGB: reaches its own cell and the ones before it
    frame = RawFrame(cfa=values, pattern="RGGB", black=(512.0,) * 4, white=10_512)
    valid = raw.linear_rgb(frame, demosaic="centered", gain=1.0, read_noise=0.0).valid
    spoilt = {(int(i), int(j)) for i, j in np.argwhere(~valid)}
    assert spoilt == {(0, 0), (0, 1), (1, 0), (1, 1)}
