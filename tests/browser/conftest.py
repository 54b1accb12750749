"""One browser a session; pages of small scenes, read back as floats."""

from __future__ import annotations

import base64
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
READY_MS = 90_000


@dataclass
class ViewerPage:
    """A page that is open in the browser.

    Attributes
    ----------
    page
        The browser's own.
    problems
        Console errors, uncaught exceptions and requests to the network so far.
    """

    page: Any
    problems: list[str] = field(default_factory=list)

    def set(self, **params: Any) -> dict[str, Any]:
        """Change parameters, draw, and return all parameters."""
        return dict(self.page.evaluate("change => window.viewer.set(change)", params))

    def read(self, name: str) -> NDArray[np.float32]:
        """Return a buffer, shape (H, W, C), row 0 at the top."""
        found = self.page.evaluate("name => window.viewer.read(name)", name)
        data = np.frombuffer(base64.b64decode(found["data"]), "<f4")
        return data.reshape(found["height"], found["width"], found["channels"])

    def buffers(self) -> list[str]:
        """Return the names of the buffers."""
        return list(self.page.evaluate("() => window.viewer.buffers()"))

    def bench(self, frames: int, *, light: bool = False) -> dict[str, Any]:
        """Draw frames, whole or as the light turns; milliseconds of each, and work by pass."""
        asked = [frames, {"light": light}]
        return dict(self.page.evaluate("a => window.viewer.bench(a[0], a[1])", asked))

    def mesh(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the moved vertices, mm, and their normals, (V, 3) each."""
        found = self.page.evaluate("() => window.viewer.mesh()")
        positions, normals = (
            np.frombuffer(base64.b64decode(found[name]), "<f4").reshape(-1, 3)
            for name in ("positions", "normals")
        )
        return positions, normals

    def draws(self) -> dict[str, int]:
        """Return how often each pass was drawn so far."""
        found = self.page.evaluate("() => window.viewer.statistics.passes")
        return {name: int(record["draws"]) for name, record in found.items()}

    def wait_until(self, condition: str, value: Any = None) -> None:
        """Wait until a JavaScript function of a value is true, 30 s at most."""
        self.page.wait_for_function(condition, arg=value)

    def wait_frames(self, count: int = 10) -> None:
        """Wait for frames of the screen, in which a page that moves by itself draws."""
        self.page.evaluate(
            """count => new Promise(done => {
              const step = () => count-- > 0 ? requestAnimationFrame(step) : done();
              step();
            })""",
            count,
        )

    def resize(self, width: int, height: int) -> None:
        """Change the size of the canvas in pixels."""
        self.page.evaluate("s => window.viewer.resize(s[0], s[1])", [width, height])


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    """Debian's Chromium, headless, drawing on the processor."""
    chromium = shutil.which("chromium")
    reason = "" if chromium else "chromium is not installed"
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        reason = "playwright is not installed (skinrig[browser])"
    if reason:
        if os.environ.get("REQUIRE_BROWSER") == "1":
            pytest.fail(reason)
        pytest.skip(reason)
    with sync_playwright() as driver:
        opened = driver.chromium.launch(
            executable_path=chromium, headless=True, args=ARGUMENTS, timeout=60_000
        )
        yield opened
        opened.close()


@pytest.fixture(scope="session")
def open_page(
    browser: Any, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[..., ViewerPage]]:
    """Open HTML text from a file and wait until it is drawn: ``open_page(html, width, height)``."""
    contexts = []

    def opener(
        html: str, width: int = 720, height: int = 560, *, canvas: int | None = 256, **options: Any
    ) -> ViewerPage:
        path = tmp_path_factory.mktemp("page") / "page.html"
        path.write_text(html, encoding="utf-8")
        return open_address(path, width, height, canvas=canvas, **options)

    def open_address(
        where: Path | str, width: int, height: int, *, canvas: int | None, **options: Any
    ) -> ViewerPage:
        address = where.as_uri() if isinstance(where, Path) else where
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        page = context.new_page()
        viewer = ViewerPage(page)

        def console(message: Any) -> None:
            if message.type in ("error", "warning"):
                viewer.problems.append(f"{message.type}: {message.text}")

        def request(asked: Any) -> None:
            if asked.url != address and not asked.url.startswith(("data:", "blob:")):
                viewer.problems.append(f"request: {asked.url}")

        page.on("console", console)
        page.on("pageerror", lambda error: viewer.problems.append(f"exception: {error}"))
        page.on("request", request)
        page.goto(address)
        page.wait_for_selector("html[data-ready]", timeout=READY_MS, state="attached")
        state = page.evaluate("() => document.documentElement.dataset.ready")
        assert state == "true", (state, viewer.problems)
        if canvas is not None:
            viewer.resize(canvas, canvas)
        return viewer

    opener.address = open_address  # type: ignore[attr-defined]
    yield opener
    for context in contexts:
        context.close()


@pytest.fixture(scope="session")
def procedural_scene() -> Any:
    """The procedural head with textures of 256 texels, its skin alone: eyes closed, no hair."""
    from skinrig.viewer import faces as procedural

    scene = procedural.build_scene(size=256)
    return replace(scene, params={**scene.params, "eyes_open": 0, "brows": 0, "hair": 0})


@pytest.fixture(scope="session")
def procedural_html(procedural_scene: Any) -> str:
    """Its page."""
    from skinrig.viewer import page

    return page.build(procedural_scene)


@pytest.fixture(scope="session")
def viewer_page(open_page: Callable[..., ViewerPage], procedural_html: str) -> ViewerPage:
    """That page, open at 256 x 256 pixels; a test leaves parameters as it found them."""
    return open_page(procedural_html)


@pytest.fixture
def viewer(viewer_page: ViewerPage) -> Iterator[ViewerPage]:
    """The same page, its parameters put back after the test."""
    before = viewer_page.page.evaluate("() => window.viewer.params")
    yield viewer_page
    viewer_page.set(**before)
    viewer_page.resize(256, 256)
