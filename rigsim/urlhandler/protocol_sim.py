"""Implement the pyserial port of a simulated box: ``sim://BOX?seed=1&clock=virtual&drop=0.001``.

``sim://flash?world=NAME`` is the controller of a registered world; an unknown name builds a world
and registers it. ``name=NAME`` is equivalent. Without a name the whole URL is the name: the same
URL is the same controller, which keeps its state while its port is closed, and its cameras are
``sim://flash/VIEW``. ``seed``, ``clock`` (virtual or real) and the switches of
`rigsim.boxes.faults.Faults` configure a new world.

The port fails as real ones do: a pulled cable is a SerialException in read and write, an OSError in
``in_waiting`` and a ``termios.error`` in ``reset_input_buffer``.
"""

import errno
import math
import termios
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from serial.serialutil import PortNotOpenError, SerialBase, SerialException, SerialTimeoutException

from capture.rig import SCANNER_BOX, load_rig
from rigsim import world as worlds
from rigsim.boxes.faults import Faults
from rigsim.world import World
from rigsim.world.link import Link, LinkStalled, LinkUnplugged
from rigsim.world.rig_boxes import BOXES

REAL_POLL_S = 0.002
"""Interval at which a port on the real clock checks for actions of other threads, s."""


def world_from_url(url: str) -> tuple[World, str]:
    """Return the world of a ``sim://`` URL, built if necessary, and the name of the controller.

    Raises
    ------
    ValueError
        When the URL has an invalid or a contradictory setting.
    """
    parts = urlsplit(url)
    pairs = parse_qsl(parts.query, keep_blank_values=True, strict_parsing=bool(parts.query))
    settings = dict(pairs)
    if len(settings) != len(pairs):
        raise ValueError(f"{url}: got a setting twice, expected each once")
    box = parts.netloc
    if "name" in settings and "world" in settings:
        raise ValueError(f"{url}: got world and name, which mean the same; give one")
    name = settings.pop("world", settings.pop("name", url))
    try:
        return _with_box(worlds.get_world(name), box, url), box
    except KeyError:
        pass
    seed, clock = settings.pop("seed", "0"), settings.pop("clock", "virtual")
    if not seed.isdecimal():
        raise ValueError(f"{url}: seed: got {seed!r}, expected a whole number >= 0")
    if clock not in ("virtual", "real"):
        raise ValueError(f"{url}: clock: got {clock!r}, expected 'virtual' or 'real'")
    try:
        faults = Faults.from_text(settings)
    except ValueError as exc:
        raise ValueError(f"{url}: {exc}") from exc
    rig = load_rig(BOXES[box].rig if box in BOXES else "flash")
    if box == SCANNER_BOX:
        rig = rig.with_scanner()
    made = World(rig, seed=int(seed), clock="real" if clock == "real" else "virtual", faults=faults)
    _with_box(made, box, url).register(name)
    return made, box


def _with_box(world: World, box: str, url: str) -> World:
    try:
        world.link(box)
    except KeyError as exc:
        raise ValueError(f"{url}: {exc.args[0]}") from exc
    return world


class Serial(SerialBase):
    """Host end of a simulated line."""

    BAUDRATES = (9600, 19_200, 38_400, 57_600, 115_200, 230_400, 460_800, 921_600, 1_000_000)
    is_open: bool

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self._world: World | None = None
        self._link: Link | None = None
        super().__init__(*args, **kwargs)

    def open(self) -> None:
        """Open the port; fail when another one has opened it."""
        if self._port is None:
            raise SerialException("Port must be configured before it can be used.")
        if self.is_open:
            raise SerialException("Port is already open.")
        world, box = world_from_url(self._port)
        with world.lock:
            world.advance(world.now)
            link = world.link(box)
            if link.attached:
                raise SerialException(errno.EAGAIN, f"Could not exclusively lock port {self._port}")
            try:
                link.attach(world.now)
            except LinkUnplugged as exc:
                raise SerialException(errno.ENOENT, f"could not open port {self._port}") from exc
        self._world, self._link = world, link
        self.is_open = True

    def close(self) -> None:
        """Close the port; the controller's state persists."""
        if self.is_open and self._link is not None and self._world is not None:
            with self._world.lock:
                self._world.advance(self._world.now)
                self._link.detach()
        self.is_open = False

    def _reconfigure_port(self) -> None:
        """Accept any line settings."""

    def _ends(self) -> tuple[World, Link]:
        if not self.is_open or self._world is None or self._link is None:
            raise PortNotOpenError()
        return self._world, self._link

    @property
    def in_waiting(self) -> int:
        """Number of bytes that have arrived."""
        world, link = self._ends()
        with world.lock:
            world.advance(world.now)
            try:
                link.check(world.now)
            except LinkUnplugged as exc:
                raise OSError(errno.EIO, "Input/output error") from exc
            return link.waiting

    def read(self, size: int = 1) -> bytes:
        """Return up to `size` bytes, fewer when the timeout comes first."""
        world, link = self._ends()
        data = b""
        until = math.inf if self._timeout is None else world.now + self._timeout
        while True:
            with world.lock:
                due = world.advance(world.now)
                try:
                    link.check(world.now)
                except LinkUnplugged as exc:
                    what = "device reports readiness to read but returned no data"
                    raise SerialException(f"{what} (device disconnected?)") from exc
                data += link.take(size - len(data))
            if len(data) >= size or world.now >= until:
                return data
            if world.virtual and math.isinf(min(due, until)):
                raise SerialException("nothing will ever come; a virtual clock needs a timeout")
            world.wait(min(due, until, math.inf if world.virtual else world.now + REAL_POLL_S))

    def write(self, data: bytes) -> int:
        """Send bytes to the controller."""
        world, link = self._ends()
        data = bytes(data)
        until = math.inf if self._write_timeout is None else world.now + self._write_timeout
        while True:
            with world.lock:
                world.advance(world.now)
                try:
                    link.send(data, world.now)
                except LinkUnplugged as exc:
                    raise SerialException(f"write failed: [Errno {errno.EIO}]") from exc
                except LinkStalled as exc:
                    if world.now >= until:
                        raise SerialTimeoutException("Write timeout") from exc
                else:
                    world.advance(world.now)
                    return len(data)
                due = world.deadline()
            if math.isinf(min(due, until)):
                raise SerialException("the controller never takes bytes; set a write timeout")
            world.wait(min(due, until))

    def reset_input_buffer(self) -> None:
        """Drop the bytes that have arrived."""
        world, link = self._ends()
        with world.lock:
            world.advance(world.now)
            try:
                link.check(world.now)
            except LinkUnplugged as exc:
                raise termios.error(errno.EIO, "Input/output error") from exc
            link.flush()
