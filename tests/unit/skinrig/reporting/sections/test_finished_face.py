"""The finished face in the report: its structure, its link, its place and its size."""

import json
import re
import shlex
from types import SimpleNamespace

import numpy as np
import pytest
from fixtures.finished_faces import write_face

from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig.reporting import report
from skinrig.reporting.folders import ReportError
from skinrig.reporting.sections import finished_face

MAX_SHEET_KB = 100


@pytest.fixture
def folder(tmp_path):
    write_face(tmp_path / "finished-face")
    return tmp_path


def test_buttons_and_caption_describe_the_face(folder):
    html = report.build([folder])
    part = html[html.index('<h2 id="the-finished-face">') :]
    radios = re.findall(r'<input type="radio" name="([^"]+)" id="([^"]+)"( checked)?>', part)
    assert len(radios) == 5
    assert len({name for name, _, _ in radios}) == 1
    assert [bool(checked) for _, _, checked in radios] == [False, True, False, False, False]
    labels = re.findall(r'<label for="([^"]+)">([^<]+)</label>', part)
    assert [name for name, _ in labels] == [identity for _, identity, _ in radios]
    assert [text for _, text in labels] == ["left", "half left", "front", "half right", "right"]
    assert part.count('type="checkbox"') == 1
    assert re.search(r'<img alt="Face of double from the front, lit from left[^"]+anger"', part)
    sentence = re.search(r"<p>([^<]+)</p>", part)[1]
    assert "are measured" in sentence
    assert "independent of the measurements" in sentence
    assert "Eyes and hair are not measured" in sentence
    assert max(len(one.split()) for one in sentence.split(".")) <= 25
    assert "1.3°" in part
    assert "49 % of the skin" in part
    assert "no rig measures it" in part
    assert "older than the maps" not in part


def test_live_page_is_linked_where_it_exists(folder, tmp_path):
    assert "skinrig view" in report.build([folder], folder=folder)
    (folder / "person.html").write_text("<html></html>")
    elsewhere = tmp_path / "pages"
    for place, address in ((folder, "person.html"), (elsewhere, "../person.html")):
        html = report.build([folder], folder=place)
        assert f'<a href="{address}">Live page of this person</a>' in html
        assert "Its eyes, hair, crown and neck are not measured." in html
        assert "skinrig view" not in html
    assert "Live page of this person</a>" not in report.build([folder])


def test_two_faces_have_buttons_of_their_own(folder):
    write_face(folder / "other-face")
    html = report.build([folder])
    names = re.findall(r'<input type="radio" name="([^"]+)"', html)
    assert len(names) == 10
    assert len(set(names)) == 2
    found = re.findall(r' id="([^"]+)"', html)
    assert len(found) == len(set(found))


def test_face_alone_is_a_report_without_requests(folder):
    html = report.build([folder / "finished-face"])
    assert "Contents: 1 finished face. All data are simulated; no person was measured." in html
    assert not re.search(r'(?:src|href)="(?!data:|#)', html)
    assert html == report.build([folder / "finished-face"])


def test_consent_of_measured_person_is_listed(tmp_path):
    write_face(tmp_path / "face", source="measured")
    html = report.build([tmp_path / "face"])
    part = html[html.index('<h2 id="consent">') :]
    assert re.search("unknown.*nothing.*face", part, re.DOTALL)
    assert "All data are measured." in html
    simulated = report.build([write_face(tmp_path / "simulated")])
    assert 'id="consent"' not in simulated
    assert "All data are simulated; no person was measured." in simulated


def test_textured_sheet_stays_below_its_size(tmp_path):
    """Rationale: the report has 3 MB; frames with the detail of skin take 3 % of it."""
    y, x = np.mgrid[-1.0:1.0:270j, -1.0:1.0:240j]
    inside = x**2 + y**2 < 0.8
    grain = np.random.default_rng(0).normal(0.0, 3.0, (270, 240))
    shade = [
        np.clip(150.0 + 60.0 * (x * np.sin(a) - y * 0.3) + grain, 0, 255)
        for a in np.linspace(-1.0, 1.0, 5)
    ]
    face = np.where(inside, np.stack(shade), 42.0).astype(np.uint8)
    frames = np.repeat(np.repeat(face[:, None, ..., None], 5, axis=1), 3, axis=-1)
    sheet = write_face(tmp_path / "face", frames) / "frames.webp"
    assert 10e3 < sheet.stat().st_size < 1e3 * MAX_SHEET_KB


def test_names_with_special_characters_are_quoted(tmp_path):
    folder = tmp_path / "my demo #2"
    write_face(folder / "finished-face")
    html = report.build([folder], folder=tmp_path)
    command = html[html.index("skinrig view ") :].split("<")[0].replace("&#39;", "'")
    assert shlex.split(command)[2:] == [str(folder / "double"), "-o", str(folder / "person.html")]
    (folder / "person.html").write_text("<html></html>")
    assert 'href="my%20demo%20%232/person.html"' in report.build([folder], folder=tmp_path)


def test_live_page_on_another_drive_has_no_link(folder, monkeypatch):
    (folder / "person.html").write_text("<html></html>")

    def other_drive(*_):
        raise ValueError("path is on mount 'D:'")

    monkeypatch.setattr(
        finished_face, "os", SimpleNamespace(path=SimpleNamespace(relpath=other_drive))
    )
    assert "skinrig view" in report.build([folder], folder=folder)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"schema": "skinrig.finished-face/0"}, "finished-face/0"),
        ({"schema": None}, "schema"),
        ({"person": None}, "'person'"),
        ({"inputs": None}, "'inputs'"),
        ({"weights": [0.0]}, "1 weights, expected 5"),
        ({"lights": {"left": 0.0}}, "1 lights, expected 5"),
        ({"left_out": ["eyes"]}, "left_out"),
    ],
)
def test_invalid_record_is_one_clear_error(folder, change, says):
    path = folder / "finished-face" / "finished_face.json"
    document = json.loads(path.read_text(encoding="utf-8")) | change
    path.write_text(json.dumps({k: v for k, v in document.items() if v is not None}))
    with pytest.raises(ReportError, match=says) as caught:
        report.build([folder])
    assert str(path) in str(caught.value)


def test_damaged_files_are_clear_errors(folder):
    sheet = folder / "finished-face" / "frames.webp"
    sheet.unlink()
    with pytest.raises(ReportError, match=r"frames\.webp.*again"):
        report.build([folder])
    path = sheet.with_name("finished_face.json")
    path.write_text(path.read_text(encoding="utf-8")[:-20])
    with pytest.raises(ReportError, match=r"finished_face\.json"):
        report.build([folder])


def test_changed_maps_are_reported(folder):
    changed = SkinAppearance({"r_d": SkinMap(np.full((4, 4, 3), 0.4), "1")}, "simulated")
    store.write(folder / "double", changed)
    assert "older than the maps in double:" in report.build([folder / "finished-face"])


def test_people_in_simulated_frames_are_not_denied(folder):
    path = folder / "finished-face" / "finished_face.json"
    subject = {"pseudonym": "P1", "consent_scope": ["research"], "consent_expires": None}
    document = json.loads(path.read_text(encoding="utf-8")) | {"consent": [subject]}
    path.write_text(json.dumps(document))
    html = report.build([folder / "finished-face"])
    assert "no person was measured" not in html
    assert "some of their inputs are measured" in html
