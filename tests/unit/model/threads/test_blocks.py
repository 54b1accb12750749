import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from model.threads import blocks, run_in_blocks


@given(count=st.integers(0, 200), block=st.integers(1, 70), workers=st.integers(1, 5))
def test_blocks_contain_each_item_once(count, block, workers):
    calls, lock = [], threading.Lock()

    def kernel(values, first, last):
        values[first:last] += 1
        with lock:
            calls.append((first, last))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks, "get_num_threads", lambda: workers)
        values = np.zeros(count, int)
        run_in_blocks(kernel, count, block, values)
    assert (values == 1).all()
    assert all(first % block == 0 and first < last for first, last in calls)
    assert len(calls) <= blocks.MAX_PIECES_PER_THREAD * workers


def test_kernel_error_reaches_caller(monkeypatch):
    monkeypatch.setattr(blocks, "get_num_threads", lambda: 3)

    def kernel(first, last):
        if first <= 7 < last:
            raise FloatingPointError("item 7")

    with pytest.raises(FloatingPointError, match="item 7"):
        run_in_blocks(kernel, 12, 1)
