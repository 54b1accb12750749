"""Skin of a face that rules, light and ground truth share."""

import gc
import weakref

import numpy as np
import pytest

from rigsim.light.observed_skin import observe_skin
from rigsim.population.files import load_subject

CAMERA, ILLUMINANT = "Nikon 5100 (NPL)", "D55"


@pytest.fixture(scope="module")
def face():
    return load_subject("III").face(seed=0, size=64)


def test_skin_is_shared_while_it_is_held(face):
    first = observe_skin(face, "neutral", CAMERA, ILLUMINANT)
    assert observe_skin(face, "neutral", CAMERA, ILLUMINANT) is first
    assert observe_skin(face, "smile", CAMERA, ILLUMINANT) is not first
    assert first.reflectance() is first.reflectance()
    left = weakref.ref(first)
    del first
    gc.collect()
    assert left() is None


def test_shared_colors_are_those_of_state(face):
    neutral, pressed = (observe_skin(face, s, CAMERA, ILLUMINANT) for s in ("neutral", "smile"))
    assert not np.array_equal(neutral.reflectance(), pressed.reflectance())
    brightest = neutral.reflectance_without_melanin()
    assert (neutral.reflectance() <= brightest + 1e-6).all()
