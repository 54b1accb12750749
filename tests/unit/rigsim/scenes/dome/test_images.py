"""Images of single lights, kept in memory and in a file."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

import numpy as np
import pytest

from rigsim.scenes.dome.images import ImageFile, LightImages


@pytest.fixture
def image() -> np.ndarray:
    made = np.zeros((12, 7), np.float32)
    made[3:9] = np.random.default_rng(1).random((6, 7), np.float32)
    return made


class Lights:
    """Renders images of their own for each light, and counts them."""

    def __init__(self, image: np.ndarray) -> None:
        self.image, self.rendered = image, []

    def of(self, camera: str, light: int) -> np.ndarray:
        return self.image * np.float32(1 + light + 100 * int(camera[1:]))

    def __call__(self, camera, lights, t_s) -> list[np.ndarray]:
        self.rendered += [(camera, light) for light in lights]
        return [self.of(camera, light) for light in lights]


@pytest.fixture
def lights(image) -> Lights:
    return Lights(image)


def test_stored_image_is_returned_bit_for_bit(image, tmp_path):
    images = ImageFile(tmp_path, 10**6)
    dark = np.zeros((4, 4), np.float32)
    images.add(("C00", 1, 0.0), image)
    images.add(("C00", 2, 0.0), dark)
    assert np.array_equal(images.load(("C00", 1, 0.0)), image)
    assert np.array_equal(images.load(("C00", 2, 0.0)), dark)
    assert images.has(("C00", 1, 0.0))
    assert not images.has(("C00", 3, 0.0))
    assert images.load(("C00", 3, 0.0)) is None
    assert not list(tmp_path.iterdir()), "the file has a name"


def test_file_stores_no_image_beyond_its_size(image, tmp_path):
    """Six of twelve rows are lit, 168 bytes."""
    images = ImageFile(tmp_path, 2 * 168)
    for light in range(3):
        images.add(("C00", light, 0.0), image)
    assert [images.has(("C00", light, 0.0)) for light in range(3)] == [True, True, False]
    assert not images.has_room(1)


def test_file_uses_places_of_removed_images(image, tmp_path):
    """Of 6, 5 and 3 rows, 28 bytes each."""
    images = ImageFile(tmp_path, 9 * 28)
    small = image.copy()
    small[6:] = 0.0
    images.add(("C00", 0, 0.0), image)
    images.add(("C00", 1, 0.0), small)
    assert not images.has_room(1)
    images.remove(("C00", 0, 0.0))
    assert not images.has(("C00", 0, 0.0))
    assert images.has_room(1)
    assert not images.has_room(2)
    for light in (2, 3):
        images.remove(("C00", light - 1, 0.0))
        other = image * np.float32(light)
        other[8] = 0.0
        images.add(("C00", light, 0.0), other)
        assert np.array_equal(images.load(("C00", light, 0.0)), other)


@pytest.mark.parametrize("call", ["pwrite", "preadv"])
def test_images_of_failing_disk_render_again(lights, tmp_path, monkeypatch, call):
    images = LightImages(lights)
    images.expect([("C00", light) for light in (0, 1, 0, 1)])

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(f"os.{call}", fail)
    monkeypatch.setattr("rigsim.scenes.dome.images.MAX_CACHED_IMAGES", 1)
    monkeypatch.setattr("rigsim.scenes.dome.images.IMAGE_CACHE_BYTES", 1)
    with images.render_ahead(tmp_path, 10**6):
        for light in (0, 1, 0, 1):
            assert np.array_equal(images.get(("C00", light, 0.0)), lights.of("C00", light))
    assert len(lights.rendered) > 4


def test_latest_images_need_no_file(lights):
    images = LightImages(lights)
    first = images.get(("C00", 0, 0.0))
    assert images.get(("C00", 0, 0.0)) is first
    assert lights.rendered == [("C00", 0)]


def test_request_renders_its_group_once(lights):
    images = LightImages(lights)
    images.expect([(one, k) for k in [*range(20, 0, -1), 20] for one in ("C00", "C01")])
    for camera in ("C00", "C01"):
        for light in (13, 20, 12, 3):
            assert np.array_equal(images.get((camera, light, 0.0)), lights.of(camera, light))
    one = [*range(20, 12, -1), *range(12, 4, -1), *range(4, 0, -1)]
    assert lights.rendered == [(camera, light) for camera in ("C00", "C01") for light in one]


def test_requests_of_several_threads_render_one_after_another(image):
    inside, most = [], []

    def render(camera, lights, t_s):
        inside.append(camera)
        most.append(len(inside))
        time.sleep(1e-3)
        inside.remove(camera)
        return [image for _ in lights]

    images = LightImages(render)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda k: images.get((f"C{k}", k, 0.0)), range(24)))
    assert len(most) == 24
    assert max(most) == 1


def test_images_ahead_are_rendered_once_each(lights, tmp_path, monkeypatch):
    monkeypatch.setattr("rigsim.scenes.dome.images.IMAGE_CACHE_BYTES", 1)
    images = LightImages(lights)
    asked = [(camera, light) for camera in ("C00", "C01") for light in range(40)]
    images.expect(asked * 2)
    with images.render_ahead(tmp_path, 10**6):
        for _ in range(2):
            for camera, light in asked:
                assert np.array_equal(images.get((camera, light, 0.0)), lights.of(camera, light))
    assert sorted(lights.rendered) == asked


def test_full_file_lets_requests_render_one_light(lights, tmp_path, monkeypatch):
    monkeypatch.setattr("rigsim.scenes.dome.images.IMAGE_CACHE_BYTES", 1)
    images = LightImages(lights)
    images.expect([("C00", light) for light in range(24)] * 2)
    with images.render_ahead(tmp_path, 8 * 168):
        for light in range(24):
            assert np.array_equal(images.get(("C00", light, 0.0)), lights.of("C00", light))
    assert sorted(lights.rendered) == [("C00", light) for light in range(24)]


@pytest.mark.parametrize("ahead", [False, True])
def test_cameras_render_their_own_lights(lights, tmp_path, ahead):
    images = LightImages(lights)
    asked = [("C00", 0), ("C01", 1), ("C00", 2), ("C01", 0)]
    images.expect(asked)
    with images.render_ahead(tmp_path, 10**6) if ahead else nullcontext():
        for camera, light in asked:
            assert np.array_equal(images.get((camera, light, 0.0)), lights.of(camera, light))
    assert sorted(lights.rendered) == sorted(asked)


def test_images_leave_file_after_last_request(lights, tmp_path, monkeypatch):
    """Room for two of five groups suffices where each image is requested once."""
    monkeypatch.setattr("rigsim.scenes.dome.images.IMAGE_CACHE_BYTES", 1)
    images = LightImages(lights)
    images.expect([("C00", light) for light in range(40)])
    with images.render_ahead(tmp_path, 16 * 168):
        for light in range(40):
            assert np.array_equal(images.get(("C00", light, 0.0)), lights.of("C00", light))
            assert not images._file.has(("C00", light, 0.0))
        assert np.array_equal(images.get(("C00", 3, 0.0)), lights.of("C00", 3))  # unexpected
    assert lights.rendered[-1] == ("C00", 3)
    assert images._file._end <= 16 * 168


def test_request_at_end_waits_for_group_ahead(image, tmp_path):
    """Images ahead end while a group renders and another thread requests an image."""
    inside, most = [], []
    started, go_on, ends = threading.Event(), threading.Event(), threading.Event()

    def render(camera, lights, t_s):
        inside.append(camera)
        most.append(len(inside))
        if camera == "C01":
            started.set()
            go_on.wait(10.0)
        inside.remove(camera)
        return [image for _ in lights]

    def request() -> None:
        ends.wait(10.0)
        time.sleep(0.1)  # the main thread waits for the group now
        images.get(("C02", 0, 0.0))

    images = LightImages(render)
    images.expect([(camera, 0) for camera in ("C00", "C01", "C02")])
    with ThreadPoolExecutor(1) as pool:
        with images.render_ahead(tmp_path, 10**6):
            images.get(("C00", 0, 0.0))
            assert started.wait(10.0)
            found = pool.submit(request)
            threading.Timer(0.3, go_on.set).start()
            ends.set()
        found.result(timeout=20.0)
    assert max(most) == 1
