"""Simulate, capture, calibrate, reconstruct and judge the cases of a study, one at a time."""

import dataclasses
import importlib
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from numba import set_num_threads
from threadpoolctl import threadpool_limits

from skinrig.atomic_file import write_atomically
from skinrig.benchmarks.intervals.coverage import COVERAGE_RANGES, IntervalTrial
from skinrig.console import to_json_value
from skinrig.errors import UnusableError, format_error
from skinrig.studies.description import MEDIUM_TYPE, Case, require_software

RECORD_SCHEMA: Final = "skinrig.study_case/1"
RECORDS_FOLDER: Final = "cases"
WORK_FOLDER: Final = "work"
SESSIONS_FOLDER: Final = "sessions"

Judge = Callable[[Case, Path], Iterable[IntervalTrial]]
"""Run a case in an empty folder, and return its errors and intervals by quantity."""


@dataclass(frozen=True, slots=True)
class JudgedQuantity:
    """Errors and coverage of one quantity of one case: the record of an `IntervalTrial`."""

    quantity: str
    """With the setup of its case, where it has one."""
    band: str
    """Skin type of the case."""
    truths: int
    """Number of ground truths with a valid estimate."""
    error: float
    """Median |estimate - truth|, in `unit`."""
    width: float
    """Median half width of the 68 % interval, in `unit`."""
    unit: str
    inside_68: float
    """Fraction of ground truths in 68 % intervals; NaN without any."""
    inside_95: float
    """Fraction of ground truths in 95 % intervals."""

    def inside_fraction(self, level: int) -> float:
        """Return the fraction of ground truths inside the intervals of a nominal level, %."""
        return {68: self.inside_68, 95: self.inside_95}[level]

    @classmethod
    def of(cls, trial: IntervalTrial, case: Case) -> "JudgedQuantity":
        """Return the record of a trial."""
        name = ", ".join(filter(None, (trial.quantity, case.setup)))
        inside = [
            trial.inside_fraction(level) if trial.truths else float("nan")
            for level in COVERAGE_RANGES
        ]
        return cls(name, case.skin, trial.truths, trial.error, trial.width, trial.unit, *inside)


@dataclass(frozen=True, slots=True)
class CaseOrder:
    """Small, picklable order of a case; all that is large is below `out`, on a shared disk."""

    case: Case
    key: str
    out: Path
    """The study's folder, absolute."""
    software: str
    """See `software_hash`; a worker with other software refuses the case."""
    keep: bool
    """Whether the case's folder is kept after judging."""
    judge: Judge
    one_thread: bool
    """Whether the case may use one thread only."""


@dataclass(frozen=True, slots=True)
class CaseOutcome:
    """Result of running an order; the quantities are in the case's record."""

    key: str
    error: str
    """Message of the error; empty for a judged case."""
    processor_s: float


def judge_case(case: Case, folder: Path) -> Iterator[IntervalTrial]:
    """Run one case through its rig's pipeline with a calibration of its own.

    Parameters
    ----------
    case
        The case.
    folder
        Empty folder of its sessions and maps.

    Yields
    ------
    IntervalTrial
        One per quantity, see `skinrig.benchmarks.intervals`.
    """
    # imported on use, so that a worker loads only the rigs of its cases
    from skinrig.benchmarks.intervals.trials import CaptureVariant

    rig = importlib.import_module(f"skinrig.benchmarks.intervals.{case.rig}")
    size = case.size
    numbers = {"lights": size.lights, "views": size.views}
    subject: dict[str, Any] = {"leave_out": case.leave_out} if case.leave_out else {}
    if case.rig == "gradient":
        subject["subject"] = case.subject
    given = {k: n for k, n in numbers.items() if n is not None} | {"iso_factor": case.iso_factor}
    variant = CaptureVariant(case.calibration_age_days, given, subject)
    people = {case.seed: case.site or case.subject}
    options: dict[str, Any] = {"variant": variant}
    if case.rig == "probe":
        directed = case.subject.startswith("anisotropic:")
        kind = "directed" if directed else "media" if case.skin == MEDIUM_TYPE else "skin"
        yield from rig.run_trials(folder, **{"media": {}, kind: people}, **options)
        return
    if case.rig == "flash":
        options |= {"moving": False, "calibration_seed": case.seed}
    yield from rig.run_trials(folder, people, width_px=size.width_px, **options)


def run_case(order: CaseOrder) -> CaseOutcome:
    """Run and judge a case, and write its record atomically; an error is part of the outcome.

    A case that has a record is not run again. One that two workers run at once, because one of them
    was taken for lost, writes equal records.

    Parameters
    ----------
    order
        The case, and where its record goes.
    """
    if read_record(order.out, order.key) is not None:  # of a worker that ended after writing it
        return CaseOutcome(order.key, "", 0.0)
    begun_s = time.process_time()
    error = ""
    work: Path | None = None
    try:
        require_software(order.software)
        if order.case.key(order.software) != order.key:
            raise UnusableError(
                f"worker: got another content of {order.case.subject}, expected that of the "
                "study's command; copy its files to the same path on every machine"
            )
        (order.out / WORK_FOLDER).mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f"{order.key}-", dir=order.out / WORK_FOLDER))
        if order.one_thread:
            set_num_threads(1)
        with threadpool_limits(1 if order.one_thread else None):
            rows = [JudgedQuantity.of(t, order.case) for t in order.judge(order.case, work)]
        if order.keep:
            kept = order.out / SESSIONS_FOLDER / order.key
            kept.parent.mkdir(exist_ok=True)
            shutil.rmtree(kept, ignore_errors=True)
            with suppress(OSError):  # another worker has just kept the same
                work.rename(kept)
        write_record(order, rows)
    except Exception as failure:  # of any stage: the case's row states it, and the others go on
        error = format_error(failure)
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)
    return CaseOutcome(order.key, error, time.process_time() - begun_s)


def record_path(out: Path, key: str) -> Path:
    """Return the file of a case's record."""
    return out / RECORDS_FOLDER / f"{key}.json"


def write_record(order: CaseOrder, rows: Iterable[JudgedQuantity]) -> None:
    """Write the record of a judged case."""
    document = {
        "schema": RECORD_SCHEMA,
        "key": order.key,
        "software": order.software,
        "case": dataclasses.asdict(order.case),
        "quantities": [dataclasses.asdict(row) for row in rows],
    }
    text = json.dumps(to_json_value(document), indent=1, sort_keys=True)
    write_atomically(record_path(order.out, order.key), f"{text}\n")


def read_record(out: Path, key: str) -> list[JudgedQuantity] | None:
    """Return the quantities of a case's record; None where it is missing or damaged."""
    try:
        document: Mapping[str, Any] = json.loads(record_path(out, key).read_bytes())
        if document["schema"] != RECORD_SCHEMA or document["key"] != key:
            return None
        missing: Any = float("nan")
        return [
            JudgedQuantity(**{k: missing if v is None else v for k, v in row.items()})
            for row in document["quantities"]
        ]
    except (OSError, ValueError, KeyError, TypeError):
        return None
