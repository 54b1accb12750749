"""Benchmark of photon transport: light at each fiber, and photons per second, against peers."""

from contextlib import suppress
from functools import partial
from math import inf, log, pi, sqrt
from typing import Any

import numpy as np
from numba import njit

from capture.rig import load_rig
from rigsim.fiber.profile import trace_fiber_profile
from rigsim.mitsuba.render_error import RenderError
from rigsim.mitsuba.scene_radiance import look_at, radiance
from rigsim.tissue.tissue_mc import Layer, LayerStack, trace_photons
from skinrig.arrays import Float64Array
from skinrig.benchmarks.measurement import LIMIT_CORES, measure_processor_time
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues
from skinrig.evaluating.skin_bands import MelaninBand

RED_MEDIUM_PER_MM = (0.04, 1.5)  # sigma_a and sigma_s', 1/mm; see rigs.md section 4
MEDIUM_G = 0.8
ETA = 1.4
SPEED_MEDIUM = (0.05, 10.0, 0.9, 1.4)  # sigma_a, sigma_s (1/mm), g, eta
MCML_R_D = 0.3592  # MCML's diffuse reflectance of that medium, without the specular reflection
PEER_SAMPLES = 4096
N_PEER_RUNS = 20


@njit(cache=True, nogil=True)
def trace_half_space(sigma_a, sigma_s, g, eta, photons, seed, sine, edges2, rings):  # type: ignore[no-untyped-def]
    """Trace photons in a half-space as MCML does, without optimization; return the exiting weight.

    `rings` receives the weights that exit within a cone of the sine `sine`, binned by r^2.
    """
    np.random.seed(seed)  # noqa: NPY002, numba's own generator
    sigma_t = sigma_a + sigma_s
    total = 0.0
    for _ in range(photons):
        x, y, z, ux, uy, uz = 0.0, 0.0, 0.0, 0.0, 0.0, 1.0
        weight = 1.0 - ((eta - 1.0) / (eta + 1.0)) ** 2
        while weight > 0.0:
            step = -log(1.0 - np.random.random()) / sigma_t  # noqa: NPY002
            while uz < 0.0 and step * -uz > z:
                gap = -z / uz
                x += gap * ux
                y += gap * uy
                z = 0.0
                step -= gap
                sin_t = eta * sqrt(1.0 - uz * uz)
                reflected = 1.0
                if sin_t < 1.0:
                    cos_i, cos_t = -uz, sqrt(1.0 - sin_t * sin_t)
                    r_s = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
                    r_p = (cos_i * 1.0 - eta * cos_t) / (cos_i * 1.0 + eta * cos_t)
                    reflected = 0.5 * (r_s * r_s + r_p * r_p)
                if np.random.random() > reflected:  # noqa: NPY002
                    total += weight
                    if sin_t <= sine:
                        ring = np.searchsorted(edges2, x * x + y * y) - 1
                        if 0 <= ring < rings.size:
                            rings[ring] += weight
                    weight = 0.0
                    break
                uz = -uz
            if weight == 0.0:
                break
            x += step * ux
            y += step * uy
            z += step * uz
            weight *= sigma_s / sigma_t
            if weight < 1e-4:  # Russian roulette: survival 0.1, weight times 10
                weight = weight * 10.0 if np.random.random() < 0.1 else 0.0  # noqa: NPY002
            # Henyey-Greenstein: inverse of the cumulative distribution of the cosine
            u = np.random.random()  # noqa: NPY002
            cosine = 2.0 * u - 1.0
            if g != 0.0:
                part = (1.0 - g * g) / (1.0 - g + 2.0 * g * u)
                cosine = (1.0 + g * g - part * part) / (2.0 * g)
            azimuth = 2.0 * pi * np.random.random()  # noqa: NPY002
            sin_a, cos_a = np.sin(azimuth), np.cos(azimuth)
            sine_t = sqrt(max(0.0, 1.0 - cosine * cosine))
            if abs(uz) > 0.99999:
                ux, uy, uz = sine_t * cos_a, sine_t * sin_a, cosine if uz > 0.0 else -cosine
            else:
                root = sqrt(1.0 - uz * uz)
                vx = sine_t * (ux * uz * cos_a - uy * sin_a) / root + ux * cosine
                vy = sine_t * (uy * uz * cos_a + ux * sin_a) / root + uy * cosine
                uz = -sine_t * cos_a * root + uz * cosine
                ux, uy = vx, vy
    return total


def measure_photon_transport(stage: BenchmarkStage) -> None:
    """Measure light at the fibers by next event and by photons in the cone, then against peers."""
    probe = load_rig("probe").probe
    if probe is None:
        raise ValueError("probe rig: got no probe, expected its fibers; reinstall skinrig")
    radii = np.array(probe.radius_mm)
    stack = _half_space(*RED_MEDIUM_PER_MM)
    timed = partial(stage.time, repeats=1, memory=None)
    for photons in (1000, 2000) if stage.toy else (5000, 20_000, 80_000, 320_000):
        timing, run = timed(lambda: _next_event(stack, radii, photons))
        knobs: Knobs = {"quantity": "fibers", "score": "next event", "photons": photons}
        stage.add(knobs, timing, _max_relative_stderr(run.stderr / run.reflectance_per_mm2))
    for photons in (1000, 2000) if stage.toy else (80_000, 320_000):
        timing, relative = timed(lambda: _cone_relative_stderr(radii, photons))
        knobs = {"quantity": "fibers", "score": "leaves in the cone", "photons": photons}
        stage.add(knobs, timing, _max_relative_stderr(relative))
    medium = LayerStack((Layer(inf, SPEED_MEDIUM[0], *SPEED_MEDIUM[1:]),))
    for engine in ("numba", "drjit"):
        with suppress(ValueError):  # drjit needs LLVM
            timing, total = timed(
                lambda: trace_photons(
                    medium,
                    photons=2000 if stage.toy else 400_000,
                    rng=np.random.default_rng(2),
                    engine=engine,
                )
            )
            error = 100.0 * total.reflectance_stderr / total.reflectance
            knobs = {"quantity": "all that leaves", "engine": engine, "photons": total.photons}
            # a standard deviation of n batches has the relative error 1 / sqrt(2 (n - 1))
            half = error / sqrt(2.0 * (total.batches - 1))
            stage.add(knobs, timing, ErrorEstimate.symmetric(error, half))
    photons = 2000 if stage.toy else 20_000
    stage.measure_bands(lambda band: _on_skin(band, radii, photons))
    if not stage.toy:
        stage.limits = (
            _one_percent(radii, stack) | _against_volpath(radii) | _compare_photon_rates(medium)
        )


def _on_skin(band: MelaninBand, radii: Float64Array, photons: int) -> ErrorEstimate:
    """Return the error of a number of photons in skin of a melanin band."""
    stack = _half_space(band.sigma_a_per_mm, band.sigma_s_prime_per_mm)
    run = _next_event(stack, radii, photons)
    return _max_relative_stderr(run.stderr / run.reflectance_per_mm2)


def _half_space(sigma_a: float, sigma_s_prime: float, eta: float = ETA) -> LayerStack:
    return LayerStack((Layer(inf, sigma_a, sigma_s_prime / (1.0 - MEDIUM_G), MEDIUM_G, eta),))


def _next_event(stack: LayerStack, radii: Float64Array, photons: int) -> Any:
    """Trace the light at the fibers by next-event estimation."""
    rng = np.random.default_rng(1)
    return trace_fiber_profile(stack, radii_mm=radii, photons=photons, rng=rng, threads=LIMIT_CORES)


def _max_relative_stderr(relative: Float64Array) -> ErrorEstimate:
    """Return the largest relative standard error, %, of 20 batches."""
    worst = float(100.0 * np.nan_to_num(relative, nan=1.0, posinf=1.0).max())
    return ErrorEstimate.symmetric(worst, worst / sqrt(2.0 * 19.0))


def _cone_relative_stderr(radii: Float64Array, photons: int) -> Float64Array:
    """Return relative standard errors of the plain walk in rings of the fibers' width."""
    rings = np.zeros((20, 2 * len(radii)))
    edges = np.sort(np.concatenate([radii - 0.1, radii + 0.1]))
    for batch, row in enumerate(rings):
        counted = np.zeros(edges.size - 1)
        trace_half_space(
            RED_MEDIUM_PER_MM[0],
            RED_MEDIUM_PER_MM[1] / (1.0 - MEDIUM_G),
            MEDIUM_G,
            ETA,
            photons // 20,
            batch,
            0.22,
            edges**2,
            counted,
        )
        row[: counted.size] = counted
    counts = rings[:, 0 : 2 * len(radii) : 2]
    mean, error = counts.mean(axis=0), counts.std(axis=0, ddof=1) / sqrt(20.0)
    return np.divide(error, mean, out=np.full(len(mean), np.nan), where=mean > 0)


def _one_percent(radii: Float64Array, stack: Any) -> LimitValues:
    seconds, run = measure_processor_time(
        lambda: trace_fiber_profile(
            stack, radii_mm=radii, photons=200_000, rng=np.random.default_rng(3), batches=100
        )
    )
    worst = 100.0 * float((run.stderr / run.reflectance_per_mm2).max())
    # the error falls with 1 / sqrt(seconds): time to 1 % is seconds * (error in %)^2
    return {"seconds": seconds * worst**2 / LIMIT_CORES}


def _against_volpath(radii: Float64Array) -> LimitValues:
    """Compare with volpath at n = 1: a lit disc, viewed along the normal, one pixel per fiber."""
    scene = build_volpath_scene(radii)
    try:
        radiance(scene, kind="mono", samples=16)
    except (RenderError, RuntimeError):  # no variant with volumes is installed
        return {}
    peer_s, runs = measure_processor_time(
        lambda: [
            radiance(scene, kind="mono", samples=PEER_SAMPLES, seed=seed)[0, :, 0]
            for seed in range(N_PEER_RUNS)
        ]
    )
    images = np.array(runs, np.float64)
    mean, error = images.mean(axis=0), images.std(axis=0, ddof=1) / sqrt(N_PEER_RUNS)
    # pixels with light in at most one run have an unknown error; 100 % is in the peer's favor
    relative = np.where(mean > 0.0, 100.0 * error / np.maximum(mean, 1e-30), 100.0)
    stack = _half_space(*RED_MEDIUM_PER_MM, eta=1.0)
    ours_s, run = measure_processor_time(
        lambda: trace_fiber_profile(
            stack,
            radii_mm=radii,
            photons=100_000,
            rng=np.random.default_rng(4),
            batches=100,
            source_numerical_aperture=1.0,
        )
    )
    ours = ours_s * float((100.0 * run.stderr / run.reflectance_per_mm2).max()) ** 2
    # the peer's samples are counted as if they were distributed optimally over the fibers
    peers = peer_s * float((relative**2).mean())
    return {"over_volpath": peers / ours}


def build_volpath_scene(radii: Float64Array) -> dict[str, Any]:
    """Build Mitsuba's scene of a lit disc on a half-space, with one square pixel per fiber.

    The radiance times pi is the exitance per source power for Lambertian exitance.
    """
    pitch = float(radii[1] - radii[0])
    middle, half = float(radii.mean()), 0.5 * pitch * len(radii)
    sigma_s = RED_MEDIUM_PER_MM[1] / (1.0 - MEDIUM_G)
    sigma_t = RED_MEDIUM_PER_MM[0] + sigma_s

    def placed(x: float, y: float, z: float, at: float) -> Float64Array:
        matrix = np.diag([x, y, z, 1.0])
        matrix[2, 3] = at
        return matrix

    return {
        "type": "scene",
        "integrator": {"type": "volpath", "max_depth": 2000, "rr_depth": 50},
        "sensor": {
            "type": "orthographic",
            "near_clip": 0.01,
            "far_clip": 100.0,
            "to_world": look_at([middle, 0, 5], [middle, 0, 0], [0, 1, 0])
            @ np.diag([half, half, 1.0, 1.0]),
            "sampler": {"type": "independent"},
            "film": {
                "type": "hdrfilm",
                "width": len(radii),
                "height": 1,
                "pixel_format": "luminance",
                "rfilter": {"type": "box"},
            },
        },
        "tissue": {
            "type": "cube",
            "to_world": placed(100.0, 100.0, 100.0, -100.0),
            "bsdf": {"type": "null"},
            "interior": {
                "type": "homogeneous",
                "sigma_t": {"type": "spectrum", "value": sigma_t},
                "albedo": {"type": "spectrum", "value": sigma_s / sigma_t},
                "phase": {"type": "hg", "g": MEDIUM_G},
            },
        },
        "light": {
            "type": "disk",
            "to_world": placed(0.1, -0.1, -0.1, 0.001),
            "emitter": {
                "type": "area",
                "radiance": {"type": "spectrum", "value": 1.0 / (pi * pi * 0.1**2)},
            },
        },
    }


def _compare_photon_rates(medium: Any) -> LimitValues:
    """Compare photons per processor second with the plain walk, and R_d with MCML."""
    edges2, rings = np.array([0.0, 1.0]), np.zeros(1)
    trace_half_space(*SPEED_MEDIUM, 10, 0, 1.0, edges2, rings)
    plain_s, _ = measure_processor_time(
        lambda: trace_half_space(*SPEED_MEDIUM, 40_000, 0, 1.0, edges2, rings), 3
    )
    scalar_s, _ = measure_processor_time(
        lambda: trace_photons(medium, photons=40_000, rng=np.random.default_rng(5)), 3
    )
    photons = 2_000_000
    try:
        ours_s, run = measure_processor_time(
            lambda: trace_photons(
                medium, photons=photons, rng=np.random.default_rng(6), engine="drjit", batches=40
            ),
            2,
        )
    except ValueError:
        return {}
    rate = run.photons / ours_s
    return {
        "over_walk": rate / (40_000 / plain_s),
        "over_own_walk": rate / (40_000 / scalar_s),
        "off_mcml": max(abs(run.reflectance - MCML_R_D) - 5e-4, 0.0) / run.reflectance_stderr,
    }
