"""The photon walk against an independent plain-NumPy walk, closed forms and its own statistics."""

from dataclasses import replace
from math import exp, inf

import numpy as np
import pytest
from scipy import stats

from rigsim.tissue.tissue_mc import (
    Layer,
    LayerStack,
    TransportError,
    trace_escape_paths,
    trace_photons,
)

RINGS_MM = (0.0, 0.05, 0.15, 0.4, inf)

# Every index differs from its neighbours', one layer scatters backwards, one not at all.
STACK = LayerStack(
    (
        Layer(0.10, 0.5, 12.0, 0.80, 1.50),
        Layer(0.05, 0.2, 0.0, 0.00, 1.33),
        Layer(0.30, 1.0, 6.0, -0.30, 1.40),
    ),
    eta_above=1.0,
    eta_below=1.45,
)


def analog_walk(stack, photons, rng):
    """Count photons that are reflected (by ring), transmitted, absorbed (by layer): plain NumPy.

    Written apart from the kernel: photons are absorbed whole, the free path is drawn anew at every
    boundary, Fresnel's equations are in their sine and tangent form and directions turn in a frame
    built by cross products.
    """
    layers = stack.layers
    depth = np.cumsum([0.0, *(layer.thickness_mm for layer in layers)])
    sigma_a = np.array([layer.sigma_a_per_mm for layer in layers])
    sigma_t = sigma_a + [layer.sigma_s_per_mm for layer in layers]
    g = np.array([layer.g for layer in layers])
    eta = np.array([stack.eta_above, *(layer.eta for layer in layers), stack.eta_below])

    entering = photons - rng.binomial(photons, stack.specular_reflectance)
    position = np.zeros((entering, 3))
    direction = np.tile([0.0, 0.0, 1.0], (entering, 1))
    layer = np.zeros(entering, dtype=int)
    scattered = np.zeros(entering, dtype=bool)
    absorbed = np.zeros(len(layers))
    rings = np.zeros(len(RINGS_MM) - 1)
    unscattered = photons - entering
    transmitted = 0

    while layer.size:
        down = direction[:, 2] > 0.0
        gap = np.where(down, depth[layer + 1] - position[:, 2], depth[layer] - position[:, 2])
        to_boundary = gap / direction[:, 2]
        free = rng.exponential(size=layer.size) / sigma_t[layer]
        crossing = free >= to_boundary
        position += np.where(crossing, to_boundary, free)[:, None] * direction
        position[crossing, 2] = depth[layer + down][crossing]

        swallowed = ~crossing & (rng.random(layer.size) * sigma_t[layer] < sigma_a[layer])
        absorbed += np.bincount(layer[swallowed], minlength=len(layers))
        turning = ~crossing & ~swallowed
        scattered |= turning
        direction[turning] = _turned(direction[turning], g[layer[turning]], rng)

        eta_i, eta_t = eta[layer + 1], eta[np.where(down, layer + 2, layer)]
        theta_i = np.arccos(np.minimum(np.abs(direction[:, 2]), 1.0))
        sine_t = eta_i / eta_t * np.sin(theta_i)
        theta_t = np.arcsin(np.minimum(sine_t, 1.0))
        plus, minus = theta_i + theta_t, theta_i - theta_t
        with np.errstate(divide="ignore", invalid="ignore"):
            r = 0.5 * ((np.sin(minus) / np.sin(plus)) ** 2 + (np.tan(minus) / np.tan(plus)) ** 2)
        r = np.where(theta_i < 1e-9, ((eta_i - eta_t) / (eta_i + eta_t)) ** 2, r)
        r = np.where(sine_t >= 1.0, 1.0, r)
        mirrored = crossing & (rng.random(layer.size) < r)
        direction[mirrored, 2] *= -1.0
        through = crossing & ~mirrored
        direction[through, :2] *= (eta_i / eta_t)[through, None]
        direction[through, 2] = np.where(down, 1.0, -1.0)[through] * np.cos(theta_t[through])
        layer = layer + np.where(through, np.where(down, 1, -1), 0)

        out = layer < 0
        unscattered += np.count_nonzero(out & ~scattered)
        radius = np.hypot(position[:, 0], position[:, 1])[out & scattered]
        rings += np.histogram(radius, np.minimum(RINGS_MM, 1e9))[0]
        transmitted += np.count_nonzero(layer == len(layers))
        kept = ~swallowed & ~out & (layer < len(layers))
        position, direction = position[kept], direction[kept]
        layer, scattered = layer[kept], scattered[kept]
    return np.array([unscattered, transmitted, *absorbed, *rings]) / photons


def _turned(direction, g, rng):
    u = rng.random(len(direction))
    safe = np.where(g == 0.0, 1.0, g)
    cosine = (1.0 + safe**2 - ((1.0 - safe**2) / (1.0 - safe + 2.0 * safe * u)) ** 2) / (2.0 * safe)
    cosine = np.clip(np.where(g == 0.0, 2.0 * u - 1.0, cosine), -1.0, 1.0)
    phi = rng.uniform(0.0, 2.0 * np.pi, len(direction))
    axis = np.where(np.abs(direction[:, :1]) > 0.7, [0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    side = np.cross(direction, axis)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(direction, side)
    sine = np.sqrt(1.0 - cosine**2)
    turned = (
        cosine[:, None] * direction
        + (sine * np.cos(phi))[:, None] * side
        + (sine * np.sin(phi))[:, None] * other
    )
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def scores(run):
    return np.array([run.specular, run.transmittance, *run.absorbed, *run.ring_reflectance])


def smallest_p_value(stack):
    """Kernel on `stack`, NumPy walk on `STACK`: two-sided p of the largest z, Sidak-corrected."""
    run = trace_photons(
        stack, photons=400_000, rng=np.random.default_rng(1), ring_edges_mm=RINGS_MM
    )
    photons = 100_000
    twin = analog_walk(STACK, photons, np.random.default_rng(2))
    # A weighted photon's variance is at most that of a whole one, so this error is not too small.
    error = np.sqrt(twin * (1.0 - twin) * (1.0 / photons + 1.0 / run.photons))
    z = np.abs(scores(run) - twin) / error
    return 1.0 - (1.0 - 2.0 * stats.norm.sf(z.max())) ** z.size


def test_kernel_agrees_with_plain_numpy_whole_photon_walk():
    # False alarms: below 1e-4.
    assert smallest_p_value(STACK) > 1e-4


@pytest.mark.long
@pytest.mark.parametrize("wrong", [{"g": 0.75}, {"eta": 1.45}, {"sigma_s_per_mm": 9.5}])
def test_that_agreement_would_show_a_wrong_first_layer(wrong):
    first, *others = STACK.layers
    assert smallest_p_value(replace(STACK, layers=(replace(first, **wrong), *others))) < 1e-4


def test_no_weight_is_lost():
    run = trace_photons(STACK, photons=20_000, rng=np.random.default_rng(3), ring_edges_mm=RINGS_MM)
    assert run.balance == pytest.approx(1.0, abs=1e-12)
    assert run.ring_reflectance.sum() == pytest.approx(run.reflectance, abs=1e-12)


def test_result_does_not_depend_on_thread_count():
    runs = [
        trace_photons(STACK, photons=8000, rng=np.random.default_rng(4), threads=threads)
        for threads in (1, 2, 5)
    ]
    for other in runs[1:]:
        assert other.reflectance == runs[0].reflectance
        assert other.reflectance_stderr == runs[0].reflectance_stderr
        np.testing.assert_array_equal(other.absorbed, runs[0].absorbed)


def test_another_seed_gives_another_sample():
    one, other = (
        trace_photons(STACK, photons=2000, rng=np.random.default_rng(seed)) for seed in (5, 6)
    )
    assert one.reflectance != other.reflectance


def test_standard_error_matches_scatter_of_repeated_runs():
    rng = np.random.default_rng(7)
    runs = [trace_photons(STACK, photons=2000, rng=rng) for _ in range(120)]
    spread = np.var([run.reflectance for run in runs], ddof=1)
    stated = np.mean([run.reflectance_stderr**2 for run in runs])
    # spread/stated follows F(119, 120 x 19); both tails together 1e-4.
    low, high = stats.f.ppf([5e-5, 1.0 - 5e-5], 119, 120 * 19)
    assert low < spread / stated < high


def test_error_falls_with_the_square_root_of_photons():
    few, many = (
        trace_photons(STACK, photons=n, rng=np.random.default_rng(8), batches=200)
        for n in (4000, 64_000)
    )
    # The variances' ratio follows 16 F(199, 199): both tails together 1e-4.
    low, high = 16.0 * stats.f.ppf([5e-5, 1.0 - 5e-5], 199, 199)
    assert low < (few.reflectance_stderr / many.reflectance_stderr) ** 2 < high


def test_clear_plate_matches_fresnel_series_sums():
    plate = LayerStack((Layer(1.0, 0.0, 0.0, 0.0, 1.5),))
    run = trace_photons(plate, photons=400_000, rng=np.random.default_rng(9))
    r = 0.04
    assert run.reflectance == 0.0
    # False alarms: 4 standard errors of 20 batches, 8e-4.
    assert abs(run.transmittance - (1.0 - r) / (1.0 + r)) < 4.0 * run.transmittance_stderr
    assert run.specular + run.transmittance == pytest.approx(1.0, abs=1e-12)


def test_purely_absorbing_slab_follows_beer_and_lambert():
    slab = LayerStack((Layer(0.5, 1.0, 0.0, 0.0, 1.0), Layer(0.5, 3.0, 0.0, 0.5, 1.0)))
    run = trace_photons(slab, photons=200_000, rng=np.random.default_rng(10))
    # False alarms: 4 standard errors of 20 batches, 8e-4 each.
    assert abs(run.transmittance - exp(-2.0)) < 4.0 * run.transmittance_stderr
    deviation = np.abs(run.absorbed - [1.0 - exp(-0.5), exp(-0.5) - exp(-2.0)])
    assert np.all(deviation < 4.0 * run.absorbed_stderr)


def test_splitting_a_layer_changes_nothing():
    whole = Layer(0.4, 0.3, 8.0, 0.7, 1.4)
    parts = tuple(replace(whole, thickness_mm=part) for part in (0.1, 0.25, 0.05))
    one, split = (
        trace_photons(LayerStack(layers), photons=200_000, rng=np.random.default_rng(seed))
        for layers, seed in (((whole,), 11), (parts, 12))
    )
    error = np.hypot(one.reflectance_stderr, split.reflectance_stderr)
    # False alarms: 4 standard errors of 20 batches each, below 4e-4.
    assert abs(one.reflectance - split.reflectance) < 4.0 * error


def test_reweighted_paths_give_reflectance_at_more_absorption():
    layers = (Layer(0.2, 0.1, 20.0, 0.8, 1.4), Layer(inf, 0.1, 10.0, 0.8, 1.4))
    extra = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 1.0], [2.0, 4.0]])
    kept = trace_escape_paths(LayerStack(layers), photons=30_000, rng=np.random.default_rng(13))
    each = np.array(
        [np.exp(-extra @ batch.path_mm.T) @ batch.weight / batch.photons for batch in kept]
    )
    error = each.std(axis=0, ddof=1) / np.sqrt(len(kept))
    for index, added in enumerate(extra):
        darker = tuple(
            replace(layer, sigma_a_per_mm=layer.sigma_a_per_mm + more)
            for layer, more in zip(layers, added, strict=True)
        )
        run = trace_photons(
            LayerStack(darker), photons=30_000, rng=np.random.default_rng(14 + index)
        )
        both = np.hypot(error[index], run.reflectance_stderr)
        # False alarms: 4 standard errors of 20 batches each, below 4e-4 for each of the four.
        assert abs(each[:, index].mean() - run.reflectance) < 4.0 * both


def test_kept_paths_are_the_light_that_transport_counts():
    kept = trace_escape_paths(STACK, photons=4000, rng=np.random.default_rng(20))
    run = trace_photons(STACK, photons=4000, rng=np.random.default_rng(20))
    total = np.mean([batch.weight.sum() / batch.photons for batch in kept])
    assert total == pytest.approx(run.reflectance, rel=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"thickness_mm": 0.0}, "thickness_mm: expected > 0, got 0.0"),
        ({"thickness_mm": float("nan")}, "thickness_mm"),
        ({"sigma_a_per_mm": -0.1}, "sigma_a_per_mm: expected a finite number >= 0, got -0.1"),
        ({"sigma_s_per_mm": inf}, "sigma_s_per_mm"),
        ({"g": 1.0}, "g: expected -1 < g < 1, got 1.0"),
        ({"eta": 0.9}, "eta: expected >= 1, got 0.9"),
    ],
)
def test_impossible_layer_is_refused_by_name(change, message):
    with pytest.raises(TransportError, match=message):
        replace(STACK.layers[0], **change)


def test_impossible_stacks_are_refused():
    endless = Layer(inf, 0.0, 1.0, 0.0, 1.0)
    with pytest.raises(TransportError, match="at least one layer"):
        LayerStack(())
    with pytest.raises(TransportError, match="wander"):
        LayerStack((endless,))
    with pytest.raises(TransportError, match="only the last layer"):
        LayerStack((endless, endless))


@pytest.mark.parametrize(
    ("request_", "field"),
    [
        ({"photons": 0}, "photons"),
        ({"batches": 19}, "batches"),
        ({"threads": 0}, "threads"),
        ({"ring_edges_mm": (0.1, 0.1)}, "ring_edges_mm"),
        ({"ring_edges_mm": (-1.0, 0.1)}, "ring_edges_mm"),
    ],
)
def test_impossible_requests_are_refused_by_name(request_, field):
    arguments = {"photons": 100, "rng": np.random.default_rng(0), **request_}
    with pytest.raises(TransportError, match=field):
        trace_photons(STACK, **arguments)
