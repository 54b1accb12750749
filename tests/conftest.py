"""Fixtures shared by all tests."""

import csv
import ctypes
import gc
import ipaddress
import os
import re
import signal
import socket
import sys
from collections import Counter
from contextlib import suppress
from functools import cache
from pathlib import Path

# Tests run in as many processes as there are cores. Threads of one that wait by spinning take
# their core from another, which doubles and more what both spend: wait asleep, and leave small
# matrices to one thread. Read when the libraries are loaded, so before they are imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import hypothesis
import keyword_files
import numpy as np
import pytest
import real_time
import work_units
from _pytest.doctest import DoctestModule
from fixtures.stale_kernels import remove_stale_kernels

# Tests draw the same examples in each run, as slowly as a busy machine likes; nothing is kept
# from one run for the next. Later releases of Hypothesis than the pinned one also draw numbers from
# the source of whatever modules a process has imported, which changes with its other tests.
hypothesis.settings.register_profile("alike", derandomize=True, deadline=None, database=None)
hypothesis.settings.load_profile("alike")


ROOT = Path(__file__).parents[1]

MALLOC_OPTIONS = {-1: 256 * 2**20, -3: 32 * 2**20}
"""M_TRIM_THRESHOLD and M_MMAP_THRESHOLD of glibc's mallopt, bytes."""


def keep_freed_memory():
    """Have the process keep what arrays free: the system clears each page that it gives again.

    That took up to a third of a file's time. A process that a test starts has the defaults, and a
    measurement of resident memory gives free pages back first (skinrig.benchmarks.resident_memory).
    """
    with suppress(OSError, AttributeError, TypeError):  # glibc alone has it
        for option, size in MALLOC_OPTIONS.items():
            ctypes.CDLL(None).mallopt(option, size)


def require_loopback(address):
    """Fail a test that connects to, or listens for, anything beyond this machine."""
    if isinstance(address, tuple) and address[0] != "localhost":
        host = str(address[0]) or "0.0.0.0"
        if not ipaddress.ip_address(host.partition("%")[0]).is_loopback:
            pytest.fail(f"network: got {address}, expected an address of this machine")


@pytest.fixture(scope="session", autouse=True)
def loopback_sockets():
    """Block sockets beyond this machine: no command needs a network at run time."""
    with pytest.MonkeyPatch.context() as patched:
        for name in ("connect", "connect_ex", "bind"):
            honest = getattr(socket.socket, name)

            def checked(self, address, honest=honest):
                require_loopback(address)
                return honest(self, address)

            patched.setattr(socket.socket, name, checked)
        yield


pytest_runtest_protocol = real_time.pytest_runtest_protocol

MIN_RECORDED_S = 2.0
"""Quicker files are not worth a line."""
DURATIONS = ROOT / "tests" / "durations.csv"
"""Seconds of each test file, recorded by `pytest --record-durations`. One process runs a file from
end to end, so a long file taken up last would leave the others without work."""
UNRECORDED_LONG_S = 20.0
"""Assumed seconds of a file with long tests that is not in `DURATIONS`: it is not taken up last."""


def pytest_addoption(parser):
    parser.addoption("--device-port", default=None, help="serial URL of a real box")
    parser.addoption(
        "--record-durations", action="store_true", help=f"write {DURATIONS.name} from this run"
    )
    parser.addoption(
        "--part", default="1/1", help="run one part of the files, 2/3 the second of three"
    )


COLLECTOR_THRESHOLD = 10_000
"""New containers between two runs of the collector, by default 700: most runs find nothing, and
Hypothesis measures each."""


@hypothesis.settings(max_examples=1)
@hypothesis.given(hypothesis.strategies.none())
def draw_once(nothing):
    """Have Hypothesis register its generator: it asks the collector who refers to that.

    Before tests are read there are few objects to ask.
    """


def pytest_xdist_auto_num_workers():
    """One process more than there are cores: tests on real lines and of other processes wait."""
    return (os.cpu_count() or 1) + 1


class ExamplesAlone:
    """Leave modules without an example to those that import them: most have none.

    A plugin, since a conftest.py is asked about the files of its own folder alone.
    """

    @pytest.hookimpl(wrapper=True)
    def pytest_collect_file(self, file_path):
        collectors = yield
        if file_path.suffix != ".py" or b">>>" in file_path.read_bytes():
            return collectors
        return [one for one in collectors if not isinstance(one, DoctestModule)]


def pytest_configure(config):
    keep_freed_memory()
    config.pluginmanager.register(ExamplesAlone())
    config.pluginmanager.register(keyword_files)
    config.pluginmanager.register(work_units)
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a background job of a shell
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if not hasattr(config, "workerinput"):  # before any process of several compiles
        remove_stale_kernels()


@cache
def says_long(path):
    """Tell whether a file names the marker `long`."""
    return "mark.long" in path.read_text(encoding="utf-8")


@cache
def is_all_long(path):
    """Return whether a file marks all its tests `long`, by a line of its own."""
    return re.search(r"^pytestmark = .*\bmark\.long\b", path.read_text("utf-8"), re.M) is not None


def pytest_ignore_collect(collection_path, config):
    """Leave unread what holds no test that is asked for: long ones alone, or all others.

    A file's tests are long by its own words, or by those of what it shares with others: the modules
    beside it that are no tests, and the conftest.py of each folder above.
    """
    one_of_tests = collection_path.match("test_*.py")
    if config.getoption("markexpr") == "not long" and one_of_tests:
        return True if is_all_long(collection_path) else None
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


@pytest.hookimpl(tryfirst=True)
def pytest_pycollect_makeitem(collector, name, obj):
    """Make no items of a function that is long by its own mark where these are not asked for."""
    if name.startswith("test") and collector.config.getoption("markexpr") == "not long":
        if any(mark.name == "long" for mark in getattr(obj, "pytestmark", ())):
            return []
    return None


def recorded_durations_s():
    """Return the seconds by file of `DURATIONS`."""
    with DURATIONS.open(newline="", encoding="utf-8") as file:
        return {ROOT / row["file"]: float(row["seconds"]) for row in csv.DictReader(file)}


def expect_durations_s(items):
    """Return the recorded seconds by file; of others, the assumed ones where a test is long."""
    long = {item.path for item in items if item.get_closest_marker("long")}
    return dict.fromkeys(long, UNRECORDED_LONG_S) | recorded_durations_s()


def pytest_collection():
    draw_once()
    gc.disable()  # nothing that is read now goes away


def pytest_collection_finish():
    """Spare the collector modules and tests, through which it went for a tenth of all time."""
    gc.enable()
    gc.freeze()
    gc.set_threshold(COLLECTOR_THRESHOLD)


def choose_files(part, tests, seconds):
    """Return the files of one part; parts take about as long, and each file is in one.

    ``part`` is "2/3" for the second of three; ``tests`` counts the tests by file, ``seconds`` has
    recorded durations. The longest files go first, each to the part with the least to do.
    """
    try:
        number, count = (int(one) for one in part.split("/"))
    except ValueError:
        number, count = 0, 0
    if not 1 <= number <= count:
        raise pytest.UsageError(f"--part: got {part!r}, expected such as 2/3")
    loads = [0.0] * count
    chosen = set()
    for path in sorted(tests, key=lambda path: (-seconds.get(path, 0.0), str(path))):
        least = loads.index(min(loads))
        loads[least] += max(seconds.get(path, 0.0), 0.01 * tests[path])
        if least == number - 1:
            chosen.add(path)
    return chosen


@pytest.hookimpl(trylast=True)  # what is not asked for has been left out
def pytest_collection_modifyitems(config, items):
    seconds = expect_durations_s(items)
    tests = Counter(item.path for item in items)
    part = choose_files(config.getoption("part"), tests, seconds)
    config.hook.pytest_deselected(items=[item for item in items if item.path not in part])
    items[:] = [item for item in items if item.path in part]
    number = {path: count for count, path in enumerate(tests)}  # a file's tests stay together
    unit = {path: work_units.name_unit(path.relative_to(ROOT).as_posix()) for path in tests}
    unit_s, unit_tests = Counter(), Counter()
    for path in tests:
        unit_s[unit[path]] += seconds.get(path, 0.0)
        unit_tests[unit[path]] += tests[path]

    def order(item):
        name = unit[item.path]
        return -unit_s[name], -unit_tests[name], name, number[item.path]

    items.sort(key=order)


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter, config):
    reports = [
        report
        for reports in terminalreporter.stats.values()
        for report in reports
        if isinstance(report, pytest.TestReport)
    ]
    wanting = sum("test data not found" in str(report.longrepr) for report in reports)
    if wanting:
        terminalreporter.write_line(
            f"{wanting} tests skipped for want of test data (SKINRIG_TEST_DATA)"
        )
    wanting = sum("real set not found" in str(report.longrepr) for report in reports)
    if wanting:
        terminalreporter.write_line(
            f"{wanting} tests skipped for want of public data sets (SKINRIG_REAL_SETS)"
        )
    real_time.pytest_terminal_summary(terminalreporter)
    if config.getoption("record_durations"):
        seconds = {path: spent for path, spent in recorded_durations_s().items() if path.is_file()}
        measured = Counter()
        for report in reports:
            measured[ROOT / report.fspath] += report.duration
        for path, spent in measured.items():  # a file has long tests and others: two runs
            seconds[path] = max(spent, seconds.get(path, 0.0))
        with DURATIONS.open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file, lineterminator="\n")
            table.writerow(("file", "seconds"))
            for path, spent in sorted(seconds.items()):
                if spent >= MIN_RECORDED_S:
                    table.writerow((path.relative_to(ROOT).as_posix(), f"{spent:.0f}"))


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_the_disk():
    """Let synchronizing a file return at once; an invalid descriptor is still refused.

    What one process writes another reads whether or not it has reached the disk: only a cut of
    power matters, and tests of faults wait for the disk (their conftest.py). Gives the calls that
    do wait, by name.
    """
    waiting = {name: getattr(os, name) for name in ("fsync", "fdatasync")}
    with pytest.MonkeyPatch.context() as patch:
        for name in waiting:
            patch.setattr(os, name, lambda descriptor: os.fstat(descriptor) and None)
        yield waiting


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
    return {} if world is None else world._WORLDS


@pytest.fixture(scope="session")
def test_data():
    """The folder of test data outside the repository, or a skip that says where it was sought."""
    beside = Path(__file__).parents[2] / "shared" / "data"
    folder = Path(os.environ.get("SKINRIG_TEST_DATA", beside))
    if not folder.is_dir():
        pytest.skip("test data not found: set SKINRIG_TEST_DATA")
    return folder


@pytest.fixture(scope="session")
def typical_person(tmp_path_factory):
    """Return a function from a preset to the file of a person whose optics are the model's.

    Tests of an algorithm after the color model need it: another person's blood has an unknown
    factor.
    """
    folder = tmp_path_factory.mktemp("typical")

    def write(preset):
        path = folder / f"typical-{preset}.toml"
        lines = 'schema = "skinrig.subject/1"', f'preset = "{preset}"', 'tissue_model = "typical"'
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return str(path)

    return write
