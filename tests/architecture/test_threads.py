"""Processes of tests leave each other the cores, as tests/conftest.py asks of the libraries."""

import os

import scipy.linalg  # noqa: F401  (loads its own BLAS beside NumPy's)
from threadpoolctl import threadpool_info


def test_small_matrices_use_requested_threads():
    """The libraries read the environment when they are loaded: before that it must be set."""
    asked = int(os.environ["OPENBLAS_NUM_THREADS"])
    found = [row["num_threads"] for row in threadpool_info() if row["internal_api"] == "openblas"]
    assert set(found) <= {asked}
