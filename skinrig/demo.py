"""Run the demo: simulate, capture, calibrate, reconstruct, fuse, measure and report."""

import json
import multiprocessing
import os
import shutil
import signal
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from skinrig.benchmarks.stages import run_stages
from skinrig.console import Console, to_json_value
from skinrig.demo_rigs import RIGS, DemoResults, RigDemo, fuse_person
from skinrig.kernel_cache import PASSIVE_WAIT_SETTINGS
from skinrig.next_steps import suggest
from skinrig.unit_format import format_unit
from skinrig.workspace import scan

MAX_JOBS = 2
"""Rigs that run in parallel: much of each uses one core only, or waits for a compiler."""
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
BENCH_BUDGET_S = 8.0
RIG_ORDER = ("gradient", "dome", "flash", "probe")
SLEEPING_THREADS = {**PASSIVE_WAIT_SETTINGS, "OPENBLAS_NUM_THREADS": "1"}
"""Environment of parallel rigs, unless the user has set it: the rigs share the cores."""
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
        Rigs that run in parallel, one process each; None: two if there are two cores.
    """
    unknown = [rig for rig in rigs if rig not in RIGS]
    if unknown or not rigs:
        raise DemoError(f"rigs: got {(*unknown, 'none')[0]!r}, expected names of {', '.join(RIGS)}")
    if seed < 0:
        raise DemoError(f"seed: got {seed}, expected 0 or more")
    _make_room(out)
    began = time.perf_counter()
    asked = [rig for rig in RIGS if rig in rigs]
    at_once = min(len(asked), MAX_JOBS, os.cpu_count() or 1) if jobs is None else jobs
    order = (out, seed, width_px, console)
    if at_once > 1:
        parts = _run_in_processes(asked, order, at_once)
    else:
        parts = {rig: _run_rig(rig, *order) for rig in asked}
    found = DemoResults()
    shares: SecondsByStep = {}
    for rig in asked:
        part, seconds = parts[rig]
        found.errors += part.errors
        found.tables += part.tables
        shares |= seconds
    if {"flash", "dome"} <= set(asked):
        run = RigDemo(out, seed, lambda name: _time_step(name, shares, console), width_px, found)
        fuse_person(run, asked)
    with _time_step("measure error against run time", shares, console):
        bench = run_stages(
            BENCH_STAGES, budget_s=BENCH_BUDGET_S, toy=True, out=out, console=console
        )
    spent = DemoResults()
    title = "Seconds" + (", rigs in parallel" if at_once > 1 else "")
    spent.add_table(title, ["step", "seconds"], ((n, round(s, 2)) for n, s in shares.items()))
    document: dict[str, Any] = {"schema": "skinrig.demo/1", "title": "This demo"}
    document["tables"] = spent.tables + found.tables
    # run times differ from run to run, so they go to a document of their own, not into the maps
    (out / "demo.json").write_text(json.dumps(to_json_value(document), indent=1), encoding="utf-8")
    with _time_step("report", shares, console):
        from skinrig.report import build

        (out / "report.html").write_text(build([out], title="skinrig demo"), encoding="utf-8")
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
    parallel = f", {at_once} rigs in parallel" if at_once > 1 else ""
    total_s = time.perf_counter() - began
    console.print_line(f"\ntotal: {total_s:.1f} s{parallel}")
    for step in suggest(scan(out), out):
        console.print_line(f"next: {step.command}  ({step.why})")
    return {
        "out": out,
        "seconds": shares,
        "total_s": total_s,
        "errors": found.errors,
        "bench_passed": bench["passed"],
        "report": out / "report.html",
    }


_Order = tuple[Path, int, int | None, Console]
_Parts = dict[str, tuple[DemoResults, SecondsByStep]]


def _run_in_processes(rigs: Sequence[str], order: _Order, at_once: int) -> _Parts:
    """Run each rig in its own process; an error in one stops all."""
    pool = ProcessPoolExecutor(
        at_once, mp_context=multiprocessing.get_context("spawn"), initializer=_die_when_interrupted
    )
    first = sorted(rigs, key=lambda rig: RIG_ORDER.index(rig) if rig in RIG_ORDER else 0)
    try:
        with _environment(SLEEPING_THREADS):  # the pool starts its processes on submission
            futures = {rig: pool.submit(_run_rig, rig, *order) for rig in first}
        wait(futures.values(), return_when=FIRST_EXCEPTION)
        failed = [f for f in futures.values() if f.done() and f.exception() is not None]
        if failed:
            failed[0].result()
        return {rig: futures[rig].result() for rig in rigs}
    except BaseException:
        for process in multiprocessing.active_children():
            process.terminate()
        pool.shutdown(wait=True, cancel_futures=True)
        raise
    finally:
        pool.shutdown()


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


def _die_when_interrupted() -> None:
    """Let SIGINT end this process silently; the parent reports the interruption."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _run_rig(
    rig: str, out: Path, seed: int, width_px: int | None, console: Console
) -> tuple[DemoResults, SecondsByStep]:
    found = DemoResults()
    shares: SecondsByStep = {}
    RIGS[rig](RigDemo(out, seed, lambda name: _time_step(name, shares, console), width_px, found))
    return found, shares


@contextmanager
def _time_step(name: str, seconds: SecondsByStep, console: Console) -> Iterator[None]:
    console.progress(name)
    start = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - start


def _make_room(out: Path) -> None:
    """Empty the folder of an earlier demo; refuse any other folder that is not empty."""
    mark = out / ".skinrig-demo"
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
