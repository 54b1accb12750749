"""Light from furrow to furrow on relief of skin, against Mitsuba's path tracer."""

from __future__ import annotations

import numpy as np
import pytest

from rigsim import shading
from rigsim.light.relief_shadow import hidden_sky_fraction
from rigsim.scenes.gradient.reference import (
    NEUTRAL_GRIP,
    plain_scene,
    plain_skin,
    render_pattern,
    scene_pixels,
)
from rigsim.tissue.skin_layers import ETA

pytestmark = pytest.mark.render

WIDTH = 48
BLOCK = 6
SEEDS = 4


@pytest.fixture(scope="module")
def skin():
    return plain_skin(WIDTH * 0.006 + 0.9)


@pytest.fixture(scope="module")
def ours(skin):
    every = np.arange(WIDTH**2)
    light = [
        scene_pixels(plain_scene(skin, width_px=WIDTH, interreflections=on), every)[:, 0]
        for on in (True, False)
    ]
    return (light[0] - light[1]).reshape(WIDTH, WIDTH)


@pytest.fixture(scope="module")
def traced(skin):
    """All bounces less direct light alone, once a seed, shape (SEEDS, H, W)."""
    scene = plain_scene(skin, width_px=WIDTH)
    return np.array(
        [
            render_pattern(scene, "full", samples=96, seed=seed, depth=8, specular=False)[0]
            - render_pattern(scene, "full", samples=96, seed=seed, depth=2, specular=False)[0]
            for seed in range(SEEDS)
        ]
    )


@pytest.mark.long
def test_groove_wall_irradiance_matches_path_tracing(ours, traced):
    """Expected: Mitsuba's mean over a patch of cheek. Tolerance: 10 %, the model's own, which takes
    one transmittance for two walls (measured 6 to 7 % high), and 4 standard errors of the mean."""
    means = traced.mean(axis=(1, 2))
    stderr = means.std(ddof=1) / np.sqrt(SEEDS)
    assert stderr < 0.02 * means.mean()
    assert abs(ours.mean() - means.mean()) < 0.10 * means.mean() + 4.0 * stderr


@pytest.mark.long
def test_groove_wall_interreflection_distribution_matches_path_tracing(ours, traced):
    def blocks(image):
        return image.reshape(WIDTH // BLOCK, BLOCK, -1, BLOCK).mean(axis=(1, 3)).ravel()

    assert np.corrcoef(blocks(ours), blocks(traced.mean(axis=0)))[0, 1] > 0.95


def test_angle_independent_walls_receive_far_too_much_light(skin):
    """What goes along the surface passes the boundary badly: an average over all angles, which the
    test above refuses, is 1.5 times as much or more."""
    patch = plain_scene(skin, width_px=WIDTH).surface(NEUTRAL_GRIP, subpixels=1, border_px=40)
    shares = [
        hidden_sky_fraction(
            np.ascontiguousarray(1e3 * patch.height_mm),
            patch.normals,
            margin=0,
            pixel_um=6.0,
            sectors=16,
            boundaries=on,
        ).mean()
        for on in (False, True)
    ]
    assert shading.average_transmittance(ETA) ** 2 * shares[0] > 1.5 * shares[1] > 0.0
