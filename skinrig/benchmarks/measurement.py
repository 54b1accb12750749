"""Time calls and measure their memory."""

import time
import tracemalloc
from collections.abc import Callable, Hashable, Mapping
from typing import Any, TypeVar

import numpy as np

from skinrig.benchmarks import resident_memory
from skinrig.benchmarks.results import Timing

Made = TypeVar("Made")
Key = TypeVar("Key", bound=Hashable)

LIMIT_CORES = 2
"""Cores that limits in seconds assume; processor time excludes other programs on them."""

MAX_TRACED_CALL_S = 0.1
"""Calls below this time are always repeated once to trace their memory, s."""


def measure(call: Callable[[], Any], *, repeats: int = 3, memory: bool | None = True) -> Timing:
    """Time ``call`` once cold and ``repeats`` times warm, and measure its peak memory.

    Parameters
    ----------
    call
        Function without arguments; its result is discarded.
    repeats
        Warm calls, at least 1.
    memory
        True repeats the call once more and traces its allocations. False avoids this extra call
        where the call takes long and reports the growth of resident memory instead (None where the
        system does not report it). None never traces: the renderer's threads free memory that
        Python allocated, and tracing this crashes about one process in ten.

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
    """Time a call with `measure`, and return timing and result of the last warm call.

    Examples
    --------
    >>> measure_and_keep(lambda: sum(range(100)))[1]
    4950
    """
    if repeats < 1:
        raise ValueError(f"repeats: got {repeats}, expected at least 1; pass a positive number")
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
    """Return the least processor time of repeated calls, s, and the last result.

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
    """Return the least processor time of repeated calls, s.

    Examples
    --------
    >>> 0.0 <= measure_processor_seconds(lambda: sum(range(100)), 2) < 1.0
    True
    """
    return measure_processor_time(call, repeats)[0]


def measure_processor_seconds_in_turn(
    calls: Mapping[Key, Callable[[], object]], repeats: int
) -> dict[Key, float]:
    """Return the least processor time of each call, s, of repeats that alternate between them.

    Other programs then slow all calls alike.

    Examples
    --------
    >>> found = measure_processor_seconds_in_turn({"a": list, "b": lambda: sum(range(10**5))}, 3)
    >>> found["a"] < found["b"]
    True
    """
    least = dict.fromkeys(calls, float("inf"))
    for _ in range(repeats):
        for name, call in calls.items():
            least[name] = min(least[name], measure_processor_seconds(call))
    return least


def measure_once(call: Callable[[], Made]) -> tuple[Timing, Made]:
    """Time a single call that takes too long to repeat; it counts as cold and as warm.

    Returns
    -------
    timing : Timing
    made
        Result of the call.

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
