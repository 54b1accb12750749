"""Line format between host and controller: framing, sequence numbers, checksum, codes; no I/O.

Three kinds of lines exist, each printable ASCII ended by a newline, at most 1024 bytes long::

    host -> box   @<seq>:<boot> <text>*<CRC4>             @17:9f3a FLAS:FIRE a1*68AB
    box -> host   =<seq>:<boot> <code> <payload>*<CRC4>
    box -> host   !<number>:<boot> <NAME> <payload>*<CRC4>

``seq`` and ``number`` are decimal without leading zeros, 0 to 2**32 - 1; ``boot`` is the epoch that
the controller drew at power-up, four lower-case hexadecimal digits, with 0000 for "not known yet";
``CRC4`` is CRC-16/IBM-3740 of all bytes before its ``*``, four upper-case hexadecimal digits. One
frame has exactly one encoding, so that a retry can be recognized by its bytes. Any other line is
bare: people and foreign programs may send queries that way, never a command.
"""

import binascii
import enum
import re
from dataclasses import dataclass

PROTOCOL_VERSION = 1
MAX_LINE_BYTES = 1024
"""Longest line in bytes, its newline included."""
MAX_SEQ = 2**32 - 1
UNKNOWN_BOOT = 0
"""Epoch of a host before hello; no controller ever draws it."""

_NUMBER_PATTERN = r"(0|[1-9][0-9]{0,9})"
_FRAME_PATTERN = re.compile(rf"([@=!]){_NUMBER_PATTERN}:([0-9a-f]{{4}}) (.*)", re.DOTALL)
_CODE_PATTERN = re.compile(r"(0|-?[1-9][0-9]{0,3})(?: (.*))?", re.DOTALL)
_NAME_PATTERN = re.compile(r"([A-Z][A-Z0-9:]{0,31})(?: (.*))?", re.DOTALL)
_CHECKSUM_PATTERN = re.compile(rb"\*[0-9A-F]{4}\Z")


class BadFrame(ValueError):
    """Raised for a line that is not exactly one frame; its number must not be guessed."""


class Code(enum.IntEnum):
    """Result codes of a controller: 0 done, negative as SCPI defines them, positive ours."""

    OK = 0
    SYNTAX = -102
    UNDEFINED_HEADER = -113
    NOT_ARMED = -203
    IGNORED = -213
    OUT_OF_RANGE = -222
    HARDWARE = -240
    QUEUE_OVERFLOW = -350
    DUTY = 101
    THERMAL = 102
    RECYCLE = 103
    LIGHT_DOSE = 104
    FLICKER = 105
    FORCE = 106
    INTERLOCK = 107
    WATCHDOG_TRIPPED = 108
    BOOT_CHANGED = 201
    SEQ_REUSED = 202
    UNFRAMED = 203
    BAD_CRC = 204


def _check_counter(field: str, value: int) -> None:
    if not 0 <= value <= MAX_SEQ:
        raise ValueError(f"{field}: got {value}, expected 0 to {MAX_SEQ}")


def _check_boot(value: int) -> None:
    if not 0 <= value <= 0xFFFF:
        raise ValueError(f"boot: got {value}, expected 0 to 65535")


def _check_text(field: str, value: str) -> None:
    if not all(" " <= character <= "~" for character in value):
        raise ValueError(f"{field}: got {value!r}, expected printable ASCII")


@dataclass(frozen=True, slots=True)
class Request:
    """One numbered command or query from the host."""

    seq: int
    """Sequence number, 0 to 2**32 - 1; a retry keeps it."""
    boot: int
    """Epoch that the host assumes, 0 to 65535; 0 before hello."""
    text: str
    """Command and arguments, printable ASCII, not empty."""

    def __post_init__(self) -> None:
        _check_counter("seq", self.seq)
        _check_boot(self.boot)
        _check_text("text", self.text)
        if not self.text:
            raise ValueError("text: got '', expected a command")


@dataclass(frozen=True, slots=True)
class Reply:
    """The answer to one request."""

    seq: int
    """Number of the request that is answered."""
    boot: int
    """Epoch of the controller, 1 to 65535."""
    code: int
    """0 done; any other value: refused, nothing was done (see `Code`)."""
    payload: str = ""
    """Requested value, or the reason of the refusal; printable ASCII."""

    def __post_init__(self) -> None:
        _check_counter("seq", self.seq)
        _check_boot(self.boot)
        _check_text("payload", self.payload)
        if not -9999 <= self.code <= 9999:
            raise ValueError(f"code: got {self.code}, expected -9999 to 9999")


@dataclass(frozen=True, slots=True)
class Event:
    """Message that a controller sends without a request."""

    number: int
    """Counter of events since power-up, from which lost events are detected."""
    boot: int
    """Epoch of the controller, 1 to 65535."""
    name: str
    """Upper-case word, e.g. ``WDOG:TRIP``."""
    payload: str = ""
    """Details; printable ASCII."""

    def __post_init__(self) -> None:
        _check_counter("number", self.number)
        _check_boot(self.boot)
        _check_text("payload", self.payload)
        if _NAME_PATTERN.fullmatch(self.name) is None:
            raise ValueError(f"name: got {self.name!r}, expected upper-case words like 'WDOG:TRIP'")


def crc16(data: bytes) -> int:
    """Return CRC-16/IBM-3740 of `data`, 0 to 65535.

    Examples
    --------
    >>> hex(crc16(b"123456789"))  # the check value of the catalogue
    '0x29b1'
    """
    return binascii.crc_hqx(data, 0xFFFF)


def seal(text: str) -> str:
    """Append ``*CRC4`` to a printable ASCII text.

    Examples
    --------
    >>> seal("SYST:PING?")
    'SYST:PING?*24DD'
    """
    return f"{text}*{crc16(text.encode('ascii')):04X}"


def unseal(sealed: str) -> str:
    """Return the text that `seal` has sealed; raise `BadFrame` when it is damaged."""
    data = sealed.encode("ascii", errors="replace")
    if _CHECKSUM_PATTERN.search(data) is None:
        raise BadFrame(f"checksum: got {sealed[-5:]!r} at the end, expected '*' and 4 hex digits")
    body, stated = data[:-5], int(data[-4:], 16)
    if crc16(body) != stated:
        raise BadFrame(f"checksum: got {stated:04X}, expected {crc16(body):04X}")
    return body.decode("ascii")


def encode(frame: Request | Reply | Event) -> bytes:
    r"""Return the one encoding of a frame, newline included.

    Raises
    ------
    ValueError
        When the line would be longer than `MAX_LINE_BYTES`.

    Examples
    --------
    >>> encode(Request(17, 0x9F3A, "FLAS:FIRE a1"))
    b'@17:9f3a FLAS:FIRE a1*68AB\n'
    """
    match frame:
        case Request(seq, boot, text):
            body = f"@{seq}:{boot:04x} {text}"
        case Reply(seq, boot, code, payload):
            body = f"={seq}:{boot:04x} {int(code)}" + (f" {payload}" if payload else "")
        case Event(number, boot, name, payload):
            body = f"!{number}:{boot:04x} {name}" + (f" {payload}" if payload else "")
    line = seal(body).encode("ascii") + b"\n"
    if len(line) > MAX_LINE_BYTES:
        raise ValueError(f"frame: got {len(line)} bytes, expected at most {MAX_LINE_BYTES}")
    return line


def decode(line: bytes) -> Request | Reply | Event:
    """Return the frame in a line without its newline.

    Raises
    ------
    BadFrame
        For any line that `encode` cannot have produced.

    Examples
    --------
    >>> decode(b"@17:9f3a FLAS:FIRE a1*68AB")
    Request(seq=17, boot=40762, text='FLAS:FIRE a1')
    """
    if len(line) >= MAX_LINE_BYTES:
        raise BadFrame(f"line: got {len(line)} bytes, expected fewer than {MAX_LINE_BYTES}")
    if any(not 0x20 <= byte <= 0x7E for byte in line):
        raise BadFrame("line: got a byte outside printable ASCII")
    body = unseal(line.decode("ascii"))
    head = _FRAME_PATTERN.fullmatch(body)
    if head is None:
        raise BadFrame(f"frame: got {body[:24]!r}, expected '@', '=' or '!', seq:boot and a text")
    mark, number, boot, rest = head[1], int(head[2]), int(head[3], 16), head[4]
    try:
        if mark == "@":
            return Request(number, boot, rest)
        tail = (_CODE_PATTERN if mark == "=" else _NAME_PATTERN).fullmatch(rest)
        if tail is None or tail[2] == "":
            raise BadFrame(f"frame: got {rest[:24]!r} after seq:boot, expected a code or a name")
        if mark == "=":
            return Reply(number, boot, int(tail[1]), tail[2] or "")
        return Event(number, boot, tail[1], tail[2] or "")
    except BadFrame:
        raise
    except ValueError as exc:
        raise BadFrame(str(exc)) from exc


def is_frame_like(line: bytes) -> bool:
    """Return whether a line is a frame, or a damaged one."""
    return line[:1] in (b"@", b"=", b"!") or _CHECKSUM_PATTERN.search(line) is not None


def next_seq(seq: int) -> int:
    """Return the number after `seq`, modulo 2**32."""
    return 0 if seq == MAX_SEQ else seq + 1


def is_behind(number: int, latest: int) -> bool:
    """Return whether a counter of 32 bits is behind the latest one: an old line, come again.

    Examples
    --------
    >>> is_behind(7, 8), is_behind(8, 8), is_behind(0, 2**32 - 1)
    (True, False, False)
    """
    return (number - latest) % (MAX_SEQ + 1) > MAX_SEQ // 2


class LineSplitter:
    r"""Split a byte stream into lines and drop a line that is too long, up to the next newline.

    One carriage return before the newline is removed, because terminals send it.

    Examples
    --------
    >>> splitter = LineSplitter()
    >>> splitter.feed(b"*IDN?\r\n@1:0")
    [b'*IDN?']
    >>> splitter.feed(b"000 SYST:HELLO?*9A6F\n")
    [b'@1:0000 SYST:HELLO?*9A6F']
    """

    def __init__(self) -> None:
        self._pending = bytearray()
        self._discarding = False
        self.overlong_lines = 0

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that `data` completes, without their ends; empty lines are omitted."""
        lines = []
        *ended, rest = data.split(b"\n")
        for piece in ended:
            self._take(piece)
            if not self._discarding and self._pending:
                lines.append(bytes(self._pending).removesuffix(b"\r"))
            self._pending.clear()
            self._discarding = False
        self._take(rest)
        return [line for line in lines if line]

    def clear(self) -> None:
        """Drop a line that has begun."""
        self._pending.clear()
        self._discarding = False

    def _take(self, piece: bytes) -> None:
        if self._discarding:
            return
        self._pending += piece
        if len(self._pending) >= MAX_LINE_BYTES:
            self._pending.clear()
            self._discarding = True
            self.overlong_lines += 1
