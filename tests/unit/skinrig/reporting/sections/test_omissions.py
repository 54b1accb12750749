"""The report's table of what scenes leave out."""

import json

import pytest

from skinrig.reporting import page
from skinrig.reporting.sections import session as sections_session

EFFECTS = [
    {"name": "shadows", "verdict": "built", "reason": "a face", "over_noise": 55.0, "switch": ""},
    {
        "name": "bounces",
        "verdict": "negligible",
        "reason": "<flat>",
        "over_noise": 0.0,
        "switch": "interreflections",
    },
    {"name": "lens", "verdict": "unmodeled", "reason": "1 px", "over_noise": None, "switch": ""},
]


@pytest.fixture
def session(tmp_path):
    def make(name, extra):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "session.json").write_text(json.dumps({"extra": extra}))
        return folder

    return make


def test_omitted_effects_are_listed_before_built_ones(session):
    html = page.render_fragment(
        sections_session.list_omissions([session("session-a", {"effects": EFFECTS})])
    )
    places = [html.index(word) for word in ("bounces", "lens", "shadows")]
    assert places == sorted(places)
    assert "1 of 3 effects simulated" in html
    assert "&lt;flat&gt;" in html
    assert "<flat>" not in html


def test_sessions_of_similar_scenes_share_table_any_order(session):
    two = [session(name, {"effects": EFFECTS}) for name in ("session-b", "session-a")]
    other = session("session-c", {"effects": EFFECTS[:1]})
    html = page.render_fragment(sections_session.list_omissions([*two, other]))
    assert html.count("<table") == 2
    assert "session-a, session-b" in html
    assert html == page.render_fragment(sections_session.list_omissions([other, *reversed(two)]))


def test_measured_sessions_and_invalid_folders_report_no_omissions(session, tmp_path):
    assert not list(
        sections_session.list_omissions([session("session-real", {}), tmp_path / "nowhere"])
    )
