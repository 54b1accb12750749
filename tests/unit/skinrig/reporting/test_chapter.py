"""Heads of chapters: their titles, weakest results, drawings of rigs and captured images."""

import base64
import io
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import PIL.Image
import pytest
from fixtures.pattern_sessions import write_gradient_session

from capture.session import Session
from model import store
from model.skin import SkinAppearance, SkinMap
from skinrig.drawing import png
from skinrig.reporting import chapter, page, report

DRAWING = Path("skinrig/data/rig-gradient.svg")


def decode(html, title):
    """Return the image above a caption that begins with a title, and its bytes."""
    address = re.search(rf'base64,([^"]+)">\s*<figcaption>{title}', html)[1]
    return base64.b64decode(address)


def pixels(html, title):
    return np.asarray(PIL.Image.open(io.BytesIO(decode(html, title))).convert("RGB")).astype(int)


def test_found_session_adds_rig_and_frame(tmp_path):
    lit = np.full((64, 64), 0.2)
    lit[:, 32:] = 0.8
    images = {("full", "parallel"): lit, ("full", "crossed"): lit}
    session = write_gradient_session(tmp_path / "session", images)
    inputs = {"session": Session.open(session).content_hash}
    maps = {"shading": SkinMap(np.ones((8, 8)), "1")}
    about = {"parameters": {"session": "session"}, "inputs": inputs}
    store.write(tmp_path / "maps", SkinAppearance(maps, "simulated", **about))
    html = report.build([tmp_path])
    assert "Gradient rig: maps <small>maps</small>" in html
    caption = "Gradient rig: full layout; this session used 132 lights and 1 camera"
    assert decode(html, caption) == DRAWING.read_bytes()
    frame = pixels(html, "captured frame")
    linear = ((frame / 255 + 0.055) / 1.055) ** 2.4
    ratio = linear[:, :28].mean() / linear[:, 36:].mean()
    assert ratio == pytest.approx(0.25, rel=0.03)  # of JPEG
    without = report.build([tmp_path / "maps"])
    assert "full layout" not in without
    assert "captured frame" not in without


def test_frontal_lit_frame_is_chosen():
    def place(name, *position_mm):
        return SimpleNamespace(name=name, position_mm=position_mm)

    def frame(kind, camera, light):
        return SimpleNamespace(kind=kind, camera=camera, index={}, settings={"light": light})

    lights = place("L0", 0.0, 900.0, 0.0), place("L1", 0.0, 300.0, 800.0)
    cameras = place("C0", 800.0, 0.0, 300.0), place("C1", 100.0, 0.0, 900.0)
    lit = [frame("olat", camera, light) for camera in ("C0", "C1") for light in ("L0", "L1")]
    others = [frame(kind, "C1", "L1") for kind in ("tracking", "dark") for _ in range(5)]
    session = SimpleNamespace(
        rig=SimpleNamespace(lights=lights, views=cameras), frames=lambda: lit + others
    )
    assert chapter._choose_frame(session) == [lit[3]]


def test_captured_image_is_neither_burnt_nor_black():
    """The brightest half percent is white; pixels that are not valid are gray."""
    values = 3.0 * np.linspace(0.01, 1.0, 40 * 50).reshape(40, 50, 1).repeat(3, axis=2)
    valid = np.ones((40, 50), bool)
    valid[:10, :10] = False
    values[~valid] = 0.0
    found = SkinAppearance({"image": SkinMap(values, "1", valid=valid)}, "measured")
    head = chapter.draw_head(page.ReportedAppearance("face", found, None, []), None)
    shown = pixels(page.render_fragment(head), "captured image")
    assert (shown[~valid] == png.INVALID_GRAY).all()
    burnt = (shown == 255).all(axis=-1).mean()
    assert 0.0 < burnt < 0.02
    step = np.abs(shown[20, 25] / 255 - 1.055 * (values[20, 25] / 2.985) ** (1 / 2.4) + 0.055)
    assert step.max() < 0.01


def test_missed_check_precedes_closer_one():
    found = SkinAppearance({}, "measured")
    checks = [
        page.Check("face: normals, mean error", 1.9, 2.0, "<=", "°"),
        page.Check("face: coverage", 0.1, 0.5, ">="),
    ]
    sentence = chapter.describe_weakest("face", checks, found)
    assert sentence == "Limit missed: coverage, 0.1 (limit 0.5)."
    thickness = SkinMap(np.full((2, 2), 2.0), "mm", np.full((2, 2), 0.1))
    bare = SkinAppearance({"thickness": thickness}, "measured")
    least = (
        "Least certain: thickness, median standard uncertainty 5\N{NO-BREAK SPACE}% of its value."
    )
    assert chapter.describe_weakest("face", [], bare) == least
