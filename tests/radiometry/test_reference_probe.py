"""Paths laid into voxels: against the simulator's photons, and against rendered voxels."""

import dataclasses
from math import inf

import numpy as np
import pytest
from scipy.stats import chi2, norm

from capture.rig import load_rig
from rigsim.fiber.profile import FiberGeometry, trace_fiber_profile
from rigsim.mitsuba.variant import choose_variant
from rigsim.scenes.reference.patch import describe_patch, draw_patch
from rigsim.scenes.reference.placed_paths import HeadPlace, UnevenLayers, trace_placed_paths
from rigsim.scenes.reference.probe_skin import columns, read_person, render_fiber
from rigsim.subject.person_skin import PersonSkin
from rigsim.tissue.skin_layers import skin_layer_stack
from rigsim.tissue.tissue_mc import Layer, LayerStack

FALSE_ALARM = 1e-3
FIBERS = FiberGeometry((0.3, 1.05, 2.05, 3.3, 5.05, 7.05))
LAYERS = LayerStack((Layer(0.09, 1.5, 40.0, 0.8, 1.4), Layer(inf, 0.1, 20.0, 0.8, 1.4)))
WAVELENGTH_NM = 540.0


def even_map(stack, factor=1.0):
    """The stack's absorption times a factor, everywhere the same."""
    each = np.array([layer.sigma_a_per_mm for layer in stack.layers])
    return UnevenLayers(stack, factor * each[:, None, None] * np.ones((1, 2, 2)), 1.0)


def simulated(stack, *, photons, seed):
    """The simulator's profile."""
    return trace_fiber_profile(
        stack, photons=photons, rng=np.random.default_rng(seed), **dataclasses.asdict(FIBERS)
    )


def misfit(mean, stderr, other):
    """Squared deviations in standard errors, summed over the fibers."""
    spread = np.hypot(stderr, other.stderr)
    return float((((mean - other.reflectance_per_mm2) / spread) ** 2).sum())


@pytest.fixture(scope="module")
def run():
    """Walk on layers, with paths laid into layers of 1.3 times their absorption."""
    return trace_placed_paths(
        even_map(LAYERS, 1.3),
        FIBERS,
        (HeadPlace(), HeadPlace(1.0, -2.0, 33.0)),
        photons=20_000,
        laid_paths=500,
        rng=np.random.default_rng(4),
    )


@pytest.mark.long
def test_walk_agrees_with_simulators_photons(run):
    """Tolerance: chi-squared of six fibers; 15 % more absorption exceeds it."""
    mean = run.even_per_mm2.mean(axis=0)
    stderr = run.even_per_mm2.std(axis=0, ddof=1) / np.sqrt(len(run.even_per_mm2))
    bound = chi2.isf(FALSE_ALARM, len(mean))
    assert misfit(mean, stderr, simulated(LAYERS, photons=40_000, seed=1)) < bound
    darker = LayerStack(
        tuple(
            dataclasses.replace(layer, sigma_a_per_mm=1.15 * layer.sigma_a_per_mm)
            for layer in LAYERS.layers
        )
    )
    assert misfit(mean, stderr, simulated(darker, photons=40_000, seed=2)) > bound


@pytest.mark.long
def test_laid_paths_take_added_absorption(run):
    """Rationale: even absorption lowers readings as two separate walks state it, at any place."""
    darker = trace_placed_paths(
        even_map(
            LayerStack(
                tuple(
                    dataclasses.replace(layer, sigma_a_per_mm=1.3 * layer.sigma_a_per_mm)
                    for layer in LAYERS.layers
                )
            )
        ),
        FIBERS,
        (HeadPlace(),),
        photons=20_000,
        laid_paths=1,
        rng=np.random.default_rng(5),
    )
    means = [one.even_per_mm2.mean(axis=0) for one in (darker, run)]
    errors = [
        one.even_per_mm2.std(axis=0, ddof=1) / np.sqrt(len(one.even_per_mm2)) / mean
        for one, mean in zip((darker, run), means, strict=True)
    ]
    expected = means[0] / means[1]
    spread = np.hypot(expected * np.hypot(*errors), run.ratio_stderr[:, 0])
    deviation = (run.ratio[:, 0] - expected) / spread
    assert (deviation**2).sum() < chi2.isf(FALSE_ALARM, len(deviation))
    np.testing.assert_allclose(run.ratio[:, 0], run.ratio[:, 1], rtol=1e-9)
    assert (((1.0 - expected) / spread) ** 2).sum() > chi2.isf(FALSE_ALARM, len(deviation))


@pytest.mark.long
@pytest.mark.render
@pytest.mark.skipif(
    not choose_variant("mono").is_vectorized, reason="Dr.Jit finds no LLVM 17 or newer here"
)
@pytest.mark.parametrize("place", [HeadPlace(), HeadPlace(0.5, 0.3, 90.0)])
def test_laid_paths_agree_with_rendered_voxels(place):
    """Tolerance: normal deviation; readings of the even layers exceed it."""
    drawn = draw_patch(PersonSkin.of_preset("II"), "cheek", field_mm=8.0, voxel_mm=0.25, alpha=0.0)
    melanin = np.full_like(drawn.melanin, 0.01)
    melanin[:, drawn.x_mm > 0.4] = 0.05
    melanin[drawn.x_mm > 1.0] = 0.1
    blood = np.full_like(drawn.blood, 0.01)
    blood[:, drawn.x_mm < -0.5] = 0.05
    patch = dataclasses.replace(drawn, melanin=melanin, blood=blood)
    stack = skin_layer_stack(WAVELENGTH_NM, 0.03, 0.03, patch.tissue)
    absorption = columns(WAVELENGTH_NM, melanin, blood, patch.tissue)[-len(stack.layers) :]
    fibers = FiberGeometry((0.5,), 0.4, 0.4, 0.01, 0.0)
    run = trace_placed_paths(
        UnevenLayers(stack, absorption, patch.voxel_mm),
        fibers,
        (place,),
        photons=40_000,
        laid_paths=4000,
        rng=np.random.default_rng(0),
    )
    even = run.even_per_mm2.mean(axis=0)[0]
    relative = run.even_per_mm2.std(axis=0, ddof=1)[0] / np.sqrt(len(run.even_per_mm2)) / even
    expected = even * run.ratio[0, 0]
    scene = describe_patch(patch, load_rig("flash"), WAVELENGTH_NM, width_px=1)
    found = render_fiber(scene, place, radius_mm=0.5, core_mm=0.4, samples=64)
    spread = np.hypot(
        found.stderr, expected * np.hypot(relative, run.ratio_stderr[0, 0] / run.ratio[0, 0])
    )
    limit = norm.isf(0.5 * FALSE_ALARM)
    assert abs(found.reflectance_per_mm2 - expected) < limit * spread
    assert abs(found.reflectance_per_mm2 - even) > limit * spread


def test_pigment_of_person_changes_readings():
    """Rationale: a person's pigment changes readings by percents, more than the paths' noise."""
    read = read_person(
        PersonSkin.of_preset("III", seed=3),
        "cheek",
        load_rig("probe"),
        (HeadPlace(), HeadPlace(angle_deg=180.0)),
        photons=1000,
        laid_paths=50,
        seed=0,
    )
    assert read.reflectance_per_mm2.shape == (2, 28, 3)
    change = np.abs(read.ratio - 1.0)
    assert 0.005 < np.median(change) < 0.3
    assert np.median(change / read.ratio_stderr) > 3.0
