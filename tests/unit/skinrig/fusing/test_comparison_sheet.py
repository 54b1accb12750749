"""The sheet of a blind comparison: hidden sides, a separate key, and counted answers."""

import base64
import csv
import importlib.util
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from fixtures.finished_faces import matte_head
from PIL import Image

from model import store

PATH = Path(__file__).resolve().parents[4] / "tools" / "make_comparison_sheet.py"
NAMES = ("II-front", "II-left", "III-front", "III-left", "VI-front")
RED, BLUE = (200, 40, 40), (40, 40, 200)


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("make_comparison_sheet", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def folders(tmp_path):
    """Return a folder of red images and one of blue ones."""
    for name, color in (("ours", RED), ("photographs", BLUE)):
        (tmp_path / name).mkdir()
        for stem in NAMES:
            Image.new("RGB", (120, 150), color).save(tmp_path / name / f"{stem}.png")
    return tmp_path / "ours", tmp_path / "photographs"


def colors(html):
    """Return whether each image of a page is red, in pairs of left and right."""
    found = []
    for address in re.findall(r'src="data:image/jpeg;base64,([^"]+)"', html):
        image = np.asarray(Image.open(io.BytesIO(base64.b64decode(address))), float)
        red, _, blue = image.mean(axis=(0, 1))
        found.append(bool(red > blue))
    return list(zip(found[::2], found[1::2], strict=True))


def answers(key, chosen, observer="P1"):
    """Return the rows of an observer who chooses these sides."""
    return [
        {"sheet": key["sheet"], "observer": observer, "trial": str(one["trial"]), "answer": side}
        for one, side in zip(key["trials"], chosen, strict=True)
    ]


def test_key_alone_names_sides_and_pairs(tool, folders):
    html, key = tool.make_sheet(*folders, seed=1)
    shown = colors(html)
    assert len(shown) == len(key["trials"]) == 2 * len(NAMES)
    assert shown == [(one["left"] == "A", one["left"] == "B") for one in key["trials"]]
    for name in (*NAMES, *(folder.name for folder in folders)):
        assert name not in html
        assert name in json.dumps(key)
    assert not re.search(r'(?:src|href)="(?!data:)', html)


def test_sides_are_balanced_and_order_follows_seed(tool, folders):
    html, key = tool.make_sheet(*folders, seed=1)
    sides = {name: {one["left"] for one in key["trials"] if one["pair"] == name} for name in NAMES}
    assert all(both == {"A", "B"} for both in sides.values())
    assert tool.make_sheet(*folders, seed=1) == (html, key)
    orders = {tuple(one["pair"] for one in tool.arrange_trials(NAMES, 2, s)) for s in range(10)}
    assert len(orders) == 10
    # one trial per pair: a place in the order says nothing of the side
    left = np.array(
        [[one["left"] == "A" for one in tool.arrange_trials(NAMES, 1, s)] for s in range(400)]
    )
    assert set(left.sum(axis=1)) == {2, 3}
    np.testing.assert_allclose(left.mean(axis=0), 0.5, atol=4 * 0.5 / 400**0.5)


def test_unanimous_answers_have_closed_form_interval(tool, folders):
    _, key = tool.make_sheet(*folders, seed=1)
    chosen = ["left" if one["left"] == "A" else "right" for one in key["trials"]]
    found = tool.evaluate(key, answers(key, chosen) + answers(key, chosen, "P2"))
    assert (found["answers"], found["chose_a"], found["fraction"]) == (20, 20, 1.0)
    np.testing.assert_allclose(found["interval_95"], [0.025 ** (1 / 20), 1.0])
    assert found["p_value"] == pytest.approx(2 * 0.5**20)
    assert set(found["observers"]) == {"P1", "P2"}
    assert found["pairs"]["II-left"]["answers"] == 4
    others = tool.evaluate(key, answers(key, ["left"] * 10))
    assert others["chose_a"] == sum(one["left"] == "A" for one in key["trials"]) == 5


def test_interval_covers_planted_preference(tool, folders, rng):
    _, key = tool.make_sheet(*folders, seed=1)
    prefers, covered = 0.7, []
    for _ in range(300):
        for_a = rng.random(len(key["trials"])) < prefers
        chosen = [
            "left" if a == (one["left"] == "A") else "right"
            for a, one in zip(for_a, key["trials"], strict=True)
        ]
        low, high = tool.evaluate(key, answers(key, chosen))["interval_95"]
        covered.append(low <= prefers <= high)
    assert 0.95 - 3 * (0.95 * 0.05 / 300) ** 0.5 <= np.mean(covered) < 1.0


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"answer": "both"}, "left or right"),
        ({"trial": "99"}, "1 to 10"),
        ({"trial": "2"}, "two answers of 'P1' to trial 2"),
    ],
)
def test_invalid_answers_are_refused(tool, folders, change, says):
    _, key = tool.make_sheet(*folders, seed=1)
    rows = answers(key, ["left"] * 10)
    rows[0] |= change
    with pytest.raises(tool.ComparisonError, match=says):
        tool.evaluate(key, rows)
    with pytest.raises(tool.ComparisonError, match="none"):
        tool.evaluate(key, [])


def test_command_writes_sheet_and_counts_its_answers(tool, folders, tmp_path, capsys):
    out, key_file, table = (tmp_path / name for name in ("s.html", "k.json", "answers.csv"))
    made = [*map(str, folders), "--out", str(out), "--key", str(key_file), "--seed", "3"]
    assert tool.main(["sheet", *made]) == 0
    key = json.loads(key_file.read_text())
    for sheet, status in ((key["sheet"], 0), ("another", 1)):
        with table.open("w", newline="") as text:
            writer = csv.DictWriter(text, tool.ANSWER_COLUMNS)
            writer.writeheader()
            writer.writerows(row | {"sheet": sheet} for row in answers(key, ["right"] * 10))
        assert tool.main(["evaluate", str(key_file), str(table)]) == status
    captured = capsys.readouterr()
    assert json.loads(captured.out)["chose_a"] == 5
    assert f"another, expected {key['sheet']}" in captured.err
    (folders[1] / "II-left.png").unlink()
    assert tool.main(["sheet", *made]) == 1
    assert "equal names" in capsys.readouterr().err


def test_fitted_maps_are_lit_from_three_sides(tool, tmp_path, monkeypatch):
    monkeypatch.setattr(tool, "IMAGE_PX", (48, 54))
    appearance, _ = matte_head()
    found = tool.read_faces(store.write(tmp_path / "maps", appearance))
    assert list(found) == ["left", "front", "right"]
    balance = [image[:, :24].astype(float).sum() / image[:, 24:].sum() for image in found.values()]
    assert balance[0] > 1.5
    assert balance[2] < 1 / 1.5
    assert balance[1] == pytest.approx(1.0, abs=0.05)
