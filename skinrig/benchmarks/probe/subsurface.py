"""Benchmarks of the inversion of radial profiles: model, fibers, and batches against SciPy."""

from math import inf
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from model.dipole import kienle_patterson as diffusion
from reconstruction import subsurface
from reconstruction.subsurface.models import Method
from rigsim.fiber.profile import trace_fiber_profile
from rigsim.tissue.tissue_mc import Layer, LayerStack
from skinrig.arrays import BoolArray, Float64Array
from skinrig.benchmarks.measurement import measure_processor_seconds
from skinrig.benchmarks.resampling import bootstrap_columns_median, median_error
from skinrig.benchmarks.results import ErrorEstimate, Knobs
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues
from skinrig.evaluating.skin_bands import MELANIN_BANDS, MelaninBand

FIBER_RADII_MM = 0.3 + 0.25 * np.arange(28)
FIBER_CORE_MM = 0.2
RELATIVE_FIBER_ERROR, RELATIVE_COMMON_ERROR = 0.012, 0.01
"""Relative errors of a calibration: of each fiber, and common to all."""
DARK_NOISE_PER_MM2 = 1e-8
"""Dark noise of a reading, 1/mm^2."""
N_BATCH_PROFILES = 30_000
N_PEER_FITS = 60
"""Timed SciPy fits; their time is extrapolated to the batch."""


def simulate_profiles(*, toy: bool) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Simulate profiles and their errors (N, 28) by Monte Carlo; return also true sigma_tr (N,).

    Media have sigma_tr from 0.3 to 3.0 per mm, random sigma_s' and three values of g in turn. The
    last three are the melanin bands.
    """
    rng = np.random.default_rng(0)
    media = []
    for k in np.geomspace(0.3, 3.0, 3 if toy else 10):
        s = float(np.exp(rng.uniform(np.log(0.7), np.log(4.0))))
        media.append((0.5 * (np.sqrt(s**2 + 4.0 / 3.0 * k**2) - s), s))
    media += [(b.sigma_a_per_mm, b.sigma_s_prime_per_mm) for b in MELANIN_BANDS.values()]
    sigma_tr = np.array([np.sqrt(3.0 * a * (a + s)) for a, s in media])
    profiles, errors = np.empty((2, len(media), FIBER_RADII_MM.size))
    for n, (a, s) in enumerate(media):
        g = (0.8, 0.73, 0.9)[n % 3]
        found = trace_fiber_profile(
            LayerStack((Layer(inf, a, s / (1.0 - g), g, 1.4),)),
            radii_mm=FIBER_RADII_MM,
            photons=3_000 if toy else 100_000,
            rng=np.random.default_rng(n),
            core_mm=FIBER_CORE_MM,
            source_core_mm=FIBER_CORE_MM,
        )
        profiles[n], errors[n] = found.reflectance_per_mm2, found.stderr
    return sigma_tr, profiles, errors


def measure_tiers(stage: BenchmarkStage) -> None:
    """Measure fits of Monte Carlo profiles by three models, with all fibers and with fewer."""
    rng = np.random.default_rng(1)
    sigma_tr, profiles, errors = simulate_profiles(toy=stage.toy)
    media = slice(0, len(sigma_tr) - len(MELANIN_BANDS))
    draws = 4 if stage.toy else 40
    shape = (draws, *profiles.shape)
    noisy = profiles * np.exp(RELATIVE_COMMON_ERROR * rng.standard_normal((*shape[:2], 1)))
    noisy *= 1.0 + RELATIVE_FIBER_ERROR * rng.standard_normal(shape)
    noisy += DARK_NOISE_PER_MM2 * rng.standard_normal(shape)
    variance = (RELATIVE_FIBER_ERROR * profiles) ** 2 + errors**2 + DARK_NOISE_PER_MM2**2
    chosen: list[tuple[Method, slice]] = [
        ("photon_table", slice(None)),
        ("diffusion", slice(None)),
        ("dipole", slice(None)),
        ("photon_table", slice(0, None, 2)),
        ("photon_table", slice(4, None)),
        ("photon_table", slice(0, 14)),
        ("photon_table", slice(0, None, 4)),
    ]
    best = np.zeros(1)
    for method, part in chosen:
        timing, found = stage.time(
            lambda: subsurface.invert(
                FIBER_RADII_MM[part],
                noisy[..., part],
                variance=variance[..., part],
                method=method,
                collection="fiber",
                core_mm=FIBER_CORE_MM,
                source_core_mm=FIBER_CORE_MM,
                common_error=RELATIVE_COMMON_ERROR,
            )
        )
        relative = found.sigma_tr_per_mm / sigma_tr - 1.0
        if not stage.by_band:
            own = np.abs(relative[:, -len(MELANIN_BANDS) :].T)
            stage.by_band |= dict(zip(MELANIN_BANDS, map(median_error, own), strict=True))
        error = np.abs(relative[:, media])
        radius = FIBER_RADII_MM[part]
        knobs: Knobs = {"model": method, "fibers": radius.size}
        knobs |= {"from mm": float(radius[0]), "to mm": float(radius[-1])}
        stage.add(knobs, timing, bootstrap_columns_median(error))
        if part == slice(None):
            bias = np.median(relative[:, media], axis=0)
            low, high = np.moveaxis(found.interval_per_mm, -1, 0)
            inside = ((low <= sigma_tr) & (sigma_tr <= high))[:, media]
            best = bias if method == "photon_table" else best
            stage.limits |= _tier_limits(method, error, bias, inside, best)
    relative_error = float(np.median(errors / profiles))
    stage.reference_error = relative_error / np.sqrt(FIBER_RADII_MM.size)


def _tier_limits(
    method: Method, error: Float64Array, bias: Float64Array, inside: BoolArray, best: Float64Array
) -> LimitValues:
    """Return the limits' values of a model with all fibers; `best` is the photon table's bias."""
    if method == "dipole":
        over_table = float(np.median(np.abs(bias))) / max(float(np.median(np.abs(best))), 1e-9)
        return {
            "least_bias": float(bias.max()),
            "greatest_bias": float(bias.min()),
            "over_table": over_table,
        }
    if method != "photon_table":
        return {}
    # the limits are 60 to 76 % plus the variation of ten media's coverage by simulation noise
    coverage = float(inside.mean())
    return {
        "median": float(np.median(error)),
        "worst": float(np.median(error, axis=0).max()),
        "inside": coverage,
        "inside_most": coverage,
    }


def _minimum_error(
    sigma_a: Float64Array, sigma_s: Float64Array, variance: Float64Array
) -> Float64Array:
    """Return the Cramér-Rao bound of each profile's relative error of sigma_tr, (N,)."""
    step = 1e-4
    slopes = [
        diffusion.reflectance(
            FIBER_RADII_MM, (sigma_a * up)[:, None], (sigma_s * along)[:, None], 1.4
        )
        for up, along in ((1 + step, 1), (1 - step, 1), (1, 1 + step), (1, 1 - step))
    ]
    # derivatives by the logarithms of both coefficients
    by_log = np.stack([slopes[0] - slopes[1], slopes[2] - slopes[3]], axis=-1) / (2.0 * step)
    information = np.einsum("nfi,nfj,nf->nij", by_log, by_log, 1.0 / variance)
    covariance = np.linalg.inv(information)
    # log sigma_tr = (log a + log (a + s')) / 2 + const
    total = sigma_a + sigma_s
    gradient = 0.5 * np.stack([1.0 + sigma_a / total, sigma_s / total], axis=-1)
    return np.asarray(np.sqrt(np.einsum("ni,nij,nj->n", gradient, covariance, gradient)))


def _absorbs_like(sigma_a: Float64Array, band: MelaninBand) -> BoolArray:
    """Return the mask of media whose sigma_a is within a factor of two of a band's skin."""
    return np.asarray(np.abs(np.log(sigma_a / band.sigma_a_per_mm)) < np.log(2.0))


def measure_batches(stage: BenchmarkStage) -> None:
    """Measure batches of diffusion fits, 30,000 of them against a loop of SciPy's least_squares."""
    rng = np.random.default_rng(2)
    count = 200 if stage.toy else N_BATCH_PROFILES
    k = np.exp(rng.uniform(np.log(0.3), np.log(3.0), count))
    s = np.exp(rng.uniform(np.log(0.7), np.log(4.0), count))
    a = 0.5 * (np.sqrt(s**2 + 4.0 / 3.0 * k**2) - s)
    clean = diffusion.reflectance(FIBER_RADII_MM, a[:, None], s[:, None], 1.4)
    variance = (0.02 * clean) ** 2 + DARK_NOISE_PER_MM2**2
    noisy = clean + np.sqrt(variance) * rng.standard_normal(clean.shape)

    def ours(n: int = count, model_error: float | None = 0.0) -> subsurface.SubsurfaceFit:
        return subsurface.invert(
            FIBER_RADII_MM,
            noisy[:n],
            variance=variance[:n],
            method="diffusion",
            model_error=model_error,
        )

    drawn = np.abs(_minimum_error(a, s, variance) * rng.standard_normal(count))
    for model_error in (0.0, None):
        for n in (count // 10, count):
            timing, made = stage.time(lambda: ours(n, model_error))
            error = np.abs(made.sigma_tr_per_mm / k[:n] - 1.0)
            # the bound includes noise only: these data have no model error
            bound = float(np.median(drawn[:n])) if model_error == 0.0 else None
            own = "none" if model_error == 0.0 else "diffusion's"
            outcome = median_error(error, bound=bound)
            stage.add({"profiles": n, "model error": own}, timing, outcome)
            if not stage.by_band and n == count:

                def on_skin(band: MelaninBand) -> ErrorEstimate:
                    some = _absorbs_like(a, band)
                    return median_error(error[some], float(np.median(drawn[some])))

                stage.measure_bands(on_skin)
    if not stage.toy:
        found, above, differences = ours(), [], []
        start = np.log([0.1, 1.0])

        def peer(n: int) -> Any:
            deviation = np.sqrt(variance[n])

            def residual(pair: Float64Array) -> Float64Array:
                sigma_a, sigma_s = np.exp(pair)
                value = diffusion.reflectance(FIBER_RADII_MM, sigma_a, sigma_s, 1.4)
                return np.asarray((value - noisy[n]) / deviation)

            return least_squares(residual, start, method="lm")

        for n in range(N_PEER_FITS):
            theirs = peer(n)
            above.append(float(found.chi2[n]) / (2.0 * theirs.cost) - 1.0)
            pair = np.array([found.sigma_a_per_mm[n], found.sigma_s_prime_per_mm[n]])
            differences.append(float(np.abs(np.log(pair) - theirs.x).max()))
        theirs_s = measure_processor_seconds(lambda: [peer(n) for n in range(N_PEER_FITS)], 2)
        theirs_s *= count / N_PEER_FITS
        ours_s = measure_processor_seconds(ours, 3)
        stage.limits = {
            "speed_up": theirs_s / ours_s,
            "chi2": float(max(above)),
            "apart": float(np.median(differences)),
        }
