"""Images of single lights, kept in memory and in a file."""

import numpy as np
import pytest

from rigsim.scenes.dome.images import ImageFile, LightImages


@pytest.fixture
def image() -> np.ndarray:
    made = np.zeros((12, 7), np.float32)
    made[3:9] = np.random.default_rng(1).random((6, 7), np.float32)
    return made


def refuse() -> np.ndarray:
    raise AssertionError("rendered twice")


def test_stored_image_is_returned_bit_for_bit(image, tmp_path):
    images = ImageFile(tmp_path, 10**6)
    dark = np.zeros((4, 4), np.float32)
    for key, made in ((("C00", 1, 0.0), image), (("C00", 2, 0.0), dark)):
        assert images.get(key, lambda made=made: made) is made
    assert np.array_equal(images.get(("C00", 1, 0.0), refuse), image)
    assert np.array_equal(images.get(("C00", 2, 0.0), refuse), dark)
    assert not list(tmp_path.iterdir()), "the file has a name"


def test_image_beyond_size_of_file_renders_again(image, tmp_path):
    """Six of twelve rows are lit, 168 bytes."""
    images = ImageFile(tmp_path, 2 * 168)
    count = []
    for _ in range(2):
        for light in range(3):
            images.get(("C00", light, 0.0), lambda: count.append(1) or image)
    assert len(count) == 4


def test_failing_disk_renders_again(image, tmp_path, monkeypatch):
    images = ImageFile(tmp_path, 10**6)

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.pwrite", fail)
    for _ in range(2):
        assert images.get(("C00", 0, 0.0), lambda: image) is image


def test_latest_images_need_no_file(image):
    images = LightImages()
    images.get(("C00", 0, 0.0), lambda: image)
    assert images.get(("C00", 0, 0.0), refuse) is image


def test_images_pushed_out_of_memory_come_from_file(image, tmp_path, monkeypatch):
    monkeypatch.setattr("rigsim.scenes.dome.images.IMAGE_CACHE_BYTES", 1)
    images = LightImages()
    images.store(tmp_path, 10**6)
    for light in range(40):
        images.get(("C00", light, 0.0), lambda light=light: image + light)
    for light in range(40):
        assert np.array_equal(images.get(("C00", light, 0.0), refuse), image + light)
