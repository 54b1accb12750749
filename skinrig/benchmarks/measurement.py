"""Error against run time: how a stage is measured."""

import time
import tracemalloc
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from skinrig.benchmarks import resident_memory
from skinrig.benchmarks.results import Timing

Made = TypeVar("Made")

LIMIT_CORES = 2
"""Cores of limits in seconds; processor time does not count other programs on them."""

MAX_TRACED_CALL_S = 0.1
"""Calls that are quicker are run once more for their memory, asked or not."""


def measure(call: Callable[[], Any], *, repeats: int = 3, memory: bool | None = True) -> Timing:
    """Time ``call``: once cold, ``repeats`` times warm, and once more for its memory.

    Parameters
    ----------
    call
        Takes no argument; its result is dropped.
    repeats
        Warm calls, at least 1.
    memory
        False spares a call that takes long the extra one in which its allocations are traced:
        then how far resident memory rose in a warm call is taken (None on systems that do not
        tell). None never traces: for calls into the renderer, whose own threads free what Python
        allocated, which tracing does not survive (one process in ten or so ends).

    Returns
    -------
    Timing

    Examples
    --------
    >>> measure(lambda: sum(range(100)), repeats=3).seconds < 1.0
    True
    """
    return measure_and_keep(call, repeats=repeats, memory=memory)[0]


def measure_and_keep(
    call: Callable[[], Made], *, repeats: int = 3, memory: bool | None = True
) -> tuple[Timing, Made]:
    """Time a call as `measure` does, and return what its last warm call made as well.

    Examples
    --------
    >>> measure_and_keep(lambda: sum(range(100)))[1]
    4950
    """
    if repeats < 1:
        raise ValueError(f"repeats: got {repeats}, expected at least 1")
    start = time.perf_counter()
    call()
    cold = time.perf_counter() - start
    seconds: list[float] = []
    made: list[Made] = []
    with resident_memory.track_peak() as rise:
        for _ in range(repeats):
            made.clear()
            start = time.perf_counter()
            made.append(call())
            seconds.append(time.perf_counter() - start)
    traced = memory is not None and (memory or min(seconds) < MAX_TRACED_CALL_S)
    timing = Timing(
        seconds=float(np.median(seconds)),
        range_s=(min(seconds), max(seconds)),
        cold_s=cold,
        peak_memory_mb=_allocated_mb(call) if traced else rise.mb,
        memory_kind="allocated" if traced else "resident",
    )
    return timing, made[0]


def measure_processor_time(call: Callable[[], Made], repeats: int = 1) -> tuple[float, Made]:
    """Return the least processor time of some calls, s, and what the last made.

    Examples
    --------
    >>> measure_processor_time(lambda: sum(range(100)), 2)[1]
    4950
    """
    seconds = np.inf
    for _ in range(repeats):
        begin = time.process_time()
        made = call()
        seconds = min(seconds, time.process_time() - begin)
    return seconds, made


def measure_processor_seconds(call: Callable[[], object], repeats: int = 1) -> float:
    """Return the least processor time of some calls, s.

    Examples
    --------
    >>> 0.0 <= processor_seconds(lambda: sum(range(100)), 2) < 1.0
    True
    """
    return measure_processor_time(call, repeats)[0]


def measure_once(call: Callable[[], Made]) -> tuple[Timing, Made]:
    """Make something a single time, for a call too long to repeat: cold and warm are one.

    Returns
    -------
    timing : Timing
    made
        What the call returned.

    Examples
    --------
    >>> measure_once(lambda: sum(range(100)))[1]
    4950
    """
    with resident_memory.track_peak() as rise:
        start = time.perf_counter()
        made = call()
        seconds = time.perf_counter() - start
    return Timing.single(seconds, rise.mb, memory_kind="resident"), made


def _allocated_mb(call: Callable[[], Any]) -> float:
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
