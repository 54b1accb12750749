import threading
from concurrent.futures import ThreadPoolExecutor

import numba
import pytest

from reconstruction import tiles as module
from reconstruction.tiles import map_tiles, open_worker_pool


@pytest.mark.parametrize("threads", [0, 2])
def test_results_come_in_the_order_of_the_tiles(threads):
    if not threads:
        assert list(map_tiles(lambda n: n * n, range(20))) == [n * n for n in range(20)]
        return
    with ThreadPoolExecutor(threads) as pool:
        results = list(map_tiles(lambda n: n * n, range(20), executor=pool, window=3))
    assert results == [n * n for n in range(20)]


def test_tile_queue_never_exceeds_its_window():
    taken = []

    def tiles():
        for n in range(10):
            taken.append(n)
            yield n

    with ThreadPoolExecutor(1) as pool:
        results = map_tiles(lambda n: n, tiles(), executor=pool, window=2)
        next(results)
        assert len(taken) <= 3


def test_error_in_a_tile_is_propagated():
    with ThreadPoolExecutor(1) as pool, pytest.raises(ZeroDivisionError):
        list(map_tiles(lambda n: 1 // n, [1, 0, 1], executor=pool))


def test_a_window_of_zero_is_refused():
    with pytest.raises(ValueError, match="window"):
        list(map_tiles(abs, [1], window=0))


@numba.njit(parallel=True)
def count_on_threads(n):
    total = 0
    for _ in numba.prange(n):
        total += 1
    return total


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one processor")
def test_workers_divide_threads_and_run_parallel_kernels_together():
    count_on_threads(3)  # starts the threads
    met = threading.Barrier(2, timeout=20)
    most = numba.get_num_threads()

    def measure(n):
        met.wait()  # fails unless two tiles run at once
        return count_on_threads(n), numba.get_num_threads()

    with open_worker_pool(2) as (executor, workers):
        assert workers == 2
        found = list(map_tiles(measure, [10**5] * 6, executor=executor, window=workers))
    assert found == [(10**5, most // 2)] * 6
    assert numba.get_num_threads() == most


def test_threads_of_numbas_own_pool_get_one_worker(monkeypatch):
    monkeypatch.setattr(module, "threading_layer", lambda: "workqueue")
    with open_worker_pool() as (executor, workers):
        assert (executor, workers) == (None, 1)


def test_all_threads_are_given_to_workers(monkeypatch):
    given = []
    monkeypatch.setattr(module, "threading_layer", lambda: "omp")
    monkeypatch.setattr(module, "get_num_threads", lambda: 7)
    monkeypatch.setattr(module, "set_num_threads", given.append)
    met = threading.Barrier(4, timeout=20)  # all four threads are started
    with open_worker_pool(4) as (executor, workers):
        assert list(map_tiles(lambda _: met.wait() >= 0, range(4), executor=executor)) == [True] * 4
    assert (workers, sorted(given)) == (4, [1, 2, 2, 2])
