"""The sampler behind the photon table by itself: energy, repetition, parts put together."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from model.tissue_optics import adding_doubling

pytestmark = pytest.mark.long  # compiles the walk
PATH = Path(__file__).parents[4] / "tools" / "photon_walk.py"
SEED = np.array([11, 12, 13], np.uint64)


@pytest.fixture(scope="module")
def recipe():
    spec = importlib.util.spec_from_file_location("photon_walk", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # compiled code is loaded again by its module's name
    spec.loader.exec_module(module)
    return module


def traced(recipe, seed, photons, fiber, path_end):
    hist = np.zeros((recipe.ETAS.size, recipe.RADIUS_BINS, recipe.PATH_BINS, 2))
    recipe.walk(photons, seed, 0.8, fiber, recipe.ETAS, path_end, hist)
    return hist / photons


def test_single_walk_serves_all_indices_and_absorptions(recipe):
    # 20 batches: beyond 4 standard errors in one of 21 totals once in 60 runs (t, 19 dof).
    absorption = np.array([0.02, 0.2, 1.0])
    seeds = np.random.SeedSequence(5).generate_state(60, np.uint64).reshape(20, 3)
    totals = np.array(
        [
            recipe.absorb(traced(recipe, seed, 2000, False, recipe.PATH_END), absorption).sum(1)
            for seed in seeds
        ]
    )
    error = totals.std(axis=0, ddof=1) / np.sqrt(20)
    for e, eta in enumerate(recipe.ETAS):
        exact = adding_doubling.reflectance(
            absorption[:, None],
            np.ones((3, 1)),
            np.full((3, 1), np.inf),
            eta=float(eta),
            anisotropy=0.8,
            directions=24,
        ).ravel()
        # What returns within 0.005 transport lengths is not counted: less than 1e-3.
        gap = totals.mean(axis=0)[e] - exact
        assert np.all(gap < 4.0 * error[e])
        assert np.all(gap > -4.0 * error[e] - 1e-3)


def test_the_same_seed_traces_the_same_photons(recipe):
    first = traced(recipe, SEED, 500, True, recipe.PATH_END)
    np.testing.assert_array_equal(traced(recipe, SEED, 500, True, recipe.PATH_END), first)
    assert np.any(traced(recipe, SEED + np.uint64(1), 500, True, recipe.PATH_END) != first)


def test_short_paths_are_independent_of_long_path_tracing(recipe):
    seeds = np.random.SeedSequence(6).generate_state(120, np.uint64).reshape(40, 3)
    end = np.exp(recipe.LOG_PATH_START + recipe.LOG_PATH_STEP * recipe.SHORT_BIN)
    short, whole = (
        np.array(
            [
                traced(recipe, seed, 4000, True, stop)[4, :, : recipe.SHORT_BIN, 0].sum()
                for seed in part
            ]
        )
        for part, stop in ((seeds[:20], end), (seeds[20:], recipe.PATH_END))
    )
    error = np.hypot(short.std(ddof=1), whole.std(ddof=1)) / np.sqrt(20)
    assert abs(short.mean() - whole.mean()) < 4.0 * error
    assert 0.0 < error < 0.1 * whole.mean()
