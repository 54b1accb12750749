"""Benchmark of the space of surface BRDFs: common mixtures against error and seconds."""

from __future__ import annotations

from typing import Final, Literal

import numpy as np

from model.brdf import tables as brdf_tables
from reconstruction.brdf_basis import space as brdf_space
from rigsim.population.population import table_1
from skinrig.analysing import brdf_space_datasets
from skinrig.analysing.brdf_space_datasets import Dataset
from skinrig.arrays import Float64Array, Int64Array
from skinrig.benchmarks.measurement import Limit, Point, StageBenchmark, measure

SPACE_RANKS: Final = (1, 2, 3, 4, 6, 8, 12)
NOISE_RANK: Final = 4
"""Lobes of a model of one face, whose error is to stay below what noise leaves."""
HELD_OUT_POINT_FRACTION: Final = 0.3
"""Part of the points that no mixture is made of."""


def space(*, toy: bool) -> StageBenchmark:
    """Factor the mixtures of three datasets into ever more common ones, in two ways."""
    basis = brdf_tables.default()
    ranks = (1, 2, 4) if toy else SPACE_RANKS
    points: list[Point] = []
    steepest, excess, beyond = -np.inf, 0.0, 0.0
    for number, data in enumerate(_datasets(toy=toy)):
        rng = np.random.default_rng([number, 72])
        order = rng.permutation(len(data.weights))
        kept = round(HELD_OUT_POINT_FRACTION * len(order))
        tried, trained = data.weights[order[:kept]], data.weights[order[kept:]]
        whose = data.label[order[:kept]] if data.name == "dataset B" else None
        ways: tuple[Literal["shares", "brdf"], ...] = ("shares", "brdf")
        for method in ways:
            # Each rank alone, as somebody who asks for it would have it.
            for rank in ranks:

                def run(
                    rank: int = rank,
                    method: Literal["shares", "brdf"] = method,
                    trained: Float64Array = trained,
                    tried: Float64Array = tried,
                    whose: Int64Array | None = whose,
                ) -> brdf_space.SpaceCurve:
                    return brdf_space.curve(
                        trained, basis, ranks=(rank,), held_out=tried, groups=whose, method=method
                    )

                timing = measure(run, repeats=1, memory=not toy)
                found = run()
                inside, error = float(found.error[0]), float(found.held_out[0])
                half = float(found.held_out_stderr[0])
                knobs: dict[str, str | int | float | bool] = {
                    "set": data.name,
                    "way": method,
                    "rank": rank,
                    "points": found.points,
                }
                also = {
                    "own_points_error_percent": round(100.0 * inside, 3),
                    "noise_percent": round(100.0 * data.noise, 1),
                }
                interval = (100.0 * max(error - half, 0.0), 100.0 * (error + half))
                points.append(Point(knobs, timing, 100.0 * error, interval, also=also))
                if method == "shares" and rank == NOISE_RANK:
                    beyond = max(beyond, inside / data.noise)
        shares, brdf = (
            brdf_space.curve(trained, basis, ranks=ranks, method=way).error for way in ways
        )
        steepest = max(steepest, float(np.diff(brdf).max()))
        excess = max(excess, float((brdf / shares).max()))
    return StageBenchmark(
        "brdf-space",
        "error of the BRDFs of points that the mixtures were not made of, %",
        "mixtures of 59 materials fitted to noisy samples of simulated faces, one by one; two fits "
        "with other noise lie `noise_percent` apart",
        0.0,
        tuple(points),
        (
            Limit(
                "largest rise of the error from a rank to the next, way brdf",
                100.0 * steepest,
                0.0,
                "<=",
                "%",
            ),
            Limit(
                "error of way brdf over that of scikit-learn's NMF alone, worst", excess, 1.0, "<="
            ),
            Limit(
                f"error at rank {NOISE_RANK} over what noise leaves, worst set", beyond, 1.0, "<="
            ),
        ),
        left_out=(
            ("all points of figure 15", "`skinrig analyse brdf --out analysis` has them"),
            ("a Cramer-Rao bound", "the number of mixtures is no parameter with one"),
        ),
        condition=("set",),
        interval_of="points left out",
        no_bands="mixtures of the surface term, which pigment does not enter",
    )


def _datasets(*, toy: bool) -> tuple[Dataset, ...]:

    rng = np.random.default_rng(72)
    if toy:
        return (brdf_space_datasets.one_person(60, rng=rng),)
    return (
        brdf_space_datasets.one_person(700, rng=rng),
        brdf_space_datasets.dataset_a(1_400, rng=rng),
        brdf_space_datasets.dataset_b(70, members=table_1()[::4], rng=rng),
    )
