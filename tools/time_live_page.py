"""Time frames of the live page with one head and with five, in a headless browser.

    python tools/time_live_page.py [PAGE.html] [--size-px 512] [--frames 8] [--gpu]
        [--distances | --lights]

Without a page it draws the procedural head. A frame is timed whole (an expression that changes) and
as the light turns. Jimenez et al. 2010 report 53 frames per second for five heads on a graphics
card; the browser without --gpu draws on the processor (SwiftShader).

With --distances it compares images with and without the level of detail of wrinkles: the bound of
the error that the page computes, the error of the image, and texture reads of the surface pass.

With --lights it prints the time of the first paint, and times frames of one head by light and by
what moves; processor seconds are those of all processes of the browser.
"""

import argparse
import base64
import os
import shutil
import statistics
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import sync_playwright

SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
DETAIL_TOLERANCE = 2.0 / 255.0
"""The page's own tolerance of the level of detail, radiance of which a white surface has 1."""
ALWAYS_OMIT = 100.0
"""A tolerance that every bound meets."""
DISTANCES_MM = (400, 800, 1600, 3200, 6400, 12800, 25600)
CROWD_DISTANCE_MM = 1800.0
"""Distance of the camera from which five heads fit into the image."""


def time_heads(page: Any, heads: int, frames: int) -> tuple[float, float, int]:
    """Return median milliseconds of a whole frame and of a turned light, and draws of a frame."""
    far = {"camera_distance_mm": CROWD_DISTANCE_MM}
    page.evaluate("change => window.viewer.set(change)", {"heads": heads, "crowd": 1.0, **far})
    whole = page.evaluate("n => window.viewer.bench(n, {})", frames)
    turned = page.evaluate("n => window.viewer.bench(n, {light: true})", frames)
    middle = [statistics.median(found["frames_ms"]) for found in (whole, turned)]
    return middle[0], middle[1], int(whole["draws"])


def compare_detail(page: Any, distance_mm: float, asked: Any) -> tuple[float, ...]:
    """Return pixel size, mm, bound and RMS error of omission, and ms of both frames."""
    common = {"camera_distance_mm": distance_mm, "weights": {asked.state: 1.0}, "relief": 0}
    images, times = [], []
    for tolerance in (0.0, ALWAYS_OMIT):
        change = {**common, "detail": 1, "detail_tolerance": tolerance}
        page.evaluate("change => window.viewer.set(change)", change)
        images.append(read_buffer(page, "radiance"))
        found = page.evaluate("n => window.viewer.bench(n, {light: true})", asked.frames)
        times.append(statistics.median(found["frames_ms"]))
    state = page.evaluate("() => window.viewer.statistics.detail.wrinkles")
    lit = images[0].any(axis=2)
    error = float(np.sqrt(np.mean((images[1] - images[0])[lit] ** 2)))
    return state["pixel_mm"], state["error"], error, *times


LIGHTINGS = {
    "key light": {"fill": 0, "rim": 0, "environment": "none"},
    "three-point": {"light_intensity": 2.2, "fill": 0.3, "rim": 0.3, "environment": "none"},
    "overcast sky": {"fill": 0, "rim": 0, "light_intensity": 0, "environment": "overcast"},
}
MOVED = {
    "camera": "i => ({camera_yaw_deg: i + 1})",
    "light": "i => ({light_azimuth_deg: i + 1})",
    "expression": "i => ({weights: {anger: 0.02 * i + 0.1}})",
}


def browser_seconds() -> float:
    """Return the processor seconds of all processes below this one."""
    parents, seconds = {}, {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            words = stat.read_text().rpartition(")")[2].split()
        except OSError:
            continue  # the process has ended
        own = int(stat.parent.name)
        parents[own] = int(words[1])
        seconds[own] = (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")
    below = {os.getpid()}
    while more := {one for one, parent in parents.items() if parent in below} - below:
        below |= more
    return sum(seconds[one] for one in below if one in seconds)


def time_lights(page: Any, frames: int) -> None:
    """Print the first paint, and milliseconds and processor seconds per frame by light."""
    entry = "performance.getEntriesByName('first-contentful-paint')[0].startTime"
    paint = page.evaluate(f"() => {entry}")
    print(f"first contentful paint: {paint:.0f} ms")
    print("light | moved | ms | processor seconds")
    for name, lighting in LIGHTINGS.items():
        page.evaluate("change => window.viewer.set(change)", lighting)
        for moved, change in MOVED.items():
            page.evaluate(f"() => window.viewer.set(({change})(99))")  # compiles its passes
            before = browser_seconds()
            found = page.evaluate(
                f"""frames => Array.from({{length: frames}}, (_, i) => {{
                  const begun = performance.now();
                  window.viewer.set(({change})(i));
                  return performance.now() - begun; }})""",
                frames,
            )
            spent = (browser_seconds() - before) / frames
            print(f"{name} | {moved} | {statistics.median(found):.0f} | {spent:.3f}", flush=True)


def read_buffer(page: Any, name: str) -> Any:
    """Return the first three channels of a buffer of the page, (H, W, 3)."""
    found = page.evaluate("name => window.viewer.read(name)", name)
    data = np.frombuffer(base64.b64decode(found["data"]), "<f4")
    return data.reshape(found["height"], found["width"], found["channels"])[..., :3]


def main() -> None:
    """Print a table of milliseconds and frames per second."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("page", nargs="?", type=Path)
    parser.add_argument("--size-px", type=int, default=512)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--distances", action="store_true")
    parser.add_argument("--lights", action="store_true")
    parser.add_argument("--state", default="surprise")
    parser.add_argument("--gpu", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as driver:
        file = asked.page or Path(folder) / "page.html"
        if asked.page is None:
            from skinrig.viewer import faces, page

            file.write_text(page.build(faces.build_scene(size=256)), encoding="utf-8")
        opened = driver.chromium.launch(
            executable_path=shutil.which("chromium"),
            headless=True,
            args=["--no-sandbox", *(() if asked.gpu else SOFTWARE)],
        )
        view = opened.new_page()
        view.goto(file.resolve().as_uri())
        view.wait_for_selector("html[data-ready=true]", state="attached", timeout=120_000)
        view.evaluate("s => window.viewer.resize(s, s)", asked.size_px)
        if asked.lights:
            time_lights(view, asked.frames)
        elif asked.distances:
            print("distance, mm | pixel, mm | bound | RMS error | omitted | ms, ms without")
            for distance_mm in DISTANCES_MM:
                mm, bound, error, ms, without = compare_detail(view, distance_mm, asked)
                omitted = bound < DETAIL_TOLERANCE
                print(f"{distance_mm} | {mm:.2f} | {bound:.4f} | {error:.5f} | ", end="")
                print(f"{omitted} | {ms:.0f}, {without:.0f}", flush=True)
        else:
            print("heads | whole frame, ms | light turns, ms | frames per second | draws")
            for heads in (1, 5):
                whole, turned, draws = time_heads(view, heads, asked.frames)
                print(f"{heads} | {whole:.1f} | {turned:.1f} | {1000.0 / whole:.2f} | {draws}")
        opened.close()


if __name__ == "__main__":
    main()
