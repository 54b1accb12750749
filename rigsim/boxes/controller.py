"""What every box has: protocol endpoint, error queue, arming and the lease watchdog; sans-I/O.

A `Controller` is fed bytes and time and returns bytes; it never sleeps and opens nothing. What the
box is good for - lamps, motors - is a `Device` with a command table of its own.

The lease: an armed box wants a valid frame at least every ``SYST:WDOG`` milliseconds. When none
comes it goes dark and disarms itself, and only a deliberate ``SYST:ARM`` arms it again.
"""

from __future__ import annotations

import json
import math
import re
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from capture.devices import wire
from capture.devices.wire import Code, Event, Reply, Request

CACHED_REPLIES = 8
ERROR_QUEUE = 16
CAPABILITY_PART = 48
"""Characters of the limits that one line carries: a short line survives a bad cable."""
LEASE_MS = (300, 5000)
DEFAULT_LEASE_MS = 1000

_NUMBER_PATTERN = re.compile(r"-?[0-9]{1,9}(\.[0-9]{1,9})?")
_WORD_PATTERN = re.compile(r"[A-Za-z0-9._-]{1,48}")

_CODE_TEXTS = {
    Code.SYNTAX: "Syntax error",
    Code.UNDEFINED_HEADER: "Undefined header",
    Code.NOT_ARMED: "Command protected; SYST:ARM first",
    Code.IGNORED: "Init ignored",
    Code.OUT_OF_RANGE: "Data out of range",
    Code.HARDWARE: "Hardware error",
    Code.QUEUE_OVERFLOW: "Queue overflow",
    Code.DUTY: "Duty limit",
    Code.THERMAL: "Too hot",
    Code.RECYCLE: "Recycling",
    Code.LIGHT_DOSE: "Light dose",
    Code.FLICKER: "Flicker; SAFE:EYES says whether eyes are safe",
    Code.FORCE: "Force limit",
    Code.INTERLOCK: "Interlock open",
    Code.WATCHDOG_TRIPPED: "Watchdog tripped; SYST:ARM first",
    Code.BOOT_CHANGED: "Boot changed; SYST:HELLO? first",
    Code.SEQ_REUSED: "Sequence number reused",
    Code.UNFRAMED: "Unframed command",
    Code.BAD_CRC: "Bad frame",
}


class Refused(Exception):
    """A command that is not carried out, with its code; the box did nothing."""

    def __init__(self, code: Code, detail: str = "") -> None:
        super().__init__(code, detail)
        self.code = code
        self.reason = _CODE_TEXTS[code] + (f"; {detail}" if detail else "")


@dataclass(frozen=True, slots=True)
class Later:
    """An act that is under way: it is answered when it is over."""

    at_s: float
    """When, s, on the world's clock."""
    outcome: Callable[[], str | Refused]
    """Payload of the answer, or why there is none; asked for then."""


@dataclass(frozen=True, slots=True)
class Command:
    """One row of a command table."""

    run: Callable[[str, float], str | Later]
    """(arguments, now in s) -> payload of the answer, or when it comes; raises `Refused`."""
    arguments: str = ""
    """What follows the header, as the manual writes it; empty: nothing may follow."""
    armed: bool = False
    """Whether it makes light, and so is refused unless the box is armed."""
    bare: bool = False
    """Whether it is taken without a frame although it is no query: only what makes dark."""
    harmless: tuple[str, ...] = ()
    """Arguments, upper case, with which it makes dark: taken unarmed and without a frame."""
    manual: str = ""
    """What it does, in one line."""


class Device(Protocol):
    """What a controller controls."""

    kind: str
    model: str

    def commands(self) -> Mapping[str, Command]:
        """Return the command table."""

    def capabilities(self) -> Mapping[str, Any]:
        """Return limits and counts, units in the names, as JSON values."""

    def status_bits(self, now: float) -> int:
        """Return bits 4 and up of ``STAT?``."""

    def busy(self, now: float) -> bool:
        """Tell whether something that was accepted is still going on."""

    def go_dark(self, now: float) -> None:
        """Switch every light off at once."""

    def reset(self, now: float, *, power_up: bool) -> None:
        """Return to the settings of power-up."""

    def advance(self, now: float) -> None:
        """Let time pass up to `now`, in s."""

    def deadline(self) -> float:
        """Return when the device will next change by itself, in s; inf for never."""

    def take_events(self) -> Iterable[tuple[str, str]]:
        """Return and forget what the device has to say unasked: name and payload."""


class Controller:
    """A box as its port sees it.

    Parameters
    ----------
    device
        What it controls.
    serial, firmware
        Identity; the serial number is the box, whatever its port is called.
    protocol
        Version of the wire protocol that the firmware speaks.
    rng
        Draws the boot epochs.
    now
        Time of power-up on the world's clock, in s.
    """

    def __init__(
        self,
        device: Device,
        *,
        serial: str,
        firmware: str = "1.0",
        protocol: int = wire.PROTOCOL_VERSION,
        rng: np.random.Generator,
        now: float = 0.0,
    ) -> None:
        self.device = device
        self.serial = serial
        self.boot = wire.UNKNOWN_BOOT
        self._firmware = firmware
        self._protocol = protocol
        self._rng = rng
        self._announce = False
        self.commands: dict[str, Command] = {**self._own_commands(), **device.commands()}
        self._forget(now, boot_s=0.0)

    # power ------------------------------------------------------------------------------------

    def power_cycle(self, now: float, *, boot_s: float, announce: bool) -> None:
        """Reset: dark, disarmed, deaf for `boot_s`, and a new epoch.

        `announce`: print a banner and a BOOT event when ready; a brown-out says nothing.
        """
        self.device.advance(now)
        self.device.go_dark(now)
        self._forget(now, boot_s=boot_s)
        self._announce = announce

    def _forget(self, now: float, *, boot_s: float) -> None:
        fresh = [self.boot, wire.UNKNOWN_BOOT]
        while self.boot in fresh:
            self.boot = int(self._rng.integers(1, 0x10000))
        self._splitter = wire.LineSplitter()
        self._errors: deque[tuple[int, str]] = deque()
        self._replies: deque[tuple[int, str, bytes]] = deque(maxlen=CACHED_REPLIES)
        self._under_way: tuple[Request, Later] | None = None
        self._events = 0
        self._lease_ms = DEFAULT_LEASE_MS
        self._lease_end = math.inf
        self._powered_at = now
        self._ready_at = now + boot_s
        self.armed = False
        self.tripped = False
        self.device.reset(now, power_up=True)

    # time and bytes ---------------------------------------------------------------------------

    def deadline(self) -> float:
        """Return when the box will next do something by itself, in s; inf for never."""
        ready = self._ready_at if self._announce else math.inf
        over = math.inf if self._under_way is None else self._under_way[1].at_s
        return min(ready, self._lease_end, over, self.device.deadline())

    def advance(self, now: float) -> bytes:
        """Let time pass up to `now`, in s, and return what the box says by itself."""
        output = b""
        while (due := self.deadline()) <= now:
            self.device.advance(due)
            output += self._device_events()
            if self._announce and due >= self._ready_at:
                self._announce = False
                output += f"{self.device.model} {self._firmware} ready\n".encode()
                output += self._event("BOOT", "POWER")
            if self._under_way is not None and due >= self._under_way[1].at_s:
                (request, later), self._under_way = self._under_way, None
                output += self._answer(request, later.outcome(), due)
            if due >= self._lease_end:
                self._disarm(due)
                self.tripped = True
                output += self._event("WDOG:TRIP", str(self._lease_ms))
        self.device.advance(now)
        return output + self._device_events()

    def feed(self, data: bytes, now: float) -> bytes:
        """Take bytes from the host at `now`, in s, and return what the box answers."""
        output = self.advance(now)
        if now < self._ready_at:
            return output
        for line in self._splitter.feed(data):
            answer = self._framed if wire.looks_framed(line) else self._bare
            output += answer(line, now)
            output += self._device_events()
        return output

    def _device_events(self) -> bytes:
        return b"".join(self._event(name, text) for name, text in self.device.take_events())

    # frames -----------------------------------------------------------------------------------

    def _framed(self, line: bytes, now: float) -> bytes:
        try:
            frame = wire.decode(line)
        except wire.BadFrame:
            return self._event("NAK", str(int(Code.BAD_CRC)))
        if not isinstance(frame, Request):
            return b""  # our own words back, from an echoing line
        if frame.boot == wire.UNKNOWN_BOOT and frame.text == "SYST:HELLO?":
            return wire.encode(Reply(frame.seq, self.boot, Code.OK, self._hello()))
        if self._foreign_epoch(frame.boot):
            refused = Refused(Code.BOOT_CHANGED)
            return wire.encode(Reply(frame.seq, self.boot, refused.code, refused.reason))
        self._renew_lease(now)
        answers = list(self._replies)
        if self._under_way is not None:
            request = self._under_way[0]
            # a retry gets nothing yet: the answer comes when the act is over
            answers.append((request.seq, request.text, b""))
        for seq, text, answer in answers:
            if self._same_request(seq, text, frame):
                return answer
            if seq == frame.seq:
                refused = Refused(Code.SEQ_REUSED)
                self._remember(refused)
                return wire.encode(Reply(frame.seq, self.boot, refused.code, refused.reason))
        try:
            outcome = self._execute(frame.text, now)
        except Refused as refused:
            return self._answer(frame, refused, now)
        if isinstance(outcome, Later):
            self._under_way = (frame, outcome)
            self._renew_lease(now)
            return b""
        return self._answer(frame, outcome, now)

    def _answer(self, request: Request, outcome: str | Refused, now: float) -> bytes:
        if isinstance(outcome, Refused):
            self._remember(outcome)
            reply = Reply(request.seq, self.boot, outcome.code, outcome.reason)
        else:
            reply = Reply(request.seq, self.boot, Code.OK, outcome)
        self._renew_lease(now)
        answer = wire.encode(reply)
        self._replies.append((request.seq, request.text, answer))
        return answer

    def _bare(self, line: bytes, now: float) -> bytes:
        text = line.decode("ascii", errors="replace").strip()
        header, _, arguments = text.partition(" ")
        header = header.upper()
        command = self.commands.get(header)
        try:
            if command is not None:
                dark = command.bare or arguments.upper() in command.harmless
                if not (header.endswith("?") or dark):
                    raise Refused(Code.UNFRAMED)
            payload = self._execute(text, now)
        except Refused as refused:
            self._remember(refused)
            return b""
        return f"{payload}\n".encode() if header.endswith("?") else b""

    def _execute(self, text: str, now: float) -> str | Later:
        header, _, arguments = text.partition(" ")
        command = self.commands.get(header.upper())
        if command is None:
            raise Refused(Code.UNDEFINED_HEADER)
        if bool(arguments) != bool(command.arguments):
            raise Refused(Code.SYNTAX, f"expected {header.upper()} {command.arguments}".strip())
        if command.armed and not (self.armed or arguments.upper() in command.harmless):
            raise Refused(Code.WATCHDOG_TRIPPED if self.tripped else Code.NOT_ARMED)
        return command.run(arguments, now)

    def _same_request(self, seq: int, text: str, frame: Request) -> bool:
        return seq == frame.seq and text == frame.text

    def _foreign_epoch(self, boot: int) -> bool:
        return boot != self.boot

    def _event(self, name: str, payload: str) -> bytes:
        number, self._events = self._events, wire.next_seq(self._events)
        return wire.encode(Event(number, self.boot, name, payload))

    def _remember(self, refused: Refused) -> None:
        if len(self._errors) == ERROR_QUEUE:
            self._errors[-1] = (int(Code.QUEUE_OVERFLOW), _CODE_TEXTS[Code.QUEUE_OVERFLOW])
        else:
            self._errors.append((int(refused.code), refused.reason))

    # lease and arming -------------------------------------------------------------------------

    def _renew_lease(self, now: float) -> None:
        self._lease_end = now + self._lease_ms / 1e3 if self.armed else math.inf

    def _disarm(self, now: float) -> None:
        self.armed = False
        self._lease_end = math.inf
        self.device.go_dark(now)

    # the commands every box knows -------------------------------------------------------------

    def _own_commands(self) -> dict[str, Command]:
        return {
            "*IDN?": Command(self._identify, manual="maker, model, serial number, firmware"),
            "*RST": Command(self._reset, manual="dark, disarmed, settings of power-up"),
            "*CLS": Command(self._clear, bare=True, manual="empty the error queue"),
            "*OPC?": Command(self._complete, manual="1 when nothing is under way, else 0"),
            "SYST:ERR?": Command(self._error, manual="oldest error and its text, removed"),
            "SYST:HELLO?": Command(self._greet, manual="protocol, kind, serial number, firmware"),
            "SYST:CAP?": Command(self._capable, manual="limits as JSON, with its checksum"),
            "SYST:CAP:PART?": Command(
                self._capable_part,
                "<n>",
                manual="part n of SYST:CAP?, from 0: 1 for the last, text",
            ),
            "SYST:WDOG": Command(self._set_lease, "<ms>", manual="lease, 300 to 5000 ms"),
            "SYST:WDOG?": Command(self._get_lease, manual="lease in ms"),
            "SYST:ARM": Command(self._arm, manual="allow light; starts the lease"),
            "SYST:ARM?": Command(self._is_armed, manual="1 armed, 0 not"),
            "SYST:PING?": Command(self._ping, manual="box clock since power-up, us"),
            "SAFE": Command(self._safe, bare=True, manual="dark and disarmed at once"),
            "ABOR": Command(self._safe, bare=True, manual="the same as SAFE"),
            "STAT?": Command(
                self._status,
                manual="sum of 1 armed, 2 watchdog tripped, 4 error queued, and the device's bits",
            ),
        }

    def _hello(self) -> str:
        return f"{self._protocol},{self.device.kind},{self.serial},{self._firmware}"

    def _identify(self, _: str, now: float) -> str:
        return f"RIGSIM,{self.device.model},{self.serial},{self._firmware}"

    def _greet(self, _: str, now: float) -> str:
        return self._hello()

    def _reset(self, _: str, now: float) -> str:
        self._disarm(now)
        self.device.reset(now, power_up=False)
        return ""

    def _clear(self, _: str, now: float) -> str:
        self._errors.clear()
        return ""

    def _complete(self, _: str, now: float) -> str:
        return "0" if self.device.busy(now) else "1"

    def _error(self, _: str, now: float) -> str:
        code, text = self._errors.popleft() if self._errors else (0, "No error")
        return f'{code},"{text}"'

    def _capable(self, _: str, now: float) -> str:
        table = {
            "kind": self.device.kind,
            "protocol": self._protocol,
            "lease_min_ms": LEASE_MS[0],
            "lease_max_ms": LEASE_MS[1],
            **self.device.capabilities(),
        }
        return wire.seal(json.dumps(table, separators=(",", ":"), allow_nan=False))

    def _capable_part(self, arguments: str, now: float) -> str:
        text = self._capable("", now)
        last = (len(text) - 1) // CAPABILITY_PART
        part = int(number(arguments, 0, last, "parts"))
        start = part * CAPABILITY_PART
        return f"{int(part == last)},{text[start : start + CAPABILITY_PART]}"

    def _set_lease(self, arguments: str, now: float) -> str:
        self._lease_ms = int(number(arguments, LEASE_MS[0], LEASE_MS[1], "ms"))
        return ""

    def _get_lease(self, _: str, now: float) -> str:
        return str(self._lease_ms)

    def _arm(self, _: str, now: float) -> str:
        self.armed = True
        self.tripped = False
        return ""

    def _is_armed(self, _: str, now: float) -> str:
        return str(int(self.armed))

    def _ping(self, _: str, now: float) -> str:
        return str(round((now - self._powered_at) * 1e6))

    def _safe(self, _: str, now: float) -> str:
        self._disarm(now)
        return ""

    def _status(self, _: str, now: float) -> str:
        own = self.armed + 2 * self.tripped + 4 * bool(self._errors)
        return str(own | self.device.status_bits(now))


def number(text: str, low: float, high: float, unit: str) -> float:
    """Return the number that a command gives, or refuse with -102 or -222.

    Examples
    --------
    >>> number("0.5", 0.0, 1.0, "of full power")
    0.5
    """
    if _NUMBER_PATTERN.fullmatch(text) is None:
        raise Refused(Code.SYNTAX, "expected a number")
    value = float(text)
    if not low <= value <= high:
        raise Refused(Code.OUT_OF_RANGE, f"expected {low:g} to {high:g} {unit}")
    return value


def choice(text: str, names: tuple[str, ...]) -> str:
    """Return the upper-case word that a command gives, or refuse with -102."""
    if text.upper() not in names:
        raise Refused(Code.SYNTAX, f"expected {' or '.join(names)}")
    return text.upper()


def word(text: str) -> str:
    """Return the token that a command gives, or refuse with -102."""
    if _WORD_PATTERN.fullmatch(text) is None:
        raise Refused(Code.SYNTAX, "expected 1 to 48 of A-Z a-z 0-9 . _ -")
    return text
