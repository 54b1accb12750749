"""How near estimators come to the Cramér-Rao bound, over subjects from light to dark.

Each estimator is given data that its own model made, with noise of known variance: then nothing
but its use of the data is measured, as the mean squared error over the least that any unbiased
estimator can have. Bounds are taken from each forward equation by differences, not from the
estimator's own standard errors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from model import color_table, fresnel, photon_table
from model.tissue_optics import ANISOTROPY_SKIN
from reconstruction import (
    chromophores,
    diffuse_albedo,
    light_selection,
    photometric_stereo,
    subsurface,
)
from skinrig.benchmark import Limit, Point, StageBenchmark, measure

Floats = NDArray[np.float64]
Trial = tuple[Callable[[], Floats], float]
"""Makes the squared errors of the draws, and the bound on their mean."""

SUBJECTS: Final = {
    "palest": (0.005, 0.03), "II": (0.014, 0.05), "III": (0.028, 0.05), "IV": (0.047, 0.05),
    "V": (0.085, 0.05), "VI": (0.17, 0.05),
}  # fmt: skip
"""Melanin and hemoglobin of typical skin."""
MOST = 1.2
"""Mean squared error over the bound that is aimed at."""
CLEAR = 2.5
"""Standard errors between a fraction and 0: nearer, an estimate that cannot be negative is not
linear in the noise, and a bound on unbiased ones says nothing of it."""
NOISE = 0.004
"""Relative noise of each channel."""
READINGS = 0.01
"""Relative noise of each fibre."""


def efficiency(*, toy: bool) -> StageBenchmark:
    """Measure mean squared errors over Cramér-Rao bounds."""
    draws = 500 if toy else 20_000
    points: list[Point] = []
    limits: list[Limit] = []
    left_out: list[tuple[str, str]] = []
    bands: dict[str, float] = {}
    for name, made in _ESTIMATORS.items():
        worst = 0.0
        for subject, trial in made(draws):
            squared_errors, bound = trial
            timing = measure(squared_errors, repeats=1)
            squared = squared_errors()
            ratio = float(squared.mean()) / bound
            spread = float(squared.std() / np.sqrt(len(squared))) / bound
            points.append(
                Point(
                    {"estimator": name, "subject": subject}, timing, ratio,
                    (ratio - spread, ratio + spread), 1.0,
                )
            )  # fmt: skip
            bands[subject] = max(bands.get(subject, 0.0), ratio)
            # what 20,000 draws leave open of the ratio counts for the estimator
            worst = max(worst, ratio - 2.0 * spread)
        limits.append(Limit(f"{name}: mean squared error over the bound", worst, MOST, "<="))
        measured = {point.knobs["subject"] for point in points if point.knobs["estimator"] == name}
        left_out += [
            (f"{name}, {subject}", "a fraction is nearer to 0 than 2.5 bounds")
            for subject in SUBJECTS
            if subject not in measured
        ]
    return StageBenchmark(
        "efficiency",
        "mean squared error over Cramér-Rao bound",
        "data of the estimator's own model with noise of known variance",
        0.0,
        tuple(points),
        tuple(limits),
        tuple(left_out),
        by_band=bands,
        squared=True,
        condition=("estimator", "subject"),
        interval_of="draws of noise",
    )


def _chromophores(shading: str) -> Callable[[int], Iterator[tuple[str, Trial]]]:
    def made(draws: int) -> Iterator[tuple[str, Trial]]:
        table = color_table.build("Nikon 5100 (NPL)", "D55", anisotropy=ANISOTROPY_SKIN)
        for number, (subject, truth) in enumerate(SUBJECTS.items()):
            color = table.lookup(*truth)
            sigma = NOISE * color
            slopes = _differences(lambda p: table.lookup(p[0], p[1]), np.array(truth))
            if shading == "free":
                slopes = np.column_stack([slopes, color])
            bounds = np.diag(
                np.linalg.inv((slopes / sigma[:, None]).T @ (slopes / sigma[:, None]))
            )[:2]
            rng = np.random.default_rng([1, number])
            noisy = color + sigma * rng.standard_normal((draws, 3))
            given = "known" if shading == "known" else None

            def squared(
                noisy: Floats = noisy, sigma: Floats = sigma, given: str | None = given,
                truth: tuple[float, float] = truth,
            ) -> Floats:  # fmt: skip
                found = chromophores.invert(
                    noisy.astype(np.float32), table, shading=given,
                    variance=np.broadcast_to(np.float32(sigma**2), noisy.shape),
                )  # fmt: skip
                return np.square(np.asarray(found.melanin, np.float64)[found.valid] - truth[0])

            if np.all(CLEAR * np.sqrt(bounds) < truth):
                yield subject, (squared, float(bounds[0]))

    return made


def _normals(draws: int) -> Iterator[tuple[str, Trial]]:
    rng = np.random.default_rng(2)
    lights = rng.normal(size=(40, 3))
    lights[:, 2] = np.abs(lights[:, 2]) + 0.4
    lights /= np.linalg.norm(lights, axis=-1, keepdims=True)
    normal = np.array([0.2, -0.1, 0.0])
    normal[2] = np.sqrt(1.0 - normal @ normal)
    lit = lights @ normal
    lights, lit = lights[lit > 0.15], lit[lit > 0.15]
    for subject, albedo in zip(SUBJECTS, (0.6, 0.5, 0.4, 0.3, 0.2, 0.1), strict=True):
        # shot noise of 20,000 electrons at full scale, read noise of 5
        sigma = np.sqrt(albedo * lit / 20_000 + (5 / 20_000) ** 2)
        told = light_selection.information(
            normal[None], lights, (sigma / (albedo * lit))[None] ** 2
        )
        tilt = light_selection.predict(told, range(len(lights)), least=3).tilt_rad[0]
        noisy = albedo * lit[:, None] + sigma[:, None] * rng.standard_normal((len(lights), draws))

        def squared(noisy: Floats = noisy, sigma: Floats = sigma) -> Floats:
            found = photometric_stereo.estimate_normals(
                noisy, lights, variance=np.broadcast_to((sigma**2)[:, None], noisy.shape)
            )
            return np.asarray(np.sum(np.cross(found.normals, normal) ** 2, axis=-1), np.float64)

        yield subject, (squared, 2.0 * float(tilt) ** 2)


def _albedo(draws: int) -> Iterator[tuple[str, Trial]]:
    rng = np.random.default_rng(3)
    ways = rng.normal(size=(2, 60, 3))
    ways[..., 2] = np.abs(ways[..., 2]) + 0.4
    light, view = ways / np.linalg.norm(ways, axis=-1, keepdims=True)
    through = np.prod([1.0 - fresnel.reflectance(way[:, 2], 1.4) for way in (light, view)], axis=0)
    up = np.array([0.0, 0.0, 1.0])
    for subject, albedo in zip(SUBJECTS, (0.6, 0.5, 0.4, 0.3, 0.2, 0.1), strict=True):
        value = albedo * through / np.pi
        sigma = 0.02 * value
        bound = 1.0 / np.sum((through / np.pi / sigma) ** 2)
        count = draws // 10
        noisy = value[:, None] + sigma[:, None] * rng.standard_normal((count, 60, 1))

        def squared(noisy: Floats = noisy, sigma: Floats = sigma, albedo: float = albedo) -> Floats:
            every = (len(noisy), 60, 3)
            found = diffuse_albedo.estimate(
                noisy, np.broadcast_to(light, every), np.broadcast_to(view, every),
                np.broadcast_to(up, (len(noisy), 3)), eta=1.4, normal_stderr_rad=0.0,
                variance=np.broadcast_to((sigma**2)[:, None], noisy.shape),
            )  # fmt: skip
            return np.square(found.r_d[found.valid, 0] - albedo)

        yield subject, (squared, float(bound))


def _subsurface(draws: int) -> Iterator[tuple[str, Trial]]:
    radius = np.linspace(1.0, 15.0, 28)
    count = draws // 40
    for number, (subject, (sigma_a, sigma_s)) in enumerate(
        zip(SUBJECTS, ((0.02, 1.4), (0.03, 1.3), (0.05, 1.2), (0.08, 1.2), (0.15, 1.1), (0.3, 1.0)),
            strict=True)
    ):  # fmt: skip
        truth = np.array([sigma_a, sigma_s])
        profile = photon_table.reflectance(radius, *truth)
        sigma = READINGS * profile + 1e-3 * profile.max() * READINGS
        slopes = _differences(lambda p: photon_table.reflectance(radius, p[0], p[1]), truth)
        covariance = np.linalg.inv((slopes / sigma[:, None]).T @ (slopes / sigma[:, None]))
        along = _differences(lambda p: np.atleast_1d(_sigma_tr(p)), truth)[0]
        rng = np.random.default_rng([4, number])
        noisy = profile + sigma * rng.standard_normal((count, 28))

        def squared(noisy: Floats = noisy, sigma: Floats = sigma, truth: Floats = truth) -> Floats:
            fit = subsurface.invert(
                radius, noisy, variance=np.broadcast_to(sigma**2, noisy.shape), g=0.8,
                g_error=0.0, model_error=0.0,
            )  # fmt: skip
            return np.square(fit.sigma_tr_per_mm[fit.valid] - _sigma_tr(truth))

        yield subject, (squared, float(along @ covariance @ along))


def _sigma_tr(coefficients: Floats) -> float:
    sigma_a, sigma_s = coefficients
    return float(np.sqrt(3.0 * sigma_a * (sigma_a + sigma_s)))


def _differences(value: Callable[[Floats], Floats], at: Floats) -> Floats:
    """Return derivatives of a vector by each parameter, by central differences."""
    columns = []
    for k in range(len(at)):
        step = np.zeros(len(at))
        step[k] = 1e-3 * at[k]
        columns.append((value(at + step) - value(at - step)) / (2.0 * step[k]))
    return np.column_stack(columns)


_ESTIMATORS: Final[dict[str, Callable[[int], Iterator[tuple[str, Trial]]]]] = {
    "melanin, shading known": _chromophores("known"),
    "melanin, shading free": _chromophores("free"),
    "normals": _normals,
    "diffuse albedo": _albedo,
    "sigma_tr": _subsurface,
}
