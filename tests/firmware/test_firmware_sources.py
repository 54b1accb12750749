"""The firmware's limits are the rigs', its code is clean, and it behaves as the emulated boxes."""

import shutil
import subprocess

import pytest
from fixtures.compiled.fuzzing import differences, texts_of
from fixtures.compiled.library import COMPILER, FIRMWARE, SOURCES, build_library, load_tool
from fixtures.product_code import text_of

from rigsim.boxes.box_clock import add_us
from rigsim.world.rig_boxes import BOXES

MAX_BOARD_FUNCTIONS = 20
MAX_LINES = 5000
QUICK_LINES, LONG_LINES = 4000, 200_000
each_box = pytest.mark.parametrize("name", SOURCES)
needs_cc = pytest.mark.skipif(COMPILER is None, reason="compiled firmware: no C compiler `cc`")


@each_box
def test_limits_header_is_current(name):
    made = load_tool("make_firmware_limits").shipped_headers()[name]
    shipped = (FIRMWARE / "limits" / name / "limits.h").read_text("utf-8")
    assert shipped == made, "run python tools/make_firmware_limits.py"


def test_every_box_of_the_protocol_has_firmware():
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
    found, sent = differences(name, lines=LONG_LINES, seed=12)
    assert (found, sent) == ([], LONG_LINES)
