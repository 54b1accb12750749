"""Work that needs more memory or disk than is free is refused before it begins."""

import math
import os
import resource
import shutil
import subprocess
import sys
from collections import namedtuple
from types import SimpleNamespace

import pytest

from capture.plan.dome import dome_plan
from capture.rig import load_rig
from reconstruction.pipeline.inputs import DomeOptions
from skinrig.cli import main
from skinrig.errors import EXIT_BAD_INPUT, UnusableError
from skinrig.resources import forecast as resources
from skinrig.resources.forecast import ResourceForecast
from skinrig.resources.free_memory import FreeMemory, read_free_memory
from skinrig.studies import reconstruction, study
from skinrig.studies.description import CaseSize
from skinrig.studies.reconstruction import ReconstructionOrder

Usage = namedtuple("Usage", "total used free")
LIMIT_BYTES = 2 * 10**9
STATUS = "Name:\tskinrig\nVmRSS:\t  100000 kB\n"
MEMINFO = "MemTotal: 8000000 kB\nMemAvailable: 4000000 kB\nSwapFree: 1000000 kB\n"


@pytest.fixture
def kernel(tmp_path):
    """Return folders like the kernel's, with 5.12 GB free on the machine and 0.1 GB in use."""
    process = tmp_path / "proc"
    (process / "self").mkdir(parents=True)
    (process / "self/status").write_text(STATUS)
    (process / "meminfo").write_text(MEMINFO)
    groups = tmp_path / "cgroup"
    groups.mkdir()
    return process, groups


def limit_group(folder, names, limit, used, dropped):
    folder.mkdir(parents=True)
    for name, number in zip(names, (limit, used), strict=True):
        (folder / name).write_text(f"{number}\n")
    (folder / "memory.stat").write_text(
        f"anon 5\ninactive_file {dropped}\ntotal_inactive_file {dropped}\n"
    )


VERSION_2 = ("memory.max", "memory.current")
VERSION_1 = ("memory.limit_in_bytes", "memory.usage_in_bytes")


def test_machine_without_groups_limits_memory(kernel):
    free = read_free_memory(*kernel)
    assert free.memory_mb == pytest.approx(5120.0 + 102.4)
    assert free.source == "machine"


@pytest.mark.parametrize(
    ("line", "folder", "names"),
    [("0::/user/job", "user/job", VERSION_2), ("4:memory:/user/job", "memory/user", VERSION_1)],
)
def test_control_group_limits_memory(kernel, line, folder, names):
    process, groups = kernel
    (process / "self/cgroup").write_text(f"9:name=systemd:/\n{line}\n")
    limit_group(groups / folder, names, 3 * 10**9, 2 * 10**9, 5 * 10**8)
    free = read_free_memory(process, groups)
    assert free.memory_mb == pytest.approx(1500.0 + 102.4)
    assert free.source == "control group"


@pytest.mark.parametrize("limit", ["max", 2**63 - 4096])
def test_group_without_limit_limits_nothing(kernel, limit):
    process, groups = kernel
    (process / "self/cgroup").write_text("0::/job\n")
    limit_group(groups / "job", VERSION_2, limit, 10**9, 0)
    assert read_free_memory(process, groups).source == "machine"


def test_variable_replaces_free_memory(monkeypatch):
    monkeypatch.setenv(resources.MEMORY_VARIABLE, "1.5")
    assert read_free_memory().memory_mb == 1500.0


@pytest.mark.parametrize("text", ["0", "-1", "much", "nan"])
def test_unusable_variable_is_refused(text, monkeypatch):
    monkeypatch.setenv(resources.MEMORY_VARIABLE, text)
    with pytest.raises(UnusableError, match=f"got '{text}', expected GB above 0"):
        read_free_memory()


def test_kernel_without_files_limits_nothing(tmp_path):
    assert read_free_memory(tmp_path / "a", tmp_path / "b").memory_mb == math.inf


@pytest.fixture
def free(monkeypatch):
    def set_free(memory_mb, space_mb=math.inf):
        found = FreeMemory(memory_mb, "machine", space_mb)
        monkeypatch.setattr(resources, "read_free_memory", lambda: found)

    return set_free


def refuse_scene(*_, **__):
    raise AssertionError("work began before the check")


COMMANDS = {
    "simulate": ["simulate", "flash", "--width", "4000"],
    "dome": ["simulate", "dome", "--scale", "full"],
    "sequence": ["simulate", "flash", "--width", "4000", "--sequence", "exercise"],
    "demo": ["demo"],
    "bench": ["bench"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_lack_of_memory_is_refused_first(name, tmp_path, free, monkeypatch, capsys):
    for begun in ("rigsim.population.files.load_subject", "skinrig.demo._make_room"):
        monkeypatch.setattr(begun, refuse_scene)
    free(100.0)
    assert main([*COMMANDS[name], "--out", str(tmp_path / "out")]) == EXIT_BAD_INPUT
    said = capsys.readouterr().err.splitlines()[-1]
    assert "0.1 GB free (machine); nothing was computed" in said
    assert said.endswith("[SR-CLI-016]")
    assert list(tmp_path.iterdir()) == []


def test_refusal_names_width_that_fits(tmp_path, free, capsys):
    whole, half = (
        resources.forecast_resources("simulate flash", {"camera_mp": n * 10.7, "frame_mp": n * 64})
        for n in (1.0, 0.25)
    )
    free((whole.memory_mb + half.memory_mb) / 2)
    argv = ["simulate", "flash", "--width", "4000", "--out", str(tmp_path / "out")]
    assert main(argv) == EXIT_BAD_INPUT
    assert "--width 2000 needs" in capsys.readouterr().err


def test_lack_of_addresses_is_refused(free, tmp_path):
    free(math.inf, 2000.0)
    need = ResourceForecast(1000.0, 2001.0, 0.0)
    with pytest.raises(UnusableError, match=r"2 GB of addresses, 2 GB allowed \(ulimit -v\)"):
        resources.require_resources("work", need, tmp_path)


def test_lack_of_disk_is_refused(free, tmp_path, monkeypatch):
    free(math.inf)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(9, 9, 999_000_000))
    need = ResourceForecast(0.0, 0.0, 1000.0)
    with pytest.raises(UnusableError, match="writes about 1 GB, 1 GB free"):
        resources.require_resources("work", need, tmp_path / "new" / "out")
    resources.require_resources("work", ResourceForecast(0.0, 0.0, 998.0), tmp_path)


def test_fewer_processes_are_advised(free, tmp_path):
    tasks = [resources.Task("reconstruct flash", {"camera_mp": n}) for n in (0.1, 10.0)]
    one = resources.forecast_resources(tasks[1].work, tasks[1].amounts)
    free(2.5 * one.memory_mb)
    with pytest.raises(UnusableError, match="--executor local:2 needs"):
        resources.require_resources_of_tasks(tasks, tmp_path, processes=4, outputs=2)
    resources.require_resources_of_tasks(tasks, tmp_path, processes=2, outputs=2)
    resources.require_resources_of_tasks(tasks, tmp_path, processes=0, outputs=2)


def test_export_without_memory_is_refused_first(tmp_path, free, capsys):
    free(10.0)
    assert main(["export", str(tmp_path), "--to", "maps", "--out", str(tmp_path / "x")]) == 3
    assert "export --to maps needs about" in capsys.readouterr().err


def test_full_dome_needs_no_more_than_files_keep():
    """Samples above 1 GiB go to files: 5,000 frames need hardly more memory than 300."""
    few, many = (
        resources.forecast_resources("reconstruct dome", {"frame_mp": frames * 1.34})
        for frames in (300, 5000)
    )
    assert many.memory_mb == pytest.approx(3080.0)
    assert many.memory_mb == few.memory_mb
    assert many.disk_mb > 10 * few.disk_mb


def test_reconstruction_without_memory_is_refused_first(tmp_path, free, monkeypatch):
    rig = load_rig("dome")
    opened = SimpleNamespace(manifest=SimpleNamespace(extra={}), rig=rig, plan=dome_plan(rig))
    monkeypatch.setattr(reconstruction.Session, "open", lambda path: opened)
    monkeypatch.setattr(reconstruction, "reconstruct_session", refuse_scene)
    order = ReconstructionOrder(
        session=tmp_path / "s",
        want=("normals",),
        out=tmp_path / "out",
        calibration=None,
        state="neutral",
        landmarks=None,
        truth="",
        dome=DomeOptions(),
    )
    free(1000.0)
    with pytest.raises(UnusableError, match="reconstruct dome needs about"):
        next(reconstruction.reconstruct_sessions([order], executor="threads", progress=print))


def test_study_without_memory_is_refused_first(tmp_path, free):
    cases = [SimpleNamespace(rig="dome", size=CaseSize(width_px=width)) for width in (96, 640)]
    free(2000.0)
    with pytest.raises(UnusableError, match="dome in 4 processes needs about"):
        study._require_room(cases, "local:4", tmp_path)
    study._require_room(cases[:1], "threads", tmp_path)


def limit_addresses():
    resource.setrlimit(resource.RLIMIT_AS, (LIMIT_BYTES, LIMIT_BYTES))


@pytest.mark.long
@pytest.mark.parametrize("forecast", [True, False])
def test_limit_of_addresses_gives_one_error(forecast, tmp_path):
    """Without the forecast the work begins, and the allocation that fails ends it alike."""
    code = "import sys; from skinrig import cli; from skinrig.resources import forecast; "
    if not forecast:
        code += "forecast.ResourceForecast.fits = lambda self, free: True; "
    argv = ["simulate", "flash", "--width", "6000", "--out", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-c", f"{code}sys.exit(cli.main(sys.argv[1:]))", *argv],
        preexec_fn=limit_addresses,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == EXIT_BAD_INPUT
    assert "Traceback" not in done.stderr
    last = done.stderr.splitlines()[-1]
    assert last.endswith("[SR-CLI-016]" if forecast else "[SR-CLI-015]")
    if forecast:
        assert list(tmp_path.iterdir()) == []
