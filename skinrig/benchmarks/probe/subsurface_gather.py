"""Benchmark of gathered subsurface light against the direct sum in NumPy in the same run."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from model.dipole import direct_sum as dipole_sum
from model.dipole.direct_sum import DipoleMedia, sum_exitance
from model.dipole.gather import GATHER_TOL, SourceTree, gather
from model.fresnel import ETA_SKIN
from skinrig.arrays import Float64Array
from skinrig.benchmarks.measurement import (
    measure,
    measure_processor_seconds,
    measure_processor_time,
)
from skinrig.benchmarks.resampling import bootstrap_rms
from skinrig.benchmarks.results import ErrorEstimate, Knobs, Timing
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues
from skinrig.evaluating.skin_bands import MelaninBand

FULL_SIDE_PX = 512
MIN_RELATIVE_EXITANCE = 0.01
"""Fraction of the largest exitance below which points are excluded from locally relative errors."""
MEAN_R_D = np.array([0.55, 0.35, 0.25])
MEAN_TRANSLUCENCY_MM = 1.0 / np.array([0.598, 1.069, 1.672])
"""Diffuse mean free path of a mean face, mm: table 2 of Weyrich et al. 2005."""
BAND_STEP_MM = 0.8
"""Spacing of the sources for errors by melanin band, mm."""
EDGE_POSITIONS_MM = np.linspace(-3.0, 3.0, 60)


@dataclass(frozen=True, slots=True)
class LitFace:
    """Texels of a face, lit from one side, with a cast shadow."""

    position_mm: Float64Array
    area: Float64Array
    irradiance: Float64Array
    r_d: Float64Array
    translucency_mm: Float64Array


def build_lit_face(side: int) -> LitFace:
    """Build a face of 160 mm x 220 mm in side x side texels of varying albedo and translucency."""
    u, v = np.meshgrid(np.linspace(-1, 1, side), np.linspace(1, -1, side))
    x, y = 80.0 * u, 110.0 * v
    z = 80.0 * np.sqrt(1.3 - 0.8 * u**2 - 0.4 * v**2) + 20.0 * np.exp(-(x**2 + y**2) / 300.0)
    position = np.stack([x, y, z], axis=-1)
    across = np.cross(np.gradient(position, axis=1), -np.gradient(position, axis=0))
    area = np.linalg.norm(across, axis=-1)
    lit = np.clip(across @ np.array([0.8, 0.3, 0.52]) / area, 0.0, None)
    lit[(x - y > 20.0) & (x - y < 50.0)] = 0.0
    return LitFace(
        position.reshape(-1, 3),
        area.ravel(),
        lit.reshape(-1, 1) * np.array([1.0, 0.9, 0.8]),
        MEAN_R_D * (1.0 + 0.1 * np.sin(x / 5.0)).reshape(-1, 1),
        MEAN_TRANSLUCENCY_MM * (1.0 + 0.2 * np.cos(y / 20.0)).reshape(-1, 1),
    )


def edge_profile(x_mm: Float64Array, media: DipoleMedia) -> Float64Array:
    """Return the exitance at x of uniform light on x < 0, relative to R_d, by a 1-D integral."""
    widest = 40.0 / float(media.sigma_tr_per_mm)
    t = widest * np.linspace(0.0, 1.0, 20_001) ** 3
    away = np.abs(x_mm)[:, None]
    # the fraction acos(x / r) / pi of a ring of radius r is beyond a line at a distance x; the
    # substitution r^2 = x^2 + t^2 gives 2 pi r dr acos(x / r) / pi = 2 t atan2(t, x) dt
    ring = 2.0 * t * np.arctan2(t, away) * dipole_sum.profile(np.hypot(away, t), media)
    beyond = np.trapezoid(ring, t, axis=1)
    return np.asarray(np.where(x_mm >= 0.0, beyond, 1.0 - beyond))


def measure_gathering(stage: BenchmarkStage) -> None:
    """Measure gathering over the tree's tolerance on a face and over sources at a shadow's edge."""
    rng = np.random.default_rng(0)
    _tolerances(stage, rng)
    _edges(stage, rng)
    if not stage.toy:
        stage.limits = _full_size(rng)
    stage.measure_bands(lambda band: _on_skin(band, rng))


def _tolerances(stage: BenchmarkStage, rng: np.random.Generator) -> None:
    side, steps = (48, 3) if stage.toy else (256, 6)
    scene = build_lit_face(side)
    at = rng.choice(len(scene.area), 40 if stage.toy else 100, replace=False)
    truth = _sum_directly(scene, at)
    for tolerance in (10.0 ** (1.0 - k) for k in range(steps)):
        tree = SourceTree.of(scene.position_mm, scene.area)
        timing, found = stage.time(lambda: _gathered(scene, tree, tolerance), repeats=1)
        error = (found[at] - truth) / (scene.r_d[at] * scene.irradiance.max())
        knobs: Knobs = {"scene": "face", "texels": side**2, "tolerance": tolerance}
        stage.add(knobs, timing, _rms(error, rng))
    direct = measure(lambda: _sum_directly(scene, at[:10]), repeats=1, memory=False)
    seconds = direct.seconds * side**2 / 10
    why = "its seconds are extrapolated from those of 10 points"
    timing = Timing(seconds, (seconds, seconds), direct.cold_s, None, no_memory_reason=why)
    knobs = {"scene": "face", "texels": side**2, "sum": "direct, NumPy, extrapolated"}
    stage.add(knobs, timing, ErrorEstimate.symmetric(0.0, 0.0))


def _edges(stage: BenchmarkStage, rng: np.random.Generator) -> None:
    truth = _edge_truth(MEAN_R_D, MEAN_TRANSLUCENCY_MM)
    for step in (0.8, 0.4) if stage.toy else (1.6, 0.8, 0.4, 0.2):
        for known in (False, True):
            knobs: Knobs = {"scene": "a shadow's edge"}
            knobs |= {"edge": "own light" if known else "sources alone", "source mm": step}
            edge = partial(_edge, step, known)
            stage.measure(knobs, edge, lambda found: _rms(found - truth, rng), repeats=1)


def _edge_truth(r_d: Float64Array, translucency_mm: Float64Array) -> Float64Array:
    """Return the true profile of a shadow's edge in three channels, (X, 3)."""
    media = [DipoleMedia.of(r, t, eta=ETA_SKIN) for r, t in zip(r_d, translucency_mm, strict=True)]
    return np.stack([edge_profile(EDGE_POSITIONS_MM, medium) for medium in media], axis=-1)


def _on_skin(band: MelaninBand, rng: np.random.Generator) -> ErrorEstimate:
    """Return the error of a shadow's edge on skin, over its own R_d."""
    sigma_tr = np.sqrt(
        3.0 * band.sigma_a_per_mm * (band.sigma_a_per_mm + band.sigma_s_prime_per_mm)
    )
    skin = band.reflectance(), MEAN_TRANSLUCENCY_MM / MEAN_TRANSLUCENCY_MM[0] / sigma_tr
    return _rms(_edge(BAND_STEP_MM, True, skin=skin) - _edge_truth(*skin), rng)


def _edge(
    step_mm: float,
    exact_coefficients: bool,
    *,
    skin: tuple[Float64Array, Float64Array] = (MEAN_R_D, MEAN_TRANSLUCENCY_MM),
) -> Float64Array:
    """Return the profile of a shadow's edge from sources at a spacing, (X, 3).

    `skin` is the diffuse albedo and the diffuse mean free path, mm.
    """
    half = step_mm * round(10.0 / step_mm)  # a multiple of the step: no source is on the edge
    grid = np.arange(-half, half, step_mm) + 0.5 * step_mm
    x, y = np.meshgrid(grid, grid)
    position = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    lit = np.repeat(position[:, :1] < 0.0, 3, axis=1).astype(np.float64)
    at = np.stack(
        [EDGE_POSITIONS_MM, 0.3 * EDGE_POSITIONS_MM, np.zeros_like(EDGE_POSITIONS_MM)], axis=-1
    )
    own = np.repeat(EDGE_POSITIONS_MM[:, None] < 0.0, 3, axis=1).astype(np.float64)
    tree = SourceTree.of(position, np.full(len(position), step_mm**2))
    found = gather(tree, lit, at, *skin, entered_at=own if exact_coefficients else None)
    return np.asarray(found.exitance / skin[0])


def _gathered(scene: LitFace, tree: SourceTree, tolerance: float = GATHER_TOL) -> Float64Array:
    return gather(
        tree,
        scene.irradiance,
        scene.position_mm,
        scene.r_d,
        scene.translucency_mm,
        tolerance=tolerance,
    ).exitance


def _sum_directly(scene: LitFace, at: NDArray[np.intp]) -> Float64Array:
    with threadpool_limits(1):
        return sum_exitance(
            scene.position_mm,
            scene.area,
            scene.irradiance,
            scene.position_mm[at],
            scene.r_d[at],
            scene.translucency_mm[at],
        )


def _rms(error: Float64Array, rng: np.random.Generator) -> ErrorEstimate:
    """Return the root mean square in percent with its 68 % bootstrap interval over points."""
    found = bootstrap_rms((error**2).mean(axis=-1), rng=rng)
    low, high = found.error_interval
    return ErrorEstimate(100.0 * found.error, (100.0 * low, 100.0 * high))


def _full_size(rng: np.random.Generator) -> LimitValues:
    """Measure 512 x 512 texels at as many exit points, and some of them by the direct sum."""
    scene = build_lit_face(FULL_SIDE_PX)
    gathered = partial(_gathered, scene)
    spent_s = measure_processor_seconds(
        lambda: gathered(SourceTree.of(scene.position_mm, scene.area)), 2
    )
    tree = SourceTree.of(scene.position_mm, scene.area)
    found = gathered(tree)
    at = rng.choice(len(scene.area), 80, replace=False)
    peer_s, truth = measure_processor_time(lambda: _sum_directly(scene, at))
    peer_s *= len(scene.area) / len(at)
    visible = truth > MIN_RELATIVE_EXITANCE * (scene.r_d * scene.irradiance.max())[at]
    relative = np.abs(found[at] / np.where(visible, truth, 1.0) - 1.0)[visible]
    even = gather(
        tree,
        np.ones_like(scene.irradiance),
        scene.position_mm[at],
        scene.r_d[at],
        scene.translucency_mm[at],
    ).exitance
    plane = _plane_level()
    return {
        "seconds": spent_s,
        "local": float(100.0 * np.quantile(relative, 0.95)),
        "largest": float(
            100.0 * np.max(np.abs(found[at] - truth) / (scene.r_d[at] * scene.irradiance.max()))
        ),
        "even": float(np.max(np.abs(even / scene.r_d[at] - 1.0))),
        "plane": 100.0 * plane,
        "speed_up": peer_s / spent_s,
    }


def _plane_level() -> float:
    """Return the largest relative error of a plane's sum without normalization from R_d."""
    step, half = 0.4, 30.0
    grid = np.arange(-half, half, step) + 0.5 * step
    x, y = np.meshgrid(grid, grid)
    position = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    tree = SourceTree.of(position, np.full(len(position), step**2))
    offset = np.linspace(0.0, step, 9)
    at = np.stack(np.meshgrid(offset, offset, [0.0]), axis=-1).reshape(-1, 3)
    found = gather(
        tree, np.ones_like(position), at, MEAN_R_D, MEAN_TRANSLUCENCY_MM, normalize=False
    )
    return float(np.max(np.abs(found.exitance / MEAN_R_D - 1.0)))
