"""Benchmarks of anisotropy over directions and of translucency maps over sites, with bounds."""

import math
from typing import Literal

import numpy as np
from scipy import stats
from threadpoolctl import threadpool_limits

from model import photon_table
from reconstruction import subsurface
from reconstruction.anisotropy import estimation as anisotropy
from reconstruction.anisotropy import profile_anisotropy
from reconstruction.subsurface import translucency
from reconstruction.subsurface.probe_sites import SITE_UV
from reconstruction.subsurface.translucency import TEXTURE_MM, TranslucencyPrior
from skinrig.arrays import Float64Array
from skinrig.benchmarks.measurement import measure_processor_seconds
from skinrig.benchmarks.resampling import gaussian_rms
from skinrig.benchmarks.results import ErrorEstimate
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.skin_bands import MelaninBand

AnisotropyMethod = Literal["sigma_tr", "profiles"]
ANISOTROPY_METHODS: tuple[AnisotropyMethod, ...] = ("sigma_tr", "profiles")

FIBER_RADII_MM = 0.3 + 0.25 * np.arange(28)
Medium = tuple[float, float]
"""sigma_a and sigma_s', 1/mm."""

MEDIUM_PER_MM: Medium = (0.04, 1.5)
ETA = 1.4
TRUE_RATIO, TRUE_AXIS_RAD = 1.1, 0.6
"""Largest over smallest 1/sigma_tr, and the axis of the largest."""
COUPLING_ERROR, SINGLE_FIBER_ERROR, DARK_NOISE = 0.02, 0.01, 1e-7
"""Relative standard deviations of the coupling of each placement and of each fiber; noise,
1/mm^2."""
FALSE_ALARM_RATE = 0.01
LIMIT_FALSE_ALARM_PROBABILITY = 1e-6
"""Probability that a correct estimator exceeds the limit of false alarms."""
SITE_ERROR = 0.03
"""Relative standard error of sigma_tr at a site."""


def _directions(count: int) -> Float64Array:
    return np.asarray(np.arange(count) * (math.tau / count))


def _profiles(
    angle: Float64Array,
    ratio: float,
    cases: int,
    *,
    medium: Medium = MEDIUM_PER_MM,
    rng: np.random.Generator,
) -> Float64Array:
    """Simulate readings (N, cases, F) of tissue that scatters less along an axis."""
    sigma_tr = np.hypot(np.cos(angle - TRUE_AXIS_RAD) / ratio, np.sin(angle - TRUE_AXIS_RAD))
    # sigma_tr^2 = 3 sigma_a (sigma_a + sigma_s'), scaled about the geometric mean of its extremes
    sigma_a, sigma_s_prime = medium
    total = (sigma_a + sigma_s_prime) * ratio * sigma_tr**2
    truth = photon_table.reflectance(FIBER_RADII_MM, sigma_a, (total - sigma_a)[:, None], eta=ETA)
    shape = (angle.size, cases, FIBER_RADII_MM.size)
    readings = truth[:, None] * np.exp(COUPLING_ERROR * rng.standard_normal((*shape[:2], 1)))
    readings = readings * (1.0 + SINGLE_FIBER_ERROR * rng.standard_normal(shape))
    return np.asarray(readings + DARK_NOISE * rng.standard_normal(shape))


def _estimate_anisotropy(
    method: AnisotropyMethod,
    angle: Float64Array,
    profiles: Float64Array,
    *,
    medium: Medium = MEDIUM_PER_MM,
) -> anisotropy.Anisotropy:
    variance = np.full(profiles.shape, DARK_NOISE**2)
    if method == "profiles":
        return profile_anisotropy.estimate_from_profiles(
            angle,
            FIBER_RADII_MM,
            profiles,
            variance,
            sigma_a_per_mm=medium[0],
            sigma_s_prime_per_mm=medium[1],
            eta=ETA,
            floor=SINGLE_FIBER_ERROR,
        )
    fits = subsurface.invert(
        FIBER_RADII_MM,
        profiles,
        eta=ETA,
        variance=variance + (SINGLE_FIBER_ERROR * profiles) ** 2,
        common_error=COUPLING_ERROR,
        g_error=0.0,
        model_error=0.0,
    )
    return anisotropy.estimate(angle, fits.sigma_tr_per_mm, fits.sigma_tr_stderr, valid=fits.valid)


def _bound(count: int, medium: Medium = MEDIUM_PER_MM) -> float:
    """Return the Cramér-Rao bound of the log ratio with known absorption and unknown coupling."""
    sigma_a, sigma_s_prime = medium
    here = photon_table.derivatives(FIBER_RADII_MM, sigma_a, sigma_s_prime, eta=ETA)
    light = here.reflectance_per_mm2
    by_log = here.by_sigma_s_prime * sigma_s_prime
    # parameters: log coupling, with its Gaussian prior, and log sigma_s'
    weight = 1.0 / ((SINGLE_FIBER_ERROR * light) ** 2 + DARK_NOISE**2)
    across = (weight * light * by_log).sum()
    fisher = np.array(
        [
            [(weight * light * light).sum() + COUPLING_ERROR**-2.0, across],
            [across, (weight * by_log * by_log).sum()],
        ]
    )
    # d log sigma_tr = 0.5 sigma_s' / (sigma_a + sigma_s') d log sigma_s'
    single = math.sqrt(np.linalg.inv(fisher)[1, 1])
    single *= 0.5 * sigma_s_prime / (sigma_a + sigma_s_prime)
    # log sigma_tr = const - h / 2 cos 2 theta, where h is the log ratio: the amplitude of a cosine
    # over N directions has the standard deviation sqrt(2 / N)
    return 2.0 * single * math.sqrt(2.0 / count)


def measure_directions(stage: BenchmarkStage) -> None:
    """Measure ratios from 5 to 64 directions, by fits of each and by comparison of profiles."""
    rng = np.random.default_rng(0)
    cases = 12 if stage.toy else 200
    for count in (5, 16) if stage.toy else (5, 8, 16, 32, 64):
        angle = _directions(count)
        profiles = _profiles(angle, TRUE_RATIO, cases, rng=rng)
        one = profiles[:, :3]  # three channels of one measurement
        for way in ANISOTROPY_METHODS:
            timing, _ = stage.time(lambda: _estimate_anisotropy(way, angle, one), memory=False)
            outcome = _ratio_error(_estimate_anisotropy(way, angle, profiles), _bound(count))
            stage.add({"way": way, "directions": count}, timing, outcome)
    angle = _directions(16)

    def on_skin(band: MelaninBand) -> ErrorEstimate:
        medium = band.sigma_a_per_mm, band.sigma_s_prime_per_mm
        profiles = _profiles(angle, TRUE_RATIO, cases, medium=medium, rng=rng)
        return _ratio_error(
            _estimate_anisotropy("profiles", angle, profiles, medium=medium), _bound(16, medium)
        )

    stage.measure_bands(on_skin)
    if not stage.toy:
        _evaluate_directions(stage, rng)


def _ratio_error(found: anisotropy.Anisotropy, bound: float) -> ErrorEstimate:
    """Return the RMS error of the log ratio, with cases - 1 degrees of freedom."""
    off = np.log(found.ratio) - math.log(TRUE_RATIO)
    return gaussian_rms(off, bound=bound, freedom=len(found.ratio) - 1)


def _evaluate_directions(stage: BenchmarkStage, rng: np.random.Generator) -> None:
    cases = 1000
    angle = _directions(16)
    null = _profiles(angle, 1.0, cases, rng=rng)
    # a falsely omitted outlier may add its own rate
    max_alarms = float(
        stats.binom.isf(LIMIT_FALSE_ALARM_PROBABILITY, cases, FALSE_ALARM_RATE + 0.001)
    )
    for way in ANISOTROPY_METHODS:
        alarms = float((_estimate_anisotropy(way, angle, null).p_value < FALSE_ALARM_RATE).sum())
        stage.limits["alarms", str(cases), way] = (alarms, max_alarms)
    fits, profiles = (stage.find_point(way=way, directions=16).error for way in ANISOTROPY_METHODS)
    stage.limits |= {"over_bound": profiles / _bound(16), "over_profiles": fits / profiles}


def _root(prior: TranslucencyPrior, uv: Float64Array) -> Float64Array:
    """Return a square root of the prior covariance of log(1/sigma_tr) at positions (P, 2)."""
    at = uv * np.array(TEXTURE_MM)
    squared = ((at[:, None] - at[None]) ** 2).sum(axis=-1) / prior.length_mm**2
    covariance = prior.person_deviation[0] ** 2 + prior.place_deviation[0] ** 2 * np.exp(
        -0.5 * squared
    )
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def measure_sites(stage: BenchmarkStage) -> None:
    """Measure maps of 1/sigma_tr from 1 to 16 sites, and time against scikit-learn."""
    rng = np.random.default_rng(0)
    whole = translucency.population_prior()
    prior = TranslucencyPrior(
        whole.log_mean[:1], whole.person_deviation[:1], whole.place_deviation[:1]
    )
    named = np.array([SITE_UV[n] for n in ("forehead", "cheek left", "cheek right", "chin")])
    more = np.stack(np.meshgrid([0.25, 0.42, 0.58, 0.75], [0.25, 0.45, 0.65, 0.85]), axis=-1)
    layouts = {1: named[:1], 2: named[:2], 3: named[[0, 1, 3]], 4: named, 16: more.reshape(-1, 2)}
    side, faces = (8, 6) if stage.toy else (16, 150)
    v, u = np.meshgrid(
        1 - (np.arange(side) + 0.5) / side, (np.arange(side) + 0.5) / side, indexing="ij"
    )
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    size = 64 if stage.toy else 1024
    for count, uv in layouts.items():
        if stage.toy and count == 16:
            continue
        squares, stated, inside = [], [], []
        root = _root(prior, np.concatenate([uv, pixels]))
        for _ in range(faces):
            log = prior.log_mean[0] + root @ rng.standard_normal(len(root))
            measured = np.exp(-log[:count] + SITE_ERROR * rng.standard_normal(count))[:, None]
            found = translucency.interpolate(
                uv, measured, SITE_ERROR * measured, (side, side), prior=prior
            )
            off = np.log(found.values.reshape(-1)) - log[count:]
            deviation = found.log_stderr.reshape(-1)
            squares.append((off**2).mean())
            stated.append((deviation.astype(np.float64) ** 2).mean())
            inside.append((np.abs(off) < deviation).mean())
        three = np.repeat(measured, 3, axis=1)
        timing, _ = stage.time(
            lambda: translucency.interpolate(uv, three, SITE_ERROR * three, (size, size)),
            memory=not stage.toy,
        )
        error, bound = (math.sqrt(float(np.mean(part))) for part in (squares, stated))
        half = float(np.std(squares)) / math.sqrt(faces) / (2 * error)
        outcome = ErrorEstimate.symmetric(error, half, bound)
        stage.add({"sites": count, "side": size}, timing, outcome)
        if count == 3:
            within, three_sites = float(np.mean(inside)), error
    if not stage.toy:
        times, mismatch = _compare_with_scikit_learn(prior, named)
        # without sites, the error is the standard deviation of the population
        population_std = math.hypot(
            float(prior.person_deviation[0]), float(prior.place_deviation[0])
        )
        stage.limits = {
            "within": within,
            "within_least": within,
            "over_mean": three_sites / population_std,
            "speed_up": times,
            "difference": mismatch,
        }


def _compare_with_scikit_learn(prior: TranslucencyPrior, uv: Float64Array) -> tuple[float, float]:
    """Return the speed-up over scikit-learn's Gaussian process, and the largest difference."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel

    side = 512
    sigma = np.array([[0.5], [0.6], [0.55], [0.7]])
    kernel = ConstantKernel(prior.person_deviation[0] ** 2, "fixed") + ConstantKernel(
        prior.place_deviation[0] ** 2, "fixed"
    ) * RBF(prior.length_mm, "fixed")
    center = (np.arange(side) + 0.5) / side
    u, v = np.meshgrid(center, 1.0 - center)
    positions = np.stack([u, v], axis=-1).reshape(-1, 2) * np.array(TEXTURE_MM)

    def theirs() -> tuple[Float64Array, Float64Array]:
        process = GaussianProcessRegressor(kernel, alpha=SITE_ERROR**2, optimizer=None)
        process.fit(uv * np.array(TEXTURE_MM), -np.log(sigma[:, 0]) - prior.log_mean[0])
        mean, deviation = process.predict(positions, return_std=True)
        return mean + prior.log_mean[0], deviation

    def ours() -> translucency.TranslucencyMap:
        return translucency.interpolate(uv, sigma, SITE_ERROR * sigma, (side, side), prior=prior)

    found, (mean, deviation) = ours(), theirs()
    mismatch = max(
        float(np.abs(np.log(found.values.reshape(-1)) - mean).max()),
        float(np.abs(found.log_stderr.reshape(-1) - deviation).max()),
    )
    with threadpool_limits(1, "blas"):
        return measure_processor_seconds(theirs, 2) / max(
            measure_processor_seconds(ours, 5), 1e-6
        ), mismatch
