"""What a subject agreed to, as it is said on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date, datetime

from capture.session import Subject


def subject_of(
    pseudonym: str, scopes: Sequence[str] | None, expires: datetime | date | None
) -> Subject:
    """Return the subject that the options name.

    Parameters
    ----------
    pseudonym
        Never a name.
    scopes
        What the data may be used for; each may hold several, separated by commas.
    expires
        Last day of the consent; None where it has no end.

    Raises
    ------
    SessionError
        For a full name, or a scope that cannot be one.

    Examples
    --------
    >>> subject_of("P042", ["research,teaching", "publication"], date(2031, 1, 1)).consent_scope
    ('research', 'teaching', 'publication')
    """
    words = [word.strip() for text in scopes or () for word in text.split(",")]
    day = expires.date() if isinstance(expires, datetime) else expires
    return Subject(pseudonym, tuple(dict.fromkeys(filter(None, words))), day)
