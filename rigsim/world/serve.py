"""Serve a world's controllers on a pty or a TCP port, and its cameras on TCP, in real time.

One thread moves the controllers' bytes and advances the world's time. Each camera connection has a
thread of its own, because computing pixels takes time and no lamp may wait for it. Controllers,
lines and faults are those behind ``sim://``, so that a client in any language observes the same as
a driver. Every client that reaches a port can fire the lights: ports listen on this machine only.
"""

from __future__ import annotations

import ipaddress
import os
import selectors
import threading
from collections.abc import Mapping
from types import TracebackType
from typing import Self

from capture.rig import Rig, load_rig
from rigsim.boxes.faults import Faults
from rigsim.world.box_endpoints import BoxEndpoint, PtyEndpoint, TcpEndpoint
from rigsim.world.camera_service import CameraService
from rigsim.world.world import Scene, World

MAX_IDLE_S = 0.5
"""Longest sleep of the thread that serves the controllers, s."""
STALL_POLL_S = 0.02


class ServeError(ValueError):
    """An address that cannot be served."""


def serve_world(
    rig_name: str | Rig,
    *,
    pty: bool = False,
    tcp: str = "127.0.0.1:0",
    seed: int = 0,
    subject_seed: int | None = None,
    scene: Scene | None = None,
    faults: Faults | None = None,
    shots_made: Mapping[str, int] | None = None,
    world: World | None = None,
) -> ServedWorld:
    """Serve the controllers and cameras of a rig until the result is closed.

    Parameters
    ----------
    rig_name
        Name, path, or the rig itself.
    pty
        Controllers on pseudo-terminals instead of TCP; cameras are on TCP in either case.
    tcp
        ``HOST:PORT``; port 0 takes free ones. Otherwise the controllers get ports upwards from it,
        in the order of the rig, then all cameras one.
    seed, subject_seed, scene, faults, shots_made
        Arguments of the new world, see `World`; without `faults`, bytes take no time beyond that
        of the pty or the network.
    world
        Serve this world instead; its clock must be the real one.

    Returns
    -------
    Served
        Running service; ``served.addresses`` are the URLs, controllers first.

    Raises
    ------
    ServeError
        When the address is in use, is malformed, or is reachable from elsewhere.

    Examples
    --------
    >>> with serve_world("flash") as served:
    ...     sorted(served.addresses)
    ['cam', 'flash']
    """
    if world is None:
        rig = rig_name if isinstance(rig_name, Rig) else load_rig(rig_name)
        faults = Faults(baud=0.0) if faults is None else faults
        world = World(
            rig,
            seed=seed,
            subject_seed=subject_seed,
            clock="real",
            scene=scene,
            faults=faults,
            shots_made=shots_made,
        )
    if world.virtual:
        raise ServeError("clock: got a virtual one, expected 'real' for other programs")
    return ServedWorld(world, pty=pty, host_port=_host_port(tcp))


def _host_port(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not (colon and host and port.isdecimal() and int(port) < 65_536):
        raise ServeError(f"tcp: got {text!r}, expected HOST:PORT, e.g. 127.0.0.1:0")
    try:
        local = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        local = False
    if not local:
        raise ServeError(
            f"tcp: got {host!r}, expected an address of this machine only, such as 127.0.0.1. "
            "Any client of the port can fire the lights; from another machine use a tunnel, "
            "ssh -L PORT:127.0.0.1:PORT THIS_MACHINE"
        )
    return host, int(port)


class ServedWorld:
    """Running service of controllers and cameras; close it to stop.

    Attributes
    ----------
    world : World
        The served world.
    addresses : dict of str to str
        URL of each controller, then of each camera, by name.
    """

    def __init__(self, world: World, *, pty: bool, host_port: tuple[str, int]) -> None:
        self.world = world
        self.addresses: dict[str, str] = {}
        self._closing = threading.Event()
        self._selector = selectors.DefaultSelector()
        self._wake_read, self._wake_write = os.pipe()
        self._selector.register(self._wake_read, selectors.EVENT_READ, lambda: None)
        self._ends: list[BoxEndpoint] = []
        host, port = host_port
        try:
            for name in world.rig.boxes:
                link = world.link(name)
                end = PtyEndpoint(world, link) if pty else TcpEndpoint(world, link, host, port)
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
        """Stop serving; a second call is allowed."""
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
            pause = min(MAX_IDLE_S, world.deadline() - world.now)
            if any(end.is_stalled for end in self._ends):
                pause = min(pause, STALL_POLL_S)
            for key, _ in self._selector.select(max(0.0, pause)):
                key.data()
            world.advance(world.now)
            for end in self._ends:
                end.pump()
