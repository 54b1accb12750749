"""Benchmark of edited albedo maps: a tan put on a face against the same face simulated with one."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np

from reconstruction.correspondence.common_parameterization import Chart
from rigsim.population.population import Member, table_1
from skinrig.arrays import BoolArray, Float32Array, FloatArray
from skinrig.benchmarks.measurement import BandError, Limit, Point, StageBenchmark, measure
from skinrig.editing import albedo as editing_albedo
from skinrig.evaluating.skin_bands import MELANIN_BANDS
from skinrig.fitting import traits
from skinrig.traits.albedo_vectors import AlbedoTraits, VectorKind
from skinrig.traits.labels import Labels
from skinrig.traits.truth import CommonFaces

TAN_MELANIN_FACTOR: Final = 1.5
"""Factor of melanin."""
N_EDITED_FACES: Final = 4
"""Faces that are edited; the traits are learned of others."""
MAX_EDIT_ERROR_PERCENT, MAX_ROUND_TRIP_PERCENT, MAX_ERROR_RATIO_TO_NO_EDIT = 10.0, 2.0, 0.5
"""Limits, %, %, and of the error over that of no edit."""


def editing(*, toy: bool) -> StageBenchmark:
    """Edit faces over iterations of matching, noise and kinds of vectors."""
    count, size = (4, 64) if toy else (28, 192)
    # heads take long to build: one of them is enough to see that this runs
    everybody = [p for p in table_1() if not toy or p.head == 0]
    order = np.random.default_rng(0).permutation(len(everybody))[: count + N_EDITED_FACES]
    people = [dataclasses.replace(everybody[k], applied=()) for k in order]
    faces = CommonFaces.of(people, size=size, common=64 if toy else 128)
    learned, edited = people[:count], people[count:]
    tanned = [p if k % 2 else _tanned(p) for k, p in enumerate(learned)]
    rng = np.random.default_rng(1)
    samples = [faces.albedo(p, noise=0.01, rng=rng) for p in tanned]
    labels = Labels(tuple(p.name for p in learned), {"tan": np.arange(count) % 2 == 0}, {}, ())
    before = [faces.albedo(p, noise=0.0, rng=rng) for p in edited]
    after = [faces.albedo(_tanned(p), noise=0.0, rng=rng) for p in edited]
    points, returns, kept = [], [], {}
    bands: dict[str, BandError] = {}
    settings: list[tuple[VectorKind, int, float]] = [
        ("quantiles", 5, editing_albedo.MATCHING_NOISE),
        ("quantiles", 5, 0.0),
        ("histograms", 5, editing_albedo.MATCHING_NOISE),
    ]
    settings += [
        ("quantiles", n, editing_albedo.MATCHING_NOISE) for n in ((1,) if toy else (1, 2, 10))
    ]
    spaces: dict[str, AlbedoTraits] = {}
    for kind, iterations, noise in settings:
        if kind not in spaces:
            found = traits.albedo_spaces(samples, labels, faces.frame, kind, left_out=[])
            spaces[kind] = AlbedoTraits(kind, found["texture"], found["albedo"])
        call = partial(_edit, spaces[kind], iterations, noise)
        errors, back = [], []
        for one, truth in zip(before, after, strict=True):
            new = call(one.r_d, one.valid, 1.0)
            again = call(new, one.valid, -1.0)
            good = one.valid & truth.valid
            errors.append(100 * float(np.median(np.abs(new / truth.r_d - 1)[good])))
            back.append(100 * float(np.sqrt(np.mean((again / one.r_d - 1)[good] ** 2))))
        timing = measure(
            partial(call, before[0].r_d, before[0].valid, 1.0),
            repeats=1 if toy else 3,
            memory=not toy,
        )
        if not bands:
            bands = {
                name: _on_skin(call, faces, band.melanin, people[0])
                for name, band in MELANIN_BANDS.items()
            }
        mean = float(np.mean(errors))
        off = float(np.std(errors, ddof=1) / np.sqrt(len(errors)))
        knobs: dict[str, Any] = {"vectors": kind, "iterations": iterations, "noise": noise}
        points.append(Point(knobs, timing, mean, (mean - off, mean + off)))
        returns.append(float(np.mean(back)))
        kept[kind, iterations, noise] = (mean, returns[-1])
    error, returned = kept[settings[0]]
    none = float(
        np.mean(
            [
                100 * np.median(np.abs(one.r_d / truth.r_d - 1)[one.valid & truth.valid])
                for one, truth in zip(before, after, strict=True)
            ]
        )
    )
    same = _edit(
        spaces["quantiles"], 5, editing_albedo.MATCHING_NOISE, before[0].r_d, before[0].valid, 0.0
    )
    zero = float(np.abs(same / before[0].r_d - 1)[before[0].valid].max())
    return StageBenchmark(
        "editing",
        "R_d of an edited face, median relative error, %",
        "the same face simulated with the trait",
        0.0,
        tuple(points),
        (
            Limit("tan, error of R_d", error, MAX_EDIT_ERROR_PERCENT, "<=", "%"),
            Limit(
                "tan, error over that of no edit", error / none, MAX_ERROR_RATIO_TO_NO_EDIT, "<="
            ),
            Limit(
                "tan and its opposite, what is left", returned, MAX_ROUND_TRIP_PERCENT, "<=", "%"
            ),
            Limit("tan of amount 0, largest change", zero, 1e-5, "<="),
        ),
        interval_of="faces; by band, regions of one",
        by_band=bands,
    )


def _on_skin(
    edit: Callable[..., Float32Array], faces: CommonFaces, melanin: float, person: Member
) -> BandError:
    """Return the error of a tan put on one face of so much melanin, %."""
    here = dataclasses.replace(person, melanin=melanin)
    rng = np.random.default_rng(2)
    one, truth = (faces.albedo(p, noise=0.0, rng=rng) for p in (here, _tanned(here)))
    new = edit(one.r_d, one.valid, 1.0)
    good = one.valid & truth.valid
    sizes = 100 * np.abs(new / truth.r_d - 1)
    # neighbors err alike: the face is cut into squares
    step = max(len(good) // 8, 1)
    squares = [
        float(np.median(sizes[i : i + step, j : j + step][at]))
        for i in range(0, len(good), step)
        for j in range(0, len(good), step)
        if (at := good[i : i + step, j : j + step]).any()
    ]
    return BandError(float(np.median(sizes[good])), _around(np.median(sizes[good]), squares))


def _around(middle: float, squares: list[float]) -> tuple[float, float]:
    half = 1.2533 * float(np.std(squares)) / np.sqrt(len(squares))
    return float(middle) - half, float(middle) + half


def _tanned(person: Member) -> Member:
    return dataclasses.replace(person, melanin=TAN_MELANIN_FACTOR * person.melanin)


def _edit(
    space: AlbedoTraits,
    iterations: int,
    noise: float,
    r_d: FloatArray,
    valid: BoolArray,
    amount: float,
) -> Float32Array:
    """Edit a map that lies in the common map already."""
    size = len(r_d)
    place = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).astype(np.float64)
    on = np.ones((size, size), np.bool_)
    chart = Chart(size, place, on, on, np.zeros((size, size), np.float32))
    found = editing_albedo.edit_albedo(
        r_d,
        valid,
        chart,
        space,
        {"tan": amount},
        region=on,
        share=np.ones((size, size)),
        iterations=iterations,
        noise=noise,
        rng=np.random.default_rng(int(amount < 0)),
    )
    return found.apply(r_d)[0]
