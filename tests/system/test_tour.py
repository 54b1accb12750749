"""The tutorials, typed line by line by somebody who has just arrived."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

from skinrig.cli import main
from skinrig.simulating import dome, flash_truth
from skinrig.viewer import faces

ROOT = Path(__file__).parents[2]


TUTORIALS = sorted(path for path in (ROOT / "docs/tutorials").glob("*.md") if path.stem != "index")
each_tutorial = pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)


def commands(page):
    blocks = re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True) for line in lines if line.strip()]


def leaves(words):
    """The file or folder that a command is to write."""
    return next((words[i + 1] for i, word in enumerate(words) if word in ("--out", "-o")), None)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    """Folder of what the lines that simulate left: another tutorial's equal line copies it."""
    return tmp_path_factory.mktemp("simulated")


@pytest.mark.long
@each_tutorial
def test_tutorial_runs_to_its_end(page, tmp_path, simulated, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # smaller than their defaults, which other tests cover
    monkeypatch.setitem(flash_truth.WIDTHS_PX, "small", 160)
    monkeypatch.setitem(dome.WIDTHS_PX, "small", 200)
    monkeypatch.setitem(dome.LIGHT_COUNTS, "small", 21)
    monkeypatch.setitem(dome.VIEW_COUNTS, "small", 5)
    monkeypatch.setattr(faces, "FACE_PX", 128)
    lines = commands(page)
    assert lines
    for words in lines:
        assert words[0] == "skinrig"
        made = simulated / re.sub(r"\W+", "-", shlex.join(words))
        if made.is_dir():
            shutil.copytree(made, tmp_path, dirs_exist_ok=True)
        else:
            before = set(tmp_path.iterdir())
            code = main(words[1:])
            out, err = capsys.readouterr()
            assert code == 0, f"{shlex.join(words)}\n{out}\n{err}"
            if words[1] == "simulate":
                for folder in set(tmp_path.iterdir()) - before:
                    shutil.copytree(folder, made / folder.name)
        if leaves(words):
            assert Path(leaves(words)).exists(), shlex.join(words)


@each_tutorial
def test_tutorial_lines_use_outputs_of_earlier_lines(page):
    made = set()
    for words in commands(page):
        out = leaves(words)
        for word in words[2:]:
            if re.match(r"(session|calibration|appearance|moving|irritated|truth)(-|$)", word):
                known = any(word.startswith(name) for name in made)
                assert known or word == out, (word, words)
        if out:
            made |= {out, f"truth-{out.removeprefix('session-')}"}  # beside its session
