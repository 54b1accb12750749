"""The README's tour, typed line by line by somebody who has just arrived."""

import re
import shlex
from pathlib import Path

import pytest

from skinrig.cli import main

ROOT = Path(__file__).parents[2]


def tour():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    section = text.split("## A tour of five minutes")[1].split("\n## ")[0]
    block = re.search(r"```sh\n(.*?)```", section, re.DOTALL).group(1)
    return [shlex.split(line, comments=True) for line in block.splitlines() if line.strip()]


def leaves(words):
    """The file or folder that a command is to write."""
    return next((words[i + 1] for i, word in enumerate(words) if word in ("--out", "-o")), None)


@pytest.mark.long
def test_readme_tour_runs_to_its_end(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    lines = tour()
    assert len(lines) >= 8
    for words in lines:
        assert words[0] == "skinrig"
        code = main(words[1:])
        out, err = capsys.readouterr()
        assert code == 0, f"{shlex.join(words)}\n{out}\n{err}"
        if leaves(words):
            assert Path(leaves(words)).exists(), shlex.join(words)


def test_tour_lines_use_results_of_earlier_lines():
    made = {"truth-face"}  # beside its session
    for words in tour():
        for word in words[2:]:
            if re.match(r"(session|calibration|appearance|moving|irritated|truth)(-|$)", word):
                assert word in made or word == leaves(words), (word, words)
        made.add(leaves(words))
