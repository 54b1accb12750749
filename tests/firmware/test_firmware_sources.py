"""The firmware's limits are the rigs', its code is clean, and it behaves as the emulated boxes."""

import os
import subprocess
import sys

import pytest
from fixtures.compiled.fuzzing import differences, spread_differences
from fixtures.compiled.library import COMPILER, FIRMWARE, SOURCES, load_tool
from fixtures.product_code import ROOT, text_of

from rigsim.world.rig_boxes import BOXES

MAX_BOARD_FUNCTIONS = 20
MAX_LINES = 5600
QUICK_LINES = 2000
LONG_LINES = int(os.environ.get("FIRMWARE_FUZZ_LINES", "12000"))
SANITIZED = """
from fixtures.compiled import fuzzing, library
library.FLAGS += ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")
for name in library.SOURCES:
    found, sent = fuzzing.differences(name, lines=1500, seed=5)
    assert found == [], (name, found)
    print(name, sent)
"""
"""A program that compares the boxes under the sanitizers of memory and of undefined behavior."""
each_box = pytest.mark.parametrize("name", SOURCES)
needs_cc = pytest.mark.skipif(COMPILER is None, reason="compiled firmware: no C compiler `cc`")


@each_box
def test_limits_header_is_current(name):
    made = load_tool("make_firmware_limits").shipped_headers()[name]
    shipped = (FIRMWARE / "limits" / name / "limits.h").read_text("utf-8")
    assert shipped == made, "run python tools/make_firmware_limits.py"


def test_build_guide_and_drawings_are_current(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tools")
    for path, text in load_tool("make_wiring").make_files().items():
        assert text_of(path) == text, "run python tools/make_wiring.py"


def test_every_box_has_firmware():
    assert SOURCES.keys() == BOXES.keys()


def test_board_header_and_code_stay_small():
    header = text_of(FIRMWARE / "boards" / "board.h")
    assert header.count("board_") == header.count(" board_")
    functions = [line for line in header.splitlines() if line.partition("(")[0].count(" board_")]
    assert len(functions) <= MAX_BOARD_FUNCTIONS
    files = [path for path in FIRMWARE.rglob("*.[ch]") if path.parent.parent.name != "limits"]
    assert sum(len(text_of(path).splitlines()) for path in files) <= MAX_LINES


def test_firmware_uses_neither_heap_nor_stdio():
    for folder in ("core", "boxes"):
        for path in (FIRMWARE / folder).glob("*.[ch]"):
            text = text_of(path)
            assert not any(word in text for word in ("malloc", "stdio.h", "printf(", "stdlib.h"))


@pytest.mark.long
@needs_cc
@each_box
def test_firmware_answers_as_emulated_box_byte_for_byte(name):
    found, sent = differences(name, lines=QUICK_LINES, seed=11)
    assert (found, sent) == ([], QUICK_LINES)


@needs_cc
@pytest.mark.long
@pytest.mark.timeout(900)
@each_box
def test_firmware_answers_as_emulated_box_long_run(name):
    found, sent = spread_differences(name, lines=LONG_LINES, seed=12)
    print(f"{name}: {sent} lines, {len(found)} differences")
    assert (found, sent) == ([], LONG_LINES)


@needs_cc
@pytest.mark.long
@pytest.mark.timeout(240)
def test_firmware_is_clean_under_sanitizers():
    runtime = subprocess.run(
        [COMPILER, "-print-file-name=libasan.so"], check=True, capture_output=True, text=True
    ).stdout.strip()
    if not os.path.isabs(runtime):
        pytest.skip(f"compiled firmware: {COMPILER} has no libasan")
    places = os.pathsep.join((str(ROOT), str(ROOT / "tests")))
    more = {"LD_PRELOAD": runtime, "ASAN_OPTIONS": "detect_leaks=0", "PYTHONPATH": places}
    done = subprocess.run(
        [sys.executable, "-c", SANITIZED], env=os.environ | more, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split() == [word for name in SOURCES for word in (name, "1500")]
