"""Map a function over tiles in order, with a bounded number in flight.

The only interface for parallel and distributed work: any executor with ``submit`` fits, a
``concurrent.futures`` pool or ``distributed.Client(...).get_executor()`` alike.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Final, TypeVar

from numba import get_num_threads, set_num_threads, threading_layer
from threadpoolctl import threadpool_limits

from model.checks import Checks

MAX_THREADS = 8
MAX_WORKERS: Final = 4
"""Tiles of a stage that are computed at once; each needs the memory of its samples."""

Tile = TypeVar("Tile")
Result = TypeVar("Result")


def map_tiles(
    fn: Callable[[Tile], Result],
    tiles: Iterable[Tile],
    *,
    executor: Executor | None = None,
    window: int = 8,
) -> Iterator[Result]:
    """Yield ``fn(tile)`` for each tile, in the order of the tiles.

    Parameters
    ----------
    fn
        A pure function; defined at module level when the executor uses processes.
    tiles
        Small handles (paths, boxes, indices), read lazily; not the arrays themselves.
    executor
        Where to run; None runs in this thread.
    window
        Largest number of tiles in flight.

    Yields
    ------
    Result
        One result per tile, in order. If a tile raises, tiles not yet started
        are cancelled and the error is passed on.

    Raises
    ------
    ValueError
        If ``window`` is below 1.

    Examples
    --------
    >>> list(map_tiles(abs, [-1, 2, -3]))
    [1, 2, 3]
    """
    Checks().within("window", window, "[1, inf)")
    if executor is None:
        for tile in tiles:
            yield fn(tile)
        return
    pending: deque[Future[Result]] = deque()
    try:
        for tile in tiles:
            pending.append(executor.submit(fn, tile))
            if len(pending) >= window:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        for future in pending:
            future.cancel()


def map_on_threads(
    fn: Callable[[Tile], Result],
    tiles: Sequence[Tile],
    executor: Executor | None = None,
    *,
    window: int = 8,
) -> list[Result]:
    """Return ``fn(tile)`` of all tiles: on an executor, or on Numba's number of threads, at most 8.

    Several tiles get threads if no executor is given; one runs in this thread. A worker process of
    a cluster has one (``NUMBA_NUM_THREADS``). Tiles write into arrays of this process, so the
    executor is one of threads. The other parameters are those of :func:`map_tiles`.
    """
    if executor is not None or len(tiles) < 2:
        return list(map_tiles(fn, tiles, executor=executor))
    with ThreadPoolExecutor(min(get_num_threads(), MAX_THREADS)) as pool:
        return list(map_tiles(fn, tiles, executor=pool, window=window))


@contextmanager
def open_worker_pool(workers: int = MAX_WORKERS) -> Iterator[tuple[Executor | None, int]]:
    """Open threads for independent tiles that each use all of NumPy and Numba.

    Numba's threads are divided among the workers, and BLAS has one, so that a tile's bytes do not
    depend on their number. Numba's own thread pool must not be called from several threads: with it
    there is one worker.

    Parameters
    ----------
    workers
        Most threads; at most Numba's number of threads is used. With 1, nothing is changed.

    Yields
    ------
    executor
        For :func:`map_tiles`; None for one worker, which is the calling thread.
    workers
        Number of tiles that are computed at once, >= 1.

    Examples
    --------
    >>> with open_worker_pool(1) as (executor, workers):
    ...     list(map_tiles(abs, [-1, 2, -3], executor=executor, window=workers))
    [1, 2, 3]
    """
    if workers < 2:
        yield None, 1
        return
    threads = get_num_threads()  # starts them, which chooses their layer
    count = min(workers, threads) if threading_layer() in ("omp", "tbb") else 1
    with threadpool_limits(1, user_api="blas"):
        if count < 2:
            yield None, 1
            return
        left = iter([threads // count + (number < threads % count) for number in range(count)])
        with ThreadPoolExecutor(count, initializer=lambda: set_num_threads(next(left))) as pool:
            yield pool, count
