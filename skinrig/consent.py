"""Consent of subjects: parse it, keep it with maps and check it before an export."""

from collections.abc import Mapping, Sequence
from datetime import UTC, date, datetime
from typing import Any, Protocol

from capture.session import ConsentError, SubjectRecord
from capture.session.manifest import ANY_USE
from skinrig.errors import UsageError

CONSENT_KEY = "consent"
"""Key in an appearance's parameters: the consent of each measured session's subject."""


THING_SUBJECT = "none"
"""Subject of a session of a thing."""


class HasProvenance(Protocol):
    """An object with provenance: an appearance, its document or a library of traits."""

    @property
    def source(self) -> str:
        """Return "measured" or "simulated"."""

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Return the parameters of its computation."""


def parse_subject(
    pseudonym: str,
    scopes: Sequence[str] | None,
    expires: datetime | date | None,
    *,
    today: date | None = None,
) -> SubjectRecord:
    """Return the subject record of the options.

    Parameters
    ----------
    pseudonym
        Pseudonym, never a name; `THING_SUBJECT` for a thing, which has every use unless ``scopes``
        limits it.
    scopes
        Permitted uses; each text may list several, separated by commas.
    expires
        Last day of the consent; None: unlimited.
    today
        Date of the check; None: the current date, UTC.

    Raises
    ------
    skinrig.errors.UsageError
        For a consent that has ended.
    SessionError
        For a full name, or an invalid scope.

    Examples
    --------
    >>> ends, today = date(2031, 1, 1), date(2026, 1, 1)
    >>> uses = ["research,teaching", "publication"]
    >>> parse_subject("P042", uses, ends, today=today).consent_scope
    ('research', 'teaching', 'publication')
    >>> parse_subject(THING_SUBJECT, None, None).consent_scope
    ('any',)
    """
    if pseudonym == THING_SUBJECT and scopes is None:
        scopes = [ANY_USE]
    words = [word.strip() for text in scopes or () for word in text.split(",")]
    day = expires.date() if isinstance(expires, datetime) else expires
    now = today or datetime.now(UTC).date()
    if day is not None and day < now:
        raise UsageError(f"--consent-expires: got {day}, expected {now} or later; correct the day")
    return SubjectRecord(pseudonym, tuple(dict.fromkeys(filter(None, words))), day)


def read_consent(appearance: HasProvenance) -> list[dict[str, Any]]:
    """Return the consent records of an appearance's measured sessions, without duplicates.

    Parameters
    ----------
    appearance
        Result of a reconstruction, a fit, an edit or an evaluation.

    Returns
    -------
    list of dict
        ``pseudonym``, ``consent_scope`` and ``consent_expires`` (ISO date or None), as in
        session.json.

    Examples
    --------
    >>> from model.skin import SkinAppearance
    >>> record = {"pseudonym": "P042", "consent_scope": ["research"], "consent_expires": None}
    >>> read_consent(SkinAppearance({}, "measured", {"consent": [record]})) == [record]
    True
    """
    found = [dict(one) for part in _sources(appearance) for one in part.get(CONSENT_KEY) or ()]
    return [one for k, one in enumerate(found) if one not in found[:k]]


def merge_consent(*appearances: HasProvenance) -> list[dict[str, Any]]:
    """Merge the consent records of the appearances that a result is made of.

    A measured appearance without records counts as one of a subject without consent.

    Examples
    --------
    >>> from model.skin import SkinAppearance
    >>> merge_consent(SkinAppearance({}, "measured"))[0]["consent_scope"], merge_consent()
    ([], [])
    """
    out: list[dict[str, Any]] = []
    for appearance in appearances:
        records = read_consent(appearance)
        if _has_unknown_consent(appearance):
            records.append({"pseudonym": "unknown", "consent_scope": [], "consent_expires": None})
        out += [one for one in records if one not in out]
    return out


def format_consent(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Format consent records, one line per subject.

    Examples
    --------
    >>> first = {"pseudonym": "P042", "consent_scope": ["research"]}
    >>> second = {"pseudonym": "P7", "consent_scope": [], "consent_expires": None}
    >>> format_consent([first | {"consent_expires": "2031-01-01"}, second])
    ['P042: research, until 2031-01-01', 'P7: nothing']
    """
    lines = []
    for one in records:
        uses = ", ".join(map(str, one.get("consent_scope") or ())) or "nothing"
        last = one.get("consent_expires")
        lines.append(f"{one.get('pseudonym')}: {uses}" + (f", until {last}" if last else ""))
    return lines


def require_consent(
    appearance: HasProvenance, use: str | None, *, folder: str, today: date | None = None
) -> None:
    """Raise unless all subjects of an appearance have agreed to a use.

    Parameters
    ----------
    appearance
        Data to export. Simulated data need no consent.
    use
        Purpose, such as "research"; None: not given.
    folder
        Folder of the appearance, for messages.
    today
        Date of the check; None: the current date, UTC.

    Raises
    ------
    skinrig.errors.UsageError
        If the use is required and not given.
    ConsentError
        If the use is outside the consent, the consent has expired, or measured maps lack consent
        records.
    """
    records = read_consent(appearance)
    if _has_unknown_consent(appearance):
        raise ConsentError(
            "does not record what its subjects agreed to",
            where=folder,
            advice="An older version wrote it without consent records: compute it again from its "
            "sessions with `skinrig reconstruct` or `skinrig fit`.",
        )
    if records and use is None:
        raise UsageError("--use: got none; name the purpose of the copy [SR-EXP-001]")
    day = today or datetime.now(UTC).date()
    for record in records:
        scope = [str(word) for word in record.get("consent_scope") or ()]
        expires = record.get("consent_expires")
        if {use, ANY_USE} & set(scope) and (expires is None or day <= _day(expires, folder)):
            continue
        allowed = ", ".join(scope) or "nothing"
        raise ConsentError(
            f"subject {record.get('pseudonym')} has not agreed to this use: got {use!r}, expected "
            f"one of: {allowed}" + (f", until {expires}" if expires else ""),
            where=folder,
            advice="Ask the subject again, or keep the data inside the agreed scope.",
        )


def _day(text: object, where: str) -> date:
    try:
        return date.fromisoformat(str(text))
    except ValueError as error:
        raise ConsentError(
            f"last day of the consent: got {text!r}, expected a date such as 2031-01-31",
            where=where,
        ) from error


def _has_unknown_consent(appearance: HasProvenance) -> bool:
    """Return whether any measured part lacks consent records."""
    parts = _sources(appearance)
    return any(part.get("source") == "measured" and not part.get(CONSENT_KEY) for part in parts)


def _sources(appearance: HasProvenance) -> list[dict[str, Any]]:
    """Return the provenance of an appearance, or of each part of a moving one."""
    parts = appearance.parameters.get("parts")
    if isinstance(parts, dict) and parts:
        return [dict(part) for part in parts.values()]
    return [{"source": appearance.source, **appearance.parameters}]
