"""Serve the page and its tiles on a local port, for this machine only.

The server is bound to the loopback address. Pages of other origins cannot access it through the
browser: a request with another Host is refused (DNS rebinding), and responses are not readable
across origins. Only two kinds of paths are answered, none of which is a file name.
"""

import re
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final

from skinrig.console import Console
from skinrig.viewer import page
from skinrig.viewer.microstructure.assets import add_displacement_tiles
from skinrig.viewer.microstructure.tiles import Pyramid, TileError, open_displacement
from skinrig.viewer.scene import SceneError, ViewerScene

LOOPBACK_HOST: Final = "127.0.0.1"
TILE_PATH: Final = re.compile(r"/tiles/([0-9]{1,2})/([0-9]{1,4})/([0-9]{1,4})")
CONNECTION_TIMEOUT_S: Final = 30.0
"""Time after which an idle connection is closed."""


@dataclass(frozen=True, slots=True)
class PageServer:
    """A running server.

    Attributes
    ----------
    url
        Address of the page.
    port
        Given or free port.
    requests
        Paths answered so far, in order.
    """

    url: str
    port: int
    requests: list[str]
    _ended: threading.Event

    def wait(self) -> None:
        """Wait until the server is closed."""
        self._ended.wait()


@contextmanager
def serve(html: bytes, *, pyramid: Pyramid | None = None, port: int = 0) -> Iterator[PageServer]:
    """Serve a page, and the tiles of a displacement, until the block ends.

    Parameters
    ----------
    html : bytes
        The page.
    pyramid : Pyramid, optional
        Tiles, served at ``/tiles/LEVEL/ROW/COLUMN``.
    port : int
        Port; 0: a free one.

    Raises
    ------
    SceneError
        If the port is out of range or in use.
    """
    if not 0 <= port <= 65535:
        raise SceneError(f"--port: got {port}, expected 0 to 65535; enter another")
    requests: list[str] = []
    of_page = {"html": html, "pyramid": pyramid, "requests": requests}
    handler: Any = type("Handler", (_Handler,), of_page)
    try:
        server = ThreadingHTTPServer((LOOPBACK_HOST, port), handler)
    except OSError as error:
        raise SceneError(
            f"--port: {port} is not usable ({error.strerror}); choose another, or 0 for a free one"
        ) from error
    server.daemon_threads = True
    number = int(server.server_address[1])
    handler.hosts = frozenset(f"{name}:{number}" for name in (LOOPBACK_HOST, "localhost"))
    ended = threading.Event()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.1})
    thread.start()
    try:
        yield PageServer(f"http://{LOOPBACK_HOST}:{number}/", number, requests, ended)
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
        ended.set()


def serve_scene(
    scene: ViewerScene,
    port: int,
    appearances: Sequence[Path],
    *,
    console: Console,
    displacement: Path | None = None,
) -> None:
    """Serve the page of a scene on this machine until it is interrupted.

    Parameters
    ----------
    scene
        The displayed scene.
    port
        Port; 0: a free one.
    appearances
        Source folders of the scene.
    console
        Output of the address.
    displacement
        A .npy file of heights, um, in the texture of the mesh; the page fetches it as tiles instead
        of growing relief.

    Raises
    ------
    SceneError, TileError
        If the port is in use, or the file is not a displacement.
    """
    with tempfile.TemporaryDirectory(prefix="skinrig-view-") as name:
        pyramid = None
        if displacement is not None:
            console.progress(f"cut {displacement.name} into tiles")
            pyramid = open_displacement(displacement, Path(name) / "levels")
            scene = add_displacement_tiles(scene, pyramid)
        text = page.build(scene, connect=pyramid is not None).encode("utf-8")
        with serve(text, pyramid=pyramid, port=port) as served:
            document = {
                "url": served.url,
                "bytes": len(text),
                "appearances": [str(path) for path in appearances],
                "displacement": None if displacement is None else str(displacement),
                "displacement_px": None if pyramid is None else pyramid.size,
                "left_out": [list(row) for row in scene.left_out],
                "added": [list(row) for row in scene.added],
            }
            console.print_line(
                f"{served.url}: open it in a browser on this machine; Ctrl-C ends it"
            )
            console.print_document("skinrig.view-served/1", document)
            try:
                served.wait()
            except KeyboardInterrupt:
                console.progress("server closed")


class _Handler(BaseHTTPRequestHandler):
    """Request handler of the page and its tiles."""

    html: bytes
    pyramid: Pyramid | None
    requests: list[str]
    hosts: frozenset[str]
    protocol_version = "HTTP/1.1"
    server_version = "skinrig"
    sys_version = ""
    timeout = CONNECTION_TIMEOUT_S

    def do_GET(self) -> None:
        """Send headers and body."""
        self._answer(body=True)

    def do_HEAD(self) -> None:
        """Send headers only."""
        self._answer(body=False)

    def _answer(self, *, body: bool) -> None:
        status, kind, content = self._content()
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Cross-Origin-Opener-Policy", "same-origin")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("X-Frame-Options", "DENY")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if body:
            self.wfile.write(content)

    def _content(self) -> tuple[HTTPStatus, str, bytes]:
        text = "text/plain; charset=utf-8"
        if self.headers.get("Host") not in self.hosts:
            return HTTPStatus.FORBIDDEN, text, b"this server answers to its own address only\n"
        if self.path == "/":
            self.requests.append(self.path)
            return HTTPStatus.OK, "text/html; charset=utf-8", self.html
        found = TILE_PATH.fullmatch(self.path)
        if found is not None and self.pyramid is not None:
            try:
                tile = self.pyramid.tile(*(int(part) for part in found.groups()))
            except TileError as error:
                return HTTPStatus.NOT_FOUND, text, f"{error}\n".encode()
            self.requests.append(self.path)
            return HTTPStatus.OK, "application/octet-stream", tile
        return HTTPStatus.NOT_FOUND, text, b"there is nothing at this path\n"

    def log_message(self, format: str, *args: object) -> None:
        """Omit the log line per request."""
