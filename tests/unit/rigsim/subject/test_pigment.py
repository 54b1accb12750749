"""Suntan of a face has no visible border."""

import numpy as np
import pytest
from scipy.ndimage import binary_erosion, gaussian_filter

from rigsim.geometry.atlas import unwrap
from rigsim.subject import pigment
from rigsim.subject.face_regions import region_masks, soft_step
from rigsim.subject.head import build_head

BASE = 0.0093
"""Pale skin, whose suntan has the largest contrast."""


@pytest.fixture(scope="module")
def face():
    """Points of the front of a head, its regions, and the pixels away from its outline and lips."""
    atlas = unwrap(build_head(np.random.default_rng(5)), 400)
    points = atlas.position_mm
    regions = region_masks(points)
    front = atlas.covered & (points[..., 2] > -40.0) & (regions["lips"] < 0.01)
    return points, regions, binary_erosion(front, iterations=3)


def steepness(face, log_melanin):
    """Return the slope of smoothed log melanin to the next texels, per mm."""
    points, _, inside = face
    smooth, steep = gaussian_filter(log_melanin, 1.5), np.zeros(inside.shape)
    for axis in (0, 1):
        gap = np.linalg.norm(np.diff(points, axis=axis, append=np.nan), axis=-1)
        rise = np.abs(np.diff(smooth, axis=axis, append=np.nan))
        slope = np.where(gap < 3.0, rise / np.maximum(gap, 0.2), 0.0)
        steep = np.maximum(steep, slope)
    return steep


def compare_border(face, seed):
    """Return slopes at the border of the suntan, and of the skin alone."""
    points, regions, inside = face
    pale = -pigment._suntan(points, BASE, np.random.default_rng([seed, 1]))
    log = np.log(pigment.draw_melanin_map(points, regions, BASE, seed=seed, freckles=0.0))
    border = inside & (pale > 0.25 * pale.max()) & (pale < 0.75 * pale.max())
    assert border.sum() > 300
    return steepness(face, log)[border], steepness(face, log + pale)[inside]


@pytest.mark.parametrize("seed", range(6))
def test_suntan_border_is_within_skin_variation(face, seed):
    at_border, own = compare_border(face, seed)
    assert np.median(at_border) < 2.0 * np.median(own)
    assert np.percentile(at_border, 90) < np.percentile(own, 99)


def test_crisp_border_is_found(face, monkeypatch):
    monkeypatch.setattr(pigment, "soft_step", lambda t: soft_step(6.0 * t))
    at_border, own = compare_border(face, 0)
    assert np.median(at_border) > 2.0 * np.median(own)
    assert np.percentile(at_border, 90) > np.percentile(own, 99)
