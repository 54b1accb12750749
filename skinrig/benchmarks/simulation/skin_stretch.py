"""Benchmark of stretched skin: convergence of the equilibrium against time."""

from dataclasses import replace
from functools import partial

import numpy as np

from rigsim.skin_patch.microrelief import SITE_NAMES, MicroSkin, make_micro_skin
from rigsim.skin_patch.stretch import FORCE_TOLERANCE, StretchedSkin, required_size_mm, stretch_skin
from skinrig.arrays import Float32Array
from skinrig.benchmarks.measurement import measure_processor_seconds, measure_processor_time
from skinrig.benchmarks.resampling import mean_error
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues

CALIPER_STRETCHES = (0.73, 0.8, 0.87, 0.94, 1.07, 1.14, 1.21, 1.28)
"""Stretch ratios of a caliper series."""


def _variance(state: StretchedSkin, half_mm: float) -> float:
    """Return the variance of slopes along the jaws over the same material points."""
    grid = np.arange(-half_mm, half_mm, 0.008)
    x, y = np.meshgrid(grid, -grid)
    position = np.stack([x, y], -1) @ state.gradient.T
    found = state.sample(position[..., 0], position[..., 1])
    angle = np.radians(state.angle_deg)
    along = np.cos(angle) * found.slope_x + np.sin(angle) * found.slope_y
    return float(np.var(along, dtype=np.float64))


def measure_stretch(stage: BenchmarkStage) -> None:
    """Measure the equilibrium at several force tolerances, then time whole series."""
    size = 0.3 if stage.toy else 1.6
    half = 0.4 * size
    seeds = range(2 if stage.toy else 3)
    skins = [make_micro_skin("forehead", seed=seed, size_mm=size) for seed in seeds]
    tolerances = (
        (0.1, FORCE_TOLERANCE) if stage.toy else (0.3, 0.1, 0.03, 0.01, FORCE_TOLERANCE, 1e-3)
    )
    for stretch in (0.8, 1.25):
        truth = [
            _variance(stretch_skin(s, stretch=stretch, angle_deg=90.0, tolerance=1e-5), half)
            for s in skins
        ]
        for tolerance in tolerances:
            settle = partial(stretch_skin, stretch=stretch, angle_deg=90.0, tolerance=tolerance)
            timing, states = stage.time(
                lambda: list(map(settle, skins)), repeats=1, memory=not stage.toy
            )
            pairs = zip(states, truth, strict=True)
            outcome = mean_error([100.0 * abs(_variance(s, half) / t - 1.0) for s, t in pairs])
            evaluations = np.mean([s.convergence.evaluations for s in states])
            knobs = {"stretch": stretch, "force": tolerance, "evaluations": float(evaluations)}
            stage.add(knobs, timing, outcome)
    if not stage.toy:
        stage.limits = _limits()


def _limits() -> LimitValues:
    limits: LimitValues = {}
    for site in SITE_NAMES:
        skin = make_micro_skin(site, seed=1, size_mm=2.8)
        limits["seconds", site], states = measure_processor_time(
            lambda: {r: stretch_skin(skin, stretch=r, angle_deg=90.0) for r in CALIPER_STRETCHES}
        )
        variance = [_variance(state, 1.2) for state in states.values()]
        limits["flattening", site] = float((np.diff(variance) < 0.0).sum())
        strains = (abs(s.membrane_strain / (r - 1.0)) for r, s in states.items())
        limits["strain", site] = max(strains)
    field = make_micro_skin("forehead", seed=1, size_mm=required_size_mm(12.3, 1.0, angle_deg=0.0))
    limits["field_s"] = measure_processor_seconds(
        lambda: stretch_skin(field, stretch=1.2, angle_deg=90.0)
    )
    flat = stretch_skin(_flat(field), stretch=0.8, angle_deg=0.0)
    limits["flat"] = float(np.abs(flat.height_um).max())
    return limits


def _flat(skin: MicroSkin) -> MicroSkin:
    crop = slice(0, 200)
    maps: dict[str, Float32Array] = {
        name: getattr(skin, name)[crop, crop]
        for name in ("height_um", "albedo", "alpha", "layer_um")
    }
    maps["height_um"] = np.zeros_like(maps["height_um"])
    # a layer of varying thickness buckles under compression even if its surface is flat
    maps["layer_um"] = np.full_like(maps["layer_um"], maps["layer_um"].mean())
    return replace(skin, **maps)  # type: ignore[arg-type]
