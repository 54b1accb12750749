"""Pointers, keys, touch, the comparison and the address: what people do with the page."""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.long


def center(viewer: Any) -> tuple[float, float]:
    """Return the middle of the picture in the window."""
    box = viewer.page.locator("#port").bounding_box()
    return box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]


def drag(viewer: Any, right: float, down: float) -> None:
    """Drag from the middle of the picture."""
    x, y = center(viewer)
    viewer.page.mouse.move(x, y)
    viewer.page.mouse.down()
    viewer.page.mouse.move(x + right, y + down)
    viewer.page.mouse.up()


def params(viewer: Any) -> dict[str, Any]:
    """Return all parameters."""
    return dict(viewer.page.evaluate("() => window.viewer.params"))


def wait_for_announcement(viewer: Any, text: str) -> None:
    """Wait until the page announces a text to screen readers."""
    viewer.wait_until("text => document.getElementById('live').textContent.includes(text)", text)


def reset(viewer: Any) -> None:
    """Reset all controls, and wait until the address has no settings but the scene's own."""
    viewer.page.locator("#reset").click()
    viewer.wait_until("() => ['', '#relief=1'].includes(location.hash)")


def opened(viewer: Any, group: str) -> Any:
    """Return a group of the panel, open."""
    found = viewer.page.locator(f"#group-{group}")
    found.evaluate("group => { group.open = true; }")
    return found


@pytest.fixture
def viewer(viewer):
    """The shared page; its tool is put back too."""
    yield viewer
    viewer.page.locator("button[data-tool=orbit]").click()


def test_light_tool_drag_moves_highlight_not_camera(viewer):
    viewer.page.locator("button[data-tool=light]").click()
    before, specular = params(viewer), viewer.read("specular")[..., 0]
    drag(viewer, 60, 0)
    after = params(viewer)
    assert after["light_azimuth_deg"] > before["light_azimuth_deg"] + 5
    assert after["camera_yaw_deg"] == before["camera_yaw_deg"]
    x = np.arange(256)
    moved = viewer.read("specular")[..., 0]
    assert (moved.sum(0) @ x) / moved.sum() > (specular.sum(0) @ x) / specular.sum()


def frontal(viewer: Any) -> float:
    """Return the mean column of the skin that faces straight ahead."""
    normal = viewer.read("normal")
    return float(np.nonzero(normal[..., 2] > 0.97)[1].mean())


def test_drag_right_rotates_face_right(viewer):
    before = frontal(viewer)
    drag(viewer, 20, 0)
    assert params(viewer)["camera_yaw_deg"] < -5
    assert frontal(viewer) > before + 3


def test_keys_rotate_camera_move_light_and_zoom(viewer):
    port = viewer.page.locator("#port")
    port.focus()
    start = params(viewer)
    viewer.page.keyboard.press("ArrowRight")
    viewer.page.keyboard.press("ArrowUp")
    assert params(viewer)["camera_yaw_deg"] == start["camera_yaw_deg"] + 5
    assert params(viewer)["camera_pitch_deg"] == start["camera_pitch_deg"] + 5
    viewer.page.keyboard.press("+")
    assert params(viewer)["camera_distance_mm"] < start["camera_distance_mm"]
    viewer.page.keyboard.press("l")
    viewer.page.keyboard.press("Shift+ArrowLeft")
    assert params(viewer)["light_azimuth_deg"] == start["light_azimuth_deg"] - 15
    wait_for_announcement(viewer, "Light 20 degrees")
    viewer.page.keyboard.press("r")
    again = params(viewer)
    assert again["camera_yaw_deg"] == 0
    assert again["light_azimuth_deg"] == 35


def test_pixel_probe_reads_buffer_values(viewer):
    viewer.page.locator("button[data-tool=probe]").click()
    viewer.page.locator("#port").focus()
    viewer.page.keyboard.press("Shift+ArrowUp")
    viewer.page.keyboard.press("Shift+ArrowLeft")
    inspect = viewer.read("inspect")[128 - 10, 128 - 10]
    rows = dict(
        zip(
            viewer.page.locator("#reading dt").all_text_contents(),
            viewer.page.locator("#reading dd").all_text_contents(),
            strict=True,
        )
    )
    assert rows["Melanosome volume fraction"] == f"{100 * inspect[2]:.2f} %"
    assert rows["Blood volume fraction"] == f"{100 * inspect[3]:.2f} %"
    melanin = rows["Melanosome volume fraction"]
    wait_for_announcement(viewer, f"Melanosome volume fraction {melanin}")
    viewer.set(melanin_gain=2)
    first = "() => document.querySelector('#reading dd').textContent"
    viewer.wait_until(f"old => ({first})() !== old", melanin)
    changed = viewer.page.evaluate(first)
    assert float(changed.split()[0]) == pytest.approx(2 * 100 * inspect[2], abs=0.02)


def test_click_outside_face_is_reported(viewer):
    viewer.page.locator("button[data-tool=probe]").click()
    x, y = center(viewer)
    box = viewer.page.locator("#port").bounding_box()
    side = min(box["width"], box["height"])
    viewer.page.mouse.click(x - 0.48 * side, y - 0.48 * side)
    assert "Outside the face" in viewer.page.locator("#reading").text_content()


def test_sliders_follow_keys_and_speak_their_value(viewer):
    group = opened(viewer, "expression")
    slider = group.get_by_label("Anger", exact=True)
    slider.focus()
    viewer.page.keyboard.press("ArrowRight")
    assert params(viewer)["weights"]["anger"] == pytest.approx(0.01)
    viewer.page.keyboard.press("End")
    assert params(viewer)["weights"]["anger"] == 1.5
    assert slider.get_attribute("aria-valuetext") == "150 %"
    assert "1 changed" in group.locator("summary").text_content()


def test_presets_set_every_weight_and_show_active_preset(viewer):
    group = opened(viewer, "expression")
    viewer.set(weights={"fear": 0.7})
    group.get_by_role("button", name="Anger and surprise").click()
    on = {name: w for name, w in params(viewer)["weights"].items() if w}
    assert on == {"anger": 1, "surprise": 1}
    pressed = group.locator("button[aria-pressed=true]").all_text_contents()
    assert pressed == ["Anger and surprise"]
    group.get_by_role("button", name="Neutral").click()
    assert not any(params(viewer)["weights"].values())


@pytest.mark.parametrize("preset", ["Happiness", "Exercise", "Alcohol"])
def test_each_kind_of_preset_changes_the_blood(viewer, preset):
    before = viewer.read("chromophores")[..., 1]
    opened(viewer, "expression").get_by_role("button", name=preset, exact=True).click()
    after = viewer.read("chromophores")[..., 1]
    assert np.abs(after - before).max() > 0.003
    if preset != "Happiness":
        assert after.mean() > before.mean()


def test_comparison_shows_a_left_and_b_right(viewer):
    viewer.set(melanin_gain=3)
    dark = screen(viewer)
    opened(viewer, "view").get_by_role("button", name="Store as B").click()
    viewer.set(melanin_gain=1, split=0.5)
    light = screen(viewer, alone=True)
    both = screen(viewer)
    np.testing.assert_array_equal(both[:, 129:], dark[:, 129:])
    np.testing.assert_array_equal(both[:, :127], light[:, :127])
    assert np.abs(light[:, 129:].astype(int) - dark[:, 129:]).max() > 20
    opened(viewer, "view").get_by_role("button", name="Swap A and B").click()
    assert params(viewer)["melanin_gain"] == 3
    assert params(viewer)["compare"]["melanin_gain"] == 1
    opened(viewer, "view").get_by_role("button", name="End", exact=True).click()
    assert params(viewer)["compare"] is None


def screen(viewer: Any, *, alone: bool = False) -> np.ndarray[Any, Any]:
    """Return the canvas as it is shown, (256, 256, 4) bytes; alone: without a comparison."""
    compare = params(viewer)["compare"]
    if alone:
        viewer.set(compare=None)
    viewer.set()
    data = viewer.page.evaluate(
        """() => {
          const canvas = document.getElementById("view");
          const flat = new OffscreenCanvas(canvas.width, canvas.height).getContext("2d");
          flat.drawImage(canvas, 0, 0);
          const bytes = flat.getImageData(0, 0, canvas.width, canvas.height).data;
          let text = "";
          for (let i = 0; i < bytes.length; i += 8192) {
            text += String.fromCharCode(...bytes.subarray(i, i + 8192));
          }
          return btoa(text);
        }"""
    )
    if alone:
        viewer.set(compare=compare)
    return np.frombuffer(base64.b64decode(data), np.uint8).reshape(256, 256, 4)


def test_every_buffer_view_is_nonblank_on_face(viewer):
    options = viewer.page.locator("#group-view select option").all_text_contents()
    select = opened(viewer, "view").get_by_label("Buffer")
    assert len(options) >= len(viewer.buffers())
    for name in ("normal", "albedo", "irradiance", "chromophores", "specular"):
        select.select_option(value=json.dumps(name))
        shown = screen(viewer)
        assert params(viewer)["view"] == name
        assert shown[..., :3].std() > 8, name


def test_address_stores_and_restores_settings(viewer, procedural_html, open_page):
    viewer.set(weights={"anger": 0.4}, roughness=1.25, specular_model="fitted", filmic=False)
    viewer.page.locator("#share").click()
    address = viewer.page.evaluate("() => location.hash")
    assert "weights.anger=0.4" in address
    viewer.page.reload()
    viewer.page.wait_for_selector("html[data-ready=true]", state="attached", timeout=90_000)
    viewer.resize(256, 256)
    back = params(viewer)
    assert back["weights"]["anger"] == 0.4
    assert back["roughness"] == 1.25
    assert back["specular_model"] == "fitted"
    assert back["filmic"] is False
    reset(viewer)
    assert params(viewer)["roughness"] == 1


def test_address_with_invalid_parts_keeps_valid_parts(viewer):
    url = viewer.page.url.split("#")[0]
    bad = (
        "#roughness=%22rough%22&nothing=3&weights.anger=0.2&camera_target_mm=[1]&f0=&%%%=1"
        "&__proto__.x=1"
    )
    viewer.page.goto("about:blank")
    viewer.page.goto(url + bad)
    viewer.page.wait_for_selector("html[data-ready]", state="attached", timeout=90_000)
    viewer.resize(256, 256)
    found = params(viewer)
    assert found["roughness"] == 1
    assert found["weights"]["anger"] == 0.2
    assert found["camera_target_mm"] == [0, -22, -30]
    assert viewer.page.evaluate("() => ({}).x === undefined")
    reset(viewer)
    assert viewer.problems == []


def test_costs_count_drawn_passes_and_grow_with_heads(viewer):
    group = opened(viewer, "cost")
    group.get_by_role("button", name="Measure a frame").click()
    group.locator("table").wait_for(timeout=60_000)
    rows = group.locator("tbody tr").count() - 1
    wanted = viewer.bench(1)["passes"]
    assert rows == len(wanted)
    taps = sum(one["taps"] for one in wanted.values())
    assert taps > 256 * 256 * 20
    shares = [
        int(text.split()[0]) for text in group.locator("tbody tr td:last-child").all_text_contents()
    ]
    assert 95 <= sum(shares) <= 105
    note = group.locator(".help").first.text_content()
    assert "Software rendering" in note
    assert "After a change of light" in note
    group.get_by_role("button", name="Measure five heads").click()
    group.locator("caption", has_text="5 heads").wait_for(timeout=60_000)
    assert params(viewer)["heads"] == 1
    assert viewer.problems == []


def test_five_heads_are_side_by_side(viewer):
    viewer.set(heads=5, camera_distance_mm=1200)
    on = (viewer.read("albedo")[..., 3] > 0).any(axis=0)
    runs = np.count_nonzero(np.diff(on.astype(int)) == 1)
    assert runs >= 4  # the outermost may touch the rim


def test_touch_drags_and_pinches(open_page, procedural_html):
    phone = open_page(procedural_html, 360, 740, has_touch=True, is_mobile=True)
    client = phone.page.context.new_cdp_session(phone.page)

    def touch(kind: str, *points: tuple[float, float]) -> None:
        client.send(
            "Input.dispatchTouchEvent",
            {
                "type": kind,
                "touchPoints": [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)],
            },
        )

    x, y = center(phone)
    touch("touchStart", (x, y))
    touch("touchMove", (x + 40, y))
    touch("touchEnd")
    assert params(phone)["camera_yaw_deg"] < -5
    start = params(phone)["camera_distance_mm"]
    touch("touchStart", (x - 20, y), (x + 20, y))
    touch("touchMove", (x - 60, y), (x + 60, y))
    touch("touchEnd")
    assert params(phone)["camera_distance_mm"] < 0.6 * start
    wide = phone.page.evaluate("() => document.documentElement.scrollWidth")
    assert wide <= 360
    port = phone.page.locator("#port").bounding_box()
    panel = phone.page.locator("#panel").bounding_box()
    assert port["y"] + port["height"] <= panel["y"]
    assert phone.problems == []


def test_canvas_follows_its_container_and_chosen_resolution(viewer):
    viewer.set(resolution=384)
    size = viewer.page.evaluate("() => [view.width, view.height]")
    assert max(size) == 384
    viewer.page.set_viewport_size({"width": 900, "height": 500})
    viewer.wait_until("old => view.width !== old[0] || view.height !== old[1]", size)
    assert max(viewer.page.evaluate("() => [view.width, view.height]")) == 384
    viewer.page.set_viewport_size({"width": 720, "height": 560})
    viewer.set(resolution=0)


@pytest.mark.parametrize(
    ("missing", "said"),
    [
        ("HTMLCanvasElement.prototype.getContext = () => null", "WebGL2"),
        ("WebGL2RenderingContext.prototype.getExtension = () => null", "EXT_color_buffer_float"),
    ],
)
def test_device_without_webgl_gets_instructions(browser, tmp_path, procedural_html, missing, said):
    path = tmp_path / "page.html"
    path.write_text(procedural_html, encoding="utf-8")
    context = browser.new_context(viewport={"width": 720, "height": 560})
    page = context.new_page()
    page.add_init_script(missing)
    page.goto(path.as_uri())
    page.wait_for_selector("html[data-ready=failed]", state="attached", timeout=60_000)
    trouble = page.locator(".trouble")
    assert trouble.is_visible()
    assert said in trouble.inner_text()
    assert "hardware acceleration" in trouble.inner_text()
    assert not page.locator("#panel").is_visible()
    context.close()
