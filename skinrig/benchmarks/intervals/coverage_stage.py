"""Whether stated intervals hold the truth as often as they say, on subjects that set nothing.

Terms of error models, and the factors from 68 to 95 %, were set on subjects of seeds 0 to 19
(`reconstruction.chromophores.model_error`); subjects here have seeds from 400 on. Each goes the
whole way, from calibration targets to maps, with a calibration of its rig's own
(`interval_trials_flash` and its like).

A coverage is the mean of the subjects' shares, and its interval is that of the mean of so many
subjects. A promise is missed where the interval lies wholly outside the promised range. The
intervals' confidence is such that a run in which every coverage is in truth at the edge of its
range misses one with a chance of 5 % at most (Bonferroni).
"""

import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from skinrig.benchmarks.intervals import dome as interval_trials_dome
from skinrig.benchmarks.intervals import flash as interval_trials_flash
from skinrig.benchmarks.intervals import gradient as interval_trials_gradient
from skinrig.benchmarks.intervals import probe as interval_trials_probe
from skinrig.benchmarks.intervals import sequence as interval_trials_sequence
from skinrig.benchmarks.intervals import trials as interval_trials
from skinrig.benchmarks.intervals.coverage import COVERAGE_RANGES, Covered, Trial, by_band
from skinrig.benchmarks.measurement import once
from skinrig.benchmarks.results import Point, Timing
from skinrig.benchmarks.stage import Findings, Stage

FIRST_SEED: Final = 400
FALSE_ALARM_RATE: Final = 0.05
"""Chance that a run of honest intervals misses a promise."""

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
"""Fractions in 1/mm of absorption and reduced scattering, and g."""
PROBE_PRESETS: Final = ("II", "IV", "VI", "I", "III", "V")
"""Presets under the probe: a band of melanin each, twice."""
ANISOTROPIC_MEDIA: Final = ("anisotropic:0.25,2,-1,35", "anisotropic:0.25,2,1,110")
"""Axes at which a turn the other way, or a quarter of a turn, shows: at 0 and 90 degrees the first
cannot."""
DOME_PRESETS: Final = ("I", "III", "V", "II", "IV", "VI")

Trials = Iterable[Trial]


def intervals(stage: Stage) -> Iterator[None]:
    """Count how often 68 and 95 % intervals of every rig's maps hold the truth.

    Yields
    ------
    None
        After each kind of trial, when the stage holds what is known of all so far.
    """
    trials: list[Trial] = []
    spent: dict[str, Timing] = {}
    for make in (_small() if stage.toy else _full()).values():
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            timing, made = once(lambda make=make, folder=folder: list(make(folder)))  # type: ignore[misc]
        trials += made
        spent |= dict.fromkeys((trial.quantity for trial in made), timing)
        _judge(stage, trials, spent)
        yield


def _judge(stage: Stage, trials: Sequence[Trial], spent: Mapping[str, Timing]) -> None:
    judged = [trial for trial in trials if trial.deviation.size]
    counted = len(by_band(judged, level=68, confidence=0.95))
    # one-sided at each end of the range, of two levels
    confidence = 1.0 - 2.0 * FALSE_ALARM_RATE / (4 * counted)
    rows = [
        row
        for level in COVERAGE_RANGES
        for row in by_band(judged, level=level, confidence=confidence)
    ]
    stage.points = [_point(row, spent[row.quantity]) for row in rows]
    stage.limits = {key: found for row in rows for key, found in _limits(row).items()}
    stage.left_out = [
        (f"{trial.quantity}, {trial.subject}", "every pixel is masked")
        for trial in trials
        if not trial.deviation.size
    ]


def _full() -> Mapping[str, Callable[[Path], Trials]]:
    flash = {FIRST_SEED + k: FLASH_PRESETS[k % len(FLASH_PRESETS)] for k in range(16)}
    sites = {FIRST_SEED + k: GRADIENT_SITES[k % len(GRADIENT_SITES)] for k in range(6)}
    faces = {FIRST_SEED + k: DOME_PRESETS[k] for k in range(len(DOME_PRESETS))}
    media = {FIRST_SEED + k: medium for k, medium in enumerate(PROBE_MEDIA)}
    skin = {FIRST_SEED + k: PROBE_PRESETS[k] for k in range(len(PROBE_PRESETS))}
    coarse = {FIRST_SEED + 16 + k: FLASH_PRESETS[k] for k in range(len(FLASH_PRESETS))}
    moving = {FIRST_SEED + 24 + k: FLASH_PRESETS[k + 1] for k in range(4)}
    return {
        "flash": lambda folder: interval_trials_flash.flash(folder, flash, width_px=768),
        "coarse": lambda folder: interval_trials_flash.flash(
            folder, coarse, width_px=384, moving=False, resolution=", half resolution"
        ),
        "event": lambda folder: interval_trials_sequence.sequences(
            folder, moving, width_px=192, state="exercise"
        ),
        "prompts": lambda folder: interval_trials_sequence.sequences(
            folder, moving, width_px=192, state="smile"
        ),
        "gradient": lambda folder: interval_trials_gradient.gradient(folder, sites, width_px=128),
        "dome": lambda folder: interval_trials_dome.dome(folder, faces, width_px=320),
        "probe": lambda folder: interval_trials_probe.probe(
            folder,
            media,
            skin=skin,
            directed={FIRST_SEED + k: medium for k, medium in enumerate(ANISOTROPIC_MEDIA)},
        ),
    }


def _small() -> Mapping[str, Callable[[Path], Trials]]:
    faces = {FIRST_SEED + 1: "I"}
    return {
        "flash": lambda folder: interval_trials_flash.flash(
            folder, faces, width_px=96, moving=False
        )
    }


def _point(row: Covered, timing: Timing) -> Point:
    off = abs(100.0 * row.share - row.level)
    low, high = (100.0 * end - row.level for end in row.interval)
    # an interval of the coverage that holds the nominal one allows a distance of 0
    least = 0.0 if low <= 0.0 <= high else min(abs(low), abs(high))
    return Point(
        {
            "quantity": row.quantity,
            "skin": row.band,
            "nominal %": row.level,
            "covered %": round(100.0 * row.share, 1),
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


def _limits(row: Covered) -> Findings:
    low, high = COVERAGE_RANGES[row.level]
    skin = "" if row.band in ("all", interval_trials.ANY_BAND) else f", {row.band} skin"
    return {
        ("upper", f"{row.level}", f"{row.quantity}{skin}"): (row.interval[1], low),
        ("lower", f"{row.level}", f"{row.quantity}{skin}"): (row.interval[0], high),
    }
