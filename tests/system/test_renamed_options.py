"""Former names of options run as the present ones with a notice; closed sets are current."""

import json
import os
import subprocess
import sys
from typing import get_args

import pytest
import typer.main
from typer.core import TyperCommand

from capture.devices.led_box import Eyes
from capture.importers.image_stacks import Encoding
from capture.importers.meshes import MM_PER_UNIT
from model.traits.vectors import Contrast
from reconstruction.brdf_basis.space import Method
from skinrig.applying.relief import EXTRAPOLATION_MODES, RELIEF_SOURCES
from skinrig.cli import app, main
from skinrig.command_line.renamed_options import RENAMED_OPTIONS, format_notice
from skinrig.commands.export import FORMATS
from skinrig.exporting.export import APPEARANCE_FORMATS, SESSION_FORMATS
from skinrig.exporting.options import METERS_PER_UNIT
from skinrig.rendering.render import Subsurface
from skinrig.simulating.orders import PICTURE_SIZES
from skinrig.traits.albedo_vectors import VectorKind

FORMER_NAMES = [
    (command, former, present)
    for command, renamed in RENAMED_OPTIONS.items()
    for former, present in renamed.items()
]


def command_of(path):
    command = typer.main.get_command(app)
    for name in path.split():
        command = command.commands[name]
    return command


def options_of(command):
    return {name: option for option in command.params for name in option.opts}


@pytest.mark.parametrize("path", RENAMED_OPTIONS)
def test_rename_table_names_existing_options_only(path):
    names = options_of(command_of(path))
    for former, present in RENAMED_OPTIONS[path].items():
        assert present in names
        assert former not in names


@pytest.mark.long
@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize(("path", "former", "present"), FORMER_NAMES)
def test_former_name_is_parsed_as_present_one(path, former, present, joined, capsys, monkeypatch):
    parsed = []
    monkeypatch.setattr(TyperCommand, "parse_args", lambda *given: parsed.append(given[-1]))
    root = typer.main.get_command(app)
    context = root.context_class(root)
    for name in path.split():
        command = context.command.commands[name]
        context = command.context_class(command, parent=context, info_name=name)
    is_flag = options_of(command)[present].is_flag

    def with_value(name):
        return [name] if is_flag else [f"{name}=7"] if joined else [name, "7"]

    command.parse_args(context, with_value(former))
    assert parsed == [with_value(present)]
    shown = capsys.readouterr()
    assert (shown.out, shown.err) == ("", f"{format_notice(former, present)}\n")


def test_former_name_is_reported_on_stderr_only(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    argv = ["plan", "--most-lights=0", "dome", "--want", "normals<=1deg", "--json"]
    assert main(argv) == 3
    shown = capsys.readouterr()
    assert json.loads(shown.out)["error"] == "--max-lights: got 0, expected 1 or more"
    assert shown.err.splitlines()[:2] == [
        format_notice("--most-lights", "--max-lights"),
        format_notice("--want", "--goals"),
    ]


def test_value_equal_to_former_name_is_kept(capsys):
    assert main(["simulate", "flash", "--out", "x", "--subject", "--nearer"]) == 3
    assert "is now" not in capsys.readouterr().err


def test_argument_named_as_its_parameter_is_kept(capsys):
    assert main(["reconstruct", "sessions", "--want", "melanin", "--out", "x"]) == 3
    assert format_notice("--want", "--maps") in capsys.readouterr().err


def test_former_name_of_other_rig_is_refused(capsys):
    assert main(["simulate", "dome", "--out", "x", "--nearer", "3"]) == 2
    assert "--nearer: not an option of the dome rig (only of flash)" in capsys.readouterr().err


def completions(words):
    run = subprocess.run(
        [sys.executable, "-c", "from skinrig.cli import app; app(prog_name='skinrig')"],
        env={
            **os.environ,
            "_SKINRIG_COMPLETE": "complete_bash",
            "COMP_WORDS": f"skinrig {words}",
            "COMP_CWORD": str(len(words.split(" "))),
        },
        capture_output=True,
        text=True,
        timeout=60,
    )
    return run.stdout.split(), run.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("simulate flash --size f", ["full"]),
        ("simulate flash --scale f", ["full"]),
        ("simulate flash --nea", []),
        ("simulate flash --camera-o", ["--camera-offset-mm"]),
        ("reconstruct s --want normals,r", ["normals,r_d"]),
    ],
)
def test_completion_takes_former_names_without_offering_them(words, expected):
    found, shown = completions(words)
    assert found == expected
    assert "is now" not in shown


@pytest.mark.parametrize(("path", "former"), [(path, former) for path, former, _ in FORMER_NAMES])
def test_former_names_are_hidden_from_help(path, former, capsys):
    assert main([*path.split(), "--help"]) == 0
    assert f"{former} " not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("path", "option", "values"),
    [
        ("apply expression", "--extrapolate", EXTRAPOLATION_MODES),
        ("apply expression", "--synthesize", RELIEF_SOURCES),
        ("capture dome", "--eyes", get_args(Eyes)),
        ("simulate flash", "--scale", PICTURE_SIZES),
        ("render", "--subsurface", get_args(Subsurface)),
        ("fit traits", "--vectors", get_args(VectorKind)),
        ("fit traits", "--contrast", get_args(Contrast)),
        ("analyse brdf", "--method", get_args(Method)),
        ("export", "--unit", METERS_PER_UNIT),
        ("import mesh", "--unit", MM_PER_UNIT),
        ("import olat", "--encoding", get_args(Encoding)),
    ],
)
def test_closed_set_in_help_is_the_accepted_one(path, option, values):
    metavar = options_of(command_of(path))[option].metavar
    assert sorted(metavar.strip("[]").split("|")) == sorted(values)


def test_formats_in_help_are_those_of_writers():
    assert (*APPEARANCE_FORMATS, *SESSION_FORMATS) == FORMATS


def test_former_import_command_works_with_notice(tmp_path, capsys):
    assert main(["import", "lp", str(tmp_path / "none"), "--out", str(tmp_path / "s")]) == 3
    assert "import lp is now import olat" in capsys.readouterr().err
    assert main(["import", "--help"]) == 0
    assert " lp " not in capsys.readouterr().out
