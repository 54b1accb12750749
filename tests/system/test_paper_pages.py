"""Pages of the papers: each command parses, each item has a command or a reason."""

import re
import shlex
from pathlib import Path

import pytest
import typer

from skinrig.cli import app
from skinrig.command_line.help import RigGroup

PAGES = sorted((Path(__file__).parents[2] / "docs/validation").glob("paper-*.md"))
COMMAND = re.compile(r"`skinrig ([^`]+)`")
TREE = typer.main.get_command(app)


def item_rows(page):
    """Rows of the tables whose head is item, command, ours, printed, difference."""
    rows, wanted = [], False
    for line in page.read_text("utf-8").splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        wanted = cells[:1] == ["item"] or (wanted and bool(cells))
        if wanted and cells[0] != "item" and set(cells[0]) != {"-"}:
            rows.append(cells)
    return rows


def parse(argv):
    command = TREE
    while hasattr(command, "commands") and not isinstance(command, RigGroup):
        command = command.commands[argv.pop(0)]
    if isinstance(command, RigGroup):
        command = command.commands[argv.pop(0)]
    return command.make_context(command.name, argv)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_paper_page_commands_parse(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    commands = [found for cells in item_rows(page) for found in COMMAND.findall(cells[1])]
    assert len(commands) >= 5
    for text in commands:
        parse(shlex.split(text))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_paper_page_rows_have_command_or_reason(page):
    for cells in item_rows(page):
        assert len(cells) == 5, cells
        assert all(cells), cells
        assert "`" in cells[1] or (cells[1] == "not reproduced" and len(cells[4]) > 10), cells


def test_paper_page_parser_refuses_unknown_option():
    with pytest.raises(Exception, match="No such option"):
        parse(shlex.split("analyse blood a --out b --nothing 3"))
