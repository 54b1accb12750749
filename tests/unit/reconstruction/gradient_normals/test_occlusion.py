"""Variance of slopes that grooves hide from gradient light."""

import math

import numpy as np
import pytest

from reconstruction.gradient_normals import GradientError, SphereLights
from reconstruction.gradient_normals.occlusion import (
    HORIZON_DIRECTIONS,
    estimate_occlusion_ratios,
    find_horizons,
)

PIXEL_UM = 6.0


def even_sphere(count=200):
    """Return directions of an even sphere of lights (a Fibonacci spiral)."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = math.pi * (1.0 + math.sqrt(5.0)) * np.arange(count)
    across = np.sqrt(1.0 - z**2)
    return SphereLights(np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1))


def grooves(depth_um, side=96, period_px=24):
    """Return grooves that run along the rows' axis, sinusoidal along x."""
    wave = 0.5 * depth_um * np.cos(2.0 * np.pi * np.arange(side) / period_px)
    return np.tile(wave, (side, 1))


def ratios(relief, **settings):
    valid = np.ones(relief.shape, bool)
    return estimate_occlusion_ratios(
        relief, valid, pixel_um=PIXEL_UM, lights=even_sphere(), alpha=0.25, **settings
    )


def test_horizons_of_a_step_follow_its_height():
    """A wall of height h at distance d hides what is below h / d; behind it nothing is hidden."""
    relief = np.zeros((41, 41))
    relief[:, 31:] = 12.0  # 9 pixels from the first one
    found = find_horizons(relief, [20, 20], [22, 38], pixel_um=PIXEL_UM)
    assert found[0, 0] == pytest.approx(12.0 / (9 * PIXEL_UM))
    assert found[0, HORIZON_DIRECTIONS // 2] == 0.0
    assert found[1].max() < 1e-12


def test_horizons_turn_counterclockwise_from_the_right():
    relief = np.zeros((41, 41))
    relief[:10] = 50.0  # a wall at the top of the image
    (found,) = find_horizons(relief, [20], [20], pixel_um=PIXEL_UM)
    assert found[HORIZON_DIRECTIONS // 4] == found.max() > 0.5
    assert found[HORIZON_DIRECTIONS // 2 :].max() < 1e-12


def test_flat_relief_hides_nothing():
    found = ratios(np.zeros((32, 32)))
    assert (found.along, found.across) == (1.0, 1.0)


def test_deeper_grooves_hide_more_of_their_variance():
    found = [ratios(grooves(depth)) for depth in (10.0, 30.0, 60.0)]
    along = [one.along for one in found]
    assert (np.diff(along) > 0.0).all()
    assert along[-1] > 1.05
    assert np.all(np.diff([one.visible_fraction for one in found]) < 0.0)
    assert [one.across for one in found] == [1.0, 1.0, 1.0]


def test_ratios_turn_with_the_jaws():
    along = ratios(grooves(60.0))
    across = ratios(grooves(60.0), angle_rad=math.pi / 2)
    assert across.across == pytest.approx(along.along, rel=1e-9)


def test_wide_map_has_ratios_of_small_one():
    """512 inner columns are a multiple of the period: even steps would sample one phase.

    Tolerance: 8192 of the pixels are sampled, and borders of the small map hide nothing.
    """
    wide, small = (
        ratios(grooves(60.0, side=side, period_px=32)).along for side in (514, 2 + 2 * 32)
    )
    assert small > 1.05
    assert wide - 1.0 == pytest.approx(small - 1.0, rel=0.15)


def test_uncounted_pixels_cast_shadows_only():
    relief = grooves(60.0)
    left = np.arange(96) < 48
    flat = np.where(left, relief, relief[:, 47:48])
    counted = np.broadcast_to(left, relief.shape)
    whole, half = ratios(relief), ratios(flat, counted=counted)
    assert half.along == pytest.approx(whole.along, rel=0.03)
    assert ratios(flat).along == pytest.approx(half.along, rel=0.03)
    walls = np.where(left, 0.0, relief)
    assert ratios(walls).along > 1.05
    assert ratios(walls, counted=counted & (np.arange(96) < 47)).along == 1.0


def test_mask_without_inner_pixels_is_refused():
    with pytest.raises(GradientError, match="valid"):
        estimate_occlusion_ratios(
            np.zeros((8, 8)),
            np.zeros((8, 8), bool),
            pixel_um=PIXEL_UM,
            lights=even_sphere(),
            alpha=0.25,
        )
