"""A world's boxes on a pty or a TCP port, and its cameras on a TCP port, in real time.

One thread moves the bytes of the boxes and lets the world's time pass; each camera connection has
a thread of its own, because making pixels takes time and no lamp may wait for it. The same boxes,
lines and faults as behind ``sim://`` are used, so any client in any language sees what a driver
sees. Whoever reaches a port can fire the lights: ports listen on this machine only, unless asked
otherwise.
"""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import pty as ptys
import selectors
import socket
import threading
import tty
from collections.abc import Callable
from types import TracebackType
from typing import Protocol, Self

from capture.rig import Rig, load_rig

from .camera_service import CameraService
from .faults import Faults
from .link import Link, LinkStalled, Unplugged
from .world import Scene, World

__all__ = ["ServeError", "Served", "serve"]

log = logging.getLogger(__name__)

IDLE_S = 0.5
"""Longest sleep of the thread that serves the boxes."""
STALL_POLL_S = 0.02
CHUNK_BYTES = 4096


class ServeError(ValueError):
    """An address that cannot be served on."""


class _End(Protocol):
    """Where the bytes of one box go in and out."""

    address: str

    @property
    def stalled(self) -> bool: ...

    def start(self, selector: selectors.BaseSelector) -> None: ...

    def pump(self) -> None: ...

    def stop(self) -> None: ...


def serve(
    rig_name: str | Rig,
    *,
    pty: bool = False,
    tcp: str = "127.0.0.1:0",
    allow_remote: bool = False,
    seed: int = 0,
    scene: Scene | None = None,
    faults: Faults | None = None,
    world: World | None = None,
) -> Served:
    """Serve the boxes and cameras of a rig until the result is closed.

    Parameters
    ----------
    rig_name
        Name, path, or the rig itself.
    pty
        Boxes on pseudo-terminals instead of TCP; cameras are on TCP in either case.
    tcp
        ``HOST:PORT``; port 0 takes free ones. Otherwise the boxes get ports upwards from it, in the
        order of the rig, then all cameras one.
    allow_remote
        Permit an address that other machines can reach.
    seed, scene, faults
        Of the world that is made, see `World`; without `faults`, bytes take no time beyond that
        of the pty or the network.
    world
        Serve this one instead; its clock must be the real one.

    Returns
    -------
    Served
        Already being served; ``served.addresses`` are the URLs, boxes first.

    Raises
    ------
    ServeError
        When the address is taken, is no address, or is reachable from elsewhere without
        `allow_remote`.

    Examples
    --------
    >>> with serve("flash") as served:
    ...     sorted(served.addresses)
    ['cam', 'flash']
    """
    if world is None:
        rig = rig_name if isinstance(rig_name, Rig) else load_rig(rig_name)
        faults = Faults(baud=0.0) if faults is None else faults
        world = World(rig, seed=seed, clock="real", scene=scene, faults=faults)
    if world.virtual:
        raise ServeError("clock: got a virtual one, expected 'real': other programs share our time")
    return Served(world, pty=pty, host_port=_host_port(tcp, allow_remote))


def _host_port(text: str, allow_remote: bool) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not (colon and host and port.isdecimal() and int(port) < 65_536):
        raise ServeError(f"tcp: got {text!r}, expected HOST:PORT, e.g. 127.0.0.1:0")
    try:
        local = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        local = False
    if not local and not allow_remote:
        raise ServeError(
            f"tcp: got {host!r}, expected an address of this machine only, such as 127.0.0.1: "
            "whoever reaches the port can fire the lights; permit it explicitly if that is wanted"
        )
    if not local:
        log.warning("%s: other machines can reach the boxes and fire the lights", text)
    return host, int(port)


class Served:
    """Boxes and cameras being served; close it to stop.

    Attributes
    ----------
    world : World
        What is served.
    addresses : dict of str to str
        URL of each box, then of each camera, by name.
    """

    def __init__(self, world: World, *, pty: bool, host_port: tuple[str, int]) -> None:
        self.world = world
        self.addresses: dict[str, str] = {}
        self._closing = threading.Event()
        self._selector = selectors.DefaultSelector()
        self._wake_read, self._wake_write = os.pipe()
        self._selector.register(self._wake_read, selectors.EVENT_READ, lambda: None)
        self._ends: list[_End] = []
        host, port = host_port
        try:
            for name in world.rig.boxes:
                end: _End = (
                    _PtyEnd(world, world.link(name))
                    if pty
                    else _TcpEnd(world, world.link(name), host, port)
                )
                self._ends.append(end)
                end.start(self._selector)
                self.addresses[name] = end.address
                port += port > 0
            self._cameras = CameraService(world, host, port)
        except OSError as exc:
            for started in self._ends:
                started.stop()
            raise ServeError(f"tcp: cannot listen on {host}:{port}: {exc}") from exc
        self.addresses.update(self._cameras.addresses)
        self._thread = threading.Thread(target=self._run, name="rigsim-boxes", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def wait(self, timeout_s: float | None = None) -> None:
        """Serve until closed from elsewhere, or for `timeout_s`."""
        self._closing.wait(timeout_s)

    def close(self) -> None:
        """Stop serving; doing so twice is allowed."""
        if self._closing.is_set():
            return
        self._closing.set()
        os.write(self._wake_write, b"x")
        self._thread.join()
        self._cameras.close()
        for end in self._ends:
            end.stop()
        self._selector.close()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _run(self) -> None:
        world = self.world
        while not self._closing.is_set():
            pause = min(IDLE_S, world.deadline() - world.now)
            if any(end.stalled for end in self._ends):
                pause = min(pause, STALL_POLL_S)
            for key, _ in self._selector.select(max(0.0, pause)):
                key.data()
            world.advance(world.now)
            for end in self._ends:
                end.pump()


class _Line:
    """One end of a link: bytes that the box would not take yet wait here."""

    def __init__(self, world: World, link: Link) -> None:
        self._world = world
        self._link = link
        self._unsent = b""

    @property
    def stalled(self) -> bool:
        return bool(self._unsent)

    def forget(self) -> None:
        self._unsent = b""
        with self._world.lock:
            self._link.detach()

    def attach(self) -> None:
        with self._world.lock:
            self._world.advance(self._world.now)
            self._link.attach(self._world.now)

    def send(self, data: bytes) -> None:
        """Pass bytes on; raise `Unplugged`."""
        self._unsent += data
        with self._world.lock:
            now = self._world.now
            self._world.advance(now)
            with contextlib.suppress(LinkStalled):
                if self._unsent:
                    self._link.send(self._unsent, now)
                    self._unsent = b""
                    self._world.advance(now)

    def take(self) -> bytes:
        """Return what the box said; raise `Unplugged`."""
        if self._unsent:
            self.send(b"")
        with self._world.lock:
            self._link.check(self._world.now)
            return self._link.take(self._link.waiting)


class _PtyEnd:
    """A box behind a pseudo-terminal."""

    def __init__(self, world: World, link: Link) -> None:
        self._line = _Line(world, link)
        # the slave stays open here: else the master fails when a client closes
        self._master, self._slave = ptys.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.address = os.ttyname(self._slave)
        self._open = True

    @property
    def stalled(self) -> bool:
        return self._line.stalled

    def start(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector
        selector.register(self._master, selectors.EVENT_READ, self._readable)
        self._line.attach()

    def _readable(self) -> None:
        if not self._line.stalled:
            with contextlib.suppress(BlockingIOError):
                self._guarded(lambda: self._line.send(os.read(self._master, CHUNK_BYTES)))

    def pump(self) -> None:
        def write() -> None:
            data = self._line.take()
            # nobody reads and the terminal is full: what the box says is lost, as on a real line
            with contextlib.suppress(BlockingIOError):
                while data:
                    data = data[os.write(self._master, data) :]

        if self._open:
            self._guarded(write)

    def _guarded(self, act: Callable[[], None]) -> None:
        try:
            act()
        except Unplugged:
            self.stop()

    def stop(self) -> None:
        if self._open:
            self._open = False
            self._selector.unregister(self._master)
            os.close(self._master)
            os.close(self._slave)
            self._line.forget()


class _TcpEnd:
    """A box behind a TCP port, for one client at a time."""

    def __init__(self, world: World, link: Link, host: str, port: int) -> None:
        self._line = _Line(world, link)
        self._listener = socket.create_server((host, port), backlog=4)
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self._leaving: set[socket.socket] = set()
        self._unwritten = b""
        self.address = f"socket://{host}:{self._listener.getsockname()[1]}"

    @property
    def stalled(self) -> bool:
        return self._line.stalled or bool(self._unwritten)

    def start(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector
        selector.register(self._listener, selectors.EVENT_READ, self._acceptable)

    def _acceptable(self) -> None:
        try:
            client, peer = self._listener.accept()
        except OSError:
            return  # gone again
        if self._client is not None:
            log.warning("%s: refused %s, another host has the box", self.address, peer)
            self._see_out(client)
            return
        try:
            self._line.attach()
        except Unplugged:
            self._see_out(client)
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = client
        self._selector.register(client, selectors.EVENT_READ, self._readable)

    def _readable(self) -> None:
        if self._client is None or self._line.stalled:
            return
        try:
            data = self._client.recv(CHUNK_BYTES)
            if not data:
                raise ConnectionResetError
            self._line.send(data)
        except BlockingIOError:
            return
        except (OSError, Unplugged):
            self._hang_up()

    def pump(self) -> None:
        if self._client is None:
            return
        try:
            # a client that never reads loses what does not fit, as on a real line
            self._unwritten = (self._unwritten + self._line.take())[-(2**20) :]
            if self._unwritten:
                self._unwritten = self._unwritten[self._client.send(self._unwritten) :]
        except BlockingIOError:
            return
        except (OSError, Unplugged):
            self._hang_up()

    def _hang_up(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            self._selector.unregister(client)
            self._see_out(client)
            self._unwritten = b""
            self._line.forget()

    def _see_out(self, client: socket.socket) -> None:
        """Tell a client that it is over, and wait for its own end: closing at once is a reset."""

        def drain() -> None:
            with contextlib.suppress(BlockingIOError):
                try:
                    over = not client.recv(CHUNK_BYTES)
                except ConnectionError:
                    over = True
                if over:
                    self._leaving.discard(client)
                    self._selector.unregister(client)
                    client.close()

        try:
            client.setblocking(False)
            client.shutdown(socket.SHUT_WR)
        except OSError:
            client.close()
            return
        self._leaving.add(client)
        self._selector.register(client, selectors.EVENT_READ, drain)

    def stop(self) -> None:
        self._hang_up()
        for client in self._leaving:
            client.close()
        self._listener.close()
