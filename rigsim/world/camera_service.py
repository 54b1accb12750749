"""Serve a world's cameras on one TCP port; see `capture.devices.cameras.camera_wire`."""

import contextlib
import logging
import socket
import socketserver
import threading
import time
from collections.abc import Mapping
from typing import Any

from capture.devices.camera import CameraError, Exposure, FrameTimeout, Trigger
from capture.devices.cameras import camera_wire
from capture.devices.cameras.camera_wire import BadMessage
from rigsim.world.camera_body import CameraBody
from rigsim.world.world import World

log = logging.getLogger(__name__)

MAX_WAIT_S = 600.0
CLIENT_POLL_S = 0.2
"""Interval at which a wait for a frame checks that its client is still connected, s."""


class CameraService:
    """Threads that serve the cameras of a world.

    Parameters
    ----------
    world
        World of the cameras.
    host, port
        Listening address; port 0 takes a free one.

    Attributes
    ----------
    addresses : dict of str to str
        Camera URL by view.
    """

    def __init__(self, world: World, host: str, port: int) -> None:
        service = self
        self.world = world
        self._holders: dict[str, socket.socket] = {}
        self._waits: dict[str, threading.Lock] = {
            v.name: threading.Lock() for v in world.rig.all_views
        }
        self._lock = threading.Lock()
        self._connections: set[socket.socket] = set()

        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                service.serve_client(self.request)

        class Server(socketserver.ThreadingTCPServer):
            daemon_threads = True
            allow_reuse_address = True

        self._server = Server((host, port), Handler)
        real_port = self._server.server_address[1]
        self.addresses = {
            view.name: f"tcp://{host}:{real_port}/{view.name}" for view in world.rig.all_views
        }
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.05,), name="rigsim-cameras", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop listening and close the connections."""
        self._server.shutdown()
        self._thread.join()
        with self._lock:
            for connection in self._connections:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
        self._server.server_close()

    def serve_client(self, connection: socket.socket) -> None:
        """Answer one client until it disconnects."""
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._lock:
            self._connections.add(connection)
        view: str | None = None
        try:
            with connection.makefile("rb") as stream:
                while (request := _request(stream)) is not None:
                    if request.get("do") == "open":
                        view = self._open(connection, request, view)
                    else:
                        self._answer(connection, request, view)
        except (OSError, BadMessage, ValueError) as exc:
            log.info("camera connection ended: %s", exc)
        finally:
            with self._lock:
                self._connections.discard(connection)
                held = view is not None and self._holders.get(view) is connection
                if view is not None and held:
                    # still locked: another client could have armed it meanwhile
                    self.world.camera(view).abort()
                    del self._holders[view]

    def _open(
        self, connection: socket.socket, request: Mapping[str, Any], current: str | None
    ) -> str | None:
        name = str(request.get("view"))
        fault, error = "", "CameraError"
        with self._lock:
            holder = self._holders.get(name)
            if request.get("version") != camera_wire.CAMERA_WIRE_VERSION:
                got, expected = request.get("version"), camera_wire.CAMERA_WIRE_VERSION
                fault = f"version: got {got!r}, expected {expected}"
            elif name not in self.addresses:
                fault = f"view: got {name!r}, expected one of {', '.join(self.addresses)}"
            elif current is not None or (holder is not None and not _is_disconnected(holder)):
                fault = f"view {name!r}: another program has this camera; close it there"
                error = "CameraBusy"
            elif self.world.camera(name).is_exposing:
                # a camera armed now would miss its trigger
                fault = f"view {name!r}: still reading out a frame; retry later"
                error = "CameraBusy"
            else:
                # a client that died while its frame was pending loses the camera at once
                self._holders[name] = connection
        if fault:
            _send(connection, request, ok=False, error=error, text=fault)
            return current
        with self._waits[name]:  # that client's wait has ended: it takes no frame of this one
            camera = self.world.camera(name)
            if holder is not None:
                camera.abort()
        _send(connection, request, ok=True, info=camera_wire.info_to_json(camera.info))
        return name

    def _answer(
        self, connection: socket.socket, request: Mapping[str, Any], view: str | None
    ) -> None:
        try:
            if view is None:
                raise CameraError("no camera is open on this connection; open one first")
            with self._lock:
                if self._holders.get(view) is not connection:
                    raise ConnectionResetError("the camera has gone to another client")
            fields, blob = self._run_command(connection, self.world.camera(view), request)
        except (CameraError, KeyError, TypeError, ValueError) as exc:
            kind = "FrameTimeout" if isinstance(exc, FrameTimeout) else "CameraError"
            _send(connection, request, ok=False, error=kind, text=str(exc))
        else:
            _send(connection, request, blob=blob, ok=True, **fields)

    def _run_command(
        self, connection: socket.socket, camera: CameraBody, request: Mapping[str, Any]
    ) -> tuple[dict[str, Any], bytes | None]:
        match request.get("do"):
            case "clock":
                return {"clock_s": camera.clock_s()}, None
            case "configure":
                want = Exposure(float(request["exposure_s"]), int(request["iso"]))
                got = camera.configure(want)
                return {"exposure_s": got.exposure_s, "iso": got.iso}, None
            case "arm":
                camera.arm(int(request["count"]), Trigger(request["trigger"]))
                return {}, None
            case "fire":
                camera.fire()
                return {}, None
            case "frame":
                timeout_s = min(max(float(request["timeout_s"]), 0.0), MAX_WAIT_S)
                shot = self._next_shot(connection, camera, timeout_s)
                _send(connection, request, developing=True)
                table, blob = camera_wire.frame_to_message(camera.develop(shot))
                return {"frame": table}, blob
            case "abort":
                camera.abort()
                return {}, None
            case other:
                raise CameraError(f"do: got {other!r}, expected a command of the camera protocol")

    def _next_shot(self, connection: socket.socket, body: CameraBody, timeout_s: float) -> Any:
        """Wait for a frame while the client is connected."""
        until = time.monotonic() + timeout_s
        while True:
            left_s = max(0.0, until - time.monotonic())
            with self._waits[body.view.name]:
                if self._holders.get(body.view.name) is not connection or _is_disconnected(
                    connection
                ):
                    raise ConnectionResetError("the client is gone")
                with contextlib.suppress(FrameTimeout):
                    return body.next_shot(min(left_s, CLIENT_POLL_S))
            if left_s <= CLIENT_POLL_S:
                raise FrameTimeout(f"camera {body.view.serial}: no frame in {timeout_s:g} s")


def _is_disconnected(connection: socket.socket) -> bool:
    """Return whether the peer has closed a connection."""
    try:
        return not connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    except OSError:
        return True


def _request(stream: Any) -> dict[str, Any] | None:
    line = stream.readline(camera_wire.MAX_HEADER_BYTES)
    if not line:
        return None
    if not line.endswith(b"\n"):
        raise BadMessage("header: got one that is too long or cut, expected one line of JSON")
    fields = camera_wire.decode_header(line[:-1])
    if camera_wire.blob_size(fields):
        raise BadMessage("blob_bytes: got some in a request, expected none")
    return fields


def _send(
    connection: socket.socket,
    request: Mapping[str, Any],
    *,
    blob: bytes | None = None,
    **fields: Any,
) -> None:
    connection.sendall(camera_wire.encode_message({"id": request.get("id"), **fields}, blob))
