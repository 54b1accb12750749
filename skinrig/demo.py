"""Run the demo: simulate, capture, calibrate, reconstruct, fuse, measure and report.

A part of it, such as a rig, begins when those that it needs are done. The report is written after
the first rig, after each further one, and when the person is fused. Sections of earlier reports are
reused.
"""

import json
import multiprocessing
import os
import shutil
import signal
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

from skinrig.atomic_file import write_atomically
from skinrig.console import Console, to_json_value
from skinrig.demo_rigs import (
    DOUBLE_FOLDER,
    FACE_PART,
    HEAD_PART,
    PERSON_PART,
    PHOTOGRAPHS_PART,
    RIGS,
    RUN_BY_PART,
    DemoResults,
    RigDemo,
    choose_width,
    list_parts,
)
from skinrig.errors import EXIT_INTERRUPTED, UnusableError
from skinrig.kernel_cache import PASSIVE_WAIT_SETTINGS
from skinrig.next_steps import suggest
from skinrig.progress import beat_while_running, watch
from skinrig.resources.forecast import measure_folder_mb, require_resources_of_jobs
from skinrig.simulating.simulation import list_tasks
from skinrig.unit_format import format_unit
from skinrig.workspace import scan

if TYPE_CHECKING:
    from skinrig.reporting.drawn_sections import DrawnSections

MAX_JOBS = 2
"""Parts that run in parallel: much of each uses one core only, or waits for a compiler."""
BENCH_STAGES = (
    "hdr",
    "normals",
    "lumitexels",
    "light-order",
    "diffuse-albedo",
    "color-table",
    "layered-reflectance",
    "facial-color",
    "misalignment",
    "skin-stretch",
    "normal-histogram",
)
"""Stages measured at small size, a few per rig, about 1 s each; `skinrig bench` measures all."""
BENCH_BUDGET_S = 20.0
ENDING_S = 5.0
"""Typical seconds of benchmarks and the report after the last part."""
TYPICAL_SECONDS = {
    **{"flash": 45.0, "dome": 100.0, PHOTOGRAPHS_PART: 10.0, "gradient": 60.0, "probe": 30.0},
    **{HEAD_PART: 5.0, PERSON_PART: 7.0, FACE_PART: 6.0},
}
"""Seconds of each part while another one runs, between those with and without compiled kernels."""
REPORT_NAME = "report.html"
MARK_NAME = ".skinrig-demo"
"""File that marks the folder of a demo."""
RELOAD_S = 10
"""Seconds after which a browser loads a preliminary report again."""
SecondsByStep = dict[str, float]


class DemoError(ValueError):
    """Invalid arguments of the demo."""


def run_demo(
    out: Path,
    rigs: Sequence[str],
    *,
    seed: int = 0,
    console: Console,
    width_px: int | None = None,
    jobs: int | None = None,
) -> Mapping[str, Any]:
    """Run the demo into ``out`` and return its document.

    Parameters
    ----------
    out
        New or empty folder, or one of an earlier demo, which is replaced.
    rigs
        Names of rigs.
    seed
        Random seed; results do not depend on ``jobs``.
    console
        Receives progress.
    width_px
        Width of the simulated camera's images, pixels; None: that of the small scale.
    jobs
        Parts that run in parallel, one process each; None: two if there are two cores.
    """
    unknown = [rig for rig in rigs if rig not in RIGS]
    if unknown or not rigs:
        raise DemoError(f"rigs: got {(*unknown, 'none')[0]!r}, expected names of {', '.join(RIGS)}")
    if seed < 0:
        raise DemoError(f"seed: got {seed}, expected 0 or more")
    asked = [rig for rig in RIGS if rig in rigs]
    needs, own = list_parts(asked), SecondsByStep()
    at_once = jobs or min(len(asked), MAX_JOBS, os.cpu_count() or 1)
    at_once = _require_resources(asked, out, width_px, min(at_once, len(needs)))
    _make_room(out)
    began = time.perf_counter()
    parts: _Parts = {}
    drawn: DrawnSections | None = None
    for name, part in _run_parts(needs, (out, seed, width_px, console), at_once):
        parts[name] = part
        drawn = drawn or _keep_sections()
        waiting = [one for one in needs if one not in parts]
        if waiting and name in (*asked, PERSON_PART):
            _write_report(out, parts, _sum_up(needs, parts), waiting=waiting, drawn=drawn)
            ended = f"{name}: done, {len(parts.keys() & asked)} of {len(asked)} rigs"
            console.print_line(
                f"{ended if name in asked else 'fused person: done'}, "
                f"about {_estimate_left_s(parts, needs, at_once):.0f} s left; "
                f"the report so far: {out / REPORT_NAME}"
            )
        if name in asked and parts.keys() >= {*asked}:  # while the person is fused
            _measure_stages(out, own, console)
    found, shares = _sum_up(needs, parts)
    shares |= own
    with _time_step("report", shares, console):
        _write_report(out, parts, (found, shares), waiting=(), drawn=drawn)
    console.print_line("")
    console.print_table(
        ("subject", "map", "error", "unit", "68 % interval covers, %", "masked, %"),
        [[*row[:3], format_unit(row[3]), *row[4:]] for row in found.errors],
    )
    console.print_line("")
    by_rig = [
        (f"{rig}: total", sum(s for name, s in shares.items() if name.startswith(f"{rig}: ")))
        for rig in asked
    ]
    console.print_table(("step", "seconds"), [*shares.items(), *by_rig])
    parallel = f", {at_once} parts in parallel" if at_once > 1 else ""
    total_s = time.perf_counter() - began
    console.print_line(f"\ntotal: {total_s:.1f} s{parallel}")
    for step in suggest(scan(out), out):
        console.print_line(f"next: {step.command}  ({step.why})")
    return {
        "out": out,
        "seconds": shares,
        "total_s": total_s,
        "errors": found.errors,
        "report": out / REPORT_NAME,
    }


def _require_resources(rigs: Sequence[str], out: Path, width_px: int | None, at_once: int) -> int:
    """Return how many rigs fit at once, all or one; raise if one does not fit."""
    jobs = []
    for rig in rigs:
        width = choose_width(rig, width_px)
        jobs.append(list_tasks(rig, out, **({} if width is None else {"width_px": width})))
    # an earlier demo is removed before work begins
    held_mb = measure_folder_mb(out) if (out / MARK_NAME).exists() else 0.0
    require = partial(require_resources_of_jobs, jobs, out, held_mb=held_mb, option="")
    try:
        require(processes=at_once)
    except UnusableError:
        require(processes=1)
        return 1
    return at_once


_Order = tuple[Path, int, int | None, Console]
_Part = tuple[DemoResults, SecondsByStep]
_Parts = dict[str, _Part]


def _sum_up(needs: Iterable[str], parts: _Parts) -> _Part:
    """Return the results and seconds of the parts that are done, in the order of the report."""
    found = DemoResults()
    shares: SecondsByStep = {}
    for name in needs:
        if name in parts:
            found.errors += parts[name][0].errors
            found.tables += parts[name][0].tables
            shares |= parts[name][1]
    return found, shares


def _measure_stages(out: Path, seconds: SecondsByStep, console: Console) -> None:
    """Measure the benchmark's stages at small size into ``out``."""
    from skinrig.benchmarks.stages import run_stages

    quiet = replace(console, quiet=True)  # the report shows its tables
    with _time_step("measure error against run time", seconds, console):
        run_stages(BENCH_STAGES, budget_s=BENCH_BUDGET_S, toy=True, out=out, console=quiet)


def _keep_sections() -> "DrawnSections":
    """Return an empty store of sections; reports are imported while the rigs run."""
    from skinrig.reporting.drawn_sections import DrawnSections

    return DrawnSections()


def _write_report(
    out: Path,
    parts: Iterable[str],
    results: _Part,
    *,
    waiting: Sequence[str],
    drawn: "DrawnSections | None",
) -> None:
    """Write the demo's document and its report on what is done; preliminary if parts wait."""
    from skinrig.reporting.report import build

    found, shares = results
    spent = DemoResults()
    timed = "Seconds; those of parts and benchmarks that ran at the same time are upper bounds"
    spent.add_table(timed, ["step", "seconds"], ((n, round(s, 2)) for n, s in shares.items()))
    document: dict[str, Any] = {"schema": "skinrig.demo/1", "title": "This demo"}
    document["tables"] = spent.tables + found.tables
    # run times differ from run to run, so they go to a document of their own, not into the maps
    written = out / "demo.json"
    write_atomically(written, json.dumps(to_json_value(document), indent=1))
    done = set(parts)  # the folders of the others are growing
    paths = [out]
    title = "skinrig demo"
    if waiting:
        names = done | ({DOUBLE_FOLDER} if PERSON_PART in done else set())
        paths = [
            one
            for one in sorted(out.iterdir())
            if names & set(one.name.split("-")) and not one.name.startswith(".")
        ]
        paths += [one for one in (written, out / "bench.json") if one.exists()]
        for separator, some in ((": ", done), ("; to follow: ", waiting)):
            rigs = ", ".join(rig for rig in RIGS if rig in some)
            named = [one for one in (rigs, PERSON_PART in some and "the fused person") if one]
            title += separator + " and ".join(named) if named else ""
    reload_s = RELOAD_S if waiting else None
    html = build(paths, title=title, reload_s=reload_s, folder=out, drawn=drawn)
    write_atomically(out / REPORT_NAME, html)


def _estimate_left_s(parts: _Parts, needs: Mapping[str, Sequence[str]], at_once: int) -> float:
    """Return the time left, s, from typical seconds and this machine's pace so far."""
    pace = sum(sum(part[1].values()) for part in parts.values())
    pace /= sum(TYPICAL_SECONDS[name] for name in parts)
    end_s = dict.fromkeys(parts, 0.0)  # earliest end of each, after all that it needs
    for name, before in needs.items():
        if name not in parts:
            end_s[name] = TYPICAL_SECONDS[name] + max((end_s[one] for one in before), default=0.0)
    shared_s = sum(TYPICAL_SECONDS[name] for name in needs if name not in parts) / at_once
    return pace * max(shared_s, *end_s.values()) + ENDING_S


def _run_parts(
    needs: Mapping[str, Sequence[str]], order: _Order, at_once: int
) -> Iterator[tuple[str, _Part]]:
    """Yield each part with its results when it is done."""
    if at_once > 1:
        yield from _run_in_processes(needs, order, at_once)
        return
    found: dict[str, DemoResults] = {}
    for name, before in needs.items():
        part = _run_part(name, {one: found[one] for one in before}, *order)
        found[name] = part[0]
        yield name, part


def _run_in_processes(
    needs: Mapping[str, Sequence[str]], order: _Order, at_once: int
) -> Iterator[tuple[str, _Part]]:
    """Run each part in a process of a pool; an error in one stops all."""
    pool = ProcessPoolExecutor(
        at_once, mp_context=multiprocessing.get_context("spawn"), initializer=_end_with_parent
    )
    try:
        schedule = _Schedule(pool, needs, order)
        # the pool starts its processes on submission
        with _environment(PASSIVE_WAIT_SETTINGS), _delayed_signals():
            schedule.begin_ready()
            pool.submit(os.getpid)  # else the end of the process started last goes unnoticed
        watch(None)  # the parts report their own steps
        for _ in needs:
            yield schedule.wait_for_next()
    except BaseException as error:
        for process in multiprocessing.active_children():
            process.terminate()
        pool.shutdown(wait=True, cancel_futures=True)
        if isinstance(error, BrokenProcessPool):
            rigs = [part for part in needs if part in RIGS]
            raise DemoError(
                f"a process of the demo was ended by the system, expected it to finish one of "
                f"{', '.join(rigs)}; run it again with more memory, or rig by rig: --rigs {rigs[0]}"
            ) from error
        raise
    finally:
        pool.shutdown()


class _Schedule:
    """Parts that begin in a pool when those that they need are done, while reports are drawn."""

    def __init__(self, pool: Executor, needs: Mapping[str, Sequence[str]], order: _Order):
        self._pool, self._needs, self._order = pool, needs, order
        self._begun: dict[str, Future[_Part]] = {}
        self._ended: SimpleQueue[tuple[str, Exception | None]] = SimpleQueue()
        self._lock = threading.RLock()

    def begin_ready(self) -> None:
        """Begin the parts that wait for no other."""
        with self._lock:
            done = {n: f.result()[0] for n, f in self._begun.items() if _has_succeeded(f)}
            for name, before in self._needs.items():
                if name not in self._begun and done.keys() >= {*before}:
                    given = {one: done[one] for one in before}
                    self._begun[name] = self._pool.submit(_run_part, name, given, *self._order)
                    self._begun[name].add_done_callback(partial(self._end, name))

    def wait_for_next(self) -> tuple[str, _Part]:
        """Return the next part that ends; raise its error, or that of the start of others."""
        name, error = self._ended.get()
        if error is not None:
            raise error
        return name, self._begun[name].result()

    def _end(self, name: str, future: Future[_Part]) -> None:
        try:
            if _has_succeeded(future):
                self.begin_ready()
            self._ended.put((name, None))
        except Exception as error:  # without an entry, `wait_for_next` would wait for ever
            self._ended.put((name, error))


def _has_succeeded(future: Future[_Part]) -> bool:
    return future.done() and not future.cancelled() and future.exception() is None


@contextmanager
def _environment(defaults: Mapping[str, str]) -> Iterator[None]:
    """Set unset environment variables for the processes that start in this block."""
    added = {name: value for name, value in defaults.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            os.environ.pop(name, None)


@contextmanager
def _delayed_signals() -> Iterator[None]:
    """Deliver Ctrl-C and SIGTERM after the block; processes started in it inherit their delay.

    Another thread of this process may receive them. Python runs their handlers in the main one.
    """
    delayed = (signal.SIGINT, signal.SIGTERM)
    received: list[int] = []
    handlers: dict[signal.Signals, Any] = {}
    if threading.current_thread() is threading.main_thread():
        handlers = {one: signal.signal(one, lambda n, _: received.append(n)) for one in delayed}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, delayed)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if received:
            signal.raise_signal(received[0])


def _end_with_parent() -> None:
    """End this process when its parent ends it or ends; Ctrl-C, which is delayed, is the parent's.

    Without the delay, Ctrl-C would show a traceback of each process that is still starting.
    """
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(EXIT_INTERRUPTED)

    threading.Thread(target=wait, daemon=True).start()


def _run_part(
    name: str,
    before: Mapping[str, DemoResults],
    out: Path,
    seed: int,
    width_px: int | None,
    console: Console,
) -> _Part:
    """Return the results and seconds of a part of the demo."""
    shares: SecondsByStep = {}
    with beat_while_running():
        timer = partial(_time_step, seconds=shares, console=console)
        run = RigDemo(out, seed, timer, width_px, before)
        RUN_BY_PART[name](run)
    return run.found, shares


@contextmanager
def _time_step(name: str, seconds: SecondsByStep, console: Console) -> Iterator[None]:
    console.progress(name)
    start = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - start
    watch(None)  # this process may wait for others now


def _make_room(out: Path) -> None:
    """Empty the folder of an earlier demo; refuse any other folder that is not empty."""
    mark = out / MARK_NAME
    if out.exists() and not out.is_dir():
        raise DemoError(f"{out}: is a file, expected a folder; name another with --out")
    out.mkdir(parents=True, exist_ok=True)
    inside = list(out.iterdir())
    if inside and not mark.exists():
        raise DemoError(
            f"{out}: got a folder with other files, expected a new folder or one of an earlier "
            "demo; nothing was changed; name another with --out"
        )
    for entry in inside:
        if entry.is_dir():
            shutil.rmtree(entry)
        else:
            entry.unlink()
    mark.touch()
