"""The report in a browser: no request, nothing refused, accessible in both color schemes."""

import base64
import io
import os
import re
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from fixtures.finished_faces import gray_frames, write_face

from model import store
from model.skin import MAP_UNITS, SkinAppearance, SkinMap
from skinrig.drawing.frame_sheet import FRAME_PX, PERIOD_S
from skinrig.reporting import report
from skinrig.reporting.page import Image, Images, render_page
from skinrig.reporting.status import build_status_page, read_status

WIDTHS = (1250, 400)
MAX_HEIGHT_PX = 3000
"""Of the report on one run, at 1280 px width."""


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """Return the addresses of a report on one run and of one that compares two."""
    folder, rng = tmp_path_factory.mktemp("report"), np.random.default_rng(12345)
    melanin = 0.02 + 0.1 * np.linspace(0.0, 1.0, 120 * 160).reshape(120, 160)
    for run in ("one", "two"):
        maps = {
            name: SkinMap(
                melanin + rng.normal(0.0, 0.002, melanin.shape),
                MAP_UNITS[name],
                np.full(melanin.shape, 0.002),
            )
            for name in ("melanin", "hemoglobin")
        }
        maps["residual"] = SkinMap(np.abs(rng.normal(0.0, 1.0, melanin.shape)), "1")
        store.write(
            folder / run / "maps",
            SkinAppearance(
                maps,
                "simulated",
                parameters={"truth": "truth", "assumed": ["flat light"]},
                inputs={"session": run},
                left_out=(("gloss", "no parallel frames"),),
            ),
        )
        truth = {
            f"{name}{suffix}": SkinMap(melanin, MAP_UNITS[name] if not suffix else "1")
            for name in ("melanin", "hemoglobin")
            for suffix in ("", "_blurred")
        }
        store.write(
            folder / run / "truth", SkinAppearance(truth, "simulated", parameters={"kind": "truth"})
        )
    found = []
    for name, paths in (("one", [folder / "one"]), ("both", [folder / "one", folder / "two"])):
        path = folder / f"{name}.html"
        path.write_text(report.build_any(paths).html, encoding="utf-8")
        found.append(path)
    return found


@pytest.fixture(scope="session")
def axe():
    """Return the source of axe-core: of AXE_CORE, or of node_modules."""
    places = [os.environ.get("AXE_CORE", ""), "node_modules/axe-core/axe.min.js"]
    found = next((Path(place) for place in places if place and Path(place).is_file()), None)
    if found is None:
        pytest.skip("axe-core is not installed: npm install axe-core, or name its file by AXE_CORE")
    return found.read_text(encoding="utf-8")


def opened(browser, path, *, scheme="light", width=1250, **options):
    context = browser.new_context(
        color_scheme=scheme, viewport={"width": width, "height": 900}, **options
    )
    page = context.new_page()
    problems = []
    page.on("console", lambda message: problems.append(message.text))
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on(
        "request",
        lambda asked: (
            None
            if asked.url == path.as_uri() or asked.url.startswith("data:")
            else problems.append(asked.url)
        ),
    )
    page.goto(path.as_uri())
    return context, page, problems


def serious(page, axe):
    """Return axe's serious and critical findings, and how many rules passed."""
    page.evaluate(axe)
    found = page.evaluate("axe.run(document)")
    return (
        [
            f"{one['id']}: {one['nodes'][0]['html'][:200]}"
            for one in found["violations"]
            if one["impact"] in ("serious", "critical")
        ],
        len(found["passes"]),
    )


@pytest.mark.long
def test_report_makes_no_requests_and_policy_blocks_nothing(browser, pages):
    for path in pages:
        context, page, problems = opened(browser, path)
        assert problems == []
        # the policy did not refuse the style: the verdict has its bar, plots their size
        bar = page.evaluate("getComputedStyle(document.querySelector('.verdict')).borderLeftWidth")
        assert bar == "5px"
        loaded = page.evaluate("[...document.images].map(i => i.complete && i.naturalWidth > 0)")
        assert loaded
        assert all(loaded)
        context.close()


@pytest.mark.long
@pytest.mark.parametrize("width", WIDTHS)
def test_first_screen_shows_images_below_the_verdict(browser, pages, width):
    for path in pages:
        context, page, _ = opened(browser, path, width=width)
        places = page.evaluate(
            "[...document.querySelectorAll('.first img')].map(i => "
            "[i.getBoundingClientRect().top, i.getBoundingClientRect().right, i.alt.length])"
        )
        verdict = page.evaluate("document.querySelector('.verdict').getBoundingClientRect().bottom")
        assert len(places) >= 4
        assert verdict < places[0][0] < 400
        assert sum(top < 900 for top, _, _ in places) >= 2
        assert all(right <= width and alt > 20 for _, right, alt in places)
        assert page.locator(".first .bar").count() >= 2
        context.close()


@pytest.mark.long
def test_report_of_one_run_is_short(browser, pages):
    """Tables and plots below the checks are folded, so that images follow each other."""
    context, page, _ = opened(browser, pages[0], width=1280)
    height = "document.documentElement.scrollHeight"
    folded = page.evaluate(height)
    assert folded < MAX_HEIGHT_PX
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    assert page.evaluate(height) > MAX_HEIGHT_PX
    context.close()


@pytest.mark.long
def test_enlarged_image_reads_values_of_map(browser, pages):
    """Rationale: values come from colors alone; the map rises from 0.02 to 0.12 row by row.

    Tolerance: a 64th of the scale: 128 colors, noise of 0.002, and 17 colors of the bar.
    """
    context, page, problems = opened(browser, pages[0])
    page.locator(".maps .enlarge").filter(has=page.locator("img")).first.press("Enter")
    dialog = page.locator("dialog[open]")
    assert dialog.get_by_role("combobox").count() == 2
    stage = dialog.locator(".stage").bounding_box()
    expected = 0.02 + 0.1 * np.array([0.1, 0.9])
    found = []
    for part in (0.1, 0.9):
        page.mouse.move(stage["x"] + 0.5 * stage["width"], stage["y"] + part * stage["height"])
        text = dialog.locator("output").text_content()
        found.append(float(re.search(r"ground truth: ≈ ([0-9.]+)", text)[1]))
    np.testing.assert_allclose(found, expected, atol=0.1 / 64)
    # the keyboard reads the row above, and stays inside of the image
    dialog.locator(".stage").focus()
    for key in ("ArrowUp", "Shift+ArrowLeft", *["Shift+ArrowDown"] * 12):
        page.keyboard.press(key)
        text = dialog.locator("output").text_content()
        found.append(float(re.search(r"ground truth: [≈≥] ([0-9.]+)", text)[1]))
    assert found[2] == pytest.approx(found[1] - 0.1 / 120, abs=0.1 / 64)
    assert found[-1] == pytest.approx(0.12, abs=0.1 / 64)
    # maps of one color scale share a bar; the error has its own
    assert dialog.locator(".bar").count() == 1
    right = dialog.get_by_role("combobox").nth(1)
    right.select_option(label="estimate − ground truth")
    assert dialog.locator(".bar").count() == 2
    right.select_option("1")
    before = dialog.locator(".stage").screenshot()
    dialog.get_by_role("slider", name="divider").fill("100")
    assert dialog.locator(".stage").screenshot() != before
    # the difference of two images around gray, and of an image with itself
    difference = dialog.locator("canvas.difference")
    spread = """c => Math.max(...c.getContext("2d").getImageData(0, 0, c.width, c.height)
      .data.map((code, i) => i % 4 < 3 ? Math.abs(code - 128) : 0))"""
    dialog.get_by_role("slider", name="gain").fill("8")
    assert difference.evaluate(spread) > 20
    chosen = dialog.get_by_role("combobox")
    chosen.nth(1).select_option(chosen.nth(0).input_value())
    assert difference.evaluate(spread) == 0
    chosen.nth(1).select_option(str(1 - int(chosen.nth(0).input_value())))
    dialog.get_by_role("button", name="Flip").click()
    assert difference.count() == 0
    for side in ("0%", "100%", "0%"):
        page.wait_for_function(
            "side => document.querySelector('.stage').style.getPropertyValue('--divider') === side",
            arg=side,
        )
    page.keyboard.press("Escape")
    page.locator("dialog").wait_for(state="detached")
    assert problems == []
    context.close()


@pytest.mark.long
def test_linked_image_is_compared_with_its_partner(browser, tmp_path):
    """A repeated image is a link; its group still compares two images."""
    rng, shown = np.random.default_rng(12345), []
    for title in ("first", "second"):
        stream = io.BytesIO()
        PIL.Image.fromarray(rng.integers(0, 255, (64, 64, 3), np.uint8)).save(stream, "png")
        address = f"data:image/png;base64,{base64.b64encode(stream.getvalue()).decode()}"
        shown.append(Image(title, address, "random colors"))
    first, second = shown
    groups = [Images((first,)), Images((second, replace(first, title="repeated")))]
    path = tmp_path / "page.html"
    path.write_text(render_page("linked", [], groups), encoding="utf-8")
    assert path.read_text(encoding="utf-8").count("shown above") == 1
    context, page, problems = opened(browser, path)
    page.locator(".maps .enlarge").last.press("Enter")
    dialog = page.locator("dialog[open]")
    assert dialog.get_by_role("combobox").count() == 2
    sources = dialog.locator(".stage img").evaluate_all("all => all.map(one => one.src)")
    assert sources == [first.address, second.address]
    assert problems == []
    context.close()


@pytest.mark.long
def test_policy_refuses_foreign_content(browser, pages, tmp_path):
    path = tmp_path / "changed.html"
    text = pages[0].read_text(encoding="utf-8")
    path.write_text(text.replace("<main", "<script>document.title='ran'</script><main", 1))
    context, page, problems = opened(browser, path)
    assert page.title() != "ran"
    assert any("Content Security Policy" in problem for problem in problems)
    context.close()


@pytest.mark.long
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", WIDTHS)
def test_axe_finds_nothing_serious(browser, pages, axe, scheme, width):
    for path in pages:
        context, page, _ = opened(browser, path, scheme=scheme, width=width, bypass_csp=True)
        findings, passes = serious(page, axe)
        assert findings == []
        assert passes > 10
        context.close()


@pytest.mark.long
@pytest.mark.parametrize(("scheme", "width"), [("light", 390), ("dark", 1250)])
def test_axe_accepts_enlarged_image_and_status(browser, pages, axe, tmp_path, scheme, width):
    context, page, _ = opened(browser, pages[0], scheme=scheme, width=width, bypass_csp=True)
    page.locator(".maps .enlarge").first.press("Enter")
    dialog = page.locator("dialog[open]")
    dialog.get_by_role("slider", name="gain").fill("8")
    dialog.get_by_role("button", name="Flip").press("Enter")
    findings, _ = serious(page, axe)
    assert findings == []
    box = dialog.bounding_box()
    assert box["x"] >= 0
    assert box["x"] + box["width"] <= width
    context.close()
    path = tmp_path / "status.html"
    path.write_text(build_status_page(read_status(pages[0].parent / "one", today=date(2026, 1, 1))))
    context, page, problems = opened(browser, path, scheme=scheme, width=width, bypass_csp=True)
    findings, passes = serious(page, axe)
    assert findings == []
    assert passes > 10
    assert problems == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    context.close()


@pytest.mark.long
def test_axe_finds_image_without_text_and_low_contrast(browser, pages, axe, tmp_path):
    path = tmp_path / "changed.html"
    text = pages[0].read_text(encoding="utf-8").replace(' alt="', ' data-alt="', 1)
    path.write_text(text.replace("--soft-fg:#4a525b", "--soft-fg:#c4c8cc"), encoding="utf-8")
    context, page, _ = opened(browser, path, bypass_csp=True)
    # the style no longer fits its digest: set the pale color by hand
    page.evaluate("document.documentElement.style.setProperty('--soft-fg', '#c4c8cc')")
    findings, _ = serious(page, axe)
    assert {one.split(":")[0] for one in findings} >= {"image-alt", "color-contrast"}
    context.close()


@pytest.mark.long
@pytest.mark.parametrize("width", WIDTHS)
def test_only_tables_scroll_sideways_and_keyboard_reaches_them(browser, pages, width):
    context, page, _ = opened(browser, pages[0], width=width)
    wide = page.evaluate("document.documentElement.scrollWidth")
    assert wide <= width
    page.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    focusable = page.evaluate(
        "[...document.querySelectorAll('.scroll')].map(e => { e.focus(); "
        "return document.activeElement === e && !!e.getAttribute('aria-label') })"
    )
    assert focusable
    assert all(focusable)
    context.close()


@pytest.mark.long
def test_plot_text_has_page_text_color(browser, pages):
    for scheme in ("light", "dark"):
        context, page, _ = opened(browser, pages[0], scheme=scheme)
        colors = page.evaluate(
            "[getComputedStyle(document.body).color, "
            "getComputedStyle(document.querySelector('svg text')).fill]"
        )
        assert colors[0] == colors[1]
        context.close()


@pytest.mark.long
def test_printed_pages_are_white_and_show_folded_content(browser, pages):
    context, page, _ = opened(browser, pages[0], scheme="dark")
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor")
    page.emulate_media(media="print", color_scheme="dark")
    assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert dark != "rgb(255, 255, 255)"
    hidden = page.evaluate(
        "[...document.querySelectorAll('details table')].filter(t => !t.checkVisibility("
        "{contentVisibilityAuto: true}) || t.getBoundingClientRect().height < 10).length"
    )
    assert hidden == 0
    assert page.pdf(format="A4").startswith(b"%PDF")
    context.close()


@pytest.mark.long
def test_skip_link_and_contents_lead_to_targets(browser, pages):
    context, page, _ = opened(browser, pages[0])
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    page.keyboard.press("Enter")
    assert page.url.endswith("#content")
    targets = page.evaluate(
        "[...document.querySelectorAll('nav a')].map(a => !!document.querySelector(a.hash))"
    )
    assert len(targets) >= 3
    assert all(targets)
    context.close()


@pytest.fixture(scope="module")
def face_page(tmp_path_factory):
    """Return the address of a report on a finished face."""
    folder = tmp_path_factory.mktemp("face")
    write_face(folder / "finished-face")
    path = folder / "report.html"
    path.write_text(report.build([folder], folder=folder), encoding="utf-8")
    return path


def shown_level(page):
    """Return the gray level in the middle of the frame that is shown."""
    picture = page.locator(".player .frame").screenshot()
    image = np.asarray(PIL.Image.open(io.BytesIO(picture)).convert("L"), float)
    height, width = image.shape
    return image[height // 4 : -height // 4, width // 4 : -width // 4].mean()


def seek(page, seconds):
    """Stop the movement at a time after its start."""
    page.evaluate(
        "t => document.getAnimations().forEach(a => { a.pause(); a.currentTime = t })",
        1e3 * seconds,
    )


@pytest.mark.long
@pytest.mark.parametrize("scripts", [True, False])
def test_light_buttons_choose_the_row(browser, face_page, scripts):
    """The keyboard moves along the radio buttons, as along a slider."""
    levels = gray_frames()[:, 0, 0, 0, 0]
    still = {"reduced_motion": "reduce", "java_script_enabled": scripts}
    context, page, problems = opened(browser, face_page, **still)
    assert shown_level(page) == pytest.approx(levels[1], abs=3)
    page.get_by_role("radio", name="half left", exact=True).focus()
    for expected in levels[2:]:
        page.keyboard.press("ArrowRight")
        assert shown_level(page) == pytest.approx(expected, abs=3)
    page.get_by_text("left", exact=True).click()
    assert shown_level(page) == pytest.approx(levels[0], abs=3)
    assert problems == []
    context.close()


@pytest.mark.long
def test_movement_shows_every_step_and_pauses(browser, face_page):
    levels = gray_frames()[1, :, 0, 0, 0]
    context, page, problems = opened(browser, face_page)
    states = "document.getAnimations().map(a => a.playState)"
    assert page.evaluate(states) == ["running"]
    page.get_by_role("checkbox", name="Pause the movement to anger").check()
    assert page.evaluate(states) == ["paused"]
    found = []
    for step in range(len(levels)):
        seek(page, PERIOD_S * (0.15 + 0.7 * (step + 0.5) / len(levels)))
        found.append(shown_level(page))
    np.testing.assert_allclose(found, levels, atol=3)
    assert problems == []
    context.close()


@pytest.mark.long
def test_reduced_motion_rests_until_play(browser, face_page):
    context, page, _ = opened(browser, face_page, reduced_motion="reduce")
    states = "document.getAnimations().map(a => a.playState)"
    assert page.evaluate(states) == ["paused"]
    page.get_by_role("checkbox", name="Play the movement to anger").check()
    assert page.evaluate(states) == ["running"]
    context.close()


@pytest.mark.long
@pytest.mark.parametrize(("scheme", "width"), [("light", 390), ("dark", 1280)])
def test_finished_face_fits_and_passes_axe(browser, face_page, axe, scheme, width):
    context, page, problems = opened(
        browser, face_page, scheme=scheme, width=width, bypass_csp=True
    )
    findings, passes = serious(page, axe)
    assert findings == []
    assert passes > 10
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    frame = page.locator(".player .frame").bounding_box()
    assert frame["width"] / frame["height"] == pytest.approx(FRAME_PX[0] / FRAME_PX[1], rel=0.01)
    assert frame["x"] + frame["width"] <= width
    targets = page.locator(".player input").evaluate_all(
        "all => all.map(one => one.getBoundingClientRect().height)"
    )
    assert min(targets) >= 24.0
    assert problems == []
    context.close()
