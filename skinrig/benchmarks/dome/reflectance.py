"""Benchmark of the reflectance model: error over the number of basis BRDFs, and textures."""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from capture.rig import load_rig
from model import skin_reflectance
from model.brdf import tables as brdf_tables
from model.brdf.tables import BrdfBasis
from reconstruction import brdf_basis, diffuse_albedo
from rigsim.light import surface_brdf
from rigsim.subject import make_subject
from skinrig.arrays import BoolArray, Float64Array, Int64Array
from skinrig.benchmarks.dome import texture as bench_texture
from skinrig.benchmarks.dome.brdf_truth import TrueSamples
from skinrig.benchmarks.resampling import bootstrap_median
from skinrig.benchmarks.results import Knobs
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.skin_bands import MELANIN_BANDS
from skinrig.rendering.photographs.errors import luminance

LOBE_RANKS: Final = (1, 2, 4, 8, 24)
DEFAULT_RANK: Final = 4
RELATIVE_NOISE: Final = 0.02
HELD_OUT_LIGHT_FRACTION: Final = 0.2
"""Fraction of the lights that are held out of fits."""
MIN_COSINE: Final = 0.15
ETA: Final = 1.4
BAND_PRESETS: Final = tuple(band.preset for band in MELANIN_BANDS.values())
EXTREME_PRESETS: Final = ("palest", "darkest")
"""Presets beyond the typical subjects of the bands; measured at full size only."""


@dataclass(frozen=True, slots=True, eq=False)
class FacePoints(TrueSamples):
    """Points of a simulated face."""

    held_out: BoolArray
    """(P, M): samples of held-out lights."""
    total: Float64Array
    """(P, M, 3): true reflection, 1/sr."""


def sample_face_points(
    subject: str, *, points: int, samples: int, rng: np.random.Generator
) -> FacePoints:
    """Draw points of a simulated face and their samples by the dome's lights and cameras.

    Parameters
    ----------
    subject
        Melanin preset.
    points, samples
        Number of points, P, and of samples per point, M.
    rng
        Generator of points, pairs of light and camera, and noise.
    """
    rig = load_rig("dome")
    face = make_subject(subject, seed=0, size=128)
    surface = surface_brdf.skin_surface(
        face, rig.views[0].spectral_sensitivity, rig.lights[0].illuminant
    )
    bare = face.atlas.covered & (face.hair < 0.02) & (surface.normal[..., 2] > 0.3)
    chosen = rng.permutation(np.flatnonzero(bare))[:points]
    packed = surface.packed().reshape(-1, 7)[chosen]
    normals = surface.normal.reshape(-1, 3)[chosen].astype(np.float64)
    position = face.atlas.position_mm.reshape(-1, 3)[chosen].astype(np.float64)
    ends = [np.array([one.position_mm for one in rows]) for rows in (rig.lights, rig.views)]
    every = rng.permuted(np.tile(np.arange(len(ends[0]) * len(ends[1])), (len(chosen), 1)), axis=1)
    pair = _pairs_above_horizon(every, ends, position, normals)[:, :samples]
    which = np.divmod(pair, len(ends[1]))
    to = [_unit(end[k] - position[:, None]) for end, k in zip(ends, which, strict=True)]
    cosines = [np.einsum("pmk,pk->pm", way, normals) for way in to]
    visible = (cosines[0] > MIN_COSINE) & (cosines[1] > MIN_COSINE)
    count = pair.shape[1]
    total, specular = surface_brdf.evaluate_brdf(
        np.repeat(packed, count, axis=0),
        np.repeat(normals, count, axis=0).astype(np.float32),
        to[0].reshape(-1, 3),
        to[1].reshape(-1, 3),
    )
    clean = np.asarray(total, np.float64).reshape(len(chosen), count, 3)
    sigma = RELATIVE_NOISE * (clean + 0.02 / np.pi / np.maximum(cosines[0], MIN_COSINE)[..., None])
    held = rng.random(len(ends[0])) < HELD_OUT_LIGHT_FRACTION
    return FacePoints(
        clean + sigma * rng.standard_normal(clean.shape),
        sigma**2,
        to[0],
        to[1],
        normals,
        visible,
        np.asarray(specular, np.float64).reshape(len(chosen), count),
        held[which[0]],
        clean,
    )


def measure_reflectance_model(stage: BenchmarkStage) -> None:
    """Fit the surface term with few and many lobes, and predict held-out lights."""
    rng = np.random.default_rng(0)
    materials = brdf_tables.default_basis()
    count, samples = (10, 120) if stage.toy else (150, 400)
    usual: list[float] = []
    for subject in BAND_PRESETS if stage.toy else (*BAND_PRESETS, *EXTREME_PRESETS):
        p = sample_face_points(subject, points=count, samples=samples, rng=rng)
        use = p.valid & ~p.held_out
        options: dict[str, Any] = {"eta": ETA, "variance": p.variance, "valid": use}
        albedo = diffuse_albedo.estimate(*p.samples, **options)
        given = brdf_basis.surface_samples(*p.samples, albedo.r_d, **options)
        full = brdf_basis.fit_weights(given, materials)
        for rank in LOBE_RANKS:
            if rank > min(count, materials.size):
                continue

            def reduced() -> tuple[BrdfBasis, Float64Array]:
                lobes = materials.mix_materials(brdf_basis.reduce(full, rank, basis=materials)[1])
                return lobes, brdf_basis.fit_weights(given, lobes).weights

            timing, made = stage.time(reduced, repeats=1, memory=not stage.toy)
            surface, everything = _errors(p, *made, albedo.r_d)
            outcome = bootstrap_median(surface, rng=rng)
            total = float(np.median(everything))
            knobs: Knobs = {"part": "lobes", "rank": rank, "subject": subject}
            knobs |= {"points": len(surface), "samples": samples}
            also = {"all_light_error_percent": round(total, 3)}
            stage.add(knobs, timing, outcome, also)
            if rank == DEFAULT_RANK:
                stage.by_band |= {
                    b: outcome for b, one in MELANIN_BANDS.items() if one.preset == subject
                }
                usual.append(total)
    bench_texture.measure_efforts(stage, {"part": "texture"})
    stage.limits["total"] = max(usual)


def _errors(
    p: FacePoints, lobes: BrdfBasis, weights: Float64Array, r_d: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return relative errors of the surface term and of the total reflection by point, %."""
    finite = np.asarray(np.isfinite(r_d).all(axis=1))
    at = p.valid & p.held_out & finite[:, None]
    some = np.flatnonzero(at.any(axis=1))
    surface, everything = [], []
    for point in some:
        rows = at[point]
        to, view, n = p.light[point, rows], p.view[point, rows], p.normals[point]
        own = np.broadcast_to(weights[point], (len(to), lobes.size))
        lobe = skin_reflectance.lobe_brdf(lobes, own, to, view, n)
        transmitted = np.prod(
            [skin_reflectance.transmittance(direction @ n, ETA) for direction in (to, view)], axis=0
        )
        made = lobe[:, None] + transmitted[:, None] * r_d[point] / np.pi
        true = p.surface[point, rows]
        surface.append(np.sum(np.abs(lobe - true)) / np.sum(true))
        light = luminance(p.total[point, rows])
        everything.append(np.median(np.abs(luminance(made) - light) / light))
    return 100.0 * np.array(surface), 100.0 * np.array(everything)


def _pairs_above_horizon(
    pairs: Int64Array, ends: list[Float64Array], position: Float64Array, normals: Float64Array
) -> Int64Array:
    """Sort the pairs of each point so that those above its horizon come first, in stable order."""
    up = [
        np.einsum("pmk,pk->pm", _unit(end[None] - position[:, None]), normals) > MIN_COSINE
        for end in ends
    ]
    light, view = np.divmod(pairs, len(ends[1]))
    rows = np.arange(len(position))[:, None]
    good = up[0][rows, light] & up[1][rows, view]
    order = np.argsort(~good, axis=1, kind="stable")
    return np.take_along_axis(pairs, order, axis=1)


def _unit(v: Float64Array) -> Float64Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))
