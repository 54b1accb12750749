import dataclasses
import json
import re
import shutil

import numpy as np
import pytest

from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from reconstruction.pipeline.graph import UNWANTED_REASON
from reconstruction.pipeline.probe.stages import SUBSURFACE_FILE
from skinrig.benchmarks.document import to_document
from skinrig.benchmarks.results import Limit, Point, StageBenchmark, Timing
from skinrig.reporting import page, report
from skinrig.reporting.drawn_sections import DrawnSections
from skinrig.reporting.folders import discover
from skinrig.reporting.sections import subsurface
from skinrig.reporting.sections.chromophore import draw_panels


@pytest.fixture
def folder(tmp_path, rng):
    truth = 0.05 + 0.1 * rng.random((24, 32))
    noise = rng.normal(0, 0.002, truth.shape)
    stderr = np.full(truth.shape, 0.002)
    store.write(
        tmp_path / "appearance",
        SkinAppearance(
            {"melanin": SkinMap(truth + noise, MAP_UNITS["melanin"], stderr)},
            "simulated",
            parameters={"truth": "truth-flash", "assumed": ["<b>flat</b> light"]},
            inputs={"session": "0123456789abcdef0123"},
            left_out=(("tsumura", "not wanted"), ("monk", UNWANTED_REASON)),
        ),
    )
    maps = {
        n: SkinMap(truth, MAP_UNITS["melanin"] if n == "melanin" else "1")
        for n in ("melanin", "melanin_blurred")
    }
    store.write(
        tmp_path / "truth-flash", SkinAppearance(maps, "simulated", parameters={"kind": "truth"})
    )
    points = tuple(
        Point({"n": n}, Timing(n, (n, n), 2 * n, 1.0), 1 / n, (0.9 / n, 1.1 / n)) for n in (1, 2, 4)
    )
    stage = StageBenchmark("inversion", "error, %", "truth", 0.1, points, (Limit("s", 2, 1, "<="),))
    (tmp_path / "bench.json").write_text(json.dumps(to_document([stage])))
    return tmp_path


def test_page_is_reproducible_and_requests_nothing(folder):
    html = report.build([folder])
    assert html == report.build([folder])
    assert "default-src 'none'" in html
    assert "http://" not in html.replace("http://www.w3.org", "")
    assert html.count("<script") == 1


def test_tables_below_checks_are_folded(folder):
    html = report.build([folder])
    unfolded = re.sub("<details>.*?</details>", "", html, flags=re.DOTALL)
    captions = re.findall("<caption[^>]*>([^<]*)", unfolded)
    assert [one.split(",")[0] for one in captions] == [
        "Missed limits",
        "Measured values and limits",
    ]
    assert html.count("<table") >= len(captions) + 4


def test_stages_that_nobody_requested_are_not_listed(folder):
    html = report.build([folder])
    assert "tsumura" in html
    assert "monk" not in html


def test_sections_of_unchanged_maps_are_not_redrawn(folder, monkeypatch):
    drawn = DrawnSections()
    first = report.build([folder], drawn=drawn)
    with monkeypatch.context() as patch:
        patch.setattr(report.chromophore, "draw_panels", None)  # drawing would raise
        patch.setattr(report.bench.bench_figures, "plot_error_against_time", None)
        assert report.build([folder], drawn=drawn) == first == report.build([folder], drawn=drawn)


@pytest.mark.parametrize("changed", ["appearance", "truth-flash"])
def test_sections_of_changed_maps_are_redrawn(changed, folder):
    drawn = DrawnSections()
    first = report.build([folder], drawn=drawn)
    maps = store.read(folder / changed)
    lighter = dataclasses.replace(maps.maps["melanin"], values=0.5 * maps.maps["melanin"].values)
    edited = dataclasses.replace(maps, maps={**maps.maps, "melanin": lighter})
    shutil.rmtree(folder / changed)
    store.write(folder / changed, edited)
    again = report.build([folder], drawn=drawn)
    assert again != first
    assert again == report.build([folder])


def test_truth_estimate_error_and_stderr_are_adjacent(folder):
    html = report.build([folder])
    for title in (
        "ground truth",
        "estimate",
        "estimate − ground truth",
        "68 % credible half-width",
    ):
        assert f"<figcaption>{title}</figcaption>" in html


def test_missed_limit_is_reported_first(folder):
    html = report.build([folder])
    assert "1 of 2 checks missed" in html
    assert html.index("missed</td>") < html.index("kept</td>")


def test_text_from_files_cannot_become_markup(folder):
    html = report.build([folder])
    assert "<b>flat" not in html
    assert "&lt;b&gt;flat" in html


def test_maps_without_truth_are_reported_with_stderr(folder):
    html = report.build([folder / "appearance"])
    assert "No ground truth is given" in html
    assert "estimate − ground truth" not in html


@pytest.mark.parametrize("light", [0.0, 0.2])
def test_specular_image_without_light_is_not_drawn(tmp_path, light):
    maps = {
        "image": SkinMap(np.full((8, 8, 3), 0.4), "1"),
        "specular_image": SkinMap(np.full((8, 8, 3), light), "1"),
    }
    store.write(tmp_path / "photograph", SkinAppearance(maps, "simulated"))
    html = report.build([tmp_path])
    assert "captured image, linear RGB" in html
    assert ("specular image, linear RGB" in html) == (light > 0.0)


def test_empty_folder_is_refused_with_remedy(tmp_path):
    with pytest.raises(report.ReportError, match="skinrig demo"):
        report.build([tmp_path])
    with pytest.raises(report.ReportError, match="does not exist"):
        report.build([tmp_path / "nothing"])


def test_first_screen_states_absence_of_measured_subjects(folder):
    assert "All data are simulated; no person was measured." in report.build([folder])
    document = json.loads((folder / "appearance" / "appearance.json").read_text())
    found = discover([folder])
    assert found.summary().endswith("All data are simulated; no person was measured.")
    document["source"] = "measured"
    (folder / "appearance" / "appearance.json").write_text(json.dumps(document))
    assert found.summary().endswith("All data are measured.")


def test_map_of_rounding_alone_shows_no_structure(rng):
    noise = 1e-11 * rng.random((24, 32))

    def shown(values):
        appearance = SkinAppearance({"gamut_distance": SkinMap(values, "1")}, "simulated")
        return page.render_fragment(draw_panels(appearance, None))

    assert "e-11" not in shown(noise)
    assert "0.009" in shown(noise * 1e9)


def test_a_medium_is_not_counted_as_a_person(tmp_path):
    fits = {
        "sites": [
            {"site": "cheek", "sigma_tr_per_mm": value, "sigma_tr_stderr": 0.01}
            for value in (0.5, 0.7, 0.9)
        ]
    }
    files = {SUBSURFACE_FILE: json.dumps(fits).encode()}
    truths, appearances = {}, {}
    for subject in ("III", "homogeneous:0.08,1.2"):
        name = f"truth-{len(truths)}"
        truth = SkinAppearance({}, "simulated", parameters={"kind": "truth", "subject": subject})
        truths[name] = store.write(tmp_path / name, truth)
        appearances[subject] = SkinAppearance(
            {}, "simulated", parameters={"truth": name}, files=files
        )
    assert "this report, 1 session<" in page.render_fragment(
        subsurface.compare_people(appearances, truths)
    )
    no_truth_tells = page.render_fragment(subsurface.compare_people(appearances))
    assert "this report, 2 sessions<" in no_truth_tells
    del appearances["III"]
    assert not list(subsurface.compare_people(appearances, truths))


def test_people_are_independent_of_published_table(monkeypatch):
    sites = [
        {"site": "cheek", "sigma_tr_per_mm": value, "sigma_tr_stderr": 0.01}
        for value in (0.5, 0.7, 0.9)
    ]
    files = {SUBSURFACE_FILE: json.dumps({"sites": sites}).encode()}
    appearances = {
        name: SkinAppearance({}, "simulated", files=files) for name in ("first", "second")
    }

    def rows(who):
        html = page.render_fragment(subsurface.compare_people(appearances))
        return [row for row in html.split("<tr>") if who in row]

    own, published = rows("this report"), rows("published (")
    table = subsurface.weyrich_2005()
    other = dataclasses.replace(table, mean_per_mm=2.0 * table.mean_per_mm)
    monkeypatch.setattr(subsurface, "weyrich_2005", lambda: other)
    assert len(own) == 3
    assert rows("this report") == own
    assert rows("published (") != published
