"""Request and reply over a pyserial URL, with retries, timeouts and events.

A port is opened with `serial.serial_for_url`, so ``/dev/serial/by-id/...``, ``socket://host:port``
and every URL of the entry-point group ``capture.urlhandlers`` are the same to a driver. Of pyserial
only open, read, write, in_waiting, reset_input_buffer and close are used.

One thread uses a port. One request is pending at a time; a retry sends the same bytes, so that the
controller recognizes it and never executes a command twice.
"""

import contextlib
import errno
import json
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Protocol, Self

import serial

from capture.devices import wire
from capture.devices.errors import (
    BadAnswer,
    BoxRebooted,
    CommandRefused,
    DeviceError,
    LinkLost,
    PortBusy,
    PortTimeout,
    PortUrlError,
    WrongDevice,
)
from capture.devices.first_number import draw_first_number
from capture.devices.port_url import load_url_handler, opening_advice
from capture.devices.wire import Code, Event, Reply, Request

__all__ = [
    "SYSTEM_CLOCK",
    "BadAnswer",
    "BoxRebooted",
    "Clock",
    "CommandRefused",
    "DeviceError",
    "Hello",
    "LinkLost",
    "LinkStatistics",
    "Port",
    "PortBusy",
    "PortTimeout",
    "PortUrlError",
    "WrongDevice",
]

log = logging.getLogger(__name__)

READ_SLICE_S = 0.02
"""Duration of one read, in s; longer waits are made of several reads."""
MAX_CAPABILITY_PARTS = 1024
MAX_NOISE_BYTES = 65_536
"""Number of bytes without the answer after which an attempt ends, whatever the clock."""

try:
    from termios import error as _termios_error
except ImportError:  # pragma: no cover - Windows has no termios
    _termios_error = OSError  # type: ignore[misc,assignment]

# what pyserial raises when the device is gone or the port was closed during a read
_LINK_FAILURES = (OSError, _termios_error, TypeError, AttributeError)


class Clock(Protocol):
    """Source of time, real or simulated."""

    def monotonic(self) -> float:
        """Return the time in s since any fixed instant."""

    def sleep(self, seconds: float) -> None:
        """Let `seconds` pass."""


class _SystemClock:
    def monotonic(self) -> float:
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)


SYSTEM_CLOCK: Clock = _SystemClock()


@dataclass(slots=True)
class LinkStatistics:
    """Counters of one port since it was made."""

    requests: int = 0
    """Commands and queries requested."""
    frames: int = 0
    """Frames sent, retries included."""
    retries: int = 0
    """Frames sent again."""
    naks: int = 0
    """Damaged frames reported by the controller."""
    stale: int = 0
    """Answers to earlier requests and events that came before, dropped."""
    bad_lines: int = 0
    """Lines that were not frames, dropped."""
    lost_events: int = 0
    """Gaps in the numbers of events."""
    reboots: int = 0
    """Detected restarts of the controller."""


@dataclass(frozen=True, slots=True)
class Hello:
    """Identity of a controller, from its answer to hello."""

    version: int
    """Version of the wire protocol."""
    kind: str
    """Kind of controller, e.g. ``flash``."""
    serial: str
    """Serial number: identifies the device, whatever the port's name."""
    firmware: str
    boot: int
    """Epoch drawn at power-up, 1 to 65535."""


class _WriteStalled(Exception):
    pass


class Port:
    """Connection to a controller on a pyserial URL, one request at a time.

    Parameters
    ----------
    url
        ``/dev/...``, ``socket://host:port``, or a scheme of a handler of `URL_HANDLERS`.
    clock
        Clock of the timeouts; a read that returns nothing also counts as its duration, so that a
        port on a simulated clock times out under any clock.
    timeout_s
        Wait for an answer before the same bytes are sent again, s.
    retries
        Number of repetitions.
    first_seq
        First sequence number. By default milliseconds since 1970, so that the numbers of an
        earlier host are behind and its lines, come again, do nothing; give it only for
        byte-identical replays on a fresh controller.
    baudrate
        Bits per second, for real serial lines.

    Raises
    ------
    PortUrlError
        When no handler supports the URL.
    LinkLost
        When the port cannot be opened (`PortBusy` when another program uses it).
    """

    def __init__(
        self,
        url: str,
        *,
        clock: Clock | None = None,
        timeout_s: float = 0.25,
        retries: int = 8,
        first_seq: int | None = None,
        baudrate: int = 115_200,
    ) -> None:
        if not timeout_s > 0.0:
            raise ValueError(f"timeout_s: got {timeout_s}, expected more than 0")
        if retries < 0:
            raise ValueError(f"retries: got {retries}, expected 0 or more")
        self.url = url
        self.clock = SYSTEM_CLOCK if clock is None else clock
        self.statistics = LinkStatistics()
        self.events: deque[Event] = deque(maxlen=256)
        self.boot = wire.UNKNOWN_BOOT
        self._timeout_s = timeout_s
        self._retries = retries
        self._baudrate = baudrate
        self._seq = draw_first_number() if first_seq is None else first_seq
        self._splitter = wire.LineSplitter()
        self._lines: deque[bytes] = deque()
        self._next_event: int | None = None
        self._owner = threading.get_ident()
        self._serial: Any = None
        self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def hello(self, *, timeout_s: float = 3.0) -> Hello:
        """Read the epoch and the identity of the controller; needed first and after each reboot.

        Parameters
        ----------
        timeout_s
            Time to repeat the request, s: opening a port may reset the controller, which then does
            not answer for a while.
        """
        self._check_thread()
        self.boot = wire.UNKNOWN_BOOT
        self._next_event = None
        with self._translate_errors("flush"):
            self._serial.reset_input_buffer()
        self._splitter.clear()
        self._lines.clear()
        attempts = max(1, round(timeout_s / self._timeout_s))
        reply = self._exchange("SYST:HELLO?", attempts=attempts, knock=True)
        if reply.code != Code.OK:
            raise CommandRefused("SYST:HELLO?", reply.code, reply.payload)
        version, kind, serial_number, firmware = _hello_fields(self.url, reply.payload)
        if version != wire.PROTOCOL_VERSION:
            raise WrongDevice(
                f"{self.url}: the controller speaks protocol {version}, expected "
                f"{wire.PROTOCOL_VERSION}; update its firmware or this program [SR-CAP-004]"
            )
        self.boot = reply.boot
        return Hello(version, kind, serial_number, firmware, reply.boot)

    def ask(self, text: str) -> str:
        """Send one command or query and return the payload of its answer.

        Raises
        ------
        CommandRefused
            The controller did nothing and gave a reason.
        PortTimeout, LinkLost, BoxRebooted
            The command may have been executed.
        """
        self._check_thread()
        if self.boot == wire.UNKNOWN_BOOT:
            raise BoxRebooted(
                f"{self.url}: the epoch of the controller is not known; call hello() first"
            )
        reply = self._exchange(text, attempts=1 + self._retries, knock=False)
        if reply.code != Code.OK:
            raise CommandRefused(text, reply.code, reply.payload)
        return reply.payload

    def capabilities(self) -> dict[str, Any]:
        """Return the limits of the controller (``SYST:CAP?``), units in the keys.

        They are fetched in short parts: too few long lines survive a bad cable, and each retry
        would repeat all of it.

        Raises
        ------
        BadAnswer
            When the parts are not a sealed JSON object.
        """
        parts: list[str] = []
        last = "0"
        while last != "1":
            payload = self.ask(f"SYST:CAP:PART? {len(parts)}")
            last, _, part = payload.partition(",")
            parts.append(part)
            if last not in ("0", "1") or not part or len(parts) > MAX_CAPABILITY_PARTS:
                raise self._no_capabilities(payload)
        text = "".join(parts)
        try:
            table = json.loads(wire.unseal(text))
        except ValueError as exc:
            raise self._no_capabilities(text) from exc
        if not isinstance(table, dict):
            raise self._no_capabilities(text)
        return table

    def _no_capabilities(self, got: str) -> BadAnswer:
        return BadAnswer(
            f"{self.url}: 'SYST:CAP:PART?' gave {got!r}, expected sealed JSON in parts"
        )

    def listen(self, seconds: float) -> list[Event]:
        """Listen to the line for `seconds` and return the events that came, oldest first."""
        self._check_thread()
        for frame in self._received(seconds):
            # an answer to no pending request is stale
            self.statistics.stale += isinstance(frame, Reply)
        events = list(self.events)
        self.events.clear()
        return events

    def reopen(self, url: str | None = None) -> Hello:
        """Close the port, open it again (at `url` when given) and repeat hello."""
        self.close()
        self.url = self.url if url is None else url
        self._open()
        return self.hello()

    def close(self) -> None:
        """Close the port; calling it twice is allowed."""
        port, self._serial = self._serial, None
        if port is not None:
            with contextlib.suppress(*_LINK_FAILURES):
                port.close()

    def _check_thread(self) -> None:
        if threading.get_ident() != self._owner:
            raise RuntimeError(
                f"{self.url}: used by two threads; use a port only in the thread that made it"
            )

    def _open(self) -> None:
        load_url_handler(self.url)
        try:
            self._serial = serial.serial_for_url(
                self.url,
                baudrate=self._baudrate,
                timeout=READ_SLICE_S,
                # pyserial's RFC 2217 client rejects a write timeout; its socket's own timeouts then
                # apply
                write_timeout=None if self.url.startswith("rfc2217://") else self._timeout_s,
                exclusive=True,
            )
        except ValueError as exc:
            raise PortUrlError(f"{self.url!r} is not a port: {exc}") from exc
        except _LINK_FAILURES as exc:
            busy = getattr(exc, "errno", None) in (errno.EAGAIN, errno.EBUSY, errno.EACCES)
            kind = PortBusy if busy and "xclusive" in str(exc) else LinkLost
            number = getattr(exc, "errno", None)
            reason = os.strerror(number) if number and kind is LinkLost else str(exc)
            raise kind(
                f"cannot open {self.url}: {reason}; "
                f"{opening_advice(self.url, kind, number)} [SR-CAP-001]"
            ) from exc

    @contextlib.contextmanager
    def _translate_errors(self, action: str) -> Iterator[None]:
        if self._serial is None:
            raise LinkLost(f"{self.url}: cannot {action}, the port is closed; reopen it")
        try:
            yield
        except serial.SerialTimeoutException as exc:
            raise _WriteStalled from exc
        except _LINK_FAILURES as exc:
            self.close()
            raise LinkLost(
                f"{self.url}: the link was lost in {action} ({exc}); the last command may have "
                "been executed; reopen the port"
            ) from exc

    def _exchange(self, text: str, *, attempts: int, knock: bool) -> Reply:
        seq, self._seq = self._seq, wire.next_seq(self._seq)
        frame = wire.encode(Request(seq, self.boot, text))
        statistics = self.statistics
        statistics.requests += 1
        for attempt in range(attempts):
            statistics.frames += 1
            statistics.retries += attempt > 0
            # without this newline a lost one would join two frames
            line = b"\n" + frame if knock or attempt else frame
            try:
                with self._translate_errors("write"):
                    self._serial.write(line)
            except _WriteStalled:
                log.warning("%s: the controller does not accept bytes", self.url)
                continue
            reply = self._await_reply(seq)
            if reply is not None:
                return reply
        raise PortTimeout(
            f"{self.url}: no answer to {text!r} after {attempts} attempts of "
            f"{self._timeout_s:g} s; the command may have been executed; check cable and power, "
            "then connect again [SR-CAP-002]"
        )

    def _await_reply(self, seq: int) -> Reply | None:
        """Return the answer to `seq`, or None when the request must be sent again."""
        for frame in self._received(self._timeout_s):
            if isinstance(frame, Event):
                if frame.name == "NAK":
                    self.statistics.naks += 1
                    return None
            elif frame.seq == seq:
                return frame
            else:
                self.statistics.stale += 1
        return None

    def _received(self, seconds: float) -> Iterator[Reply | Event]:
        """Yield frames from the controller for `seconds`; events are also kept in `events`."""
        start_s = self.clock.monotonic()
        silent_s = 0.0
        bytes_left = MAX_NOISE_BYTES
        while True:
            while self._lines:
                frame = self._frame_in(self._lines.popleft())
                if frame is not None:
                    yield frame
            if max(silent_s, self.clock.monotonic() - start_s) >= seconds or bytes_left <= 0:
                return
            with self._translate_errors("read"):
                data = self._serial.read(max(1, self._serial.in_waiting))
            silent_s += 0.0 if data else READ_SLICE_S
            bytes_left -= len(data)
            self._lines.extend(self._splitter.feed(data))

    def _frame_in(self, line: bytes) -> Reply | Event | None:
        try:
            frame = wire.decode(line)
        except wire.BadFrame:
            frame = None
        if frame is None or isinstance(frame, Request):
            self.statistics.bad_lines += 1
            return None
        if self.boot not in (wire.UNKNOWN_BOOT, frame.boot):
            self.boot = wire.UNKNOWN_BOOT
            self.statistics.reboots += 1
            raise BoxRebooted(
                f"{self.url}: the controller has started again (epoch {frame.boot:04x}) and "
                "lost its settings; it is dark and disarmed; find the cause, then run the same "
                "command with --resume [SR-CAP-005]"
            )
        if isinstance(frame, Event):
            if self._next_event is not None:
                if wire.is_behind(frame.number, self._next_event):
                    self.statistics.stale += 1
                    return None
                lost = (frame.number - self._next_event) % (wire.MAX_SEQ + 1)
                self.statistics.lost_events += lost
            self._next_event = wire.next_seq(frame.number)
            if frame.name != "NAK":
                self.events.append(frame)
        return frame


def _hello_fields(url: str, payload: str) -> tuple[int, str, str, str]:
    fields = payload.split(",")
    if len(fields) != 4 or not fields[0].isdecimal():
        raise BadAnswer(
            f"{url}: 'SYST:HELLO?' was answered with {payload!r}, expected "
            "'version,kind,serial,firmware'"
        )
    return int(fields[0]), fields[1], fields[2], fields[3]
