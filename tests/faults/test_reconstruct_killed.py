"""A reconstruction that is killed and repeated ends with the bytes of an undisturbed one.

`SKINRIG_KILLS` sets the number of kills, and `SKINRIG_DEMO` a folder of `skinrig demo`, whose four
rigs and two simulations are then killed in turn.
"""

import importlib.util
import os
from pathlib import Path

import pytest

from reconstruction.pipeline import recipes
from skinrig.cli import main

ROOT = Path(__file__).parents[2]
MAPS = ("melanin", "hemoglobin", "diffuse", "specular", "tsumura_melanin")
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def tool():
    path = ROOT / "tools" / "judge_resume.py"
    spec = importlib.util.spec_from_file_location("judge_resume", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    out = tmp_path_factory.mktemp("killed") / "session"
    quick = ["--width", "96", "--omit", "lateral,interreflections,relief_shadows"]
    assert main(["simulate", "flash", *quick, "--subject", "IV", "--out", str(out)]) == 0
    return out


@pytest.mark.timeout(3600)
def test_commands_killed_at_random_end_with_same_bytes(tool, session, tmp_path, monkeypatch):
    demo = Path(os.environ.get("SKINRIG_DEMO", session.parent))
    names = [*tool.RECONSTRUCTIONS, *tool.SIMULATIONS]
    if demo == session.parent:
        names = ["flash"]
        monkeypatch.setitem(tool.RECONSTRUCTIONS, "flash", (session.name, "", ",".join(MAPS)))
    kills = tool.judge(demo, tmp_path, names, int(os.environ.get("SKINRIG_KILLS", "2")), seed=1)
    assert all(kill.same for kill in kills)
    assert all(kill.interrupted <= 1 for kill in kills)


def test_reconstruct_interrupted_everywhere_ends_with_same_bytes(tool, session, tmp_path):
    """Each run computes one part and takes up all earlier ones from the work folder."""
    whole, out = tmp_path / "whole", tmp_path / "out"
    recipes.reconstruct(session, want=MAPS, out=whole)
    begun, runs = [], 0

    def stop_at_second(text, left_s):
        begun.append(text)
        if len(set(begun) - earlier) > 1:
            raise KeyboardInterrupt

    while not out.exists():
        earlier, runs = set(begun), runs + 1
        try:
            recipes.reconstruct(session, want=MAPS, out=out, progress=stop_at_second)
        except KeyboardInterrupt:
            assert (tmp_path / ".out.work").is_dir()
    assert runs >= 4
    assert tool.hash_folder(out) == tool.hash_folder(whole)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "whole"]
