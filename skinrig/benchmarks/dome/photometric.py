"""Benchmark of robust photometric stereo, beside a per-pixel NumPy IRLS in the same run."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from model.metrics import angular_error_rad
from reconstruction.photometric_stereo import NormalMaps, Robustness, estimate_normals
from skinrig.arrays import BoolArray, Float32Array, Float64Array
from skinrig.benchmarks.measurement import (
    LIMIT_CORES,
    measure_processor_seconds,
    measure_processor_time,
)
from skinrig.benchmarks.resampling import bootstrap_interval
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues
from skinrig.evaluating.skin_bands import MelaninBand

SAMPLE_NOISE = 0.005
"""Standard deviation of every sample; a white pixel that faces a light is 1."""


@dataclass(frozen=True, slots=True)
class BallScene:
    """A glossy ball under many lights, with things between it and them."""

    images: Float32Array
    """(N, H, W)."""
    lights: Float64Array
    """(N, 3)."""
    normals: Float32Array
    """(H, W, 3)."""
    inside: BoolArray
    matte: BoolArray
    """(N, H, W): samples that are lit, not shadowed and without a highlight above the noise."""
    albedo: Float32Array


def render_glossy_ball(
    side: int, lights: int, *, noise: float, rng: np.random.Generator, albedo: float = 0.5
) -> BallScene:
    """Make a ball with painted albedo, highlights, attached shadows and shadows of three posts.

    Parameters
    ----------
    side : int
        Of the images, px.
    lights : int
        Spread over the half space in front.
    noise : float
        Standard deviation of each sample.
    rng
        Draws the noise.
    albedo
        Mean of the painted albedo, which varies by 60 % of it to both sides.
    """
    y, x = np.mgrid[0:side, 0:side].astype(np.float32)
    u, v = (x - (side - 1) / 2) / (0.48 * side), ((side - 1) / 2 - y) / (0.48 * side)
    inside = u * u + v * v < 0.92
    z = np.sqrt(np.maximum(1.0 - u * u - v * v, 0.0))
    n = np.where(inside[..., None], np.stack([u, v, z], axis=-1), [0, 0, 1]).astype(np.float32)
    paint = (albedo * (1.0 + 0.6 * np.sin(20 * u) * np.cos(17 * v))).astype(np.float32)
    k = np.arange(lights) + 0.5
    height = 1.0 - 0.8 * k / lights
    phi = np.pi * (1.0 + np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - height * height)
    towards = np.stack([flat * np.cos(phi), flat * np.sin(phi), height], axis=-1)
    images = np.empty((lights, side, side), np.float32)
    matte = np.empty((lights, side, side), bool)
    posts = np.array([[0.9, 0.7, 1.1], [-1.0, 0.2, 1.0], [0.1, -1.0, 0.9]], np.float32)
    for number, light in enumerate(towards.astype(np.float32)):
        cosine = np.maximum(n @ light, 0.0)
        half = light + np.array([0, 0, 1], np.float32)
        gloss = 0.8 * np.maximum(n @ (half / np.linalg.norm(half)), 0.0) ** 60 * (cosine > 0)
        dark = np.zeros((side, side), bool)
        for post in posts:
            way = post - n
            along = way @ light
            dark |= (along > 0) & (np.sum(way * way, axis=-1) - along * along < 0.45**2)
        images[number] = np.where(dark, 0.0, paint * cosine + gloss)
        images[number] += noise * rng.standard_normal((side, side), np.float32)
        matte[number] = (cosine > 0) & ~dark & (gloss < noise)
    return BallScene(images, towards, n, inside, matte, paint)


def fit_normals_with_numpy(samples: Float64Array, lights: Float64Array) -> Float64Array:
    """Fit pixels one by one by least absolute deviations, in plain NumPy.

    Iteratively reweighted least squares with weights 1 / max(|r|, 1e-6) from the least-squares
    start until the solution moves by less than 1e-6 or 100 times (Schlossmacher 1973, J. Am. Stat.
    Assoc. 68, 857), over the samples that are not dark: not below a tenth of a pixel's bright
    sample (its eighth part from above).

    Parameters
    ----------
    samples : ndarray, shape (N, P)
    lights : ndarray, shape (N, 3)

    Returns
    -------
    ndarray, shape (P, 3)
        Unit normals; 0 where fewer than three samples are left.
    """
    rank = max(3, len(lights) // 8)
    normals = np.zeros((samples.shape[1], 3))
    for pixel, values in enumerate(samples.T):
        bright = np.partition(values, -rank)[-rank]
        lit = values > 0.1 * bright
        if bright <= 0 or np.count_nonzero(lit) < 3:
            continue
        A, i = lights[lit], values[lit]
        b = np.linalg.lstsq(A, i)[0]
        for _ in range(100):
            root = 1.0 / np.sqrt(np.maximum(np.abs(i - A @ b), 1e-6))
            before, b = b, np.linalg.lstsq(root[:, None] * A, root * i)[0]
            if np.linalg.norm(b - before) < 1e-6 * np.linalg.norm(b):
                break
        normals[pixel] = b / max(float(np.linalg.norm(b)), 1e-300)
    return normals


def _mean_bound_deg(scene: BallScene, noise: float) -> float:
    """Return the least mean error with the matte samples known: 0.886 of the RMS angle."""
    places = np.flatnonzero(scene.inside)[:: max(1, scene.inside.sum() // 2000)]
    flat = scene.matte.reshape(len(scene.lights), -1)[:, places].astype(np.float64)
    A = np.einsum("np,ni,nj->pij", flat, scene.lights, scene.lights)
    solvable = np.linalg.eigvalsh(A)[:, 0] > 1e-3
    C = np.linalg.inv(A[solvable])
    n = scene.normals.reshape(-1, 3)[places][solvable]
    across = np.trace(C, axis1=1, axis2=2) - np.einsum("pi,pij,pj->p", n, C, n)
    rms = noise * np.sqrt(across) / scene.albedo.reshape(-1)[places][solvable]
    return float(np.degrees(np.sqrt(np.pi) / 2 * rms.mean()))


def _mean_deg(
    found: NormalMaps, scene: BallScene, noise: float, rng: np.random.Generator
) -> ErrorEstimate:
    """Return the mean error of normals, degrees, beside the least."""
    seen = scene.inside & found.valid
    error = np.degrees(angular_error_rad(found.normals[seen], scene.normals[seen]))
    some = rng.choice(error, min(error.size, 20_000), replace=False)
    interval = bootstrap_interval(some, np.mean, draws=100, rng=rng)
    return ErrorEstimate(float(error.mean()), interval, _mean_bound_deg(scene, noise))


def measure_normals(stage: BenchmarkStage) -> None:
    """Estimate the normals of a glossy ball: lights, robust steps, noise; then at full size."""
    rng = np.random.default_rng(0)
    ball = partial(render_glossy_ball, 40 if stage.toy else 192, noise=SAMPLE_NOISE, rng=rng)

    def add(knobs: Knobs, scene: BallScene, noise: float = SAMPLE_NOISE, **options: Any) -> None:
        stage.measure(
            {"noise": noise} | knobs,
            lambda: estimate_normals(scene.images, scene.lights, **options),
            lambda found: _mean_deg(found, scene, noise, rng),
        )

    for lights in (30, 12) if stage.toy else (150, 75, 30, 12):
        add({"lights": lights, "fit": "robust"}, ball(lights))
    count = 30 if stage.toy else 150
    dense = ball(count)
    for steps in (0, 4) if stage.toy else (0, 2, 4, 8):
        robustness = Robustness(l1_iterations=steps)
        add({"lights": count, "fit": "robust", "L1 steps": steps}, dense, robustness=robustness)
    add({"lights": count, "fit": "least squares"}, dense, robust=False)
    for noise in (0.02,) if stage.toy else (0.001, 0.02):
        add({"lights": count, "fit": "robust"}, ball(count, noise=noise), noise)

    def on_skin(band: MelaninBand) -> ErrorEstimate:
        # gloss and noise stay as they are: on dark skin there is less of what is fitted
        scene = ball(count, albedo=float(band.reflectance()[1]))
        found = estimate_normals(scene.images, scene.lights)
        return _mean_deg(found, scene, SAMPLE_NOISE, rng)

    stage.measure_bands(on_skin)
    if not stage.toy:
        stage.limits = _full_size(rng)


def _full_size(rng: np.random.Generator) -> LimitValues:
    """Measure 1024 x 1024 x 150, and the NumPy fit on some of its pixels."""
    side = 1024
    scene = render_glossy_ball(side, 150, noise=SAMPLE_NOISE, rng=rng)
    estimate_normals(scene.images[:, :8, :8], scene.lights)
    ours_s = measure_processor_seconds(lambda: estimate_normals(scene.images, scene.lights), 3)
    ours_s /= LIMIT_CORES
    places = np.sort(rng.choice(np.flatnonzero(scene.inside), 300, replace=False))
    some = scene.images.reshape(150, -1)[:, places].astype(np.float64)
    with threadpool_limits(1):
        peer_s, theirs = measure_processor_time(lambda: fit_normals_with_numpy(some, scene.lights))
    peer_s *= side**2 / len(places)
    ours = estimate_normals(scene.images.reshape(150, -1)[:, places], scene.lights)
    truth = scene.normals.reshape(-1, 3)[places]
    both = ours.valid & (np.linalg.norm(theirs, axis=1) > 0)
    error = np.degrees(angular_error_rad(ours.normals[both], truth[both])).mean()
    peer_error = np.degrees(angular_error_rad(theirs[both], truth[both])).mean()
    return {
        "seconds": ours_s,
        "speed_up": peer_s / (LIMIT_CORES * ours_s),
        "over_irls": float(error / peer_error),
    }
