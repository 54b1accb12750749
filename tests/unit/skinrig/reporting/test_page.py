"""The page as programs read it: landmarks, headings, captions, alt texts, and a strict policy."""

import ast
import base64
import hashlib
import io
import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.drawing import figures, png, svg
from skinrig.reporting import map_images, page, report, verdict


class Outline(HTMLParser):
    """What a screen reader needs of a page, and what is wrong with it."""

    def __init__(self, html):
        super().__init__()
        self.headings, self.ids, self.targets, self.faults = [], [], [], []
        self.scripts = 0
        self.landmarks, self.tables, self.captions, self.in_head = set(), 0, 0, False
        self.feed(html)
        if self.tables != self.captions:
            self.faults.append(f"{self.tables} tables, {self.captions} captions")
        for level, before in zip(self.headings[1:], self.headings, strict=False):
            if level > before + 1:
                self.faults.append(f"heading {level} after {before}")
        if len(set(self.ids)) != len(self.ids):
            self.faults.append("an id twice")
        if set(self.targets) - set(self.ids):
            self.faults.append("a link to nowhere")

    def handle_starttag(self, tag, attrs):
        has = dict(attrs)
        if re.fullmatch("h[1-6]", tag):
            self.headings.append(int(tag[1]))
        if tag in ("main", "nav", "header", "section"):
            self.landmarks.add(tag)
        self.tables += tag == "table"
        self.captions += tag == "caption"
        if "id" in has:
            self.ids.append(has["id"])
        if tag == "a":
            self.targets.append(has["href"].removeprefix("#"))
        if tag == "img" and not has.get("alt"):
            self.faults.append("an image without a text")
        if tag == "svg" and not (has.get("role") == "img" and has.get("aria-label")):
            self.faults.append("a plot without a name")
        if tag == "th" and "scope" not in has:
            self.faults.append("a heading cell of nothing")
        self.scripts += tag == "script"
        if "style" in has or self.scripts > 1:
            self.faults.append("what the policy refuses")


@pytest.fixture(scope="module")
def html(tmp_path_factory):
    tmp_path, rng = tmp_path_factory.mktemp("run"), np.random.default_rng(12345)
    melanin = 0.03 + 0.05 * rng.random((30, 40))
    stderr = np.full(melanin.shape, 0.004)
    truth = {
        name: SkinMap(melanin, MAP_UNITS["melanin"] if name == "melanin" else "1")
        for name in ("melanin", "melanin_blurred")
    }
    found = SkinMap(melanin + rng.normal(0, 0.004, melanin.shape), MAP_UNITS["melanin"], stderr)
    store.write(
        tmp_path / "maps",
        SkinAppearance(
            {"melanin": found, "image": SkinMap(np.ones((30, 40, 3)), "1")},
            "simulated",
            parameters={"truth": "truth"},
            left_out=(("gloss", "no parallel frames"),),
        ),
    )
    store.write(
        tmp_path / "truth", SkinAppearance(truth, "simulated", parameters={"kind": "truth"})
    )
    return report.build([tmp_path])


def test_page_has_landmarks_ordered_headings_captions_and_texts(html):
    outline = Outline(html)
    assert outline.faults == []
    assert outline.headings[0] == 1
    assert outline.headings.count(1) == 1
    assert outline.landmarks == {"main", "nav", "header", "section"}
    assert outline.tables >= 4


@pytest.mark.parametrize(
    ("what", "into"),
    [
        ("<h3>", "<h5>"),
        (' alt="', ' title="'),
        ("<caption>", "<p>"),
        (' scope="col"', ""),
        ('href="#', 'href="#no-'),
        ("<figcaption>", '<figcaption style="color:red">'),
        ('role="img"', ""),
    ],
)
def test_outline_finds_missing_elements(html, what, into):
    assert what in html
    assert Outline(html.replace(what, into)).faults


def test_page_policy_allows_only_own_style_and_script(html):
    style, script = (
        base64.b64encode(hashlib.sha256(found[1].encode()).digest()).decode()
        for found in (
            re.search(rf"<{tag}[^>]*>(.*?)</{tag}>", html, re.DOTALL) for tag in ("style", "script")
        )
    )
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', html)[1]
    assert policy == (
        f"default-src 'none'; img-src data:; style-src 'sha256-{style}'; "
        f"script-src 'sha256-{script}'; base-uri 'none'; form-action 'none'"
    )
    assert html.count("<style") == 1


def test_image_text_describes_content_shown_in_colors():
    values = np.arange(100.0).reshape(10, 10)
    valid = np.ones((10, 10), bool)
    valid[:2] = False
    drawing = map_images.MapDrawing("height", "um", valid)
    shown = drawing.draw_scalar("error", values, 0.0, 99.0)
    assert shown.alt == (
        "height, error: median 59.5 um, 90 % of pixels within 23.95 to 95.05, 20 % masked; "
        "color scale 0 to 99 um"
    )


def test_map_image_uses_scale_colors_and_gray_invalid(rng):
    values = rng.random((40, 50))
    values[3, 4] = np.nan
    data = png.Scale(0.0, 1.0).encode(values, levels=map_images.SCALE_COLORS)
    seen = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)
    assert seen[3, 4].tolist() == [png.INVALID_GRAY] * 3
    fine = png.Scale(0.0, 1.0).colors(values).astype(int)
    step = np.abs(np.diff(png.sample_palette("viridis", 128).astype(int), axis=0)).max()
    assert np.abs(seen - fine).max() <= step
    coarse = png.Scale(0.0, 1.0).encode(values, levels=8)
    eighth = np.asarray(Image.open(io.BytesIO(coarse)).convert("RGB")).astype(int)
    assert np.abs(eighth - fine).max() > step


def test_noise_image_takes_seven_bits_slope_far_fewer(rng):
    bits = 7 * 128 * 128 / 8
    noise = png.Scale(0.0, 1.0).encode(rng.random((128, 128)))
    assert bits < len(noise) < 1.1 * bits
    slope = np.add.outer(np.linspace(0.0, 0.5, 128), np.linspace(0.0, 0.5, 128))
    assert len(png.Scale(0.0, 1.0).encode(slope)) < 0.2 * bits


def test_colorbar_spans_colors_of_image(html):
    style = re.search(r"<style>(.*?)</style>", html, re.DOTALL)[1]
    stops = re.search(r"\.bar\.viridis\{background:linear-gradient\(90deg,([^)]*)\)", style)[1]
    assert stops.split(",")[0] == "#" + bytes(png.sample_palette("viridis", 2)[0]).hex()
    assert len(stops.split(",")) == page.BAR_STOPS


def test_plot_is_well_formed_and_states_numbers():
    series = [figures.PlotSeries("red", [1.0, 2.0, 3.0], [1.0, 0.1, 0.01], [0.1, 0.01, 0.02])]
    drawn = figures.draw_curves("decay", "mm", "1/mm", series, log_y=True)
    root = ElementTree.fromstring(drawn)
    assert root.get("role") == "img"
    assert root.get("aria-label") == "decay: 1/mm against mm; red 0.01 to 1 over 1 to 3"
    assert "style=" not in drawn
    texts = {"".join(node.itertext()) for node in root.iter("{http://www.w3.org/2000/svg}text")}
    assert {"decay", "mm", "1/mm", "red", "0.01", "0.1"} <= texts


def test_plots_on_same_page_have_distinct_ids():
    plots = [
        figures.draw_curves(title, "x", "y", [figures.PlotSeries("one", [0.0, 1.0], [0.0, 1.0])])
        for title in ("first", "second")
    ]
    first, second = (set(re.findall(r' id="([^"]*)"', plot)) for plot in plots)
    assert first
    assert not first & second
    for plot, names in zip(plots, (first, second), strict=True):
        assert {a or b for a, b in re.findall(r'href="#([^"]*)"|url\(#([^)]*)\)', plot)} == names


def test_simplified_plot_lines_keep_position():
    path = '<path d="M 10.004 20.006 \nL 30.5 40 \n" style="fill: none; stroke: #123456"/>'
    other = path.replace("10.004", "11").replace("30.5", "31")
    drawn = f'<svg width="9pt"><g id="g_1">{path}{other}</g></svg>'
    found = re.search(
        r'<path d="([^"]*)" fill="none" stroke="#123456"/>', svg.simplify_svg(drawn, alt="lines")
    )
    assert found[1] == "M10 20.01L30.5 40M11 20.01L31 40"


def test_worst_skin_is_named_even_if_check_passes():
    kept = page.Check("melanin", 5.0, 10.0, "<=", "%", worst="dark: 30 %", worst_got=25.0)
    assert any("kept; one group above the limit" in row for row in verdict.list_weaknesses([kept]))
    assert sum(row[1] == "melanin" for row in verdict.list_weaknesses([kept])) == 1
    even = page.Check("melanin", 5.0, 10.0, "<=", "%", worst="dark: 9 %", worst_got=8.0)
    assert not any("one group above" in row[0] for row in verdict.list_weaknesses([even]))


def test_non_numeric_check_is_missed():
    missed = page.Check("error", float("nan"), 1.0, "<=")
    assert verdict.format_headline([missed]) == "1 of 1 checks missed its limit."
    assert verdict.list_weaknesses([missed]) == [("limit missed", "error", "–", "≤ 1", "")]


@pytest.mark.parametrize(
    ("unit", "shown"), [("deg", "1.5°"), ("°", "1.5°"), ("%", "1.5 %"), ("1/mm", "1.5 1/mm")]
)
def test_check_reads_same_in_table_and_verdict(unit, shown):
    check = page.Check("normals, median", 1.5, 1.0, "<=", unit)
    assert f">{shown}</td>" in page.render_fragment([page.build_checks_table([check])])
    summary = page.render_fragment(verdict.section([check])).split("<h2>Checks</h2>")[0]
    assert f">{shown}</td>" in summary.replace("\N{NO-BREAK SPACE}", " ")


def test_narrow_cell_keeps_number_with_percent_sign():
    check = page.Check("melanin", 1.0, 2.0, "<=", "%", "bound 11 %", worst="dark: 20.8 %")
    html = page.render_fragment([page.build_checks_table([check])])
    assert "20.8\N{NO-BREAK SPACE}%" in html
    assert "11\N{NO-BREAK SPACE}%" in html


def test_table_headings_separate_units_by_comma():
    joined = re.compile(r"[^,0-9 ] (%|°|um|mm|1/mm|px|N)$")
    found = [
        f"{path.name}:{node.lineno}: {node.value}"
        for path in sorted(Path(page.__file__).parent.glob("*.py"))
        for row in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(row, ast.Tuple)
        for node in row.elts
        if isinstance(node, ast.Constant)
        and isinstance(node.value, str)
        and joined.search(node.value)
    ]
    assert found == []
