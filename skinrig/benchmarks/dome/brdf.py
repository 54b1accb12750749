"""Benchmarks of the dome's reflectance: diffuse albedo, basis BRDFs, and their common space."""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, Literal

import numpy as np
from scipy.optimize import nnls

from model.brdf import microfacet
from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from reconstruction import brdf_basis
from reconstruction.brdf_basis import space as brdf_space
from reconstruction.diffuse_albedo import estimation as diffuse_albedo
from rigsim.population.population import draw_population
from skinrig.analysing import brdf_space_datasets
from skinrig.analysing.brdf_space_datasets import Dataset
from skinrig.arrays import BoolArray, Float64Array
from skinrig.benchmarks.dome import brdf_truth
from skinrig.benchmarks.measurement import LIMIT_CORES, measure_once, measure_processor_time
from skinrig.benchmarks.resampling import bootstrap_interval
from skinrig.benchmarks.results import ErrorEstimate, Knobs, Timing
from skinrig.benchmarks.stage import BenchmarkStage

ETA = 1.3
DIFFUSE_METHODS: tuple[diffuse_albedo.Method, ...] = ("envelope", "stable_minimum", "minimum")
COMPRESSION_METHODS: tuple[Literal["cbrt", "none"], ...] = ("cbrt", "none")
BAND_ALBEDOS: dict[str, tuple[float, float, float]] = {
    "light": brdf_truth.LIGHT_SKIN_ALBEDO,
    "medium": (0.315, 0.189, 0.133),
    "dark": brdf_truth.DARK_SKIN_ALBEDO,
}
"""Mean R_d of each band of `skinrig.evaluating.skin_bands`; the middle one is the geometric mean
of the others."""


def measure_diffuse_albedo(stage: BenchmarkStage) -> None:
    """Measure errors of R_d over noise and samples, by the fit and by the paper's minima."""
    rng = np.random.default_rng(0)
    count = 12 if stage.toy else 150
    for skin, r_d in BAND_ALBEDOS.items():
        for noise in (0.02,) if stage.toy else (0.005, 0.02, 0.08):
            for samples in (60,) if stage.toy else (60, 240, 900):
                p = brdf_truth.sample_dome(count, r_d=r_d, noise=noise, samples=samples, rng=rng)
                for method in DIFFUSE_METHODS:
                    estimate = partial(diffuse_albedo.estimate, *p.samples, eta=ETA, method=method)
                    timing, found = stage.time(
                        lambda: estimate(variance=p.variance, valid=p.valid),
                        repeats=1,
                        memory=False,
                    )
                    relative = 100.0 * (found.r_d / p.r_d - 1.0)
                    worst = np.median(np.abs(relative), axis=0)
                    channel = relative[:, int(np.argmax(worst))]
                    # standard error of a Gaussian median: sqrt(pi / 2) = 1.2533 that of the mean
                    half = 1.2533 * float(np.std(np.abs(channel))) / np.sqrt(count)
                    outcome = ErrorEstimate.nonnegative(float(worst.max()), half)
                    knobs = {"skin": skin, "noise": noise, "samples": p.f.shape[1]}
                    also = {
                        "bias_percent": round(float(np.median(channel)), 2),
                        "spread_percent": round(float(np.std(channel)), 2),
                    }
                    stage.add(knobs | {"method": method}, timing, outcome, also)
                    if method == "envelope" and noise == 0.02 and (stage.toy or samples == 900):
                        stage.by_band[skin] = outcome
                        stage.limits["error", skin] = outcome.error


def measure_basis_fit(stage: BenchmarkStage) -> None:
    """Fit basis BRDFs and predict held-out lights; compare with GGX and SciPy."""
    rng = np.random.default_rng(0)
    basis = brdf_tables.default_basis()
    count = 12 if stage.toy else 120
    for samples in (100,) if stage.toy else (100, 300, 900):
        given = _KnownPoints.draw(BAND_ALBEDOS["light"], count, samples, rng)
        for compress in COMPRESSION_METHODS:
            timing, fit = stage.time(
                lambda: brdf_basis.fit_weights(given.samples, basis, compress=compress),
                repeats=2,
                memory=False,
            )
            outcome = given.add(stage, f"basis, {compress}", timing, given.lobes(fit, basis))
            if compress == "cbrt":
                stage.limits["error"] = outcome.error
                full = fit
        for rank in (2, 4) if stage.toy else (1, 2, 3, 4, 6, 8):
            if samples < 900 and not stage.toy:
                continue
            mixed = basis.mix_materials(brdf_basis.reduce(full, rank, basis=basis)[1])
            quick = partial(brdf_basis.fit_weights, given.samples, mixed, compress="none")
            timing, _ = stage.time(quick, repeats=1, memory=False)
            fit = brdf_basis.fit_weights(given.samples, mixed, compress="cbrt")
            given.add(stage, "NMF, refitted", timing, given.lobes(fit, mixed), rank=rank)
        for way, peer in (
            ("GGX", _ggx),
            ("roots of elements", partial(_fit_cube_roots, basis=basis)),
        ):
            timing, lobe = measure_once(lambda: peer(given.truth, given.samples))
            given.add(stage, way, timing, lobe)
    for skin, r_d in BAND_ALBEDOS.items():
        given = _KnownPoints.draw(r_d, count, 100 if stage.toy else 300, rng)
        fit = brdf_basis.fit_weights(given.samples, basis, compress="cbrt")
        stage.by_band[skin] = given.error(given.lobes(fit, basis))
    faster, excess = _compare_with_scipy(basis, toy=stage.toy)
    stage.limits |= {"speed_up": faster, "residual": 100.0 * excess}


@dataclass(frozen=True, slots=True)
class _KnownPoints:
    """Points with their samples under four fifths of the lights; the others are held out."""

    truth: brdf_truth.TruePoints
    held_out: BoolArray
    samples: brdf_basis.SurfaceSamples
    diffuse: Float64Array
    """Diffuse BRDF that is subtracted, (P, M)."""
    rng: np.random.Generator

    @classmethod
    def draw(
        cls, r_d: tuple[float, float, float], count: int, samples: int, rng: np.random.Generator
    ) -> _KnownPoints:
        """Draw points and their samples; estimate R_d from samples that are not held out."""
        p = brdf_truth.sample_dome(count, r_d=r_d, noise=0.02, samples=samples, rng=rng)
        out = _held_out_samples(p, rng)
        options: dict[str, Any] = {"eta": ETA, "variance": p.variance, "valid": p.valid & ~out}
        # R_d is estimated from the same samples, as in a capture
        found = diffuse_albedo.estimate(*p.samples, **options)
        given = brdf_basis.surface_samples(*p.samples, found.r_d, **options)
        return cls(p, out, given, _diffuse(p, found.r_d), rng)

    def lobes(self, fit: brdf_basis.BasisWeights, basis: BrdfBasis) -> Float64Array:
        """Return the fitted surface BRDF at every sample, (P, M)."""
        _, *where = self.truth.samples
        rows = zip(fit.weights, *where, strict=True)
        return np.stack([brdf_basis.evaluate(x, basis, *at) for x, *at in rows])

    def error(self, lobe: Float64Array) -> ErrorEstimate:
        """Return the median error of the total reflection under held-out lights, %."""
        at = self.truth.valid & self.held_out
        true = self.truth.surface + _diffuse(self.truth, self.truth.r_d) + 1e-12
        relative = 100.0 * np.abs((lobe + self.diffuse) / true - 1.0)
        # points are independent, samples of one point are not: the bootstrap draws points
        by_point = np.array([np.median(r[a]) for r, a in zip(relative, at, strict=True) if a.any()])
        return ErrorEstimate(float(np.median(by_point)), bootstrap_interval(by_point, rng=self.rng))

    def add(
        self, stage: BenchmarkStage, method: str, timing: Timing, lobe: Float64Array, **rank: int
    ) -> ErrorEstimate:
        """Add a point for a method's surface BRDF `lobe`, (P, M), and return its error."""
        p = self.truth
        at = p.valid & self.held_out
        root = np.sqrt(np.mean((np.cbrt(lobe) - np.cbrt(p.surface))[at] ** 2))
        bright = at & (p.surface > 0.5 * _diffuse(p, p.r_d))
        highlight = np.median(np.abs(lobe[bright] / p.surface[bright] - 1.0))
        knobs = {"way": method, "samples": p.f.shape[1], "points": len(p.f), **rank}
        also = {
            "highlight_error_percent": round(float(highlight) * 100.0, 2),
            "cube_root_rms": round(float(root), 4),
        }
        return stage.add(knobs, timing, self.error(lobe), also)


def _held_out_samples(p: brdf_truth.TruePoints, rng: np.random.Generator) -> BoolArray:
    """Return the mask of the samples of a random fifth of the lights."""
    lights, which = np.unique(p.light.round(6).reshape(-1, 3), axis=0, return_inverse=True)
    return np.asarray((rng.random(len(lights)) < 0.2)[which].reshape(p.valid.shape))


def _diffuse(p: brdf_truth.TruePoints, r_d: Float64Array) -> Float64Array:
    """Return the green diffuse BRDF as `surface_samples` subtracts it, (P, M)."""
    # samples of 0 give -(diffuse BRDF) times the light's cosine, the mean over channels
    zero = np.zeros_like(p.f)
    s = brdf_basis.surface_samples(zero, *p.samples[1:], r_d, eta=ETA, valid=p.valid)
    cos_l = np.einsum("pmc,pc->pm", p.light, p.normals)
    mean = -s.value / np.where(cos_l > 0.0, cos_l, 1.0)
    return np.asarray(mean * (r_d[:, 1] / r_d.mean(axis=1))[:, None])


def _cosines(p: brdf_truth.TruePoints, point: int) -> tuple[Float64Array, ...]:
    to, at, n = p.light[point], p.view[point], p.normals[point]
    mu_l, mu_v = to @ n, at @ n
    cos_d = np.sqrt(np.clip(0.5 * (1.0 + np.sum(to * at, axis=-1)), 0.0, 1.0))
    return mu_l, mu_v, np.clip((mu_l + mu_v) / np.maximum(2.0 * cos_d, 1e-9), 0.0, 1.0), cos_d


def _ggx(p: brdf_truth.TruePoints, s: brdf_basis.SurfaceSamples) -> Float64Array:
    """Fit strength and roughness of one GGX lobe per point, the best of 60 roughnesses."""
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


def _fit_cube_roots(
    p: brdf_truth.TruePoints, s: brdf_basis.SurfaceSamples, basis: BrdfBasis
) -> Float64Array:
    """Fit cube roots of the matrix elements to cube roots of the samples, the paper's wording."""
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


def _compare_with_scipy(basis: BrdfBasis, *, toy: bool) -> tuple[float, float]:
    """Return the speed-up over SciPy, and the largest relative excess of the residual."""
    rng = np.random.default_rng(1)
    different, copies, subset = (20, 1, 3) if toy else (500, 10, 200)
    p = brdf_truth.sample_dome(
        different, r_d=BAND_ALBEDOS["light"], noise=0.02, samples=900, rng=rng
    )
    p = dataclasses.replace(p, valid=p.valid & (p.light @ p.normals[..., None] > 0.12)[..., 0])
    s = brdf_basis.surface_samples(*p.samples, p.r_d, eta=ETA, variance=p.variance, valid=p.valid)
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
    # processor time is independent of other programs; SciPy uses one core
    ours, theirs = [], []
    for _ in range(1 if toy else 5):
        ours_s, found = measure_processor_time(
            lambda: brdf_basis.fit_weights(many, basis, compress="none")
        )
        peer_s, least = measure_processor_time(lambda: [nnls(a, y)[1] for a, y in problems])
        ours.append(ours_s / LIMIT_CORES)
        theirs.append(peer_s / subset * len(many.value))
    excess = [
        float(np.linalg.norm(a @ x - y) / norm - 1.0)
        for (a, y), x, norm in zip(problems, found.weights[:subset], least, strict=True)
    ]
    return float(np.median(theirs) / np.median(ours)), max(excess)


SPACE_METHODS: Final[tuple[Literal["shares", "brdf"], ...]] = ("shares", "brdf")
SPACE_RANKS: Final = (1, 2, 3, 4, 6, 8, 12)
NOISE_RANK: Final = 4
"""Lobes of a model of one face; the error at this rank is compared with that of noise."""
HELD_OUT_POINT_FRACTION: Final = 0.3
"""Fraction of the points that no mixture is computed from."""


def measure_brdf_space(stage: BenchmarkStage) -> None:
    """Factor the mixtures of three datasets into common mixtures of rising rank, by two methods."""
    basis = brdf_tables.default_basis()
    ranks = (1, 2, 4) if stage.toy else SPACE_RANKS
    steepest, excess, beyond = -np.inf, 0.0, 0.0
    for number, data in enumerate(_datasets(toy=stage.toy)):
        rng = np.random.default_rng([number, 72])
        order = rng.permutation(len(data.weights))
        kept = round(HELD_OUT_POINT_FRACTION * len(order))
        tested, trained = data.weights[order[:kept]], data.weights[order[kept:]]
        persons = data.label[order[:kept]] if data.name == "dataset B" else None
        for method, rank in itertools.product(SPACE_METHODS, ranks):
            # each rank is timed alone, as for a user who needs only this rank
            curve = partial(
                brdf_space.compute_error_curve, trained, basis, ranks=(rank,), method=method
            )
            timing, found = stage.time(
                lambda: curve(held_out=tested, groups=persons), repeats=1, memory=not stage.toy
            )
            inside, error = float(found.error[0]), 100.0 * float(found.held_out[0])
            outcome = ErrorEstimate.nonnegative(error, 100.0 * float(found.held_out_stderr[0]))
            knobs: Knobs = {"set": data.name, "way": method, "rank": rank, "points": found.points}
            also = {
                "own_points_error_percent": round(100.0 * inside, 3),
                "noise_percent": round(100.0 * data.noise, 1),
            }
            stage.add(knobs, timing, outcome, also)
            if method == "shares" and rank == NOISE_RANK:
                beyond = max(beyond, inside / data.noise)
        shares, brdf = (
            brdf_space.compute_error_curve(trained, basis, ranks=ranks, method=way).error
            for way in SPACE_METHODS
        )
        steepest = max(steepest, float(np.diff(brdf).max()))
        excess = max(excess, float((brdf / shares).max()))
    stage.limits = {"rise": 100.0 * steepest, "over_nmf": excess, "over_noise": beyond}


def _datasets(*, toy: bool) -> tuple[Dataset, ...]:
    rng = np.random.default_rng(72)
    if toy:
        return (brdf_space_datasets.sample_one_person(60, rng=rng),)
    return (
        brdf_space_datasets.sample_one_person(700, rng=rng),
        brdf_space_datasets.build_dataset_a(1_400, rng=rng),
        brdf_space_datasets.build_dataset_b(70, members=draw_population()[::4], rng=rng),
    )
