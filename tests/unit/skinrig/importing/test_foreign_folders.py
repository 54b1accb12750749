"""Folders as strangers have them are imported right, or refused by one error with what to do."""

import numpy as np
import pytest
import tifffile
from fixtures import foreign_folders
from fixtures.foreign_folders import HEIC_HEAD, READABLE, UNREADABLE, ball, jpeg, lights
from PIL import Image

from capture.importers import read_photo
from capture.importers.light_lists import to_gray
from skinrig.cli import main
from skinrig.importing.light_stacks import find_lights

MIN_CORRELATION = 0.99
"""Decoded light is not linear in the codes, and JPEG and inks change them."""
REFUSED = {
    "mixed_sizes": ("img4.png: got", "turned alike"),
    "missing_row": ("lights: got 8, expected 9, one per image", "Move images"),
    "degrees": ("lights.txt, line 1", "cos(elevation)"),
    "degrees_by_name": ("a.lp, line 2", "cos(elevation)"),
    "zero_vector": ("a.lp, line 4", "not all zero"),
    "turned_once": ("img5.jpg: got", "EXIF orientation 3"),
    "heic": ("9 .HEIC", "Convert it to TIFF or PNG"),
    "raw_and_jpeg": ("img0.jpg and img0.png look like one shot", "keep one format"),
    "video": ("1 .mp4", "ffmpeg -i VIDEO"),
}
"""Parts of the message of each folder: what was found, and what to do."""


def number_of(file):
    return int("".join(one for one in file.stem if one.isdigit()))


@pytest.mark.parametrize("name", READABLE)
def test_stranger_folder_pairs_images_with_lights(name, tmp_path):
    folder = tmp_path / "Süd 2" / "data"
    READABLE[name](folder)
    found = find_lights(folder, lights=None, mask=None, encoding="auto").lights
    numbers = [number_of(file) for file in found.images]
    expected = list(range(len(lights()) - (name == "missing_entry")))
    assert sorted(numbers) == expected
    np.testing.assert_allclose(found.directions, lights()[numbers], atol=1e-4)
    for file, number in zip(found.images, numbers, strict=True):
        gray = to_gray(read_photo(file).frame)
        codes = ball()[number].mean(axis=-1)
        assert np.corrcoef(np.sqrt(gray).ravel(), codes.ravel())[0, 1] > MIN_CORRELATION


@pytest.mark.parametrize("name", ["leftovers", "umlauts", "cmyk", "turned"])
def test_stranger_folder_becomes_a_session(name, tmp_path, capsys):
    READABLE[name](tmp_path / "data")
    argv = ["import", "olat", str(tmp_path / "data"), "--out", str(tmp_path / "s")]
    assert main([*argv, "--subject", "none"]) == 0
    assert "9 pictures" in capsys.readouterr().out


@pytest.mark.parametrize("name", UNREADABLE)
def test_stranger_folder_is_refused_by_one_error(name, tmp_path, capsys):
    UNREADABLE[name](tmp_path / "data")
    capsys.readouterr()
    argv = ["import", "olat", str(tmp_path / "data"), "--out", str(tmp_path / "s")]
    assert main([*argv, "--subject", "none"]) == 3
    message = capsys.readouterr().err
    for part in REFUSED[name]:
        assert part in message
    assert message.count("skinrig:") == 1
    assert [one.name for one in tmp_path.iterdir()] == ["data"]


@pytest.mark.parametrize(
    ("name", "code", "part"),
    [
        ("leftovers", 0, "ignored: Thumbs.db"),
        ("turned", 0, "EXIF orientation 6"),
        ("cmyk", 0, "four inks (CMYK)"),
        ("two_pages", 0, "only the first of 2 pages"),
        ("alpha", 0, "transparency was dropped"),
        ("heic", 3, "is a HEIC image"),
        ("heic", 3, "Convert it to TIFF or PNG"),
        ("video", 3, "ffmpeg -i VIDEO"),
    ],
)
def test_stranger_photographs_are_imported_or_refused(name, code, part, tmp_path, capsys):
    (READABLE | UNREADABLE)[name](tmp_path / "data")
    capsys.readouterr()
    argv = ["import", "photos", str(tmp_path / "data"), "--out", str(tmp_path / "s")]
    assert main([*argv, "--subject", "none"]) == code
    printed = capsys.readouterr()
    assert part in printed.out + printed.err


@pytest.mark.parametrize(
    ("name", "data", "part"),
    [
        ("me.HEIC", HEIC_HEAD, "Convert it to TIFF or PNG"),
        ("me.jpg", HEIC_HEAD, "is a HEIC image"),
        ("me.webp", b"RIFF\0\0\0\0WEBPVP8 " + bytes(40), "is a WebP image"),
        ("clip.mov", b"\0\0\0\x14ftypqt  " + bytes(40), "ffmpeg -i VIDEO"),
        ("me.jpg", b"RIFF\0\0\0\0WEBPVP8 " + bytes(40), "is a WebP image"),
        ("clip.bin", b"RIFF\0\0\0\0AVI LIST" + bytes(40), "that is a video"),
        ("sound.bin", b"RIFF\0\0\0\0WAVEfmt " + bytes(40), "is not a raw file"),
        ("Thumbs.db", b"\xd0\xcf\x11\xe0" + bytes(40), "is not a raw file"),
        ("me.jpg", jpeg(ball()[0], mode="CMYK"), "face"),
    ],
    ids=["heic", "heic as jpg", "webp", "mov", "webp as jpg", "avi", "wav", "thumbs", "no face"],
)
def test_photo_of_other_format_states_what_to_do(name, data, part, tmp_path, capsys):
    (tmp_path / name).write_bytes(data)
    assert main(["photo", str(tmp_path / name), "--out", str(tmp_path / "out")]) == 3
    assert part in capsys.readouterr().err


def test_photo_of_folder_states_what_to_do(tmp_path, capsys):
    foreign_folders.write(tmp_path / "data")
    assert main(["photo", str(tmp_path / "data"), "--out", str(tmp_path / "out")]) == 3
    assert "skinrig import photos" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_turns_image_upright(orientation, suffix, tmp_path):
    """Exif 2.32, tag 0x0112: stored row 0 and column 0 are these sides of the upright image."""
    upright = ball(64, 48)[2]
    stored = {
        1: upright,
        2: upright[:, ::-1],
        3: upright[::-1, ::-1],
        4: upright[::-1],
        5: upright.transpose(1, 0, 2),
        6: np.rot90(upright),
        7: upright[::-1, ::-1].transpose(1, 0, 2),
        8: np.rot90(upright, -1),
    }[orientation]
    file = tmp_path / f"a.{suffix}"
    pixels = np.ascontiguousarray(stored)
    if suffix == "jpg":
        file.write_bytes(jpeg(pixels, orientation=orientation))
    elif suffix == "png":
        exif = Image.Exif()
        exif[0x0112] = orientation
        Image.fromarray(pixels).save(file, exif=exif)
    else:
        tag = (0x0112, "H", 1, orientation, True)
        tifffile.imwrite(file, pixels, extratags=[tag], photometric="rgb")
    photo = read_photo(file)
    assert any("EXIF orientation" in note for note in photo.notes) == (orientation != 1)
    gray = to_gray(photo.frame)
    assert (photo.orientation, gray.shape) == (orientation, (48, 64))
    assert np.corrcoef(np.sqrt(gray).ravel(), upright.mean(axis=-1).ravel())[0, 1] > MIN_CORRELATION
