"""Measure what an executor costs: overhead against serial, tasks per second, MB per second.

    python tools/measure_executors.py [--executor local:2] [--tasks N] [--seconds S]

Costs are processor seconds of this process and all its children, so that other programs on the
machine do not count. They are measured after the workers have started, for tasks of three kinds:
empty ones, those that compute for S seconds, and those whose argument is an array of 1 MB.
The last is what studies avoid: their tasks get paths. Wall seconds are printed beside them.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, as_completed
from contextlib import contextmanager
from typing import Any

import numpy as np
import psutil

from skinrig.studies.executors import ONE_THREAD, open_executor

IDLE_S = 5.0
MEGABYTE = np.zeros(125_000)


def compute(seconds: float) -> None:
    """Use the processor for a time."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        sum(range(1000))


def ignore(_argument: object) -> None:
    """Do nothing."""


def processor_s() -> dict[str, float]:
    """Return processor seconds of this process, which has the scheduler, and of the others."""
    own = psutil.Process()
    spent = {"this": sum(own.cpu_times()[:2]), "workers": 0.0}
    for child in own.children(recursive=True):
        spent["workers"] += sum(child.cpu_times()[:2])
    return spent


class Measured:
    """Seconds of a block."""

    wall = this = workers = 0.0


@contextmanager
def measure() -> Iterator[Measured]:
    """Measure a block."""
    before, begun, found = processor_s(), time.perf_counter(), Measured()
    yield found
    found.wall = time.perf_counter() - begun
    after = processor_s()
    found.this, found.workers = (after[name] - before[name] for name in ("this", "workers"))


def run(pool: Executor, task: Callable[[Any], None], arguments: Iterable[Any]) -> None:
    """Run tasks as a study does."""
    for future in as_completed([pool.submit(task, one) for one in arguments]):
        future.result()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--executor", default="local:2")
    parser.add_argument("--tasks", type=int, default=500)
    parser.add_argument("--seconds", type=float, default=0.5)
    given = parser.parse_args()
    few = max(given.tasks // 50, 2)
    with measure() as serial:
        for _ in range(few):
            compute(given.seconds)
    with open_executor(given.executor) as pool:
        if pool is None:
            sys.exit("threads run in this process: nothing to measure")
        run(pool, ignore, range(100))  # every worker has started and imported
        with measure() as empty:
            run(pool, ignore, range(given.tasks))
        with measure() as busy:
            run(pool, compute, [given.seconds] * few)
        with measure() as idle:
            time.sleep(IDLE_S)
        with measure() as heavy:
            run(pool, ignore, [MEGABYTE + k for k in range(few)])
    own = 1e3 * empty.this / given.tasks
    print(f"executor {given.executor}, workers' environment {ONE_THREAD}")
    print(
        f"{given.tasks} empty tasks: {own:.2f} ms of client and scheduler, "
        f"{1e3 * empty.workers / given.tasks:.2f} ms of workers each; {1e3 / own:.0f} tasks per "
        f"processor second of client and scheduler, {given.tasks / empty.wall:.0f} per wall second"
    )
    total, alone = busy.this + busy.workers, serial.this
    print(
        f"{few} tasks of {given.seconds:g} s: {total:.2f} processor s, serial {alone:.2f}: "
        f"overhead {100 * (total / alone - 1):.2f} %; wall {busy.wall:.1f} and {serial.wall:.1f} s"
    )
    per_task = (empty.this + empty.workers) / given.tasks
    alive = (idle.this + idle.workers) / idle.wall / os.cpu_count()
    share = 100 * (per_task / given.seconds + alive)
    print(
        f"idle: {1e3 * (idle.this + idle.workers) / idle.wall:.1f} ms of processor time per wall "
        f"second; so {share:.2f} % of tasks of {given.seconds:g} s on cores without other work"
    )
    cost = heavy.this + heavy.workers
    print(
        f"{few} arguments of 1 MB: {few / heavy.wall:.0f} MB/s, {1e3 * cost / few:.1f} ms of "
        "processor time per MB"
    )


if __name__ == "__main__":
    main()
