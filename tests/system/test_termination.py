"""Ended commands: exit code 130, and neither a temporary folder nor a process is left."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from skinrig import demo, errors

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


def list_children(pid):
    """Return the processes that a process has started."""
    try:
        return [int(n) for n in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except OSError:
        return []


def is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def is_worker(pid):
    try:
        return b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes()
    except OSError:
        return False


ENDINGS = {
    "first child killed": (0, signal.SIGKILL, errors.EXIT_BAD_INPUT, "ended by the system"),
    "last child killed": (-1, signal.SIGKILL, errors.EXIT_BAD_INPUT, "ended by the system"),
    "terminated": (None, signal.SIGTERM, errors.EXIT_INTERRUPTED, "interrupted"),
    "killed": (None, signal.SIGKILL, -signal.SIGKILL, ""),
}


@pytest.mark.long
@pytest.mark.parametrize("ending", ENDINGS)
def test_ended_demo_leaves_no_process(ending, tmp_path):
    who, number, code, text = ENDINGS[ending]
    temporary = tmp_path / "tmp"
    temporary.mkdir()
    argv = ["demo", "--rigs", "flash,probe", "--out", str(tmp_path / "demo")]
    with subprocess.Popen(
        [sys.executable, "-m", "skinrig", *argv],
        env={**os.environ, "TMPDIR": str(temporary)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        last_s = time.monotonic() + TIMEOUT_S
        while len(workers := [*filter(is_worker, list_children(process.pid))]) < 2:
            assert process.poll() is None
            assert time.monotonic() < last_s
            time.sleep(0.02)
        children = list_children(process.pid)
        os.kill(process.pid if who is None else workers[who], number)
        _, said = process.communicate(timeout=TIMEOUT_S)
    assert process.returncode == code
    assert text in said
    assert "Traceback" not in said
    last_s = time.monotonic() + TIMEOUT_S
    while any(map(is_alive, children)) and time.monotonic() < last_s:
        time.sleep(0.05)
    assert not [pid for pid in children if is_alive(pid)]
    if ending != "killed":
        assert list(temporary.iterdir()) == []


def test_signal_to_other_thread_waits_for_block():
    """A thread that does not block signals receives them for the process."""
    lines, ended = [], threading.Event()
    thread = threading.Thread(target=ended.wait)
    thread.start()
    before = signal.getsignal(signal.SIGINT)

    def interrupt():
        with demo._delayed_signals():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
            lines.append("end of the block")
        lines.append("the signal was lost")

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    ended.set()
    thread.join()
    assert lines == ["end of the block"]
    assert signal.getsignal(signal.SIGINT) is before


def test_lack_of_memory_is_not_a_defect():
    error = MemoryError("Unable to allocate 9.00 GiB")
    assert errors.exit_code(error) == errors.EXIT_BAD_INPUT
    assert "9.00 GiB" in errors.format_error(error)
    assert "smaller size [SR-CLI-015]" in errors.format_error(MemoryError())
