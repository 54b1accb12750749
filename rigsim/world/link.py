"""Simulate the line between a host and a controller: delay, order, and faults on its bytes.

A `Link` is sans-I/O like the controller behind it: bytes from either side are queued with their
arrival times, and `advance` delivers the due ones. The line keeps its order: a late answer delays
all that follow.
"""

import math
from bisect import insort
from collections import deque
from collections.abc import Callable
from operator import itemgetter

import numpy as np

from rigsim.boxes.controller import Controller
from rigsim.boxes.faults import Faults
from rigsim.world.line_faults import LineReset, LineTap

STALL_BUFFER_BYTES = 256
"""Capacity of the line while a stalled controller takes nothing, bytes."""
BOOT_BANNER = b"\r\nrst:0x1 (POWERON),boot:0x13\r\nheap 203412 free\r\n"

RecordBytes = Callable[[float, str, bytes], None]


class LinkUnplugged(Exception):
    """The cable is unplugged."""


class LinkStalled(Exception):
    """The controller takes no bytes and the buffer of the line is full."""


class Link:
    """One controller and the line to it.

    Parameters
    ----------
    box
        Controller at the far end.
    faults
        Switches, see `rigsim.boxes.faults.Faults`.
    rng
        Determines when the faults strike.
    record
        Called with (time in s, direction, bytes) for the transcript: ``>`` arrives at the
        controller,
        ``<`` arrives at the host.

    Attributes
    ----------
    tap : LineTap or None
        What is between the two ends; None: nothing.
    """

    def __init__(
        self, box: Controller, *, faults: Faults, rng: np.random.Generator, record: RecordBytes
    ) -> None:
        self.box = box
        self.attached = False
        self.tap: LineTap | None = None
        self._is_reset = False
        # lines that the tap holds back: arrival time, direction and bytes
        self._held_back: list[tuple[float, str, bytes]] = []
        self._faults = faults
        self._rng = rng
        self._record = record
        self._to_box: deque[tuple[float, bytes]] = deque()
        self._to_host: deque[tuple[float, bytes]] = deque()
        self._received = bytearray()
        self._first_open = math.inf
        self._opened_at = math.inf
        self._byte_s = 10.0 / faults.baud if faults.baud else 0.0
        self._reset_at = faults.reset_after
        # arrival time of the last byte in each direction: the line is first in, first out
        self._box_free = 0.0
        self._host_free = 0.0

    # the host's end ---------------------------------------------------------------------------

    def attach(self, now: float) -> None:
        """Open the port; raise `LinkUnplugged` when the cable is out."""
        self._first_open = min(self._first_open, now)
        self._opened_at = now
        self._is_reset = False
        self.check(now)
        self.attached = True
        if self._faults.reset_on_open:
            self.box.power_cycle(now, boot_s=self._faults.boot_s, announce=True)

    def detach(self) -> None:
        """Close the port; later output of the controller is lost."""
        self.attached = False
        self._held_back.clear()
        self._to_host.clear()
        self._received.clear()

    def check(self, now: float) -> None:
        """Raise `LinkUnplugged` while the cable is out, or after a reset of the connection.

        An earlier port stays dead.
        """
        if self._is_reset:
            raise LinkUnplugged
        out = self._first_open + self._faults.unplug_after
        if now >= out and (now < out + self._faults.replug_after or self._opened_at < out):
            raise LinkUnplugged

    def send(self, data: bytes, now: float) -> None:
        """Send bytes to the controller; raise `LinkStalled` when they do not fit."""
        self.check(now)
        waiting = sum(len(chunk) for _, chunk in self._to_box)
        if self._stall_end(now) > now and waiting + len(data) > STALL_BUFFER_BYTES:
            raise LinkStalled
        for line in data.splitlines(keepends=True):
            for copy in self._apply_faults(line):
                self._pass(">", copy, now)
        self.check(now)

    def _pass(self, way: str, line: bytes, now: float) -> None:
        """Put a line on its way, through the tap if there is one."""
        parts = [(0.0, line)]
        if self.tap is not None and line != b"\n":
            try:
                parts = self.tap.pass_on(way, line)
            except LineReset:
                self._is_reset = True
                return
        for delay_s, data in parts:
            if data and delay_s > 0.0:
                insort(self._held_back, (now + delay_s, way, data), key=itemgetter(0))
            elif data:
                self._queue(way, data, now)

    def _queue(self, way: str, data: bytes, now: float) -> None:
        if way == ">":
            self._box_free = max(now, self._box_free) + len(data) * self._byte_s
            self._to_box.append((self._box_free + self._faults.latency, data))
        else:
            self._host_free = max(now, self._host_free) + len(data) * self._byte_s
            self._to_host.append((self._host_free, data))

    @property
    def quiet_from_s(self) -> float:
        """Time from which no more bytes of the host arrive unless it sends some, s."""
        return max((at_s for at_s, _ in self._to_box), default=0.0)

    def take(self, size: int) -> bytes:
        """Return at most `size` bytes that have arrived."""
        data = bytes(self._received[:size])
        del self._received[:size]
        return data

    @property
    def waiting(self) -> int:
        """Number of bytes that have arrived and were not taken."""
        return len(self._received)

    def flush(self) -> None:
        """Drop the bytes that have arrived."""
        self._received.clear()

    # time -------------------------------------------------------------------------------------

    def deadline(self, now: float) -> float:
        """Return the time of the next event on the line, in s; inf for never."""
        due = self._to_host[0][0] if self._to_host else math.inf
        if self._to_box:
            due = min(due, max(self._to_box[0][0], self._stall_end(now)))
        held_s = self._held_back[0][0] if self._held_back else math.inf
        return min(due, held_s, self._reset_at, self.box.deadline())

    def advance(self, now: float) -> None:
        """Deliver the bytes due at `now`, in s."""
        if self._reset_at <= now:
            self._reset_at = math.inf
            self.box.power_cycle(now, boot_s=self._faults.boot_s, announce=False)
        self._answer(self.box.advance(now), now)
        while self._held_back and self._held_back[0][0] <= now:
            _, way, data = self._held_back.pop(0)
            self._queue(way, data, now)
        while self._to_box and self._to_box[0][0] <= now and self._stall_end(now) <= now:
            _, data = self._to_box.popleft()
            self._record(now, ">", data)
            if self._occurs(self._faults.brownout):
                self.box.power_cycle(now, boot_s=self._faults.boot_s, announce=False)
            self._answer(self.box.feed(data, now), now)
        while self._to_host and self._to_host[0][0] <= now:
            _, data = self._to_host.popleft()
            self._record(now, "<", data)
            self._received += data

    def _answer(self, data: bytes, now: float) -> None:
        for line in data.splitlines(keepends=True):
            if not self.attached or self._occurs(self._faults.lose_answer):
                continue
            output = [BOOT_BANNER] if self._occurs(self._faults.babble) else []
            delay_s = self._faults.latency
            if self._occurs(self._faults.late):
                delay_s += self._faults.late_s
            for copy in [*output, *self._apply_faults(line)]:
                self._pass("<", copy, now + delay_s)

    def _stall_end(self, now: float) -> float:
        start = self._first_open + self._faults.stall_after
        return start + self._faults.stall_s if start <= now < start + self._faults.stall_s else now

    # faults on bytes --------------------------------------------------------------------

    def _occurs(self, probability: float) -> bool:
        return probability > 0.0 and bool(self._rng.random() < probability)

    def _apply_faults(self, line: bytes) -> list[bytes]:
        faults = self._faults
        copies = 1 + self._occurs(faults.duplicate)
        return [damaged for _ in range(copies) if (damaged := self._corrupt(line))]

    def _corrupt(self, line: bytes) -> bytes:
        faults = self._faults
        if self._occurs(faults.glue):
            line = line.removesuffix(b"\n")
        if self._occurs(faults.cut):
            line = line[: int(self._rng.integers(0, len(line) + 1))]
        if not (faults.drop or faults.flip):
            return line
        data = np.frombuffer(line, np.uint8).copy()
        if faults.flip:
            bits = np.left_shift(1, self._rng.integers(0, 8, data.size)).astype(np.uint8)
            data ^= np.where(self._rng.random(data.size) < faults.flip, bits, 0).astype(np.uint8)
        if faults.drop:
            data = data[self._rng.random(data.size) >= faults.drop]
        return data.tobytes()
