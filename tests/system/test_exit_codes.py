"""One rule of exit codes for all commands: 2 where words cannot be read, 3 where they can."""

import json
import re

import pytest
import typer

from skinrig import errors
from skinrig.cli import app, main
from skinrig.command_line.help import RigGroup

SPEECHLESS = ("demo", "doctor", "view", "bench", "soak")
"""Commands that need no argument at all."""
RIG_ALONE = tuple(
    f"{name} {rig}" for name in ("plan", "serve") for rig in ("flash", "dome", "gradient", "probe")
)
"""Commands that need nothing but a rig."""

UNREADABLE = {
    "demo": ["--seed one"],
    "doctor": ["extra"],
    "plan": ["dome --goals normals<=soon", "probe --width 100", "flash --max-lights 3"],
    "simulate": [
        "flash",
        "flash --out x --width wide",
        "dome --out x --condition cold=very",
        "flash --out x --lights 4",
        "flash --out x --condition cold",
        "gradient --out x --steps 3",
        "gradient --out x --angles a",
        "flash --out x --relaxation 3",
        "flash --out x --target white --camera-offset-mm 3",
        "probe --out x --sequence smile",
        "flash --out x --consent-expires 2020",
        "flash --out x --captures 3",
        "flash --out x --sequence exercise --duration long",
    ],
    "capture": [
        "flash --out x",
        "flash --out x --port a",
        "gradient --dry-run --steps 1",
        "flash --dry-run --sites cheek",
    ],
    "serve": ["flash --tcp here", "flash --site cheek"],
    "diagnose": ["a b"],
    "verify": ["a b"],
    "calibrate": ["sensor"],
    "reconstruct": ["s --out a", "s --maps melanin --out a --rank some"],
    "bench": ["--budget long", "--extremes --smoke"],
    "render": [
        "maps --out r",
        "maps --light 1,1,1 --look-at 0,0 --view 0,0,9 --out r",
        "maps --light L017*bright --out r",
    ],
    "edit": ["maps --out e", "maps --out e --trait tan", "maps --out e --spots moles=lots"],
    "report": ["maps -o - --json"],
    "status": ["a b", "folder -o -"],
    "view": ["--port here", "--displacement d.npy"],
    "export": ["maps --out e", "maps --to rgl --use research --out e --at here"],
    "fit traits": ["a b --out t"],
    "fit reflectance": ["--out t"],
    "fit brdf": [""],
    "fit facial-color": ["s"],
    "fit wrinkles": ["a"],
    "fit microstructure": ["a"],
    "fit template": ["s"],
    "photo": ["d"],
    "import photos": ["d"],
    "import olat": ["d"],
    "import mesh": ["m.obj"],
    "apply expression": ["moving --weights smile --out a"],
    "apply microstructure": ["a --out b", "--on patch --weights smile=1 --out b"],
    "analyse albedo": ["maps --out a", "--labels l.csv --out a"],
    "analyse brdf": ["--out a --labels l.csv"],
    "analyse blood": ["a"],
    "analyse parameterization": ["a"],
    "analyse relief": ["a --out r"],
    "analyse profile": ["a", "--stretch 1,b --out p"],
    "analyse color-table": ["--size 8", "file.txt --eumelanin-fraction 0.5 --out t"],
    "analyse lumitexel": ["a"],
    "fuse": ["--out a"],
    "study": ["--out a", "file.txt", "a b --out c"],
    "soak": ["--hours long", "extra"],
    "session seal": ["", "a b"],
    "session copy": ["s", "folder copy --verify", "a b c"],
    "session anonymize": [
        "s",
        "folder --out a --landmarks cam",
        "folder --out a --landmarks cam=file.txt --landmarks cam=file.txt",
    ],
}
"""What no file could make right."""

UNUSABLE = {
    "demo": ["--rigs submarine", "--out file.txt", "--seed -1"],
    "plan": [
        "teapot",
        "probe --subject none.toml",
        "dome --goals gloss<=1",
        "dome --goals normals<=-1",
        "dome --subject XX",
        "dome --seed -1",
        "dome --max-lights 0",
        "dome --min-valid-fraction 2",
        "dome --width 3",
        "dome --forecast none.json",
        "dome --out folder",
    ],
    "simulate": [
        "teapot --out x",
        "flash --out x --scale huge",
        "flash --out x --subject XX",
        "flash --out x --seed -1",
        "flash --out x --width 3",
        "flash --out x --target moon",
        "flash --out x --state happy",
        "flash --out x --mesh none.obj",
        "dome --out x --lights 0",
        "flash --out x --omit gold",
        "flash --out x --camera-offset-mm inf",
        "dome --out x --views 400",
        "flash --out x --sequence tea",
        "flash --out x --sequence exercise --duration -3",
        "dome --out x --condition mud",
        "dome --out x --condition cold=2",
        "gradient --out x --site nose",
        "gradient --out x --angles 3",
        "gradient --out x --steps 3..1",
        "probe --out x --subject homogeneous:1",
        "flash --out x --subject none.toml",
        "dome --out x --subject none.toml",
    ],
    "capture": [
        "teapot --dry-run",
        "flash --dry-run --plan none",
        "flash --dry-run --repeats 0",
        "dome --dry-run --eyes shut",
        "gradient --out x --force-limit -1",
    ],
    "serve": ["teapot", "flash --subject XX", "flash --scale huge"],
    "diagnose": ["none", "file.txt", "folder"],
    "verify": ["none", "file.txt", "folder"],
    "calibrate": ["taste folder", "sensor none"],
    "reconstruct": [
        "none --maps melanin --out a",
        "none --maps normals --out a --rank 1000",
        "none --maps melanin --out a --executor local:0",
    ],
    "bench": ["--stage coffee", "--budget 0", "--out file.txt"],
    "soak": ["--hours -1", "--first-day -1", "--budget 0", "--seed -1"],
    "session seal": ["none", "file.txt", "folder"],
    "session copy": ["none copy --use research", "folder copy --use research"],
    "session anonymize": [
        "none --drop-images --out a",
        "folder --drop-images --out a",
        "folder --landmarks cam=none.csv --out a",
    ],
    "render": [
        "folder --light 1,1,1 --out r",
        "folder --light 1,1,1 --exposure 0 --out r",
        "folder --light 1,1,1 --samples 3 --out r",
        "folder --light 1,1,1 --subsurface wax --out r",
        "folder --light 1,1,1 --calibration none --out r",
    ],
    "edit": ["none --out e --trait tan=1", "folder --out e --trait tan=1 --seed -1"],
    "report": ["none", "file.txt", "folder", "folder -o folder"],
    "status": ["none", "file.txt", "folder", "folder -o folder"],
    "view": [
        "none",
        "folder",
        "--port 70000",
        "--preset XX",
        "--size-px 3",
        "--people II,XX",
        "--size-px 0",
        "--people II,VI --preset IV",
        "--people I,I,I,I,I,I,I",
    ],
    "export": ["none --to maps --use research --out e", "folder --to fbx --use research --out e"],
    "fit traits": ["none folder --labels l.csv --out t"],
    "fit reflectance": ["none --out t"],
    "fit brdf": ["none --out t", "folder --out t", "--count 2 --out t"],
    "fit facial-color": ["none --out m"],
    "fit wrinkles": ["none --out m", "folder --method sums --out m"],
    "fit microstructure": ["none --out m"],
    "fit template": ["none --out m.ply"],
    "photo": ["none --out p", "folder --out p", "file.txt --out p"],
    "import photos": ["none --out s", "folder --out s", "file.txt --out s"],
    "import olat": ["none --out s", "folder --out s"],
    "import mesh": ["none --session none", "file.txt --session folder"],
    "apply expression": ["none --weights smile=1 --out a"],
    "apply microstructure": [
        "none --weights smile=1 --mesh none.obj --out a",
        "--on cube --out a",
        "none --on sphere --out a",
        "--on sphere --size-px 3 --out a",
    ],
    "analyse albedo": ["none folder --out a"],
    "analyse brdf": ["none folder --out a"],
    "analyse blood": ["none --out a", "folder --out a"],
    "analyse relief": ["none --moving none --mesh none --out r"],
    "analyse parameterization": ["none --out p", "file.txt --out p", "folder --out p"],
    "analyse profile": [
        "none --out p",
        "file.txt --out p",
        "--length 99 --out p",
        "--stretch 9 --out p",
    ],
    "analyse color-table": [
        "none.exr --out t",
        "file.txt --out t",
        "--camera none --out t",
        "--size 3 --out t",
        "--eumelanin-fraction 2 --out t",
        "--epidermal-blood-ratio 1 --out t",
        "--tissue wax --out t",
    ],
    "analyse lumitexel": ["none none --out a"],
    "fuse": ["none folder --out a", "folder --out a"],
    "study": [
        "none.toml --out a",
        "file.txt --out a",
        "none.toml --out a --executor many",
        "none.toml --out file.txt",
    ],
}
"""What another name, number or file would make right."""


def leaves(command, name=()):
    """Return the names of all commands, those of groups with the group's before.

    A command that there is of each rig counts once; the cases name the rig.
    """
    if not hasattr(command, "commands") or isinstance(command, RigGroup):
        return [" ".join(name)]
    return [leaf for word, one in command.commands.items() for leaf in leaves(one, (*name, word))]


TREE = typer.main.get_command(app)
COMMANDS = leaves(TREE)
OF_RIGS = [
    f"{name} {rig}"
    for name, command in TREE.commands.items()
    if isinstance(command, RigGroup)
    for rig in command.commands
]


def cases(table):
    return [
        pytest.param([*name.split(), *tail.split()], id=f"{name} {tail}")
        for name, tails in table.items()
        for tail in tails
    ]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file.txt").write_text("no session", encoding="utf-8")
    (tmp_path / "folder").mkdir()
    return tmp_path


def told(capsys):
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    document = json.loads(out)
    assert document["schema"] == "skinrig.error/1"
    assert document["error"]
    return document["exit_code"]


def test_every_command_is_held_to_the_rule():
    assert set(UNREADABLE) == set(COMMANDS)
    assert set(UNUSABLE) == set(COMMANDS) - {"doctor"}  # which names nothing


@pytest.mark.parametrize("name", [*COMMANDS, *OF_RIGS])
def test_the_words_of_every_command_are_checked_alike(name, here, capsys):
    assert main([*name.split(), "--help"]) == errors.EXIT_DONE
    said = capsys.readouterr().out
    assert "Usage:" in said
    assert not re.search(r"list\[|Path|%Y|\.\.\.\]?\.\.\.", said)  # Python, dots twice
    assert main([*name.split(), "--no-such-option", "--json"]) == errors.EXIT_USAGE
    assert told(capsys) == errors.EXIT_USAGE
    if name.split()[0] not in SPEECHLESS and name not in RIG_ALONE:
        assert main([*name.split(), "--json"]) == errors.EXIT_USAGE
        assert told(capsys) == errors.EXIT_USAGE


@pytest.mark.parametrize("argv", cases(UNREADABLE))
def test_uncorrectable_words_exit_with_2(argv, here, capsys):
    assert main(argv if "--json" in argv else [*argv, "--json"]) == errors.EXIT_USAGE
    assert told(capsys) == errors.EXIT_USAGE
    assert sorted(path.name for path in here.iterdir()) == ["file.txt", "folder"]


@pytest.mark.parametrize("argv", cases(UNUSABLE))
def test_invalid_names_numbers_and_files_exit_with_3(argv, here, capsys):
    assert main([*argv, "--json"]) == errors.EXIT_BAD_INPUT
    assert told(capsys) == errors.EXIT_BAD_INPUT
    assert sorted(path.name for path in here.iterdir()) == ["file.txt", "folder"]


def test_help_lists_every_exit_code(capsys):
    assert main(["--help"]) == errors.EXIT_DONE
    said = " ".join(capsys.readouterr().out.split())
    assert errors.EXIT_CODE_HELP in said
    for code in (0, 1, 2, 3, 4, 5, 70, 130):
        assert f"{code} " in errors.EXIT_CODE_HELP
