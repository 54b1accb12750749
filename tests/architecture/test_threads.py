"""Processes of tests spare cores and memory's pages, as tests/conftest.py asks of the libraries."""

import ctypes
import gc
import os
import resource

import numpy as np
import pytest
import scipy.linalg  # noqa: F401  (loads its own BLAS beside NumPy's)
from threadpoolctl import threadpool_info


def test_small_matrices_use_requested_threads():
    """The libraries read the environment when they are loaded: before that it must be set."""
    asked = int(os.environ["OPENBLAS_NUM_THREADS"])
    found = [row["num_threads"] for row in threadpool_info() if row["internal_api"] == "openblas"]
    assert set(found) <= {asked}


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="a C library without mallopt")
def test_freed_arrays_leave_their_pages_to_next():
    """Expected: hardly a page of 24 arrays is new; with glibc's defaults, two of three are."""

    def faults():
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(8):
            arrays = [np.ones(2**18) for _ in range(3)]
            del arrays
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    faults()  # the first arrays need new pages
    pages = 24 * 2**18 * 8 // resource.getpagesize()
    assert faults() < 0.1 * pages


def test_collector_runs_seldom():
    assert gc.isenabled()
    assert gc.get_threshold()[0] == 10_000
