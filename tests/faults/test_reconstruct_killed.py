"""A reconstruction that is killed and repeated ends with the bytes of an undisturbed one.

`tools/judge_resume.py` kills reconstructions of all rigs, and simulations, more often.
"""

import importlib.util
import time
from pathlib import Path

import numpy as np
import pytest

from reconstruction.pipeline import recipes
from skinrig.cli import main

ROOT = Path(__file__).parents[2]
MAPS = ("melanin", "hemoglobin", "diffuse", "specular", "tsumura_melanin")
N_KILLS = 2
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


@pytest.fixture(scope="module")
def command(session):
    return ["reconstruct", str(session), "--maps", ",".join(MAPS)]


@pytest.fixture(scope="module")
def whole(tool, command, tmp_path_factory):
    """Return the seconds of an undisturbed run with its kernels compiled, and its files."""
    out = tmp_path_factory.mktemp("whole")
    for name in ("compile", "judge"):
        begun_s = time.perf_counter()
        assert main([*command, "--out", str(out / name)]) == 0
    return time.perf_counter() - begun_s, tool.hash_outputs(out / name)


def test_killed_reconstruction_ends_with_same_bytes(tool, command, whole, tmp_path):
    out = tmp_path / "out"
    run, rng = [*command, "--out", str(out)], np.random.default_rng(1)
    kills = tool.kill_until_done("flash", run, out, whole=whole, rng=rng, most=N_KILLS)
    assert kills
    assert all(kill.same for kill in kills)
    assert all(kill.interrupted <= 1 for kill in kills)


def test_reconstruct_interrupted_everywhere_ends_with_same_bytes(tool, session, whole, tmp_path):
    """Each run computes one part and takes up all earlier ones from the work folder."""
    out = tmp_path / "out"
    begun, runs = [], 0

    def stop_at_second(text, left_s):
        begun.append(text)
        if len(set(begun) - earlier) > 1:
            raise KeyboardInterrupt

    while not out.exists():
        earlier, runs = set(begun), runs + 1
        try:
            recipes.reconstruct(
                session, want=MAPS, out=out, progress=stop_at_second, truth="truth-session"
            )
        except KeyboardInterrupt:
            assert (tmp_path / ".out.work").is_dir()
    assert runs >= 4
    assert tool.hash_outputs(out) == whole[1]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
