"""Exposures that files state: read from each format, and used for polarized pairs and lights."""

from datetime import UTC, datetime

import numpy as np
import pytest
from fixtures.faulty_patterns import make_pair
from PIL import Image, TiffImagePlugin

from capture.importers import import_photos, read_photo
from capture.importers.exif import ExifData, _parse, compare_exposures, read_exif
from capture.importers.pair_exposures import relate_exposures
from capture.session import Session
from reconstruction.pipeline.flash.mean_frames import make_image_reader
from reconstruction.pipeline.flash.pair_diagnosis import diagnose_pairs
from reconstruction.pipeline.light_stack import diagnose_images
from skinrig.cli import main
from skinrig.importing.light_stacks import _read_reduced as read_reduced

FLASH_FIRED, FLASH_OFF = 1, 0


def clock():
    return datetime(2026, 11, 29, tzinfo=UTC)


def make_exif(exposure_s=None, iso=None, f_number=None, flash=None):
    exif = Image.Exif()
    exif[0x0110] = "model"  # without a tag of the first directory, no EXIF data are written
    given = {0x829A: exposure_s, 0x8827: iso, 0x829D: f_number, 0x9209: flash}
    exif.get_ifd(0x8769).update({k: v for k, v in given.items() if v is not None})
    return exif


def save_pair(folder, exposures, times=(1.0, 1.0)):
    """Save the pair of one surface, display values of 8 bits, with the light of each image."""
    folder.mkdir()
    pair = make_pair("", 56000, side=48)[:2]
    for name, image, exif, factor in zip(
        ("parallel", "crossed"), pair, exposures, times, strict=True
    ):
        light = np.clip(0.25 * factor * image / pair[0].max(), 0.0, 1.0)
        shown = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        pixels = np.rint(255.0 * shown).astype(np.uint8)
        Image.fromarray(pixels).save(folder / f"anna {name}.png", exif=exif)
    return folder


@pytest.mark.parametrize("suffix", ["jpg", "png", "tif"])
def test_stated_exposure_is_read_from_each_format(suffix, tmp_path):
    pixels = np.arange(48, dtype=np.uint8).reshape(4, 4, 3) * 5
    file = tmp_path / f"a.{suffix}"
    exif = make_exif(exposure_s=0.02, iso=400, f_number=5.6, flash=FLASH_FIRED)
    stated = TiffImagePlugin.ImageFileDirectory_v2()
    stated[0x8769] = exif.get_ifd(0x8769)
    Image.fromarray(pixels).save(
        file, **({"tiffinfo": stated} if suffix == "tif" else {"exif": exif})
    )
    photo = read_photo(file)
    assert photo.frame.exposure_s == pytest.approx(0.02)
    assert photo.frame.iso == 400
    assert photo.frame.f_number == pytest.approx(5.6)
    assert photo.flash_fired is True
    Image.fromarray(pixels).save(file)
    assert read_photo(file).exposure_settings == {}


@pytest.mark.parametrize("exif", [{"exposure_s": 0.0}, {"iso": 0}, {"f_number": float("nan")}])
def test_impossible_settings_count_as_not_stated(exif):
    data = make_exif(**exif).tobytes().removeprefix(b"Exif\0\0")
    assert read_exif(data) == ExifData()
    assert read_exif(data[:-6]) == ExifData()
    assert read_exif(b"II*\0\xff\xff\xff\xff") == ExifData()


def test_parallel_image_is_divided_by_its_relative_exposure(tmp_path):
    """Parallel at 1/25 s and f/4, crossed at 1/50 s and f/5.6: four times the light."""
    exposures = make_exif(0.04, 100, 4.0, FLASH_OFF), make_exif(0.02, 100, 5.6, FLASH_OFF)
    done = import_photos(
        save_pair(tmp_path / "in", exposures, times=(2.0 * 1.96, 1.0)),
        out=tmp_path / "uneven", now=clock,
    )  # fmt: skip
    assert any("3.92 times the exposure" in text for text in done.assumed)
    same = make_exif(0.02, 100, 5.6, FLASH_OFF)
    import_photos(save_pair(tmp_path / "in2", (same, same)), out=tmp_path / "even", now=clock)
    images = []
    for name in ("uneven", "even"):
        session = Session.open(tmp_path / name)
        read = make_image_reader(session, None)
        images.append(
            [read(session.frames("subject", polarizer=p)) for p in ("parallel", "crossed")]
        )
        assert diagnose_pairs(session).findings == ()
    (uneven, crossed), (even, other) = images
    # 8 bits: half a step of the display values, which is largest where the curve is steepest
    np.testing.assert_allclose(uneven.rgb, even.rgb, atol=0.006)
    np.testing.assert_array_equal(crossed.rgb, other.rgb)
    ratio = np.median(uneven.variance / even.variance)
    assert 1.0 / 3.92**2 < ratio < 1.0  # more light has less relative noise


def test_pair_without_exposures_counts_as_exposed_alike(tmp_path):
    """Then the diagnosis itself finds that one of the two has four times the light."""
    folder = save_pair(tmp_path / "in", (None, None), times=(1.0, 3.9))
    done = import_photos(folder, out=tmp_path / "session", now=clock)
    assert any("count as exposed alike" in text for text in done.assumed)
    session = Session.open(tmp_path / "session")
    assert all("relative_exposure" not in one.settings for one in session.frames("subject"))
    assert diagnose_pairs(session).findings


def test_time_does_not_count_where_flash_fired():
    flash = {"iso": 200, "f_number": 8.0, "flash": "fired"}
    one, other = {"exposure_s": 1 / 60, **flash}, {"exposure_s": 1 / 200, **flash}
    assert relate_exposures(one, other, ("p", "c")) == (1.0, "")
    ratio, _ = relate_exposures({**one, "iso": 100}, other, ("p", "c"))
    assert ratio == pytest.approx(0.5)
    ratio, text = relate_exposures({**one, "flash": "off"}, other, ("p", "c"))
    assert (ratio, "one of p and c only" in text) == (1.0, True)
    alone = {"exposure_s": 0.01, "flash": "fired"}
    assert "no exposure that can be compared" in relate_exposures(alone, alone, ("p", "c"))[1]


def test_exposures_of_different_terms_are_not_compared():
    """A time with an f-number and one without differ by f^2, a flash and the sun by anything."""
    bare, full = {"exposure_s": 0.01, "iso": 100}, {"exposure_s": 0.01, "iso": 100, "f_number": 8.0}
    assert compare_exposures([bare, full]) == ([], "")
    assert compare_exposures([full, {**full, "flash": "fired"}]) == ([], "")
    assert compare_exposures([]) == ([], "")
    # without a tag of the flash, and with one that did not fire
    ratio, text = relate_exposures({**full, "exposure_s": 0.02, "flash": "off"}, full, ("p", "c"))
    assert (ratio, "by its time, ISO and f-number" in text) == (2.0, True)
    assert "by its time:" in relate_exposures({"exposure_s": 2}, {"exposure_s": 1}, ("p", "c"))[1]


def test_two_iso_values_form_no_fraction():
    assert _parse({0x8827: (200, 200), 0x829A: (1, 50)}, 1).iso == 200
    assert _parse({0x8827: (200, 200), 0x829A: (1, 50)}, 1).exposure_s == 0.02


def save_stack(folder, flashes):
    """Save six images of one surface, taken at 1/60 and 1/200 s by turns."""
    folder.mkdir()
    image = np.tile(np.linspace(20, 200, 48, dtype=np.uint8), (48, 1))
    for number, fired in enumerate(flashes):
        exif = make_exif((1 / 60, 1 / 200)[number % 2], 100, 8.0, FLASH_FIRED if fired else None)
        Image.fromarray(image).save(folder / f"{number}.png", exif=exif)
    angles = np.radians(60.0 * np.arange(len(flashes)))
    vectors = np.stack([np.cos(angles), np.sin(angles), np.ones(len(flashes))], axis=-1)
    np.savetxt(folder / "light_directions.txt", vectors)
    return folder


@pytest.mark.parametrize("flashes", [[1] * 6, [0] * 6, [0, 1, 1, 1, 1, 1]])
def test_light_stack_uses_exposures_that_can_be_compared(flashes, tmp_path):
    """Times count without a flash only; a flash in some of the images compares none."""
    folder = save_stack(tmp_path / "in", flashes)
    out = tmp_path / "s"
    assert main(["import", "olat", str(folder), "--out", str(out), "--subject", "none"]) == 0
    seen = diagnose_images(Session.open(out))
    ratio = np.median(seen.gray[1] / seen.gray[0])
    assert ratio == pytest.approx(200 / 60 if not any(flashes) else 1.0, rel=1e-5)
    assert any("cannot be compared" in text for text in seen.assumed) == (0 < sum(flashes) < 6)
    files = sorted(folder.glob("*.png"))
    estimated = read_reduced(files, None, "linear").gray
    assert np.median(estimated[1] / estimated[0]) == pytest.approx(ratio, rel=1e-5)
