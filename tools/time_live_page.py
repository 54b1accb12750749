"""Time frames of the live page with one head and with five, in a headless browser.

    python tools/time_live_page.py [PAGE.html] [--size-px 512] [--frames 8] [--gpu]

Without a page it draws the procedural head. A frame is timed whole (an expression that changes) and
as the light turns. Jimenez et al. 2010 report 53 frames per second for five heads on a graphics
card; the browser without --gpu draws on the processor (SwiftShader).
"""

import argparse
import shutil
import statistics
import tempfile
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
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


def main() -> None:
    """Print a table of milliseconds and frames per second."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("page", nargs="?", type=Path)
    parser.add_argument("--size-px", type=int, default=512)
    parser.add_argument("--frames", type=int, default=8)
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
        print("heads | whole frame, ms | light turns, ms | frames per second | draws")
        for heads in (1, 5):
            whole, turned, draws = time_heads(view, heads, asked.frames)
            print(f"{heads} | {whole:.1f} | {turned:.1f} | {1000.0 / whole:.2f} | {draws}")
        opened.close()


if __name__ == "__main__":
    main()
