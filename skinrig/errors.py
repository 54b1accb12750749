"""Map exceptions of commands to one sentence and an exit code.

Exit codes:

=== ================================================================================
0   done
1   a limit was missed
2   invalid command line: an unknown command or option, an argument that is missing or malformed,
    or two that exclude each other
3   invalid input: a name, a number, a file or a session that is unknown, out of range, damaged or
    unusable
4   a device or a capture failed
5   an optional part of the distribution is missing
70  a defect of skinrig
130 interrupted
=== ================================================================================
"""

import errno
import re
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

Choice = TypeVar("Choice", bound=str)

EXIT_DONE = 0
EXIT_LIMIT_MISSED = 1
EXIT_USAGE = 2
EXIT_BAD_INPUT = 3
EXIT_DEVICE_FAILED = 4
EXIT_EXTRA_MISSING = 5
EXIT_BUG = 70
EXIT_INTERRUPTED = 130
EXIT_CODE_HELP = (
    f"{EXIT_DONE} done; {EXIT_LIMIT_MISSED} a limit was missed; {EXIT_USAGE} invalid command line "
    "(an argument is missing, malformed or excluded by another); "
    f"{EXIT_BAD_INPUT} invalid input (unknown, out of range, damaged or unusable); "
    f"{EXIT_DEVICE_FAILED} a device or a capture failed; "
    f"{EXIT_EXTRA_MISSING} an optional part is missing; {EXIT_BUG} a defect of skinrig; "
    f"{EXIT_INTERRUPTED} interrupted."
)
"""Exit codes as listed by ``skinrig --help``; the module's docstring has more detail."""


class MissingExtra(ImportError):
    """An optional part of the distribution is not installed."""

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(
            f"{what} needs the optional part '{extra}': pip install 'skinrig[{extra}]' [SR-ENV-001]"
        )


class UsageError(ValueError):
    """An argument that is missing, malformed or excluded by another."""


class UnusableError(ValueError):
    """A well-formed argument whose value is unknown, out of range or unusable."""


def require_choice(
    name: str, value: str, choices: Iterable[Choice], error: type[Exception] = UnusableError
) -> Choice:
    """Return the value if it is one of the choices, else raise an error that lists them.

    Parameters
    ----------
    name
        Option or field, for the message.
    value
        Given value.
    choices
        Valid values.
    error
        Class of the error.

    Examples
    --------
    >>> require_choice("--clamp", "unit", ("unit", "signed"))
    'unit'
    """
    known = tuple(choices)
    for choice in known:
        if value == choice:
            return choice
    raise error(
        f"{name}: got {value!r}, expected one of {', '.join(known)}; choose one [SR-CLI-004]"
    )


_CODE = re.compile(r" \[(SR-[A-Z]{3}-[0-9]{3})\]")
"""Code in a message. Codes are never reused; docs/how-to/troubleshooting.md has a row for each."""


def message_code(message: str) -> str | None:
    """Return the code at the end of an error message, or None.

    Examples
    --------
    >>> message_code("weights: got 'a', expected name=value; correct it [SR-CLI-000]")
    'SR-CLI-000'
    """
    found = re.search(_CODE.pattern + "$", message)
    return found[1] if found else None


def move_code_to_end(message: str) -> str:
    """Return a message with one code, at its end: that of the outermost error that has one.

    Examples
    --------
    >>> move_code_to_end("left: no file [SR-IMP-000]; name another")
    'left: no file; name another [SR-IMP-000]'
    """
    codes = _CODE.findall(message)
    return f"{_CODE.sub('', message)} [{codes[-1]}]" if codes else message


def exit_code(error: BaseException) -> int:
    """Return the exit code of an exception.

    Device errors are recognized by the package of their class, so that this module need not import
    the drivers.
    """
    if isinstance(error, KeyboardInterrupt):
        return EXIT_INTERRUPTED
    if isinstance(error, ImportError) and (error.name or "").split(".")[0] in _OWN_PACKAGES:
        return EXIT_BUG
    if isinstance(error, ImportError):
        return EXIT_EXTRA_MISSING
    if isinstance(error, UsageError):
        return EXIT_USAGE
    own = [kind for kind in type(error).__mro__ if kind.__module__.split(".")[0] in _OWN_PACKAGES]
    names = {kind.__name__ for kind in own}
    if any(kind.__module__.startswith("capture.devices") for kind in own) or (
        names & {"DeviceError", "AcquisitionError"}
    ):
        return EXIT_DEVICE_FAILED
    if own or isinstance(error, (ValueError, OSError, MemoryError)):
        return EXIT_BAD_INPUT
    return EXIT_BUG


def is_interruption(error: BaseException | None) -> bool:
    """Return whether an exception is Ctrl-C, or was raised because of it.

    Examples
    --------
    >>> error = SystemError("import failed")
    >>> error.__cause__ = KeyboardInterrupt()
    >>> is_interruption(error), is_interruption(SystemError("import failed"))
    (True, False)
    """
    waiting, followed = [error], set[int]()
    while waiting:
        one = waiting.pop()
        if isinstance(one, KeyboardInterrupt):
            return True
        if one is not None and id(one) not in followed:
            followed.add(id(one))
            waiting += [one.__cause__, one.__context__]
    return False


_ADVICE_BY_ERROR = {
    errno.ENOENT: "check the name, and the folder that the command runs in [SR-CLI-001]",
    errno.EEXIST: "a file or folder of that name exists; name another",
    errno.ENOTDIR: "a part of this path is a file, expected a folder; name another",
    errno.EISDIR: "expected a file; name another",
    errno.EACCES: "no permission; change its permissions, or name another [SR-CLI-002]",
    errno.EPERM: "no permission; change its permissions, or name another [SR-CLI-002]",
    errno.EROFS: "the disk is mounted read-only; name another",
    errno.ENOSPC: "free space, or name another disk, then run the command again [SR-CLI-003]",
    errno.EDQUOT: "free space, or name another disk, then run the command again [SR-CLI-003]",
}
"""Advice by the operating system's error number."""
_OWN_PACKAGES = ("capture", "reconstruction", "model", "rigsim", "skinrig")


RESUMABLE_COMMANDS = ("capture", "serve", "simulate")
"""Commands that have --resume."""


def find_command(given: Sequence[str]) -> str:
    """Return the name of the command in a command line; empty without one.

    Examples
    --------
    >>> find_command(["--verbose", "report", "capture"])
    'report'
    """
    return next((word for word in given if not word.startswith("-")), "")


def format_interruption(given: Sequence[str]) -> str:
    """Return the message of an interrupted command.

    Parameters
    ----------
    given
        Name and arguments of the command.

    Examples
    --------
    >>> format_interruption(["simulate", "flash", "--out", "not-begun"])
    'interrupted; run the same command again'
    >>> format_interruption(["bench", "--out", "bench"])
    'interrupted; bench.json in --out keeps what was measured; run the same command to continue'
    """
    command = find_command(given)
    if command == "serve":  # it resumes from the session of its client, not from its own
        return "interrupted; serve with --resume SESSION to continue a session captured from it"
    words = [part for word in given for part in word.split("=", 1)]
    out = next((after for word, after in pairwise(words) if word == "--out"), None)
    if command in RESUMABLE_COMMANDS and out and Path(out, "session.json").is_file():
        return "interrupted; run the same command with --resume to continue"
    if command == "bench" and out and "--extremes" not in given:
        kept = "interrupted; bench.json in --out keeps what was measured"
        named = {"--stage", "--end-to-end"} & {*words}  # these are measured again
        return kept if named else f"{kept}; run the same command to continue"
    if command == "reconstruct":
        return "interrupted; run the same command again: it takes up the finished stages"
    return "interrupted; run the same command again"


def format_error(error: BaseException) -> str:
    """Return the message of an exception, without a traceback and with its code at the end."""
    return move_code_to_end(_describe(error))


def _describe(error: BaseException) -> str:
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    if isinstance(error, OSError) and error.strerror and error.errno in _ADVICE_BY_ERROR:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror}; {_ADVICE_BY_ERROR[error.errno]}"
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, UnicodeDecodeError):
        return (
            f"text file: got byte {error.object[error.start]:#04x} at {error.start}, expected "
            "UTF-8; check that it is the right file [SR-CLI-009]"
        )
    text = str(error).strip() or type(error).__name__
    if isinstance(error, MemoryError):
        wanted = "" if text == type(error).__name__ else f" ({text})"
        return (
            f"memory: not enough for this size{wanted}; close other programs, raise the limit of "
            "the process (ulimit -v), or use a smaller size [SR-CLI-015]"
        )
    if exit_code(error) == EXIT_BUG:
        return (
            f"defect of skinrig ({type(error).__name__}: {text}); "
            "run again with SKINRIG_TRACEBACK=1 and report the output [SR-CLI-010]"
        )
    return text
