"""The page for people who use keys, screen readers, other colors or a small screen."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def axe() -> str:
    """The script of axe-core; ``npm install axe-core`` or AXE_CORE=FILE."""
    found = [os.environ.get("AXE_CORE"), ROOT / "node_modules/axe-core/axe.min.js"]
    for path in found:
        if path and Path(path).is_file():
            return Path(path).read_text(encoding="utf-8")
    pytest.skip("axe-core is not installed: npm install axe-core, or AXE_CORE=FILE")


def violations(page: Any, axe: str) -> list[str]:
    """Return the serious and critical findings."""
    page.evaluate(axe)
    found = page.evaluate("() => axe.run(document)")
    assert len(found["passes"]) > 15  # it has looked at something
    return [
        f"{one['impact']}: {one['id']}: {one['nodes'][0]['html'][:120]}"
        for one in found["violations"]
        if one["impact"] in ("serious", "critical")
    ]


@pytest.fixture(scope="module")
def still(open_page, procedural_html) -> Any:
    """A page for someone who asked for less motion, all groups open."""
    viewer = open_page(procedural_html, 1100, 740, canvas=64, reduced_motion="reduce")
    open_all(viewer.page)
    return viewer


def open_all(page: Any) -> None:
    """Open every group of the panel."""
    page.evaluate("() => document.querySelectorAll('details').forEach(d => { d.open = true; })")


@pytest.mark.parametrize(("scheme", "width"), [("light", 1100), ("dark", 1100), ("light", 360)])
def test_axe_finds_nothing_serious(open_page, procedural_html, axe, scheme, width):
    viewer = open_page(procedural_html, width, 740, canvas=64, color_scheme=scheme)
    red, green, blue = viewer.page.evaluate(
        "() => getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number)"
    )
    assert (red + green + blue > 600) == (scheme == "light")  # colors follow the system
    open_all(viewer.page)
    viewer.page.locator("button[data-tool=probe]").click()
    viewer.page.get_by_role("button", name="Store as B").click()
    viewer.page.get_by_role("button", name="Measure a frame").click()
    viewer.page.locator("#group-cost table").wait_for(timeout=60_000)
    assert violations(viewer.page, axe) == []


def test_axe_would_find_a_label_that_is_missing(still, axe):
    label = "() => { const e = document.querySelector('#group-view label'); e.htmlFor = %r; }"
    kept = still.page.evaluate("() => document.querySelector('#group-view label').htmlFor")
    still.page.evaluate(label % "nobody")
    assert any("select-name" in one for one in violations(still.page, axe))
    still.page.evaluate(label % kept)


def test_tab_reaches_every_control_and_shows_focus(still):
    viewer = still
    wanted = viewer.page.evaluate(
        """() => [...document.querySelectorAll("button, input, select, summary, #port, a")]
          .filter(e => !e.disabled && e.checkVisibility()).length"""
    )
    viewer.page.evaluate("() => { document.body.tabIndex = -1; document.body.focus(); }")
    seen, unseen_focus = 0, []
    for _ in range(wanted):
        viewer.page.keyboard.press("Tab")
        found = viewer.page.evaluate(
            """() => {
              const e = document.activeElement;
              const style = getComputedStyle(e);
              return [e.tagName + "#" + e.id, style.outlineStyle, parseFloat(style.outlineWidth),
                e.closest("main, header") !== null || e.className === "skip"];
            }"""
        )
        seen += found[3]
        if found[1] == "none" or found[2] < 2:
            unseen_focus.append(found[0])
    assert seen == wanted
    assert unseen_focus == []


def test_controls_have_names_and_sliders_spoken_values(still):
    viewer = still
    nameless = viewer.page.evaluate(
        """() => [...document.querySelectorAll("#panel input, #panel select")]
          .filter(e => !e.labels.length || !e.labels[0].textContent.trim()).map(e => e.id)"""
    )
    assert nameless == []
    mute = viewer.page.evaluate(
        """() => [...document.querySelectorAll("input[type=range]")]
          .filter(e => !e.getAttribute("aria-valuetext")).map(e => e.id)"""
    )
    assert mute == []
    helped = viewer.page.evaluate(
        """() => [...document.querySelectorAll("[aria-describedby]")]
          .every(e => document.getElementById(e.getAttribute("aria-describedby")))"""
    )
    assert helped


def test_reduced_motion_disables_automatic_movement(still):
    viewer = still
    draws = "() => window.viewer.statistics.draws"
    before = viewer.page.evaluate(draws)
    viewer.wait_frames()
    assert viewer.page.evaluate(draws) == before
    moving = viewer.page.evaluate("() => document.getAnimations().length")
    assert moving == 0
    duration = viewer.page.evaluate(
        """() => getComputedStyle(document.querySelector("summary"), "::before")
          .transitionDuration"""
    )
    assert duration in ("0s", "")
