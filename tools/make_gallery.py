"""Make the images of ``docs/gallery/index.md`` from the folder of a demo.

    skinrig demo --out demo
    python tools/make_gallery.py demo

Equal demo folders give equal images. The two screenshots need playwright and Chromium
(``make browser``); without them these files stay as they are.
"""

from __future__ import annotations

import base64
import io
import shutil
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import make_dome_maps
import make_portrait_maps
import make_reference_images
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from model import store
from model.skin import SkinMap
from skinrig.appearances.front_view import FrontView
from skinrig.demo_rigs import FACE_FOLDER
from skinrig.drawing import png
from skinrig.drawing.frame_sheet import N_LIGHTS, N_STEPS
from skinrig.fusing.finished_face_file import SHEET_FILE
from skinrig.rendering.photographs.evaluation import EvaluationSettings, evaluate_folders
from skinrig.viewer import faces, page

IMAGES = Path(__file__).resolve().parents[1] / "docs/images"
HELD_OUT = "C05-L044.png"
BROWSER = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
READY_MS = 90_000
VIEW = "#weights.anger=1&weights.surprise=0.6"
"""Settings of the live page, as its *Copy link* writes them."""
FUSED_PANELS = (
    ("melanin", 0.0, 0.06),
    ("hemoglobin", 0.0, 0.03),
    ("r_d", 0.0, 0.8),
    ("translucency", 0.8, 1.2),
)
"""Maps of the fused person with the ends of their scales; of the mean free path, mm, green."""
FACE_WIDTH_PX = 160
"""Width of a frame of the finished face."""
HIDE_TIME = "document.getElementById('time').style.visibility = 'hidden'"
"""Run times differ between runs: they stay out of the image."""


def scalar(
    shown: SkinMap, low: float, high: float, part: Any = np.s_[:], scale: str = "viridis"
) -> NDArray[np.uint8]:
    """Draw a map of one channel by a color scale, masked pixels gray."""
    return png.Scale(low, high, scale).colors(shown.values[part], shown.mask[part])


def color(shown: SkinMap, white: float, part: Any = np.s_[:]) -> NDArray[np.uint8]:
    """Draw a linear RGB map with a white level."""
    return masked(png.encode_srgb8(shown.values[part] / white), shown.mask[part])


def normals(shown: SkinMap, part: Any = np.s_[:]) -> NDArray[np.uint8]:
    """Draw unit normals: x, y, z from -1 to 1 as red, green, blue."""
    codes = np.rint(255 * np.clip(0.5 + 0.5 * shown.values[part], 0, 1)).astype(np.uint8)
    return masked(codes, shown.mask[part])


def masked(image: NDArray[np.uint8], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the image with masked pixels gray."""
    return np.where(valid[..., None], image, np.uint8(png.INVALID_GRAY))


def face(shown: SkinMap) -> tuple[slice, slice]:
    """Return rows and columns of the valid pixels."""
    rows, columns = np.nonzero(shown.mask)
    return slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)


def write(name: str, image: Image.Image, dither: Image.Dither = Image.Dither.NONE) -> None:
    """Write an image with 256 colors; dithered where colors vary in three channels."""
    file = io.BytesIO()
    image = image.convert("RGB")
    colors = image.quantize(256)
    image.quantize(palette=colors, dither=dither).save(file, "PNG", optimize=True)
    (IMAGES / name).write_bytes(file.getvalue())
    print(f"{name}: {len(file.getvalue()) / 1000:.0f} kB", file=sys.stderr)


def write_row(
    name: str, panels: Sequence[NDArray[np.uint8]], dither: Image.Dither = Image.Dither.NONE
) -> None:
    """Write panels side by side, 4 white pixels apart."""
    gap = np.full((panels[0].shape[0], 4, 3), 255, np.uint8)
    parts = [part for panel in panels for part in (gap, panel)][1:]
    write(name, Image.fromarray(np.concatenate(parts, axis=1)), dither)


# rows --------------------------------------------------------------------------------------------


def chromophores(demo: Path) -> None:
    """Draw images of a face, and estimate, half-width and ground truth of its chromophores."""
    found = store.read(demo / "appearance-flash-III").maps
    truth = store.read(demo / "truth-flash-III").maps
    part = face(found["melanin"])
    images = [color(found["image"], 0.5, part), color(found["specular_image"], 0.1, part)]
    write_row("gallery-polarization.png", images)
    for name, high in (("melanin", 0.12), ("hemoglobin", 0.1)):
        estimate = found[name]
        half_width = SkinMap(estimate.stderr, estimate.unit, valid=estimate.valid)
        row = [
            scalar(estimate, 0.0, high, part),
            scalar(half_width, 0.0, high / 4, part, "magma"),
            scalar(truth[name], 0.0, high, part),
        ]
        write_row(f"gallery-{name}.png", row)


def expression(demo: Path) -> None:
    """Draw the blood of an angry face, and its change from the neutral face."""
    found = store.read(demo / "appearance-flash-moving-III").maps
    angry, rest = found["hemoglobin_anger"], found["hemoglobin"]
    part = face(rest)
    row = [scalar(shown, 0.0, 0.1, part) for shown in (rest, angry)]
    change = scalar(found["change_anger"], -0.03, 0.03, part, "RdBu_r")
    write_row("gallery-expression.png", [*row, change])


def topography(demo: Path) -> None:
    """Draw normals and heights of a patch of skin: neutral, compressed, stretched."""
    found = store.read(demo / "appearance-gradient-forehead").maps
    row = [normals(found["normals_a000_n0"])]
    for step in ("n0", "m2", "p3"):
        row.append(scalar(found[f"height_a000_{step}"], -40.0, 40.0, scale="gray"))
    write_row("gallery-topography.png", row, Image.Dither.FLOYDSTEINBERG)


def translucency(demo: Path) -> None:
    """Draw the diffuse mean free path in red, green and blue, and its uncertainty in red."""
    found = store.read(demo / "appearance-probe-III").maps["translucency"]
    row = []
    for channel in range(3):
        one = SkinMap(found.values[..., channel], found.unit, valid=found.valid)
        row.append(scalar(one, 0.0, 3.0))
    error = SkinMap(found.stderr[..., 0], found.unit, valid=found.valid)
    write_row("gallery-translucency.png", [*row, scalar(error, 0.0, 0.75, scale="magma")])


def held_out(demo: Path) -> None:
    """Copy a photograph that no fit used, its rendering and the error."""
    write("gallery-held-out.png", Image.open(demo / "pictures-dome-III" / HELD_OUT))


def fused_person(demo: Path) -> None:
    """Draw a fused person: rendering beside a held-out photograph, and its maps from the front."""
    pictures = demo / "pictures-double"
    if not (pictures / HELD_OUT).is_file():
        settings = EvaluationSettings(count=3, seed=0)
        folders = demo / "double", demo / "session-dome-III", pictures
        evaluate_folders(*folders, settings, calibration=demo / "calibration-dome")
    above = Image.open(pictures / HELD_OUT).convert("RGB")
    found = store.read(demo / "double").maps
    place = found["position"]
    points = place.values[place.mask].astype(np.float64)
    view = FrontView.of(points, (points.min(axis=0), points.max(axis=0)))
    panels = []
    for name, low, high in FUSED_PANELS:
        values, good = found[name].values[place.mask], found[name].mask[place.mask]
        chosen = values if name == "r_d" or values.ndim == 1 else values[:, 1]
        image, seen = view.rasterize(chosen, valid=good)
        shown = SkinMap(image, "1", valid=seen)
        panels.append(color(shown, high) if name == "r_d" else scalar(shown, low, high))
    row = Image.fromarray(np.concatenate(panels, axis=1))
    row = row.resize((above.width, round(row.height * above.width / row.width)))
    both = Image.new("RGB", (above.width, above.height + row.height), "white")
    both.paste(above, (0, 0))
    both.paste(row, (0, above.height))
    write("gallery-fused.png", both)


def finished_face(demo: Path) -> None:
    """Draw the fused person under five lights: at rest above, angry below."""
    sheet = Image.open(demo / FACE_FOLDER / SHEET_FILE).convert("RGB")
    width, height = sheet.width // N_STEPS, sheet.height // N_LIGHTS
    small = round(FACE_WIDTH_PX * height / width)
    image = Image.new("RGB", (N_LIGHTS * FACE_WIDTH_PX, 2 * small))
    for row, step in enumerate((0, N_STEPS - 1)):
        for light in range(N_LIGHTS):
            corner = step * width, light * height
            frame = sheet.crop((*corner, corner[0] + width, corner[1] + height))
            image.paste(frame.resize((FACE_WIDTH_PX, small)), (light * FACE_WIDTH_PX, row * small))
    write("gallery-finished-face.png", image, Image.Dither.FLOYDSTEINBERG)


# screenshots -------------------------------------------------------------------------------------

PEOPLE = (("II", 1), ("IV", 2), ("VI", 3))
"""Skin types and seeds of the people on the live page."""
PEOPLE_LIGHTS = ((35, 30), (0, 15), (-60, 25))
"""Azimuth and elevation of their light, degrees."""
PEOPLE_VIEW = {"camera_distance_mm": 520, "camera_target_mm": [0, 12, -40]}
PEOPLE_PX = 270


def people(browser: Any, folder: Path) -> None:
    """Draw three people of the live page, a row each, under three lights."""
    rows = []
    for preset, seed in PEOPLE:
        live = folder / f"{preset}.html"
        live.write_text(page.build(faces.build_scene(preset=preset, seed=seed)), encoding="utf-8")
        tab = browser.new_page()
        tab.goto(live.as_uri())
        tab.wait_for_selector("html[data-ready=true]", timeout=READY_MS, state="attached")
        tab.evaluate("size => window.viewer.resize(...size)", [2 * PEOPLE_PX, 2 * PEOPLE_PX])
        row = []
        for azimuth, elevation in PEOPLE_LIGHTS:
            light = {"light_azimuth_deg": azimuth, "light_elevation_deg": elevation}
            tab.evaluate("change => window.viewer.set(change)", PEOPLE_VIEW | light)
            found = tab.evaluate("() => window.viewer.read('display')")
            values = np.frombuffer(base64.b64decode(found["data"]), "<f4")
            image = values.reshape(found["height"], found["width"], 4)[..., :3]
            row.append(image.reshape(PEOPLE_PX, 2, PEOPLE_PX, 2, 3).mean(axis=(1, 3)))
        rows.append(np.concatenate(row, axis=1))
        tab.close()
    codes = np.rint(255.0 * np.concatenate(rows)).astype(np.uint8)
    write("gallery-people.png", Image.fromarray(codes))


def screenshots(demo: Path) -> None:
    """Photograph the live page, three people on it, and the first screen of the report."""
    chromium = shutil.which("chromium")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        chromium = None
    if chromium is None:
        print(
            "viewer.png, gallery-people.png, report.png: not made, run `make browser` first",
            file=sys.stderr,
        )
        return
    with tempfile.TemporaryDirectory() as name, sync_playwright() as driver:
        live = Path(name) / "face.html"
        live.write_text(page.build(faces.build_scene()), encoding="utf-8")
        browser = driver.chromium.launch(executable_path=chromium, args=BROWSER)
        tab = browser.new_page(viewport={"width": 1200, "height": 780})
        tab.goto(live.as_uri() + VIEW)
        tab.wait_for_selector("html[data-ready=true]", timeout=READY_MS, state="attached")
        tab.evaluate("size => window.viewer.resize(...size)", [1024, 834])
        tab.evaluate(HIDE_TIME)
        write("viewer.png", Image.open(io.BytesIO(tab.screenshot())))
        people(browser, Path(name))
        tab = browser.new_page(viewport={"width": 1280, "height": 800}, device_scale_factor=0.75)
        tab.goto((demo / "report.html").resolve().as_uri())
        shot = Image.open(io.BytesIO(tab.screenshot()))
        write("report.png", shot, Image.Dither.FLOYDSTEINBERG)
        browser.close()


def main(demo: Path) -> None:
    """Make all images."""
    began = time.perf_counter()
    IMAGES.mkdir(exist_ok=True)
    for draw in (
        chromophores,
        expression,
        topography,
        translucency,
        held_out,
        fused_person,
        finished_face,
    ):
        draw(demo)
    make_reference_images.main()
    make_dome_maps.main(demo)
    make_portrait_maps.main()
    screenshots(demo)
    print(f"{time.perf_counter() - began:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
