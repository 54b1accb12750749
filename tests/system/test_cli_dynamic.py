"""`skinrig fit` and `skinrig apply` as a user calls them."""

import json

import numpy as np
import pytest

from model import store
from model.facial_color import HemoglobinRig
from model.facial_color import document as facial_color_document
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.appearances import dynamic
from skinrig.cli import main

SIDE = 40


@pytest.fixture
def moving(tmp_path):
    rng = np.random.default_rng(3)
    neutral = np.clip(0.02 + 0.004 * rng.standard_normal((SIDE, SIDE)), 0.005, 0.05)
    rig = HemoglobinRig.from_maps(neutral, {"smile": 1.5 * neutral}, radius_px=6.0)
    maps, document = facial_color_document.to_maps(rig)
    maps["melanin"] = SkinMap(np.full((SIDE, SIDE), 0.03, np.float32), MAP_UNITS["melanin"])
    files = {facial_color_document.RIG_DOCUMENT: document}
    dynamic.add(
        tmp_path / "moving",
        dynamic.FACIAL_COLOR,
        SkinAppearance(maps, "simulated", {}, {}, files=files),
    )
    return tmp_path / "moving"


def test_expression_is_evaluated_and_reported_in_single_document(moving, tmp_path, capsys):
    out = tmp_path / "out"
    code = main(
        [
            "apply",
            "expression",
            str(moving),
            "--weights",
            "smile=0.5,neutral=0.5",
            "--out",
            str(out),
            "--json",
        ]
    )
    assert code == 0
    document = json.loads(capsys.readouterr().out)
    assert document["schema"] == "skinrig.apply/1"
    assert set(document["maps"]) == {"hemoglobin", "melanin", "color"}
    assert document["figures"]["facial_color"]["clipped_fraction"] == 0.0
    assert (out / store.DOCUMENT_FILE).is_file()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--weights", "smile=0.5"], "normalize"),
        (["--weights", "smlie=1"], "did you mean 'smile'"),
        (["--weights", "smile"], "NAME=NUMBER"),
        (["--weights", "smile=1", "--clamp", "none"], "--clamp"),
        (["--weights", "smile=1", "--parts", "hair"], "parts"),
        (["--weights", "smile=1", "--landmarks", "a.csv"], "--target-face"),
        (["--weights", "smile=1", "--mesh", "nowhere.npz"], "nowhere.npz"),
    ],
)
def test_unevaluable_expression_gives_single_sentence_and_no_output(
    moving, tmp_path, capsys, arguments, words
):
    out = tmp_path / "out"
    code = main(["apply", "expression", str(moving), "--out", str(out), *arguments])
    captured = capsys.readouterr()
    assert code in (2, 3)
    last = captured.err.strip().splitlines()[-1]
    assert words in last
    assert "Traceback" not in captured.err
    assert not out.exists()


def test_fits_refuse_folders_without_required_inputs(moving, tmp_path, capsys):
    plain = tmp_path / "plain"
    store.write(plain, SkinAppearance({}, "measured", parameters={"kind": "appearance"}))
    for command, words in (
        (["fit", "microstructure", str(plain)], "kernels.json"),
        (["fit", "wrinkles", f"neutral={plain}", f"smile={plain}"], "normals"),
        (["fit", "facial-color", str(plain)], "session"),
    ):
        code = main([*command, "--out", str(tmp_path / "new")])
        assert code == 3
        assert words in capsys.readouterr().err
        assert not (tmp_path / "new").exists()
    # a folder of other maps is not overwritten
    assert main(["fit", "microstructure", str(plain), "--out", str(plain)]) == 3
    assert "it was not changed" in capsys.readouterr().err


def test_state_repeats_are_captured_in_alternation(tmp_path, capsys):
    """Each expression several times, with the others in between (Jimenez2010, section 3)."""
    plan = tmp_path / "plan.json"
    code = main(
        [
            "capture",
            "flash",
            "--dry-run",
            "--state",
            "neutral",
            "--state",
            "smile",
            "--repeats",
            "2",
            "--port",
            "flash=sim://x/flash",
            "--camera",
            "cam=sim://x/cam",
            "--plan-out",
            str(plan),
        ]
    )
    assert code == 0
    steps = json.loads(plan.read_text("utf-8"))["steps"]
    shown = [(s["index"]["state"], s["index"]["repeat"]) for s in steps if s["kind"] == "subject"]
    assert list(dict.fromkeys(shown)) == [
        ("neutral", 0),
        ("smile", 0),
        ("neutral", 1),
        ("smile", 1),
    ]
    code = main(["capture", "dome", "--dry-run", "--state", "smile"])
    assert code == 2
    assert "--state" in capsys.readouterr().err
