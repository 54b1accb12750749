"""Benchmark of estimators' efficiency against the Cramér-Rao bound, from light to dark skin.

Each estimator receives data of its own model with noise of known variance, so that the result
depends only on its use of the data. The error is the mean squared error over that bound. Bounds are
computed from each forward equation by differences, not from the estimator's standard errors.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final, Literal

import numpy as np

from model import color_table, fresnel, photon_table
from model.tissue_optics.layers import ANISOTROPY_SKIN
from reconstruction import chromophores, diffuse_albedo, photometric_stereo, subsurface
from reconstruction.photometric_stereo import light_selection
from skinrig.arrays import Float64Array
from skinrig.benchmarks.results import ErrorEstimate, Knobs, Point
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.skin_bands import MELANIN_BANDS, classify_melanin


@dataclass(frozen=True, slots=True)
class EstimatorTrial:
    """Estimator with noise draws of one subject."""

    squared_errors: Callable[[], Float64Array]
    """Function that computes the squared errors of the draws."""
    bound: float
    """Cramér-Rao bound on their mean."""
    noise: float
    """Relative noise of a reading."""
    sigmas_above_zero: float = np.inf
    """True value over the bound's standard deviation, for quantities that cannot be negative."""


@dataclass(frozen=True, slots=True)
class TypicalSkin:
    """Parameters of typical skin of a preset."""

    melanin: float
    hemoglobin: float
    r_d: float
    sigma_a_per_mm: float
    sigma_s_per_mm: float


TYPICAL_SKINS: Final = {
    "palest": TypicalSkin(0.0075, 0.0065, 0.6, 0.02, 1.4),
    "II": TypicalSkin(0.016, 0.011, 0.5, 0.03, 1.3),
    "III": TypicalSkin(0.0255, 0.0125, 0.4, 0.05, 1.2),
    "IV": TypicalSkin(0.0395, 0.013, 0.3, 0.08, 1.2),
    "V": TypicalSkin(0.066, 0.0145, 0.2, 0.15, 1.1),
    "VI": TypicalSkin(0.16, 0.018, 0.1, 0.3, 1.0),
}
MIN_MEASURED_SIGMAS, MIN_EVALUATED_SIGMAS = 2.5, 10.0
"""Minimum distance of a fraction from 0, in standard errors. Below the first, nonnegative estimates
are clipped, and the bound of unbiased estimators does not apply. Below the second, the color is
nonlinear within the error and no estimator reaches the bound: it is measured, but not evaluated."""
CHANNEL_NOISES: Final = (0.004, 0.002, 0.001, 0.0005)
"""Relative noise per channel: first that of a typical image; lower ones, down to the mean of 64
pixels, are tried until the colors are linear within the noise."""
ALBEDO_NOISE = 0.02
"""Relative noise of a BRDF sample."""
FIBER_NOISE = 0.01
"""Relative noise of each fiber."""


def measure_efficiency(stage: BenchmarkStage) -> None:
    """Measure mean squared errors over Cramér-Rao bounds of each estimator and subject."""
    draws = 500 if stage.toy else 20_000
    worst = stage.by_band
    for name, made in _ESTIMATOR_TRIALS.items():
        ratios: dict[str, list[tuple[float, float]]] = {band: [] for band in MELANIN_BANDS}
        for subject, trial in made(draws):
            timing, squared = stage.time(trial.squared_errors, repeats=1)
            ratio = float(squared.mean()) / trial.bound
            stderr = float(squared.std() / np.sqrt(len(squared))) / trial.bound
            knobs: Knobs = {"estimator": name, "subject": subject}
            knobs["noise_percent"] = round(100 * trial.noise, 2)
            evaluated = trial.sigmas_above_zero >= MIN_EVALUATED_SIGMAS
            outcome = ErrorEstimate.symmetric(ratio, stderr, 1.0)
            stage.add(knobs, timing, outcome, {"judged": evaluated})
            if evaluated:
                ratios[str(classify_melanin(TYPICAL_SKINS[subject].melanin))].append(
                    (ratio, stderr)
                )
        stage.omitted += _excluded_subjects(name, stage.points)
        for band, pairs in ratios.items():
            if not pairs:
                continue
            each, stderrs = np.array(pairs).T
            ratio = float(np.mean(each))
            stderr = float(np.sqrt(np.sum(stderrs**2))) / len(pairs)
            # the limit applies to the lower end of the ratio's 95 % interval
            stage.limits["ratio", name, band] = ratio - 2.0 * stderr
            if band not in worst or ratio > worst[band].error:
                worst[band] = ErrorEstimate.symmetric(ratio, stderr, 1.0)


def _excluded_subjects(name: str, points: Sequence[Point]) -> list[tuple[str, str]]:
    """Return the subjects for which an estimator was not evaluated, with the reason."""
    evaluated = {
        p.knobs["subject"]
        for p in points
        if p.knobs["estimator"] == name and p.extra_values["judged"]
    }
    why = (
        f"a fraction is below {MIN_EVALUATED_SIGMAS:g} standard deviations of the bound even at "
        f"{100 * CHANNEL_NOISES[-1]:g} % noise"
    )
    return [(f"{name}, {subject}", why) for subject in TYPICAL_SKINS if subject not in evaluated]


def _chromophores(
    name: Literal["melanin", "hemoglobin"], shading: Literal["known", "free"], draws: int
) -> Iterator[tuple[str, EstimatorTrial]]:
    index = 0 if name == "melanin" else 1

    table = color_table.build(
        "Nikon 5100 (NPL)", "D55", anisotropy=ANISOTROPY_SKIN, exact_optics=True
    )

    def squared(noisy: Float64Array, sigma: Float64Array, true: float) -> Float64Array:
        found = chromophores.invert(
            noisy.astype(np.float32),
            table,
            shading="known" if shading == "known" else None,
            variance=np.broadcast_to(np.float32(sigma**2), noisy.shape),
        )
        value = getattr(found, name)
        return np.square(np.asarray(value, np.float64)[found.valid] - true)

    for number, (subject, skin) in enumerate(TYPICAL_SKINS.items()):
        truth = skin.melanin, skin.hemoglobin
        color = table.lookup(*truth).reshape(3)
        slopes = differentiate(lambda p: table.lookup(p[0], p[1]).reshape(3), np.array(truth))
        if shading == "free":
            slopes = np.column_stack([slopes, color])
        # Fisher information for noise proportional to the color: (J / c)^T (J / c) / noise^2; free
        # shading adds the column J = c of the derivative by log shading
        relative = slopes / color[:, None]
        least = np.diag(np.linalg.inv(relative.T @ relative))[:2]  # variances at noise 1
        for noise in CHANNEL_NOISES:
            sigmas = float(np.min(np.array(truth) / (noise * np.sqrt(least))))
            usual = noise == CHANNEL_NOISES[0]
            if sigmas < (MIN_MEASURED_SIGMAS if usual else MIN_EVALUATED_SIGMAS):
                continue
            sigma = noise * color
            rng = np.random.default_rng([1, number])
            noisy = color + sigma * rng.standard_normal((draws, 3))
            call = partial(squared, noisy, sigma, truth[index])
            yield subject, EstimatorTrial(call, float(noise**2 * least[index]), noise, sigmas)
            if sigmas >= MIN_EVALUATED_SIGMAS:
                break


def _normals(draws: int) -> Iterator[tuple[str, EstimatorTrial]]:
    rng = np.random.default_rng(2)
    lights = rng.normal(size=(40, 3))
    lights[:, 2] = np.abs(lights[:, 2]) + 0.4
    lights /= np.linalg.norm(lights, axis=-1, keepdims=True)
    normal = np.array([0.2, -0.1, 0.0])
    normal[2] = np.sqrt(1.0 - normal @ normal)
    lit = lights @ normal
    lights, lit = lights[lit > 0.15], lit[lit > 0.15]
    for subject, skin in TYPICAL_SKINS.items():
        albedo = skin.r_d
        # shot noise of 20,000 electrons at full scale, read noise of 5
        sigma = np.sqrt(albedo * lit / 20_000 + (5 / 20_000) ** 2)
        information = light_selection.fisher_information(
            normal[None], lights, (sigma / (albedo * lit))[None] ** 2
        )
        tilt = light_selection.predict_errors(
            information, range(len(lights)), min_lights=3
        ).tilt_rad[0]
        noisy = albedo * lit[:, None] + sigma[:, None] * rng.standard_normal((len(lights), draws))

        def squared() -> Float64Array:
            found = photometric_stereo.estimate_normals(
                noisy, lights, variance=np.broadcast_to((sigma**2)[:, None], noisy.shape)
            )
            return np.asarray(np.sum(np.cross(found.normals, normal) ** 2, axis=-1), np.float64)

        # the squared angle is the sum of two tangential components of variance tilt^2 each
        noise = float(np.mean(sigma / (albedo * lit)))
        yield subject, EstimatorTrial(squared, 2.0 * float(tilt) ** 2, noise)


def _albedo(draws: int) -> Iterator[tuple[str, EstimatorTrial]]:
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(2, 60, 3))
    directions[..., 2] = np.abs(directions[..., 2]) + 0.4
    light, view = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    transmittance = np.prod(
        [1.0 - fresnel.reflectance(to[:, 2], 1.4) for to in (light, view)], axis=0
    )
    up = np.array([0.0, 0.0, 1.0])
    for subject, skin in TYPICAL_SKINS.items():
        albedo = skin.r_d
        value = albedo * transmittance / np.pi
        sigma = ALBEDO_NOISE * value
        bound = 1.0 / np.sum((transmittance / np.pi / sigma) ** 2)
        count = draws // 4
        noisy = value[:, None] + sigma[:, None] * rng.standard_normal((count, 60, 1))

        def squared() -> Float64Array:
            every = (len(noisy), 60, 3)
            found = diffuse_albedo.estimate(
                noisy,
                np.broadcast_to(light, every),
                np.broadcast_to(view, every),
                np.broadcast_to(up, (len(noisy), 3)),
                eta=1.4,
                normal_stderr_rad=0.0,
                variance=np.broadcast_to((sigma**2)[:, None], noisy.shape),
            )
            return np.square(found.r_d[found.valid, 0] - albedo)

        yield subject, EstimatorTrial(squared, float(bound), ALBEDO_NOISE)


def _subsurface(draws: int) -> Iterator[tuple[str, EstimatorTrial]]:
    radius = np.linspace(1.0, 15.0, 28)
    count = draws // 20
    for number, (subject, skin) in enumerate(TYPICAL_SKINS.items()):
        truth = np.array([skin.sigma_a_per_mm, skin.sigma_s_per_mm])
        profile = photon_table.reflectance(radius, *truth)
        sigma = FIBER_NOISE * profile + 1e-3 * profile.max() * FIBER_NOISE
        slopes = differentiate(lambda p: photon_table.reflectance(radius, p[0], p[1]), truth)
        covariance = np.linalg.inv((slopes / sigma[:, None]).T @ (slopes / sigma[:, None]))
        # the bound of sigma_tr propagates the coefficients' covariance by its gradient
        gradient = differentiate(lambda p: np.atleast_1d(_sigma_tr(p)), truth)[0]
        rng = np.random.default_rng([4, number])
        noisy = profile + sigma * rng.standard_normal((count, 28))

        def squared() -> Float64Array:
            fit = subsurface.invert(
                radius,
                noisy,
                variance=np.broadcast_to(sigma**2, noisy.shape),
                g=0.8,
                g_error=0.0,
                model_error=0.0,
            )
            return np.square(fit.sigma_tr_per_mm[fit.valid] - _sigma_tr(truth))

        yield subject, EstimatorTrial(squared, float(gradient @ covariance @ gradient), FIBER_NOISE)


def _sigma_tr(coefficients: Float64Array) -> float:
    sigma_a, sigma_s = coefficients
    return float(np.sqrt(3.0 * sigma_a * (sigma_a + sigma_s)))


def differentiate(
    value: Callable[[Float64Array], Float64Array], point: Float64Array
) -> Float64Array:
    """Return the Jacobian of a vector function by central differences, (values, parameters)."""
    columns = []
    for k in range(len(point)):
        step = np.zeros(len(point))
        step[k] = 1e-3 * point[k]
        columns.append((value(point + step) - value(point - step)) / (2.0 * step[k]))
    return np.column_stack(columns)


_ESTIMATOR_TRIALS: Final[dict[str, Callable[[int], Iterator[tuple[str, EstimatorTrial]]]]] = {
    "melanin, shading known": partial(_chromophores, "melanin", "known"),
    "melanin, shading free": partial(_chromophores, "melanin", "free"),
    "hemoglobin, shading known": partial(_chromophores, "hemoglobin", "known"),
    "hemoglobin, shading free": partial(_chromophores, "hemoglobin", "free"),
    "normals": _normals,
    "diffuse albedo": _albedo,
    "sigma_tr": _subsurface,
}
