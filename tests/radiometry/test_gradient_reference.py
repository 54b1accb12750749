"""The gradient rig's moments against shadow rays, and against Mitsuba."""

import numpy as np
import pytest

from rigsim.as_built.sphere import PATTERN_WEIGHTS
from rigsim.scenes.gradient.reference import (
    compare_with_reference,
    plain_scene,
    plain_skin,
    render_pattern,
    scene_pixels,
    trace_pixels,
)

pytestmark = pytest.mark.render

WIDTH = 48


@pytest.fixture(scope="module")
def skin():
    return plain_skin(WIDTH * 0.006 + 0.9)


@pytest.fixture(scope="module")
def pixels():
    return np.sort(np.random.default_rng(0).choice(WIDTH**2, 300, replace=False))


@pytest.fixture(scope="module")
def reference(skin, pixels):
    return trace_pixels(plain_scene(skin, width_px=WIDTH), pixels, subpixels=3)[0]


@pytest.fixture(scope="module")
def estimated(skin, pixels):
    """Moments of the pixels, from horizons."""
    return scene_pixels(plain_scene(skin, width_px=WIDTH), pixels)


def test_horizon_moments_match_shadow_rays(estimated, reference):
    """All four moments; horizons in 32 directions, table and samples err by less than 1 %."""
    for moment in range(4):
        error = estimated[:, moment] - reference[:, moment]
        assert np.sqrt(np.mean(error**2)) < 0.01 * reference[:, 0].mean()


def test_leaving_shadows_out_is_worse(skin, pixels, estimated, reference):
    bright = scene_pixels(plain_scene(skin, width_px=WIDTH, shadows=False), pixels)
    with_shadows, without = (
        compare_with_reference(moments, reference, 0.0) for moments in (estimated, bright)
    )
    assert without.error > 3.0 * with_shadows.error


@pytest.mark.long
@pytest.mark.parametrize("pattern", ["full", "-x", "z"])
def test_mitsuba_s_mean_is_ours(skin, pixels, pattern):
    """z-test of the mean over blocks of pixels: false alarm 1e-4 a pattern (|z| < 3.9)."""
    scene = plain_scene(skin, width_px=WIDTH)
    every = np.arange(WIDTH**2)
    ours = scene_pixels(scene, every) @ np.array(PATTERN_WEIGHTS[pattern])
    image, _ = render_pattern(scene, pattern, samples=64)
    way = compare_with_reference(image.reshape(-1).astype(float), ours, 0.0)
    assert abs(way.mean_ratio - 1.0) < 3.9 * way.mean_ratio_stderr
    assert way.mean_ratio_stderr < 0.01
