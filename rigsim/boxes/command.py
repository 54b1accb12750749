"""Commands of a box: the rows of its table, the arguments they read, and how they refuse."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from capture.devices.wire import Code
from rigsim.package_data import package_table

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


class CommandRefused(Exception):
    """A command that is not carried out, with its code; the box did nothing."""

    def __init__(self, code: Code, detail: str = "") -> None:
        super().__init__(code, detail)
        self.code = code
        self.reason = _CODE_TEXTS[code] + (f"; {detail}" if detail else "")

    @classmethod
    def raise_if(cls, condition: object, code: Code, detail: str = "") -> None:
        """Refuse the command when something is wrong."""
        if condition:
            raise cls(code, detail)


@dataclass(frozen=True, slots=True)
class PendingReply:
    """An act that is under way: it is answered when it is over."""

    at_s: float
    """When, s, on the world's clock."""
    outcome: Callable[[], str | CommandRefused]
    """Payload of the answer, or why there is none; asked for then."""


CommandHandler: TypeAlias = Callable[[str, float], str | PendingReply | None]
"""(arguments, now in s) -> payload of the answer (None: empty), or when it comes; may refuse."""


@dataclass(frozen=True, slots=True)
class Command:
    """One row of a command table."""

    run: CommandHandler
    arguments: str = ""
    """What follows the header, as the manual writes it; empty: nothing may follow."""
    armed: bool = False
    """Whether it makes light, and so is refused unless the box is armed."""
    bare: bool = False
    """Whether it is taken without a frame although it is no query: only what makes dark."""
    harmless: Sequence[str] = ()
    """Arguments, upper case, with which it makes dark: taken unarmed and without a frame."""
    manual: str = ""
    """What it does, in one line."""


def build_command_table(kind: str, handlers: Mapping[str, CommandHandler]) -> dict[str, Command]:
    """Return the commands of a kind of box, in its manual's order, each with what it does."""
    rows = package_table("box_commands")[kind]
    return {header: Command(handlers[header], **row) for header, row in rows.items()}


def parse_number(text: str, low: float, high: float, unit: str) -> float:
    """Return the number that a command gives, or refuse with -102 or -222.

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


def parse_choice(text: str, names: tuple[str, ...]) -> str:
    """Return the upper-case word that a command gives, or refuse with -102."""
    if text.upper() not in names:
        raise CommandRefused(Code.SYNTAX, f"expected {' or '.join(names)}")
    return text.upper()


def parse_token(text: str) -> str:
    """Return the token that a command gives, or refuse with -102."""
    if _WORD_PATTERN.fullmatch(text) is None:
        raise CommandRefused(Code.SYNTAX, "expected 1 to 48 of A-Z a-z 0-9 . _ -")
    return text


def parse_integer(text: str, low: int, high: int) -> int:
    """Return a whole number that a command gives, or refuse with -102 or -222."""
    if not (text.isascii() and text.isdecimal() and len(text) <= 9):
        raise CommandRefused(Code.SYNTAX, "expected a whole number")
    value = int(text)
    CommandRefused.raise_if(
        not low <= value <= high, Code.OUT_OF_RANGE, f"expected {low} to {high}"
    )
    return value
