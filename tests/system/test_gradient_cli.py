"""The gradient rig from the command line: dry runs, refusals, and a capture from a served rig."""

import json
import re
import subprocess
import sys

import pytest

from capture.session import Session, verify
from skinrig import errors
from skinrig.cli import main

SERVE = [sys.executable, "-m", "skinrig.cli", "serve", "gradient"]
PORTS = [
    "--port",
    "gradient_sphere=loop://",
    "--port",
    "caliper=loop://",
    "--camera",
    "cam=tcp://x",
]


def test_dry_run_prints_plan_light_without_address_force(capsys):
    arguments = ["capture", "gradient", "--dry-run", "--angles", "0,90", "--steps", "-1..2"]
    assert main([*arguments, "--json"]) == errors.EXIT_DONE
    document = json.loads(capsys.readouterr().out)
    assert document["steps"] == 2 + 2 * 4 * 16
    assert document["light"]["open_eyes"] == "refused"
    assert document["light"]["duty"] <= 0.25
    assert main(arguments) == errors.EXIT_DONE
    printed = capsys.readouterr()
    assert "must be closed or shielded" in printed.out + printed.err


def test_skin_capture_without_force_limit_is_usage_error(capsys, tmp_path):
    code = main(["capture", "gradient", *PORTS, "--out", str(tmp_path / "s")])
    assert code == errors.EXIT_USAGE
    assert re.search(r"--force-limit N.*no default", capsys.readouterr().err)
    assert not (tmp_path / "s").exists()


def test_missing_address_is_reported_target_needs_no_caliper(capsys, tmp_path):
    out = ["--out", str(tmp_path / "s")]
    assert main(["capture", "gradient", "--force-limit", "1", *out]) == errors.EXIT_USAGE
    assert "--port caliper=URL" in capsys.readouterr().err
    assert main(["capture", "gradient", "--target", "ball", *out]) == errors.EXIT_USAGE
    text = capsys.readouterr().err
    assert "--port gradient_sphere=URL" in text
    assert "caliper" not in text


@pytest.mark.parametrize(
    ("arguments", "code", "match"),
    [
        (["--angles", "30"], errors.EXIT_BAD_INPUT, "angles: got 30"),
        (["--steps", "1-2"], errors.EXIT_USAGE, "FIRST..LAST"),
        (["--steps", "-9..0"], errors.EXIT_BAD_INPUT, "steps"),
        (["--target", "chart"], errors.EXIT_BAD_INPUT, "expected one of ball, flat, dark"),
        (["--target", "ball", "--angles", "0"], errors.EXIT_USAGE, "default plan of skin"),
    ],
)
def test_a_wrong_option_is_named(capsys, arguments, code, match):
    assert main(["capture", "gradient", "--dry-run", *arguments]) == code
    assert match in capsys.readouterr().err


def test_target_is_simulated_and_next_step_printed(capsys, tmp_path):
    out = tmp_path / "session-dark"
    assert main(["simulate", "gradient", "--out", str(out), "--target", "dark"]) == errors.EXIT_DONE
    assert verify(out).ok
    printed = capsys.readouterr()
    # the calibration needs flat frames, too
    assert "next: skinrig simulate gradient --target flat" in printed.out + printed.err


def test_a_large_rig_is_not_served(capsys):
    assert main(["serve", "gradient", "--scale", "full"]) == errors.EXIT_BAD_INPUT
    assert "expected small" in capsys.readouterr().err


@pytest.mark.long
def test_served_rig_is_captured_by_printed_command(tmp_path):
    with subprocess.Popen(
        [*SERVE, "--seed", "2"], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as server:
        try:
            found = dict(server.stdout.readline().split() for _ in range(3))
            out = tmp_path / "session"
            run = subprocess.run(
                [
                    sys.executable,
                    "-m",
                    "skinrig.cli",
                    "capture",
                    "gradient",
                    "--port",
                    f"gradient_sphere={found['gradient_sphere']}",
                    "--port",
                    f"caliper={found['caliper']}",
                    "--camera",
                    f"cam={found['cam']}",
                    "--force-limit",
                    "2",
                    "--eyes",
                    "closed",
                    "--angles",
                    "0",
                    "--steps",
                    "-1..1",
                    "--out",
                    str(out),
                ],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=100,
            )
            assert run.returncode == errors.EXIT_DONE, run.stderr
            assert "tape the skin at 0 degrees" in run.stderr
            session = Session.open(out)
            assert session.closed
            assert session.source == "simulated"
            assert session.pending_frames() == []
            assert len(session.frames("gradient")) == 3 * 16
            assert verify(out).ok
        finally:
            server.terminate()
