"""The command line as a user meets it: exit codes, one JSON document, no traceback."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from skinrig import errors
from skinrig.cli import app, main


def registered(typer_app, before=()):
    """Each command's words, those in groups too."""
    for command in typer_app.registered_commands:
        yield (*before, command.name or command.callback.__name__.replace("_", "-"))
    for group in typer_app.registered_groups:
        yield from registered(group.typer_instance, (*before, group.name))


WORDS = sorted(registered(app))
COMMANDS = sorted({words[0] for words in WORDS})
ROOT = Path(__file__).parents[2]
RIG_GROUPS = ("plan", "simulate", "capture", "serve")
MAX_HELP_LINES = 45


@pytest.mark.parametrize("words", WORDS, ids=" ".join)
def test_every_command_explains_itself_with_an_example(words, capsys):
    assert main([*words, "--help"]) == 0
    assert f"Example: skinrig {' '.join(words)}" in capsys.readouterr().out


@pytest.mark.parametrize(
    "group",
    [[], ["fit"], ["apply"], ["analyse"], ["import"], *([name] for name in RIG_GROUPS)],
    ids=" ".join,
)
def test_help_lists_each_command_with_its_whole_summary(group, capsys):
    assert main([*group, "--help"]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "..." not in printed.replace("[ARGS]...", "")
    for words in WORDS:
        if list(words[: len(group)]) == group:
            assert f" {words[len(group)]} " in printed


def test_commands_are_listed_under_their_purpose(capsys):
    assert main(["--help"]) == 0
    assert "More:" not in capsys.readouterr().out


def test_the_promised_commands_are_there():
    promised = {
        "simulate",
        "capture",
        "serve",
        "calibrate",
        "reconstruct",
        "import",
        "report",
        "bench",
        "verify",
        "doctor",
        "demo",
    }
    assert promised <= set(COMMANDS)


@pytest.mark.parametrize("rig", ["flash", "dome", "gradient", "probe"])
def test_simulate_help_fits_one_screen_help_all_explains(rig, capsys):
    assert main(["simulate", rig, "--help"]) == 0
    short = capsys.readouterr().out
    assert len(short.splitlines()) <= MAX_HELP_LINES
    assert main(["simulate", rig, "--help-all"]) == 0
    whole = capsys.readouterr().out
    short, _, further = short.partition("Further options (--help-all")
    named = set(re.findall(r"--[a-z-]+", further))
    assert "--renderer" in named
    assert named <= set(re.findall(r"^  (--[a-z-]+)", whole, re.MULTILINE))
    assert not named & set(re.findall(r"^  (--[a-z-]+)", short, re.MULTILINE))


@pytest.mark.parametrize("verb", RIG_GROUPS)
def test_rig_help_lists_its_own_options_only(verb, capsys):
    shown = {}
    for rig in ("flash", "dome", "gradient", "probe"):
        assert main([verb, rig, "--help"]) == 0
        shown[rig] = set(re.findall(r"^  (--[a-z-]+)", capsys.readouterr().out, re.MULTILINE))
    owners = {
        "--site": {"flash", "gradient"} if verb == "simulate" else {"gradient"},
        "--sites": {"probe"},
        "--state": {"flash"} if verb == "capture" else {"flash", "dome"},
        "--sequence": {"flash"},
        "--condition": {"dome"},
        "--steps": {"gradient"},
        "--all-brackets": {"probe"},
        "--max-lights": {"dome"},
        "--force-limit": {"gradient"},
    }
    for option, rigs in owners.items():
        assert {rig for rig in shown if option in shown[rig]} in (rigs, set()), option


@pytest.mark.parametrize(
    ("argv", "rigs"),
    [
        (["simulate", "flash", "--out", "x", "--steps", "-1..2"], "gradient"),
        (["simulate", "--steps", "-1..2", "flash", "--out", "x"], "gradient"),
        (["capture", "probe", "--dry-run", "--sequence", "smile"], "flash"),
        (["plan", "gradient", "--max-lights", "3"], "dome"),
        (["serve", "dome", "--site", "cheek"], "gradient"),
    ],
)
def test_option_of_other_rig_error_names_option_rigs(argv, rigs, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(argv) == 2
    rig = next(word for word in argv if word in ("flash", "dome", "gradient", "probe"))
    option = next(
        word for word in argv if word.startswith("--") and word[2:5] not in ("out", "dry")
    )
    told = capsys.readouterr().err
    assert f"{option}: not an option of the {rig} rig (only of {rigs}); remove it" in told
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    "argv",
    [
        ["capture", "--dry-run", "--plan-out", "plan.json", "flash"],
        ["capture", "--plan-out", "dome", "flash", "--dry-run"],
        ["capture", "flash", "--dry-run"],
    ],
)
def test_options_may_precede_rig(argv, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*argv, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["plan"]["rig"] == "flash"


def test_own_rig_file_is_captured_by_kind_command(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = ROOT / "capture" / "rigs" / "probe.toml"
    (tmp_path / "mine.toml").write_text(shipped.read_text("utf-8"), encoding="utf-8")
    assert main(["capture", "mine.toml", "--dry-run", "--sites", "cheek", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["plan"]["rig"] == "probe"
    assert main(["capture", "mine.toml", "--dry-run", "--eyes", "closed"]) == 2
    assert "--eyes: not an option of the probe rig" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("argv", "code", "says"),
    [
        (["nonsense"], 2, "nonsense"),
        (["simulate"], 2, "Missing"),
        (["verify", "nothing"], 3, "nothing"),
        (["report", "nothing"], 3, "does not exist"),
        (["simulate", "teapot", "--out", "x"], 3, "teapot"),
        (["simulate", "flash", "--out", "x", "--scale", "huge"], 3, "huge"),
        (["simulate", "flash", "--out", "x", "--target", "moon"], 3, "moon"),
        (["simulate", "dome", "--out", "x", "--condition", "mud"], 3, "mud"),
        (["simulate", "dome", "--out", "x", "--condition", "hot=much"], 2, "hot=much"),
        (["simulate", "flash", "--out", "x", "--condition", "hot"], 2, "flash"),
        (["simulate", "dome", "--out", "x", "--target", "white", "--condition", "hot"], 2, "hot"),
        (["simulate", "dome", "--out", "x", "--subject", "P99"], 3, "P01 to P87"),
        (["simulate", "flash", "--out", "x", "--subject", "green"], 3, "green"),
        (["reconstruct", "nothing", "--maps", "melanin", "--out", "x"], 3, "nothing"),
        (
            ["reconstruct", "s", "--maps", "normals", "--out", "x", "--rank", "1000"],
            3,
            "--rank: got 1000, expected at most 59",
        ),
        (
            [
                "reconstruct",
                "s",
                "--maps",
                "normals",
                "--out",
                "x",
                "--rank",
                "3",
                "--merl-basis",
                ".",
            ],
            3,
            "expected at most 0",
        ),
        (["calibrate", "sensor", "nothing"], 3, "nothing"),
        (["simulate", "flash", "--out", "x", "--state", "happy"], 3, "happiness"),
        (["bench", "--stage", "coffee"], 3, "coffee"),
        (["capture", "flash", "--out", "x"], 2, "--port flash=URL"),
        (["capture", "flash", "--out", "x", "--port", "flash"], 2, "NAME=URL"),
        (["verify", "."], 3, "is not a session"),
        (["verify", "photo.jpg"], 3, "got a file, expected a folder with session.json"),
        (["serve", "flash", "--resume", "nothing"], 3, "nothing: is not a session"),
        (["demo", "--rigs", "submarine"], 3, "submarine"),
        (["import", "photos", "nothing", "--out", "x"], 3, "nothing"),
    ],
)
def test_bad_input_gives_single_error_and_exit_code(
    argv, code, says, capsys, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photo.jpg").write_bytes(b"no session")
    assert main(argv) == code
    out, err = capsys.readouterr()
    told = " ".join((out + err).split())
    assert says in told
    assert "DAMAGED" not in told
    assert "Traceback" not in told
    assert not (tmp_path / "x").exists()


def test_missing_controller_is_device_failure(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    argv = ["capture", "flash", "--out", "x", "--port", "flash=/dev/no-such-port"]
    assert main([*argv, "--camera", "cam=hotfolder:none"]) == 4
    assert "no-such-port" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_dry_run_prints_plan_and_opens_nothing(capsys):
    assert main(["capture", "flash", "--out", "x", "--dry-run", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "skinrig.capture/1"
    assert document["captured"] == 0
    assert document["steps"] > 1


@pytest.mark.parametrize(
    ("argv", "exit_code", "says", "code"),
    [
        (["verify", "nothing"], 3, "is not a session", "SR-SES-001"),
        (["capture", "flash", "--out", "x"], 2, "--port flash=URL", "SR-CAP-033"),
        (["plan", "flash", "--width", "many"], 2, "--width", None),
        (
            [
                "capture",
                "flash",
                "--out",
                "x",
                "--port",
                "flash=/dev/no-such-port",
                "--camera",
                "cam=hotfolder:none",
            ],
            4,
            "no-such-port",
            "SR-CAP-001",
        ),
    ],
)
def test_json_error_is_single_document(argv, exit_code, says, code, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*argv, "--json"]) == exit_code
    out, err = capsys.readouterr()
    document = json.loads(out)
    assert says in document.pop("error")
    assert document == {"schema": "skinrig.error/1", "code": code, "exit_code": exit_code}
    assert says in err
    assert code is None or err.rstrip().endswith(f"[{code}]")
    assert main(argv) == exit_code
    assert "skinrig.error" not in capsys.readouterr().out


def test_interrupted_command_is_reported(monkeypatch, capsys):
    def interrupted(path, **_):
        raise KeyboardInterrupt

    monkeypatch.setattr("capture.session.verify", interrupted)
    assert main(["verify", "session", "--json"]) == 130
    out, err = capsys.readouterr()
    assert "skinrig: interrupted; run the same command again" in err
    assert json.loads(out)["exit_code"] == 130


def test_interrupted_import_exits_as_interrupted(monkeypatch, capsys):
    def interrupted(path, **_):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as stop:
            raise SystemError("__import__ returned a result with an exception set") from stop

    monkeypatch.setattr("capture.session.verify", interrupted)
    assert main(["verify", "session"]) == 130
    assert "defect" not in capsys.readouterr().err


def test_interrupted_command_suggests_resuming_where_possible(tmp_path):
    """Those with the option, and no others, are advised to use it, once their session exists."""
    place = ["--json", f"--out={tmp_path}"]
    assert "--resume" not in errors.format_interruption(["simulate", *place])
    (tmp_path / "session.json").touch()
    commands = get_command(app).commands
    resumable = {
        name
        for name, command in commands.items()
        for one in (getattr(command, "commands", None) or {name: command}).values()
        if any("--resume" in option.opts for option in one.params)
    }
    assert resumable == set(errors.RESUMABLE_COMMANDS)
    advice = {name: errors.format_interruption([name, *place]) for name in commands}
    assert {name for name, text in advice.items() if "--resume" in text} == resumable


@pytest.mark.parametrize(
    ("argv", "end"),
    [
        (["--out", "b"], "keeps what was measured; run the same command to continue"),
        (["--out=b", "--smoke"], "keeps what was measured; run the same command to continue"),
        (["--out", "b", "--stage", "hdr"], "keeps what was measured"),
        (["--out", "b", "--end-to-end=flash"], "keeps what was measured"),
        ([], "interrupted; run the same command again"),
        (["--extremes", "--out", "b"], "interrupted; run the same command again"),
    ],
)
def test_interrupted_benchmark_reports_location_of_measurements(
    argv, end, capsys, tmp_path, monkeypatch
):
    """Extremes write theirs at the end alone."""

    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("skinrig.benchmarks.stages.run_stages", interrupted)
    monkeypatch.setattr("skinrig.reporting.sections.extremes.run_extremes", interrupted)
    assert main(["bench", *argv]) == 130
    assert capsys.readouterr().err.strip().endswith(end)


@pytest.mark.parametrize(("own", "expected"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_benchmark_threads_sleep_unless_user_sets_wait_policy(own, expected, monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    if own is not None:
        monkeypatch.setenv("OMP_WAIT_POLICY", own)
    found = []

    def look(*args, **kwargs):
        found.append(os.environ.get("OMP_WAIT_POLICY"))
        return {"schema": "skinrig.bench/2", "passed": True}

    monkeypatch.setattr("skinrig.benchmarks.stages.run_stages", look)
    assert main(["bench", "--smoke"]) == 0
    assert found == [expected]


def test_benchmark_sets_thread_wait_policy_before_library_loads():
    """OpenMP reads its environment once: a fresh process has not loaded it by then."""
    code = (
        "import sys\n"
        "def look(environment):\n"
        "    print([m for m in ('numba', 'numpy', 'scipy', 'cv2') if m in sys.modules])\n"
        "    raise SystemExit\n"
        "import skinrig.commands.measuring as measuring\n"
        "measuring.set_passive_waiting = look\n"
        "from skinrig.cli import main\n"
        "main(['bench', '--smoke'])"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert run.stdout.strip() == "[]", run.stderr


def test_the_package_runs_as_the_script_does(tmp_path):
    """`python -m skinrig` ends as `skinrig` does, with its output and its exit code."""
    for argv, code in ((["--version"], 0), (["verify", "no-such-session"], 3)):
        run = subprocess.run(
            [sys.executable, "-m", "skinrig", *argv], capture_output=True, text=True, cwd=tmp_path
        )
        assert run.returncode == code, run.stderr
        assert "Traceback" not in run.stderr
        assert ("skinrig " in run.stdout) == (code == 0)


def test_no_argument_shows_where_to_begin(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([]) == 0
    out, err = capsys.readouterr()
    assert "skinrig demo" in out + err


@pytest.mark.parametrize(
    "command", re.findall(r"^skinrig (\w+)", (ROOT / "README.md").read_text(), re.MULTILINE)
)
def test_the_readme_names_commands_that_exist(command):
    assert command in COMMANDS


@pytest.mark.long
def test_simulated_world_is_captured_by_controller_camera_urls(tmp_path, monkeypatch):
    monkeypatch.setattr("rigsim.world.world._WORLDS", {})
    out = tmp_path / "session"
    where = ["--port", "flash=sim://flash?seed=1&clock=virtual", "--camera", "cam=sim://flash/cam"]
    assert main(["capture", "flash", *where, "--target", "dark", "--out", str(out)]) == 0
    assert main(["verify", str(out)]) == 0


def test_benchmark_accepts_stages_in_single_or_repeated_options(monkeypatch):
    asked = []

    def measured(stages, **settings):
        asked.append(stages)
        return {"schema": "skinrig.bench/1", "passed": True}

    monkeypatch.setattr("skinrig.benchmarks.stages.run_stages", measured)
    assert main(["bench", "--stage", "chromophores", "wrinkles", "hdr", "--json"]) == 0
    assert main(["bench", "--stage", "chromophores", "--stage", "wrinkles", "hdr"]) == 0
    assert main(["bench", "chromophores", "wrinkles", "hdr"]) == 0
    assert main(["bench"]) == 0
    assert asked == [["chromophores", "wrinkles", "hdr"]] * 3 + [None]
