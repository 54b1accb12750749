"""Work that needs more memory or disk than is free is refused before it begins."""

import functools
import itertools
import math
import os
import resource
import shutil
import subprocess
import sys
from collections import namedtuple
from types import SimpleNamespace

import pytest
from fixtures.study_judge import judge_by_drawing

from capture.plan.dome import dome_plan
from capture.plan.gradient import gradient_plan
from capture.rig import load_rig
from capture.session import Session
from model import store
from model.skin import SkinAppearance
from reconstruction.pipeline.inputs import DomeOptions
from skinrig import demo
from skinrig.cli import main
from skinrig.errors import EXIT_BAD_INPUT, UnusableError
from skinrig.resources import forecast as resources
from skinrig.resources.forecast import ResourceForecast
from skinrig.resources.free_memory import FreeMemory, read_free_memory
from skinrig.simulating.simulation import simulate_session
from skinrig.studies import reconstruction
from skinrig.studies.description import CaseGroup, CaseSize, StudyFile
from skinrig.studies.reconstruction import ReconstructionOrder
from skinrig.studies.study import run_study

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
        f"anon 5\nactive_file {dropped // 4}\ninactive_file {dropped - dropped // 4}\n"
        f"total_active_file {dropped // 4}\ntotal_inactive_file {dropped - dropped // 4}\n"
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


@pytest.mark.parametrize("text", ["", "anon 5\n\n", "inactive_file\n", "active_file x\n"])
def test_unknown_statistics_raise_nothing(kernel, text):
    process, groups = kernel
    (process / "self/cgroup").write_text("0::/job\n")
    limit_group(groups / "job", VERSION_2, 10**9, 10**8, 0)
    (groups / "job/memory.stat").write_text(text)
    assert read_free_memory(process, groups).source == ("machine" if text else "control group")


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


@pytest.mark.parametrize(("disk_mb", "text"), [(-300.0, "0"), (300.0, "0.3")])
def test_disk_of_session_with_files_is_positive(tmp_path, disk_mb, text):
    """A resumed session may have more files than the forecast counts."""
    need = ResourceForecast(1.0, 1.0, disk_mb)
    assert resources.describe_disk(need, tmp_path) == f"disk: about {text} GB"


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
    jobs = [[resources.Task("reconstruct flash", {"camera_mp": n})] for n in (0.1, 10.0, 9.9)]
    one = resources.forecast_resources("reconstruct flash", {"camera_mp": 10.0})
    free(2.1 * one.memory_mb)
    with pytest.raises(UnusableError, match="--executor local:2 needs"):
        resources.require_resources_of_jobs(jobs, tmp_path, processes=4)
    resources.require_resources_of_jobs(jobs, tmp_path, processes=2)
    resources.require_resources_of_jobs(jobs, tmp_path, processes=0)
    resources.require_resources_of_jobs(jobs[:2], tmp_path, processes=4)


def test_disk_is_that_of_outputs(free, tmp_path, monkeypatch):
    """An output of 1.1 GB and eleven of 11 MB fit into 1.5 GB, two large ones do not."""
    free(math.inf)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(9, 9, 1_500_000_000))
    small = [resources.Task("reconstruct flash", {"camera_mp": 1.0})]
    jobs = [[resources.Task("reconstruct flash", {"camera_mp": 100.0})], *[small] * 11]
    resources.require_resources_of_jobs(jobs, tmp_path, processes=1)
    with pytest.raises(UnusableError, match=r"writes about 2\.3 GB"):
        resources.require_resources_of_jobs([jobs[0], *jobs], tmp_path, processes=1)
    resources.require_resources_of_jobs([jobs[0], *jobs], tmp_path, processes=1, outputs=1)
    resources.require_resources_of_jobs([jobs[0], *jobs], tmp_path, processes=1, held_mb=1000.0)


def test_export_without_memory_is_refused_first(tmp_path, free, capsys):
    free(10.0)
    assert main(["export", str(tmp_path), "--to", "maps", "--out", str(tmp_path / "x")]) == 3
    assert "export --to maps needs about" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("work", "few", "many", "memory_mb"),
    [
        ("reconstruct dome", {"frame_mp": 400.0}, {"frame_mp": 6700.0}, 3080.0),
        ("simulate dome", {"frame_mp": 400.0}, {"frame_mp": 6700.0}, 1870.0),
        ("simulate flash", {"frame_mp": 1.0}, {"frame_mp": 100.0}, 493.0),
        ("simulate gradient", {"frame_mp": 60.0}, {"frame_mp": 3498.0}, 913.0),
    ],
)
def test_bounded_caches_bound_forecasts(work, few, many, memory_mb):
    first, second = (resources.forecast_resources(work, amounts) for amounts in (few, many))
    assert first.memory_mb == second.memory_mb == pytest.approx(memory_mb)
    assert second.disk_mb > 1.5 * first.disk_mb


def test_forecast_counts_captured_states_of_caliper():
    rig = load_rig("gradient").resized(64)
    plan = gradient_plan(rig, angles=(0.0, 90.0))
    whole = resources.count_megapixels(rig, plan)
    pixels = whole["camera_mp"]
    states = {
        (step.index.get("angle"), step.index["caliper"])
        for step in plan.steps
        if "caliper" in step.index
    }
    assert whole["state_mp"] == pytest.approx(len(states) * pixels)
    lost = {step.id for step in plan.steps if step.index.get("angle") == 90}
    some = resources.count_megapixels(rig, plan, lost)
    assert 0.0 < some["state_mp"] < whole["state_mp"]
    assert some["camera_mp"] == pixels
    one, two = (
        resources.forecast_resources("simulate gradient", sizes).memory_mb
        for sizes in (some, whole)
    )
    assert two > one


def test_bound_of_frames_leaves_cameras():
    one, two = (
        resources.forecast_resources("simulate gradient", {"camera_mp": n, "frame_mp": 3498.0})
        for n in (1.0, 2.0)
    )
    assert two.memory_mb == pytest.approx(one.memory_mb + 859.0)


def test_demo_falls_back_to_one_process(tmp_path, free):
    """The width of the dome's demo is bounded, and so is its forecast."""
    out = tmp_path / "demo"
    free(math.inf)
    assert demo._require_resources(["dome", "probe"], out, None, 2) == 2
    free(1500.0)
    assert demo._require_resources(["dome", "probe"], out, 4000, 2) == 1
    free(1000.0)
    with pytest.raises(UnusableError, match="reconstruct dome needs about"):
        demo._require_resources(["dome", "probe"], out, None, 2)


def test_earlier_demo_leaves_its_disk(tmp_path, free, monkeypatch):
    free(math.inf)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(9, 9, 10_000_000))
    (tmp_path / "session").write_bytes(bytes(20_000_000))
    with pytest.raises(UnusableError, match="writes about"):
        demo._require_resources(["probe"], tmp_path, None, 1)
    (tmp_path / demo.MARK_NAME).touch()
    demo._require_resources(["probe"], tmp_path, None, 1)


def test_reconstruction_without_memory_is_refused_first(tmp_path, free, monkeypatch):
    rig = load_rig("dome")
    opened = SimpleNamespace(
        manifest=SimpleNamespace(extra={}),
        rig=rig,
        plan=dome_plan(rig),
        content_hash="sha256:0",
        omitted_steps=dict,
    )
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
    run = functools.partial(reconstruction.reconstruct_sessions, executor="threads", progress=print)
    with pytest.raises(UnusableError, match="reconstruct dome needs about"):
        next(run([order]))
    inputs = {"session": opened.content_hash}
    missing = (("normals", "too dark"),)
    store.write(order.out, SkinAppearance({}, source="simulated", inputs=inputs, left_out=missing))
    with pytest.raises(AssertionError, match="work began"):
        next(run([order]))
    opened.content_hash = "sha256:1"
    with pytest.raises(UnusableError, match="reconstruct dome needs about"):
        next(run([order]))


def test_study_without_memory_is_refused_first(tmp_path, free):
    group = CaseGroup(rig="flash", subjects=("I",), seeds="1..4", sizes=(CaseSize(width_px=64),))
    cases = StudyFile(schema="skinrig.study/1", title="Some cases", groups=(group,))
    free(600.0)
    with pytest.raises(UnusableError, match="flash in 4 processes needs about"):
        run_study(cases, tmp_path, executor="local:4", judge=refuse_scene)
    free(1000.0)
    run_study(cases, tmp_path, judge=judge_by_drawing)
    free(100.0)
    again = run_study(cases, tmp_path, executor="local:4", judge=refuse_scene)
    assert (again.ran, len(again.quantities)) == (0, 4)


def test_nearly_complete_session_resumes(tmp_path, free, monkeypatch):
    """Frames on the disk need no more room; a complete session needs none."""
    out = tmp_path / "s"
    order = {"target": "white", "width_px": 48}
    commit, numbers = Session.commit_step, itertools.count()

    def commit_some(self, *args, **more):
        if next(numbers) == 4:
            raise KeyboardInterrupt
        return commit(self, *args, **more)

    monkeypatch.setattr(Session, "commit_step", commit_some)
    with pytest.raises(KeyboardInterrupt):
        simulate_session("flash", out, **order)
    (out / "frames/more.bin").write_bytes(bytes(4_000_000))
    free(math.inf)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(9, 9, 100_000))
    with pytest.raises(UnusableError, match="writes about"):
        simulate_session("flash", tmp_path / "new", **order)
    simulate_session("flash", out, resume=True, **order)
    free(1.0)
    assert simulate_session("flash", out, resume=True, **order).frames > 4


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
