"""Benchmark of robust photometric stereo against a per-pixel NumPy IRLS in the same run."""

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
"""Standard deviation of every sample; a white pixel at normal incidence has the value 1."""


@dataclass(frozen=True, slots=True)
class BallScene:
    """Images of a glossy ball under many lights, with cast shadows, and their ground truth."""

    images: Float32Array
    """(N, H, W)."""
    lights: Float64Array
    """(N, 3)."""
    normals: Float32Array
    """(H, W, 3)."""
    inside: BoolArray
    matte: BoolArray
    """(N, H, W): samples that are lit, not shadowed and without specular reflection above noise."""
    albedo: Float32Array


def render_glossy_ball(
    side: int, lights: int, *, noise: float, rng: np.random.Generator, albedo: float = 0.5
) -> BallScene:
    """Render a ball with varying albedo, highlights, attached shadows and shadows of three posts.

    Parameters
    ----------
    side
        Side of the images, px.
    lights
        Number of lights over the half space in front.
    noise
        Standard deviation of each sample.
    rng
        Generator of the noise.
    albedo
        Mean albedo; it varies by plus and minus 60 %.
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
    radius = np.sqrt(1.0 - height * height)
    directions = np.stack([radius * np.cos(phi), radius * np.sin(phi), height], axis=-1)
    images = np.empty((lights, side, side), np.float32)
    matte = np.empty((lights, side, side), bool)
    posts = np.array([[0.9, 0.7, 1.1], [-1.0, 0.2, 1.0], [0.1, -1.0, 0.9]], np.float32)
    for number, light in enumerate(directions.astype(np.float32)):
        cosine = np.maximum(n @ light, 0.0)
        half = light + np.array([0, 0, 1], np.float32)
        specular = 0.8 * np.maximum(n @ (half / np.linalg.norm(half)), 0.0) ** 60 * (cosine > 0)
        dark = np.zeros((side, side), bool)
        for post in posts:
            # a sphere of radius 0.45 blocks the ray if it is ahead and nearer than its radius
            to_post = post - n
            along = to_post @ light
            dark |= (along > 0) & (np.sum(to_post * to_post, axis=-1) - along * along < 0.45**2)
        images[number] = np.where(dark, 0.0, paint * cosine + specular)
        images[number] += noise * rng.standard_normal((side, side), np.float32)
        matte[number] = (cosine > 0) & ~dark & (specular < noise)
    return BallScene(images, directions, n, inside, matte, paint)


def fit_normals_with_numpy(samples: Float64Array, lights: Float64Array) -> Float64Array:
    """Fit normals pixel by pixel by least absolute deviations, in plain NumPy.

    Iteratively reweighted least squares with weights 1 / max(|r|, 1e-6), from the least-squares
    solution, until the solution changes by less than 1e-6 or after 100 steps (Schlossmacher 1973,
    J. Am. Stat. Assoc. 68, 857). Samples below a tenth of the pixel's bright sample (the N/8-th
    largest) are omitted as dark.

    Parameters
    ----------
    samples : ndarray, shape (N, P)
    lights : ndarray, shape (N, 3)

    Returns
    -------
    ndarray, shape (P, 3)
        Unit normals; 0 where fewer than three samples remain.
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
    """Return the least mean error with known matte samples, degrees."""
    # The covariance of albedo * normal is noise^2 (L^T L)^-1. Its part tangential to the normal,
    # over the albedo, is the angle's variance. The mean of a Rayleigh distributed angle is
    # sqrt(pi) / 2 = 0.886 of its root mean square.
    chosen = np.flatnonzero(scene.inside)[:: max(1, scene.inside.sum() // 2000)]
    flat = scene.matte.reshape(len(scene.lights), -1)[:, chosen].astype(np.float64)
    A = np.einsum("np,ni,nj->pij", flat, scene.lights, scene.lights)
    solvable = np.linalg.eigvalsh(A)[:, 0] > 1e-3
    C = np.linalg.inv(A[solvable])
    n = scene.normals.reshape(-1, 3)[chosen][solvable]
    across = np.trace(C, axis1=1, axis2=2) - np.einsum("pi,pij,pj->p", n, C, n)
    rms = noise * np.sqrt(across) / scene.albedo.reshape(-1)[chosen][solvable]
    return float(np.degrees(np.sqrt(np.pi) / 2 * rms.mean()))


def _mean_deg(
    found: NormalMaps, scene: BallScene, noise: float, rng: np.random.Generator
) -> ErrorEstimate:
    """Return the mean error of normals with its bound, degrees."""
    visible = scene.inside & found.valid
    error = np.degrees(angular_error_rad(found.normals[visible], scene.normals[visible]))
    some = rng.choice(error, min(error.size, 20_000), replace=False)
    interval = bootstrap_interval(some, np.mean, draws=100, rng=rng)
    return ErrorEstimate(float(error.mean()), interval, _mean_bound_deg(scene, noise))


def measure_normals(stage: BenchmarkStage) -> None:
    """Measure normals of a glossy ball over lights, robust steps and noise, then at full size."""
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
        # specular reflection and noise are independent of albedo: darker skin has less signal
        scene = ball(count, albedo=float(band.reflectance()[1]))
        found = estimate_normals(scene.images, scene.lights)
        return _mean_deg(found, scene, SAMPLE_NOISE, rng)

    stage.measure_bands(on_skin)
    if not stage.toy:
        stage.limits = _full_size(rng)


def _full_size(rng: np.random.Generator) -> LimitValues:
    """Measure the fit of 1024 x 1024 x 150 and the NumPy fit of some of its pixels."""
    side = 1024
    scene = render_glossy_ball(side, 150, noise=SAMPLE_NOISE, rng=rng)
    estimate_normals(scene.images[:, :8, :8], scene.lights)
    ours_s = measure_processor_seconds(lambda: estimate_normals(scene.images, scene.lights), 3)
    ours_s /= LIMIT_CORES
    chosen = np.sort(rng.choice(np.flatnonzero(scene.inside), 300, replace=False))
    some = scene.images.reshape(150, -1)[:, chosen].astype(np.float64)
    with threadpool_limits(1):
        peer_s, theirs = measure_processor_time(lambda: fit_normals_with_numpy(some, scene.lights))
    peer_s *= side**2 / len(chosen)
    ours = estimate_normals(scene.images.reshape(150, -1)[:, chosen], scene.lights)
    truth = scene.normals.reshape(-1, 3)[chosen]
    both = ours.valid & (np.linalg.norm(theirs, axis=1) > 0)
    error = np.degrees(angular_error_rad(ours.normals[both], truth[both])).mean()
    peer_error = np.degrees(angular_error_rad(theirs[both], truth[both])).mean()
    return {
        "seconds": ours_s,
        "speed_up": peer_s / (LIMIT_CORES * ours_s),
        "over_irls": float(error / peer_error),
    }
