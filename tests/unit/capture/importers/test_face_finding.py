"""The face of a photograph is found, whatever its size, brightness and surroundings."""

import cv2
import numpy as np
import pytest
import skimage.data

from capture.importers.face_finding import find_face, frame_face
from capture.importers.framing import Framing
from capture.importers.image_checks import PhotoError
from capture.importers.photos import import_photos
from capture.session import Session

EYES = np.array([(200.0, 101.0), (247.0, 101.0)])
"""Pupils in the portrait that scikit-image ships, pixels; read from the picture."""


@pytest.fixture(scope="module")
def portrait():
    return (skimage.data.astronaut() / 255.0).astype(np.float32) ** 2.2


def contains_eyes(square, scale=1.0):
    left, top, width, height = square
    inside = (EYES * scale - [left, top]) / [width, height]
    return bool(((inside > 0.1) & (inside < 0.9)).all()) and width < 4 * scale * 47


@pytest.mark.parametrize("scale", [0.5, 1.0, 4.0])
def test_face_of_any_size_found(portrait, scale):
    scaled = cv2.resize(portrait, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    assert contains_eyes(find_face(scaled), scale)
    assert not contains_eyes((300, 300, 100, 100), scale)


@pytest.mark.parametrize("gain", [0.02, 30.0])
def test_brightness_does_not_matter(portrait, gain):
    assert contains_eyes(find_face(gain * portrait))


def test_gray_photograph_has_face(portrait):
    assert contains_eyes(find_face(portrait.mean(axis=-1, keepdims=True)))


def test_surroundings_alone_show_no_face(portrait):
    without = portrait.copy()
    without[40:180, 150:290] = portrait[0, 0]
    found = find_face(without)
    assert found is None or not contains_eyes(found)


def test_blue_face_is_not_found(portrait):
    assert find_face(portrait[:, :, ::-1].copy()) is None


def test_noise_shows_no_face():
    noise = np.random.default_rng(4).random((200, 300, 3), np.float32)
    assert find_face(noise) is None


def test_crop_stays_inside_photograph():
    left, top, width, height = frame_face((2, 90, 50, 50), (60, 120))
    assert (left, top) == (0, 68)
    assert (left + width, top + height) == (60, 120)


def test_pair_of_states_shares_crop(tmp_path, portrait):
    folder = tmp_path / "photographs"
    folder.mkdir()
    shown = skimage.data.astronaut()[:, :, ::-1]
    moved = np.roll(shown, 9, axis=1)
    for name, picture in (("anna crossed", shown), ("anna parallel", moved), ("ben", moved)):
        cv2.imwrite(str(folder / f"{name}.png"), picture)
    import_photos(folder, out=tmp_path / "s", framing=Framing.parse("face", None))
    listed = Session.open(tmp_path / "s").manifest.extra["photographs"]
    first, second, third = (one["face"] for one in listed)
    assert first == second
    assert max(map(abs, np.subtract(first, third))) < 0.1


def test_photograph_without_face_is_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "wall.png"), np.full((200, 200, 3), 90, np.uint8))
    with pytest.raises(PhotoError, match="shows no face"):
        import_photos(tmp_path, out=tmp_path / "s", framing=Framing.parse("face", None))
    assert not (tmp_path / "s").exists()
