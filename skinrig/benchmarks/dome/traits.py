"""Benchmark of trait vectors against traits that a simulated population is known to have."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from model.brdf import tables as brdf_tables
from model.traits import TraitSpace, cosine, lobe_edits, reduced_spaces
from model.traits.reduced_spaces import SpaceKind
from reconstruction import brdf_basis
from reconstruction.correspondence import common_regions
from rigsim.population.population import Member, shifted, table_1
from skinrig.arrays import BoolArray, Float64Array
from skinrig.benchmarks import resident_memory
from skinrig.benchmarks.description import Findings, described
from skinrig.benchmarks.dome.editing import TAN_MELANIN_FACTOR
from skinrig.benchmarks.results import Knobs, Point, StageBenchmark, Timing
from skinrig.fitting import traits as fitting_traits
from skinrig.traits import albedo_vectors
from skinrig.traits import truth as trait_truth
from skinrig.traits.albedo_vectors import VectorKind
from skinrig.traits.labels import Labels
from skinrig.traits.truth import CommonFaces

N_GROUP_DRAWS = 12
"""Random choices of so many people, whose scatter is the error's."""
N_LABEL_SHUFFLES = 200
N_JACKKNIFE_GROUPS = 10
"""Groups of people, each left out once, for the error of what all of them tell."""
MAX_LOBE_RANK = 8
SPACE_KINDS: tuple[SpaceKind, ...] = ("pca", "nmf")
VECTOR_KINDS: tuple[VectorKind, ...] = ("quantiles", "histograms")


def traits(*, toy: bool) -> StageBenchmark:
    """Learn lotion from fitted lobes and tan from albedo maps, over people, spaces and noise."""
    people = table_1()
    rng = np.random.default_rng(0)
    some = [people[i] for i in np.sort(rng.permutation(len(people))[: 8 if toy else 40])]
    points, limits = _surface(some, toy=toy)
    more, bounds = _albedo(some, toy=toy)
    return described("traits", (*points, *more), limits | bounds)


def _surface(people: Sequence[Member], *, toy: bool) -> tuple[list[Point], Findings]:
    basis = brdf_tables.default()
    strength = basis.strength()
    metric = basis.kinship() * np.outer(strength, strength)
    dressed = shifted(people, "lotion", apply={"lotion": 0.9}, rng=np.random.default_rng(1))
    label = np.array(["lotion" in person.marks for person in dressed])
    compared = [people[i] for i in range(0, len(people), 4 if toy else 8)]
    worn = shifted(
        compared, "lotion", apply={"lotion": 0.9}, share=1.0, rng=np.random.default_rng(1)
    )
    bare = [p for p in compared if not p.applied]
    worn = tuple(w for w, p in zip(worn, compared, strict=True) if not p.applied)
    points, pairs = (4, 500) if toy else (60, 1000)
    rng = np.random.default_rng(2)
    changes = trait_truth.lobe_changes(bare, {"worn": worn}, points=points, pairs=pairs, rng=rng)
    truth = changes["worn"]

    def judged(space: TraitSpace) -> float:
        return truth.cosine(space.trait("trait").vector, basis)

    found: list[Point] = []
    limits: Findings = {}
    rng = np.random.default_rng(3)
    most = 4 if toy else 20
    seen = [trait_truth.surface_points(p, most, rng=rng) for p in dressed]
    for noise, places in ((0.02, 4),) if toy else ((0.2, 20), (0.02, 5), (0.02, 20)):
        means = np.array(
            [
                trait_truth.mean_mixture(
                    p[:places], basis, pairs=60 if toy else 160, noise=noise, rng=rng
                )
                for p in seen
            ]
        )
        for group in (2, 3) if toy else (3, 8, int(label.sum())):
            for kind in SPACE_KINDS:
                knobs = {"trait": "lotion", "space": kind, "noise": noise, "points": places}
                fit = partial(_fitted, means, label, kind, metric, basis)
                found.append(_drawn(fit, label, group, knobs, judged))
    space = _fitted(means, label, "nmf", metric, basis, np.arange(len(means)))
    limits["lotion"] = judged(space)
    limits |= _false_alarms("lobes", means, metric, toy=toy)
    return found, limits | _returned(means[~label], space, metric)


def _fitted(
    means: Float64Array,
    label: BoolArray,
    kind: SpaceKind,
    metric: Float64Array,
    basis: brdf_tables.BrdfBasis,
    rows: NDArray[np.intp],
) -> TraitSpace:
    some = means[rows]
    mix = None
    if kind == "nmf":
        mix = brdf_basis.reduce(some, min(MAX_LOBE_RANK, len(some) - 1), basis=basis)[1]
    return TraitSpace.fit(some, {"trait": label[rows]}, space=kind, basis=mix, metric=metric)


def _drawn(
    fit: Callable[[NDArray[np.intp]], TraitSpace],
    label: BoolArray,
    group: int,
    knobs: dict[str, Any],
    judged: Callable[[TraitSpace], float],
) -> Point:
    """Learn from random groups of people; the error is the median over them."""
    sides = [np.flatnonzero(label), np.flatnonzero(~label)]
    most = min(group, *(len(side) for side in sides))
    whole = most == min(len(side) for side in sides)
    rng = np.random.default_rng(5)
    seconds, errors, expected, kept = [], [], [], []
    groups = [
        np.sort(np.concatenate([s if whole else rng.choice(s, most, replace=False) for s in sides]))
        for _ in range(1 if whole else N_GROUP_DRAWS)
    ]
    with resident_memory.watched() as rise:
        fit(groups[0])
    for rows in groups:
        start = time.perf_counter()
        space = fit(rows)
        seconds.append(time.perf_counter() - start)
        errors.append(1.0 - judged(space))
        expected.append(space.trait("trait").confidence.expected_cosine)
        kept.append(len(space.basis))
    low, middle, high = (float(v) for v in np.quantile(errors, (0.16, 0.5, 0.84)))
    if whole:
        half = _jackknife(lambda rows: 1.0 - judged(fit(rows)), groups[0])
        low, high = max(middle - half, 0.0), middle + half
    spread = min(seconds), max(seconds)
    timing = Timing(float(np.median(seconds)), spread, seconds[0], rise.mb, "resident")
    shown = {**knobs, "people": 2 * most if not whole else len(label)}
    also = {
        "components": int(np.median(kept)),
        "expected_cosine": round(float(np.median(expected)), 4),
    }
    return Point(shown, timing, middle, (low, high), also=also)


def _jackknife(value: Callable[[NDArray[np.intp]], float], rows: NDArray[np.intp]) -> float:
    """Return a value's standard error by leaving out each of `N_JACKKNIFE_GROUPS` groups."""
    parts = np.array_split(np.random.default_rng(9).permutation(len(rows)), N_JACKKNIFE_GROUPS)
    values = [value(np.delete(rows, part)) for part in parts if part.size]
    count = len(values)
    return float(np.std(values) * np.sqrt(count - 1))


def _false_alarms(
    what: str, samples: Float64Array, metric: Float64Array | None, *, toy: bool
) -> Findings:
    """Return how often shuffled labels pass for a trait."""
    rng = np.random.default_rng(6)
    passed = []
    for _ in range(10 if toy else N_LABEL_SHUFFLES):
        label = rng.permutation(np.arange(len(samples)) < len(samples) // 3)
        space = TraitSpace.fit(samples, {"none": label}, components=1, metric=metric)
        passed.append(space.trait("none").confidence.p_value < 0.05)
    return {("false_alarms", what): float(np.mean(passed))}


def _returned(faces: Float64Array, space: TraitSpace, metric: Float64Array) -> Findings:
    """Edit the lobes of faces without the trait, and back again."""
    size = float(reduced_spaces.lengths(space.trait("trait").vector, metric))
    rng = np.random.default_rng(7)
    worst_zero, back, off = 0.0, [], []
    for face in faces[:6]:
        others = faces[rng.choice(len(faces), 4)]
        mix = np.vstack([face, others])  # texels between this face's mixture and others'
        mix /= mix.sum(axis=1, keepdims=True)
        weights = rng.dirichlet(np.full(len(mix), 0.8), 500)
        same = lobe_edits.edit_weights(weights, mix, space, {"trait": 0.0})
        worst_zero = max(worst_zero, float(np.abs(same.weights - weights).max()))
        there = lobe_edits.edit_weights(weights, mix, space, {"trait": 0.6})
        again = lobe_edits.edit_weights(there.weights, there.mix, space, {"trait": -0.6})
        gap = again.weights @ again.mix - weights @ mix
        back.append(reduced_spaces.lengths(gap, metric) / (0.6 * size))
        miss = there.weights @ there.mix - weights @ mix - 0.6 * space.trait("trait").vector
        off.append(reduced_spaces.lengths(miss, metric) / (0.6 * size))
    return {
        "zero": worst_zero,
        "back": float(np.sqrt(np.mean(np.square(back)))),
        "off": float(np.sqrt(np.mean(np.square(off)))),
    }


def _albedo(people: Sequence[Member], *, toy: bool) -> tuple[list[Point], Findings]:
    tanned = shifted(people, "tan", melanin=TAN_MELANIN_FACTOR, rng=np.random.default_rng(1))
    label = np.array(["tan" in person.marks for person in tanned])
    faces = CommonFaces.of(people, size=64 if toy else 128, common=48 if toy else 80)
    inside = common_regions.region("face", faces.frame)
    compared = list(range(0, len(people), 4))
    seen = list(range(2, len(people), 4))
    after = shifted(
        people, "tan", melanin=TAN_MELANIN_FACTOR, share=1.0, rng=np.random.default_rng(1)
    )
    points: list[Point] = []
    limits: Findings = {}
    for noise in (0.01,) if toy else (0.01, 0.1):
        maps = [
            faces.albedo(p, noise=noise, rng=np.random.default_rng([8, k]))
            for k, p in enumerate(tanned)
        ]
        clean = [
            [faces.albedo(group[i], noise=0.0, rng=np.random.default_rng(0)) for i in compared]
            for group in (people, after)
        ]
        # People who are seen without and with the trait; the truth is of others
        twice = [
            faces.albedo(group[i], noise=noise, rng=np.random.default_rng([9, i, k]))
            for k, group in enumerate((people, after))
            for i in seen
        ]
        for kind in VECTOR_KINDS:
            names = tuple(p.name for p in people)
            spaces = fitting_traits.albedo_spaces(
                maps, Labels(names, {"trait": label}, {}, ()), faces.frame, kind, left_out=[]
            )
            vectors = partial(_vectors, texture=spaces["texture"], kind=kind, inside=inside)
            before, with_it = (vectors(group) for group in clean)
            truth = (with_it - before).mean(axis=0)
            rows, pairs = vectors(maps), vectors(twice)

            def judged(space: TraitSpace) -> float:
                return cosine(space.trait("trait").vector, truth)

            knobs: Knobs = {"trait": "tan", "space": f"pca of {kind}", "noise": noise}
            for group in (2, 3) if toy else (3, 8, int(label.sum())):
                for components in (None, 1) if toy else (None, 1, 4):
                    asked = knobs | {"asked": components or "chosen"}
                    fit = partial(_learned, rows, label, components)
                    points.append(_drawn(fit, label, group, asked, judged))
            tan = np.arange(len(pairs)) >= len(seen)
            fit, asked = partial(_learned, pairs, tan, None), knobs | {"asked": "seen twice"}
            points.append(_drawn(fit, tan, len(pairs), asked, judged))
            # Plain histograms are measured, and miss it: their points say by how much
            if noise == 0.01 and kind == "quantiles":
                limits["tan", kind, len(seen)] = 1.0 - points[-1].error
                limits |= _false_alarms("albedo", rows, None, toy=toy)
    return points, limits


def _vectors(
    shown: Sequence[albedo_vectors.AlbedoSample], texture: Any, kind: VectorKind, inside: BoolArray
) -> Float64Array:
    return np.array(
        [
            albedo_vectors.vector(
                one.r_d, texture, kind, valid=one.valid, region=inside & one.valid
            )
            for one in shown
        ]
    )


def _learned(
    vectors: Float64Array, label: BoolArray, components: int | None, rows: NDArray[np.intp]
) -> TraitSpace:
    return TraitSpace.fit(vectors[rows], {"trait": label[rows]}, components=components)
