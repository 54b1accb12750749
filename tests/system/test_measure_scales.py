"""The tool that runs a rig at the scale of its paper: its commands exist, its table is right."""

import importlib.util
from pathlib import Path

import pytest
import typer

from skinrig.cli import app

PATH = Path(__file__).parents[2] / "tools/measure_scales.py"


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("measure_scales", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("rig", ["flash", "dome", "gradient", "probe"])
def test_every_step_is_a_command(tool, rig):
    root = typer.main.get_command(app)
    for scale in ("small", "half", "full"):
        for name, words in tool.list_steps(rig, scale, 0):
            command, left = root, list(words)
            while hasattr(command, "commands"):
                command = command.commands[left.pop(0)]
            assert command.make_context(name, left).params


def test_failing_step_names_its_log(tool, tmp_path, monkeypatch):
    monkeypatch.setattr(tool, "list_steps", lambda *_: [("verify", ["verify", "absent"])])
    with pytest.raises(SystemExit, match=r"verify: exit code 3, see .*verify\.txt"):
        tool.run("probe", "small", 0, tmp_path / "run")
    (tmp_path / "run/scale.json").write_text('{"rig": "dome", "scale": "small", "seed": 0}')
    with pytest.raises(SystemExit, match="another rig, scale or seed"):
        tool.run("probe", "small", 0, tmp_path / "run")


def record(scale, frame_mp, processor_s):
    step = {"seconds": processor_s / 2, "processor_s": processor_s, "peak_mb": 300.0}
    return {
        "rig": "dome",
        "scale": scale,
        "frames": 10,
        "frame_mp": frame_mp,
        "disk_mb": 1500.0,
        "steps": {"capture": step},
        "errors": [["normals", 1.25, "deg", 0.69]],
    }


def test_exponent_is_that_of_the_largest_scales(tool):
    """Ten times the pixels, a hundred times the time: exponent 2."""
    lines = list(tool.tabulate([record("full", 100.0, 400.0), record("small", 10.0, 4.0)]))
    assert lines[2] == "| step | small: s; processor s; MB | full: s; processor s; MB | exponent |"
    assert lines[4] == "| capture | 2.0; 4.0; 300 | 200.0; 400.0; 300 | 2.00 |"
    assert "| error of normals; coverage | 1.2 deg; 69 % | 1.2 deg; 69 % |  |" in lines
