"""The vectorised walk against the scalar one, and what each engine promises."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest
from scipy import stats

from rigsim.tissue import photon_lanes
from rigsim.tissue.tissue_mc import Layer, LayerStack, TransportError, trace_photons

needs_lanes = pytest.mark.skipif(
    not photon_lanes.is_usable(), reason="Dr.Jit finds no LLVM 17 or newer here"
)
RINGS_MM = (0.0, 0.05, 0.15, 0.4, inf)
UNLIKE = LayerStack(
    (
        Layer(0.10, 0.5, 12.0, 0.80, 1.50),
        Layer(0.05, 0.2, 0.0, 0.00, 1.33),
        Layer(0.30, 1.0, 6.0, -0.30, 1.40),
    ),
    eta_below=1.45,
)
ALONE = LayerStack((Layer(inf, 0.5, 7.5, 0.9, 1.4),))
FILM = LayerStack((Layer(0.001, 3.0, 100.0, 0.99, 1.6), Layer(inf, 0.5, 10.0, 0.0, 1.0)))


def smallest_p_value(stack, twin, photons=200_000):
    """Dr.Jit on `stack`, numba on `twin`: p of the largest z of all parts, Sidak-corrected."""
    runs = [
        trace_photons(
            each,
            photons=photons,
            rng=np.random.default_rng(seed),
            ring_edges_mm=RINGS_MM,
            engine=engine,
            threads=2,
            batches=40,
        )
        for each, seed, engine in ((stack, 1, "drjit"), (twin, 2, "numba"))
    ]
    value = [[r.reflectance, r.transmittance, *r.absorbed, *r.ring_reflectance] for r in runs]
    error = [
        [
            r.reflectance_stderr,
            r.transmittance_stderr,
            *r.absorbed_stderr,
            *r.ring_reflectance_stderr,
        ]
        for r in runs
    ]
    both = np.hypot(*error)
    z = np.abs(np.subtract(*value))[both > 0.0] / both[both > 0.0]
    return 1.0 - (1.0 - 2.0 * stats.t.sf(z.max(), 39)) ** z.size


@needs_lanes
@pytest.mark.parametrize("stack", [UNLIKE, ALONE, FILM])
def test_lanes_agree_with_the_scalar_walk(stack):
    # False alarms: below 1e-4 each.
    assert smallest_p_value(stack, stack) > 1e-4


@needs_lanes
@pytest.mark.parametrize("wrong", [{"g": 0.88}, {"eta": 1.45}, {"sigma_s_per_mm": 7.0}])
def test_that_agreement_would_show_a_wrong_layer(wrong):
    assert smallest_p_value(ALONE, LayerStack((replace(ALONE.layers[0], **wrong),))) < 1e-4


@needs_lanes
def test_no_weight_is_lost_in_lanes():
    for stack in (UNLIKE, ALONE, FILM):
        run = trace_photons(stack, photons=20_000, rng=np.random.default_rng(3), engine="drjit")
        # float32 weights: each of some hundred products may be off by 6e-8.
        assert run.balance == pytest.approx(1.0, abs=1e-6)
        assert run.ring_reflectance.sum() == pytest.approx(run.reflectance, rel=1e-6)


@needs_lanes
def test_same_seed_repeats_run_in_lanes_others_differ():
    one, two, other = (
        trace_photons(ALONE, photons=5000, rng=np.random.default_rng(seed), engine="drjit")
        for seed in (4, 4, 5)
    )
    assert one.reflectance == two.reflectance
    assert one.reflectance != other.reflectance


@needs_lanes
def test_standard_error_of_lanes_matches_repeated_run_scatter():
    rng = np.random.default_rng(7)
    runs = [trace_photons(ALONE, photons=2000, rng=rng, engine="drjit") for _ in range(60)]
    spread = np.var([run.reflectance for run in runs], ddof=1)
    stated = np.mean([run.reflectance_stderr**2 for run in runs])
    # spread/stated follows F(59, 60 x 19); both tails together 1e-4.
    low, high = stats.f.ppf([5e-5, 1.0 - 5e-5], 59, 60 * 19)
    assert low < spread / stated < high


def test_automatic_choice_without_llvm_is_the_scalar_walk(monkeypatch):
    monkeypatch.setattr(photon_lanes, "is_usable", lambda: False)
    rng = np.random.default_rng
    chosen = trace_photons(FILM, photons=100_000, rng=rng(6), engine="auto", threads=2)
    scalar = trace_photons(FILM, photons=100_000, rng=rng(6), engine="numba", threads=2)
    assert chosen.reflectance == scalar.reflectance
    with pytest.raises(TransportError, match="LLVM"):
        trace_photons(FILM, photons=100, rng=rng(6), engine="drjit")


def test_unknown_engine_is_refused():
    with pytest.raises(TransportError, match="engine"):
        trace_photons(ALONE, photons=100, rng=np.random.default_rng(0), engine="abacus")
