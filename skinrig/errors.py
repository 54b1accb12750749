"""From an exception to one sentence and an exit code.

What a command ends with:

=== ================================================================================
0   done
1   a limit was missed
2   the command line cannot be read: a command or an option that does not exist, an argument that
    is missing or not of its form, or two that do not go together
3   it can be read, but what it names or asks for is not known, out of range, damaged or cannot be
    used: a name, a number, a file, a session
4   a device or a capture failed
5   an optional part of the distribution is missing
70  a fault of skinrig's own
130 interrupted
=== ================================================================================
"""

import errno
from collections.abc import Iterable, Sequence
from typing import TypeVar

Choice = TypeVar("Choice", bound=str)

EXIT_DONE = 0
LIMIT_MISSED = 1
EXIT_USAGE = 2
BAD_INPUT = 3
DEVICE_FAILED = 4
EXTRA_MISSING = 5
EXIT_BUG = 70
EXIT_INTERRUPTED = 130
EXIT_CODE_HELP = (
    f"{EXIT_DONE} done; {LIMIT_MISSED} a limit was missed; {EXIT_USAGE} the command line cannot be "
    f"read (an argument missing, not of its form, or at odds with another); {BAD_INPUT} what it "
    f"names is not known, out of range, damaged or of no use; {DEVICE_FAILED} a device or a "
    "capture failed; "
    f"{EXTRA_MISSING} an optional part is missing; {EXIT_BUG} a fault of skinrig's own; "
    f"{EXIT_INTERRUPTED} interrupted."
)
"""What commands end with, as the help tells it; the module's text says it at length."""


class MissingExtra(ImportError):
    """An optional part of the distribution is not installed."""

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(
            f"{what} needs the optional part '{extra}': pip install 'skinrig[{extra}]'"
        )


class UsageError(ValueError):
    """An argument that is missing or not of its form, or that does not go with another."""


class UnusableError(ValueError):
    """An argument that can be read, but names or asks for what is not there or cannot be used."""


def one_of(
    name: str, value: str, choices: Iterable[Choice], error: type[Exception] = UnusableError
) -> Choice:
    """Return a value that is one of the choices, else raise an error that names them.

    Parameters
    ----------
    name
        What the value is of: an option, a field.
    value
        As it was given.
    choices
        What it may be.
    error
        Class of the error.

    Examples
    --------
    >>> one_of("--clamp", "unit", ("unit", "signed"))
    'unit'
    """
    known = tuple(choices)
    for choice in known:
        if value == choice:
            return choice
    raise error(f"{name}: got {value!r}, expected one of {', '.join(known)}")


def exit_code(error: BaseException) -> int:
    """Return the exit code that stands for ``error``.

    Device errors are told from bad input by the package that raised them, so that this
    module need not import the drivers.
    """
    if isinstance(error, KeyboardInterrupt):
        return EXIT_INTERRUPTED
    if isinstance(error, ImportError) and (error.name or "").split(".")[0] in _OWN_PACKAGES:
        return EXIT_BUG
    if isinstance(error, ImportError):
        return EXTRA_MISSING
    if isinstance(error, UsageError):
        return EXIT_USAGE
    own = [kind for kind in type(error).__mro__ if kind.__module__.split(".")[0] in _OWN_PACKAGES]
    names = {kind.__name__ for kind in own}
    if any(kind.__module__.startswith("capture.devices") for kind in own) or (
        names & {"DeviceError", "AcquisitionError"}
    ):
        return DEVICE_FAILED
    if own or isinstance(error, (ValueError, OSError)):
        return BAD_INPUT
    return EXIT_BUG


_ADVICE_BY_ERROR = {
    errno.ENOENT: "check the name, and the folder that the command runs in",
    errno.EEXIST: "something of that name is there already; name another",
    errno.ENOTDIR: "a part of this path is a file, expected a folder; name another",
    errno.EISDIR: "expected a file; name another",
    errno.EACCES: "no right to it; change its rights, or name another",
    errno.EPERM: "no right to it; change its rights, or name another",
    errno.EROFS: "the disk is mounted for reading alone; name another",
    errno.ENOSPC: "free space, or name another disk, then run the same command again",
    errno.EDQUOT: "free space, or name another disk, then run the same command again",
}
"""What to do, by the number of the system's error."""
_OWN_PACKAGES = ("capture", "reconstruction", "model", "rigsim", "skinrig")


RESUMABLE_COMMANDS = ("capture", "serve", "simulate")
"""Commands that have --resume."""


def interruption(given: Sequence[str]) -> str:
    """Return what to print of a command that was interrupted.

    Parameters
    ----------
    given
        Its name and arguments.

    Examples
    --------
    >>> interruption(["simulate", "flash"])
    'interrupted; the same command with --resume goes on'
    >>> interruption(["bench", "--out", "bench"])
    'interrupted; bench.json in --out keeps what was measured'
    """
    command = next((word for word in given if not word.startswith("-")), "")
    if command == "serve":  # what it is resumed with is not its own
        return "interrupted; serve with --resume SESSION to go on with a session captured from it"
    if command in RESUMABLE_COMMANDS:
        return "interrupted; the same command with --resume goes on"
    kept = any(word == "--out" or word.startswith("--out=") for word in given)
    if command == "bench" and kept and "--extremes" not in given:
        return "interrupted; bench.json in --out keeps what was measured"
    return "interrupted; run the same command again"


def sentence(error: BaseException) -> str:
    """Return what to print for ``error``, without a traceback."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    if isinstance(error, OSError) and error.strerror and error.errno in _ADVICE_BY_ERROR:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror}; {_ADVICE_BY_ERROR[error.errno]}"
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f"{error.filename}: {error.strerror}"
    if isinstance(error, UnicodeDecodeError):
        return (
            f"a file that was to be UTF-8 text is not (byte {error.start} of it is "
            f"{error.object[error.start]:#04x}); is another file meant?"
        )
    text = str(error).strip() or type(error).__name__
    if exit_code(error) == EXIT_BUG:
        return (
            f"this is a fault of skinrig, not yours ({type(error).__name__}: {text}); "
            "run again with SKINRIG_TRACEBACK=1 and report what it prints"
        )
    return text
