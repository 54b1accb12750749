import json
import os
import struct
import zlib
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import tifffile

from capture import raw
from capture.importers import PhotoError, import_photos, read_photo
from capture.rig import load_rig
from capture.session import Session, verify

DATA = Path(os.environ.get("SKINRIG_TEST_DATA", Path(__file__).parents[5] / "shared" / "data"))
needs_data = pytest.mark.skipif(
    not (DATA / "raw").is_dir(), reason="needs the shared test data (SKINRIG_TEST_DATA)"
)


def clock():
    return datetime(2026, 11, 21, tzinfo=UTC)


@pytest.fixture
def picture():
    """Display values with every 8-bit code in each channel."""
    rng = np.random.default_rng(1)
    return rng.permuted(np.tile(np.arange(256, dtype=np.uint8)[:, None], (3, 3)), axis=0).reshape(
        24, 32, 3
    )


def save_png(path, rgb):
    assert cv2.imwrite(str(path), rgb[..., ::-1])
    return path


def linear(frame):
    return raw.linear_rgb(frame)


def decoded(codes, top=255):
    s = codes / top
    return np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)


def test_png_pixels_come_back_as_linear_light_exactly(picture, tmp_path):
    photo = read_photo(save_png(tmp_path / "a.png", picture))
    image = linear(photo.frame)
    assert photo.encoding == "sRGB"
    np.testing.assert_allclose(image.rgb, decoded(picture), atol=0.5 / 65535 + 1e-6)
    np.testing.assert_array_equal(image.valid, (picture < 255).all(axis=-1))
    assert any("sRGB curve" in note for note in photo.notes)


def test_sixteen_bit_png_keeps_its_depth(picture, tmp_path):
    deep = picture.astype(np.uint16) * 251 + 3
    photo = read_photo(save_png(tmp_path / "a.png", deep))
    np.testing.assert_allclose(linear(photo.frame).rgb, decoded(deep, 65535), atol=1e-5)


def test_jpeg_is_decoded_to_within_its_compression(tmp_path):
    y, x = np.mgrid[:48, :64]
    smooth = np.stack([2 * x + 60, 3 * y + 40, x + y + 50], -1).astype(np.uint8)
    assert cv2.imwrite(str(tmp_path / "a.jpg"), smooth[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 97])
    photo = read_photo(tmp_path / "a.jpg")
    np.testing.assert_allclose(linear(photo.frame).rgb, decoded(smooth), atol=0.03)


def test_linear_tiff_keeps_its_numbers(tmp_path):
    rng = np.random.default_rng(2)
    values = rng.integers(0, 65536, (10, 14, 3), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", values, photometric="rgb")
    photo = read_photo(tmp_path / "a.tif")
    assert photo.encoding == "linear"
    np.testing.assert_allclose(linear(photo.frame).rgb, values / 65535, atol=1e-6)


def test_multipage_file_uses_first_page_and_reports_this(tmp_path):
    pages = np.random.default_rng(2).integers(1, 60000, (3, 8, 10), dtype=np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", pages, photometric="minisblack")
    photo = read_photo(tmp_path / "a.tif")
    np.testing.assert_array_equal(photo.frame.cfa, pages[0])
    assert any("first of 3 pages" in note for note in photo.notes)


def test_eight_bit_tiff_counts_as_display_values(picture, tmp_path):
    tifffile.imwrite(tmp_path / "a.tiff", picture, photometric="rgb")
    photo = read_photo(tmp_path / "a.tiff")
    assert photo.encoding == "sRGB"
    np.testing.assert_allclose(linear(photo.frame).rgb, decoded(picture), atol=1e-5)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_exr_values_keep_their_ratios_and_signs(dtype, tmp_path):
    rng = np.random.default_rng(3)
    values = rng.uniform(-0.005, 4.0, (9, 11, 3)).astype(dtype)
    OpenEXR.File({}, {"RGB": np.ascontiguousarray(values)}).write(str(tmp_path / "a.exr"))
    photo = read_photo(tmp_path / "a.exr")
    image = linear(photo.frame)
    scale = float(values.max()) * 1.02
    np.testing.assert_allclose(image.rgb * scale, values, atol=1e-4)
    assert image.rgb.min() < 0
    assert image.valid.all()
    assert any("divided by" in note for note in photo.notes)


def test_not_a_number_in_an_exr_is_masked(tmp_path):
    values = np.full((8, 8, 3), 0.5, np.float32)
    values[2, 3] = [np.nan, 0.5, np.inf]
    OpenEXR.File({}, {"RGB": values}).write(str(tmp_path / "a.exr"))
    photo = read_photo(tmp_path / "a.exr")
    expected = np.ones((8, 8), bool)
    expected[2, 3] = False
    np.testing.assert_array_equal(linear(photo.frame).valid, expected)
    assert any("2 values that are not numbers" in note for note in photo.notes)


def test_a_raw_file_keeps_its_sensor_values(tmp_path):
    cfa = np.random.default_rng(4).integers(512, 16000, (20, 30), dtype=np.uint16)
    raw.write_dng(
        tmp_path / "a.dng",
        cfa,
        pattern="GRBG",
        black=500,
        white=16000,
        exposure_s=0.01,
        iso=200,
        camera_model="Some Camera",
        camera_serial="SECRET123",
        neutral=(0.5, 1.0, 0.7),
        captured_at=clock(),
    )
    frame = read_photo(tmp_path / "a.dng").frame
    np.testing.assert_array_equal(frame.cfa, cfa)
    assert (frame.pattern, frame.white, frame.iso) == ("GRBG", 16000, 200)
    assert frame.neutral == pytest.approx((0.5, 1.0, 0.7), abs=1e-4)
    assert frame.camera_serial == ""
    assert frame.captured_at is None


def write_foreign_dng(path, rgb, orientation):
    """Write a DNG of another program: a mosaic whose stored rows are not the upright ones."""
    stored = {
        1: rgb, 2: rgb[:, ::-1], 3: rgb[::-1, ::-1], 4: rgb[::-1],
        5: rgb.transpose(1, 0, 2), 6: np.rot90(rgb),
        7: rgb[::-1, ::-1].transpose(1, 0, 2), 8: np.rot90(rgb, -1),
    }[orientation]  # fmt: skip
    cfa = np.empty((2 * stored.shape[0], 2 * stored.shape[1]), np.uint16)
    for row, column, channel in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        cfa[row::2, column::2] = stored[..., channel]
    identity = [1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1]
    tags = [
        (274, "H", 1, orientation, True), (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, bytes([0, 1, 1, 2]), True), (50706, "B", 4, b"\1\4\0\0", True),
        (50708, "s", 0, "Some Camera", True), (50714, "H", 1, 64, True),
        (50717, "I", 1, 4095, True), (50721, "2i", 9, identity, True),
        (50728, "2I", 3, [1, 2, 1, 1, 1, 2], True),
    ]  # fmt: skip
    tifffile.imwrite(path, cfa, photometric="cfa", extratags=tags, metadata=None)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_raw_mosaic_is_turned_upright(orientation, tmp_path):
    rgb = np.random.default_rng(orientation).integers(100, 4000, (20, 30, 3), dtype=np.uint16)
    file = tmp_path / "a.dng"
    write_foreign_dng(file, rgb, orientation)
    photo = read_photo(file)
    np.testing.assert_allclose(linear(photo.frame).rgb * (4095 - 64) + 64, rgb, atol=0.01)
    assert photo.orientation == orientation
    assert any("EXIF orientation" in note for note in photo.notes) == (orientation != 1)
    unturned = read_photo(file, turn_raw=False)
    np.testing.assert_array_equal(unturned.frame.cfa, raw.read(file).cfa)
    assert unturned.frame.pattern == "RGGB"
    assert any("not followed" in note for note in unturned.notes) == (orientation != 1)


def test_imported_raw_is_upright_unless_rig_is_known(tmp_path):
    rgb = np.random.default_rng(0).integers(100, 4000, (20, 30, 3), dtype=np.uint16)
    write_foreign_dng(tmp_path / "a.dng", rgb, 6)
    import_photos(tmp_path / "a.dng", out=tmp_path / "s", now=clock)
    session = Session.open(tmp_path / "s")
    (record,) = session.frames()
    np.testing.assert_allclose(linear(session.read(record)).rgb * (4095 - 64) + 64, rgb, atol=0.01)
    view = session.rig.views[0]
    sensor = replace(view, width_px=40, height_px=60, cfa="RGGB")
    rig = replace(session.rig, views=(sensor,))
    done = import_photos(tmp_path / "a.dng", out=tmp_path / "r", rig=rig, now=clock)
    (record,) = Session.open(tmp_path / "r").frames()
    assert Session.open(tmp_path / "r").read(record).cfa.shape == (60, 40)
    assert any("not followed" in text for text in done.assumed)


def exif_with_place():
    """An APP1 segment with an owner's name and a GPS directory, as a phone writes."""
    owner = b"Anna Example\0"
    entries = [(0x013B, 2, len(owner), 200), (0x8825, 4, 1, 100)]
    body = b"II*\0" + struct.pack("<IH", 8, len(entries))
    body += b"".join(struct.pack("<HHII", *entry) for entry in entries) + struct.pack("<I", 0)
    body = body.ljust(100, b"\0") + struct.pack("<HHHI4sI", 1, 1, 2, 2, b"N\0\0\0", 0)
    body = body.ljust(200, b"\0") + owner
    payload = b"Exif\0\0" + body
    return b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload


def test_import_removes_location_and_owner(picture, tmp_path):
    plain = cv2.imencode(".jpg", picture)[1].tobytes()
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "a.jpg").write_bytes(plain[:2] + exif_with_place() + plain[2:])
    assert b"Anna Example" in (folder / "a.jpg").read_bytes()
    import_photos(folder, out=tmp_path / "s", now=clock)
    written = b"".join(p.read_bytes() for p in (tmp_path / "s").rglob("*") if p.is_file())
    assert b"Anna" not in written
    assert b"Example" not in written


def test_imported_session_is_complete_closed_and_reports_assumptions(picture, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    save_png(folder / "portrait.png", picture)
    (folder / "notes.txt").write_text("not a photograph")
    done = import_photos(folder, out=tmp_path / "s", now=clock)
    assert (done.frames, done.states, done.ignored) == (1, ("neutral",), ("notes.txt",))
    report = verify(tmp_path / "s")
    assert report.ok
    session = Session.open(tmp_path / "s")
    assert session.closed
    assert session.source == "measured"
    assert session.manifest.extra["assumed"] == done.assumed
    assert session.rig.lights[0].illuminant == "D65"
    assert session.rig.views[0].spectral_sensitivity == "linear sRGB"
    (record,) = session.frames("subject", state="neutral", polarizer="crossed")
    np.testing.assert_allclose(linear(session.read(record)).rgb, decoded(picture), atol=1e-5)
    for needed in ("sRGB curve", "as if the photograph were crossed", "spectral sensitivity"):
        assert any(needed in text for text in done.assumed), needed
    json.dumps(done.assumed)


def test_file_names_give_states_and_polarizers(picture, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for name in ("anna smile parallel", "anna smile crossed", "bob_crossed", "bob-parallel"):
        save_png(folder / f"{name}.png", picture)
    done = import_photos(folder, out=tmp_path / "s", now=clock)
    assert sorted(done.states) == ["anna-smile", "bob"]
    session = Session.open(tmp_path / "s")
    for state in done.states:
        for polarizer in ("parallel", "crossed"):
            assert len(session.frames("subject", state=state, polarizer=polarizer)) == 1
    assert not any("no polarizers" in text for text in done.assumed)


def test_two_formats_of_shot_are_never_averaged(picture, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    save_png(folder / "x.png", picture)
    tifffile.imwrite(folder / "x.tif", picture.astype(np.uint16) * 256, photometric="rgb")
    done = import_photos(folder, out=tmp_path / "s", now=clock)
    assert len(done.states) == 2


def test_images_of_two_sizes_become_two_cameras(picture, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    save_png(folder / "a.png", picture)
    save_png(folder / "b.png", picture[:10])
    import_photos(folder, out=tmp_path / "s", now=clock)
    session = Session.open(tmp_path / "s")
    assert [view.name for view in session.rig.views] == ["cam", "cam2"]


def test_frames_of_known_rig_keep_that_rig(tmp_path):
    rig = load_rig("flash").resized(48)
    view = rig.views[0]
    folder = tmp_path / "in"
    folder.mkdir()
    cfa = np.full((view.height_px, view.width_px), 900, np.uint16)
    raw.write_dng(folder / "a crossed.dng", cfa, pattern="RGGB", black=512, white=16383)
    import_photos(folder, out=tmp_path / "s", rig=rig, now=clock)
    session = Session.open(tmp_path / "s")
    assert session.rig == rig
    assert session.read(session.frames()[0]).camera_serial == view.serial
    save_png(folder / "b.png", np.zeros((8, 8, 3), np.uint8) + np.uint8([1, 2, 3]))
    with pytest.raises(PhotoError, match="rig's camera"):
        import_photos(folder, out=tmp_path / "s2", rig=rig, now=clock)


def huge_png(path):
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    chunks = b"\x89PNG\r\n\x1a\n"
    for kind, data in ((b"IHDR", header), (b"IDAT", b"x"), (b"IEND", b"")):
        chunks += struct.pack(">I", len(data)) + kind + data
        chunks += struct.pack(">I", zlib.crc32(kind + data))
    path.write_bytes(chunks)


def damage(path, at, value=0xA5):
    data = bytearray(path.read_bytes())
    data[at] ^= value
    path.write_bytes(bytes(data))


def tiny_rows_per_strip(path):
    """Write a TIFF whose strips have 5e-324 rows each: infinitely many, as a double."""
    tifffile.imwrite(path, np.zeros((9, 8, 3), np.uint16), photometric="rgb")
    data = path.read_bytes()
    tag, long, double = 278, 4, 12
    entry = data.index(struct.pack("<HHI", tag, long, 1))
    changed = struct.pack("<HHII", tag, double, 1, len(data))
    path.write_bytes(data[:entry] + changed + data[entry + 12 :] + struct.pack("<d", 5e-324))


def bad_file(kind, folder, picture):
    png = save_png(folder / "x.png", picture)
    jpeg = folder / "x.jpg"
    cv2.imwrite(str(jpeg), picture)
    for file in (png, jpeg):
        if not kind.startswith(file.suffix[1:]):
            file.unlink()
    if kind == "png cut":
        png.write_bytes(png.read_bytes()[:-30])
    elif kind == "png flipped bit":
        damage(png, 60)
    elif kind == "png huge":
        huge_png(png)
    elif kind == "jpg cut":
        jpeg.write_bytes(jpeg.read_bytes()[:-40])
    elif kind == "jpg header only":
        jpeg.write_bytes(jpeg.read_bytes()[:25])
    elif kind == "empty":
        (folder / "x.png").write_bytes(b"")
    elif kind == "text":
        (folder / "x.png").write_text("this is no picture at all")
    elif kind == "tif cut":
        tifffile.imwrite(folder / "x.tif", np.zeros((40, 40, 3), np.uint16), photometric="rgb")
        data = (folder / "x.tif").read_bytes()
        (folder / "x.tif").write_bytes(data[:-400])
    elif kind == "tif garbage":
        (folder / "x.tif").write_bytes(b"II*\0" + bytes(range(200)))
    elif kind == "tif 5 channels":
        tifffile.imwrite(
            folder / "x.tif",
            np.zeros((9, 8, 5), np.uint16),
            photometric="minisblack",
            planarconfig="contig",
        )
    elif kind == "tif 32 bit":
        tifffile.imwrite(folder / "x.tif", np.zeros((9, 8, 3), np.uint32), photometric="rgb")
    elif kind == "tif rows of 5e-324":
        tiny_rows_per_strip(folder / "x.tif")
    elif kind == "exr cut":
        OpenEXR.File({}, {"RGB": np.ones((40, 40, 3), np.float32)}).write(str(folder / "x.exr"))
        data = (folder / "x.exr").read_bytes()
        (folder / "x.exr").write_bytes(data[: len(data) // 2])
    elif kind == "exr of depth only":
        OpenEXR.File({}, {"Z": np.ones((4, 4), np.float32)}).write(str(folder / "x.exr"))
    elif kind == "exr black":
        OpenEXR.File({}, {"RGB": np.zeros((4, 4, 3), np.float32)}).write(str(folder / "x.exr"))
    elif kind == "dng cut":
        raw.write_dng(
            folder / "x.dng", np.ones((40, 40), np.uint16), pattern="RGGB", black=0, white=9
        )
        data = (folder / "x.dng").read_bytes()
        (folder / "x.dng").write_bytes(data[:-100])
    elif kind == "pipe":
        os.mkfifo(folder / "x.jpg")


@pytest.mark.parametrize(
    "kind",
    [
        "png cut",
        "png flipped bit",
        "png huge",
        "jpg cut",
        "jpg header only",
        "empty",
        "text",
        "tif cut",
        "tif garbage",
        "tif 5 channels",
        "tif 32 bit",
        "tif rows of 5e-324",
        "exr cut",
        "exr of depth only",
        "exr black",
        "dng cut",
        "pipe",
    ],
)
def test_single_bad_file_gives_clear_error_writes_nothing(kind, picture, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    bad_file(kind, folder, picture)
    save_png(folder / "good.png", picture)
    with pytest.raises(PhotoError, match=r"1 of 2 files cannot be imported") as caught:
        import_photos(folder, out=tmp_path / "s", now=clock)
    (fault,) = caught.value.faults
    assert fault.path.startswith("x.")
    assert "\n" not in fault.got
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


def test_every_bad_file_is_named_at_once(picture, tmp_path):
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(PhotoError, match="3 of 3") as caught:
        import_photos(tmp_path, out=tmp_path / "s", now=clock)
    assert [fault.path for fault in caught.value.faults] == ["a.jpg", "b.jpg", "c.jpg"]


def test_empty_and_missing_photograph_folders_are_reported(tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(PhotoError, match="contains no photographs"):
        import_photos(tmp_path, out=tmp_path / "s")
    with pytest.raises(PhotoError, match="folder not found"):
        import_photos(tmp_path / "missing", out=tmp_path / "s")


def test_a_folder_in_use_is_never_overwritten(picture, tmp_path):
    photo = save_png(tmp_path / "a.png", picture)
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "precious").write_text("x")
    with pytest.raises(PhotoError, match="new or empty folder"):
        import_photos(photo, out=tmp_path / "s")
    assert (tmp_path / "s" / "precious").read_text() == "x"


def test_an_interrupted_import_leaves_nothing(picture, tmp_path, monkeypatch):
    photo = save_png(tmp_path / "a.png", picture)

    def stop(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(Session, "commit", stop)
    with pytest.raises(KeyboardInterrupt):
        import_photos(photo, out=tmp_path / "s")
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


@needs_data
def test_a_real_camera_raw_file_is_imported(tmp_path):
    """A Kodak DC50 of 1996: 768 x 512, GRBG-like cell, no white balance in the file."""
    done = import_photos(DATA / "raw" / "RAW_KODAK_DC50.KDC", out=tmp_path / "s", now=clock)
    session = Session.open(tmp_path / "s")
    frame = session.read(session.frames()[0])
    assert frame.cfa.shape == (512, 768)
    image = linear(frame)
    assert image.rgb.shape == (256, 384, 3)
    assert 0.01 < float(np.median(image.rgb)) < 0.9
    assert any("20000 electrons" in text for text in done.assumed)
    assert verify(tmp_path / "s").ok


@needs_data
def test_foreign_dng_imports_exact_content(tmp_path):
    import_photos(DATA / "raw" / "synth_pidng.dng", out=tmp_path / "s", now=clock)
    session = Session.open(tmp_path / "s")
    frame = session.read(session.frames()[0])
    row, column = np.mgrid[: frame.cfa.shape[0], : frame.cfa.shape[1]]
    np.testing.assert_array_equal(frame.cfa, np.minimum(512 + 20 * row + 10 * column, 65535))
    assert frame.black == (512.0,) * 4
    assert frame.white == 16383
    np.testing.assert_allclose(frame.neutral, np.array([0.5, 1.0, 2 / 3]), atol=1e-3)


@needs_data
def test_real_chart_photograph_is_imported_as_chart(tmp_path):
    path = DATA / "colorchecker" / "colorchecker_classic_photo.png"
    import_photos(path, out=tmp_path / "s", kind="chart", now=clock)
    session = Session.open(tmp_path / "s")
    assert len(session.frames("chart")) == 1


def test_a_public_domain_portrait_is_imported(tmp_path):
    data = pytest.importorskip("skimage.data")
    portrait = data.astronaut()
    save_png(tmp_path / "astronaut.png", portrait)
    done = import_photos(tmp_path / "astronaut.png", out=tmp_path / "s", now=clock)
    session = Session.open(tmp_path / "s")
    image = linear(session.read(session.frames("subject", state="neutral")[0]))
    assert image.rgb.shape == (512, 512, 3)
    np.testing.assert_allclose(image.rgb, decoded(portrait), atol=1e-5)
    assert done.frames == 1


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "exr", "dng"])
def test_random_damage_gives_own_error_or_image_only(suffix, tmp_path):
    """60 seeded files each with up to five wrong bytes near the head, or cut short."""
    rng = np.random.default_rng([9, len(suffix), ord(suffix[0])])
    rgb = rng.integers(0, 255, (24, 32, 3), dtype=np.uint8)
    path = tmp_path / f"a.{suffix}"
    if suffix == "tif":
        tifffile.imwrite(path, rgb.astype(np.uint16), photometric="rgb")
    elif suffix == "exr":
        OpenEXR.File({}, {"RGB": rgb.astype(np.float32)}).write(str(path))
    elif suffix == "dng":
        raw.write_dng(path, rgb[..., 0].astype(np.uint16), pattern="RGGB", black=0, white=300)
    else:
        save_png(path, rgb)
    whole = path.read_bytes()
    refused = 0
    for _ in range(60):
        data = bytearray(whole)
        for at in rng.integers(0, min(len(data), 600), rng.integers(1, 6)):
            data[at] = int(rng.integers(0, 256))
        keep = int(rng.integers(len(data) // 2, len(data))) if rng.random() < 0.3 else len(data)
        path.write_bytes(bytes(data[:keep]))
        try:
            assert read_photo(path).frame.cfa.size > 0
        except PhotoError:
            refused += 1
    assert refused > 10


def test_uncalibrated_color_of_exif_is_noted(picture, tmp_path):
    """EXIF 2.32: color space 65535 is any but sRGB, such as Adobe RGB."""
    plain = cv2.imencode(".jpg", picture)[1].tobytes()
    for space, noted in ((1, False), (65535, True)):
        body = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 0x8769, 4, 1, 26, 0)
        body += struct.pack("<HHHIII", 1, 0xA001, 3, 1, space, 0)
        payload = b"Exif\0\0" + body
        segment = b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload
        file = tmp_path / f"{space}.jpg"
        file.write_bytes(plain[:2] + segment + plain[2:])
        assert any("uncalibrated" in note for note in read_photo(file).notes) == noted


def test_gray_partner_of_color_photograph_is_named(picture, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    cv2.imwrite(str(folder / "anna crossed.png"), picture)
    for parallel, named in ((picture, False), (picture[..., :1], True)):
        cv2.imwrite(str(folder / "anna parallel.png"), parallel)
        done = import_photos(folder, out=tmp_path / f"s-{named}", now=clock)
        assert any("no specular image follows" in text for text in done.assumed) == named
