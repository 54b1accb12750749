"""Interrupted and terminated commands: exit code 130, and no temporary folder is left."""

import os
import signal
import subprocess
import sys
import time

import pytest

from skinrig import errors

TIMEOUT_S = 120.0


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_ended_command_leaves_no_temporary_folder(tmp_path, number):
    command = [sys.executable, "-m", "skinrig", "soak", "--hours", "100000"]
    with subprocess.Popen(
        command,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        # background jobs of a shell start with SIGINT ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        last_s = time.monotonic() + TIMEOUT_S
        while not any(tmp_path.glob("skinrig-soak-*/s/frames/*")):
            assert process.poll() is None
            assert time.monotonic() < last_s
            time.sleep(0.02)
        process.send_signal(number)
        _, said = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == errors.EXIT_INTERRUPTED
    assert "interrupted" in said
    assert "Traceback" not in said
    assert list(tmp_path.iterdir()) == []


def test_lack_of_memory_is_not_a_defect():
    error = MemoryError("Unable to allocate 9.00 GiB")
    assert errors.exit_code(error) == errors.EXIT_BAD_INPUT
    assert "9.00 GiB" in errors.format_error(error)
    assert "smaller size [SR-CLI-015]" in errors.format_error(MemoryError())
