"""The sheet of a blind comparison: hidden sides, a separate key, and counted answers."""

import base64
import csv
import dataclasses
import importlib.util
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from fixtures.finished_faces import matte_head
from PIL import Image, ImageCms

from capture.session import ConsentError
from model import store
from skinrig.errors import UsageError

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


def test_unanimous_observers_have_closed_form_interval(tool, folders):
    _, key = tool.make_sheet(*folders, seed=1)
    chosen = ["left" if one["left"] == "A" else "right" for one in key["trials"]]
    names = ["P1", "P2", "P3"]
    rows = [row for name in names for row in answers(key, chosen, name)]
    found = tool.evaluate(key, rows)
    assert (found["answers"], found["chose_a"], found["fraction"]) == (30, 30, 1.0)
    assert "p_value" not in found
    signs = found["sign_test"]
    assert (signs["prefer_a"], signs["prefer_b"], signs["ties"]) == (3, 0, 0)
    np.testing.assert_allclose(signs["interval_95"], [0.025 ** (1 / 3), 1.0])
    assert signs["p_value"] == pytest.approx(2 * 0.5**3)
    assert set(found["observers"]) == set(names)
    assert found["pairs"]["II-left"]["answers"] == 6
    assert found["missing_trials"] == 0


def test_side_bias_and_missing_trials_are_counted(tool, folders):
    _, key = tool.make_sheet(*folders, seed=1)
    found = tool.evaluate(key, answers(key, ["left"] * 10))
    assert found["chose_a"] == sum(one["left"] == "A" for one in key["trials"]) == 5
    assert found["fraction_left"] == 1.0
    assert found["sign_test"]["ties"] == 1
    assert found["sign_test"]["interval_95"] is None
    found = tool.evaluate(key, answers(key, ["right"] * 10) + answers(key, ["left"] * 10, "P2")[3:])
    assert found["missing_trials"] == 3
    assert found["observers"]["P2"]["missing_trials"] == 3
    assert found["fraction_left"] == pytest.approx(7 / 17)


def test_interval_covers_planted_preference_of_observers(tool, folders, rng):
    """Rationale: an observer gives equal answers to all pairs; only observers are independent."""
    _, key = tool.make_sheet(*folders, seed=1)
    prefers, observers, covered = 0.7, 8, []
    for _ in range(200):
        rows = []
        for number, for_a in enumerate(rng.random(observers) < prefers):
            chosen = ["left" if for_a == (one["left"] == "A") else "right" for one in key["trials"]]
            rows += answers(key, chosen, f"P{number}")
        low, high = tool.evaluate(key, rows)["sign_test"]["interval_95"]
        covered.append(low <= prefers <= high)
    assert 0.95 - 3 * (0.95 * 0.05 / 200) ** 0.5 <= np.mean(covered) <= 1.0


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
    for sheet, status in ((key["sheet"], 0), ("another", 2)):
        with table.open("w", newline="") as text:
            writer = csv.DictWriter(text, tool.ANSWER_COLUMNS)
            writer.writeheader()
            writer.writerows(row | {"sheet": sheet} for row in answers(key, ["right"] * 10))
        assert tool.main(["evaluate", str(key_file), str(table)]) == status
    captured = capsys.readouterr()
    assert json.loads(captured.out)["chose_a"] == 5
    assert f"another, expected {key['sheet']}" in captured.err
    (folders[1] / "II-left.png").unlink()
    assert tool.main(["sheet", *made]) == 2
    assert "equal names" in capsys.readouterr().err
    assert tool.main(["sheet", *made[:-1], "-1"]) == 2
    assert "--seed: got -1" in capsys.readouterr().err
    (folders[1] / "II-left.png").write_bytes(b"not an image")
    assert tool.main(["sheet", *made]) == 2
    assert "II-left.png" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["{}", "[]", "{", '{"sheet": "a", "trials": [{"trial": 1}]}'])
def test_damaged_key_is_one_clear_error(tool, tmp_path, capsys, text):
    path = tmp_path / "key.json"
    path.write_text(text)
    assert tool.main(["evaluate", str(path), str(tmp_path / "answers.csv")]) == 2
    error = capsys.readouterr().err
    assert str(path) in error
    assert error.count("\n") == 1


def test_images_of_other_modes_are_refused(tool, tmp_path):
    Image.fromarray(np.full((9, 8), 30000, np.uint16)).save(tmp_path / "one.png")
    with pytest.raises(tool.ComparisonError, match=r"one.png: got mode I;16"):
        tool.read_faces(tmp_path)


def test_two_images_of_one_name_are_refused(tool, tmp_path):
    for suffix in ("png", "jpg"):
        Image.new("RGB", (8, 9), RED).save(tmp_path / f"one.{suffix}")
    with pytest.raises(tool.ComparisonError, match="two images named one"):
        tool.read_faces(tmp_path)


def test_transparent_pixels_show_the_background(tool, tmp_path):
    Image.new("RGBA", (8, 9), (*RED, 0)).save(tmp_path / "clear.png")
    Image.new("RGBA", (8, 9), (*RED, 255)).save(tmp_path / "solid.png")
    found, _ = tool.read_faces(tmp_path)
    assert found["clear"][0, 0].tolist() == [40, 42, 45]
    assert found["solid"][0, 0].tolist() == list(RED)


def test_profile_of_an_image_is_converted(tool, tmp_path):
    """Rationale: a profile with exchanged red and blue primaries exchanges red and blue."""
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    exchanged = srgb.replace(b"rXYZ", b"XYZ_").replace(b"bXYZ", b"rXYZ").replace(b"XYZ_", b"bXYZ")
    for name, profile in (("same", srgb), ("exchanged", exchanged)):
        Image.new("RGB", (8, 9), RED).save(tmp_path / f"{name}.png", icc_profile=profile)
    found, _ = tool.read_faces(tmp_path)
    np.testing.assert_allclose(found["same"][0, 0], RED, atol=1)
    np.testing.assert_allclose(found["exchanged"][0, 0], BLUE, atol=2)
    lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes()
    Image.new("RGB", (8, 9), RED).save(tmp_path / "other.png", icc_profile=lab)
    with pytest.raises(tool.ComparisonError, match=r"other.png: ICC profile"):
        tool.read_faces(tmp_path)


def test_fitted_maps_are_lit_from_three_sides(tool, tmp_path, monkeypatch):
    monkeypatch.setattr(tool, "IMAGE_PX", (48, 54))
    appearance, _ = matte_head()
    found, agreed = tool.read_faces(store.write(tmp_path / "maps", appearance))
    assert agreed == []
    assert list(found) == ["left", "front", "right"]
    balance = [image[:, :24].astype(float).sum() / image[:, 24:].sum() for image in found.values()]
    assert balance[0] > 1.5
    assert balance[2] < 1 / 1.5
    assert balance[1] == pytest.approx(1.0, abs=0.05)


def test_measured_people_need_their_consent(tool, tmp_path, monkeypatch):
    monkeypatch.setattr(tool, "IMAGE_PX", (48, 54))
    subject = {"pseudonym": "P1", "consent_scope": ["research"], "consent_expires": None}
    appearance, _ = matte_head()
    measured = dataclasses.replace(appearance, source="measured", parameters={"consent": [subject]})
    folder = store.write(tmp_path / "maps", measured)
    with pytest.raises(ConsentError, match="P1"):
        tool.make_sheet(folder, folder, seed=1, use="publication")
    with pytest.raises(UsageError, match="--use"):
        tool.make_sheet(folder, folder, seed=1)
    _, key = tool.make_sheet(folder, folder, seed=1, use="research")
    assert key["consent"] == {"A": ["P1: research"], "B": ["P1: research"]}
