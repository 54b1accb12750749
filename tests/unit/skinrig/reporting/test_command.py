"""`skinrig report` as a user runs it: what it prints, what it leaves behind, what it promises."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig import atomic_file
from skinrig.appearances.front_view import FRONT_VIEW_WIDTH_PX
from skinrig.cli import main
from skinrig.reporting import map_images, verdict
from skinrig.reporting.comparison import maps as map_comparison
from skinrig.reporting.comparison import runs as run_comparison

PAGE = Path(__file__).parents[4] / "docs" / "how-to" / "report.md"


@pytest.fixture
def maps(tmp_path):
    for name, level in (("monday", 0.05), ("tuesday", 0.06)):
        melanin = np.full((20, 30), level)
        store.write(
            tmp_path / name,
            SkinAppearance(
                {"melanin": SkinMap(melanin, MAP_UNITS["melanin"], np.full(melanin.shape, 0.001))},
                "measured",
            ),
        )
    return tmp_path


def test_report_states_whether_runs_are_reported_or_compared(maps, capsys):
    out = maps / "page.html"
    assert main(["report", str(maps / "monday"), "-o", str(out)]) == 0
    assert "No limit was checked" in capsys.readouterr().out
    assert "Largest uncertainties" in out.read_text("utf-8")
    both = [str(maps / "monday"), str(maps / "tuesday")]
    assert main(["report", *both, "-o", str(out)]) == 0
    assert "compared A: monday with B: tuesday; --no-compare" in capsys.readouterr().out
    assert "in combined standard uncertainties" in out.read_text("utf-8")
    assert main(["report", *both, "--no-compare", "-o", str(out), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["compared"] is None
    assert told["bytes"] == out.stat().st_size
    assert [p.name for p in maps.iterdir() if p.name.startswith(".")] == []


def test_page_folder_is_created_like_map_folders(maps):
    out = maps / "reports" / "today" / "page.html"
    assert main(["report", str(maps / "monday"), "-o", str(out)]) == 0
    assert [p.name for p in out.parent.iterdir()] == ["page.html"]


def test_incomparable_inputs_are_refused_and_nothing_is_written(maps, capsys):
    out = maps / "page.html"
    assert main(["report", str(maps / "monday"), "--compare", "-o", str(out)]) == 3
    assert "expected two of one kind" in capsys.readouterr().err
    assert not out.exists()


def test_failed_page_write_keeps_old_page_only(maps, monkeypatch):
    out = maps / "page.html"
    out.write_text("old")

    def full(*_):
        raise OSError(28, "No space left on device", str(out))

    monkeypatch.setattr(atomic_file.os, "replace", full)
    assert main(["report", str(maps / "monday"), "-o", str(out)]) == 3
    assert out.read_text() == "old"
    assert [p.name for p in maps.iterdir() if p.name.startswith(".")] == []


def test_a_document_that_is_damaged_is_named(maps, capsys):
    (maps / "bench.json").write_text('{"schema": "skinrig.bench/2"')
    assert main(["report", str(maps), "-o", str(maps / "page.html")]) == 3
    message = capsys.readouterr().err
    assert "bench.json: cannot be read as JSON" in message
    assert "Traceback" not in message


@pytest.mark.parametrize(
    ("words", "value"),
    [
        (r"coverage below (\d+) %", 100 * verdict.MIN_COVERAGE),
        (r"or above (\d+) %", 100 * verdict.MAX_COVERAGE),
        (r"more than (\d+) % masked", 100 * verdict.MAX_UNREMARKED_MASK),
        (r"more than (\d+) % of the pixels differ", 100 * map_comparison.MAX_FRACTION_BEYOND),
        (r"within (\d+) mm in the median", run_comparison.MAX_SAME_POINT_MM),
        (r"have (\d+) colors", map_images.SCALE_COLORS),
        (r"faces from the front \| (\d+)", FRONT_VIEW_WIDTH_PX),
    ],
)
def test_documentation_page_on_reports_matches_program_numbers(words, value):
    text = " ".join(PAGE.read_text("utf-8").split())
    assert float(re.search(words, text)[1]) == value
