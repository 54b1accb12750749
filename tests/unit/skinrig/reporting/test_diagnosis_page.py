"""The page of a diagnosis shows the images in question and their lights."""

import numpy as np
from fixtures.faulty_stacks import make

from model.vectors import unit_vectors
from reconstruction.pipeline.diagnosed_images import DiagnosedImages
from reconstruction.stack_diagnosis import diagnose_stack
from skinrig.reporting.diagnosis_page import build_diagnosis_page


def with_images(found, stack):
    names = tuple(str(number + 1) for number in range(len(stack.images)))
    listed = unit_vectors(stack.lights)
    return DiagnosedImages(found.findings, names, stack.images, found, listed)


def test_page_shows_named_images_and_both_lights():
    stack = make("two swapped", 3)
    found = diagnose_stack(
        stack.images, stack.lights, inside=stack.inside, rng=np.random.default_rng(0)
    )
    page = build_diagnosis_page("a/s", with_images(found, stack))
    assert "swapped lights" in page
    for number in stack.frames:
        assert f"ball under the listed light of image {number + 1}" in page
        assert f"ball under the light of image {number + 1}" in page
    others = set(range(len(stack.images))) - set(stack.frames)
    assert not any(f'ball under the light of image {number + 1}"' in page for number in others)


def test_page_without_faults_names_number_of_images():
    stack = make("two swapped", 3)
    found = diagnose_stack(
        stack.images, stack.lights, inside=stack.inside, rng=np.random.default_rng(0)
    )
    sound = type(found)((), found.order, found.left_out, found.directions, found.strength)
    page = build_diagnosis_page("s", with_images(sound, stack))
    assert f"no fault in {len(stack.images)} images" in page


def test_page_of_single_image_names_it_in_heading():
    stack = make("zeros", 3)
    found = diagnose_stack(
        stack.images, stack.lights, inside=stack.inside, rng=np.random.default_rng(0)
    )
    page = build_diagnosis_page("s", with_images(found, stack))
    (number,) = stack.frames
    assert f"empty image: image {number + 1}" in page
    assert f"Image {number + 1} has one value everywhere. Remedy: take" in page
