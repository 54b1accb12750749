import numpy as np
import pytest

from model.microstructure.kernel_table import (
    FOREHEAD,
    KernelTable,
    forehead_points,
    kernel_parameters,
)
from reconstruction.kernel_fit.table import (
    KernelTableFitError,
    alpha_rms,
    estimate_direction_dependence,
    fit_table,
)


def test_published_points_give_published_sigma_lines():
    points = forehead_points()
    fit = fit_table(points.stretch, points.alpha, points.sigma_um)
    for ours, paper in (
        (fit.table.sigma_compression_um, FOREHEAD.sigma_compression_um),
        (fit.table.sigma_stretch_um, FOREHEAD.sigma_stretch_um),
    ):
        np.testing.assert_allclose(ours, paper, rtol=0.10)
    np.testing.assert_allclose(fit.table.sigma_compression_um, (73.6, -49.4), atol=0.05)
    np.testing.assert_allclose(fit.table.sigma_stretch_um, (38.9, -27.35), atol=0.05)
    assert np.isfinite([fit.sigma_compression_stderr_um, fit.sigma_stretch_stderr_um]).all()


def test_alpha_fits_published_points_like_eq_8():
    points = forehead_points()
    fit = fit_table(points.stretch, points.alpha, points.sigma_um)
    paper = alpha_rms(FOREHEAD, points.stretch, points.alpha)
    assert fit.segments <= len(FOREHEAD.alpha_lines) == 2
    assert alpha_rms(fit.table, points.stretch, points.alpha) <= paper
    assert alpha_rms(fit.table, points.stretch, points.alpha) == pytest.approx(fit.alpha_rms)
    assert np.isfinite([*fit.alpha_stderr, *fit.break_stderr]).all()
    one = fit_table(points.stretch, points.alpha, points.sigma_um, max_segments=1)
    assert one.alpha_rms > paper  # a single line would not do


def bent(r):
    return np.where(r < 0.9, 9.0 * (r - 0.9) - 0.2, 2.0 * (r - 1.0))


def test_a_bent_line_comes_back_with_its_break(rng):
    r = np.concatenate([np.linspace(0.76, 0.98, 8), np.linspace(1.03, 1.3, 8)])
    pulls = []
    for _ in range(20):
        alpha = np.clip(bent(r) + 0.03 * rng.standard_normal(r.size), -2, 1)
        fit = fit_table(r, alpha, 40 * r - 25)
        assert fit.segments == 2
        assert abs(fit.table.alpha_breaks[0] - 0.9) < 0.03
        pulls.append((fit.table.alpha_lines[1][0] - 2.0) / fit.alpha_stderr[1])
    # mean square of 20 pulls lies in 0.37...2.0 in 99.8 %; that breaks are fitted too widens it
    assert 0.37 < np.mean(np.square(pulls)) < 2.5


def test_a_straight_line_is_not_broken(rng):
    r = np.concatenate([np.linspace(0.8, 0.98, 10), np.linspace(1.02, 1.25, 10)])
    alpha = 2.5 * (r - 1.0) + 0.02 * rng.standard_normal(r.size)
    fit = fit_table(r, alpha, 20.0 * r, max_segments=3)
    assert fit.segments == 1
    assert abs(fit.table.alpha_lines[0][0] - 2.5) < 4 * fit.alpha_stderr[0]


def test_weights_leave_a_bad_point_out():
    points = forehead_points()
    r, a, s = (
        [*values, bad]
        for values, bad in zip(
            (points.stretch, points.alpha, points.sigma_um), (1.1, -2.0, 90.0), strict=True
        )
    )
    spoiled = fit_table(r, a, s)
    mended = fit_table(r, a, s, weights=[1.0] * 8 + [0.0])
    clean = fit_table(points.stretch, points.alpha, points.sigma_um)
    assert mended.table == clean.table
    assert spoiled.table != clean.table


def test_single_sided_points_make_single_sided_table():
    r = np.array([1.05, 1.1, 1.15, 1.2])
    fit = fit_table(r, 3.0 * (r - 1.0), 20.0 * r)
    assert fit.table.sigma_compression_um is None
    assert fit.table.stretch_range == (1.0, 1.2)
    assert not fit.table.inside(0.9)
    alpha, sigma_um = kernel_parameters(1.1, fit.table)
    assert alpha == pytest.approx(0.3)
    assert sigma_um == pytest.approx(22.0)


def test_points_that_determine_no_table_are_refused():
    with pytest.raises(KernelTableFitError, match="stretching"):
        fit_table([0.8, 0.9, 1.1], [-1, -0.5, 0.3], [10, 12, 14])
    with pytest.raises(KernelTableFitError, match="point 1"):
        fit_table([0.8, 0.9], [-1, np.nan], [10, 12])
    with pytest.raises(KernelTableFitError, match="neutral points only"):
        fit_table([1.0, 1.0], [0.0, 0.0], [10, 12])


def test_table_goes_through_json():
    points = forehead_points()
    table = fit_table(points.stretch, points.alpha, points.sigma_um, source="here").table
    assert KernelTable.from_json(table.to_json()) == table


def test_deviating_direction_is_separated_from_equal_ones(rng):
    r = np.tile([0.8, 0.87, 0.93, 1.07, 1.14, 1.21], 4)
    angle = np.repeat(np.radians([0.0, 45.0, 90.0, 135.0]), 6)
    alpha, sigma = kernel_parameters(r)
    chances = []
    for shift in (0.0, 0.4):
        noisy = alpha + 0.05 * rng.standard_normal(r.size) + shift * (angle > 2.0)
        found = estimate_direction_dependence(FOREHEAD, r, noisy, sigma, angle)
        assert abs(found.alpha_offset[3] - shift) < 5 * found.alpha_stderr[3]
        chances.append(found.p_alpha)
    assert chances[0] > 1e-3 > 1e-6 > chances[1]
    with pytest.raises(KernelTableFitError, match="directions"):
        estimate_direction_dependence(FOREHEAD, r, alpha, sigma, np.zeros(r.size))


def test_vanishing_sigma_line_is_clamped_to_smallest_sigma():
    """Points that rise steeply, as the flat valley of alpha and sigma gives them."""
    fit = fit_table([1.1, 1.19, 1.28], [0.28, 0.5, 0.7], [23.5, 92.5, 91.0])
    slope, intercept = fit.table.sigma_stretch_um
    assert slope + intercept == pytest.approx(1.0, abs=1e-6)
    # the best line without the bound runs below zero at r = 1
    free = np.polyfit([1.1, 1.19, 1.28], [23.5, 92.5, 91.0], 1)
    assert np.polyval(free, 1.0) < 0.0
    # no line within the bound is nearer to the points
    r, s = np.array([1.1, 1.19, 1.28]), np.array([23.5, 92.5, 91.0])
    best = np.sum((slope * r + intercept - s) ** 2)
    for end in np.linspace(40.0, 200.0, 400):
        other = 1.0 + (end - 1.0) * (r - 1.0) / 0.28
        assert np.sum((other - s) ** 2) >= best - 1e-6
