"""Tests on a real line keep real time: what failed while the machine stood still is done again.

A box waits 0.3 s for its host and a lamp burns 0.5 s, however busy the machine is. A test that
failed while nothing of this process ran for a tenth of a second proves nothing about box or driver:
it runs up to five times. One core of a virtual machine can stand still while another serves the
watching thread, so a test that failed without a stall runs twice. The summary counts repetitions.
"""

import threading
import time

import pytest
from _pytest.runner import runtestprotocol

REAL_LINES = frozenset({"pty", "tcp", "rfc2217"})
PARAMETERS = ("bench", "served", "transport")
FOLDERS = frozenset({"hardware", "firmware"})
"""Tests of emulated chips; a real box (``--device-port``) gets one attempt."""
STALL_S = 0.1
PERIOD_S = 0.005
ATTEMPTS = 5
ATTEMPTS_WITHOUT_STALL = 2


class Stalls:
    """Note how late a thread wakes up: the others of its process were not served either."""

    def __init__(self):
        self.longest_s = 0.0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self):
        last_s = time.monotonic()
        while not self._ended.wait(PERIOD_S):
            now_s = time.monotonic()
            self.longest_s = max(self.longest_s, now_s - last_s - PERIOD_S)
            last_s = now_s
        self.longest_s = max(self.longest_s, time.monotonic() - last_s - PERIOD_S)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()


def is_on_a_real_line(item):
    """Return whether a test speaks over a line of the operating system."""
    if item.path.parent.name in FOLDERS:
        return item.config.getoption("device_port", default=None) is None
    given = getattr(getattr(item, "callspec", None), "params", {})
    return any(given.get(name) in REAL_LINES for name in PARAMETERS)


def allowed_attempts(longest_stall_s):
    """Return how often a failing test runs, given the longest stall of its last attempt."""
    return ATTEMPTS if longest_stall_s >= STALL_S else ATTEMPTS_WITHOUT_STALL


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item, nextitem):
    """Run a test on a real line, again where the machine stood still while it failed."""
    if not is_on_a_real_line(item):
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for attempt in range(1, ATTEMPTS + 1):
        with Stalls() as stalls:
            reports = runtestprotocol(item, nextitem=nextitem, log=False)
        failed = any(report.failed for report in reports)
        if not failed or attempt >= allowed_attempts(stalls.longest_s):
            break
    for report in reports:
        if attempt > 1 and report.when == "call":
            report.user_properties.append(("attempts on a real line", attempt))
        if failed:
            told = f"attempt {attempt}; nothing ran for up to {stalls.longest_s:.3f} s"
            report.sections.append(("real time", told))
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_terminal_summary(terminalreporter):
    """List the tests on a real line that ran more than once."""
    for reports in terminalreporter.stats.values():
        for report in reports:
            for name, attempts in getattr(report, "user_properties", ()):
                if name == "attempts on a real line":
                    terminalreporter.write_line(f"{attempts} {name}: {report.nodeid}")
