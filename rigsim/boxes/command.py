"""Command tables of controllers: rows, argument parsers, refusals, and the clock's resolution.

Times are world times in s, as floats. A time on the clock's grid is the float nearest to a whole
number of microseconds, so that two equal times compare as equal, whatever sums they come from.
"""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from capture.devices.wire import Code
from rigsim.package_data import package_table

_NUMBER_PATTERN = re.compile(r"-?[0-9]{1,9}(\.[0-9]{1,9})?")
_WORD_PATTERN = re.compile(r"[A-Za-z0-9._-]{1,48}")

_FLOAT_ERROR_US = 1e-4

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
    Code.FLICKER: "Flicker; set SAFE:EYES to CLOSED or SHIELDED once eyes are safe",
    Code.FORCE: "Force limit",
    Code.INTERLOCK: "Interlock open",
    Code.WATCHDOG_TRIPPED: "Watchdog tripped; SYST:ARM first",
    Code.BOOT_CHANGED: "Boot changed; SYST:HELLO? first",
    Code.SEQ_REUSED: "Sequence number reused",
    Code.UNFRAMED: "Unframed command",
    Code.BAD_CRC: "Bad frame",
}


class CommandRefused(Exception):
    """A command that is refused, with its code; the controller has done nothing."""

    def __init__(self, code: Code, detail: str = "") -> None:
        super().__init__(code, detail)
        self.code = code
        self.reason = _CODE_TEXTS[code] + (f"; {detail}" if detail else "")

    @classmethod
    def raise_if(cls, condition: object, code: Code, detail: str = "") -> None:
        """Refuse the command when `condition` is true."""
        if condition:
            raise cls(code, detail)


@dataclass(slots=True)
class PendingReply:
    """A command in progress: it is answered when it is complete, or when it is ended early."""

    at_s: float
    """Time of the answer on the world's clock, s."""
    outcome: Callable[[], str | CommandRefused]
    """Payload of the answer, or the refusal; evaluated at that time."""

    def end(self, now: float, code: Code, reason: str) -> None:
        """Have the command refused at `now`, in s, before it is complete."""
        self.at_s, refused = min(self.at_s, now), CommandRefused(code, reason)
        self.outcome = lambda: refused


CommandHandler: TypeAlias = Callable[[str, float], str | PendingReply | None]
"""(arguments, now in s) -> payload of the answer (None: empty), or a pending one; may refuse."""


@dataclass(frozen=True, slots=True)
class Command:
    """One row of a command table."""

    run: CommandHandler
    arguments: str = ""
    """Arguments after the header, in the manual's notation; empty: none are allowed."""
    armed: bool = False
    """Whether it makes light and is therefore refused unless the controller is armed."""
    bare: bool = False
    """Whether it is accepted without a frame although it is not a query, as for going dark."""
    harmless: Sequence[str] = ()
    """Arguments, upper case, that make dark: accepted unarmed and without a frame."""
    manual: str = ""
    """Effect, in one line."""


def build_command_table(kind: str, handlers: Mapping[str, CommandHandler]) -> dict[str, Command]:
    """Return the commands of a kind of controller with their effects, in its manual's order."""
    rows = package_table("box_commands")[kind]
    return {header: Command(handlers[header], **row) for header, row in rows.items()}


def parse_number(text: str, low: float, high: float, unit: str) -> float:
    """Parse the number of a command, or refuse with -102 or -222.

    Examples
    --------
    >>> parse_number("0.5", 0.0, 1.0, "of full power")
    0.5
    """
    if _NUMBER_PATTERN.fullmatch(text) is None:
        raise CommandRefused(Code.SYNTAX, "expected a number")
    value = float(text)
    if not low <= value <= high:
        raise CommandRefused(Code.OUT_OF_RANGE, f"expected {low:g} to {high:g} {unit}")
    return value


def parse_decimal(text: str, low: float, high: float, unit: str, *, digits: int) -> int:
    """Parse the number of a command to whole multiples of ``10**-digits``, halves rounded up.

    The range is that of the number as it was sent.

    Examples
    --------
    >>> parse_decimal("0.0005", 0.0, 1.0, "degrees", digits=3)
    1
    """
    parse_number(text, low, high, unit)
    whole, _, part = text.lstrip("-").partition(".")
    nano = int(whole) * 10**9 + int(part.ljust(9, "0"))
    unit_nano = 10 ** (9 - digits)
    return (2 * (-nano if text[0] == "-" else nano) + unit_nano) // (2 * unit_nano)


def parse_choice(text: str, names: tuple[str, ...]) -> str:
    """Parse the word of a command, upper case, or refuse with -102."""
    if text.upper() not in names:
        raise CommandRefused(Code.SYNTAX, f"expected {' or '.join(names)}")
    return text.upper()


def parse_token(text: str) -> str:
    """Parse the token of a command, or refuse with -102."""
    if _WORD_PATTERN.fullmatch(text) is None:
        raise CommandRefused(Code.SYNTAX, "expected 1 to 48 of A-Z a-z 0-9 . _ -")
    return text


def parse_integer(text: str, low: int, high: int) -> int:
    """Parse the integer of a command, or refuse with -102 or -222."""
    if not (text.isascii() and text.isdecimal() and len(text) <= 9):
        raise CommandRefused(Code.SYNTAX, "expected a whole number")
    value = int(text)
    CommandRefused.raise_if(
        not low <= value <= high, Code.OUT_OF_RANGE, f"expected {low} to {high}"
    )
    return value


def whole_us(seconds: float) -> int:
    """Return the whole microseconds that have passed in `seconds`, despite a float's error.

    Examples
    --------
    >>> whole_us(0.1 + 0.2), whole_us(2.9e-6)
    (300000, 2)
    """
    return math.floor(seconds * 1e6 + _FLOAT_ERROR_US)


def on_clock(seconds: float) -> float:
    """Return a time on the clock's grid, in s: the last whole microsecond; inf stays."""
    return whole_us(seconds) / 1e6 if math.isfinite(seconds) else seconds


def add_us(now: float, duration_us: float) -> float:
    """Return the time on the grid that is `duration_us` after `now`, halves rounded up."""
    return (whole_us(now) + math.floor(duration_us + 0.5)) / 1e6


def elapsed_us(start: float, now: float) -> int:
    """Return the microseconds between two times on the grid."""
    return whole_us(now) - whole_us(start)


def elapsed_s(start: float, now: float) -> float:
    """Return the time between two times on the grid, in s, without their floats' errors."""
    return elapsed_us(start, now) / 1e6


def ceil_ms(duration_us: int) -> int:
    """Return a duration in ms, a part of one counted as a whole.

    Examples
    --------
    >>> ceil_ms(1500), ceil_ms(2000)
    (2, 2)
    """
    return -(-duration_us // 1000)


def rotation_us(angle_mdeg: int, quarter_turn_us: int) -> int:
    """Return how long a rotation takes that needs `quarter_turn_us` for 90 degrees.

    Examples
    --------
    >>> rotation_us(45_000, 500_000)
    250000
    """
    return (2 * abs(angle_mdeg) * quarter_turn_us + 90_000) // 180_000
