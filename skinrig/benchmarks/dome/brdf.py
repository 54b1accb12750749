"""Benchmarks of the dome's reflectance: diffuse albedo, and surface BRDFs on a tabulated basis."""

from __future__ import annotations

import dataclasses
import time
from functools import partial
from typing import Literal

import numpy as np
from scipy.optimize import nnls

from model.brdf import microfacet
from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from reconstruction import brdf_basis
from reconstruction.diffuse_albedo import estimation as diffuse_albedo
from skinrig.arrays import BoolArray, Float64Array
from skinrig.benchmarks.dome import brdf_truth
from skinrig.benchmarks.measurement import (
    BandError,
    Limit,
    Point,
    StageBenchmark,
    Timing,
    measure,
    once,
)

MAX_ALBEDO_ERROR_PERCENT = 3.0
MAX_HELD_OUT_ERROR_PERCENT = 5.0
MIN_SPEEDUP_OVER_NNLS = 10.0
FIT_CORES = 2
"""Cores that the fit shares its points out to."""
MAX_RESIDUAL_EXCESS_PERCENT = 0.2
ETA = 1.3
BAND_ALBEDOS: dict[str, tuple[float, float, float]] = {
    "light": brdf_truth.LIGHT_SKIN_ALBEDO,
    "medium": (0.315, 0.189, 0.133),
    "dark": brdf_truth.DARK_SKIN_ALBEDO,
}
"""Mean R_d of each band of `skinrig.evaluating.skin_bands`; the middle one is the geometric mean
of the others."""


def albedo(*, toy: bool) -> StageBenchmark:
    """Estimate R_d over noise and samples, by the fit and by the paper's minima."""
    rng = np.random.default_rng(0)
    count = 12 if toy else 150
    points, limits = [], []
    bands: dict[str, BandError] = {}
    for skin, r_d in BAND_ALBEDOS.items():
        for noise in (0.02,) if toy else (0.005, 0.02, 0.08):
            for samples in (60,) if toy else (60, 240, 900):
                p = brdf_truth.dome(count, r_d=r_d, noise=noise, samples=samples, rng=rng)
                for method in ("envelope", "stable_minimum", "minimum"):

                    def run(
                        p: brdf_truth.Points = p, method: diffuse_albedo.Method = method
                    ) -> diffuse_albedo.DiffuseAlbedo:
                        return diffuse_albedo.estimate(
                            p.f,
                            p.light,
                            p.view,
                            p.normals,
                            eta=ETA,
                            variance=p.variance,
                            valid=p.valid,
                            method=method,
                        )

                    timing = measure(run, repeats=1, memory=False)
                    relative = 100.0 * (run().r_d / p.r_d - 1.0)
                    worst = np.median(np.abs(relative), axis=0)
                    channel = int(np.argmax(worst))
                    bias = float(np.median(relative[:, channel]))
                    spread = float(np.std(relative[:, channel]))
                    knobs = {
                        "skin": skin,
                        "noise": noise,
                        "samples": p.f.shape[1],
                        "method": method,
                    }
                    also = {"bias_percent": round(bias, 2), "spread_percent": round(spread, 2)}
                    # 68 % interval of a median of `count` errors of this spread
                    half = 1.2533 * float(np.std(np.abs(relative[:, channel]))) / np.sqrt(count)
                    error = float(worst[channel])
                    interval = (max(error - half, 0.0), error + half)
                    points.append(Point(knobs, timing, error, interval, also=also))
                    if method == "envelope" and noise == 0.02 and (toy or samples == 900):
                        bands[skin] = BandError(error, interval)
                        limits.append(
                            Limit(
                                f"median error of R_d, worst channel, {skin} skin",
                                error,
                                MAX_ALBEDO_ERROR_PERCENT,
                                "<=",
                                "%",
                            )
                        )
    return StageBenchmark(
        "diffuse-albedo",
        "median error of R_d, worst channel, %",
        "the R_d that the samples were made of, under a surface in no estimator's family",
        0.0,
        tuple(points),
        tuple(limits),
        by_band=bands,
        condition=("skin", "noise"),
        interval_of="points",
    )


def surface(*, toy: bool) -> StageBenchmark:
    """Fit surface BRDFs, and predict lights that were left out; beside GGX and SciPy."""
    rng = np.random.default_rng(0)
    basis = brdf_tables.default()
    count = 12 if toy else 120
    points = []
    error = np.nan
    for samples in (100,) if toy else (100, 300, 900):
        p, out, given, diffuse = _given(BAND_ALBEDOS["light"], count, samples, rng)

        def point(
            name: str,
            timing: Timing,
            lobe: Float64Array,
            *,
            rank: int = 0,
            p: brdf_truth.Points = p,
            out: BoolArray = out,
            diffuse: Float64Array = diffuse,
        ) -> Point:
            return _judged(name, timing, lobe, p, out, diffuse, rank, rng)

        ways: tuple[Literal["cbrt", "none"], ...] = ("cbrt", "none")
        for compress in ways:

            def run(
                compress: Literal["cbrt", "none"] = compress,
                given: brdf_basis.SurfaceSamples = given,
                on: BrdfBasis = basis,
            ) -> brdf_basis.BasisWeights:
                return brdf_basis.fit_weights(given, on, compress=compress)

            timing = measure(run, repeats=2, memory=False)
            fit = run()
            points.append(point(f"basis, {compress}", timing, _lobes(fit.weights, basis, p)))
            if compress == "cbrt":
                error = points[-1].error
                full = fit
        for rank in (2, 4) if toy else (1, 2, 3, 4, 6, 8):
            if samples < 900 and not toy:
                continue
            mixed = basis.mixed(brdf_basis.reduce(full, rank, basis=basis)[1])
            timing = measure(lambda on=mixed: run(on=on), repeats=1, memory=False)  # type: ignore[misc]
            lobe = _lobes(run("cbrt", on=mixed).weights, mixed, p)
            points.append(point("NMF, refitted", timing, lobe, rank=rank))
        points.append(point("GGX", *once(partial(_ggx, p, given))))
        points.append(point("roots of elements", *once(partial(_rooted, p, given, basis))))
    bands = {}
    for skin, r_d in BAND_ALBEDOS.items():
        p, out, given, diffuse = _given(r_d, count, 100 if toy else 300, rng)
        timing, fit = once(partial(brdf_basis.fit_weights, given, basis, compress="cbrt"))
        told = _judged("", timing, _lobes(fit.weights, basis, p), p, out, diffuse, 0, rng)
        bands[skin] = BandError(told.error, told.error_interval)
    faster, excess = _beside_scipy(basis, toy=toy)
    limits = (
        Limit(
            "median error of all light under lights left out",
            error,
            MAX_HELD_OUT_ERROR_PERCENT,
            "<=",
            "%",
        ),
        Limit(
            "times faster on 2 cores than a loop of SciPy's nnls, 5,000 x 900 x 59, matrices "
            "included",
            faster,
            MIN_SPEEDUP_OVER_NNLS,
            ">=",
        ),
        Limit(
            "largest residual above SciPy's", 100.0 * excess, MAX_RESIDUAL_EXCESS_PERCENT, "<=", "%"
        ),
    )
    return StageBenchmark(
        "brdf",
        "median error of all light under lights left out, %",
        "a surface whose slopes fall between an exponential and a Gaussian, in no basis",
        0.0,
        tuple(points),
        limits,
        left_out=(("SciPy on all 5,000 points", "its time is that of a subset, extrapolated"),),
        by_band=bands,
        interval_of="points",
    )


def _given(
    r_d: tuple[float, float, float], count: int, samples: int, rng: np.random.Generator
) -> tuple[brdf_truth.Points, BoolArray, brdf_basis.SurfaceSamples, Float64Array]:
    """Return points, their samples left out, what is fitted, and the diffuse part taken off."""
    p = brdf_truth.dome(count, r_d=r_d, noise=0.02, samples=samples, rng=rng)
    out = _left_out(p, rng)
    # R_d as it would be known: estimated, from the same samples
    found = diffuse_albedo.estimate(
        p.f, p.light, p.view, p.normals, eta=ETA, variance=p.variance, valid=p.valid & ~out
    )
    given = brdf_basis.surface_samples(
        p.f,
        p.light,
        p.view,
        p.normals,
        found.r_d,
        eta=ETA,
        variance=p.variance,
        valid=p.valid & ~out,
    )
    return p, out, given, _diffuse(p, found.r_d)


def _left_out(p: brdf_truth.Points, rng: np.random.Generator) -> BoolArray:
    """Return the samples of a fifth of the lights."""
    lights, which = np.unique(p.light.round(6).reshape(-1, 3), axis=0, return_inverse=True)
    return np.asarray((rng.random(len(lights)) < 0.2)[which].reshape(p.valid.shape))


def _diffuse(p: brdf_truth.Points, r_d: Float64Array) -> Float64Array:
    """Return the green diffuse BRDF by the convention, (P, M)."""
    zero = np.zeros_like(p.f)
    s = brdf_basis.surface_samples(zero, p.light, p.view, p.normals, r_d, eta=ETA, valid=p.valid)
    cos_l = np.einsum("pmc,pc->pm", p.light, p.normals)
    mean = -s.value / np.where(cos_l > 0.0, cos_l, 1.0)
    return np.asarray(mean * (r_d[:, 1] / r_d.mean(axis=1))[:, None])


def _lobes(weights: Float64Array, basis: BrdfBasis, p: brdf_truth.Points) -> Float64Array:
    return np.stack(
        [
            brdf_basis.evaluate(x, basis, to, at, n)
            for x, to, at, n in zip(weights, p.light, p.view, p.normals, strict=True)
        ]
    )


def _judged(
    name: str,
    timing: Timing,
    lobe: Float64Array,
    p: brdf_truth.Points,
    out: BoolArray,
    diffuse: Float64Array,
    rank: int,
    rng: np.random.Generator,
) -> Point:
    at = p.valid & out
    true_diffuse = _diffuse(p, p.r_d)
    relative = 100.0 * np.abs((lobe + diffuse) / (p.surface + true_diffuse + 1e-12) - 1.0)
    # The points are independent of each other, their samples are not.
    by_point = np.array([np.median(r[a]) for r, a in zip(relative, at, strict=True) if a.any()])
    again = rng.choice(by_point, (200, len(by_point)))
    low, high = np.quantile(np.median(again, axis=1), [0.16, 0.84])
    root = np.sqrt(np.mean((np.cbrt(lobe) - np.cbrt(p.surface))[at] ** 2))
    bright = at & (p.surface > 0.5 * true_diffuse)
    knobs: dict[str, str | int | float | bool] = {
        "way": name,
        "samples": p.f.shape[1],
        "points": len(p.f),
    }
    also = {
        "highlight_error_percent": round(
            float(np.median(np.abs(lobe[bright] / p.surface[bright] - 1.0))) * 100.0, 2
        ),
        "cube_root_rms": round(float(root), 4),
    }
    if rank:
        knobs["rank"] = rank
    error = float(np.median(by_point))
    return Point(knobs, timing, error, (float(low), float(high)), also=also)


def _cosines(p: brdf_truth.Points, point: int) -> tuple[Float64Array, ...]:
    to, at, n = p.light[point], p.view[point], p.normals[point]
    mu_l, mu_v = to @ n, at @ n
    cos_d = np.sqrt(np.clip(0.5 * (1.0 + np.sum(to * at, axis=-1)), 0.0, 1.0))
    return mu_l, mu_v, np.clip((mu_l + mu_v) / np.maximum(2.0 * cos_d, 1e-9), 0.0, 1.0), cos_d


def _ggx(p: brdf_truth.Points, s: brdf_basis.SurfaceSamples) -> Float64Array:
    """Fit strength and roughness of one GGX lobe a point: the best of 60 roughnesses."""
    lobes = np.zeros(p.surface.shape)
    for point in range(len(lobes)):
        cosines = _cosines(p, point)
        ok = s.valid[point]
        weight = 1.0 / s.variance[point][ok]
        best = np.inf
        for roughness in np.geomspace(0.05, 0.9, 60):
            f = microfacet.brdf(*cosines, roughness=float(roughness), eta=1.4)
            m = (f * cosines[0])[ok]
            y = s.value[point][ok]
            strength = max(float(np.sum(weight * m * y) / np.sum(weight * m * m)), 0.0)
            misfit = float(np.sum(weight * (strength * m - y) ** 2))
            if misfit < best:
                best, lobes[point] = misfit, strength * f
    return lobes


def _rooted(p: brdf_truth.Points, s: brdf_basis.SurfaceSamples, basis: BrdfBasis) -> Float64Array:
    """Fit cube roots of the matrix' elements to cube roots of the samples, the paper's words."""
    lobes = np.zeros(p.surface.shape)
    for point in range(len(lobes)):
        material = np.cbrt(basis.evaluate(p.light[point], p.view[point], p.normals[point]))
        cos_l = np.maximum(p.light[point] @ p.normals[point], 0.0)
        ok = s.valid[point]
        if ok.any():
            matrix = material[ok] * np.cbrt(cos_l[ok])[:, None]
            x, _ = nnls(matrix, np.cbrt(s.value[point][ok].astype(np.float64)))
            lobes[point] = (material @ x) ** 3
    return lobes


def _beside_scipy(basis: BrdfBasis, *, toy: bool) -> tuple[float, float]:
    """Return how many times faster than SciPy, and the largest relative excess of the residual."""
    rng = np.random.default_rng(1)
    different, copies, subset = (20, 1, 3) if toy else (500, 10, 200)
    p = brdf_truth.dome(different, r_d=BAND_ALBEDOS["light"], noise=0.02, samples=900, rng=rng)
    p = dataclasses.replace(p, valid=p.valid & (p.light @ p.normals[..., None] > 0.12)[..., 0])
    s = brdf_basis.surface_samples(
        p.f, p.light, p.view, p.normals, p.r_d, eta=ETA, variance=p.variance, valid=p.valid
    )
    many = brdf_basis.SurfaceSamples(
        *(
            np.tile(getattr(s, f.name), (copies, *[1] * (getattr(s, f.name).ndim - 1)))
            for f in dataclasses.fields(s)
        )
    )
    brdf_basis.fit_weights(s, basis, compress="none")
    problems = []
    for point in range(subset):
        ok = s.valid[point]
        root = 1.0 / np.sqrt(s.variance[point][ok].astype(np.float64))
        cos_l = s.light_dir[point].astype(np.float64) @ s.normals[point]
        material = basis.evaluate(s.light_dir[point], s.view_dir[point], s.normals[point])
        matrix = (material * cos_l[:, None])[ok] * root[:, None]
        problems.append((matrix, s.value[point][ok] * root))
    # Processor time, which does not see who else keeps the cores busy; SciPy uses one.
    ours, theirs = [], []
    for _ in range(1 if toy else 5):
        start = time.process_time()
        found = brdf_basis.fit_weights(many, basis, compress="none")
        ours.append((time.process_time() - start) / FIT_CORES)
        start = time.process_time()
        least = [nnls(a, y)[1] for a, y in problems]
        theirs.append((time.process_time() - start) / subset * len(many.value))
    excess = [
        float(np.linalg.norm(a @ x - y) / norm - 1.0)
        for (a, y), x, norm in zip(problems, found.weights[:subset], least, strict=True)
    ]
    return float(np.median(theirs) / np.median(ours)), max(excess)
