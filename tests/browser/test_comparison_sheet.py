"""The sheet of a blind comparison in a browser: answers become a file that its tool reads."""

import importlib.util
from pathlib import Path

import pytest
from PIL import Image

PATH = Path(__file__).resolve().parents[2] / "tools" / "make_comparison_sheet.py"


@pytest.mark.long
def test_saved_answers_are_those_chosen(browser, tmp_path):
    spec = importlib.util.spec_from_file_location("make_comparison_sheet", PATH)
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    for name, gray in (("one", 90), ("two", 160)):
        (tmp_path / name).mkdir()
        for light in ("left", "front"):
            Image.new("L", (80, 90), gray).save(tmp_path / name / f"III-{light}.png")
    html, key = tool.make_sheet(tmp_path / "one", tmp_path / "two", seed=4)
    (tmp_path / "sheet.html").write_text(html, encoding="utf-8")
    context = browser.new_context(viewport={"width": 390, "height": 844})
    page = context.new_page()
    problems = []
    page.on("console", lambda message: problems.append(message.text))
    page.goto((tmp_path / "sheet.html").as_uri())
    page.get_by_label("Your code").fill('P"1')
    sides = {str(one["trial"]): "left" if one["left"] == "B" else "right" for one in key["trials"]}
    for trial, side in list(sides.items())[1:]:
        page.locator(f'input[name="trial-{trial}"][value="{side}"]').check()
    # the first is missing: nothing is saved, and the browser leads to it
    page.get_by_role("button", name="Save the answers").click()
    assert page.evaluate("document.activeElement.name") == "trial-1"
    page.locator(f'input[name="trial-1"][value="{sides["1"]}"]').check()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save the answers").click()
    download.value.save_as(tmp_path / "answers.csv")
    rows = tool.read_answers(tmp_path / "answers.csv", key["sheet"])
    assert {row["trial"]: row["answer"] for row in rows} == sides
    assert {row["observer"] for row in rows} == {'P"1'}
    assert tool.evaluate(key, rows)["chose_a"] == 0
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert problems == []
    context.close()
