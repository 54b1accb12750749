"""Run compiled kernels over blocks of items in threads."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, Final

from numba import get_num_threads

MAX_PIECES_PER_THREAD: Final = 4
"""Pieces of the items per thread, of which each thread takes the next one when it is free."""


def run_in_blocks(kernel: Callable[..., None], count: int, block: int, *arguments: Any) -> None:
    """Call ``kernel(*arguments, first, last)`` on pieces of the items, in Numba's threads.

    A kernel that Numba parallelizes is compiled four times in succession: alone, as the body of
    the loop, with its wrapper, and with its caller. One that threads call is compiled once.

    Parameters
    ----------
    kernel
        Releases the global interpreter lock. It processes items ``first`` to ``last - 1``, and
        writes its results into its arguments.
    count
        Number of items.
    block
        Items that one call processes together; pieces begin at its multiples.
    arguments
        Common arguments.

    Examples
    --------
    >>> seen = [0] * 5
    >>> def kernel(values, first, last):
    ...     values[first:last] = range(first, last)
    >>> run_in_blocks(kernel, 5, 2, seen)
    >>> seen
    [0, 1, 2, 3, 4]
    """
    if count < 1:
        return
    threads = get_num_threads()
    blocks = -(-count // block)
    pieces = min(blocks, MAX_PIECES_PER_THREAD * threads)
    if threads == 1 or pieces == 1:
        kernel(*arguments, 0, count)
        return
    edges = [min(count, block * (blocks * piece // pieces)) for piece in range(pieces + 1)]

    def run(ends: tuple[int, int]) -> None:
        kernel(*arguments, *ends)

    with ThreadPoolExecutor(min(threads, pieces)) as pool:
        deque(pool.map(run, pairwise(edges)), maxlen=0)  # raises what a kernel raises
