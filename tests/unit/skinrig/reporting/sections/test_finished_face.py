"""The finished face in the report: its structure, its link, its place and its size."""

import re

import numpy as np
import pytest
from fixtures.finished_faces import write_face

from skinrig.reporting import report

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
    assert sentence.count(".") == 1
    assert len(sentence.split()) <= 25
    assert "1.3°" in part
    assert "49 % of the skin" in part
    assert "no rig measures it" in part


def test_live_page_is_linked_where_it_exists(folder, tmp_path):
    assert "skinrig view" in report.build([folder], folder=folder)
    (folder / "person.html").write_text("<html></html>")
    elsewhere = tmp_path / "pages"
    for place, address in ((folder, "person.html"), (elsewhere, "../person.html")):
        html = report.build([folder], folder=place)
        assert f'<a href="{address}">Live page of this person</a>' in html
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
