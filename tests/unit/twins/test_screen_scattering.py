"""Screen-space scattering against what Gaussians do to edges, planes and steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import erf
from twins import screen_scattering
from twins.screen_scattering import ScreenScatteringError, scatter

DEPTH_MM = 500.0
VARIANCES = (0.05, 0.4, 3.0)
WEIGHTS = np.array([[0.3, 0.5, 0.7], [0.4, 0.4, 0.2], [0.3, 0.1, 0.1]])


def _edge(distance_mm):
    bands = 0.5 + 0.5 * erf(distance_mm[:, None] / np.sqrt(2.0 * np.array(VARIANCES)))
    return bands @ WEIGHTS


def _largest_error_at_an_edge(px_per_mm, slope):
    """Blur a half-lit plane that slants, against the exact edge averaged over each pixel."""
    column = np.arange(257) - 128
    depth = np.broadcast_to(DEPTH_MM + slope * column / px_per_mm, (5, 257))
    lit = np.broadcast_to(((column > 0) + 0.5 * (column == 0))[:, None], (257, 3))
    out = scatter(
        np.broadcast_to(lit, (5, 257, 3)),
        depth,
        variances_mm2=VARIANCES,
        weights=WEIGHTS,
        focal_px=px_per_mm * DEPTH_MM,
    )
    along = np.hypot(1.0, slope) / px_per_mm
    exact = np.mean([_edge((column + k) * along) for k in np.linspace(-0.5, 0.5, 21)], axis=0)
    return np.abs(out[2] - exact).max()


@pytest.mark.parametrize("px_per_mm", [0.5, 1.0, 2.0, 4.0, 8.0])
@pytest.mark.parametrize("slope", [0.0, 1.0])
def test_light_edge_spreads_as_gaussians_at_any_size(px_per_mm, slope):
    # 2 %: the narrowest Gaussian is a quarter of a pixel to two pixels wide
    assert _largest_error_at_an_edge(px_per_mm, slope) < 0.02


def test_the_edge_shows_when_interpolation_is_not_undone(monkeypatch):
    monkeypatch.setattr(screen_scattering, "narrowed", np.asarray)
    assert _largest_error_at_an_edge(1.0, 0.0) > 0.04


def test_uniform_light_is_unchanged_up_to_outline():
    depth = np.zeros((40, 40))
    depth[8:32, 5:30] = DEPTH_MM + np.arange(25)
    out = scatter(
        np.full((40, 40, 3), 0.7),
        depth,
        variances_mm2=VARIANCES,
        weights=WEIGHTS,
        focal_px=DEPTH_MM,
    )
    np.testing.assert_allclose(out[depth > 0.0], 0.7, atol=1e-12)
    assert np.all(out[depth == 0.0] == 0.0)


def test_light_does_not_leak_across_depth_step():
    depth = np.full((9, 60), DEPTH_MM)
    light = np.zeros((9, 60, 3))
    light[:, :30] = 1.0
    how = {"variances_mm2": VARIANCES, "weights": WEIGHTS, "focal_px": 4.0 * DEPTH_MM}
    together = scatter(light, depth, **how)[4]
    depth[:, 30:] += 40.0
    apart = scatter(light, depth, **how)[4]
    # two pixels behind the step are interpolated with those before it, once by each Gaussian
    assert apart[30:32].max() < 0.1
    assert np.all(apart[32:36].sum(axis=-1) < 0.15 * together[32:36].sum(axis=-1))
    assert together[32:36, 0].min() > 0.05


def test_a_wider_skin_spreads_light_further():
    light = np.zeros((3, 101, 3))
    light[:, 51:] = 1.0
    depth = np.full((3, 101), DEPTH_MM)
    widths = [
        scatter(light, depth, variances_mm2=VARIANCES, weights=WEIGHTS, focal_px=DEPTH_MM, width=w)[
            1, 45, 0
        ]
        for w in (0.5, 1.0, 2.0)
    ]
    assert widths[0] < widths[1] < widths[2]


def test_measured_albedo_blurs_twice_except_post_scatter_texturing():
    x = np.arange(81)
    albedo = np.repeat((0.4 + 0.1 * np.sin(0.6 * x))[None, :, None], 3, axis=2).repeat(5, axis=0)
    depth = np.full((5, 81), DEPTH_MM)
    contrast = {}
    for name, (before, behind) in screen_scattering.ALBEDO_POWERS.items():
        spread = scatter(
            albedo**before, depth, variances_mm2=VARIANCES, weights=WEIGHTS, focal_px=DEPTH_MM
        )
        contrast[name] = float(np.ptp((spread * albedo**behind)[2, 20:60, 0]))
    assert contrast["post"] == pytest.approx(0.2, rel=0.01)
    assert contrast["pre"] < contrast["both"] < 0.95 * contrast["post"]


def test_variances_that_shrink_are_refused():
    with pytest.raises(ScreenScatteringError, match="growing"):
        scatter(
            np.ones((2, 2, 3)),
            np.ones((2, 2)),
            variances_mm2=[1.0, 0.5],
            weights=np.ones((2, 3)),
            focal_px=1.0,
        )
