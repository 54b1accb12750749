"""Benchmark of the space of surface BRDFs: common mixtures against error and seconds."""

import itertools
from functools import partial
from typing import Final, Literal

import numpy as np

from model.brdf import tables as brdf_tables
from reconstruction.brdf_basis import space as brdf_space
from rigsim.population.population import table_1
from skinrig.analysing import brdf_space_datasets
from skinrig.analysing.brdf_space_datasets import Dataset
from skinrig.benchmarks.results import BandError, Knobs
from skinrig.benchmarks.stage import Stage

WAYS: Final[tuple[Literal["shares", "brdf"], ...]] = ("shares", "brdf")
SPACE_RANKS: Final = (1, 2, 3, 4, 6, 8, 12)
NOISE_RANK: Final = 4
"""Lobes of a model of one face, whose error is to stay below what noise leaves."""
HELD_OUT_POINT_FRACTION: Final = 0.3
"""Part of the points that no mixture is made of."""


def space(stage: Stage) -> None:
    """Factor the mixtures of three datasets into ever more common ones, in two ways."""
    basis = brdf_tables.default()
    ranks = (1, 2, 4) if stage.toy else SPACE_RANKS
    steepest, excess, beyond = -np.inf, 0.0, 0.0
    for number, data in enumerate(_datasets(toy=stage.toy)):
        rng = np.random.default_rng([number, 72])
        order = rng.permutation(len(data.weights))
        kept = round(HELD_OUT_POINT_FRACTION * len(order))
        tried, trained = data.weights[order[:kept]], data.weights[order[kept:]]
        whose = data.label[order[:kept]] if data.name == "dataset B" else None
        for method, rank in itertools.product(WAYS, ranks):
            # Each rank alone, as somebody who asks for it would have it.
            curve = partial(brdf_space.curve, trained, basis, ranks=(rank,), method=method)
            timing, found = stage.time(
                lambda: curve(held_out=tried, groups=whose), repeats=1, memory=not stage.toy
            )
            inside, error = float(found.error[0]), 100.0 * float(found.held_out[0])
            outcome = BandError.of_size(error, 100.0 * float(found.held_out_stderr[0]))
            knobs: Knobs = {"set": data.name, "way": method, "rank": rank, "points": found.points}
            also = {
                "own_points_error_percent": round(100.0 * inside, 3),
                "noise_percent": round(100.0 * data.noise, 1),
            }
            stage.add(knobs, timing, outcome, also)
            if method == "shares" and rank == NOISE_RANK:
                beyond = max(beyond, inside / data.noise)
        shares, brdf = (
            brdf_space.curve(trained, basis, ranks=ranks, method=way).error for way in WAYS
        )
        steepest = max(steepest, float(np.diff(brdf).max()))
        excess = max(excess, float((brdf / shares).max()))
    stage.limits = {"rise": 100.0 * steepest, "over_nmf": excess, "over_noise": beyond}


def _datasets(*, toy: bool) -> tuple[Dataset, ...]:

    rng = np.random.default_rng(72)
    if toy:
        return (brdf_space_datasets.one_person(60, rng=rng),)
    return (
        brdf_space_datasets.one_person(700, rng=rng),
        brdf_space_datasets.dataset_a(1_400, rng=rng),
        brdf_space_datasets.dataset_b(70, members=table_1()[::4], rng=rng),
    )
