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


def test_no_more_tiles_are_taken_than_the_window_allows():
    taken = []

    def tiles():
        for n in range(10):
            taken.append(n)
            yield n

    with ThreadPoolExecutor(1) as pool:
        results = map_tiles(lambda n: n, tiles(), executor=pool, window=2)
        next(results)
        assert len(taken) <= 3


def test_an_error_in_one_tile_is_passed_on():
    with ThreadPoolExecutor(1) as pool, pytest.raises(ZeroDivisionError):
        list(map_tiles(lambda n: 1 // n, [1, 0, 1], executor=pool))


def test_a_window_of_zero_is_refused():
    with pytest.raises(ValueError, match="window"):
        list(map_tiles(abs, [1], window=0))
