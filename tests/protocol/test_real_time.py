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


def test_of_a_lease(bench):
    if {stands_still}:
        ctypes.PyDLL(None).usleep(250_000)
    assert next(TIMES) == {passes_at}
"""


@pytest.mark.parametrize(
    ("line", "stands_still", "passes_at", "passed"),
    [
        ("tcp", True, 3, True),
        ("pty", True, 1, True),
        ("tcp", True, 6, False),  # not for ever
        ("tcp", False, 2, True),
        ("sim", True, 2, False),  # virtual time does not run on
    ],
)
def test_failure_during_machine_stall_is_retried(line, stands_still, passes_at, passed, tmp_path):
    run = trial(tmp_path, line=line, stands_still=stands_still, passes_at=passes_at)
    assert run.returncode == (0 if passed else 1), run.stdout
    assert ("1 passed" if passed else "1 failed") in run.stdout
    repeated = f"{passes_at} attempts on a real line"
    assert (repeated in run.stdout) is (passed and passes_at > 1)


def test_failure_reports_duration_of_machine_stall(tmp_path):
    """Whether it does in a test that is quick is chance: what never passes fails in any case."""
    run = trial(tmp_path, line="pty", stands_still=False, passes_at=0)
    assert run.returncode == 1, run.stdout
    assert "nothing ran for up to" in run.stdout
    assert "1 failed" in run.stdout


def trial(tmp_path, **given):
    hook = (Path(__file__).parents[1] / "real_time.py").read_text("utf-8")
    (tmp_path / "conftest.py").write_text(hook, encoding="utf-8")
    (tmp_path / "test_trial.py").write_text(TRIAL.format(**given), encoding="utf-8")
    return subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "-c",
            os.devnull,
            "--rootdir",
            str(tmp_path),
            str(tmp_path),
        ],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
    )
