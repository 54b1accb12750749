"""Values of options: texts of the command line, read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast, get_args

from capture.devices.led_box import Eyes
from skinrig.capturing.sequences import SequenceOrder
from skinrig.errors import UnusableError, UsageError


def parse_eye_state(text: str) -> Eyes:
    """Return what is said of the subject's eyes.

    Raises
    ------
    UnusableError
    """
    if text not in get_args(Eyes):
        raise UnusableError(f"--eyes: got {text!r}, expected one of {', '.join(get_args(Eyes))}")
    return cast(Eyes, text)


def parse_floats(text: str | None, option: str) -> tuple[float, ...] | None:
    """Return numbers joined by commas; None for None.

    Examples
    --------
    >>> parse_floats("0,90", "--angles")
    (0.0, 90.0)

    Raises
    ------
    UsageError
    """
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as exc:
        raise UsageError(f"{option}: got {text!r}, expected numbers joined by commas") from exc


def parse_names(text: str | None) -> tuple[str, ...] | None:
    """Return names joined by commas; None for None.

    Examples
    --------
    >>> parse_names("cheek, chin")
    ('cheek', 'chin')
    """
    return None if text is None else tuple(part.strip() for part in text.split(","))


def parse_amounts(texts: Sequence[str] | None, option: str) -> dict[str, float]:
    """Return the amounts of ``NAME`` or ``NAME=AMOUNT``; a name alone stands for 1.

    Examples
    --------
    >>> parse_amounts(["lotion=0.6", "powder"], "--condition")
    {'lotion': 0.6, 'powder': 1.0}

    Raises
    ------
    UsageError
    """
    found: dict[str, float] = {}
    for text in texts or ():
        name, sign, amount = text.partition("=")
        try:
            value = float(amount) if sign else 1.0
        except ValueError as exc:
            raise UsageError(f"{option}: got {text!r}, expected NAME or NAME=AMOUNT") from exc
        if not name or name in found:
            raise UsageError(f"{option}: got {text!r}, expected each NAME once, or NAME=AMOUNT")
        found[name] = value
    return found


def parse_range(text: str | None, option: str) -> tuple[int, int] | None:
    """Return the first and last number of ``FIRST..LAST``; None for None.

    Examples
    --------
    >>> parse_range("-2..3", "--steps")
    (-2, 3)

    Raises
    ------
    UsageError
    """
    if text is None:
        return None
    first, dots, last = text.partition("..")
    try:
        if not dots:
            raise ValueError(text)
        return int(first), int(last)
    except ValueError as exc:
        raise UsageError(f"{option}: got {text!r}, expected FIRST..LAST, such as -2..3") from exc


def parse_sequence(
    state: str | None,
    prompt_period: str | None,
    shot_period: str | None,
    captures: int | None,
    duration: str | None,
) -> SequenceOrder | None:
    """Return the sequence that options ask for; None without one.

    Examples
    --------
    >>> parse_sequence("smile", None, "10.25", None, None).shot_period_s
    '10.25'

    Raises
    ------
    UsageError
        For options without a sequence, or of another kind of it, or that are no numbers.
    """
    if state is None:
        if any(option is not None for option in (prompt_period, shot_period, captures, duration)):
            raise UsageError(
                "--prompt-period, --shot-period, --captures, --duration: are for a sequence; add "
                "--sequence STATE"
            )
        return None
    for option, text in (
        ("--prompt-period", prompt_period),
        ("--shot-period", shot_period),
        ("--duration", duration),
    ):
        if text is not None:
            _seconds(text, option)
    order = SequenceOrder(
        state=state, shot_period_s=shot_period, captures=captures, duration_s=duration
    )
    if order.prompted and duration is not None:
        raise UsageError(f"--duration: is for an event; {state} goes by --captures")
    if not order.prompted and (prompt_period is not None or captures is not None):
        raise UsageError(f"--prompt-period, --captures: {state} is no expression; use --duration")
    return order if prompt_period is None else replace(order, prompt_period_s=prompt_period)


def _seconds(text: str, option: str) -> None:
    """Refuse what is no number; the plan keeps the digits as they were given."""
    try:
        float(text)
    except ValueError as exc:
        raise UsageError(f"{option}: got {text!r}, expected seconds, such as 5.5") from exc
