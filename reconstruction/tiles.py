"""Map a function over tiles in order, with a bounded number in flight.

The only interface for parallel and distributed work: any executor with ``submit`` fits, a
``concurrent.futures`` pool or ``distributed.Client(...).get_executor()`` alike.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from typing import TypeVar

from numba import get_num_threads

from model.checks import Checks

MAX_THREADS = 8

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
