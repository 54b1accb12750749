"""Cost of starting: libraries that a command loads before its work, and the time it takes.

Each question is asked of a fresh process, since this one has loaded everything already.
"""

import ast
import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from fixtures.product_code import PACKAGES, modules, tree_of

ROOT = Path(__file__).parents[2]
COMMAND = Path(sys.executable).with_name("skinrig")

RENDERERS = ("mitsuba", "drjit")
HEAVY = (
    *RENDERERS,
    "cv2",
    "matplotlib",
    "scipy",
    "numba",
    "skimage",
    "sklearn",
    "colour",
    "OpenEXR",
    "embreex",
    "trimesh",
)
QUICK_S = 0.3
QUICK_HELP_S = 0.5
RUNS = 5
"""Starts until one is quick enough: what else runs on the machine only adds to one."""


def loaded_by(code, candidates=HEAVY):
    """Return which of the libraries a fresh process has loaded after ``code``."""
    tell = (
        f"{code}\nimport sys, json\n"
        f"sys.stderr.write(json.dumps([m for m in {candidates!r} if m in sys.modules]))"
    )
    run = subprocess.run([sys.executable, "-c", tell], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stderr.splitlines()[-1])


def packages(top):
    return [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in sorted((ROOT / top).rglob("*.py"))
    ]


def test_scikit_learn_is_loaded_by_functions_alone():
    """To load it takes 0.4 s, and few commands that load its module factor a matrix."""
    found = [
        path.relative_to(ROOT).as_posix()
        for path in modules(*PACKAGES)
        for node in tree_of(path).body
        if isinstance(node, ast.Import | ast.ImportFrom) and "sklearn" in ast.unparse(node)
    ]
    assert found == []


def test_packages_alone_load_nothing_heavy():
    assert loaded_by("import " + ", ".join(PACKAGES)) == []


def test_capture_and_devices_load_neither_renderer_nor_science():
    """A capture computer drives a rig without libraries of reconstruction and the simulator."""
    every = [
        name for name in packages("capture") if "calibration" not in name and name != "capture.hdr"
    ]
    assert len(every) > 50
    assert loaded_by("import " + ", ".join(every), (*HEAVY, "rigsim")) == []


def test_asking_for_help_loads_no_numerics_at_all():
    """One process asks all in turn: what one of them loaded would still be loaded at the end."""
    asked = [["--version"], ["--help"]]
    asked += [[name, "--help"] for name in ("simulate", "reconstruct", "fit", "render", "bench")]
    code = f"from skinrig.cli import main\nassert [main(a) for a in {asked!r}] == [0] * 7"
    assert loaded_by(code, (*HEAVY, "numpy", "capture", "model")) == []


def test_a_heavy_import_would_be_found():
    assert loaded_by("import skinrig.cli, scipy.ndimage") == ["scipy"]


def starts_within(limit_s, arguments, runs=RUNS):
    """Return whether a start takes less processor time than the limit, s, in so many runs."""
    for _ in range(runs):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        run = subprocess.run([COMMAND, *arguments], cwd=ROOT, capture_output=True, text=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        assert run.returncode == 0, run.stderr
        if after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < limit_s:
            return True
    return False


@pytest.mark.skipif(not COMMAND.exists(), reason="the command is not installed beside Python")
def test_version_is_printed_within_third_of_second():
    """Rationale: people and shells ask often. Expected: 0.13 s on a quiet core. Tolerance: the
    requirement.

    Starting with NumPy takes 0.25 s or more, and with SciPy or a renderer a second.
    """
    assert starts_within(QUICK_S, ["--version"])


@pytest.mark.skipif(not COMMAND.exists(), reason="the command is not installed beside Python")
@pytest.mark.parametrize("command", ["", "simulate flash", "reconstruct", "report", "view"])
def test_help_is_printed_within_half_second(command):
    """Tolerance: the requirement; a quiet core takes .2 to .3 s."""
    assert starts_within(QUICK_HELP_S, [*command.split(), "--help"])


@pytest.mark.skipif(not COMMAND.exists(), reason="the command is not installed beside Python")
def test_a_slow_start_would_be_found(tmp_path, monkeypatch):
    waste = "import time\nend = time.process_time() + 0.3\nwhile time.process_time() < end: pass\n"
    (tmp_path / "sitecustomize.py").write_text(waste)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert not starts_within(QUICK_S, ["--version"], runs=1)
