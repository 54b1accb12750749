"""Protocol endpoint of all controllers: error queue, arming and the lease watchdog (sans-I/O).

A `Controller` takes bytes and time and returns bytes; it never sleeps and opens nothing. A `Device`
with its own command table implements the hardware, such as lamps and motors.

The lease: an armed controller requires a valid frame at least every ``SYST:WDOG`` milliseconds.
Without one it goes dark and disarms itself, and only an explicit ``SYST:ARM`` arms it again.
"""

import json
import math
from collections import deque

import numpy as np

from capture.devices import wire
from capture.devices.wire import Code, Event, Reply, Request
from rigsim.boxes.command import (
    Command,
    CommandHandler,
    CommandRefused,
    PendingReply,
    add_us,
    build_command_table,
    elapsed_us,
    on_clock,
    parse_number,
)
from rigsim.boxes.device import Device

FIRMWARE_VERSION = "1.0"
PROTOCOL_MINOR = 3
"""Revision of the protocol's text; a controller without it in its limits is of revision 0."""
MAX_CACHED_REPLIES = 8
MAX_REMEMBERED_HELLOS = 8
MAX_KEPT_ANSWER_BYTES = 160
"""Longest answer that is kept, newline included; only the limits are longer, and are made again."""
MAX_QUEUED_ERRORS = 16
CAPABILITY_CHUNK_CHARS = 48
"""Characters of the limits per line: a short line survives a bad cable."""
LEASE_RANGE_MS = (300, 5000)
DEFAULT_LEASE_MS = 1000


class Controller:
    """A controller as seen from its port.

    Parameters
    ----------
    device
        The controlled device.
    serial
        Serial number; it identifies the controller, whatever its port's name.
    rng
        Draws the boot epochs.
    """

    def __init__(self, device: Device, *, serial: str, rng: np.random.Generator) -> None:
        self.device = device
        self.serial = serial
        self.boot = wire.UNKNOWN_BOOT
        self._protocol = device.faults.protocol
        self._rng = rng
        self._announce = False
        self.commands: dict[str, Command] = {**self._own_commands(), **device.commands()}
        self._reset_state(0.0, boot_s=0.0)

    # power ------------------------------------------------------------------------------------

    def power_cycle(self, now: float, *, boot_s: float, announce: bool) -> None:
        """Reset: dark, disarmed, deaf for `boot_s`, and in a new epoch.

        `announce`: print a banner and send a BOOT event when ready; a brown-out is silent.
        """
        now = on_clock(now)
        self.device.advance(now)
        self.device.go_dark(now)
        self._reset_state(now, boot_s=boot_s)
        self._announce = announce

    def _reset_state(self, now: float, *, boot_s: float) -> None:
        fresh = [self.boot, wire.UNKNOWN_BOOT]
        while self.boot in fresh:
            self.boot = int(self._rng.integers(1, 0x10000))
        self._splitter = wire.LineSplitter()
        self._errors: deque[tuple[int, str]] = deque()
        self._replies: deque[tuple[int, str, bytes]] = deque(maxlen=MAX_CACHED_REPLIES)
        self._under_way: tuple[Request, PendingReply] | None = None
        self._hellos: deque[int] = deque(maxlen=MAX_REMEMBERED_HELLOS)
        self._latest_seq: int | None = None
        self._events = 0
        self._lease_ms = DEFAULT_LEASE_MS
        self._lease_end = math.inf
        self._powered_at = now
        self._ready_at = add_us(now, 1e6 * boot_s)
        self.armed = False
        self.tripped = False
        self.device.reset(now, power_up=True)

    @property
    def lease_s(self) -> float:
        """Silence after which it goes dark, s."""
        return self._lease_ms / 1e3

    # time and bytes ---------------------------------------------------------------------------

    def deadline(self) -> float:
        """Return the time of the controller's next action of its own, in s; inf for never."""
        ready = self._ready_at if self._announce else math.inf
        over = math.inf if self._under_way is None else self._under_way[1].at_s
        return min(ready, self._lease_end, over, self.device.deadline())

    def advance(self, now: float) -> bytes:
        """Advance time to `now`, in s, and return unsolicited output."""
        now = on_clock(now)
        output = b""
        while (due := self.deadline()) <= now:
            self.device.advance(due)
            output += self._device_events()
            if self._announce and due >= self._ready_at:
                self._announce = False
                output += f"{self.device.model} {FIRMWARE_VERSION} ready\n".encode()
                output += self._event("BOOT", "POWER")
            if self._under_way is not None and due >= self._under_way[1].at_s:
                output += self._conclude(due)
            if due >= self._lease_end:
                self._disarm(due)
                self.tripped = True
                output += self._event("WDOG:TRIP", str(self._lease_ms))
        self.device.advance(now)
        return output + self._device_events()

    def feed(self, data: bytes, now: float) -> bytes:
        """Process bytes from the host at `now`, in s, and return the answer."""
        now = on_clock(now)
        output = self.advance(now)
        if now < self._ready_at:
            return output
        for line in self._splitter.feed(data):
            answer = (
                self._handle_framed_line if wire.is_frame_like(line) else self._handle_bare_line
            )
            output += answer(line, now)
            output += self._device_events()
        return output

    def _device_events(self) -> bytes:
        return b"".join(self._event(name, text) for name, text in self.device.take_events())

    # frames -----------------------------------------------------------------------------------

    def _handle_framed_line(self, line: bytes, now: float) -> bytes:
        try:
            frame = wire.decode(line)
        except wire.BadFrame:
            return self._event("NAK", str(int(Code.BAD_CRC)))
        if not isinstance(frame, Request):
            return b""  # the controller's own output, returned by an echoing line
        if frame.boot == wire.UNKNOWN_BOOT and frame.text == "SYST:HELLO?":
            if frame.seq not in self._hellos:  # a host begins; an old hello again changes nothing
                self._hellos.append(frame.seq)
                self._latest_seq = frame.seq
            return wire.encode(Reply(frame.seq, self.boot, Code.OK, self._hello()))
        if self._foreign_epoch(frame.boot):
            refused = CommandRefused(Code.BOOT_CHANGED)
            return wire.encode(Reply(frame.seq, self.boot, refused.code, refused.reason))
        latest = self._latest_seq
        behind = latest is not None and wire.is_behind(frame.seq, latest)
        is_new = frame.seq != latest and not behind
        if is_new:
            self._renew_lease(now)
            self._latest_seq = frame.seq
        answers = list(self._replies)
        if self._under_way is not None:
            request = self._under_way[0]
            # a retry is not answered yet: the answer follows when the command is complete
            answers.append((request.seq, request.text, b""))
        for seq, text, answer in answers:
            if self._same_request(seq, text, frame):
                if not answer:
                    self._renew_lease(now)  # its host still waits
                if len(answer) > MAX_KEPT_ANSWER_BYTES:
                    break
                return answer
            if seq == frame.seq:
                is_new = False
        else:
            if not is_new and not self._is_permitted_bare(frame.text):
                return self._refuse_reused(frame)
        try:
            outcome = self._execute(frame.text, now)
        except CommandRefused as refused:
            return self._answer(frame, refused, now, is_new=is_new)
        if isinstance(outcome, PendingReply):
            ended = self._conclude(now)  # what was made dark just before, if anything
            self._under_way = (frame, outcome)
            self._renew_lease(now)
            return ended
        return self._answer(frame, outcome, now, is_new=is_new)

    def _conclude(self, now: float) -> bytes:
        """Answer the command under way; nothing without one."""
        if self._under_way is None:
            return b""
        (request, later), self._under_way = self._under_way, None
        return self._answer(request, later.outcome(), now)

    def _refuse_reused(self, request: Request) -> bytes:
        refused = CommandRefused(Code.SEQ_REUSED)
        self._record_error(refused)
        return wire.encode(Reply(request.seq, self.boot, refused.code, refused.reason))

    def _answer(
        self, request: Request, outcome: str | CommandRefused, now: float, *, is_new: bool = True
    ) -> bytes:
        if isinstance(outcome, CommandRefused):
            self._record_error(outcome)
            reply = Reply(request.seq, self.boot, outcome.code, outcome.reason)
        else:
            reply = Reply(request.seq, self.boot, Code.OK, outcome)
        answer = wire.encode(reply)
        if is_new:
            self._renew_lease(now)
            self._replies.append((request.seq, request.text, answer))
        return answer

    def _handle_bare_line(self, line: bytes, now: float) -> bytes:
        text = line.decode("ascii", errors="replace").strip()
        header = text.partition(" ")[0].upper()
        try:
            if header in self.commands:
                permitted = header.endswith("?") or self._is_permitted_bare(text)
                CommandRefused.raise_if(not permitted, Code.UNFRAMED)
            payload = self._execute(text, now)
        except CommandRefused as refused:
            self._record_error(refused)
            return b""
        return f"{payload}\n".encode() if header.endswith("?") else b""

    def _is_permitted_bare(self, text: str) -> bool:
        """Return whether a command makes dark or safe, whoever sends it."""
        header, _, arguments = text.partition(" ")
        command = self.commands.get(header.upper())
        return command is not None and (command.bare or arguments.upper() in command.harmless)

    def _execute(self, text: str, now: float) -> str | PendingReply:
        header, _, arguments = text.partition(" ")
        command = self.commands.get(header.upper())
        if command is None:
            raise CommandRefused(Code.UNDEFINED_HEADER)
        if bool(arguments) != bool(command.arguments):
            raise CommandRefused(
                Code.SYNTAX, f"expected {header.upper()} {command.arguments}".strip()
            )
        if command.armed and not (self.armed or arguments.upper() in command.harmless):
            raise CommandRefused(Code.WATCHDOG_TRIPPED if self.tripped else Code.NOT_ARMED)
        return command.run(arguments, now) or ""

    def _same_request(self, seq: int, text: str, frame: Request) -> bool:
        return seq == frame.seq and text == frame.text

    def _foreign_epoch(self, boot: int) -> bool:
        return boot != self.boot

    def _event(self, name: str, payload: str) -> bytes:
        number, self._events = self._events, wire.next_seq(self._events)
        return wire.encode(Event(number, self.boot, name, payload))

    def _record_error(self, refused: CommandRefused) -> None:
        if len(self._errors) == MAX_QUEUED_ERRORS:
            self._errors.pop()
            refused = CommandRefused(Code.QUEUE_OVERFLOW)
        self._errors.append((int(refused.code), refused.reason))

    # lease and arming -------------------------------------------------------------------------

    def _renew_lease(self, now: float) -> None:
        self._lease_end = add_us(now, 1e3 * self._lease_ms) if self.armed else math.inf

    def _disarm(self, now: float) -> None:
        self.armed = False
        self._lease_end = math.inf
        self.device.go_dark(now)

    # commands of every controller -------------------------------------------------------------

    def _own_commands(self) -> dict[str, Command]:
        acts: dict[str, CommandHandler] = {
            "*IDN?": lambda *_: f"RIGSIM,{self.device.model},{self.serial},{FIRMWARE_VERSION}",
            "*RST": self._reset,
            "*CLS": lambda *_: self._errors.clear(),
            "*OPC?": lambda _, now: "0" if self.device.is_busy(now) else "1",
            "SYST:ERR?": self._error,
            "SYST:HELLO?": lambda *_: self._hello(),
            "SYST:CAP?": self._get_capabilities,
            "SYST:CAP:PART?": self._get_capability_chunk,
            "SYST:WDOG": self._set_lease,
            "SYST:WDOG?": lambda *_: str(self._lease_ms),
            "SYST:ARM": self._arm,
            "SYST:ARM?": lambda *_: str(int(self.armed)),
            "SYST:PING?": lambda _, now: str(elapsed_us(self._powered_at, now)),
            "SAFE": self._safe,
            "ABOR": self._safe,
            "STAT?": self._status,
        }
        return build_command_table("any", acts)

    def _hello(self) -> str:
        return f"{self._protocol},{self.device.kind},{self.serial},{FIRMWARE_VERSION}"

    def _reset(self, _: str, now: float) -> None:
        self._disarm(now)
        self.device.reset(now, power_up=False)

    def _error(self, _: str, now: float) -> str:
        code, text = self._errors.popleft() if self._errors else (0, "No error")
        return f'{code},"{text}"'

    def _get_capabilities(self, _: str, now: float) -> str:
        table = {
            "kind": self.device.kind,
            "protocol": self._protocol,
            "protocol_minor": PROTOCOL_MINOR,
            "lease_min_ms": LEASE_RANGE_MS[0],
            "lease_max_ms": LEASE_RANGE_MS[1],
            **self.device.capabilities(),
        }
        return wire.seal(json.dumps(table, separators=(",", ":"), allow_nan=False))

    def _get_capability_chunk(self, arguments: str, now: float) -> str:
        text = self._get_capabilities("", now)
        last = (len(text) - 1) // CAPABILITY_CHUNK_CHARS
        part = int(parse_number(arguments, 0, last, "parts"))
        start = part * CAPABILITY_CHUNK_CHARS
        return f"{int(part == last)},{text[start : start + CAPABILITY_CHUNK_CHARS]}"

    def _set_lease(self, arguments: str, now: float) -> None:
        self._lease_ms = int(parse_number(arguments, LEASE_RANGE_MS[0], LEASE_RANGE_MS[1], "ms"))

    def _arm(self, _: str, now: float) -> None:
        self.armed = True
        self.tripped = False

    def _safe(self, _: str, now: float) -> None:
        self._disarm(now)

    def _status(self, _: str, now: float) -> str:
        own = self.armed + 2 * self.tripped + 4 * bool(self._errors)
        return str(own | self.device.status_bits(now))
