"""Completions that the shell offers at Tab, requested as the shell does."""

import subprocess
import sys
from pathlib import Path

import pytest

from skinrig.command_line import completion


def offered(words):
    typed = f"skinrig {words}"
    run = subprocess.run(
        [Path(sys.executable).with_name("skinrig")],
        env={
            "_SKINRIG_COMPLETE": "complete_bash",
            "COMP_WORDS": typed,
            "COMP_CWORD": str(len(typed.split(" ")) - 1),
            "PATH": "",
        },
        capture_output=True,
        text=True,
        timeout=60,
    )
    return run.stdout.split()


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("simulate d", ["dome"]),
        ("simulate dome --target ch", ["charuco"]),
        ("simulate dome --condi", ["--condition"]),
        ("calibrate ge", ["geometry"]),
        ("demo --rigs flash,p", ["flash,probe"]),
        ("reconstruct session --maps normals,r", ["normals,r_d"]),
        ("rep", ["report"]),
    ],
)
def test_tab_completes_names(words, expected):
    assert offered(words) == expected


@pytest.mark.parametrize(
    ("complete", "typed", "one"),
    [
        (completion.complete_subjects, "dark", "darkest"),
        (completion.complete_states, "sm", "smile"),
        (completion.complete_conditions, "lo", "lotion"),
        (completion.complete_stages, "chrom", "chromophores"),
    ],
)
def test_completions_begin_with_typed_text(complete, typed, one):
    found = complete(typed)
    assert one in found
    assert all(name.startswith(typed) for name in found)
    assert complete("zz") == []


def test_name_is_completed_once_per_list():
    assert "flash,flash" not in completion.complete_rig_list("flash,")
