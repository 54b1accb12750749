"""Benchmark of the coverage of stated intervals on held-out subjects.

Error models and the factors from 68 to 95 % were set on subjects of seeds 0 to 19
(`reconstruction.chromophores.model_error`); subjects here have seeds from 400 on. Each passes the
whole pipeline, from calibration targets to maps, with its rig's own calibration (see
`skinrig.benchmarks.intervals.flash` and the other rigs' modules).

A coverage is the mean of the subjects' fractions inside, with the interval of a mean of that many
subjects. A limit is missed where the interval lies wholly outside the accepted range. The
confidence of the intervals is corrected for the number of coverages (Bonferroni): a run in which
every true coverage is at the edge of its range misses any limit with probability 5 % at most.
"""

import itertools
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from skinrig.benchmarks.intervals import dome, flash, gradient, probe, sequence
from skinrig.benchmarks.intervals.coverage import (
    COVERAGE_RANGES,
    IntervalCoverage,
    IntervalTrial,
    corrected_confidence,
    group_by_band,
)
from skinrig.benchmarks.intervals.trials import ANY_BAND
from skinrig.benchmarks.measurement import measure_once
from skinrig.benchmarks.results import Point, Timing
from skinrig.benchmarks.stage import BenchmarkStage, LimitValues

FIRST_SEED: Final = 400

FLASH_PRESETS: Final = ("palest", "I", "II", "III", "IV", "V", "VI", "darkest")
GRADIENT_SITES: Final = ("forehead", "cheek", "chin")
PROBE_MEDIA: Final = (
    "homogeneous:0.02,1.0,0.8",
    "homogeneous:0.1,1.5,0.86",
    "homogeneous:0.3,2.0,0.73",
    "homogeneous:0.05,1.2,0.8",
    "homogeneous:0.2,1.3,0.85",
    "homogeneous:0.04,2.2,0.76",
    "homogeneous:0.5,1.8,0.82",
    "homogeneous:0.08,0.9,0.9",
)
"""Absorption and reduced scattering coefficient, 1/mm, and anisotropy g."""
PROBE_PRESETS: Final = ("II", "IV", "VI", "I", "III", "V")
"""Presets under the probe: two of each melanin band."""
ANISOTROPIC_MEDIA: Final = ("anisotropic:0.25,2,-1,35", "anisotropic:0.25,2,1,110")
"""Media with axes at which a reversed sense of rotation and an exchange of axes are errors; at 0
and 90 degrees a reversed sense has no effect."""
DOME_PRESETS: Final = ("I", "III", "V", "II", "IV", "VI")

Trials = Iterable[IntervalTrial]


def measure_coverage(stage: BenchmarkStage) -> Iterator[None]:
    """Measure the coverage of the 68 and 95 % intervals of every rig's maps.

    Yields
    ------
    None
        After each kind of trial; the stage then contains the results of all trials so far.
    """
    trials: list[IntervalTrial] = []
    spent: dict[str, Timing] = {}
    for make in (_small() if stage.toy else _full()).values():
        with tempfile.TemporaryDirectory() as folder:
            timing, made = measure_once(lambda: list(make(Path(folder))))
        trials += made
        spent |= dict.fromkeys((trial.quantity for trial in made), timing)
        _evaluate_trials(stage, trials, spent)
        yield


def _evaluate_trials(
    stage: BenchmarkStage, trials: Sequence[IntervalTrial], spent: Mapping[str, Timing]
) -> None:
    confidence = corrected_confidence(trials)
    tried = (group_by_band(trials, level=level, confidence=confidence) for level in COVERAGE_RANGES)
    rows = list(itertools.chain(*tried))
    stage.points = [_point(row, spent[row.quantity]) for row in rows]
    stage.limits = {key: found for row in rows for key, found in _limits(row).items()}
    stage.omitted = [
        (f"{trial.quantity}, {trial.subject}", "every pixel is masked")
        for trial in trials
        if not trial.deviation.size
    ]


def _subjects(names: Sequence[str], count: int, first: int = 0) -> dict[int, str]:
    """Return names in cyclic order by seed; seeds below the offset `first` are used elsewhere."""
    return {FIRST_SEED + first + k: names[k % len(names)] for k in range(count)}


def _full() -> Mapping[str, Callable[[Path], Trials]]:
    moving = _subjects(FLASH_PRESETS[1:], 4, first=24)
    coarse: dict[str, Any] = {"moving": False, "resolution": ", half resolution"}
    return {
        "flash": partial(flash.run_trials, subjects=_subjects(FLASH_PRESETS, 16), width_px=768),
        "coarse": partial(
            flash.run_trials, subjects=_subjects(FLASH_PRESETS, 8, first=16), width_px=384, **coarse
        ),
        "event": partial(sequence.run_trials, subjects=moving, width_px=192, state="exercise"),
        "prompts": partial(sequence.run_trials, subjects=moving, width_px=192, state="smile"),
        "gradient": partial(
            gradient.run_trials, subjects=_subjects(GRADIENT_SITES, 6), width_px=128
        ),
        "dome": partial(dome.run_trials, subjects=_subjects(DOME_PRESETS, 6), width_px=320),
        "probe": partial(
            probe.run_trials,
            media=_subjects(PROBE_MEDIA, 8),
            skin=_subjects(PROBE_PRESETS, 6),
            directed=_subjects(ANISOTROPIC_MEDIA, 2),
        ),
    }


def _small() -> Mapping[str, Callable[[Path], Trials]]:
    faces = {FIRST_SEED + 1: "I"}
    return {"flash": partial(flash.run_trials, subjects=faces, width_px=96, moving=False)}


def _point(row: IntervalCoverage, timing: Timing) -> Point:
    off = abs(100.0 * row.inside_fraction - row.level)
    low, high = (100.0 * end - row.level for end in row.interval)
    # an interval of the coverage that contains the nominal one allows a distance of 0
    least = 0.0 if low <= 0.0 <= high else min(abs(low), abs(high))
    return Point(
        {
            "quantity": row.quantity,
            "skin": row.band,
            "nominal %": row.level,
            "covered %": round(100.0 * row.inside_fraction, 1),
            "at least %": round(100.0 * row.interval[0], 1),
            "at most %": round(100.0 * row.interval[1], 1),
            "subjects": row.subjects,
            "half width": f"{row.width:.3g} {row.unit}",
            "verdict": row.verdict,
        },
        timing,
        off,
        (min(off, least), max(off, abs(low), abs(high))),
    )


def _limits(row: IntervalCoverage) -> LimitValues:
    low, high = COVERAGE_RANGES[row.level]
    skin = "" if row.band in ("all", ANY_BAND) else f", {row.band} skin"
    return {
        ("upper", f"{row.level}", f"{row.quantity}{skin}"): (row.interval[1], low),
        ("lower", f"{row.level}", f"{row.quantity}{skin}"): (row.interval[0], high),
    }
