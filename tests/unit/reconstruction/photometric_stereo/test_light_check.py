"""A wrong order of lights and a dead light show in the shading."""

import numpy as np
import pytest

from reconstruction.normal_maps import PhotometricStereoError
from reconstruction.photometric_stereo import light_check


def scene(rng, lights=24, points=800, noise=0.01):
    direction = rng.standard_normal((lights, 3)) * 0.6 + [0, 0, 1.0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    n = rng.standard_normal((points, 3)) * 0.4 + [0, 0, 1.0]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    samples = rng.uniform(0.3, 0.9, points) * np.maximum(direction @ n.T, 0.0)
    return samples + noise * rng.standard_normal(samples.shape), direction


def test_the_right_order_is_left_alone(rng):
    samples, direction = scene(rng)
    found = light_check.check_lights(samples, direction, rng=rng)
    assert found.order == "as listed"
    assert not found.dead.any()
    np.testing.assert_allclose(found.strength, 1.0, atol=0.03)


@pytest.mark.parametrize(
    "name",
    [
        "reversed",
        "shifted by one",
        "shifted by one backwards",
        "sorted as text",
        "sorted as numbers",
        "every second one first",
        "the halves exchanged",
    ],
)
def test_wrong_order_is_reported_and_corrected(name, rng):
    samples, direction = scene(rng)
    order = light_check._orders(24)[name]
    listed = np.empty_like(direction)
    listed[order] = direction
    found = light_check.check_lights(samples, listed, rng=rng)
    assert found.order == name
    np.testing.assert_array_equal(listed[found.permutation], direction)
    assert found.misfit[name] < 0.5 * found.misfit["as listed"]


def test_implausible_order_is_called_unknown(rng):
    samples, direction = scene(rng)
    found = light_check.check_lights(samples, rng.permutation(direction), rng=rng)
    assert found.order == "unknown"


def test_dead_light_is_found_and_weak_lights_measured(rng):
    samples, direction = scene(rng)
    samples[7] = 0.002 * rng.standard_normal(samples.shape[1])
    samples[11] *= 0.5
    found = light_check.check_lights(samples, direction, rng=rng)
    assert found.order == "as listed"
    assert np.flatnonzero(found.dead).tolist() == [7]
    assert found.strength[7] == 0
    assert found.strength[11] == pytest.approx(0.5, rel=0.1)


def test_a_light_from_behind_is_not_dead(rng):
    samples, direction = scene(rng)
    direction[3] = [0.98, 0.0, -0.2]
    n = rng.standard_normal((800, 3)) * 0.4 + [0, 0, 1.0]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    samples = np.maximum(direction @ n.T, 0.0)
    assert not light_check.check_lights(samples, direction, rng=rng).dead.any()


def test_a_dark_room_is_refused(rng):
    _, direction = scene(rng)
    with pytest.raises(PhotometricStereoError, match="lit"):
        light_check.check_lights(np.zeros((24, 50)), direction, rng=rng)
