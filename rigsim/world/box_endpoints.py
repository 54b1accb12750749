"""Connect served controllers to pseudo-terminals or TCP ports."""

import contextlib
import logging
import os
import pty
import selectors
import socket
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable

from rigsim.world.link import Link, LinkStalled, LinkUnplugged
from rigsim.world.world import World

log = logging.getLogger(__name__)

CHUNK_BYTES = 4096
MAX_LEAVING = 16
"""Largest number of refused clients whose own end is awaited."""
BROWSER_STARTS = (
    *(b"GET ", b"POST ", b"PUT ", b"HEAD ", b"OPTIONS ", b"DELETE ", b"PATCH ", b"CONNECT "),
    *(b"TRACE ", b"PRI ", b"\x16\x03"),
)
"""First bytes of HTTP and TLS: a page in a browser must not command a controller."""


class BoxEndpoint(ABC):
    """Byte stream of one controller; bytes that it does not accept yet wait here."""

    address: str

    def __init__(self, world: World, link: Link) -> None:
        self._world = world
        self._link = link
        self._unsent = b""

    @property
    def is_stalled(self) -> bool:
        """Whether bytes wait that could not be passed on."""
        return bool(self._unsent)

    @abstractmethod
    def start(self, selector: selectors.BaseSelector) -> None:
        """Begin to serve; `selector` calls back when bytes arrive."""

    @abstractmethod
    def pump(self) -> None:
        """Pass on the controller's output."""

    @abstractmethod
    def stop(self) -> None:
        """Stop serving; a second call is allowed."""

    def _forget(self) -> None:
        self._unsent = b""
        with self._world.lock:
            self._link.detach()

    def _attach(self) -> None:
        with self._world.lock:
            self._world.advance(self._world.now)
            self._link.attach(self._world.now)

    def _send(self, data: bytes) -> None:
        """Pass bytes on; raise `LinkUnplugged`."""
        self._unsent += data
        with self._world.lock:
            now = self._world.now
            self._world.advance(now)
            with contextlib.suppress(LinkStalled):
                if self._unsent:
                    self._link.send(self._unsent, now)
                    self._unsent = b""
                    self._world.advance(now)

    def _take(self) -> bytes:
        """Return the controller's output; raise `LinkUnplugged`."""
        if self._unsent:
            self._send(b"")
        with self._world.lock:
            self._link.check(self._world.now)
            return self._link.take(self._link.waiting)


class PtyEndpoint(BoxEndpoint):
    """A controller behind a pseudo-terminal."""

    def __init__(self, world: World, link: Link) -> None:
        super().__init__(world, link)
        # the slave stays open here: otherwise the master fails when a client closes
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.address = os.ttyname(self._slave)
        self._open = True

    def start(self, selector: selectors.BaseSelector) -> None:
        """Begin to serve; `selector` calls back when bytes arrive."""
        self._selector = selector
        selector.register(self._master, selectors.EVENT_READ, self._readable)
        self._attach()

    def _readable(self) -> None:
        if not self.is_stalled:
            with contextlib.suppress(BlockingIOError):
                self._guarded(lambda: self._send(os.read(self._master, CHUNK_BYTES)))

    def pump(self) -> None:
        """Pass on the controller's output."""

        def write() -> None:
            data = self._take()
            # no reader and a full terminal: the output is lost, as on a real line
            with contextlib.suppress(BlockingIOError):
                while data:
                    data = data[os.write(self._master, data) :]

        if self._open:
            self._guarded(write)

    def _guarded(self, act: Callable[[], None]) -> None:
        try:
            act()
        except LinkUnplugged:
            self.stop()

    def stop(self) -> None:
        """Stop serving; a second call is allowed."""
        if self._open:
            self._open = False
            self._selector.unregister(self._master)
            os.close(self._master)
            os.close(self._slave)
            self._forget()


class TcpEndpoint(BoxEndpoint):
    """A controller behind a TCP port, for one client at a time."""

    def __init__(self, world: World, link: Link, host: str, port: int) -> None:
        super().__init__(world, link)
        self._listener = socket.create_server((host, port), backlog=4)
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self._heard = False
        self._leaving: dict[socket.socket, None] = {}
        self._unwritten = b""
        self.address = f"socket://{host}:{self._listener.getsockname()[1]}"

    @property
    def is_stalled(self) -> bool:
        """Whether bytes wait that could not be passed on."""
        return super().is_stalled or bool(self._unwritten)

    def start(self, selector: selectors.BaseSelector) -> None:
        """Begin to serve; `selector` calls back when bytes arrive."""
        self._selector = selector
        selector.register(self._listener, selectors.EVENT_READ, self._acceptable)

    def _acceptable(self) -> None:
        try:
            client, peer = self._listener.accept()
        except OSError:
            return  # gone again
        self._readable()  # detects a client that was killed
        if self._client is not None:
            log.warning("%s: refused %s, another host is connected", self.address, peer)
            self._close_gracefully(client)
            return
        try:
            self._attach()
        except LinkUnplugged:
            self._close_gracefully(client)
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client, self._heard = client, False
        self._selector.register(client, selectors.EVENT_READ, self._readable)

    def _readable(self) -> None:
        if self._client is None or super().is_stalled:
            return
        try:
            data = self._client.recv(CHUNK_BYTES)
            if not data or (not self._heard and data.startswith(BROWSER_STARTS)):
                raise ConnectionResetError
            self._heard = True
            self._send(data)
        except BlockingIOError:
            return
        except (OSError, LinkUnplugged):
            self._disconnect()

    def pump(self) -> None:
        """Pass on the controller's output."""
        if self._client is None:
            return
        try:
            # a client that never reads loses the overflow, as on a real line
            self._unwritten = (self._unwritten + self._take())[-(2**20) :]
            if self._unwritten:
                self._unwritten = self._unwritten[self._client.send(self._unwritten) :]
        except BlockingIOError:
            return
        except (OSError, LinkUnplugged):
            self._disconnect()

    def _disconnect(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            self._selector.unregister(client)
            self._close_gracefully(client)
            self._unwritten = b""
            self._forget()

    def _close_gracefully(self, client: socket.socket) -> None:
        """Shut a connection down and wait for the client's own end: closing at once is a reset."""

        def drain() -> None:
            if client not in self._leaving:
                return  # ended by a later one
            with contextlib.suppress(BlockingIOError):
                try:
                    over = not client.recv(CHUNK_BYTES)
                except ConnectionError:
                    over = True
                if over:
                    self._end(client)

        try:
            client.setblocking(False)
            client.shutdown(socket.SHUT_WR)
        except OSError:
            client.close()
            return
        while len(self._leaving) >= MAX_LEAVING:
            self._end(next(iter(self._leaving)))
        self._leaving[client] = None
        self._selector.register(client, selectors.EVENT_READ, drain)

    def _end(self, client: socket.socket) -> None:
        del self._leaving[client]
        self._selector.unregister(client)
        client.close()

    def stop(self) -> None:
        """Stop serving; a second call is allowed."""
        self._disconnect()
        for client in self._leaving:
            client.close()
        self._listener.close()
