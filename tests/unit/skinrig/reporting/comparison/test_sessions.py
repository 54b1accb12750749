"""The verdict on person and state in the comparison of two sessions, on the page and as JSON."""

import json

import numpy as np
import pytest

from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.cli import main
from skinrig.reporting import report

SIDE = 24


def write_session(folder, *, level=0.03, frames="a", seed=0):
    """Write maps of a face whose stated uncertainty is 10 %, and its noise 1 %."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-50.0, 50.0, SIDE), np.linspace(60.0, -60.0, SIDE))
    position = np.stack([x, y, 80.0 - 0.01 * (x**2 + y**2)], axis=-1)
    melanin = level * (1.0 + 0.01 * rng.standard_normal((SIDE, SIDE)))
    maps = {
        "melanin": SkinMap(melanin, MAP_UNITS["melanin"], np.full_like(melanin, 0.1 * level)),
        "melanin_noise_stderr": SkinMap(np.full_like(melanin, 0.01 * level), "1"),
        "position": SkinMap(position, "mm"),
    }
    store.write(folder, SkinAppearance(maps, "measured", inputs={"session": frames}))
    return folder


@pytest.fixture
def monday(tmp_path):
    return write_session(tmp_path / "monday")


def test_page_of_one_person_states_yes_first(monday, tmp_path):
    tuesday = write_session(tmp_path / "tuesday", frames="b", seed=1)
    made = report.build_any([monday, tuesday])
    assert made.sessions["monday and tuesday"].same
    lead = made.html[made.html.index("<main") : made.html.index("<h2")]
    assert "Same person, same state: yes, by 2 quantities" in lead


def test_page_of_darker_skin_states_no_and_size(monday, tmp_path):
    tanned = write_session(tmp_path / "tanned", frames="b", seed=1, level=0.036)
    made = report.build_any([monday, tanned])
    assert not made.sessions["monday and tanned"].same
    assert "Same person, same state: no, by melanosome volume fraction +18" in made.html


def test_same_frames_get_no_verdict(monday, tmp_path):
    again = write_session(tmp_path / "again", seed=1)
    made = report.build_any([monday, again])
    assert not made.sessions
    assert "No verdict on person and state: both are of the same frames" in made.html


def test_json_has_verdict_and_quantities(monday, tmp_path, capsys):
    tanned = write_session(tmp_path / "tanned", frames="b", seed=1, level=0.036)
    out = tmp_path / "page.html"
    assert main(["report", str(monday), str(tanned), "-o", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["sessions"]["monday and tanned"]
    assert found["same"] is False
    assert found["false_alarm"] == 0.01
    assert found["quantities"][0]["name"] == "melanin"
    assert found["quantities"][0]["changed"] is True
