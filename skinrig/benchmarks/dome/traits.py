"""Benchmarks of trait vectors and of albedo editing on a simulated population."""

import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from model.brdf import tables as brdf_tables
from model.traits import TraitSpace, cosine, lobe_edits, reduced_spaces
from model.traits.reduced_spaces import SpaceKind
from reconstruction import brdf_basis
from reconstruction.correspondence import common_regions
from reconstruction.correspondence.charts import TexelChart
from rigsim.population.population import Member, draw_population, shift_trait
from skinrig.arrays import BoolArray, Float32Array, Float64Array, FloatArray
from skinrig.benchmarks import resident_memory
from skinrig.benchmarks.resampling import mean_error, split_squares
from skinrig.benchmarks.results import ErrorEstimate, Knobs, Timing
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues
from skinrig.editing import albedo as editing_albedo
from skinrig.fitting import traits as fitting_traits
from skinrig.traits import albedo_vectors
from skinrig.traits import truth as trait_truth
from skinrig.traits.albedo_vectors import AlbedoSample, AlbedoTraits, VectorKind
from skinrig.traits.labels import TraitLabels
from skinrig.traits.truth import CommonFaces

TAN_MELANIN_FACTOR: Final = 1.5
"""Factor of melanin of the trait "tan"."""
N_EDITED_FACES: Final = 4
"""Number of edited faces; traits are learned from other faces."""


def measure_editing(stage: BenchmarkStage) -> None:
    """Measure edited faces over matching iterations, noise and kinds of vectors."""
    count, size = (4, 64) if stage.toy else (28, 192)
    # heads take long to build; the toy size uses one
    everybody = [p for p in draw_population() if not stage.toy or p.head == 0]
    order = np.random.default_rng(0).permutation(len(everybody))[: count + N_EDITED_FACES]
    subjects = [dataclasses.replace(everybody[k], applied=()) for k in order]
    faces = CommonFaces.of(subjects, size=size, common=64 if stage.toy else 128)
    learned, edited = subjects[:count], subjects[count:]
    tanned = [p if k % 2 else _add_tan(p) for k, p in enumerate(learned)]
    rng = np.random.default_rng(1)
    samples = [faces.albedo(p, noise=0.01, rng=rng) for p in tanned]
    labels = TraitLabels(tuple(p.name for p in learned), {"tan": np.arange(count) % 2 == 0}, {}, ())
    before = [faces.albedo(p, noise=0.0, rng=rng) for p in edited]
    after = [faces.albedo(_add_tan(p), noise=0.0, rng=rng) for p in edited]
    kept = {}
    usual = editing_albedo.MATCHING_NOISE
    settings: list[tuple[VectorKind, int, float]] = [
        ("quantiles", 5, usual),
        ("quantiles", 5, 0.0),
        ("histograms", 5, usual),
        *(("quantiles", n, usual) for n in ((1,) if stage.toy else (1, 2, 10))),
    ]
    spaces: dict[str, AlbedoTraits] = {}
    for kind, iterations, noise in settings:
        if kind not in spaces:
            found = fitting_traits.fit_albedo_spaces(
                samples, labels, faces.frame, kind, left_out=[]
            )
            spaces[kind] = AlbedoTraits(kind, found["texture"], found["albedo"])
        call = partial(_edit, spaces[kind], iterations, noise)
        errors, back = [], []
        for one, truth in zip(before, after, strict=True):
            new = call(one.r_d, one.valid, 1.0)
            again = call(new, one.valid, -1.0)
            errors.append(_error_percent(new, one, truth))
            there = one.valid & truth.valid
            back.append(100 * float(np.sqrt(np.mean((again / one.r_d - 1)[there] ** 2))))
        first = partial(call, before[0].r_d, before[0].valid, 1.0)
        timing, _ = stage.time(first, memory=not stage.toy)
        if not stage.by_band:
            stage.measure_bands(lambda band: _on_skin(call, faces, band.melanin, subjects[0]))
        knobs: Knobs = {"vectors": kind, "iterations": iterations, "noise": noise}
        outcome = stage.add(knobs, timing, mean_error(errors))
        kept[kind, iterations, noise] = outcome.error, float(np.mean(back))
    error, returned = kept[settings[0]]
    pairs = zip(before, after, strict=True)
    none = float(np.mean([_error_percent(a.r_d, a, b) for a, b in pairs]))
    same = _edit(spaces["quantiles"], 5, usual, before[0].r_d, before[0].valid, 0.0)
    zero = float(np.abs(same / before[0].r_d - 1)[before[0].valid].max())
    stage.limits |= {"error": error, "over_no_edit": error / none}
    stage.limits |= {"round_trip": returned, "zero": zero}


def _on_skin(
    edit: Callable[..., Float32Array], faces: CommonFaces, melanin: float, person: Member
) -> ErrorEstimate:
    """Return the error of adding a tan to one face of the given melanin, %."""
    here = dataclasses.replace(person, melanin=melanin)
    rng = np.random.default_rng(2)
    one, truth = (faces.albedo(p, noise=0.0, rng=rng) for p in (here, _add_tan(here)))
    new = edit(one.r_d, one.valid, 1.0)
    good = one.valid & truth.valid
    sizes = 100 * np.abs(new / truth.r_d - 1)
    # errors of neighboring texels are correlated: medians of squares are independent, and the
    # standard error of a Gaussian median is sqrt(pi / 2) = 1.2533 that of the mean
    squares = [at for at in split_squares(len(good)) if good[at].any()]
    medians = [float(np.median(sizes[at][good[at]])) for at in squares]
    half = 1.2533 * float(np.std(medians)) / np.sqrt(len(medians))
    return ErrorEstimate.symmetric(float(np.median(sizes[good])), half)


def _error_percent(r_d: FloatArray, sample: AlbedoSample, truth: AlbedoSample) -> float:
    """Return the median relative error of an edited R_d where both faces are valid, %."""
    return 100 * float(np.median(np.abs(r_d / truth.r_d - 1)[sample.valid & truth.valid]))


def _add_tan(person: Member) -> Member:
    return dataclasses.replace(person, melanin=TAN_MELANIN_FACTOR * person.melanin)


def _edit(
    space: AlbedoTraits,
    iterations: int,
    noise: float,
    r_d: FloatArray,
    valid: BoolArray,
    amount: float,
) -> Float32Array:
    """Edit a map that is given in the common parameterization."""
    size = len(r_d)
    position = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).astype(np.float64)
    on = np.ones((size, size), np.bool_)
    chart = TexelChart(size, position, on, on, np.zeros((size, size), np.float32))
    found = editing_albedo.edit_albedo(
        r_d,
        valid,
        chart,
        space,
        {"tan": amount},
        region=on,
        weight=np.ones((size, size)),
        iterations=iterations,
        noise=noise,
        rng=np.random.default_rng(int(amount < 0)),
    )
    return found.apply(r_d)[0]


N_GROUP_DRAWS = 12
"""Random groups of subjects; the error's interval is their variation."""
N_LABEL_SHUFFLES = 200
N_JACKKNIFE_GROUPS = 10
"""Groups of subjects, each omitted once, for the jackknife error of the fit to all."""
MAX_LOBE_RANK = 8
SPACE_KINDS: tuple[SpaceKind, ...] = ("pca", "nmf")
VECTOR_KINDS: tuple[VectorKind, ...] = ("quantiles", "histograms")


def measure_traits(stage: BenchmarkStage) -> None:
    """Learn lotion from fitted lobes and tan from albedo maps over subjects, spaces and noise."""
    subjects = draw_population()
    rng = np.random.default_rng(0)
    some = [subjects[i] for i in np.sort(rng.permutation(len(subjects))[: 8 if stage.toy else 40])]
    _surface(stage, some)
    _albedo(stage, some)


def _surface(stage: BenchmarkStage, subjects: Sequence[Member]) -> None:
    basis = brdf_tables.default_basis()
    strength = basis.strength()
    metric = basis.cosine_similarity() * np.outer(strength, strength)
    dressed = shift_trait(
        subjects, "lotion", products={"lotion": 0.9}, rng=np.random.default_rng(1)
    )
    label = np.array(["lotion" in person.marks for person in dressed])
    compared = [subjects[i] for i in range(0, len(subjects), 4 if stage.toy else 8)]
    worn = shift_trait(
        compared, "lotion", products={"lotion": 0.9}, fraction=1.0, rng=np.random.default_rng(1)
    )
    bare = [p for p in compared if not p.applied]
    worn = tuple(w for w, p in zip(worn, compared, strict=True) if not p.applied)
    points, pairs = (4, 500) if stage.toy else (60, 1000)
    rng = np.random.default_rng(2)
    changes = trait_truth.lobe_changes(bare, {"worn": worn}, points=points, pairs=pairs, rng=rng)
    truth = changes["worn"]

    def trait_cosine(space: TraitSpace) -> float:
        return truth.cosine(space.trait("trait").vector, basis)

    rng = np.random.default_rng(3)
    most = 4 if stage.toy else 20
    sampled = [trait_truth.surface_points(p, most, rng=rng) for p in dressed]
    for noise, count in ((0.02, 4),) if stage.toy else ((0.2, 20), (0.02, 5), (0.02, 20)):
        means = np.array(
            [
                trait_truth.mean_mixture(
                    p[:count], basis, pairs=60 if stage.toy else 160, noise=noise, rng=rng
                )
                for p in sampled
            ]
        )
        for group in (2, 3) if stage.toy else (3, 8, int(label.sum())):
            for kind in SPACE_KINDS:
                knobs: Knobs = {"trait": "lotion", "space": kind, "noise": noise, "points": count}
                fit = partial(_fitted, means, label, kind, metric, basis)
                _add(stage, knobs, fit, label, group, trait_cosine)
    space = _fitted(means, label, "nmf", metric, basis, np.arange(len(means)))
    stage.limits["lotion"] = trait_cosine(space)
    stage.limits["false_alarms", "lobes"] = _false_alarms(stage, means, metric)
    stage.limits |= _round_trip_error(means[~label], space, metric)


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


def _add(
    stage: BenchmarkStage,
    knobs: Knobs,
    fit: Callable[[NDArray[np.intp]], TraitSpace],
    label: BoolArray,
    group: int,
    error_of: Callable[[TraitSpace], float],
) -> float:
    """Learn from random groups of subjects; add and return the median error over the groups."""
    sides = [np.flatnonzero(label), np.flatnonzero(~label)]
    most = min(group, *(len(side) for side in sides))
    whole = most == min(len(side) for side in sides)
    rng = np.random.default_rng(5)
    seconds, errors, expected, kept = [], [], [], []
    groups = [
        np.sort(np.concatenate([s if whole else rng.choice(s, most, replace=False) for s in sides]))
        for _ in range(1 if whole else N_GROUP_DRAWS)
    ]
    with resident_memory.track_peak() as rise:
        fit(groups[0])
    for rows in groups:
        start = time.perf_counter()
        space = fit(rows)
        seconds.append(time.perf_counter() - start)
        errors.append(1.0 - error_of(space))
        expected.append(space.trait("trait").confidence.expected_cosine)
        kept.append(len(space.basis))
    low, middle, high = (float(v) for v in np.quantile(errors, (0.16, 0.5, 0.84)))
    if whole:
        half = _jackknife(lambda rows: 1.0 - error_of(fit(rows)), groups[0])
        low, high = max(middle - half, 0.0), middle + half
    range_s = min(seconds), max(seconds)
    timing = Timing(float(np.median(seconds)), range_s, seconds[0], rise.mb, "resident")
    shown: Knobs = {**knobs, "people": 2 * most if not whole else len(label)}
    also = {
        "components": int(np.median(kept)),
        "expected_cosine": round(float(np.median(expected)), 4),
    }
    return stage.add(shown, timing, ErrorEstimate(middle, (low, high)), also).error


def _jackknife(value: Callable[[NDArray[np.intp]], float], rows: NDArray[np.intp]) -> float:
    """Return a value's standard error by the jackknife over `N_JACKKNIFE_GROUPS` groups."""
    parts = np.array_split(np.random.default_rng(9).permutation(len(rows)), N_JACKKNIFE_GROUPS)
    values = [value(np.delete(rows, part)) for part in parts if part.size]
    # delete-a-group jackknife: variance = (g - 1) / g times the sum of squared deviations
    count = len(values)
    return float(np.std(values) * np.sqrt(count - 1))


def _false_alarms(
    stage: BenchmarkStage, samples: Float64Array, metric: Float64Array | None
) -> float:
    """Return the fraction of shuffled labels that give a trait with p < 0.05."""
    rng = np.random.default_rng(6)
    passed = []
    for _ in range(10 if stage.toy else N_LABEL_SHUFFLES):
        label = rng.permutation(np.arange(len(samples)) < len(samples) // 3)
        space = TraitSpace.fit(samples, {"none": label}, components=1, metric=metric)
        passed.append(space.trait("none").confidence.p_value < 0.05)
    return float(np.mean(passed))


def _round_trip_error(faces: Float64Array, space: TraitSpace, metric: Float64Array) -> LimitValues:
    """Return errors of adding a trait to lobes of faces without it, and of removing it again."""
    size = float(reduced_spaces.metric_lengths(space.trait("trait").vector, metric))
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
        back.append(reduced_spaces.metric_lengths(gap, metric) / (0.6 * size))
        miss = there.weights @ there.mix - weights @ mix - 0.6 * space.trait("trait").vector
        off.append(reduced_spaces.metric_lengths(miss, metric) / (0.6 * size))
    return {
        "zero": worst_zero,
        "back": float(np.sqrt(np.mean(np.square(back)))),
        "off": float(np.sqrt(np.mean(np.square(off)))),
    }


def _albedo(stage: BenchmarkStage, subjects: Sequence[Member]) -> None:
    tanned = shift_trait(subjects, "tan", melanin=TAN_MELANIN_FACTOR, rng=np.random.default_rng(1))
    label = np.array(["tan" in person.marks for person in tanned])
    faces = CommonFaces.of(subjects, size=64 if stage.toy else 128, common=48 if stage.toy else 80)
    inside = common_regions.region_mask("face", faces.frame)
    compared = list(range(0, len(subjects), 4))
    recaptured = list(range(2, len(subjects), 4))
    after = shift_trait(
        subjects, "tan", melanin=TAN_MELANIN_FACTOR, fraction=1.0, rng=np.random.default_rng(1)
    )
    for noise in (0.01,) if stage.toy else (0.01, 0.1):
        maps = [
            faces.albedo(p, noise=noise, rng=np.random.default_rng([8, k]))
            for k, p in enumerate(tanned)
        ]
        clean = [
            [faces.albedo(group[i], noise=0.0, rng=np.random.default_rng(0)) for i in compared]
            for group in (subjects, after)
        ]
        # subjects that are captured without and with the trait; the ground truth is of others
        twice = [
            faces.albedo(group[i], noise=noise, rng=np.random.default_rng([9, i, k]))
            for k, group in enumerate((subjects, after))
            for i in recaptured
        ]
        for kind in VECTOR_KINDS:
            names = tuple(p.name for p in subjects)
            spaces = fitting_traits.fit_albedo_spaces(
                maps, TraitLabels(names, {"trait": label}, {}, ()), faces.frame, kind, left_out=[]
            )
            vectors = partial(_vectors, texture=spaces["texture"], kind=kind, inside=inside)
            before, with_it = (vectors(group) for group in clean)
            truth = (with_it - before).mean(axis=0)
            rows, pairs = vectors(maps), vectors(twice)

            def trait_cosine(space: TraitSpace) -> float:
                return cosine(space.trait("trait").vector, truth)

            knobs: Knobs = {"trait": "tan", "space": f"pca of {kind}", "noise": noise}
            for group in (2, 3) if stage.toy else (3, 8, int(label.sum())):
                for components in (None, 1) if stage.toy else (None, 1, 4):
                    asked = knobs | {"asked": components or "chosen"}
                    fit = partial(_learned, rows, label, components)
                    _add(stage, asked, fit, label, group, trait_cosine)
            tan = np.arange(len(pairs)) >= len(recaptured)
            fit, asked = partial(_learned, pairs, tan, None), knobs | {"asked": "seen twice"}
            error = _add(stage, asked, fit, tan, len(pairs), trait_cosine)
            # plain histograms miss this limit; their points give the error
            if noise == 0.01 and kind == "quantiles":
                stage.limits["tan", kind, len(recaptured)] = 1.0 - error
                stage.limits["false_alarms", "albedo"] = _false_alarms(stage, rows, None)


def _vectors(
    samples: Sequence[albedo_vectors.AlbedoSample],
    texture: Any,
    kind: VectorKind,
    inside: BoolArray,
) -> Float64Array:
    return np.array(
        [
            albedo_vectors.vector(
                one.r_d, texture, kind, valid=one.valid, region=inside & one.valid
            )
            for one in samples
        ]
    )


def _learned(
    vectors: Float64Array, label: BoolArray, components: int | None, rows: NDArray[np.intp]
) -> TraitSpace:
    return TraitSpace.fit(vectors[rows], {"trait": label[rows]}, components=components)
