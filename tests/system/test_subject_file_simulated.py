"""A subject's file from the command line to the truth."""

import json

import numpy as np
import pytest

from model import store
from skinrig.cli import main

QUICK = ["--width", "64", "--omit", "lateral,interreflections,relief_shadows"]
"""What becomes of a file's skin is judged elsewhere: here of its words and numbers."""
FILE = 'schema = "skinrig.subject/1"\npreset = "II"\nmelanin = {melanin}\nfreckles = 0.0\n'


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def truth_of(here, melanin):
    (here / "ann.toml").write_text(FILE.format(melanin=melanin), encoding="utf-8")
    argv = ["simulate", "flash", *QUICK, "--subject", "ann.toml", "--json"]
    assert main([*argv, "--out", f"session-{melanin}"]) == 0
    return store.read(here / f"truth-{melanin}")


@pytest.mark.long
def test_subject_file_melanin_is_truth_citing_file(here, capsys):
    light, dark = (truth_of(here, melanin) for melanin in (0.02, 0.08))
    medians = [
        float(np.median(one.maps["melanin"].values[one.maps["melanin"].valid]))
        for one in (light, dark)
    ]
    # variation is steps of log-odds against the limit of 0.5
    odds = [value / (0.5 - value) for value in (*medians, 0.02, 0.08)]
    assert odds[1] / odds[0] == pytest.approx(odds[3] / odds[2], rel=0.1)
    assert dark.parameters["subject"] == "ann"
    assert dark.parameters["subject_file"] == {
        "file": "ann.toml",
        "preset": "II",
        "melanin": 0.08,
        "freckles": 0.0,
    }
    manifest = json.loads((here / "session-0.08" / "session.json").read_text(encoding="utf-8"))
    assert manifest["subject"]["pseudonym"] == "simulated-ann-0"
    assert str(here) not in json.dumps(manifest)


@pytest.fixture
def killed(here, capsys, monkeypatch):
    """Arguments of a simulation that was interrupted before its first frame."""
    (here / "ann.toml").write_text(FILE.format(melanin=0.02), encoding="utf-8")
    argv = ["simulate", "flash", *QUICK, "--subject", "ann.toml", "--out", "session"]

    def broken(*args, **settings):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("skinrig.simulating.driving.run_plan", broken)
        assert main([*argv, "--consent", "research,teaching"]) == 130
    capsys.readouterr()
    return argv


@pytest.mark.long
def test_session_is_not_resumed_with_changed_subject_file(here, capsys, killed):
    (here / "ann.toml").write_text(FILE.format(melanin=0.03), encoding="utf-8")
    assert main([*killed, "--resume", "--camera-offset-mm", "5", "--seed", "1"]) == 3
    said = capsys.readouterr().err
    assert "resume with the same settings" in said
    told = [line.strip() for line in said.splitlines() if "recorded" in line]
    assert told == [
        "subject ann.toml melanin: recorded with 0.02, got 0.03",
        "seed: recorded with 0, got 1",
        "nearer_mm: recorded without, got 5.0",
    ]
    (here / "ann.toml").write_text(FILE.format(melanin=0.02), encoding="utf-8")
    assert main([*killed, "--resume"]) == 0
    manifest = json.loads((here / "session" / "session.json").read_text(encoding="utf-8"))
    # nothing was said of the consent when it was resumed: it is as it was begun
    assert manifest["subject"]["consent_scope"] == ["research", "teaching"]


@pytest.mark.long
@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--consent", "research"], ["consent: recorded with research, teaching, got research"]),
        (
            ["--consent", "research,teaching", "--consent-expires", "2031-01-01"],
            ["consent_expires: recorded with no end, got 2031-01-01"],
        ),
    ],
)
def test_a_session_is_not_resumed_with_another_consent(here, capsys, killed, options, told):
    assert main([*killed, "--resume", *options]) == 3
    said = capsys.readouterr().err.splitlines()
    assert [line.strip() for line in said if "recorded" in line] == told


@pytest.mark.long
def test_a_consent_is_the_same_in_any_order(killed):
    assert main([*killed, "--resume", "--consent", "teaching,research"]) == 0


@pytest.mark.long
@pytest.mark.parametrize("command", ["plan", "serve"])
def test_effects_invisible_to_rig_are_reported_before_work(here, capsys, monkeypatch, command):
    (here / "ann.toml").write_text(FILE.format(melanin=0.02) + "oil = 2.0\n", encoding="utf-8")

    def stopped(*args, **settings):
        raise KeyboardInterrupt

    monkeypatch.setattr("skinrig.planning.plans.choose", stopped)
    monkeypatch.setattr("skinrig.simulating.gradient.make_scene", stopped)
    assert main([command, "gradient", "--subject", "ann.toml"]) == 130
    said = capsys.readouterr().err
    assert "ann.toml: without effect on the gradient rig: oil" in said
    if command == "serve":
        assert "the same command" not in said


@pytest.mark.long
def test_forecast_uses_skin_from_subject_file(here, capsys):
    found = []
    for melanin in (0.01, 0.2):
        (here / "ann.toml").write_text(FILE.format(melanin=melanin), encoding="utf-8")
        assert main(["plan", "gradient", "--subject", "ann.toml", "--width", "64", "--json"]) == 0
        found.append(json.loads(capsys.readouterr().out)["forecasts"][0]["median"])
    assert main(["plan", "gradient", "--subject", "II", "--width", "64", "--json"]) == 0
    preset = json.loads(capsys.readouterr().out)["forecasts"][0]["median"]
    assert found[0] != found[1]
    assert preset not in found
