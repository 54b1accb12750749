"""Firmware with one bug each: the lines that both boxes must answer alike catch all of them."""

import functools
import shutil
import tomllib

import pytest
from fixtures.compiled.controller import CompiledController
from fixtures.compiled.fuzzing import differences
from fixtures.compiled.library import COMPILER, FIRMWARE, build_library, load_tool
from fixtures.product_code import ROOT, text_of

with (ROOT / "tests/data/firmware_mutants.toml").open("rb") as file:
    MUTANTS = tomllib.load(file)["mutants"]
LEAST = 30
LINES = 24_000

pytestmark = pytest.mark.skipif(COMPILER is None, reason="compiled firmware: no C compiler `cc`")


def mutated_tree(mutant, folder):
    """Copy the sources with one text replaced."""
    root = folder / "firmware"
    shutil.copytree(FIRMWARE, root, ignore=shutil.ignore_patterns("limits"))
    path = root / mutant["file"]
    text = path.read_text("utf-8")
    assert text.count(mutant["old"]) == 1
    path.write_text(text.replace(mutant["old"], mutant["new"]), "utf-8")
    return root


def make_mutant(name, wiring, root, folder):
    header = load_tool("make_firmware_limits").limits_header(name, wiring.rig, wiring.faults)
    path = build_library(name, header, root=root, flags=("-Wno-error",), folder=folder)
    return CompiledController(name, wiring, path=path)


def test_bugs_are_many_and_fit_the_sources():
    assert len({mutant["name"] for mutant in MUTANTS}) == len(MUTANTS) >= LEAST
    for mutant in MUTANTS:
        assert text_of(FIRMWARE / mutant["file"]).count(mutant["old"]) == 1, mutant["name"]


@pytest.mark.long
@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant["name"])
def test_planted_bug_is_caught(mutant, tmp_path):
    root = mutated_tree(mutant, tmp_path)
    make = functools.partial(make_mutant, root=root, folder=tmp_path)
    found, _ = differences(mutant["box"], lines=LINES, seed=3, limit=1, make=make)
    assert found
