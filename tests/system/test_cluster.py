"""Studies on real Dask schedulers and workers that are killed and stopped: same bytes as serial."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import psutil
import pytest
import tifffile
from fixtures.faulty_stacks import dome, render
from fixtures.product_code import ROOT
from fixtures.study_judge import HELD_FILE, PAUSE_VARIABLE, judge_by_drawing

from skinrig.cli import main
from skinrig.studies.description import CaseGroup, StudyFile
from skinrig.studies.executors import ExecutorLost
from skinrig.studies.study import run_study

pytestmark = pytest.mark.long
pytest.importorskip("distributed")

CASES = 24
PAUSE_S = 0.4
STOPPED_S = 20.0
START_S = 120.0
"""Longest start of a process on a machine with other work."""


def study():
    subjects = ("I", "II", "III", "IV", "V", "VI")
    group = CaseGroup(rig="flash", subjects=subjects, seeds=f"0..{CASES - 1}")
    return StudyFile(schema="skinrig.study/1", title="Cases", groups=(group,))


def results(out):
    records = sorted((out / "cases").iterdir())
    files = [out / "study.csv", out / "study.json", out / "report.html", *records]
    return {path.name: path.read_bytes() for path in files}


@contextmanager
def process(*words):
    """Run a Dask process; SIGTERM ends it and its children."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "tests"))),
        PAUSE_VARIABLE: str(PAUSE_S),
    }
    run = subprocess.Popen(
        [sys.executable, "-m", "dask", *words],
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield run
    finally:
        run.terminate()
        try:
            run.wait(20)
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            run.wait()
        run.stderr.close()


def first_match(run, pattern):
    """Return a group of the first line of a process's log that matches; the rest is read away."""
    for line in run.stderr:
        if found := re.search(pattern, line):
            threading.Thread(target=lambda: [None for _ in run.stderr], daemon=True).start()
            return found[1]
    raise AssertionError(f"ended without {pattern}")


@contextmanager
def cluster(folder, workers):
    """Yield a scheduler's process and address, with workers below nannies."""
    with process("scheduler", "--port", "0", "--host", "127.0.0.1", "--no-dashboard") as scheduler:
        address = first_match(scheduler, r"Scheduler at: +(tcp://\S+)")
        more = ("--nworkers", str(workers), "--nthreads", "1", "--no-dashboard")
        with process("worker", address, *more, "--local-directory", str(folder)):
            yield scheduler, address


def wait_for_files(folder, pattern, count):
    """Return the files of a pattern once there are `count`."""
    end_s = time.monotonic() + START_S
    while time.monotonic() < end_s:
        files = list(folder.glob(pattern))
        if len(files) >= count:
            return files
        time.sleep(0.05)
    raise AssertionError(f"{folder}: got {len(files)} files {pattern}, expected {count}")


def wait_for_pids(out, count):
    """Return the process ids of workers once `count` have begun a case."""
    return [int(path.name.removeprefix("pid-")) for path in wait_for_files(out, "pid-*", count)]


class Strike(threading.Thread):
    """Call a function with the workers' process ids once `count` of them have begun a case."""

    def __init__(self, out, count, strike):
        super().__init__(daemon=True)
        self.out, self.count, self.strike = out, count, strike
        self.start()

    def run(self):
        self.strike(wait_for_pids(self.out, self.count))


def kill_one_and_stop_another(pids):
    os.kill(pids[0], signal.SIGKILL)
    os.kill(pids[1], signal.SIGSTOP)
    time.sleep(STOPPED_S)
    os.kill(pids[1], signal.SIGCONT)


@pytest.fixture(scope="module")
def serial(tmp_path_factory):
    out = tmp_path_factory.mktemp("serial")
    run_study(study(), out, judge=judge_by_drawing)
    return results(out)


def test_killed_and_stopped_workers_change_nothing(tmp_path, serial):
    out = tmp_path / "out"
    out.mkdir()
    (out / HELD_FILE).touch()

    def strike_until_restarted(pids):
        kill_one_and_stop_another(pids)
        wait_for_pids(out, 5)  # the nanny restarted the killed one
        (out / HELD_FILE).unlink()

    with cluster(tmp_path, workers=4) as (_, address):
        strike = Strike(out, 3, strike_until_restarted)
        run = run_study(study(), out, executor=address, judge=judge_by_drawing)
        strike.join()
    assert (run.ran, run.errors) == (CASES, {})
    assert results(out) == serial


def test_killed_scheduler_loses_no_completed_case(tmp_path, serial):
    out = tmp_path / "out"
    with cluster(tmp_path, workers=2) as (scheduler, address):

        def kill_after_some_records(_pids):
            wait_for_files(out / "cases", "*.json", 4)
            scheduler.kill()

        strike = Strike(out, 1, kill_after_some_records)
        with pytest.raises(ExecutorLost, match=r"of 24 cases are complete: start a scheduler"):
            run_study(study(), out, executor=address, judge=judge_by_drawing)
        strike.join()
    complete = len(list((out / "cases").glob("*.json")))
    assert 4 <= complete < CASES
    assert not (out / "study.csv").exists()
    run = run_study(study(), out, judge=judge_by_drawing)
    assert run.ran == CASES - complete
    assert results(out) == serial


def test_missing_scheduler_is_one_error(tmp_path):
    with pytest.raises(ExecutorLost, match="no scheduler at"):
        run_study(study(), tmp_path, executor="tcp://127.0.0.1:9", judge=judge_by_drawing)


@pytest.fixture(scope="module")
def stacks(tmp_path_factory):
    """Two sessions of images of a sphere under listed lights."""
    place = tmp_path_factory.mktemp("stacks")
    for seed in (1, 2):
        folder = place / f"images-{seed}"
        folder.mkdir()
        rng = np.random.default_rng(seed)
        lights = dome(12, rng, 60)
        images, _ = render("ball", lights, rng, side=48, gloss=0.2, noise=0.005)
        rows = [str(len(lights))]
        for number, (image, light) in enumerate(zip(images, lights, strict=True)):
            tifffile.imwrite(folder / f"{number:02d}.tif", image.astype(np.float32))
            rows.append(f"{number:02d}.tif {' '.join(map(str, light))}")
        (folder / "lights.lp").write_text("\n".join(rows), encoding="utf-8")
        assert main(["import", "olat", str(folder), "--out", str(place / f"session-{seed}")]) == 0
    return [place / f"session-{seed}" for seed in (1, 2)]


def arguments(sessions, out, executor):
    words = ["--maps", "normals", "--out", str(out), "--executor", executor]
    return ["reconstruct", *map(str, sessions), *words]


def test_sessions_on_workers_give_same_maps(stacks, tmp_path):
    """All load their kernels from the cache, which the first run fills."""
    for name in ("filling", "a"):
        words = arguments(stacks, tmp_path / name, "threads")
        subprocess.run([sys.executable, "-m", "skinrig", *words], check=True)
    assert main(arguments(stacks, tmp_path / "b", "local:2")) == 0
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*")]
    assert len(files) > 4
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes(), file


def kill_workers_of(command, out):
    """Kill the worker processes of a command once a session has begun; return how many."""
    end_s = time.monotonic() + 3.0 * START_S  # of the command, its workers, and their libraries
    while not list(out.glob(".*.work")):
        assert time.monotonic() < end_s, "no session has begun"
        assert command.poll() is None, "the command ended before a session had begun"
        time.sleep(0.002)
    complete = len(list(out.glob("*/appearance.json")))
    children = psutil.Process(command.pid).children(recursive=True)
    workers = [one for one in children if "spawn_main" in " ".join(one.cmdline())]
    for one in workers:
        one.kill()
    return len(workers), complete


@pytest.mark.timeout(900)
def test_killed_workers_of_reconstruction_change_nothing(stacks, tmp_path):
    """Nannies restart the workers, which take the sessions up; later commands reuse the maps."""
    subprocess.run(
        [sys.executable, "-m", "skinrig", *arguments(stacks, tmp_path / "a", "threads")], check=True
    )
    out = tmp_path / "b"
    out.mkdir()
    words = [sys.executable, "-m", "skinrig", *arguments(stacks, out, "local:2")]
    with subprocess.Popen(words, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL) as command:
        killed, complete = kill_workers_of(command, out)
        _, errors = command.communicate(timeout=400)
    assert killed == 2
    assert complete < len(stacks)
    assert command.returncode == 0, errors.decode()
    assert b"Traceback" not in errors
    files = [path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*")]
    assert len(files) > 4
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (out / file).read_bytes(), file
    assert not list(out.glob(".*"))


def test_error_of_worker_is_that_of_serial_run(stacks, tmp_path, capsys):
    words = []
    for executor in ("threads", "local:1"):
        damaged = tmp_path / "session"
        damaged.mkdir(exist_ok=True)
        assert main(arguments([damaged, *stacks], tmp_path / executor[:5], executor)) == 3
        words.append(capsys.readouterr().err.splitlines()[-1])
    assert words[0] == words[1]
