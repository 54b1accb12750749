"""Fixtures shared by all tests."""

import importlib.util
import os
import sys
from collections import Counter
from functools import cache
from pathlib import Path

# Tests run in as many processes as there are cores. Threads of one that wait by spinning take
# their core from another, which doubles and more what both spend: wait asleep, and leave small
# matrices to one thread. Read when the libraries are loaded, so before they are imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hypothesis
import numpy as np
import pytest
from hypothesis.internal.conjecture import providers

# Tests draw the same examples in each run, as slowly as a busy machine likes; nothing is kept
# from one run for the next. Derandomized or not, Hypothesis would also draw the numbers that stand
# in the source of all modules imported by then, and which those are is chance: other tests of the
# same process.
hypothesis.settings.register_profile("alike", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("alike")
providers._get_local_constants = providers.Constants

# What one process writes another reads whether or not it has reached the disk: only a cut of power
# tells, which tests/faults/test_power_cut.py models operation by operation. Each frame waits three
# times for the disk, in which its core has nothing to do; an invalid descriptor is still refused.
# That the calls come, tests/unit/capture/session/test_disk.py sees.
os.fsync = os.fdatasync = lambda descriptor: os.fstat(descriptor) and None

ROOT = Path(__file__).parents[1]

_REAL_TIME = importlib.util.spec_from_file_location(
    "real_time", Path(__file__).with_name("real_time.py")
)
real_time = importlib.util.module_from_spec(_REAL_TIME)
_REAL_TIME.loader.exec_module(real_time)
pytest_runtest_protocol = real_time.pytest_runtest_protocol

LONGEST_FIRST = (
    "tests/recovery/test_dome_rig.py",
    "tests/system/test_demo.py",
    "tests/browser/test_controls_hands.py",
    "tests/browser/test_accessibility.py",
    "tests/browser/test_viewer_pages.py",
    "tests/system/test_tour.py",
    "tests/recovery/test_kernels_of_patches.py",
    "tests/benchmarks/test_benchmarks.py",
    "tests/radiometry/test_dome_session.py",
    "tests/radiometry/test_flash_lateral_reference.py",
    "tests/recovery/test_gradient_stages.py",
    "tests/faults/test_damage.py",
    "tests/recovery/test_held_out_photographs.py",
    "tests/recovery/test_flash_rig.py",
    "tests/recovery/test_dome_stages.py",
    "tests/recovery/test_subsurface_inversion.py",
    "tests/recovery/test_facial_color_fit.py",
    "tests/protocol/test_fuzz.py",
    "tests/faults/test_caliper_stateful.py",
    "tests/faults/test_dome_stateful.py",
    "tests/faults/test_wire_stateful.py",
    "tests/recovery/test_head_motion.py",
    "tests/faults/test_power_cut.py",
    "tests/unit/skinrig/exporting/test_consent_on_its_way.py",
    "tests/unit/rigsim/tissue/test_skin_table.py",
    "tests/unit/reconstruction/kernel_fit/test_fit.py",
)
"""Files that take 20 s and more, the longest first; the rest go by how many tests they have. One
process runs a file from end to end, so one of these taken up last would leave the others without
work."""


def pytest_addoption(parser):
    parser.addoption("--device-port", default=None, help="serial URL of a real box")


@cache
def says_long(path):
    """Tell whether a file names the marker `long`."""
    return "mark.long" in path.read_text(encoding="utf-8")


def pytest_ignore_collect(collection_path, config):
    """Leave unread what holds no long test where these alone are asked for.

    A file's tests are long by its own words, or by those of what it shares with others: the modules
    beside it that are no tests, and the conftest.py of each folder above.
    """
    one_of_tests = collection_path.match("test_*.py")
    if config.getoption("markexpr") != "long" or not one_of_tests:
        return None
    folder = collection_path.parent
    beside = [path for path in folder.glob("*.py") if not path.name.startswith("test_")]
    above = [
        conftest
        for parent in folder.parents
        if parent.is_relative_to(ROOT / "tests" / "")
        and parent != ROOT / "tests"
        and (conftest := parent / "conftest.py").is_file()
    ]
    return None if any(map(says_long, (collection_path, *beside, *above))) else True


@pytest.hookimpl(trylast=True)  # what is not asked for has been left out
def pytest_collection_modifyitems(items):
    missing = [name for name in LONGEST_FIRST if not (ROOT / name).is_file()]
    if missing:
        raise pytest.UsageError(f"tests/conftest.py: LONGEST_FIRST: no file {', '.join(missing)}")
    rank = {ROOT / name: number for number, name in enumerate(LONGEST_FIRST)}
    tests = Counter(item.path for item in items)
    place = {path: number for number, path in enumerate(tests)}  # a file's tests stay together

    def order(item):
        path = item.path
        return rank.get(path, len(rank)), -tests[path], place[path]

    items.sort(key=order)


@pytest.fixture
def rng():
    return np.random.default_rng(12345)


@pytest.fixture(autouse=True)
def worlds_of_others():
    """Take away the worlds that a test opened and left: the next one of this process has its own.

    A world stays for as long as its process, as a rig's box stays on its port; which tests share a
    process, and in which order, is chance.
    """
    before = set(_worlds())
    yield
    for name in set(_worlds()) - before:
        _worlds()[name].unregister()


def _worlds():
    world = sys.modules.get("rigsim.world.world")  # most tests need none, and its import takes time
    return {} if world is None else world._BENCH


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
