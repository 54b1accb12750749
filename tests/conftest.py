"""Fixtures shared by all tests."""

import os
from pathlib import Path

# Tests run in as many processes as there are cores. Threads of one that wait by spinning take
# their core from another, which doubles and more what both spend: wait asleep, and leave small
# matrices to one thread. Read when the libraries are loaded, so before they are imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pytest


def pytest_addoption(parser):
    parser.addoption("--device-port", default=None, help="serial URL of a real box")


@pytest.fixture
def rng():
    return np.random.default_rng(12345)


@pytest.fixture(scope="session")
def test_data():
    """The folder of test data outside the repository, or a skip that says where it was sought."""
    beside = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("SKINRIG_TEST_DATA", beside))
    if not folder.is_dir():
        pytest.skip("test data not found: set SKINRIG_TEST_DATA")
    return folder


@pytest.fixture(scope="session")
def device_port(request):
    url = request.config.getoption("--device-port")
    if url is None:
        pytest.skip("no --device-port was given")
    return url


def pytest_terminal_summary(terminalreporter):
    skipped = [
        report
        for report in terminalreporter.stats.get("skipped", [])
        if "test data not found" in str(report.longrepr)
    ]
    if skipped:
        terminalreporter.write_line(
            f"{len(skipped)} tests skipped for want of test data (SKINRIG_TEST_DATA)"
        )
