"""session.json: subject, rig, plan and provenance; written once, every byte sealed."""

import hashlib
import json
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date, datetime
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Literal

import numpy as np

from capture.documents import (
    Document,
    Fault,
    FaultCollector,
    parse_document,
    read_json,
    to_json_table,
)
from capture.former_names import translate_names
from capture.plan import Plan
from capture.rig import ID_RULE, Rig, is_id
from capture.session.errors import SessionDamage, SessionError

SCHEMA = "skinrig.session/2"
READABLE_SCHEMAS = (SCHEMA, "skinrig.session/1")
ANY_USE = "any"
Source = Literal["measured", "simulated"]

_SEAL_KEY = "seal"
_SHA256_PATTERN = re.compile(r"sha256:[0-9a-f]{64}")
_PSEUDONYM_PATTERN = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


@dataclass(frozen=True, slots=True)
class SubjectRecord(Document):
    """Captured subject, by pseudonym, and the uses that the person has consented to.

    Parameters
    ----------
    pseudonym : str
        1 to 64 letters, digits, ``_ . -``; no space, so that a full name is rejected.
    consent_scope : tuple of str
        Permitted uses of the data, e.g. ``("research", "publication")``; ``("any",)`` for every
        use, as of an object; empty for nothing beyond the capture itself.
    consent_expires : date or None
        Last day of the consent; None when it has no end.

    Examples
    --------
    >>> SubjectRecord("P042", ("research",), date(2031, 1, 1)).pseudonym
    'P042'
    """

    pseudonym: str
    consent_scope: tuple[str, ...] = ()
    consent_expires: date | None = None

    def __post_init__(self) -> None:
        checks = FaultCollector("SubjectRecord", SessionError)
        good = _PSEUDONYM_PATTERN.fullmatch(self.pseudonym) is not None
        checks.check("pseudonym", self.pseudonym, good, "letters, digits, _ . - (no full name)")
        for scope in self.consent_scope:
            checks.check("consent_scope", scope, is_id(scope), ID_RULE)
        checks.close(advice="Use a pseudonym without spaces.", code="SR-SES-011")


@dataclass(frozen=True, slots=True)
class CalibrationRef(Document):
    """Calibration in force during the capture, identified by the hash of its file."""

    kind: str
    sha256: str
    """``sha256:`` and 64 hexadecimal digits."""
    path: str = ""
    """Path at the time of the capture, for people; the hash identifies the file."""

    def __post_init__(self) -> None:
        checks = FaultCollector("CalibrationRef", SessionError)
        checks.check("kind", self.kind, is_id(self.kind), ID_RULE)
        good = _SHA256_PATTERN.fullmatch(self.sha256) is not None
        checks.check("sha256", self.sha256, good, '"sha256:" and 64 hexadecimal digits')
        checks.close()


@dataclass(frozen=True, slots=True, kw_only=True)
class Manifest(Document):
    """Content of session.json."""

    id: str
    created_at: datetime
    source: Source
    subject: SubjectRecord
    plan: Plan
    rig: Rig
    devices: Mapping[str, Any] = field(default_factory=dict)
    """Identification, serial number and limits that each controller and camera reported."""
    calibrations: tuple[CalibrationRef, ...] = ()
    seed: int | None = None
    """Seed of a simulated session; None for a measured one."""
    versions: Mapping[str, str] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)

    @property
    def has_developed_images(self) -> bool:
        """Whether imported photographs are developed images, not the mosaic of a sensor.

        A developed image has one cell of 2 x 2 equal sites per pixel.
        """
        listed = self.extra.get("photographs", [])
        photos = listed if isinstance(listed, list) else []
        return any(photo.get("encoding") != "raw" for photo in photos if isinstance(photo, dict))

    def __post_init__(self) -> None:
        checks = FaultCollector("Session", SessionError)
        checks.check("id", self.id, is_id(self.id), ID_RULE)
        good = self.source in ("measured", "simulated")
        checks.check("source", self.source, good, '"measured" or "simulated"')
        zoned = self.created_at.utcoffset() is not None
        checks.check("created_at", self.created_at.isoformat(), zoned, "a time with its zone")
        checks.close()
        self.plan.check(self.rig)

    def to_json(self) -> dict[str, Any]:
        """Return the manifest as JSON values, schema included, without the seal."""
        return {"schema": SCHEMA, **to_json_table(self)}

    def encode(self) -> tuple[bytes, str]:
        """Return the bytes of session.json and the seal that the journal starts from."""
        return seal(self.to_json())


def seal(content: Mapping[str, Any]) -> tuple[bytes, str]:
    """Return the bytes of ``content`` with its seal added, and the seal.

    Raises
    ------
    SessionError
        When ``content`` contains a value that JSON cannot represent.
    """
    try:
        entries = {name: _format_entry(value) for name, value in content.items()}
        digest = f"sha256:{hashlib.sha256(_join_entries(entries)).hexdigest()}"
        return _join_entries({**entries, _SEAL_KEY: _format_entry(digest)}), digest
    except (TypeError, ValueError, RecursionError) as exc:
        fault = Fault("devices, extra", str(exc), "texts, finite numbers, lists and tables")
        raise SessionError("the manifest cannot be written", faults=[fault]) from exc


def decode(data: bytes, *, where: str) -> tuple[Manifest, str]:
    """Return manifest and seal of the bytes of a session.json.

    Raises
    ------
    SessionError
        When the schema is not ours.
    SessionDamage
        When any byte differs from what was written, or the content is invalid.
    """
    content = read_json(data, where=where, error=SessionDamage)
    if not isinstance(content, dict):
        fault = Fault("", type(content).__name__, "a table")
        raise SessionDamage("is not a session manifest", where=where, faults=[fault])
    schema = content.pop("schema", None)
    if schema not in READABLE_SCHEMAS:
        advice = "Read it with the version of skinrig that wrote it, or check the file."
        faults = [Fault("schema", repr(schema), " or ".join(READABLE_SCHEMAS))]
        raise SessionError(
            "has an unknown schema", where=where, faults=faults, advice=advice, code="SR-SES-007"
        )
    found = content.pop(_SEAL_KEY, None)
    written, expected = seal({"schema": schema, **content})
    if found != expected or written != data:
        # equal seals with unequal bytes: a change in spacing or in the spelling of a number
        got = str(found) if found != expected else "other bytes than were sealed"
        advice = "Restore session.json from a copy: it was changed after it was written."
        faults = [Fault(_SEAL_KEY, got, expected)]
        code = "SR-SES-005"
        raise SessionDamage("is damaged", where=where, faults=faults, advice=advice, code=code)
    for part in {"plan", "rig", "calibrations"} & content.keys():
        content[part] = translate_names(content[part])
    return parse_document(Manifest, content, where=where, error=SessionDamage), expected


def package_versions() -> dict[str, str]:
    """Return the versions of the software that wrote a session."""
    try:
        ours = version("skinrig")
    except PackageNotFoundError:
        ours = "not installed"
    return {"skinrig": ours, "python": platform.python_version(), "numpy": np.__version__}


def calibration_refs(
    calibrations: Sequence[CalibrationRef | Mapping[str, str]],
) -> tuple[CalibrationRef, ...]:
    """Return references given as objects or as tables of kind, sha256 and path."""
    return tuple(
        c
        if isinstance(c, CalibrationRef)
        else parse_document(CalibrationRef, dict(c), where="calibrations", error=SessionError)
        for c in calibrations
    )


def _format_entry(value: Any) -> str:
    # an entry of a table is one level deeper; line breaks within texts are escaped
    return json.dumps(value, sort_keys=True, indent=1, allow_nan=False).replace("\n", "\n ")


def _join_entries(entries: Mapping[str, str]) -> bytes:
    """Return the table of formatted entries, as `json.dumps` with an indent of 1 formats it."""
    lines = (f"{json.dumps(name)}: {entries[name]}" for name in sorted(entries))
    return ("{\n " + ",\n ".join(lines) + "\n}\n").encode("ascii")
