"""Benchmark of repeatability: two sessions of one person per rig, verdicts, and aged calibrations.

Each session has a calibration of its own day. The difference of both sessions is compared with the
stated uncertainties per sample. The verdict on person and state is tested on pairs of one person,
of two people, and of one person in two states.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from capture.calibration import store as calibrations
from capture.calibration.validity import CalibrationDrift as NumberDrift
from model.skin import SkinAppearance
from skinrig.arrays import Float64Array
from skinrig.benchmarks.repeatability.sessions import RigDay, RigProtocol, choose_protocol
from skinrig.benchmarks.resampling import gaussian_rms
from skinrig.benchmarks.results import Timing
from skinrig.benchmarks.stage import BenchmarkStage
from skinrig.evaluating.session_agreement import SessionError, compare_sessions, region_changes

DAYS_AGO: Final = (30, 0)
"""Days of the two sessions, before today."""
AGES_DAYS: Final = (1, 90, 365)
"""Ages at which calibrations are compared with today's."""
SKIN_PRESETS: Final = ("I", "II", "III", "IV", "V", "VI")
PATCH_SITES: Final = ("forehead", "cheek", "chin")
CHANGED_STATE: Final = "exercise"
"""State with blood in the whole face."""
FIRST_PERSON: Final = 104
"""Number of the first person: lower ones set the errors between sessions."""
WIDTHS_PX: Final[Mapping[str, int]] = {"flash": 128, "dome": 240, "gradient": 128, "probe": 0}
PEOPLE_BY_RIG: Final[Mapping[str, int]] = {"flash": 20, "dome": 6, "gradient": 5, "probe": 6}
TOY_WIDTH_PX: Final = 64


def describe_person(rig: str, number: int) -> dict[str, Any]:
    """Return the options of a person in front of a rig.

    Parameters
    ----------
    rig
        Name of the rig.
    number
        Number of the person, >= 0.

    Notes
    -----
    The seed of dome, sphere and probe is also that of the rig as built. People in front of the dome
    are members of the population; patches are of several sites; people under the probe have several
    skin tones.

    Examples
    --------
    >>> describe_person("flash", 7), describe_person("dome", 3)
    ({'subject': 'II', 'seed': 7}, {'subject': 'P04'})
    """
    preset = SKIN_PRESETS[number % len(SKIN_PRESETS)]
    if rig == "flash":
        return {"subject": preset, "seed": number}
    if rig == "dome":
        return {"subject": f"P{number % 87 + 1:02d}"}
    if rig == "gradient":
        return {"subject": preset, "site": PATCH_SITES[number % len(PATCH_SITES)]}
    return {"subject": f"ita:{65 - 9 * (number % 12)}"}


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationDrift:
    """Change of one kind of calibration between two days."""

    kind: str
    days: int
    """Days between them."""
    sigmas: Float64Array
    """Change of each quantity with an uncertainty, in combined standard uncertainties."""
    relative: float
    """Median relative change of quantities other than 0; 0 without any."""
    moved: tuple[NumberDrift, ...] = ()
    """All changes."""

    @classmethod
    def between(cls, kind: str, old: RigDay, new: RigDay, *, days: int) -> CalibrationDrift:
        """Compare the calibrations of two days."""
        pair = (calibrations.load(day.folder / "calibration", kind) for day in (old, new))
        moved = calibrations.measure_drift(*pair)
        sigmas = np.array([one.sigmas for one in moved if one.sigmas is not None])
        relative = [abs(one.change / one.old) for one in moved if one.old]
        return cls(kind, days, sigmas, float(np.median(relative)) if relative else 0.0, moved)


@dataclass(slots=True)
class RigTrials:
    """Comparisons of sessions of one rig.

    Attributes
    ----------
    ratios
        Rms difference, stated one, and their ratio, by map, one per pair of one person.
    common
        Changes in stated uncertainties by map: mean over regions, and their deviation.
    false_alarms, pairs
        Pairs of one person judged as changed, and all.
    found, changed
        Changed pairs found, and all: of two people, and of two states.
    drifts
        Changes of calibrations between both days.
    """

    ratios: dict[str, list[tuple[float, float, float]]] = field(default_factory=dict)
    common: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    false_alarms: int = 0
    pairs: int = 0
    found: int = 0
    changed: int = 0
    drifts: list[CalibrationDrift] = field(default_factory=list)

    def judge_same(self, a: SkinAppearance, b: SkinAppearance) -> None:
        """Compare two sessions of one person in one state."""
        verdict = compare_sessions(a, b)
        self.pairs += 1
        self.false_alarms += not verdict.same
        for one in verdict.quantities:
            figures = (one.rms, one.stated, one.ratio)
            self.ratios.setdefault(one.name, []).append(figures)
        for name, (change, _, stated) in region_changes(a, b).items():
            relative = change / stated
            spread = float(relative.std(axis=0, ddof=1).mean()) if len(relative) > 1 else 0.0
            self.common.setdefault(name, []).append((float(relative.mean()), spread))

    def judge_changed(self, a: SkinAppearance, b: SkinAppearance) -> None:
        """Compare sessions of two people or of two states."""
        self.changed += 1
        try:
            self.found += not compare_sessions(a, b).same
        except SessionError:  # no skin in common is a difference
            self.found += 1


def run_trials(
    folder: Path, protocol: RigProtocol, numbers: Sequence[int], *, with_state: bool
) -> RigTrials:
    """Capture people twice and judge the pairs.

    Parameters
    ----------
    folder
        Folder of the sessions.
    protocol
        How the rig is used.
    numbers
        People, see `describe_person`.
    with_state
        Whether every second person is also captured in `CHANGED_STATE`.
    """
    days = [
        RigDay.calibrate(protocol, folder / f"day-{k}", days_ago=ago, seed=9000 + k)
        for k, ago in enumerate(DAYS_AGO)
    ]
    trials = RigTrials()
    apart = DAYS_AGO[0] - DAYS_AGO[1]
    for kind, _ in protocol.kinds:
        trials.drifts.append(CalibrationDrift.between(kind, *days, days=apart))
    before: SkinAppearance | None = None
    for number in numbers:
        person = describe_person(protocol.rig, number)
        first, second = (day.capture(person, seed=2 * number + k) for k, day in enumerate(days))
        trials.judge_same(first, second)
        if before is not None:
            trials.judge_changed(before, second)
        if with_state and number % 2 == 0:
            moved = days[1].capture(person, seed=5000 + number, state=CHANGED_STATE)
            trials.judge_changed(first, moved)
        before = first
    return trials


def measure_drifts(
    folder: Path, protocol: RigProtocol, ages_days: Sequence[int]
) -> Iterator[CalibrationDrift]:
    """Yield the change of each calibration with age.

    Parameters
    ----------
    folder
        Folder of the calibrations.
    protocol
        How the rig is calibrated.
    ages_days
        Ages of the old calibrations.
    """
    today = RigDay.calibrate(protocol, folder / "age-0", days_ago=0, seed=9100)
    for age in ages_days:
        old = RigDay.calibrate(protocol, folder / f"age-{age}", days_ago=age, seed=9100 + age)
        for kind, _ in protocol.kinds:
            yield CalibrationDrift.between(kind, old, today, days=age)


def measure_repeatability(stage: BenchmarkStage) -> Iterator[None]:
    """Measure differences between sessions, verdicts and drifts, one rig after the other."""
    people = {"flash": 1} if stage.toy else PEOPLE_BY_RIG
    alarms = pairs = found = changed = 0
    for rig, count in people.items():
        width = TOY_WIDTH_PX if stage.toy else WIDTHS_PX[rig]
        protocol = choose_protocol(rig, width_px=width)
        numbers = range(FIRST_PERSON, FIRST_PERSON + count)
        with tempfile.TemporaryDirectory() as name:
            state = rig == "flash" and not stage.toy
            begun = time.perf_counter()
            trials = run_trials(Path(name), protocol, numbers, with_state=state)
            timing = Timing.single((time.perf_counter() - begun) / count)
            for quantity, rows in trials.ratios.items():
                rms, stated, ratios = np.array(rows).T
                face, region = np.sqrt(np.mean(np.square(trials.common[quantity]), axis=0)).tolist()
                extra = {
                    "rms difference": float(np.sqrt(np.mean(rms**2))),
                    "stated": float(np.sqrt(np.mean(stated**2))),
                    "pairs": len(ratios),
                    "common to the face, stated uncertainties": face,
                    "common to a region": region,
                }
                knobs = {"rig": rig, "quantity": quantity}
                stage.add(knobs, timing, gaussian_rms(ratios), extra)
            alarms, pairs = alarms + trials.false_alarms, pairs + trials.pairs
            found, changed = found + trials.found, changed + trials.changed
            if not stage.toy:
                trials.drifts += measure_drifts(Path(name) / "drift", protocol, AGES_DAYS)
            for drift in (one for one in trials.drifts if one.sigmas.size):
                knobs = {"rig": rig, "quantity": f"{drift.kind} calibration, {drift.days} days old"}
                extra = {"median relative change, %": 100.0 * drift.relative}
                stage.add(knobs, timing, gaussian_rms(drift.sigmas), extra)
        yield
    stage.limits["false"] = alarms / max(pairs, 1)
    if changed:
        stage.limits["found"] = found / changed
