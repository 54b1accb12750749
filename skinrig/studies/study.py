"""Run the cases of a study that have no record yet, on any executor, and write its results."""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Executor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from skinrig.resources.forecast import Task, require_resources_of_jobs
from skinrig.simulating.simulation import list_tasks
from skinrig.studies import results
from skinrig.studies.cases import (
    WORK_FOLDER,
    CaseOrder,
    CaseOutcome,
    Judge,
    JudgedQuantity,
    judge_case,
    read_record,
    run_case,
)
from skinrig.studies.description import Case, CaseSize, StudyError, StudyFile, software_hash
from skinrig.studies.executors import (
    SERIAL_EXECUTOR,
    ExecutorLost,
    check_executor,
    count_local_processes,
    describe_lost_task,
    open_executor,
)


@dataclass(frozen=True, slots=True)
class StudyRun:
    """What one run of a study did."""

    cases: Mapping[str, Case]
    """All cases, by key."""
    quantities: Mapping[str, Sequence[JudgedQuantity]]
    """Results of the judged cases, by key."""
    errors: Mapping[str, str]
    """Messages of the cases that failed, by key."""
    ran: int
    """Cases that this run judged."""
    processor_s: float
    """Processor time of the cases that this run ran, s."""


def run_study(
    study: StudyFile,
    out: Path,
    *,
    executor: str = SERIAL_EXECUTOR,
    keep: bool = False,
    judge: Judge = judge_case,
    progress: Callable[[str], None] = lambda line: None,
) -> StudyRun:
    """Run the cases of a study that have no record, and write its table, document and page.

    Parameters
    ----------
    study
        Description of the cases.
    out
        Folder of the records and results; a second run of the same study does no work.
    executor
        See `skinrig.studies.executors.open_executor`.
    keep
        Whether sessions, calibrations and maps are kept, in ``out/sessions``.
    judge
        How a case is run, a function that workers can import.
    progress
        Called before the first case and after each, with their count, which gives the pace.

    Raises
    ------
    StudyError
        If the study is not valid, or another command is writing to `out`.
    skinrig.studies.executors.ExecutorLost
        If the connection to the scheduler is lost; the records of completed cases stay.
    """
    check_executor(executor)
    software = software_hash()
    cases = {case.key(software): case for case in study.list_cases()}
    out = out.absolute()
    with _lock(out):
        done = {key: found for key in cases if (found := read_record(out, key)) is not None}
        one_thread = executor != SERIAL_EXECUTOR
        orders = [
            CaseOrder(case, key, out, software, keep, judge, one_thread)
            for key, case in cases.items()
            if key not in done
        ]
        _require_room(orders, executor, out)
        if done:
            progress(f"{len(done)} of {len(cases)} cases are complete already")
        errors: dict[str, str] = {}
        ran, processor_s = 0, 0.0
        progress(f"cases: 0/{len(orders)}")
        try:
            for outcome in _run_orders(orders, executor):
                ran += 1
                processor_s += outcome.processor_s
                found = None if outcome.error else read_record(out, outcome.key)
                if found is None:
                    errors[outcome.key] = outcome.error or "no record: is the folder shared?"
                else:
                    done[outcome.key] = found
                failure = f": {errors[outcome.key]}" if outcome.key in errors else ""
                progress(f"cases: {ran}/{len(orders)}, last {cases[outcome.key].name}{failure}")
        except ExecutorLost as error:
            raise ExecutorLost(
                f"{error}; {len(done)} of {len(cases)} cases are complete: start a scheduler and "
                "run the same command again to continue"
            ) from error
        finally:
            shutil.rmtree(out / WORK_FOLDER, ignore_errors=True)
        run = StudyRun(
            cases,
            {key: done[key] for key in cases if key in done},
            {key: errors[key] for key in cases if key in errors},
            ran,
            processor_s,
        )
        results.write_results(study.title, run.cases, run.quantities, run.errors, out)
    return run


def _require_room(orders: Sequence[CaseOrder], executor: str, out: Path) -> None:
    """Raise unless memory and disk suffice for the largest cases at once, on disk for all kept."""
    jobs: dict[tuple[str, CaseSize], list[Task]] = {}
    for order in orders:
        rig, size = order.case.rig, order.case.size
        if (rig, size) not in jobs:
            given = {name: n for name, n in asdict(size).items() if n is not None}
            jobs[rig, size] = list_tasks(rig, out, **given)
    processes = count_local_processes(executor)
    require_resources_of_jobs(
        [jobs[order.case.rig, order.case.size] for order in orders],
        out,
        processes=processes,
        outputs=None if any(order.keep for order in orders) else processes,
    )


def _run_orders(orders: Sequence[CaseOrder], executor: str) -> Iterator[CaseOutcome]:
    """Yield the outcome of each order as it ends."""
    if not orders:
        return
    with open_executor(executor) as pool:
        if pool is None:
            yield from map(run_case, orders)
        else:
            yield from _run_on_pool(orders, pool, executor)


def _run_on_pool(
    orders: Sequence[CaseOrder], pool: Executor, executor: str
) -> Iterator[CaseOutcome]:
    futures = {pool.submit(run_case, order): order for order in orders}
    for future in as_completed(futures):
        try:
            yield future.result()
        except CancelledError as error:
            raise ExecutorLost(
                f"--executor: the connection to the scheduler of {executor} was lost"
            ) from error
        except Exception as error:
            yield CaseOutcome(futures[future].key, describe_lost_task(error), 0.0)


@contextmanager
def _lock(out: Path) -> Iterator[None]:
    """Refuse a folder to which another study is being written."""
    out.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(out / "study.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise StudyError(
                "another study is being written there", where=str(out), advice="Wait for its end."
            ) from error
        yield
    finally:
        os.close(descriptor)


def describe_run(run: StudyRun) -> dict[str, object]:
    """Return the numbers of a run, for the command's document."""
    return {
        "cases": len(run.cases),
        "ran": run.ran,
        "reused": len(run.cases) - run.ran,
        "failed": [
            {"case": run.cases[key].name, "error": text} for key, text in run.errors.items()
        ],
        "processor_s": round(run.processor_s, 1),
    }
