"""Grooves as voxels and in the gradient rig's scene: the same heights, and their contrast."""

import numpy as np
import pytest

from rigsim.scenes.reference.gradient_relief import draw_grooves, predict_relief
from rigsim.subject.person_skin import PersonSkin
from skinrig.benchmarks.simulation.reference_relief import (
    PIXEL_UM,
    RELIEF_SITE,
    compare_contrast,
    crop_rig,
    judge_diffuse_normals,
)

WIDTH = 24


@pytest.fixture(scope="module")
def images():
    """Patch, rig, slopes of the heights toward +x and +y, and the fast renderer's images."""
    rig, person = crop_rig(WIDTH), PersonSkin.of_preset("III")
    patch = draw_grooves(person, RELIEF_SITE, max(rig.views[0].field_mm))
    block = round(1e-3 * PIXEL_UM / patch.voxel_mm)
    first = (len(patch.x_mm) - block * WIDTH) // 2
    inner = slice(first, first + block * WIDTH)
    slopes = [
        np.gradient(patch.height_mm, patch.voxel_mm, axis=axis)[inner, inner]
        .reshape(WIDTH, block, WIDTH, block)
        .mean(axis=(1, 3))[::-1]
        for axis in (1, 0)
    ]
    light = {
        lateral: predict_relief(person, patch, rig, RELIEF_SITE, lateral=lateral)
        for lateral in (False, True)
    }
    return patch, rig, slopes, light


@pytest.mark.long
def test_fast_image_has_heights_of_voxels(images):
    """Rationale: skin that rises toward +x turns away from light at +x. Rows swapped fail."""
    _, _, slopes, light = images
    for slope, image in zip(slopes, light[False][1:3], strict=True):
        assert np.corrcoef(-slope.ravel(), image.ravel())[0, 1] > 0.8
        assert np.corrcoef(-slope[::-1].ravel(), image.ravel())[0, 1] < 0.4


@pytest.mark.long
def test_lateral_scattering_lowers_contrast(images):
    *_, light = images
    local, scattered = (light[lateral][1] / light[lateral][0].mean() for lateral in (False, True))
    found = compare_contrast(np.stack([scattered, scattered]), local)
    assert 0.02 < found.slope < 0.5
    assert compare_contrast(np.stack([local, local]), local).slope == pytest.approx(1.0)


@pytest.mark.long
def test_diffuse_normals_state_error_of_grooves(images):
    """Bound: half to twice the stated error; light that stays where it entered exceeds it."""
    patch, rig, _, light = images
    scattered, local = (
        judge_diffuse_normals(np.stack(2 * [light[way] / light[way][0].mean()]), patch, rig)
        for way in (True, False)
    )
    assert 0.5 < scattered.error_rad / scattered.stated_rad < 2.0
    assert max(scattered.coverage_by_noise) == 0.0
    assert local.error_rad > 4.0 * scattered.stated_rad
