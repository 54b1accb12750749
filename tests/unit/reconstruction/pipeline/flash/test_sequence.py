"""Frames of a sequence laid over the face at rest: their errors are those from frame to frame."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from scipy import ndimage

from model.skin import SkinMap
from reconstruction.pipeline.flash.sequence import _align_to_rest

SIDE, NOISE, PROMPT_S = 128, 5e-4, 5.0
PHASE = (5.5 * np.arange(22)) % (2 * PROMPT_S) + 0.007


def frames(rng, asked):
    """Return skin in noise that is stretched while the expression is asked for, and its errors."""
    grain = rng.standard_normal((SIDE, SIDE))
    relief = sum(ndimage.gaussian_filter(grain, sigma) * sigma for sigma in (1.5, 3.0, 6.0))
    still = 0.3 * np.exp(0.15 * relief / relief.std())
    rows, columns = np.indices(still.shape, float)
    away = 3.0 * np.exp(-((rows - SIDE / 2) ** 2 + (columns - SIDE / 2) ** 2) / (2 * 30.0**2))
    shifted = ndimage.map_coordinates(still, [rows, columns - 1.0 - away], order=3, mode="nearest")
    color = np.array([1.0, 0.6, 0.45])
    maps = []
    for on in asked:
        clean = (shifted if on else still)[..., None] * color
        seen = clean + NOISE * rng.standard_normal(clean.shape)
        maps.append(SkinMap(seen.astype(np.float32), "1", np.full(clean.shape, NOISE)))
    return maps


def test_same_pose_frames_scatter_as_stated_without_alignment():
    """One alignment lays all of them: its error is theirs together, a step and no noise."""
    asked = PHASE < PROMPT_S
    evidence = SimpleNamespace(assumed=[])
    moved, laid = _align_to_rest(
        frames(np.random.default_rng(20), asked), PHASE, PROMPT_S, evidence
    )
    assert evidence.assumed == []
    np.testing.assert_array_equal(moved, asked)
    inner = (slice(24, -24), slice(24, -24))
    for pose in (asked, ~asked):
        chosen = [m for m, is_on in zip(laid, pose, strict=True) if is_on]
        values = np.array([m.values[inner] for m in chosen], float)
        told = np.array([m.stderr[inner] for m in chosen], float)
        scatter = np.mean(values.var(axis=0, ddof=1))
        # of 10 frames and thousands of pixels the variance is known to a few percent; what
        # interpolation averages is told by its mean
        assert 0.85 < scatter / np.mean(np.square(told)) < 1.15
