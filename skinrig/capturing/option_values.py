"""Parse the values of command-line options."""

from collections.abc import Sequence
from dataclasses import replace
from typing import get_args

from capture.devices.led_box import Eyes
from skinrig.capturing.sequences import SequenceOrder
from skinrig.errors import UsageError, require_choice


def parse_eye_state(text: str) -> Eyes:
    """Parse the state of the subject's eyes: open, closed or shielded.

    Raises
    ------
    UnusableError
        For any other text.
    """
    return require_choice("--eyes", text, get_args(Eyes))


def parse_floats(text: str | None, option: str) -> tuple[float, ...] | None:
    """Parse numbers separated by commas; None for None.

    Examples
    --------
    >>> parse_floats("0,90", "--angles")
    (0.0, 90.0)

    Raises
    ------
    UsageError
        For a part that is not a number.
    """
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as exc:
        raise UsageError(f"{option}: got {text!r}, expected numbers separated by commas") from exc


def parse_names(text: str | None) -> tuple[str, ...] | None:
    """Parse names separated by commas; None for None.

    Examples
    --------
    >>> parse_names("cheek, chin")
    ('cheek', 'chin')
    """
    return None if text is None else tuple(part.strip() for part in text.split(","))


def parse_amounts(
    texts: Sequence[str],
    option: str,
    *,
    default: float | None = None,
    error: type[UsageError] = UsageError,
) -> dict[str, float]:
    """Parse ``NAME=AMOUNT`` texts into amounts by name.

    Parameters
    ----------
    texts
        Texts as typed.
    option
        Name of the option, for messages.
    default
        Amount of a name without one; None: each name needs an amount.
    error
        Class of the error.

    Raises
    ------
    UsageError
        For a text of another form, or a name given twice.

    Examples
    --------
    >>> parse_amounts(["lotion=0.6", "powder"], "--condition", default=1.0)
    {'lotion': 0.6, 'powder': 1.0}
    """
    form = "NAME=NUMBER" if default is None else "NAME or NAME=NUMBER"
    found: dict[str, float] = {}
    for text in texts:
        name, sign, amount = (part.strip() for part in text.partition("="))
        try:
            value = default if default is not None and not sign else float(amount)
            if not name or name in found:
                raise ValueError(name)
        except ValueError as exc:
            message = f"{option}: got {text.strip()!r}, expected {form}, each name once"
            raise error(message) from exc
        found[name] = value
    return found


def parse_range(text: str | None, option: str) -> tuple[int, int] | None:
    """Parse the first and last whole number of ``FIRST..LAST``; None for None.

    Examples
    --------
    >>> parse_range("-2..3", "--steps")
    (-2, 3)

    Raises
    ------
    UsageError
        For a text of another form.
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
    """Return the sequence that the options describe; None if none is requested.

    Examples
    --------
    >>> parse_sequence("smile", None, "10.25", None, None).shot_period_s
    '10.25'

    Raises
    ------
    UsageError
        For options without ``--sequence``, options of the other kind of sequence, or texts that
        are not numbers.
    """
    if state is None:
        if any(option is not None for option in (prompt_period, shot_period, captures, duration)):
            raise UsageError(
                "--prompt-period, --shot-period, --captures, --duration: options of a sequence; "
                "add --sequence STATE"
            )
        return None
    seconds = {"prompt-period": prompt_period, "shot-period": shot_period, "duration": duration}
    for option, text in seconds.items():
        try:  # only checked: the plan keeps the decimals as typed, without rounding
            float(text or 0)
        except ValueError as exc:
            raise UsageError(f"--{option}: got {text!r}, expected seconds, such as 5.5") from exc
    order = SequenceOrder(
        state=state, shot_period_s=shot_period, captures=captures, duration_s=duration
    )
    if order.is_prompted and duration is not None:
        raise UsageError(f"--duration: an option of events; use --captures for {state}")
    if not order.is_prompted and (prompt_period is not None or captures is not None):
        raise UsageError(
            f"--prompt-period, --captures: options of expressions; use --duration for {state}"
        )
    return order if prompt_period is None else replace(order, prompt_period_s=prompt_period)
