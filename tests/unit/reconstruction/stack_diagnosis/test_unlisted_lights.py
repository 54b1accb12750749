"""Lights without a list: directions, their errors, and what the images leave undetermined."""

import numpy as np
import pytest
from fixtures.faulty_stacks import dome, render

from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.stack_diagnosis.unlisted_lights import (
    HOLLOW_FACTORS,
    MAX_STDERR_DEG,
    _equalize_strengths,
    estimate_lights,
)


def angle_deg(found, lights):
    return np.degrees(np.arccos(np.clip((found * lights).sum(axis=1), -1.0, 1.0)))


def photograph(shape, lights, seed, *, spread=0.03, gloss=0.3, side=80):
    rng = np.random.default_rng(seed)
    gains = rng.lognormal(0.0, spread, len(lights))
    return render(shape, lights, rng, side=side, gloss=gloss, noise=0.01, gains=gains)


@pytest.mark.parametrize(
    ("shape", "count", "seed", "sign"),
    [
        ("head", 24, 11, "cast shadows"),
        ("relief", 24, 12, "cast shadows"),
        ("ball", 12, 13, "outline"),
    ],
)
def test_directions_are_found_without_list(shape, count, seed, sign):
    lights = dome(count, np.random.default_rng(seed), 60)
    images, inside = photograph(shape, lights, seed)
    found = estimate_lights(images, inside=inside, rng=np.random.default_rng(0))
    error = angle_deg(found.directions, lights)
    assert error.mean() < 2.5
    assert error.mean() < 3.0 * np.median(found.stderr_deg)
    assert found.sign == sign
    assert found.sign_evidence > 0.1
    # the test can fail: the hollow twin explains all shading and is far off
    assert angle_deg(found.directions * HOLLOW_FACTORS, lights).mean() > 45.0


def test_stated_error_grows_with_unequal_lights():
    lights = dome(24, np.random.default_rng(3), 60)
    stated, error = [], []
    for spread in (0.0, 0.02, 0.15):
        images, inside = photograph("head", lights, 3, spread=spread, side=64)
        found = estimate_lights(images, inside=inside, rng=np.random.default_rng(0))
        stated.append(float(np.median(found.stderr_deg)))
        error.append(float(angle_deg(found.directions, lights).mean()))
    # real lamps differ by a few percent, which a flatter surface can hide
    assert stated[0] == pytest.approx(stated[1], rel=0.1)
    assert stated[2] > 2.0 * stated[1]
    assert error[2] < 3.0 * stated[2]


def test_hidden_differences_of_strength_widen_stated_error():
    """Strengths that differ by 2 % let a flatter surface under steeper lights fit exactly."""
    lights = dome(12, np.random.default_rng(4), 25)
    tilt = np.deg2rad(20.0)
    lights = lights @ [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    flatter = np.stack([lights[:, 0], lights[:, 1], 0.6 * lights[:, 1] + 2.0 * lights[:, 2]], 1)
    strength = 1.0 / np.linalg.norm(flatter, axis=1)
    assert np.log(strength).std() == pytest.approx(0.022, abs=0.002)
    found, error = _equalize_strengths(lights * strength[:, None])
    unit = found / np.linalg.norm(found, axis=1, keepdims=True)
    assert angle_deg(unit, lights).mean() > 10.0
    assert np.degrees(np.median(error)) > MAX_STDERR_DEG


def ring(height, count=16):
    phi = 2.0 * np.pi * np.arange(count) / count
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(phi), across * np.sin(phi), np.full(count, height)], axis=1)


def test_one_ring_of_lights_is_refused():
    images, inside = photograph("head", ring(np.sqrt(0.51)), 5, side=64)
    with pytest.raises(PhotometricStereoError, match="give a list of the lights"):
        estimate_lights(images, inside=inside, rng=np.random.default_rng(0))


@pytest.mark.parametrize("height", [0.3, 0.71, 0.9])
@pytest.mark.parametrize("spread", [0.0, 0.03])
def test_ring_leaves_directions_open(height, spread):
    """Whatever the noise of the strengths, no fit of a ring states a small error and is wrong."""
    lights = ring(height) * np.random.default_rng(4).lognormal(0.0, spread, 16)[:, None]
    found, error_rad = _equalize_strengths(lights * (1.0, 1.0, 0.8))
    unit = found / np.linalg.norm(found, axis=1, keepdims=True)
    wrong = np.median(angle_deg(unit, ring(height)))
    assert np.median(np.degrees(error_rad)) > min(MAX_STDERR_DEG, wrong / 3.0)


def test_flat_object_is_refused():
    rng = np.random.default_rng(6)
    level = dome(24, rng, 60)[:, 2, None, None] * np.ones((1, 40, 40))
    with pytest.raises(PhotometricStereoError, match="from a curved object"):
        estimate_lights(0.5 * level + 0.001 * rng.normal(size=level.shape), rng=rng)


def test_too_few_images_are_refused():
    with pytest.raises(PhotometricStereoError, match="got 7 images, expected 8"):
        estimate_lights(np.ones((7, 40, 40)), rng=np.random.default_rng(0))
