"""Affine maps through displaced windows, and how far fields alike in neighbors move them."""

import numpy as np
import pytest

from reconstruction.registration.affine_fit import fit_affine

WINDOW_PX = 25.0
TRUE = np.array([[1.1, 0.02], [-0.01, 0.95]])


def windows(rng, side=5):
    """Places of one window in each cell, as texture happens to lie."""
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    return (grid - (side - 1) / 2 + rng.uniform(-0.4, 0.4, grid.shape)) * WINDOW_PX


def waves(places, reach_px, rng, count=60):
    """Displacements as sums of plane waves: the field has no correlation matrix to share."""
    wave = rng.normal(size=(count, 2)) * np.sqrt(2.0) / reach_px
    phase = rng.uniform(0, 2 * np.pi, (count, 2))
    each = np.cos((places @ wave.T)[..., None] + phase)
    return each.sum(axis=1) * np.sqrt(2.0 / count)


def test_exact_displacements_give_the_map_and_no_error(rng):
    places = windows(rng)
    solution, covariance = fit_affine(places, places @ TRUE.T + [3.0, -2.0], window_px=WINDOW_PX)
    np.testing.assert_allclose(solution, np.vstack([TRUE.T, [3.0, -2.0]]), atol=1e-6)
    assert np.sqrt(np.diag(covariance)).max() < 1e-6


def test_window_errors_give_least_squares_error(rng):
    places = windows(rng, side=12)
    design = np.column_stack([places, np.ones(len(places))])
    stated = [
        fit_affine(places, places + rng.normal(0.0, 0.3, places.shape), window_px=WINDOW_PX)[1]
        for _ in range(20)
    ]
    expected = 0.09 * np.linalg.inv(design.T @ design)
    order = [0, 1, 0, 1, 2, 2]
    mean = np.sqrt(np.mean([np.diag(one) for one in stated], axis=0))
    # what can be told of a field from 144 windows leaves room for a weak one
    np.testing.assert_allclose(mean, np.sqrt(np.diag(expected)[order]), rtol=0.15)


def test_covariance_layout_matches_map(rng):
    """A field that moves windows along y alone leaves the first row of F without error."""
    places = windows(rng)
    found = places @ TRUE.T
    found[:, 1] += rng.normal(0.0, 0.5, len(places))
    _, covariance = fit_affine(places, found, window_px=WINDOW_PX)
    spread = np.sqrt(np.diag(covariance))
    assert spread[[0, 1, 4]].max() < 1e-3 * spread[[2, 3, 5]].min()


@pytest.mark.parametrize("reach", [0.8, 1.2])
def test_intervals_have_coverage_where_neighbors_are_alike(reach, rng):
    """A smooth random field, by waves; least squares with its scatter is far too sure of itself."""
    trials, inside, naive = 200, 0, 0
    for _ in range(trials):
        places = windows(rng)
        off = waves(places, reach * WINDOW_PX, rng) + rng.normal(0.0, 0.1, places.shape)
        solution, covariance = fit_affine(places, places @ TRUE.T + off, window_px=WINDOW_PX)
        inside += abs(solution[0, 0] - TRUE[0, 0]) <= np.sqrt(covariance[0, 0])
        design = np.column_stack([places, np.ones(len(places))])
        plain = np.linalg.lstsq(design, off)[0]
        scatter = np.sum((off - design @ plain) ** 2, axis=0) / (len(places) - 3)
        alone = scatter[0] * np.linalg.inv(design.T @ design)[0, 0]
        naive += abs(plain[0, 0]) <= np.sqrt(alone)
    # the promised 60 to 76 %, and two standard deviations of so many trials
    chance = 2.0 * np.sqrt(0.68 * 0.32 / trials)
    assert 0.60 - chance <= inside / trials <= 0.76 + chance
    assert naive / trials < 0.60


def test_points_on_a_line_are_refused(rng):
    places = np.column_stack([np.arange(10.0), np.arange(10.0)])
    with pytest.raises(ValueError, match="not all on one line"):
        fit_affine(places, places, window_px=WINDOW_PX)
