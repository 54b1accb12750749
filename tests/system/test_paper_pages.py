"""Pages of the papers: commands parse, folders exist, each item has a command or a reason."""

import ast
import inspect
import re
import shlex
from pathlib import Path

import pytest
import typer

from skinrig import demo_rigs
from skinrig.cli import app
from skinrig.command_line.help import RigGroup

PAGES = sorted((Path(__file__).parents[2] / "docs/validation").glob("paper-*.md"))
COMMAND = re.compile(r"`skinrig ([^`]+)`")
FOLDER = re.compile(
    r"\b(?:session|appearance|calibration|truth)-(?:flash|dome|gradient|probe)[\w-]*"
)
OUTPUT = re.compile(r"--out (\S+?)[\s`]")
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


def list_demo_folders():
    """Read the names of sessions, maps and ground truth from the calls of `skinrig.demo_rigs`."""
    made = {demo_rigs.FLASH_MOVING_FOLDER, f"appearance-gradient-moving-{demo_rigs.GRADIENT_SITE}"}
    made |= {
        f"truth-flash-{demo_rigs.DEMO_SUBJECT}-{state}" for state in demo_rigs.FLASH_STATES[1:]
    }
    for rig in demo_rigs.RIGS:
        nodes = list(ast.walk(ast.parse(inspect.getsource(demo_rigs.RUN_BY_PART[rig]))))
        loops = {ast.unparse(one.target): one.iter for one in nodes if isinstance(one, ast.For)}
        # results of targets serve calibrations alone
        targets = [one.value for one in nodes if isinstance(one, ast.Expr)]
        made.add(f"calibration-{rig}")
        for call in nodes:
            if not isinstance(call, ast.Call) or ast.unparse(call.func) != "run.simulate":
                continue
            name = ast.unparse(call.args[1])
            names = loops.get(name, ast.Tuple([call.args[1]], ast.Load()))
            kinds = ["session"] if call in targets else ["session", "appearance", "truth"]
            values = eval(ast.unparse(names), vars(demo_rigs))
            made |= {f"{kind}-{rig}-{value}" for kind in kinds for value in values}
    return made


@pytest.mark.parametrize(
    "page", [*PAGES, PAGES[0].with_name("index.md")], ids=lambda page: page.stem
)
def test_paper_page_folders_are_made(page):
    text = page.read_text("utf-8")
    assert set(FOLDER.findall(text)) <= list_demo_folders() | set(OUTPUT.findall(text))


def test_folders_of_no_demo_are_missing():
    made = list_demo_folders()
    assert {"session-flash-white", "session-dome-III", "truth-flash-III-anger"} <= made
    assert not {"session-flash-II", "appearance-flash-white", "appearance-flash-moving-II"} & made
