"""Tests on a real line run again where the machine stood still, and once more without a stall."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

# a call into C that keeps the interpreter: no thread of the process runs meanwhile
TRIAL = """
import ctypes
import itertools

import pytest

TIMES = itertools.count(1)


@pytest.fixture(params=["{line}"])
def bench(request):
    yield request.param


def test_{name}(bench):
    if {stands_still}:
        ctypes.PyDLL(None).usleep(250_000)
    assert next(TIMES) == {passes_at}
"""

TRIALS = {
    "stalled_twice": ("tcp", True, 3),
    "stalled": ("pty", True, 1),
    "stalled_for_ever": ("tcp", True, 6),
    "by_chance": ("tcp", False, 2),
    "simulated": ("sim", True, 2),  # virtual time does not run on
    "never": ("pty", False, 0),
}
"""Line, whether the machine stands still, and the attempt that passes."""


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    """What one run of all trials prints."""
    folder = tmp_path_factory.mktemp("trials")
    hook = (Path(__file__).parents[1] / "real_time.py").read_text("utf-8")
    (folder / "conftest.py").write_text(hook, encoding="utf-8")
    for name, (line, stands_still, passes_at) in TRIALS.items():
        text = TRIAL.format(name=name, line=line, stands_still=stands_still, passes_at=passes_at)
        (folder / f"test_{name}.py").write_text(text, encoding="utf-8")
    options = ["-q", "-rA", "-p", "no:cacheprovider", "-c", os.devnull, "--rootdir", str(folder)]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", *options, str(folder)],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
    )
    assert run.returncode == 1, run.stdout
    return run.stdout


@pytest.mark.parametrize(
    ("name", "passed"),
    [
        ("stalled_twice", True),
        ("stalled", True),
        ("stalled_for_ever", False),
        ("by_chance", True),
        ("simulated", False),
    ],
)
def test_failure_during_machine_stall_is_retried(name, passed, output):
    line, _, passes_at = TRIALS[name]
    test = f"test_{name}.py::test_{name}[{line}]"
    assert f"{'PASSED' if passed else 'FAILED'} {test}" in output
    repeated = f"{passes_at} attempts on a real line: {test}"
    assert (repeated in output) is (passed and passes_at > 1)


def test_failure_reports_duration_of_machine_stall(output):
    """Whether it does in a test that is quick is chance: what never passes fails in any case."""
    assert "FAILED test_never.py::test_never[pty]" in output
    section = output.split(" test_never[pty] ")[1].split("\n____")[0]
    assert "nothing ran for up to" in section
