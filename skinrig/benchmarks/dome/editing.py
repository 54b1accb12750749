"""Benchmark of edited albedo maps: a tan put on a face against the same face simulated with one."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Final

import numpy as np

from reconstruction.correspondence.charts import Chart
from rigsim.population.population import Member, table_1
from skinrig.arrays import BoolArray, Float32Array, FloatArray
from skinrig.benchmarks.description import described
from skinrig.benchmarks.measurement import measure
from skinrig.benchmarks.resampling import mean_error, squares
from skinrig.benchmarks.results import BandError, Knobs, Point, StageBenchmark
from skinrig.editing import albedo as editing_albedo
from skinrig.evaluating.skin_bands import MELANIN_BANDS
from skinrig.fitting import traits
from skinrig.traits.albedo_vectors import AlbedoSample, AlbedoTraits, VectorKind
from skinrig.traits.labels import Labels
from skinrig.traits.truth import CommonFaces

TAN_MELANIN_FACTOR: Final = 1.5
"""Factor of melanin."""
N_EDITED_FACES: Final = 4
"""Faces that are edited; the traits are learned of others."""


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
    points, kept = [], {}
    bands: dict[str, BandError] = {}
    usual = editing_albedo.MATCHING_NOISE
    settings: list[tuple[VectorKind, int, float]] = [
        ("quantiles", 5, usual),
        ("quantiles", 5, 0.0),
        ("histograms", 5, usual),
        *(("quantiles", n, usual) for n in ((1,) if toy else (1, 2, 10))),
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
            errors.append(_error_percent(new, one, truth))
            there = one.valid & truth.valid
            back.append(100 * float(np.sqrt(np.mean((again / one.r_d - 1)[there] ** 2))))
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
        knobs: Knobs = {"vectors": kind, "iterations": iterations, "noise": noise}
        points.append(Point.of(knobs, timing, mean_error(errors)))
        kept[kind, iterations, noise] = points[-1].error, float(np.mean(back))
    error, returned = kept[settings[0]]
    pairs = zip(before, after, strict=True)
    none = float(np.mean([_error_percent(a.r_d, a, b) for a, b in pairs]))
    same = _edit(spaces["quantiles"], 5, usual, before[0].r_d, before[0].valid, 0.0)
    zero = float(np.abs(same / before[0].r_d - 1)[before[0].valid].max())
    return described(
        "editing",
        points,
        {"error": error, "over_no_edit": error / none, "round_trip": returned, "zero": zero},
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
    places = [at for at in squares(len(good)) if good[at].any()]
    medians = [float(np.median(sizes[at][good[at]])) for at in places]
    half = 1.2533 * float(np.std(medians)) / np.sqrt(len(medians))
    return BandError.around(float(np.median(sizes[good])), half)


def _error_percent(r_d: FloatArray, one: AlbedoSample, truth: AlbedoSample) -> float:
    """Return the median error of an edited R_d where both faces are known, %."""
    return 100 * float(np.median(np.abs(r_d / truth.r_d - 1)[one.valid & truth.valid]))


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
