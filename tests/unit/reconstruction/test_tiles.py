from concurrent.futures import ThreadPoolExecutor

import pytest

from reconstruction.tiles import map_tiles


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
